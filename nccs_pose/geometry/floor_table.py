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

"""The floor seen through the mirror, tabulated: ground points to pixels and back, quickly.

The exact maps cost microseconds a point; tracking asks for thousands of points a frame. Both
tables are made once per rig. The forward one is good to a thousandth of a pixel; the
backward one serves where a pixel's place on the floor need only be known roughly.
"""

from __future__ import annotations

from dataclasses import replace
import math

from nccs_pose.errors import GeometryError
from nccs_pose.geometry.pose import Array
from nccs_pose.geometry.projection import reflect_points
from nccs_pose.geometry.rig import Rig
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates, spline_filter

# The angle from the nadir varies almost linearly with the image radius, so a coarse grid in
# (angle, azimuth) with cubic splines is enough.
_ANGLES = 64
_AZIMUTHS = 128
_PADDING = 8
_STRIDE = 8


class FloorTable:
    """Ground points (z = 0 of base_link) against pixels of one rig.

    :ivar rig: the rig that it was made for.
    :ivar reach: how far from the mirror's foot the table goes, metres.
    :ivar region: (height, width) uint8, 255 where a pixel sees the floor within reach.
    :raises GeometryError: if the rig sees no floor.
    """

    def __init__(self, rig: Rig, reach: float) -> None:
        self.rig = rig
        self.reach = reach
        self._centre = rig.T_base_mirror.translation[:2]
        self._height = float(rig.T_base_mirror.translation[2])
        if self._height <= 0.0:
            raise GeometryError(
                f'the mirror at height {self._height} m does not stand over a floor')
        self._last_angle = math.atan2(1.02 * reach, self._height)
        self._splines = self._forward()
        self._grid, self._grid_reaches = self._backward()
        self.region = self._region()

    def _forward(self) -> tuple[Array, Array]:
        """Spline coefficients of u and v over (angle from the nadir, azimuth)."""
        # Through the nadir the angle goes on negative, and the azimuth goes round: padding
        # keeps every point of use away from the grid's ends.
        angle = (np.arange(-_PADDING, _ANGLES + 1) / _ANGLES) * self._last_angle
        azimuth = (np.arange(-_PADDING, _AZIMUTHS + _PADDING) / _AZIMUTHS) * 2.0 * np.pi
        radius = self._height * np.tan(angle)
        points = np.zeros((len(angle), len(azimuth), 3))
        points[..., 0] = self._centre[0] + radius[:, None] * np.cos(azimuth)
        points[..., 1] = self._centre[1] + radius[:, None] * np.sin(azimuth)
        rig = self.rig
        # The rim is a matter of visibility, not of where a point would be seen.
        whole = replace(rig.mirror, rim_radius=None)
        m, visible = reflect_points(
            whole, rig.cop, rig.T_base_mirror.inverse().apply(points.reshape(-1, 3)))
        pixels, in_front = rig.camera.project((m - rig.cop) @ rig.R_mirror_camera)
        seen = (visible & in_front).reshape(points.shape[:2])
        if not seen[_PADDING].any():
            raise GeometryError('the rig sees no floor: its nadir is not in the mirror')
        pixels = pixels.reshape(*points.shape[:2], 2)
        for row in range(_PADDING + 1, len(angle)):
            blind = ~seen[row]
            # Beyond what the mirror shows, carry the last slope on; nothing is read there.
            pixels[row, blind] = 2.0 * pixels[row - 1, blind] - pixels[row - 2, blind]
        # Near the horizon a ground point runs to infinity, but its pixel goes on smoothly: the
        # cubic through the last rows pads the end, or the spline would ring there.
        rows = list(pixels)
        for _ in range(_PADDING):
            rows.append(4.0 * rows[-1] - 6.0 * rows[-2] + 4.0 * rows[-3] - rows[-4])
        padded = np.array(rows)
        return spline_filter(padded[..., 0]), spline_filter(padded[..., 1])

    def pixels(self, points: Array) -> Array:
        """Pixels (N, 2) of ground points (N, 2) in base_link, whether or not in the image."""
        offset = points - self._centre
        radius = np.hypot(offset[:, 0], offset[:, 1])
        angle = np.arctan2(radius, self._height)
        azimuth = np.arctan2(offset[:, 1], offset[:, 0]) % (2.0 * np.pi)
        at = np.stack([
            angle * (_ANGLES / self._last_angle) + _PADDING,
            azimuth * (_AZIMUTHS / (2.0 * np.pi)) + _PADDING])
        return np.stack(
            [map_coordinates(spline, at, order=3, mode='nearest', prefilter=False)
             for spline in self._splines], axis=1)

    def _backward(self) -> tuple[Array, Array]:
        """Ground points on a coarse grid of pixels, and 1 where there is one."""
        camera = self.rig.camera
        columns = np.arange(0, camera.width + _STRIDE, _STRIDE)
        rows = np.arange(0, camera.height + _STRIDE, _STRIDE)
        u, v = np.meshgrid(columns, rows)
        rays = self.rig.back_project(np.stack([u.ravel(), v.ravel()], axis=1).astype(float))
        points, reaches = rays.floor_points()
        distance = np.linalg.norm(points - self._centre, axis=1)
        reaches &= distance < self.reach
        points[~reaches] = 0.0
        shape = (len(rows), len(columns))
        return points.reshape(*shape, 2), reaches.reshape(shape)

    def _region(self) -> NDArray[np.uint8]:
        camera = self.rig.camera
        cell = (self._grid_reaches[:-1, :-1] & self._grid_reaches[1:, :-1]
                & self._grid_reaches[:-1, 1:] & self._grid_reaches[1:, 1:])
        full = np.kron(cell.astype(np.uint8), np.full((_STRIDE, _STRIDE), 255, np.uint8))
        return np.ascontiguousarray(full[:camera.height, :camera.width])

    def sees_floor(self, pixels: Array) -> NDArray[np.bool_]:
        """Whether pixels (N, 2) lie in the image where it shows the floor within reach (N,)."""
        height, width = self.region.shape
        column = np.rint(np.clip(pixels[:, 0], -1.0, width)).astype(int)
        row = np.rint(np.clip(pixels[:, 1], -1.0, height)).astype(int)
        inside = (column >= 0) & (row >= 0) & (column < width) & (row < height)
        return inside & (self.region[row * inside, column * inside] > 0)

    def floor(self, pixels: Array) -> tuple[Array, Array]:
        """Ground points (N, 2) of pixels in :attr:`region`, and d(point)/d(u, v) (N, 2, 2).

        Bilinear in the coarse grid: good to about a tenth of a pixel's footprint.
        """
        at = np.clip(pixels / _STRIDE, 0.0, None)
        column = np.minimum(at[:, 0].astype(int), self._grid.shape[1] - 2)
        row = np.minimum(at[:, 1].astype(int), self._grid.shape[0] - 2)
        a = (at[:, 0] - column)[:, None]
        b = (at[:, 1] - row)[:, None]
        p00, p10 = self._grid[row, column], self._grid[row, column + 1]
        p01, p11 = self._grid[row + 1, column], self._grid[row + 1, column + 1]
        points = (1 - b) * ((1 - a) * p00 + a * p10) + b * ((1 - a) * p01 + a * p11)
        by_u = ((1 - b) * (p10 - p00) + b * (p11 - p01)) / _STRIDE
        by_v = ((1 - a) * (p01 - p00) + a * (p11 - p10)) / _STRIDE
        return points, np.stack([by_u, by_v], axis=2)
