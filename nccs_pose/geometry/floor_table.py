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
tables are made once per rig. The forward one is good to 0.003 px up to 5 m and 0.007 px up to 9 m
on images 1280 px wide, a tenth of that root mean square; the backward one serves where a pixel's
place on the floor need only be known roughly.
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
from scipy.ndimage import correlate1d, spline_filter

# The angle from the nadir varies almost linearly with the image radius, so a coarse grid in
# (angle, azimuth) with cubic splines is enough to make the table from.
_ANGLES = 64
_AZIMUTHS = 128
_PADDING = 8
_STRIDE = 8
# What is read are expansions at the knots of a square grid over the stereographic plane, where the
# floor is a disc and its image almost linear: so fine that the nearest knot's is good enough. So
# many knots to either side of the middle; from one to the next, right and up, and where the middle
# one is.
_CELLS = 112
_KNOTS_APART = np.array([1.0, 2.0 * _CELLS + 1.0])
_MIDDLE_KNOT = _CELLS * _KNOTS_APART.sum()
# What lies beyond the table is seen outside of any image, and goes on from there as it will.
_OUTSIDE = np.array([-1e6, 1.0, 0.0, 0.0, 0.0, 0.0])
# Where the nadir, and straight ahead, are in the grid.
_BEGIN = np.array([[_PADDING], [_PADDING + 0.5 * _AZIMUTHS]])
# Weights of the four coefficients of a cubic spline about a point as polynomials in its place t
# between the second and the third; 1 to t^3 by rows.
_BASIS = np.array([
    [1.0, 4.0, 1.0, 0.0], [-3.0, 0.0, 3.0, 0.0], [3.0, -6.0, 3.0, 0.0],
    [-1.0, 3.0, -3.0, 1.0]]) / 6.0
# The spline and its first two derivatives at a knot, by the coefficients about it.
_AT_KNOT = np.array([[1.0, 4.0, 1.0], [-3.0, 0.0, 3.0], [6.0, -12.0, 6.0]]) / 6.0


Complex = NDArray[np.complex128]


def _weights(at: Array, cell: NDArray[np.intp]) -> Array:
    """Weights of the four coefficients about places (2, N) after the knots before (4, 2, N)."""
    powers = np.empty((4, *at.shape))
    powers[0] = 1.0
    t = np.subtract(at, cell, out=powers[1])
    np.multiply(t, t, out=powers[2])
    np.multiply(powers[2], t, out=powers[3])
    return (_BASIS.T @ powers.reshape(4, -1)).reshape(powers.shape)


def _filtered(values: Complex) -> Complex:
    """Spline coefficients of values on a grid."""
    return np.asarray(spline_filter(values.real) + 1j * spline_filter(values.imag))


def as_complex(vectors: Array) -> Complex:
    """Vectors (N, 2) of a plane as complex numbers x + iy (N,)."""
    return np.ascontiguousarray(vectors).view(np.complex128)[:, 0]


def as_points(numbers: Complex) -> Array:
    """Complex numbers (N,) as vectors (N, 2) again."""
    return np.ascontiguousarray(numbers).view(np.float64).reshape(-1, 2)


@dataclass(frozen=True, eq=False)
class FloorExpansion:
    """Pixels of N ground points to second order in the points.

    Pixels u + iv and vectors of the floor x + iy, in base_link, are complex numbers. A point that
    goes by d is seen at p + P d + Q d* + (U d^2 + 2 V |d|^2 + W d*^2) / 2, d* the conjugate.

    :ivar terms: p, P, Q, U, V and W by rows (6, N); px, px per metre, px per square metre.
    :ivar offset: of the points from the mirror's foot (N,), metres.
    :ivar falls: how far outward over the floor a ray goes as it falls by a metre, in parts of the
        offset (N,).
    :ivar seen: whether the image shows the floor about there (N,), to a few px.
    """

    terms: Complex
    offset: Complex
    falls: Array
    seen: NDArray[np.bool_]

    @property
    def pixels(self) -> Complex:
        """Where the points themselves are seen (N,)."""
        return self.terms[0]


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
        self._foot = complex(*self.foot)
        self._knots_per_radian = np.array(
            [[_ANGLES / self._last_angle], [_AZIMUTHS / (2.0 * np.pi)]])
        spline = self._forward()
        rows, self._columns = spline.shape
        self._last_row = rows - 2.0 - 1e-9
        self._taps = (np.arange(-1, 3)[:, None] * self._columns + np.arange(-1, 3)).ravel()
        self._grid, self._grid_reaches = self._backward()
        self.region = self._region()
        # All that lies outside comes to lie on the frame round it.
        self._sees_floor = np.pad(self.region > 0, 1)
        self._beyond = np.array([rig.camera.width, rig.camera.height], dtype=float)
        # From one pixel to the next, right and down, and where the first one is.
        self._apart = np.array([1.0, rig.camera.width + 2.0])
        self._first = rig.camera.width + 3.0
        self._knots = self._expanded(self._expansions(spline).view(np.float64).reshape(-1, 12))

    def _forward(self) -> Complex:
        """Spline coefficients of the pixels over (angle from the nadir, azimuth from -pi)."""
        # Through the nadir the angle goes on negative, and the azimuth goes round: padding
        # keeps every point of use away from the grid's ends.
        angle = (np.arange(-_PADDING, _ANGLES + 1) / _ANGLES) * self._last_angle
        azimuth = (np.arange(-_PADDING, _AZIMUTHS + _PADDING) / _AZIMUTHS) * 2.0 * np.pi - np.pi
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
        mirror, falls = self._rays(points, m, seen)
        # As many rows as the pixels have after their padding.
        mirror = np.pad(mirror, ((0, _PADDING), (0, 0), (0, 0)), mode='edge')
        self._mirror_points = np.stack(
            [spline_filter(mirror[..., k]) for k in range(3)], axis=-1).reshape(-1, 3)
        # Outward, past the foot, and as good as the same all round.
        past = radius[_PADDING + 1:]
        outward = np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1) / len(azimuth)
        self._outward = past, np.einsum('rai,ai->r', falls[_PADDING + 1:], outward) / past
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
        return _filtered(padded[..., 0] + 1j * padded[..., 1])

    def _expansions(self, spline: Complex) -> Complex:
        """Spline coefficients of the terms of expansions (angles, azimuths, 6).

        :param spline: of the pixels (angles, azimuths).
        """
        rows, columns = spline.shape
        angle = ((np.arange(rows) - _PADDING) * (self._last_angle / _ANGLES))[:, None]
        azimuth = (np.arange(columns) - _PADDING) * (2.0 * np.pi / _AZIMUTHS) - np.pi
        by = (_ANGLES / self._last_angle, _AZIMUTHS / (2.0 * np.pi))

        def partial(i: int, j: int) -> Complex:
            """Derivative by the angle, so many times, and by the azimuth."""
            along = correlate1d(spline, _AT_KNOT[i] * by[0]**i, axis=0, mode='nearest')
            return np.asarray(
                correlate1d(along, _AT_KNOT[j] * by[1]**j, axis=1, mode='nearest'))

        # The angle's derivatives by the radius, and the radius' inverse, to the horizon and on.
        by_radius = np.cos(angle) ** 2 / self.height
        bend = -2.0 * np.sin(angle) * np.cos(angle) ** 3 / self.height**2
        angle[_PADDING] = np.nan
        inverse = 1.0 / (self.height * np.tan(angle))
        out, turned = by_radius * partial(1, 0), inverse * partial(0, 1)
        out_twice = by_radius**2 * partial(2, 0) + bend * partial(1, 0)
        mixed = inverse * (by_radius * partial(1, 1) - turned)
        turned_twice = inverse * (inverse * partial(0, 2) + out)
        outward = np.exp(-1j * azimuth)
        terms = np.stack([
            spline, 0.5 * (out - 1j * turned) * outward, 0.5 * (out + 1j * turned) / outward,
            0.25 * (out_twice - 2j * mixed - turned_twice) * outward**2,
            0.25 * (out_twice + turned_twice),
            0.25 * (out_twice + 2j * mixed - turned_twice) / outward**2])
        # At the mirror's foot there is no direction outward: what is about it says how it goes on.
        near, far = (terms[1:, _PADDING - k] + terms[1:, _PADDING + k] for k in (1, 2))
        terms[1:, _PADDING] = (4.0 * near - far) / 6.0
        for k in range(1, 6):
            terms[k] = _filtered(terms[k])
        return np.ascontiguousarray(terms.transpose(1, 2, 0))

    def _expanded(self, coefficients: Array) -> Complex:
        """What is known at the knots (M, 8).

        The terms there, the knot's offset from the mirror's foot, and the falls, with 1 for the
        imaginary part where the floor is seen.

        :param coefficients: of the terms over angle and azimuth (angles x azimuths, 12).
        """
        cells = np.arange(-_CELLS, _CELLS + 1.0) / _CELLS
        place: Complex = (cells + 1j * cells[:, None]).ravel()
        # Infinity is the unit circle; what lies on it or beyond is far enough.
        offset = place * (2.0 * self.height / np.maximum(1.0 - np.abs(place) ** 2, 1e-3))
        radius = np.abs(offset)
        knots = np.empty((len(place), 8), dtype=complex)
        knots[:, :6] = _OUTSIDE
        inside, = (self._places(offset, radius)[0] < self._last_row).nonzero()
        # Some at a time: sixteen coefficients for each fill the memory.
        for some in np.array_split(inside, len(cells)):
            knots[some, :6] = self._read(
                coefficients, offset[some], radius[some]).view(np.complex128)
        knots[:, 6] = offset
        knots[:, 7] = np.interp(radius, *self._outward) + 1j * self.sees_floor(
            as_points(knots[:, 0]))
        return knots

    def _rays(
        self, points: Array, m: Array, seen: NDArray[np.bool_],
    ) -> tuple[Array, Array]:
        """Where rays leave the mirror, and how far over the floor they go as they fall by a metre.

        Where none is seen stands that of the angle before.

        :param points: on the floor (angles, azimuths, 3), in base_link.
        :param m: their mirror points, in the mirror frame (angles x azimuths, 3).
        :param seen: which are seen (angles, azimuths).
        :returns: the mirror points in base_link (angles, azimuths, 3); and the falls
            (angles, azimuths, 2).
        """
        mirror = self.rig.T_base_mirror.apply(m).reshape(points.shape)
        falls = (points[..., :2] - mirror[..., :2]) / np.maximum(mirror[..., 2:], 1e-6)
        for row in range(1, len(falls)):
            mirror[row, ~seen[row]] = mirror[row - 1, ~seen[row]]
            falls[row, ~seen[row]] = falls[row - 1, ~seen[row]]
        return mirror, falls

    def met(self, points: Array, rise: Array) -> Array:
        """Where rays that see points over the floor meet it (N, 2), in base_link.

        :param points: (N, 2), metres.
        :param rise: how far they are over the floor, or under it (N,); small, metres.
        """
        offset = as_complex(points) - self._foot
        mirror = self._read(self._mirror_points, offset, np.abs(offset))
        # The ray meets the floor a little further on, but comes from the same place.
        z = mirror[:, 2]
        share = rise / np.maximum(z - rise, 0.5 * z)
        return points + share[:, None] * (points - mirror[:, :2])

    def pixels(self, points: Array) -> Array:
        """Pixels (N, 2) of ground points (N, 2) in base_link, whether or not in the image."""
        return as_points(self.expand(as_complex(points)).pixels)

    def expand(self, points: Complex) -> FloorExpansion:
        """Pixels of ground points x + iy (N,) in base_link, with their derivatives.

        From the nearest knot on, to second order.
        """
        offset = points - self._foot
        # In steps from knot to knot.
        place = offset * (_CELLS / (self.height + np.hypot(np.abs(offset), self.height)))
        nearest = np.rint(place).view(np.float64).reshape(-1, 2) @ _KNOTS_APART + _MIDDLE_KNOT
        knots = self._knots.take(nearest.astype(np.intp), axis=0, mode='clip')
        terms = np.ascontiguousarray(knots[:, :6].T)
        step = offset - knots[:, 6]
        back = step.conj()
        # Half of what the step adds to the first derivatives; the pixel goes by their mean.
        slopes, added = terms[1:3], 0.5 * (terms[3:5] * step + terms[4:6] * back)
        slopes += added
        terms[0] += slopes[0] * step + slopes[1] * back
        slopes += added
        return FloorExpansion(terms, offset, knots[:, 7].real, knots[:, 7].imag > 0.0)

    def _read(self, coefficients: Array, offset: Complex, radius: Array) -> Array:
        """Values (N, K) of splines at floor points.

        :param coefficients: by angle and azimuth, one knot after the other (M, K).
        :param offset: of the points from the mirror's foot (N,), metres.
        :param radius: its length (N,).
        """
        at = self._places(offset, radius)
        cell = at.astype(np.intp)
        first = cell[0] * self._columns + cell[1]
        by_one = _weights(at, cell)
        weights = (by_one[:, None, 0] * by_one[None, :, 1]).reshape(16, -1).T
        # No index is out of range; 'clip' only spares a check.
        around = coefficients.take(first[:, None] + self._taps, axis=0, mode='clip')
        return (weights[:, None] @ around)[:, 0]

    def _places(self, offset: Complex, radius: Array) -> Array:
        """Places in the grid by angle and azimuth (2, N) of floor points; see :meth:`_read`."""
        at = np.empty((2, len(offset)))
        np.arctan(radius / self.height, out=at[0])
        np.arctan2(offset.imag, offset.real, out=at[1])
        at *= self._knots_per_radian
        at += _BEGIN
        np.minimum(at[0], self._last_row, out=at[0])
        return at

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
        at = np.rint(np.minimum(np.maximum(pixels, -1.0), self._beyond)) @ self._apart
        # What is not a number becomes an index below all others, and is taken for the first.
        return self._sees_floor.take((at + self._first).astype(np.intp), mode='clip')

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
