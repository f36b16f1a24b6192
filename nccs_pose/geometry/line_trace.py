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

"""The image of a line as an ordered polyline, for overlays and predicted regions."""

from __future__ import annotations

from nccs_pose.errors import GeometryError
from nccs_pose.geometry.lines import Line
from nccs_pose.geometry.pose import Array
from nccs_pose.geometry.rig import Rig
import numpy as np
from numpy.typing import NDArray

_FIRST_SAMPLES = 65  # a visible piece that lies between two of them is missed
_MOST_ROUNDS = 14  # of halving: an end is found to a 16 000th of the first samples' distance
_MOST_SAMPLES = 20_000  # with more the spacing is given up


def trace_line(rig: Rig, line: Line, spacing: float = 3.0) -> Array:
    """Pixels of the visible part of a line segment, in order from its start to its end.

    The physical branch of the reflection curve (:mod:`nccs_pose.geometry.reflection_curve`),
    cut to the segment and to the image. Where it leaves the image and comes back, the pieces
    follow each other; :func:`trace_pieces` keeps them apart.

    :param line: in base_link.
    :param spacing: largest distance between neighbours of one piece, pixels.
    :returns: pixels (N, 2); empty where nothing of it is seen.
    """
    return np.concatenate([np.zeros((0, 2)), *trace_pieces(rig, line, spacing)])


def trace_pieces(rig: Rig, line: Line, spacing: float = 3.0) -> tuple[Array, ...]:
    """As :func:`trace_line`, each connected piece an array (N, 2).

    :raises GeometryError: if the spacing is not positive.
    """
    if not spacing > 0.0:
        raise GeometryError(f'spacing {spacing} px of a traced line is not positive')
    along = _first_samples(rig, line)
    pixels, seen = _project(rig, line, along)
    for _ in range(_MOST_ROUNDS):
        gap = np.linalg.norm(np.diff(pixels, axis=0), axis=1)
        # between a seen and an unseen sample the end of the visible part is bisected
        split = np.where(seen[1:] & seen[:-1], gap > spacing, seen[1:] != seen[:-1])
        new = (0.5 * (along[1:] + along[:-1]))[split]
        if not len(new) or len(along) + len(new) > _MOST_SAMPLES:
            break
        new_pixels, new_seen = _project(rig, line, new)
        order = np.argsort(np.concatenate([along, new]), kind='stable')
        along = np.concatenate([along, new])[order]
        pixels = np.concatenate([pixels, new_pixels])[order]
        seen = np.concatenate([seen, new_seen])[order]
    ends = np.flatnonzero(np.diff(np.concatenate([[False], seen, [False]]).astype(np.int8)))
    return tuple(pixels[a:b] for a, b in zip(ends[::2], ends[1::2]))


def _first_samples(rig: Rig, line: Line) -> Array:
    """Distances (N,) along the segment, even in angle as seen from the mirror."""
    from_foot = (rig.T_base_mirror.translation - line.start) @ line.direction
    foot = line.start + from_foot * line.direction
    away = max(float(np.linalg.norm(rig.T_base_mirror.translation - foot)), 1e-3)
    angle = np.linspace(
        np.arctan2(-from_foot, away), np.arctan2(line.length - from_foot, away), _FIRST_SAMPLES)
    return np.clip(from_foot + away * np.tan(angle), 0.0, line.length)


def _project(rig: Rig, line: Line, along: Array) -> tuple[Array, NDArray[np.bool_]]:
    return rig.project(line.start + along[:, None] * line.direction)
