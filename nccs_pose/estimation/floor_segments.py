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

from nccs_pose.estimation.floor_points import fit_line, FloorPoints, principal_lines, squares
from nccs_pose.geometry.floor_table import FloorTable
from nccs_pose.geometry.pose import Array
from nccs_pose.vision.segment import Segmentation
import numpy as np
from numpy.typing import NDArray

# A line needs so many pixels and so much length, metres.
_LEAST_PIXELS = 10
# Of a large blob only some pixels are looked at; a few of them in a row are no line yet.
_LEAST_SAMPLES = 8
_LEAST_LENGTH = 0.2
# Pieces further apart than this are not joined, metres.
_LONGEST_GAP = 0.8
# So much longer than the longest tape they are several in a row, this far apart, metres.
_TOO_LONG = 1.1
_ROW_GAP = 0.12
# Something this close beside a strip, metres, makes it part of a larger thing.
_BESIDE = 0.15
# So much beside a strip, of what lies in it, is no crossing tape any more.
_MOST_BESIDE = 0.35
# A blob is a single line when no more than this part of it lies beside; of one that is, every
# so many-th pixel is enough.
_MISFIT = 0.15
_THINNED = 4
# Of a shorter one all pixels are taken; of one with fewer than so many pixels none.
_SHORT = 60
_LEAST_LINE = 3
# Of one that is not, lines are drawn through so many of its pixels and their neighbours within
# this distance (m, and footprints), and through as many pairs of its pixels; all such blobs have
# so many of these lines together, and so many pixels.
_SEEDS = 24
_NEIGHBOURS = (0.35, 4.0)
_MOST_SEEDS = 96
_MOST_PIXELS = 2000


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


def floor_segments(
    segmentation: Segmentation, table: FloorTable, width: float, colour: str, most: int = 16,
    longest: float = math.inf,
) -> tuple[FloorSegment, ...]:
    """Straight strips among the blobs, those of most pixels first.

    :param width: width of the tapes, metres.
    :param longest: length of the longest of them, metres.
    :param colour: their colour class.
    :param most: at most so many.
    """
    if len(segmentation.pixels) == 0:
        return ()
    points = FloorPoints.of(segmentation, table, width)
    normals, offsets, kept = _candidates(points, width)
    if len(normals) == 0:
        return ()
    points, pixels = points[kept], segmentation.pixels[kept]
    # What is left of a thinned blob stands for all of it.
    share = np.bincount(segmentation.label) / np.maximum(np.bincount(
        points.blob, minlength=int(segmentation.label[-1]) + 1), 1)
    points = replace(points, weight=points.weight * share[points.blob])
    near = points.near(normals, offsets, width)
    support = (points.weight.astype(np.float32) @ near).astype(float)
    free = np.ones(len(points.floor), dtype=bool)
    segments: list[FloorSegment] = []
    futile: set[bytes] = set()
    while len(segments) < most:
        best = int(support.argmax())
        if support[best] < _LEAST_PIXELS:
            break
        support[best] = -np.inf
        start = np.flatnonzero((near[:, best] > 0.0) & free)
        # Many lines through one small thing start from the very same points.
        if start.tobytes() in futile:
            continue
        found = _strip(points, free, start, width)
        if found is None:
            futile.add(start.tobytes())
            continue
        futile.clear()
        normal, offset, inside, beside = found
        if points.weight[beside].sum() < _MOST_BESIDE * points.weight[inside].sum():
            inside = _one_tape(points, inside, normal, longest)
            segments.append(
                _segment(points, segmentation, pixels, inside, normal, offset, colour))
            taken = inside
        else:
            # What is left of a solid must not pass for a thinner thing.
            taken = np.union1d(inside, beside[free[beside]])
        free[taken] = False
        support -= points.weight[taken].astype(np.float32) @ near[taken]
    segments.sort(key=lambda s: -s.weight)
    return tuple(segments)


def _candidates(
    points: FloorPoints, width: float,
) -> tuple[Array, Array, NDArray[np.intp]]:
    """Lines (C, 2), (C,) that may run through the blobs, and the points that are needed for them.

    Each blob's own line, and where that does not fit, those through some of its pixels.
    """
    first = np.flatnonzero(np.diff(points.blob, prepend=-1))
    size = np.diff(first, append=len(points.blob))
    number = np.repeat(np.arange(len(first)), size)
    own, own_offset = _blob_lines(points, first, number)
    normal = own[number]
    distance = np.einsum('pi,pi->p', points.floor, normal) - own_offset[number]
    off = points.beyond(normal, distance, width) > 0.0
    misfit = np.add.reduceat(off.astype(float), first) / size
    speck = size < _LEAST_LINE
    tangled = ~speck & (size >= _LEAST_PIXELS) & (misfit > _MISFIT)
    count = int(tangled.sum())
    step = 1 + int(size[tangled].sum()) // _MOST_PIXELS
    stride = np.where(tangled, step, np.where(size < _SHORT, 1, _THINNED))
    kept = ((np.arange(len(number)) - first[number]) % stride[number] == 0) & ~speck[number]
    rng = np.random.default_rng(0)
    seeds = max(1, min(_SEEDS, _MOST_SEEDS // max(1, count)))
    lines = [(own[~speck], own_offset[~speck])]
    for k in np.flatnonzero(tangled).tolist():
        part = points[first[k]:first[k] + size[k]:step]
        lines += [_through_neighbours(part, seeds), _through_pairs(part, rng, seeds)]
    normals, offsets = (np.concatenate(parts) for parts in zip(*lines))
    return normals, offsets, np.flatnonzero(kept)


def _blob_lines(
    points: FloorPoints, first: NDArray[np.intp], number: NDArray[np.intp],
) -> tuple[Array, Array]:
    """Each blob's own line: normals (B, 2) and offsets (B,).

    :param first: where each blob begins (B,).
    :param number: of each point's blob among them (P,).
    """
    weight = points.precision
    total = np.add.reduceat(weight, first)[:, None]
    mean = np.add.reduceat(weight[:, None] * points.floor, first) / total
    moved = points.floor - mean[number]
    second = np.add.reduceat(weight[:, None] * squares(moved), first)
    return principal_lines(mean, second)


def _through_neighbours(part: FloorPoints, seeds: int) -> tuple[Array, Array]:
    """Lines through some pixels of a blob and what surrounds each: right but for its corners."""
    seed = np.arange(0, len(part.floor), max(1, len(part.floor) // seeds))
    footprint = np.sqrt(0.5 * (part.spread[0, seed] + part.spread[2, seed]))
    reach = _NEIGHBOURS[0] + _NEIGHBOURS[1] * footprint
    x, y = part.floor.T
    near = np.square(x - x[seed, None]) + np.square(y - y[seed, None]) < np.square(reach)[:, None]
    near = near[near.sum(axis=1) >= _LEAST_LINE]
    weight = near * part.precision
    moved = part.floor - part.floor.mean(axis=0)
    sums = weight @ np.column_stack([np.ones(len(moved)), moved, squares(moved)])
    mean = sums[:, 1:3] / sums[:, :1]
    second = sums[:, 3:] - sums[:, :1] * squares(mean)
    return principal_lines(mean + part.floor.mean(axis=0), second)


def _through_pairs(
    part: FloorPoints, rng: np.random.Generator, seeds: int,
) -> tuple[Array, Array]:
    """Lines through random pairs of a blob's pixels."""
    pair = part.floor[rng.integers(0, len(part.floor), (seeds, 2))]
    along = pair[:, 1] - pair[:, 0]
    length = np.hypot(along[:, 0], along[:, 1])
    pair, along = pair[length > 0.1], along[length > 0.1] / length[length > 0.1, None]
    across = np.column_stack([-along[:, 1], along[:, 0]])
    return across, np.einsum('ni,ni->n', across, pair[:, 0])


def _strip(
    points: FloorPoints, free: NDArray[np.bool_], inside: NDArray[np.intp], width: float,
) -> tuple[Array, float, NDArray[np.intp], NDArray[np.intp]] | None:
    """Refine a strip on its own pixels.

    :param inside: points to start from.
    :returns: normal, offset, its points and those of its blobs that lie just beside it; None
        where too little is left.
    """
    for _ in range(2):
        normal, offset = fit_line(points.floor[inside], points.precision[inside])
        beyond = points.beyond(normal, points.floor @ normal - offset, width)
        direction = np.array([-normal[1], normal[0]])
        along = points.floor @ direction
        before = inside
        inside = _longest_run(
            points, along, np.flatnonzero(free & (beyond < 0.0)), _LONGEST_GAP)
        if len(inside) < _LEAST_SAMPLES or points.weight[inside].sum() < _LEAST_PIXELS:
            return None
        if np.array_equal(inside, before):
            break
    low, high = along[inside].min(), along[inside].max()
    if high - low < _LEAST_LENGTH:
        return None
    # Only what hangs together with the strip counts: another tape may well cross it.
    own = np.zeros(int(points.blob[-1]) + 1, dtype=bool)
    own[points.blob[inside]] = True
    beside = np.flatnonzero((beyond > 0.0) & (beyond < _BESIDE) & (along > low) & (along < high))
    return normal, offset, inside, beside[own[points.blob[beside]]]


def _one_tape(
    points: FloorPoints, inside: NDArray[np.intp], normal: Array, longest: float,
) -> NDArray[np.intp]:
    """Of a strip that is longer than any tape the heaviest part between two gaps."""
    along = points.floor @ np.array([-normal[1], normal[0]])
    if np.ptp(along[inside]) <= _TOO_LONG * longest:
        return inside
    return _longest_run(points, along, inside, _ROW_GAP)


def _longest_run(
    points: FloorPoints, along: Array, inside: NDArray[np.intp], longest_gap: float,
) -> NDArray[np.intp]:
    """Of a strip's points those of its heaviest part without a long gap.

    :param along: the strip's direction, of all points (P,), metres.
    """
    if len(inside) == 0:
        return inside
    order = inside[np.argsort(along[inside], kind='stable')]
    gaps = np.flatnonzero(np.diff(along[order]) > longest_gap) + 1
    if len(gaps) == 0:
        return inside
    bounds = np.concatenate([[0], gaps])
    heaviest = int(np.add.reduceat(points.weight[order], bounds).argmax())
    return np.sort(np.split(order, gaps)[heaviest])


def _segment(
    points: FloorPoints, segmentation: Segmentation, pixels: Array, inside: NDArray[np.intp],
    normal: Array, offset: float, colour: str,
) -> FloorSegment:
    direction = np.array([-normal[1], normal[0]])
    along = points.floor[inside] @ direction
    return FloorSegment(
        normal, offset, offset * normal + along.min() * direction,
        offset * normal + along.max() * direction, float(points.weight[inside].sum()),
        float(np.median(points.footprint(normal)[inside])), pixels[inside], colour,
        segmentation.pitch)
