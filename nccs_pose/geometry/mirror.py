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

"""The mirror: a quadric of revolution about z (the paper's eq. 1)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
import math

from nccs_pose.errors import GeometryError
from nccs_pose.geometry.pose import Array, checked_vector
import numpy as np
from numpy.typing import ArrayLike, NDArray

_CONE_TOLERANCE = 1e-12  # square metres, of the squared radius: a cone's is zero but for rounding


@dataclass(frozen=True)
class QuadricMirror:
    """Omega(x, y, z) = x^2 + y^2 + A z^2 + B z - C = 0, convex towards the camera at +z.

    The physical mirror is the sheet on which h = A z + B/2 > 0: the upper half of a sphere or
    spheroid, the whole paraboloid, the lower sheet of a hyperboloid; a rim may cut it shorter.

    :ivar A: no unit; 1 sphere, other positive spheroid, 0 paraboloid, negative hyperboloid.
    :ivar B: metres.
    :ivar C: square metres.
    :ivar rim_radius: radius of the mirror's rim in metres; None: no rim.
    :raises GeometryError: if the coefficients make no mirror that faces +z.
    """

    A: float
    B: float
    C: float
    rim_radius: float | None = None

    def __post_init__(self) -> None:
        for key in ('A', 'B', 'C'):
            if not math.isfinite(getattr(self, key)):
                raise GeometryError(f'mirror: {key} = {getattr(self, key)} is not finite')
        if self.A == 0.0 and self.B <= 0.0:
            raise GeometryError(
                f'mirror: A = 0 with B = {self.B} is no paraboloid convex towards +z (B > 0)')
        if self.A > 0.0 and self.squared_radius <= 0.0:
            raise GeometryError(
                f'mirror: A = {self.A}, B = {self.B}, C = {self.C} has no real surface')
        if self.A < 0.0 and self.squared_radius > _CONE_TOLERANCE:
            raise GeometryError(
                f'mirror: A = {self.A}, B = {self.B}, C = {self.C} is a hyperboloid of one '
                'sheet, which has no apex to look at')
        rim = self.rim_radius
        if rim is not None and not (math.isfinite(rim) and rim > 0.0):
            raise GeometryError(f'mirror: rim_radius = {rim} is not a positive length')
        if rim is not None and self.A > 0.0 and rim**2 > self.squared_radius * (1.0 + 1e-9):
            raise GeometryError(
                f'mirror: rim_radius = {rim} exceeds the largest radius '
                f'{self.largest_radius:.6g} of the surface')

    @property
    def centre_z(self) -> float:
        """The z of the surface's centre, -B / (2 A); a paraboloid has none."""
        return -self.B / (2.0 * self.A)

    @property
    def squared_radius(self) -> float:
        """C + B^2 / (4 A), the right side of x^2 + y^2 + A (z - centre)^2 = ..., square metres.

        At the equator of a sphere or spheroid it is the radius squared; 0 for a cone, negative for
        a hyperboloid of two sheets; C for a paraboloid.
        """
        return self.C + self.B**2 / (4.0 * self.A) if self.A != 0.0 else self.C

    @property
    def largest_radius(self) -> float:
        """The surface's radius at its equator; infinite where it has none."""
        return math.sqrt(self.squared_radius) if self.A > 0.0 else math.inf

    @property
    def kind(self) -> str:
        """The surface's name."""
        if self.A == 0.0:
            return 'paraboloid'
        if self.A > 0.0:
            return 'sphere' if self.A == 1.0 else 'spheroid'
        return 'cone' if abs(self.squared_radius) <= _CONE_TOLERANCE else 'hyperboloid'

    def _height_at(self, radius_squared: float) -> float:
        """The z of the physical sheet at a distance from the axis."""
        if self.A == 0.0:
            return (self.C - radius_squared) / self.B
        root = math.sqrt(max(0.0, (self.squared_radius - radius_squared) / self.A))
        return self.centre_z + math.copysign(root, self.A)

    @cached_property
    def apex_z(self) -> float:
        """The z of the mirror's highest point, on its axis."""
        return self._height_at(0.0)

    @cached_property
    def z_min(self) -> float:
        """The z of the rim; of the equator or minus infinity where there is none."""
        if self.rim_radius is not None:
            return self._height_at(self.rim_radius**2)
        return self.centre_z if self.A > 0.0 else -math.inf

    def level(self, points: Array) -> Array:
        """Omega at points (..., 3), square metres; negative inside a sphere."""
        x, y, z = np.moveaxis(np.asarray(points, dtype=float), -1, 0)
        return x * x + y * y + (self.A * z + self.B) * z - self.C

    def normal(self, points: Array) -> Array:
        """The normal n = (x, y, A z + B/2) at points (..., 3) (the paper's eq. 4), not unit.

        It is half of the gradient of Omega and points away from the mirror's body.
        """
        points = np.array(points, dtype=float)
        points[..., 2] = self.A * points[..., 2] + 0.5 * self.B
        return points

    def reflected(self, incident: Array, points: Array) -> Array:
        """Unit reflected rays v - 2 n (v.n)/(n.n) (the paper's eq. 9), (N, 3).

        :param incident: v (N, 3), of any length.
        :param points: where they meet the mirror (N, 3); rows that are no such points give
            finite rays without a meaning.
        """
        n = self.normal(points)
        square = np.einsum('ni,ni->n', n, n)
        along = np.einsum('ni,ni->n', incident, n) / np.where(square > 0.0, square, 1.0)
        rays = incident - 2.0 * along[:, None] * n
        return rays / np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)

    def contains(self, points: Array) -> NDArray[np.bool_]:
        """Whether surface points (..., 3) lie on the physical part."""
        z = np.asarray(points, dtype=float)[..., 2]
        slack = 1e-9 * max(1e-3, abs(self.apex_z))
        return (self.A * z + 0.5 * self.B > 0.0) & (z >= self.z_min - slack)

    def encloses(self, point: Array) -> bool:
        """Whether a point (3,) lies inside the mirror's body."""
        below = self.A >= 0.0 or self.A * float(point[2]) + 0.5 * self.B > 0.0
        return bool(self.level(point) <= 0.0) and below

    def checked_cop(self, cop: ArrayLike) -> Array:
        """Return a centre of projection (3,) that a camera before this mirror can have, a copy.

        :raises GeometryError: if it is not three finite numbers, off the plane x = 0, or inside
            the mirror.
        """
        cop = checked_vector('cop', cop)
        if cop[0] != 0.0:
            raise GeometryError(
                f'cop {cop.tolist()}: its x must be 0 (turn the mirror frame about its axis)')
        if self.encloses(cop):
            raise GeometryError(f'cop {cop.tolist()} lies inside the mirror')
        return cop

    def intersect(self, origin: Array, directions: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Where rays from one origin first meet the mirror from outside.

        Along o + t v, Omega is a t^2 + 2 b t + c; the root with n . v = a t + b < 0 is the one
        where the ray enters.

        :param origin: (3,), outside the mirror.
        :param directions: (N, 3).
        :returns: points (N, 3), zero where there is none, and whether each ray hits (N,).
        """
        v = np.asarray(directions, dtype=float)
        n_o = self.normal(origin)
        a = v[:, 0] ** 2 + v[:, 1] ** 2 + self.A * v[:, 2] ** 2
        b = v @ n_o
        c = float(self.level(origin))
        discriminant = b * b - a * c
        root = np.sqrt(np.maximum(discriminant, 0.0))
        # Two forms of the same root; each branch adds numbers of one sign.
        denominator = np.where(b <= 0.0, root - b, a)
        safe = np.abs(denominator) > 1e-300
        t = np.where(b <= 0.0, c, -(b + root)) / np.where(safe, denominator, 1.0)
        points = origin + t[:, None] * v
        hit = safe & (discriminant > 0.0) & (t > 0.0) & self.contains(points)
        return np.where(hit[:, None], points, 0.0), hit
