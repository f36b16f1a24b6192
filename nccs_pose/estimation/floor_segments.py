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
from functools import cached_property
import itertools

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
# Something this close beside a strip, metres, makes it part of a larger thing.
_BESIDE = 0.15
# So much beside a strip, of what lies in it, is no crossing tape any more.
_MOST_BESIDE = 0.35
# A blob is a single line when no more than this part of it lies beside; of one that is, every
# so many-th pixel is enough.
_MISFIT = 0.15
_THINNED = 4
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
    """

    normal: Array
    offset: float
    start: Array
    end: Array
    weight: float
    footprint: float
    pixels: Array
    colour: str = 'green'


@dataclass(frozen=True, eq=False)
class _Points:
    """Floor points with their Jacobian by the pixel, blob and weight."""

    floor: Array
    jacobian: Array
    blob: NDArray[np.intp]
    weight: Array

    def __getitem__(self, index: NDArray[np.intp] | slice) -> _Points:
        return _Points(
            self.floor[index], self.jacobian[index], self.blob[index], self.weight[index])

    def tolerance(self, normal: Array, width: float) -> Array:
        """How far from a tape's midline its pixels may be (..., P), for normals (..., 2)."""
        # |J^T n|^2 = n^T (J J^T) n: one matrix product for all normals and points.
        square = np.stack(
            [normal[..., 0] ** 2, 2.0 * normal[..., 0] * normal[..., 1], normal[..., 1] ** 2],
            axis=-1)
        footprint = np.sqrt(np.maximum(square @ self.spread, 0.0))
        return 0.5 * width + 0.75 * footprint + 0.005

    @cached_property
    def spread(self) -> Array:
        """The three elements of the symmetric J J^T (3, P)."""
        by_u, by_v = self.jacobian[:, :, 0], self.jacobian[:, :, 1]
        return np.stack([
            by_u[:, 0] ** 2 + by_v[:, 0] ** 2, by_u[:, 0] * by_u[:, 1] + by_v[:, 0] * by_v[:, 1],
            by_u[:, 1] ** 2 + by_v[:, 1] ** 2])


def floor_segments(
    segmentation: Segmentation, table: FloorTable, width: float, colour: str, most: int = 16,
) -> tuple[FloorSegment, ...]:
    """Straight strips among the blobs, those of most pixels first.

    :param width: width of the tapes, metres.
    :param colour: their colour class.
    :param most: at most so many.
    """
    if len(segmentation.pixels) == 0:
        return ()
    floor, jacobian = table.floor(segmentation.pixels)
    points = _Points(floor, jacobian, segmentation.label, segmentation.weight)
    normals, offsets, kept = _candidates(points, width)
    points, floor, pixels = points[kept], floor[kept], segmentation.pixels[kept]
    # What is left of a thinned blob stands for all of it.
    share = np.bincount(segmentation.label) / np.maximum(np.bincount(points.blob), 1)
    points = replace(points, weight=points.weight * share[points.blob])
    free = np.ones(len(floor), dtype=bool)
    segments: list[FloorSegment] = []
    distance = np.abs(normals @ floor.T - offsets[:, None])
    near = distance < points.tolerance(normals, width)
    worth = near.astype(np.float32)
    alive = np.ones(len(normals), dtype=bool)
    while len(segments) < most and alive.any():
        support = np.where(alive, worth @ (points.weight * free).astype(np.float32), 0.0)
        best = int(support.argmax())
        alive[best] = False
        if support[best] < _LEAST_PIXELS:
            break
        found = _strip(points, free, near[best] & free, normals[best], width)
        if found is None:
            continue
        normal, offset, inside, beside = found
        if points.weight[beside].sum() < _MOST_BESIDE * points.weight[inside].sum():
            segments.append(_segment(
                points, pixels, inside, normal, offset, colour))
        else:
            # What is left of a solid must not pass for a thinner thing.
            free &= ~beside
        free &= ~inside
    segments.sort(key=lambda s: -s.weight)
    return tuple(segments)


def _candidates(
    points: _Points, width: float,
) -> tuple[Array, Array, NDArray[np.intp]]:
    """Lines (C, 2), (C,) that may run through the blobs, and the points that are needed for them.

    Each blob's own line, and where that does not fit, those through some of its pixels.
    """
    normals: list[Array] = []
    offsets: list[float] = []
    kept, tangled = [], []
    bounds = np.flatnonzero(np.diff(points.blob, prepend=-1, append=-1))
    for first, last in itertools.pairwise(bounds.tolist()):
        part = points[first:last]
        if last - first < 3:
            continue
        normal, offset = _fit(part.floor, _precision(part.jacobian, width))
        normals.append(normal)
        offsets.append(offset)
        misfit = np.abs(part.floor @ normal - offset) > part.tolerance(normal, width)
        if misfit.mean() <= _MISFIT or last - first < _LEAST_PIXELS:
            kept.append(np.arange(first, last, 1 if last - first < 60 else _THINNED))
        else:
            tangled.append((first, last))
    rng = np.random.default_rng(0)
    step = 1 + sum(last - first for first, last in tangled) // _MOST_PIXELS
    seeds = max(1, min(_SEEDS, _MOST_SEEDS // max(1, len(tangled))))
    for first, last in tangled:
        kept.append(np.arange(first, last, step))
        part = points[first:last:step]
        for normal, offset in (
                *_through_neighbours(part, width, seeds), *_through_pairs(part, rng, seeds)):
            normals.append(normal)
            offsets.append(offset)
    index = np.sort(np.concatenate(kept)) if kept else np.zeros(0, dtype=np.intp)
    return np.array(normals).reshape(-1, 2), np.array(offsets), index


def _through_neighbours(
    part: _Points, width: float, seeds: int,
) -> list[tuple[Array, float]]:
    """Lines through some pixels of a blob and what surrounds each: right but for its corners."""
    lines = []
    precision = _precision(part.jacobian, width)
    footprint = np.sqrt(0.5 * (part.spread[0] + part.spread[2]))
    for k in range(0, len(part.floor), max(1, len(part.floor) // seeds)):
        reach = _NEIGHBOURS[0] + _NEIGHBOURS[1] * footprint[k]
        offset = part.floor - part.floor[k]
        near = np.einsum('pi,pi->p', offset, offset) < reach**2
        if near.sum() >= 3:
            lines.append(_fit(part.floor[near], precision[near]))
    return lines


def _through_pairs(
    part: _Points, rng: np.random.Generator, seeds: int,
) -> list[tuple[Array, float]]:
    """Lines through random pairs of a blob's pixels."""
    pair = part.floor[rng.integers(0, len(part.floor), (seeds, 2))]
    along = pair[:, 1] - pair[:, 0]
    length = np.linalg.norm(along, axis=1)
    pair, along = pair[length > 0.1], along[length > 0.1] / length[length > 0.1, None]
    across = np.column_stack([-along[:, 1], along[:, 0]])
    return list(zip(across, np.einsum('ni,ni->n', across, pair[:, 0]).tolist()))


def _precision(jacobian: Array, width: float) -> Array:
    """Weight of floor points (P,): far pixels cover much floor and say little."""
    return 1.0 / (np.einsum('pij,pij->p', jacobian, jacobian) + 0.1 * width**2)


def _fit(floor: Array, weight: Array) -> tuple[Array, float]:
    """Total least squares line: unit normal (2,) and offset."""
    mean = weight @ floor / weight.sum()
    moved = floor - mean
    xx, yy = weight @ moved[:, 0] ** 2, weight @ moved[:, 1] ** 2
    xy = weight @ (moved[:, 0] * moved[:, 1])
    # Direction of the larger principal axis of a 2 x 2 covariance, in closed form.
    angle = 0.5 * np.arctan2(2.0 * xy, xx - yy)
    normal = np.array([-np.sin(angle), np.cos(angle)])
    return normal, float(normal @ mean)


def _strip(
    points: _Points, free: NDArray[np.bool_], inside: NDArray[np.bool_], normal: Array,
    width: float,
) -> tuple[Array, float, NDArray[np.bool_], NDArray[np.bool_]] | None:
    """Refine a strip on its own pixels.

    :returns: normal, offset, its pixels (P,) and those of its blobs that lie just beside it (P,);
        None where too little is left.
    """
    offset = 0.0
    for _ in range(2):
        normal, offset = _fit(
            points.floor[inside], _precision(points.jacobian[inside], width))
        across = np.abs(points.floor @ normal - offset)
        tolerance = points.tolerance(normal, width)
        inside = _longest_run(points, normal, free & (across < tolerance))
        if inside.sum() < _LEAST_SAMPLES or points.weight[inside].sum() < _LEAST_PIXELS:
            return None
    along = points.floor @ np.array([-normal[1], normal[0]])
    low, high = along[inside].min(), along[inside].max()
    if high - low < _LEAST_LENGTH:
        return None
    # Only what hangs together with the strip counts: another tape may well cross it.
    own = np.isin(points.blob, np.unique(points.blob[inside]))
    beside = (own & (across > tolerance) & (across < tolerance + _BESIDE)
              & (along > low) & (along < high))
    return normal, offset, inside, beside


def _longest_run(
    points: _Points, normal: Array, inside: NDArray[np.bool_],
) -> NDArray[np.bool_]:
    """Of a strip's pixels those of its heaviest part without a long gap (P,)."""
    index = np.flatnonzero(inside)
    if len(index) == 0:
        return inside
    along = points.floor[index] @ np.array([-normal[1], normal[0]])
    order = np.argsort(along, kind='stable')
    part = np.concatenate([[0], np.cumsum(np.diff(along[order]) > _LONGEST_GAP)])
    mass = np.bincount(part, weights=points.weight[index[order]])
    result = np.zeros_like(inside)
    result[index[order[part == mass.argmax()]]] = True
    return result


def _segment(
    points: _Points, pixels: Array, inside: NDArray[np.bool_], normal: Array, offset: float,
    colour: str,
) -> FloorSegment:
    direction = np.array([-normal[1], normal[0]])
    along = points.floor[inside] @ direction
    footprint = np.linalg.norm(points.jacobian[inside].transpose(0, 2, 1) @ normal, axis=1)
    return FloorSegment(
        normal, offset, offset * normal + along.min() * direction,
        offset * normal + along.max() * direction, float(points.weight[inside].sum()),
        float(np.median(footprint)), pixels[inside], colour)
