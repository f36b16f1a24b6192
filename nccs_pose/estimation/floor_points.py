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

"""Line-coloured pixels as points of the floor, and straight lines through them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
import math

from nccs_pose.geometry.floor_table import as_complex, Complex, FloorTable
from nccs_pose.geometry.pose import Array
from nccs_pose.vision.segment import Segmentation
import numpy as np
from numpy.typing import NDArray

# A pixel belongs to a strip if it is no further off than this part of its own footprint beyond
# the tape's half width.
_FOOTPRINT = 0.75
# A point of a tape may lie so much further from its midline than half its width, metres.
_SPARE = 0.005
# Where in a tape's width a point lies is as unsure as this part of the width's square; if spread
# evenly over it 1/12.
_SPREAD = 0.1
# Points are compared with lines in blocks of so many.
_BLOCK = 256


@dataclass(frozen=True, eq=False)
class FloorPoints:
    """P floor points of line-coloured pixels, blob after blob.

    :ivar floor: x, y and 1 of each (P, 3), metres.
    :ivar spread: xx, xy and yy of J J^T (P, 3), J the point's derivative by the pixel.
    :ivar precision: weight in a fit (P,): far pixels cover much floor and say little.
    :ivar blob: of each (P,), ascending.
    :ivar weight: how many pixels each stands for (P,).
    :ivar pitch: side of their pixels, px of the image.
    """

    floor: Array
    spread: Array
    precision: Array
    blob: NDArray[np.intp]
    weight: Array
    pitch: int

    def __getitem__(self, index: NDArray[np.intp] | slice) -> FloorPoints:
        return FloorPoints(
            self.floor[index], self.spread[index], self.precision[index], self.blob[index],
            self.weight[index], self.pitch)

    @cached_property
    def moments(self) -> Array:
        """1, x, y, xx, xy and yy of each point times its precision (P, 6)."""
        x, y = self.floor[:, 0], self.floor[:, 1]
        moments = np.empty((len(x), 6))
        moments[:, 0] = self.precision
        moments[:, 1] = self.precision * x
        moments[:, 2] = self.precision * y
        moments[:, 3] = moments[:, 1] * x
        moments[:, 4] = moments[:, 1] * y
        moments[:, 5] = moments[:, 2] * y
        return moments

    @cached_property
    def apart(self) -> Array:
        """How far points are from those next to them (P,), metres: some pixels are left out."""
        return np.sqrt(self.weight * (self.spread[:, 0] + self.spread[:, 2])) / self.pitch

    def near(self, normals: Array, offsets: Array, width: float) -> NDArray[np.float32]:
        """1 where a point may be one of a tape's along each of C lines (P, C), else 0."""
        x, y = normals.T.astype(np.float32)
        by_spread = np.float32(_FOOTPRINT**2) * np.stack([x * x, 2.0 * x * y, y * y])
        by_floor = np.stack([x, y, -offsets.astype(np.float32)])
        floor, spread = self.floor.astype(np.float32), self.spread.astype(np.float32)
        near = np.empty((len(floor), len(normals)), np.float32)
        # In blocks that stay in the processor's cache.
        for first in range(0, len(floor), _BLOCK):
            block = slice(first, first + _BLOCK)
            distance = np.abs(floor[block] @ by_floor)
            distance -= np.float32(_half(width))
            np.maximum(distance, 0.0, out=distance)
            np.square(distance, out=distance)
            np.less_equal(distance, spread[block] @ by_spread, out=near[block], casting='unsafe')
        return near


class PixelFloor:
    """The floor behind every pixel of a view of the image, laid out once."""

    def __init__(self, pixels: Array, pitch: int, table: FloorTable) -> None:
        """Lay out.

        :param pixels: of the view, row by row (M, 2), in the image.
        :param pitch: their side, px of the image.
        """
        points, jacobian = table.floor(pixels)
        spread = jacobian @ jacobian.transpose(0, 2, 1)
        spread *= pitch**2
        self._floor = np.column_stack([points, spread[:, 0], spread[:, 1, 1]])

    def at(self, place: NDArray[np.intp]) -> tuple[Complex, Array]:
        """The floor behind some pixels (P,): x + iy (P,), metres, and its spread (P, 3)."""
        found = self._floor.take(place, axis=0)
        return as_complex(found[:, :2]), found[:, 2:]

    def points(self, segmentation: Segmentation, width: float) -> FloorPoints:
        """What blobs of the view are on the floor, for tapes of a width in metres."""
        found = self._floor.take(segmentation.place, axis=0)
        floor = np.ones((len(found), 3))
        floor[:, :2] = found[:, :2]
        spread = found[:, 2:]
        precision = 1.0 / (spread[:, 0] + spread[:, 2] + _SPREAD * width**2)
        return FloorPoints(
            floor, spread, precision, segmentation.label, segmentation.weight, segmentation.pitch)


@dataclass(frozen=True)
class FloorLine:
    """A line on the floor: the points x, y with y cos(angle) - x sin(angle) = offset.

    :ivar angle: of its direction, radians.
    :ivar offset: to its left, metres.
    """

    angle: float
    offset: float

    @classmethod
    def through(cls, moments: Array) -> FloorLine:
        """The total least squares line of summed moments (6,); see :attr:`FloorPoints.moments`.

        One line in plain numbers: arrays of one are slow.
        """
        total, x, y, xx, xy, yy = moments.tolist()
        x, y = x / total, y / total
        angle = 0.5 * math.atan2(
            2.0 * (xy - total * x * y), xx - yy - total * (x * x - y * y))
        return cls(angle, y * math.cos(angle) - x * math.sin(angle))

    @property
    def normal(self) -> Array:
        """Unit (2,), to the left of the direction."""
        return np.array([-math.sin(self.angle), math.cos(self.angle)])

    def at(self, along: float) -> Array:
        """The point (2,) that is so far along it, metres."""
        c, s = math.cos(self.angle), math.sin(self.angle)
        return np.array([along * c - self.offset * s, along * s + self.offset * c])

    def footprint(self, spread: Array) -> Array:
        """How far pixels of spreads (N, 3) reach across it (N,), metres."""
        x, y = -math.sin(self.angle), math.cos(self.angle)
        # |J^T n|^2 = n^T (J J^T) n.
        return np.sqrt(spread @ np.array([x * x, 2.0 * x * y, y * y]))

    def places(self, points: FloorPoints, width: float) -> tuple[Array, Array]:
        """How far along the line points are (P,), and how far from being a tape's on it (P,).

        Below 0 they may be of it.
        """
        c, s = math.cos(self.angle), math.sin(self.angle)
        along, off = np.array([[c, s, 0.0], [-s, c, -self.offset]]) @ points.floor.T
        return along, np.abs(off) - half_strip(width, self.footprint(points.spread))


def misplaced(
    points: FloorPoints, normals: Array, offsets: Array, of: NDArray[np.intp], width: float,
) -> Array:
    """Whether each point is none of a tape's on a line of its own (P,).

    :param normals: of lines (K, 2).
    :param offsets: likewise (K,), metres.
    :param of: the line of each point (P,).
    """
    own = normals.take(of, axis=0)
    off = np.einsum('pi,pi->p', points.floor[:, :2], own) - offsets.take(of)
    return np.abs(off) > half_strip(width, footprints(points.spread, own))


def footprints(spread: Array, normals: Array) -> Array:
    """How far pixels of spreads (P, 3) reach along normals of their own (P, 2), metres (P,)."""
    (x, y), (xx, xy, yy) = normals.T, spread.T
    return np.sqrt(xx * (x * x) + 2.0 * xy * (x * y) + yy * (y * y))


def half_strip(width: float, footprint: Array) -> Array:
    """How far from a tape's midline pixels of footprints (N,) across it may be, metres (N,)."""
    return _FOOTPRINT * footprint + _half(width)


def _half(width: float) -> float:
    """How far from a tape's midline a point of its floor may be, metres."""
    return 0.5 * width + _SPARE


def principal_lines(moments: Array) -> tuple[Array, Array, Array]:
    """Total least squares lines.

    :param moments: summed over each one's points (K, 6); see :attr:`FloorPoints.moments`.
    :returns: unit normals (K, 2), offsets (K,) and the points' mean square distances (K,), m^2.
    """
    total, x, y, xx, xy, yy = moments.T
    x, y = x / total, y / total
    xx, xy, yy = xx - total * (x * x), xy - total * (x * y), yy - total * (y * y)
    # Direction of the larger principal axis of a 2 x 2 covariance, in closed form.
    angle = 0.5 * np.arctan2(2.0 * xy, xx - yy)
    normal = np.array([-np.sin(angle), np.cos(angle)])
    minor = 0.5 * (xx + yy - np.hypot(2.0 * xy, xx - yy)) / total
    return normal.T, normal[0] * x + normal[1] * y, minor
