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

"""Blobs laid on the floor: a floor line is a straight band of known width there, or no line.

Through a curved mirror a line is a curve, but each of its pixels is one point of the floor, and
those lie on a straight strip as wide as the tape. That refuses what is no tape (plants, boxes,
signs), splits a blob over two crossing tapes, and joins a tape that something cut in pieces.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
import math

from nccs_pose.estimation.floor_points import (
    FloorLine,
    FloorPoints,
    half_strip,
    misplaced,
    PixelFloor,
    principal_lines,
)
from nccs_pose.geometry.pose import Array
from nccs_pose.vision.median import upper_median
from nccs_pose.vision.segment import Segmentation
import numpy as np
from numpy.typing import NDArray

# Of a colour so many strips are enough.
_MOST_STRIPS = 16
# A line needs so many pixels and so much length, metres.
_LEAST_PIXELS = 10
# Of a large blob only some pixels are looked at; a few of them in a row are no line yet.
_LEAST_SAMPLES = 8
# Fewer than this to start from hardly ever grow to so many.
_LEAST_START = 7
# Of two lines that start from so large a part of the same points one is enough to see whether
# they run on.
_ALIKE = 0.8
_LEAST_LENGTH = 0.2
# Pieces further apart than this are not joined, metres.
_LONGEST_GAP = 0.8
# So much longer than the longest tape they are several in a row, further apart than this, metres.
_TOO_LONG = 1.1
ROW_GAP = 0.12
# Where something is this close beside a strip, metres, it does not stand free. If more than this
# part of what lies in the strip is there, the strip is part of a larger thing, unless it stands
# free for so long as a line has to be.
_BESIDE = 0.05
_MOST_BESIDE = 0.35
# A blob is a single line when no more than this part of it lies beside; of one that is, every
# so many-th pixel is enough.
_MISFIT = 0.15
_THINNED = 4
# Of a shorter one all pixels are taken; of one with fewer than so many pixels none.
_SHORT = 60
_LEAST_LINE = 3
# Of one that is not, lines are drawn through so many of its pixels and their neighbours within
# this distance (m, and footprints) where these make a strip; all such blobs have so many of these
# lines together, and so many pixels.
_SEEDS = 96
_NEIGHBOURS = (0.1, 3.0)
_MOST_SEEDS = 288
_MOST_PIXELS = 2000
# The mean square distance from its middle is a third of the square of half of its width where a
# strip is full, and more at a corner.
_STRAIGHT = 0.5
# A strip lies on a line of the map no further off than this, metres, beyond so many footprints.
_ON = 0.06
_ON_FOOTPRINTS = 1.5


@dataclass(frozen=True, eq=False)
class FloorSegment:
    """A straight strip of the floor in base_link: normal . p = offset between two ends.

    :ivar normal: unit (2,).
    :ivar offset: metres.
    :ivar start: one end (2,), metres.
    :ivar end: the other end (2,), metres.
    :ivar weight: how many pixels it is made of.
    :ivar footprint: how far its pixels reach across it on the floor, metres (median).
    :ivar pixels: those pixels (M, 2), in the image.
    :ivar colour: colour class.
    :ivar pitch: side of its pixels, px of the image.
    """

    normal: Array
    offset: float
    start: Array
    end: Array
    weight: float
    footprint: float
    pixels: Array
    colour: str = 'green'
    pitch: int = 1

    @property
    def tolerance(self) -> float:
        """How far off a line of the map it may be and still lies on it, metres."""
        return _ON + _ON_FOOTPRINTS * self.footprint


def floor_segments(
    segmentation: Segmentation, floor: PixelFloor, width: float, colour: str,
    longest: float,
) -> tuple[FloorSegment, ...]:
    """At most 16 straight strips among the blobs, those of most pixels first.

    :param floor: behind the pixels of the blobs' mask.
    :param width: width of the tapes, metres.
    :param colour: their colour class.
    :param longest: length of the longest of them, metres.
    """
    if len(segmentation.pixels) == 0:
        return ()
    points = floor.points(segmentation, width)
    normals, offsets, kept = _candidates(points, width)
    if len(normals) == 0:
        return ()
    # What is left of a thinned blob stands for all of it.
    label = segmentation.label
    share = np.bincount(label) / np.maximum(np.bincount(label[kept], minlength=label[-1] + 1), 1)
    points = points[kept]
    points = replace(points, weight=points.weight * share[points.blob])
    starts = _Starts(points, normals, offsets, width)
    segments: list[FloorSegment] = []
    while len(segments) < _MOST_STRIPS:
        best = starts.heaviest()
        if best is None:
            break
        along_it = starts.free_along(best)
        strip = _strip(points, starts.free, along_it, width)
        if strip is None or strip.length < _LEAST_LENGTH:
            starts.drop_like(along_it, strip)
            continue
        beside = strip.beside(points)
        if _stands_free(points, strip, beside, width):
            taken = _one_tape(points, strip.along, strip.inside, longest)
            pixels = segmentation.pixels[kept[taken]]
            segments.append(_segment(points, strip, taken, pixels, colour))
        else:
            # What is left of a solid must not pass for a thinner thing.
            taken = np.union1d(strip.inside, beside[starts.free[beside]])
        starts.drop(best)
        starts.take(taken)
    segments.sort(key=lambda s: -s.weight)
    return tuple(segments)


class _Starts:
    """C lines that strips may start from, of which the best are tried and take their points away.

    :ivar free: which of the points no strip has taken (P,).
    """

    def __init__(
        self, points: FloorPoints, normals: Array, offsets: Array, width: float,
    ) -> None:
        self.free = np.ones(len(points.floor), dtype=bool)
        self._near = points.near(normals, offsets, width)
        # Of each point what it weighs, and one; and of each line what its free points do.
        self._counts = np.array([points.weight, self.free], np.float32)
        self._weight, self._number = (self._counts @ self._near).astype(float)

    def heaviest(self) -> int | None:
        """The line along which free points weigh most; None where they are too few."""
        self._weight[self._number < _LEAST_START] = -np.inf
        best = int(self._weight.argmax())
        return None if self._weight[best] < _LEAST_PIXELS else best

    def free_along(self, line: int) -> NDArray[np.intp]:
        """The free points along a line."""
        along, = ((self._near[:, line] > 0.0) & self.free).nonzero()
        return along

    def drop(self, line: int) -> None:
        """Try a line no more."""
        self._weight[line] = -np.inf

    def drop_like(self, start: NDArray[np.intp], strip: _Strip | None) -> None:
        """Try no more lines like one that does not run on.

        That is those that start from nearly the same points, or from points of a thing so short
        alone.

        :param start: the points along it.
        :param strip: what it came to; None if to nothing.
        """
        common = self._near[start].sum(axis=0)
        self._weight[common >= _ALIKE * np.maximum(self._number, len(start))] = -np.inf
        if strip is not None:
            self._weight[self._number == self._near[strip.inside].sum(axis=0)] = -np.inf

    def take(self, taken: NDArray[np.intp]) -> None:
        """Points that are free no more."""
        self.free[taken] = False
        weight, number = self._counts[:, taken] @ self._near[taken]
        self._weight -= weight
        self._number -= number


def _segment(
    points: FloorPoints, strip: _Strip, taken: NDArray[np.intp], pixels: Array, colour: str,
) -> FloorSegment:
    """What is told of a strip.

    :param taken: those of the points that are its own (Q,).
    :param pixels: theirs (Q, 2).
    """
    line, run = strip.line, strip.along[taken]
    return FloorSegment(
        line.normal, line.offset, line.at(run.min()), line.at(run.max()),
        float(points.weight[taken].sum()), upper_median(line.footprint(points.spread[taken])),
        pixels, colour, points.pitch)


def widest_gap(longest: float, ends: float) -> float:
    """Widest gap in a row of tapes that strips run over, with so much of them beyond it, metres.

    :param longest: length of the longest of the tapes, metres.
    :param ends: how much of a strip is on either side, metres.
    """
    return max(ROW_GAP, min(_LONGEST_GAP, _TOO_LONG * longest - 2.0 * ends))


def _candidates(
    points: FloorPoints, width: float,
) -> tuple[Array, Array, NDArray[np.intp]]:
    """Lines (C, 2), (C,) that may run through the blobs, and the points that are needed for them.

    Each blob's own line, and where that does not fit, those through some of its pixels.
    """
    begins = np.ones(len(points.blob), dtype=bool)
    begins[1:] = points.blob[1:] != points.blob[:-1]
    first = np.flatnonzero(begins)
    number = np.cumsum(begins) - 1
    size = np.bincount(number)
    own, own_offset, _ = principal_lines(np.add.reduceat(points.moments, first))
    off = misplaced(points, own, own_offset, number, width)
    misfit = np.add.reduceat(off.astype(float), first) / size
    speck = size < _LEAST_LINE
    tangled = ~speck & (size >= _LEAST_PIXELS) & (misfit > _MISFIT)
    count = int(np.count_nonzero(tangled))
    step = 1 + int(size[tangled].sum()) // _MOST_PIXELS
    stride = np.where(tangled, step, np.where(size < _SHORT, 1, _THINNED))
    kept = ((np.arange(len(number)) - first[number]) % stride[number] == 0) & ~speck[number]
    lines = [(own[~speck], own_offset[~speck])]
    seeds = max(1, min(_SEEDS, _MOST_SEEDS // max(count, 1)))
    for k in np.flatnonzero(tangled).tolist():
        lines.append(_through_neighbours(points[first[k]:first[k] + size[k]:step], seeds, width))
    normals, offsets = (np.concatenate(parts) for parts in zip(*lines))
    return normals, offsets, np.flatnonzero(kept)


def _through_neighbours(part: FloorPoints, seeds: int, width: float) -> tuple[Array, Array]:
    """Lines through some pixels of a blob and what surrounds each, but for where tapes meet."""
    seed = np.arange(0, len(part.floor), max(1, len(part.floor) // seeds))
    footprint = np.sqrt(0.5 * (part.spread[seed, 0] + part.spread[seed, 2]))
    reach = _NEIGHBOURS[0] + _NEIGHBOURS[1] * footprint
    x, y, _ = part.floor.T
    near = np.square(x - x[seed, None]) + np.square(y - y[seed, None]) < np.square(reach)[:, None]
    enough = near.sum(axis=1) >= _LEAST_LINE
    normals, offsets, square = principal_lines(near[enough] @ part.moments)
    strip = square < _STRAIGHT * np.square(half_strip(width, footprint[enough]))
    return normals[strip], offsets[strip]


@dataclass(frozen=True, eq=False)
class _Strip:
    """A strip of P points' own.

    :ivar along: how far along its line all points are (P,), metres.
    :ivar beyond: how far they are from being its own (P,), metres; below 0 they may be.
    :ivar inside: which are.
    :ivar low: where it begins along its line, metres.
    :ivar high: where it ends.
    """

    line: FloorLine
    along: Array
    beyond: Array
    inside: NDArray[np.intp]
    low: float
    high: float

    @property
    def length(self) -> float:
        """From end to end, metres."""
        return self.high - self.low

    def beside(self, points: FloorPoints) -> NDArray[np.intp]:
        """Points of its blobs that lie just beside it."""
        along, beyond = self.along, self.beyond
        beside, = ((beyond > 0.0) & (beyond < _BESIDE + points.apart)
                   & (along > self.low) & (along < self.high)).nonzero()
        if len(beside) == 0:
            return beside
        # Only what hangs together with the strip counts: another tape may well cross it.
        own = np.zeros(int(points.blob[-1]) + 1, dtype=bool)
        own[points.blob[self.inside]] = True
        return beside[own[points.blob[beside]]]


def _strip(
    points: FloorPoints, free: NDArray[np.bool_], inside: NDArray[np.intp], width: float,
) -> _Strip | None:
    """Refine a strip on its own pixels; None where too little is left.

    :param inside: points to start from.
    """
    for _ in range(2):
        line = FloorLine.through(points.moments.take(inside, axis=0).sum(axis=0))
        along, beyond = line.places(points, width)
        before = inside
        inside, = ((beyond < 0.0) & free).nonzero()
        if len(inside) >= _LEAST_SAMPLES:
            inside = _longest_run(points, along, inside, _LONGEST_GAP)
        if len(inside) < _LEAST_SAMPLES or points.weight[inside].sum() < _LEAST_PIXELS:
            return None
        if len(inside) == len(before) and bool((inside == before).all()):
            break
    run = along[inside]
    return _Strip(line, along, beyond, inside, float(run.min()), float(run.max()))


def _stands_free(
    points: FloorPoints, strip: _Strip, beside: NDArray[np.intp], width: float,
) -> bool:
    """Whether a strip has little beside it, or nothing for so long as a line has to be.

    Other tapes that cross it, however many, leave it free between them; a solid does not.

    :param beside: the points beside it.
    """
    along, inside = strip.along, strip.inside
    weight = points.weight[inside]
    if points.weight[beside].sum() <= _MOST_BESIDE * weight.sum():
        return True
    place, others = along[inside], np.sort(along[beside])
    after = np.searchsorted(others, place)
    nearest = np.minimum(
        np.abs(place - others.take(after, mode='clip')),
        np.abs(place - others.take(after - 1, mode='clip')))
    free = nearest > half_strip(width, points.apart[inside])
    return bool(weight[free].sum() * np.ptp(place) > _LEAST_LENGTH * weight.sum())


def _one_tape(
    points: FloorPoints, along: Array, inside: NDArray[np.intp], longest: float,
) -> NDArray[np.intp]:
    """Of a strip that is longer than any tape the heaviest part between two gaps."""
    if math.isinf(longest) or np.ptp(along[inside]) <= _TOO_LONG * longest:
        return inside
    return _longest_run(points, along, inside, ROW_GAP)


def _longest_run(
    points: FloorPoints, along: Array, inside: NDArray[np.intp], longest_gap: float,
) -> NDArray[np.intp]:
    """Of a strip's points those of its heaviest part without a long gap.

    :param along: the strip's direction, of all points (P,), metres.
    """
    order = inside[np.argsort(along[inside], kind='stable')]
    run = along[order]
    gaps, = (run[1:] - run[:-1] > longest_gap).nonzero()
    if len(gaps) == 0:
        return inside
    bounds = [0, *(gaps + 1).tolist(), len(order)]
    heaviest = int(np.add.reduceat(points.weight[order], bounds[:-1]).argmax())
    return np.sort(order[bounds[heaviest]:bounds[heaviest + 1]])
