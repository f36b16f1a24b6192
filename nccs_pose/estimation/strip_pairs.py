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

from functools import cached_property
import math

from nccs_pose.estimation.floor_segments import FloorSegment
from nccs_pose.estimation.many_poses import Poses
from nccs_pose.geometry.floor_table import as_complex, Complex
from nccs_pose.geometry.lines import LineMap
from nccs_pose.geometry.pose import Array
import numpy as np
from numpy.typing import NDArray

# A map of many equal places gives no end of hypotheses: those of the heaviest strips are enough.
_ENOUGH = 1500
# So many and no fewer are laid at once.
_AT_ONCE = 500
# A strip with each of those that are heavier, and then the next; no image has more of them.
_BY_WEIGHT = np.tril_indices(128, -1)
# Two lines must differ by this angle to cross usefully, rad.
_CROSSING = 0.12
# To be matched they must agree with strips to the first of these angles or, where those are short
# and the image is coarse, to so many times what is unsure of their directions, if not by more than
# the last, rad.
_ANGLE_GATE = 0.07
_UNSURE = 3.0
_WIDEST_GATE = 0.25
# Strips may reach this much beyond a map line's ends, metres.
BEYOND = 0.2
# Of a strip that starts a hypothesis this part may have nothing to do with its line.
_JOINED = 0.2


class FloorLines:
    """The map's floor lines, their points complex numbers x + iy of the map.

    :ivar start: one end (L,), metres.
    :ivar direction: unit (L,), from there to the other end.
    :ivar length: metres (L,).
    :ivar colour: colour class of each.
    """

    def __init__(self, line_map: LineMap) -> None:
        self.start = as_complex(line_map.starts[:, :2])
        self.direction = as_complex(line_map.directions[:, :2])
        self.length = line_map.lengths
        self.colour = tuple(line.colour for line in line_map)

    @cached_property
    def crossings(self) -> tuple[NDArray[np.intp], NDArray[np.intp], Complex]:
        """Ordered pairs of lines that cross, and the second's direction in the first's frame."""
        turn = self.direction * self.direction.conj()[:, None]
        first, second = np.nonzero(np.abs(turn.imag) > math.sin(_CROSSING - _ANGLE_GATE))
        return first, second, turn[first, second]

    @cached_property
    def gaps(self) -> tuple[Array, Array]:
        """How near and how far apart points of the lines that cross may be (X,), metres.

        Of lines as long as strips may seem to be.
        """
        first, second, _ = self.crossings
        beyond = np.array([-BEYOND, BEYOND])
        ends = self.start[:, None] + self.direction[:, None] * (
            beyond + np.stack([np.zeros_like(self.length), self.length], axis=1))
        apart = np.abs(ends[first, :, None] - ends[second, None])
        # Where each one's ends are as seen along the other; those of lines that meet are on both
        # sides of each other.
        near, meet = apart.min(axis=(1, 2)), np.ones(len(first), dtype=bool)
        for one, other in ((first, second), (second, first)):
            seen = (ends[one] - ends[other, :1]) * self.direction[other, None].conj()
            off = np.hypot(
                seen.real - np.clip(seen.real, 0.0, self.length[other, None] + 2.0 * BEYOND),
                seen.imag)
            near = np.minimum(near, off.min(axis=1))
            meet &= seen.imag[:, 0] * seen.imag[:, 1] < 0.0
        return np.where(meet, 0.0, near), apart.max(axis=(1, 2))


class StripLines:
    """Strips in base_link, their points complex numbers x + iy.

    :ivar start: one end (S,), metres.
    :ivar direction: unit (S,), from there to the other end.
    :ivar length: metres (S,).
    :ivar middle: between both ends (S,), metres.
    :ivar unsure: how unsure the directions are (S,), rad: by a pixel of the image over the length.
    :ivar colour: colour class of each.
    """

    def __init__(self, segments: tuple[FloorSegment, ...]) -> None:
        start, end, left = np.array([(s.start, s.end, s.normal) for s in segments]).reshape(
            -1, 6).view(np.complex128).T
        self.start, self.length, self.direction = start, np.abs(end - start), -1j * left
        footprint, pitch = np.array([(s.footprint, s.pitch) for s in segments]).T
        self.unsure = footprint / (pitch * np.maximum(self.length, 1e-9))
        self.middle = 0.5 * (start + end)
        self.colour = tuple(s.colour for s in segments)

    def fits(self, lines: FloorLines) -> NDArray[np.bool_]:
        """Whether a strip can lie on a line (S, L), by its length and colour."""
        fits = self.length[:, None] * (1.0 - _JOINED) < lines.length + BEYOND
        if len(set(lines.colour)) > 1:
            fits &= np.array(self.colour)[:, None] == np.array(lines.colour)
        return fits


def poses_of_pairs(strips: StripLines, lines: FloorLines, most: int) -> Poses:
    """Poses that lay a pair of strips on a pair of map lines, those of the heaviest strips first.

    :param strips: the heaviest first.
    :param most: only so many pairs that cross are laid.
    """
    a, b, turn = lines.crossings
    count = len(strips.length)
    second, first = (side[:count * (count - 1) // 2] for side in _BY_WEIGHT)
    between = strips.direction[second] * strips.direction[first].conj()
    cross = np.flatnonzero(np.abs(between.imag) >= math.sin(_CROSSING))[:most]
    first, second, between = first[cross], second[cross], between[cross]
    gate = np.clip(
        _UNSURE * np.hypot(strips.unsure[first], strips.unsure[second]), _ANGLE_GATE, _WIDEST_GATE)
    match = np.abs((turn * between.conj()[:, None]).imag) < np.sin(gate)[:, None]
    fits = strips.fits(lines)
    match &= fits[first][:, a] & fits[second][:, b]
    apart = np.abs(strips.middle[second] - strips.middle[first])[:, None]
    near, far = lines.gaps
    match &= (apart > near) & (apart < far)
    pair, crossing = np.nonzero(match)
    if len(pair) == 0:
        return Poses.of(())
    found, laid = [], 0
    # Whole pairs of strips: any of them may be the one that is not what it seems.
    ends = np.flatnonzero(pair[1:] > pair[:-1]) + 1
    cuts = ends[ends // _AT_ONCE > np.append(0, ends[:-1]) // _AT_ONCE]
    for part in np.split(np.arange(len(pair)), cuts):
        one, other = first[pair[part]], second[pair[part]]
        found.append(_laid(strips, one, other, lines, a[crossing[part]], b[crossing[part]]))
        laid += len(found[-1])
        if laid > _ENOUGH:
            break
    return Poses(np.concatenate([poses.rotation for poses in found]),
                 np.concatenate([poses.place for poses in found]))


def _laid(
    strips: StripLines, first: NDArray[np.intp], second: NDArray[np.intp], lines: FloorLines,
    a: NDArray[np.intp], b: NDArray[np.intp],
) -> Poses:
    """Poses that put K strips' middles on lines a and b (K,), where the extents agree."""
    strip, line = np.array([first, second]), np.array([a, b])
    direction = lines.direction[line]
    by_first, by_second = direction * strips.direction[strip].conj()
    # Strips and lines go either way: half a turn between both does not count.
    rotation = by_first + np.copysign(1.0, (by_second * by_first.conj()).real) * by_second
    rotation /= np.abs(rotation)
    # Either way round (2, 1, K).
    rotation = np.array([rotation, -rotation])[:, None]
    # Each middle in its line's own frame, along + i across, but for the place (2, 2, K).
    middle = (rotation * strips.middle[strip] - lines.start[line]) * direction.conj()
    off = middle.imag / (direction[1] * direction[0].conj()).imag
    place = off[:, 1:] * direction[0] - off[:, :1] * direction[1]
    along = middle.real + (place * direction.conj()).real
    half = 0.5 * strips.length[strip]
    outside = (np.maximum(half - along, 0.0)
               + np.maximum(along + half - lines.length[line], 0.0))
    # Something in line with a tape may have been joined to it.
    good = (outside < BEYOND + 2.0 * _JOINED * half).all(axis=1)
    return Poses(rotation[:, 0][good], place[:, 0][good])
