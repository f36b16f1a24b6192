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

from dataclasses import dataclass, replace
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
# Weights of the four coefficients of a cubic spline about a point, for the value and two
# derivatives, as polynomials in its place t between the second and the third; 1 to t^3 by rows.
_BASIS = np.array([
    [1.0, 4.0, 1.0, 0.0], [-3.0, 0.0, 3.0, 0.0], [3.0, -6.0, 3.0, 0.0],
    [-1.0, 3.0, -3.0, 1.0]]) / 6.0
_BASES = np.hstack([
    _BASIS,
    np.vstack([_BASIS[1], 2.0 * _BASIS[2], 3.0 * _BASIS[3], np.zeros(4)]),
    np.vstack([2.0 * _BASIS[2], 6.0 * _BASIS[3], np.zeros((2, 4))])])


Complex = NDArray[np.complex128]


def _powers(t: Array) -> Array:
    """1 to t^3 (..., 4)."""
    powers = np.empty((*t.shape, 4))
    powers[..., 0] = 1.0
    powers[..., 1] = t
    powers[..., 2] = t * t
    powers[..., 3] = powers[..., 2] * t
    return powers


def as_complex(vectors: Array) -> Complex:
    """Vectors (N, 2) of a plane as complex numbers x + iy (N,)."""
    return np.ascontiguousarray(vectors).view(np.complex128)[:, 0]


def as_points(numbers: Complex) -> Array:
    """Complex numbers (N,) as vectors (N, 2) again."""
    return np.ascontiguousarray(numbers).view(np.float64).reshape(-1, 2)


@dataclass(frozen=True, eq=False)
class FloorExpansion:
    """Pixels of N ground points to second order in the points.

    Pixels u + iv and directions of the floor x + iy are complex numbers. Derivatives are kept in
    each point's own polar basis, away from the mirror's foot and round it.

    :ivar pixels: (N,).
    :ivar radius: of the points from the mirror's foot (N,), metres.
    :ivar outward: unit vector away from the mirror's foot (N,), in base_link.
    :ivar first: derivative of the pixels outward and round (2, N), px per metre.
    :ivar second: outward twice, mixed, and round twice (3, N), px per square metre.
    """

    pixels: Complex
    radius: Array
    outward: Complex
    first: Complex
    second: Complex

    def polar(self, direction: Complex) -> Complex:
        """Components, outward + i round, of directions of base_link (N,)."""
        return direction * self.outward.conj()

    def slope(self, polar: Complex) -> Complex:
        """First derivative of the pixels along directions in the polar basis (N,)."""
        return polar.real * self.first[0] + polar.imag * self.first[1]

    def curvature(self, polar: Complex) -> Complex:
        """Second derivative of the pixels along directions in the polar basis (N,)."""
        out, turned = polar.real, polar.imag
        return (out * out * self.second[0] + 2.0 * out * turned * self.second[1]
                + turned * turned * self.second[2])


class FloorTable:
    """Ground points (z = 0 of base_link) against pixels of one rig.

    :ivar rig: the rig that it was made for.
    :ivar reach: how far from the mirror's foot the table goes, metres.
    :ivar foot: of the mirror on the floor (2,), in base_link.
    :ivar height: of the mirror over the floor, metres.
    :ivar region: (height, width) uint8, 255 where a pixel sees the floor within reach.
    :raises GeometryError: if the rig sees no floor.
    """

    def __init__(self, rig: Rig, reach: float) -> None:
        self.rig = rig
        self.reach = reach
        self.foot = rig.T_base_mirror.translation[:2]
        self.height = float(rig.T_base_mirror.translation[2])
        if self.height <= 0.0:
            raise GeometryError(
                f'the mirror at height {self.height} m does not stand over a floor')
        self._last_angle = math.atan2(1.02 * reach, self.height)
        self._splines = self._forward()
        rows, self._columns = self._splines[0].shape
        self._last_row = rows - 2.0 - 1e-9
        self._knots = np.stack(self._splines, axis=-1).reshape(-1, 2)
        self._taps = (np.arange(-1, 3)[:, None] * self._columns + np.arange(-1, 3)).ravel()
        self._grid, self._grid_reaches = self._backward()
        self.region = self._region()
        # All that lies outside comes to lie on the frame round it.
        self._sees_floor = np.pad(self.region > 0, 1)
        self._beyond = np.array([rig.camera.width, rig.camera.height], dtype=float)

    def _forward(self) -> tuple[Array, Array]:
        """Spline coefficients of u and v over (angle from the nadir, azimuth)."""
        # Through the nadir the angle goes on negative, and the azimuth goes round: padding
        # keeps every point of use away from the grid's ends.
        angle = (np.arange(-_PADDING, _ANGLES + 1) / _ANGLES) * self._last_angle
        azimuth = (np.arange(-_PADDING, _AZIMUTHS + _PADDING) / _AZIMUTHS) * 2.0 * np.pi
        radius = self.height * np.tan(angle)
        points = np.zeros((len(angle), len(azimuth), 3))
        points[..., 0] = self.foot[0] + radius[:, None] * np.cos(azimuth)
        points[..., 1] = self.foot[1] + radius[:, None] * np.sin(azimuth)
        rig = self.rig
        # The rim is a matter of visibility, not of where a point would be seen.
        whole = replace(rig.mirror, rim_radius=None)
        m, visible = reflect_points(
            whole, rig.cop, rig.T_base_mirror.inverse().apply(points.reshape(-1, 3)))
        pixels, in_front = rig.camera.project((m - rig.cop) @ rig.R_mirror_camera)
        seen = (visible & in_front).reshape(points.shape[:2])
        self._mirror_points, falls = self._rays(points, m, seen)
        # Outward, past the foot, and as good as the same all round.
        self._outward = radius[_PADDING + 1:], np.einsum('rai,ai->r', falls[_PADDING + 1:], (
            np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1) / len(azimuth)))
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

    def _rays(
        self, points: Array, m: Array, seen: NDArray[np.bool_],
    ) -> tuple[tuple[Array, ...], Array]:
        """Where rays leave the mirror, and how far over the floor they go as they fall by a metre.

        Where none is seen stands that of the angle before.

        :param points: on the floor (angles, azimuths, 3), in base_link.
        :param m: their mirror points, in the mirror frame (angles x azimuths, 3).
        :param seen: which are seen (angles, azimuths).
        :returns: x, y and z (angles, azimuths) of the mirror points, in base_link; and the falls
            (angles, azimuths, 2).
        """
        mirror = self.rig.T_base_mirror.apply(m).reshape(points.shape)
        falls = (points[..., :2] - mirror[..., :2]) / np.maximum(mirror[..., 2:], 1e-6)
        for row in range(1, len(falls)):
            mirror[row, ~seen[row]] = mirror[row - 1, ~seen[row]]
            falls[row, ~seen[row]] = falls[row - 1, ~seen[row]]
        return tuple(np.ascontiguousarray(mirror[..., k]) for k in range(3)), falls

    def falls(self, radius: Array) -> Array:
        """How far outward over the floor a ray goes for each metre that it falls (N,).

        :param radius: where it meets the floor, from the mirror's foot (N,), metres.
        """
        return np.interp(radius, *self._outward)

    def met(self, points: Array, rise: Array) -> Array:
        """Where rays that see points over the floor meet it (N, 2), in base_link.

        :param points: (N, 2), metres.
        :param rise: how far they are over the floor, or under it (N,); small, metres.
        """
        offset = points - self.foot
        at = self._places(offset, np.sqrt(np.einsum('ni,ni->n', offset, offset)))
        x, y, z = (map_coordinates(component, at, order=1, mode='nearest')
                   for component in self._mirror_points)
        # The ray meets the floor a little further on, but comes from the same place.
        share = rise / np.maximum(z - rise, 0.5 * z)
        return np.stack([points[:, 0] + share * (points[:, 0] - x),
                         points[:, 1] + share * (points[:, 1] - y)], axis=1)

    def pixels(self, points: Array) -> Array:
        """Pixels (N, 2) of ground points (N, 2) in base_link, whether or not in the image."""
        offset = points - self.foot
        within, around = self._cells(offset, np.sqrt(np.einsum('ni,ni->n', offset, offset)))
        by_a, by_b = _powers(within) @ _BASIS
        by_row = by_a[:, None] @ around.reshape(-1, 4, 8)
        return (by_b[:, None] @ by_row.reshape(-1, 4, 2))[:, 0]

    def _cells(self, offset: Array, radius: Array) -> tuple[Array, Array]:
        """Places within the grid's cells (2, N) by angle and azimuth, and the cells' knots.

        :param offset: of floor points from the mirror's foot (N, 2), metres.
        :param radius: its length (N,).
        :returns: the places, 0 to 1, and the coefficients around them (N, 16, 2), by angles first.
        """
        at = self._places(offset, radius)
        cell = at.astype(np.intp)
        first = cell[0] * self._columns + cell[1]
        return at - cell, self._knots.take(first[:, None] + self._taps, axis=0)

    def _places(self, offset: Array, radius: Array) -> Array:
        """Places in the grid by angle and azimuth (2, N) of floor points; see :meth:`_cells`."""
        at = np.empty((2, len(offset)))
        np.multiply(np.arctan2(radius, self.height), _ANGLES / self._last_angle, out=at[0])
        np.multiply(np.arctan2(offset[:, 1], offset[:, 0]), _AZIMUTHS / (2.0 * np.pi), out=at[1])
        # The azimuth goes from -pi to pi, and the grid from 0.
        at[1] += _AZIMUTHS * (at[1] < 0.0)
        at += _PADDING
        np.minimum(at[0], self._last_row, out=at[0])
        return at

    def expand(self, points: Array) -> FloorExpansion:
        """Pixels of ground points (N, 2) in base_link with their first and second derivatives."""
        offset = points - self.foot
        square = np.einsum('ni,ni->n', offset, offset)
        radius = np.sqrt(square)
        # At the foot itself there is no direction outward; nothing is seen there but the robot.
        radius = np.maximum(radius, 1e-6)
        step_a, step_b = self._last_angle / _ANGLES, 2.0 * np.pi / _AZIMUTHS
        n = len(points)
        within, around = self._cells(offset, radius)
        basis_a, basis_b = (_powers(within) @ _BASES).reshape(2, n, 3, 4)
        by_a = (basis_a @ around.reshape(n, 4, 8)).view(np.complex128)
        # partial[j, i] is the j-th derivative by the azimuth and i-th by the angle, in knots.
        partial = np.ascontiguousarray(
            (by_a @ basis_b.transpose(0, 2, 1).astype(np.complex128)).transpose(2, 1, 0))
        p_a, p_b = partial[0, 1] / step_a, partial[1, 0] / step_b
        reach = square + self.height**2
        by_radius, inverse = self.height / reach, 1.0 / radius
        first = np.empty((2, n), np.complex128)
        np.multiply(p_a, by_radius, out=first[0])
        np.multiply(p_b, inverse, out=first[1])
        second = np.empty((3, n), np.complex128)
        second[0] = np.square(by_radius / step_a) * partial[0, 2] - (
            2.0 * by_radius * radius / reach) * p_a
        second[1] = (inverse * by_radius / (step_a * step_b)) * partial[1, 1] - inverse * first[1]
        second[2] = np.square(inverse / step_b) * partial[2, 0] + inverse * first[0]
        return FloorExpansion(
            partial[0, 0], radius, as_complex(offset) * inverse, first, second)

    def _backward(self) -> tuple[Array, NDArray[np.bool_]]:
        """Ground points on a coarse grid of pixels, and 1 where there is one."""
        camera = self.rig.camera
        columns = np.arange(0, camera.width + _STRIDE, _STRIDE)
        rows = np.arange(0, camera.height + _STRIDE, _STRIDE)
        u, v = np.meshgrid(columns, rows)
        rays = self.rig.back_project(np.stack([u.ravel(), v.ravel()], axis=1).astype(float))
        points, reaches = rays.floor_points()
        distance = np.linalg.norm(points - self.foot, axis=1)
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
        at = np.rint(np.minimum(np.maximum(pixels, -1.0), self._beyond)) + 1.0
        index = at[:, 0] + at[:, 1] * (self._beyond[0] + 2.0)
        # What is not a number becomes an index below all others, and is taken for the first.
        return self._sees_floor.take(index.astype(np.intp), mode='clip')

    def floor(self, pixels: Array) -> tuple[Array, Array]:
        """Ground points (N, 2) of pixels in :attr:`region`, and d(point)/d(u, v) (N, 2, 2).

        Bilinear in the coarse grid: good to about a tenth of a pixel's footprint.
        """
        at = np.maximum(pixels / _STRIDE, 0.0)
        rows, columns = self._grid.shape[:2]
        column = np.minimum(at[:, 0].astype(int), columns - 2)
        row = np.minimum(at[:, 1].astype(int), rows - 2)
        a = (at[:, 0] - column)[:, None]
        b = (at[:, 1] - row)[:, None]
        corner, grid = row * columns + column, self._grid.reshape(-1, 2)
        p00, p10, p01, p11 = (
            grid.take(corner + step, axis=0) for step in (0, 1, columns, columns + 1))
        # By u along both edges of the cell, and from one to the other.
        low, high = p10 - p00, p11 - p01
        start, rise = p00 + a * low, p01 - p00 + a * (high - low)
        by_u = (low + b * (high - low)) / _STRIDE
        return start + b * rise, np.stack([by_u, rise / _STRIDE], axis=2)
