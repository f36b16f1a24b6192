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

"""Poses from pairs of strips of floor laid on pairs of the map's lines."""

from __future__ import annotations

from dataclasses import dataclass
import math

from nccs_pose.estimation.floor_segments import FloorSegment
from nccs_pose.geometry.lines import LineMap
from nccs_pose.geometry.pose import Array
import numpy as np
from numpy.typing import NDArray

# A map of many equal places gives no end of hypotheses: those of the heaviest strips are enough.
_ENOUGH = 1500
# Two lines must differ by this angle to cross usefully, and agree to it to be matched, rad.
_CROSSING = 0.12
_ANGLE_GATE = 0.07
# Strips may reach this much beyond a map line's ends, metres.
BEYOND = 0.2
# Of a strip that starts a hypothesis this part may have nothing to do with its line.
_JOINED = 0.2


@dataclass(frozen=True, eq=False)
class FloorLines:
    """The map's floor lines of one image's colours, as 2-D lines n . p = c."""

    start: Array
    direction: Array
    normal: Array
    offset: Array
    length: Array
    colour: tuple[str, ...]

    @classmethod
    def of(cls, line_map: LineMap) -> FloorLines:
        start, direction = line_map.starts[:, :2], line_map.directions[:, :2]
        normal = np.column_stack([-direction[:, 1], direction[:, 0]])
        return cls(
            start, direction, normal, np.einsum('li,li->l', normal, start), line_map.lengths,
            tuple(line.colour for line in line_map))


def poses_of_pairs(segments: tuple[FloorSegment, ...], lines: FloorLines) -> Array:
    """Poses (H, 3) that lay a pair of strips on a pair of map lines."""
    if len(segments) < 2:
        return np.zeros((0, 3))
    map_angle = np.arctan2(lines.direction[:, 1], lines.direction[:, 0])
    angle = np.array([math.atan2(-s.normal[0], s.normal[1]) for s in segments])
    alike = np.array([[s.colour == colour for colour in lines.colour] for s in segments])
    first, second = np.triu_indices(len(segments), 1)
    between = angle[first] - angle[second]
    crossing = np.abs(np.sin(between)) >= math.sin(_CROSSING)
    first, second, between = first[crossing], second[crossing], between[crossing]
    off = np.subtract.outer(map_angle, map_angle) - between[:, None, None]
    match = (np.abs(np.sin(off)) < math.sin(_ANGLE_GATE)) & ~np.eye(len(map_angle), dtype=bool)
    match &= alike[first][:, :, None] & alike[second][:, None, :]
    pair, a, b = np.nonzero(match)
    first, second = first[pair], second[pair]
    yaw = map_angle[a] - angle[first] + 0.25 * np.sin(2.0 * (
        map_angle[b] - map_angle[a] + angle[first] - angle[second]))
    strips = _Strips(np.array([s.start for s in segments]), np.array([s.end for s in segments]))
    poses: list[Array] = []
    for begin in range(0, len(pair), _ENOUGH // 2):
        part = slice(begin, begin + _ENOUGH // 2)
        # Either way round.
        turned = np.concatenate([yaw[part], yaw[part] + np.pi])
        one, other, on_a, on_b = (np.tile(index[part], 2) for index in (first, second, a, b))
        poses.append(_intersect(turned, strips[one], strips[other], on_a, on_b, lines))
        if sum(map(len, poses)) > _ENOUGH:
            break
    return np.concatenate(poses) if poses else np.zeros((0, 3))


@dataclass(frozen=True, eq=False)
class _Strips:
    """Ends of strips in base_link, (S, 2) each."""

    start: Array
    end: Array

    def __getitem__(self, index: NDArray[np.intp]) -> _Strips:
        return _Strips(self.start[index], self.end[index])


def _intersect(
    yaw: Array, first: _Strips, second: _Strips, a: NDArray[np.intp], b: NDArray[np.intp],
    lines: FloorLines,
) -> Array:
    """Poses (K, 3) that put K strips' middles on lines a and b (K,), where the extents agree."""
    c, s = np.cos(yaw)[:, None], np.sin(yaw)[:, None]

    def turned(points: Array) -> Array:
        return np.hstack([c * points[:, :1] - s * points[:, 1:],
                          s * points[:, :1] + c * points[:, 1:]])

    ends = [(turned(strip.start), turned(strip.end)) for strip in (first, second)]
    n_a, n_b = lines.normal[a], lines.normal[b]
    right_a, right_b = (
        lines.offset[line] - 0.5 * np.einsum('ki,ki->k', lines.normal[line], start + end)
        for line, (start, end) in zip((a, b), ends))
    det = n_a[:, 0] * n_b[:, 1] - n_a[:, 1] * n_b[:, 0]
    t = np.column_stack([n_b[:, 1] * right_a - n_a[:, 1] * right_b,
                         n_a[:, 0] * right_b - n_b[:, 0] * right_a]) / det[:, None]
    fits = np.ones(len(yaw), dtype=bool)
    for (start, end), line in zip(ends, (a, b)):
        origin, direction = t - lines.start[line], lines.direction[line]
        one, other = (np.einsum('ki,ki->k', direction, at + origin) for at in (start, end))
        outside = (np.maximum(-np.minimum(one, other), 0.0)
                   + np.maximum(np.maximum(one, other) - lines.length[line], 0.0))
        # Something in line with a tape may have been joined to it.
        fits &= outside < BEYOND + _JOINED * np.hypot(*(end - start).T)
    return np.column_stack([t, yaw])[fits]
