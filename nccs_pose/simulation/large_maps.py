# Copyright 2026 The nccs_pose authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.
"""Maps of many tapes: scattered at random, or in patterns that look alike from many places."""

from __future__ import annotations

import math

from nccs_pose.geometry.lines import Line, LineMap
import numpy as np

_WIDTH = 0.05


def scattered(count: int, half_side: float, lengths: tuple[float, float], seed: int) -> LineMap:
    """Tapes anywhere: no place looks like another.

    :param half_side: their middles lie in a square of twice this, m.
    :param lengths: least and greatest, m.
    """
    rng = np.random.default_rng(seed)
    middle = rng.uniform(-half_side, half_side, (count, 2))
    angle = rng.uniform(0.0, math.pi, count)
    half = 0.5 * rng.uniform(*lengths, count)[:, None] * np.stack(
        (np.cos(angle), np.sin(angle)), axis=1)
    return _tapes(middle - half, middle + half)


def parking_bays() -> LineMap:
    """Two walls with a row of 23 equal bays along each, 0.6 by 1.5 m, and a lane between."""
    x = 0.6 * np.arange(24) - 6.9
    starts = [(side, 1.5) for side in x] + [(side, -3.0) for side in x]
    ends = [(side, 3.0) for side in x] + [(side, -1.5) for side in x]
    walls = np.array([(-6.9, 3.0), (-6.9, -3.0)])
    return _tapes(
        np.concatenate((starts, walls)), np.concatenate((ends, walls * (-1.0, 1.0))))


def dashes() -> LineMap:
    """Two dashed roads that cross, 2 m wide: dashes half a metre long and as far apart."""
    along = np.arange(13.0) - 6.25
    x, across = np.concatenate((along, along)), np.repeat((-1.0, 1.0), 13)
    y, beside = np.concatenate((along[:12], along[1:])), np.repeat((-1.0, 1.0), 12)
    starts = np.concatenate((np.stack((x, across), axis=1), np.stack((beside, y), axis=1)))
    length = np.concatenate((np.tile((0.5, 0.0), (26, 1)), np.tile((0.0, 0.5), (24, 1))))
    return _tapes(starts, starts + length)


def lattice() -> LineMap:
    """Twenty-five lines each way, 12 m long and half a metre apart."""
    place = 0.5 * np.arange(25) - 6.0
    low, high = np.full(25, -6.0), np.full(25, 6.0)
    return _tapes(
        np.stack((np.concatenate((place, low)), np.concatenate((low, place))), axis=1),
        np.stack((np.concatenate((place, high)), np.concatenate((high, place))), axis=1))


def _tapes(starts: np.ndarray, ends: np.ndarray) -> LineMap:
    """Green tapes between points on the floor (N, 2), m."""
    return LineMap(tuple(
        Line(np.array([*start, 0.0]), np.array([*end, 0.0]), _WIDTH, 'green', f'line{k}')
        for k, (start, end) in enumerate(zip(starts, ends))))
