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

from nccs_pose.errors import GeometryError
from nccs_pose.geometry.pose import Array
from nccs_pose.geometry.projection import reflect_points
from nccs_pose.geometry.rig import Rig
import numpy as np
from numpy.typing import NDArray

# The forward table holds expansions at the knots of a square grid over the stereographic plane,
# where the floor is the unit disc and its image almost linear: so fine that the nearest knot's is
# good enough. So many knots to either side of the middle; from one to the next, right and up, and
# where the middle one is.
_CELLS = 112
_KNOTS_APART = np.array([1.0, 2.0 * _CELLS + 1.0])
_MIDDLE_KNOT = _CELLS * _KNOTS_APART.sum()
# What is known at a knot, column by column: the terms of its expansion (see FloorExpansion); its
# offset from the mirror's foot; its falls; and one over the height at which its ray leaves the
# mirror, with 1 for the imaginary part where the image shows the floor.
_TERMS = slice(0, 6)
_OFFSET, _FALLS, _INVERSE_HEIGHT = 6, 7, 8
# The derivatives at a knot come from the knots about it, twice; and the nearest to a point may lie
# a little beyond it.
_MARGIN = 3.0 / _CELLS
# What lies beyond the table is seen outside of any image, and goes on from there as it will.
_OUTSIDE = np.array([-1e6, 1.0, 0.0, 0.0, 0.0, 0.0])
# The backward table has a point for every so many pixels.
_STRIDE = 8

Complex = NDArray[np.complex128]


def as_complex(vectors: Array) -> Complex:
    """Vectors (N, 2) of a plane as complex numbers x + iy (N,)."""
    return np.ascontiguousarray(vectors).view(np.complex128)[:, 0]


def as_points(numbers: Complex) -> Array:
    """Complex numbers (N,), one after the other in memory, as vectors (N, 2) again."""
    return numbers.view(np.float64).reshape(-1, 2)


@dataclass(frozen=True, eq=False)
class FloorExpansion:
    """Pixels of N ground points to second order in the points.

    Pixels u + iv and vectors of the floor x + iy, in base_link, are complex numbers. A point that
    goes by d is seen at p + P d + Q d* + (U d^2 + 2 V |d|^2 + W d*^2) / 2, d* the conjugate.

    :ivar terms: p, P, Q, U, V and W by rows (6, N); px, px per metre, px per square metre.
    :ivar falls: how far over the floor their rays go as they fall by a metre (N,).
    """

    terms: Complex
    falls: Complex

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
        self._foot = complex(*self.foot)
        self._grid, self._grid_reaches = self._backward()
        cells = self._cells()
        self.region = self._region(cells)
        # All that lies outside comes to lie on the frame round it.
        self._sees_floor = np.pad(cells, 1)
        self._beyond = np.array(cells.shape[::-1]) + 1.0
        # From one cell to the next, right and down.
        self._apart = np.array([1.0, cells.shape[1] + 2.0])
        self._knots = self._forward()

    def _forward(self) -> Complex:
        """What is known at the knots (M, 9): see _TERMS and after."""
        cells = np.arange(-_CELLS, _CELLS + 1.0) / _CELLS
        place: Complex = cells + 1j * cells[:, None]
        inside = 1.0 - np.abs(place) ** 2
        ends = self.reach / self._stretch(np.array(self.reach**2)) + _MARGIN
        known = (np.abs(place) < ends) & (inside > 0.0)
        inside[~known] = np.nan
        # What is not known is not a number, nor are derivatives next to it.
        with np.errstate(invalid='ignore'):
            offset = 2.0 * self.height * place / inside
            pixel, mirror, height = self._exact(offset, known)
            # The offset's own derivatives by the place and by its conjugate.
            by_place = 2.0 * self.height / inside**2
            by_conjugate = by_place * place**2
            area = by_place**2 - np.abs(by_conjugate) ** 2

            def by_ground(value: Complex) -> tuple[Complex, Complex]:
                """Derivatives by the offset and by its conjugate."""
                up, right = np.gradient(value, 1.0 / _CELLS)
                a, b = 0.5 * (right - 1j * up), 0.5 * (right + 1j * up)
                return ((a * by_place - b * by_conjugate.conj()) / area,
                        (b * by_place - a * by_conjugate) / area)

            first, conjugate = by_ground(pixel)
            twice, mixed = by_ground(first)
            mixed_too, conjugate_twice = by_ground(conjugate)
        terms = np.stack([
            pixel, first, conjugate, twice, 0.5 * (mixed + mixed_too), conjugate_twice], axis=-1)
        unknown = np.isnan(terms).any(axis=-1)
        terms[unknown], mirror[unknown], height[unknown] = _OUTSIDE, 0.0, self.height
        offset[unknown] = 0.0
        seen = self.sees_floor(as_points(terms[..., 0].ravel())).reshape(unknown.shape)
        if not seen.any():
            raise GeometryError('the rig sees no floor within its reach')
        known_there = np.stack([offset, (offset - mirror) / height, 1.0 / height + 1j * seen], -1)
        return np.concatenate([terms, known_there], axis=-1).reshape(-1, 9)

    def _exact(self, offset: Complex, known: NDArray[np.bool_]) -> tuple[Complex, Complex, Array]:
        """How points of the floor are seen, NaN where they are not.

        :param offset: from the mirror's foot (...), metres.
        :param known: which of them count (...).
        :returns: pixels; and where their rays leave the mirror: over the floor, from its foot,
            and how high, metres.
        """
        points = np.zeros((np.count_nonzero(known), 3))
        points[:, :2] = as_points(offset[known] + self._foot)
        rig = self.rig
        # The rim is a matter of visibility, not of where a point would be seen.
        whole = replace(rig.mirror, rim_radius=None)
        m, visible = reflect_points(whole, rig.cop, rig.T_base_mirror.inverse().apply(points))
        pixels, in_front = rig.camera.project((m - rig.cop) @ rig.R_mirror_camera)
        m = rig.T_base_mirror.apply(m)
        m[~(visible & in_front)] = pixels[~(visible & in_front)] = np.nan
        pixel = np.full(offset.shape, np.nan, dtype=complex)
        mirror, height = pixel.copy(), np.full(offset.shape, np.nan)
        pixel[known], mirror[known] = as_complex(pixels), as_complex(m[:, :2]) - self._foot
        height[known] = m[:, 2]
        return pixel, mirror, height

    def met(self, points: Array, rise: Array) -> Array:
        """Where rays that see points over the floor meet it (N, 2), in base_link.

        :param points: (N, 2), metres.
        :param rise: how far they are over the floor, or under it (N,); small, metres.
        """
        at = as_complex(points)
        knots, step = self._nearest(at)
        inverse_height = knots[:, _INVERSE_HEIGHT].real
        # The ray meets the floor a little further on, but comes from the same place.
        share = rise / np.maximum(1.0 - rise * inverse_height, 0.5)
        return as_points(at + share * (knots[:, _FALLS] + inverse_height * step))

    def pixels(self, points: Array) -> Array:
        """Pixels (N, 2) of ground points (N, 2) in base_link, whether or not in the image."""
        return as_points(self.expand(as_complex(points)).pixels)

    def expand(self, points: Complex) -> FloorExpansion:
        """Pixels of ground points x + iy (N,) in base_link, with their derivatives.

        From the nearest knot on, to second order.
        """
        nearest, step = self._nearest(points)
        knots = np.ascontiguousarray(nearest.T)
        terms, pixels, back = knots[_TERMS], knots[0], step.conj()
        # Half of what the step adds to the first derivatives; the pixel goes by their mean.
        slopes, added = terms[1:3], 0.5 * (terms[3:5] * step + terms[4:6] * back)
        slopes += added
        pixels += slopes[0] * step + slopes[1] * back
        slopes += added
        return FloorExpansion(terms, knots[_FALLS] + knots[_INVERSE_HEIGHT].real * step)

    def outline(self, points: Complex) -> tuple[Complex, NDArray[np.bool_]]:
        """About where ground points x + iy (N,) in base_link are seen, and whether they are.

        :returns: pixels u + iv (N,) to first order, good to some tenths of one; and whether the
            image shows the floor about there (N,), to a few px.
        """
        knots, step = self._nearest(points)
        pixels = knots[:, 0] + knots[:, 1] * step + knots[:, 2] * step.conj()
        return pixels, np.asarray(knots[:, _INVERSE_HEIGHT].imag > 0.0)

    def _nearest(self, points: Complex) -> tuple[Complex, Complex]:
        """The nearest knots to points (N, 9), see :meth:`_forward`, and the way from them (N,)."""
        offset = points - self._foot
        square = np.square(offset.real) + np.square(offset.imag)
        place = as_points(offset * (_CELLS / self._stretch(square)))
        at = np.rint(place).dot(_KNOTS_APART) + _MIDDLE_KNOT
        knots = self._knots.take(at.astype(np.intp), axis=0, mode='clip')
        return knots, offset - knots[:, _OFFSET]

    def _stretch(self, square: Array) -> Array:
        """How many metres of the floor one of the stereographic plane is.

        Infinity comes to lie on its unit circle.

        :param square: of the distance from the foot, square metres.
        """
        return self.height + np.sqrt(square + self.height**2)

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

    def _cells(self) -> NDArray[np.bool_]:
        """Which cells of the coarse grid, of those wholly in the image, see the floor."""
        camera, reaches = self.rig.camera, self._grid_reaches
        cells = reaches[:-1, :-1] & reaches[1:, :-1] & reaches[:-1, 1:] & reaches[1:, 1:]
        return np.asarray(cells[:camera.height // _STRIDE, :camera.width // _STRIDE])

    def _region(self, cells: NDArray[np.bool_]) -> NDArray[np.uint8]:
        region = np.zeros((self.rig.camera.height, self.rig.camera.width), np.uint8)
        seen = np.kron(cells.astype(np.uint8), np.full((_STRIDE, _STRIDE), 255, np.uint8))
        region[:seen.shape[0], :seen.shape[1]] = seen
        return region

    def sees_floor(self, pixels: Array) -> NDArray[np.bool_]:
        """Whether pixels (N, 2) lie in the image where it shows the floor within reach (N,)."""
        # Of the nearest pixel, in cells after the frame's corner.
        at = pixels * (1.0 / _STRIDE) + (1.0 + 0.5 / _STRIDE)
        cell = np.floor(np.minimum(np.maximum(at, 0.0), self._beyond)).dot(self._apart)
        # What is not a number becomes an index far from all others, and is taken for a corner.
        return self._sees_floor.take(cell.astype(np.intp), mode='clip')

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
