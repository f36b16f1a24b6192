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
import math

from nccs_pose.geometry.floor_table import FloorTable
from nccs_pose.geometry.pose import Array
from nccs_pose.vision.segment import Segmentation
import numpy as np
from numpy.typing import NDArray

# Pixels may lie so much further from a tape's midline than half its width, in footprints.
_FOOTPRINT = 0.75
# Points looked at together.
_BLOCK = 256


@dataclass(frozen=True, eq=False)
class FloorPoints:
    """P floor points of line-coloured pixels, blob after blob.

    :ivar floor: (P, 2), metres.
    :ivar spread: the three elements of J J^T, J the point's derivative by the pixel (3, P).
    :ivar precision: weight in a fit (P,): far pixels cover much floor and say little.
    :ivar blob: of each (P,), ascending.
    :ivar weight: how many pixels each stands for (P,).
    """

    floor: Array
    spread: Array
    precision: Array
    blob: NDArray[np.intp]
    weight: Array

    @classmethod
    def of(cls, segmentation: Segmentation, table: FloorTable, width: float) -> FloorPoints:
        """Lay blobs on the floor, for tapes of a width in metres."""
        floor, jacobian = table.floor(segmentation.pixels)
        jacobian = jacobian * segmentation.pitch
        by_u, by_v = jacobian[:, :, 0], jacobian[:, :, 1]
        spread = np.stack([
            by_u[:, 0] ** 2 + by_v[:, 0] ** 2, by_u[:, 0] * by_u[:, 1] + by_v[:, 0] * by_v[:, 1],
            by_u[:, 1] ** 2 + by_v[:, 1] ** 2])
        precision = 1.0 / (spread[0] + spread[2] + 0.1 * width**2)
        return cls(floor, spread, precision, segmentation.label, segmentation.weight)

    def __getitem__(self, index: NDArray[np.intp] | slice) -> FloorPoints:
        return FloorPoints(
            self.floor[index], self.spread[:, index], self.precision[index], self.blob[index],
            self.weight[index])

    def footprint(self, normal: Array) -> Array:
        """How far each pixel reaches along a normal (2,), or each along its own (P, 2) (P,)."""
        x, y = normal[..., 0], normal[..., 1]
        # |J^T n|^2 = n^T (J J^T) n.
        form = np.array([x * x, 2.0 * x * y, y * y])
        square = form @ self.spread if normal.ndim == 1 else (form * self.spread).sum(axis=0)
        return np.sqrt(np.maximum(square, 0.0))

    def beyond(self, normal: Array, distance: Array, width: float) -> Array:
        """How far the points are from being a tape's (P,), metres; below 0 they may be.

        :param normal: of the tape's midline (2,), or one for each point (P, 2).
        :param distance: of each point from the midline (P,), of either sign.
        """
        return np.abs(distance) - _FOOTPRINT * self.footprint(normal) - _half(width)

    def near(self, normals: Array, offsets: Array, width: float) -> NDArray[np.float32]:
        """1 where a point may be one of a tape's along each of C lines (P, C), else 0."""
        x, y = normals.T.astype(np.float32)
        by_spread = np.float32(_FOOTPRINT**2) * np.stack([x * x, 2.0 * x * y, y * y])
        by_floor = np.stack([x, y, -offsets.astype(np.float32)])
        floor = np.column_stack([self.floor, np.ones(len(self.floor))]).astype(np.float32)
        spread = self.spread.T.astype(np.float32)
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


def _half(width: float) -> float:
    """How far from a tape's midline a point of its floor may be, metres."""
    return 0.5 * width + 0.005


def squares(points: Array) -> Array:
    """xx, xy and yy of points (N, 2) as (N, 3)."""
    x, y = points[:, 0], points[:, 1]
    return np.column_stack([x * x, x * y, y * y])


def principal_lines(mean: Array, second: Array) -> tuple[Array, Array]:
    """Total least squares lines: unit normals (K, 2) and offsets (K,).

    :param mean: centres of gravity (K, 2).
    :param second: xx, xy and yy about them (K, 3).
    """
    # Direction of the larger principal axis of a 2 x 2 covariance, in closed form.
    angle = 0.5 * np.arctan2(2.0 * second[:, 1], second[:, 0] - second[:, 2])
    normal = np.column_stack([-np.sin(angle), np.cos(angle)])
    return normal, np.einsum('ki,ki->k', normal, mean)


def fit_line(floor: Array, weight: Array) -> tuple[Array, float]:
    """Total least squares line through points (M, 2): unit normal (2,) and offset.

    One line in plain numbers: arrays of one are slow.
    """
    x, y = floor[:, 0], floor[:, 1]
    total = weight.sum()
    mean_x, mean_y = weight @ x / total, weight @ y / total
    x, y = x - mean_x, y - mean_y
    by_x = weight * x
    angle = 0.5 * math.atan2(2.0 * (by_x @ y), by_x @ x - (weight * y) @ y)
    normal = np.array([-math.sin(angle), math.cos(angle)])
    return normal, float(normal[0] * mean_x + normal[1] * mean_y)
