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

"""The reflection curve of a line in closed form, and the branches of gamma's zeros.

With the mirror polynomials E, N, L, W, v_y, v_z (:mod:`nccs_pose.geometry.paper_polynomials`), the
line q + lambda d and its moment mu = q x d,

    P = -(v_y mu_y + v_z mu_z) + d_x (v_y z - v_z y)
    Q = N (mu_x - o_y d_z + o_z d_y) - 2 L (mu_x + d_y (z - h))
    c11 = E P,   c10 = E Q,   x = P / Q,   gamma = E^2 (P^2 + W Q^2)

and on the mirror, where x^2 = -W, gamma = E^2 S(x, y, z) S(-x, y, z) with S = P - x Q, the Plücker
side operator of reflected ray and line. So gamma vanishes on more than the line's image, and the
paper's "if and only if" (after its eq. 14) does not hold: see :class:`Branch`.

Its ray is the polynomial v_r, N |v_i| long, and its sign is that of the polynomials. The S of a
unit ray, the estimator's (:mod:`nccs_pose.estimation.residual`), differs: P - x Q = -N |v_i| S.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property

from nccs_pose.errors import GeometryError
from nccs_pose.geometry.lines import Line
from nccs_pose.geometry.mirror import QuadricMirror
from nccs_pose.geometry.paper_polynomials import mirror_polynomials, MirrorPolynomials
from nccs_pose.geometry.point_polynomial import companion_roots
from nccs_pose.geometry.pose import Array, checked_vector
from nccs_pose.geometry.rig import Rig
import numpy as np
from numpy.typing import ArrayLike, NDArray

# A root is real if its imaginary part is no larger than rounding leaves it where two roots meet;
# in units of the mirror's half width.
_REAL_ROOT = 1e-6
# Below this a sine, or the slope of E by y, is rounding: ray and line are parallel, E is constant.
_FLAT = 1e-12
# Below this share of the largest a leading coefficient is rounding: its root lies at infinity.
_NO_LEADING = 1e-14
# A point is on a branch if it is no further off, metres: between ray and line for S, on the mirror
# for E.
_ON_BRANCH = 1e-6


class Branch(IntEnum):
    """What a mirror point's gamma says of a line."""

    OFF = 0
    """gamma is not zero."""
    PHYSICAL = 1
    """S = 0 and the reflected ray meets the line ahead: the line's image."""
    VIRTUAL = 2
    """S = 0, but the line meets the reflected ray's backward extension."""
    MIRRORED = 3
    """S(-x, y, z) = 0: the image of the line mirrored in the plane x = 0."""
    SPURIOUS = 4
    """E = 0: a conic that every line has, whatever it is."""


@dataclass(frozen=True, eq=False)
class ReflectionCurve:
    """The curve of the mirror points in which a camera sees a line.

    :ivar mirror: the quadric.
    :ivar cop: o = (0, o_y, o_z) (3,) in the mirror frame, metres.
    :ivar point: q (3,), a point of the line in the mirror frame, metres.
    :ivar direction: d (3,), unit.
    :raises GeometryError: if a vector is not finite, d is zero, or the centre of projection is off
        the plane x = 0 or inside the mirror.
    """

    mirror: QuadricMirror
    cop: Array
    point: Array
    direction: Array

    def __post_init__(self) -> None:
        object.__setattr__(self, 'cop', self.mirror.checked_cop(self.cop))
        object.__setattr__(self, 'point', checked_vector('point', self.point))
        direction = checked_vector('direction', self.direction)
        length = np.linalg.norm(direction)
        if length == 0.0:
            raise GeometryError('the line has the direction d = 0')
        object.__setattr__(self, 'direction', direction / length)

    @classmethod
    def of_line(cls, rig: Rig, line: Line) -> ReflectionCurve:
        """The curve of a line in base_link on a rig's mirror."""
        in_mirror = line.transformed(rig.T_base_mirror.inverse())
        return cls(rig.mirror, rig.cop, in_mirror.start, in_mirror.direction)

    @cached_property
    def _base(self) -> MirrorPolynomials:
        return mirror_polynomials(self.mirror, self.cop)

    def factors(self, y: ArrayLike, z: ArrayLike) -> tuple[Array, Array, Array, Array]:
        """E, P, Q and W at (y, z) of one shape."""
        y, z = np.asarray(y, dtype=float), np.asarray(z, dtype=float)
        (o_y, o_z), (d_x, d_y, d_z) = self.cop[1:], self.direction
        mu = np.cross(self.point, self.direction)
        base = self._base
        h, n, el, v_y, v_z = (f(y, z) for f in (base.h, base.N, base.L, base.v_y, base.v_z))
        p = -(v_y * mu[1] + v_z * mu[2]) + d_x * (v_y * z - v_z * y)
        q = n * (mu[0] - o_y * d_z + o_z * d_y) - 2.0 * el * (mu[0] + d_y * (z - h))
        return base.E(y, z), p, q, base.W(y, z)

    def gamma(self, y: ArrayLike, z: ArrayLike) -> Array:
        """The paper's gamma (eq. 13), degree 10 in (y, z): E^2 (P^2 + W Q^2)."""
        e, p, q, w = self.factors(y, z)
        return e * e * (p * p + w * q * q)

    def reduced(self, y: ArrayLike, z: ArrayLike) -> Array:
        """P^2 + W Q^2, what of gamma depends on the line: degree 6, 4 for a sphere."""
        _, p, q, w = self.factors(y, z)
        return p * p + w * q * q

    def x(self, y: ArrayLike, z: ArrayLike) -> Array:
        """The mirror point's x = P / Q (eq. 14), infinite or NaN where Q = 0."""
        _, p, q, _ = self.factors(y, z)
        with np.errstate(divide='ignore', invalid='ignore'):
            return p / q

    def side(self, points: Array) -> Array:
        """S = P - x Q at mirror points (N, 3): zero where the reflected ray meets the line.

        It is -N |v_i| times S of the unit ray, in metres to the fourth.
        """
        _, p, q, _ = self.factors(points[:, 1], points[:, 2])
        return p - points[:, 0] * q

    def rays(self, points: Array) -> Array:
        """Unit reflected rays (N, 3) at mirror points (N, 3)."""
        return self.mirror.reflected(points - self.cop, points)

    def along_line(self, points: Array) -> tuple[Array, Array]:
        """Where reflected rays pass the line, for mirror points (N, 3).

        :returns: lambda (N,), metres along the line from ``point``, and the distance along the
            ray (N,), metres, negative behind the mirror; infinite where ray and line are parallel.
        """
        r = self.rays(points)
        cross = np.cross(r, self.direction)
        square = np.einsum('ni,ni->n', cross, cross)
        between = self.point - points
        parallel = square < _FLAT**2
        square = np.where(parallel, 1.0, square)
        on_line = np.einsum('ni,ni->n', np.cross(between, r), cross) / square
        on_ray = np.einsum('ni,ni->n', np.cross(between, self.direction), cross) / square
        return np.where(parallel, np.inf, on_line), np.where(parallel, np.inf, on_ray)

    def distance(self, points: Array) -> Array:
        """Distance (N,) between reflected rays and line, metres: |S| free of its scale."""
        r = self.rays(points)
        cross = np.cross(r, self.direction)
        norm = np.linalg.norm(cross, axis=1)
        between = self.point - points
        skew = np.abs(np.einsum('ni,ni->n', between, cross)) / np.where(norm > _FLAT, norm, 1.0)
        apart = np.linalg.norm(np.cross(between, self.direction), axis=1)
        return np.where(norm > _FLAT, skew, apart)

    def branch(self, points: Array) -> NDArray[np.int_]:
        """The :class:`Branch` of mirror points (N, 3); the line's own image goes first."""
        mirrored = points * [-1.0, 1.0, 1.0]
        _, ahead = self.along_line(points)
        on_curve = self.distance(points) <= _ON_BRANCH
        base = self._base
        e = base.E(points[:, 1], points[:, 2])
        slope = np.hypot(base.s(points[:, 1], points[:, 2]), np.abs(self.cop[1]))
        return np.select(
            [on_curve & (ahead > 0.0), on_curve, self.distance(mirrored) <= _ON_BRANCH,
             np.abs(e) <= _ON_BRANCH * np.maximum(slope, _FLAT)],
            [Branch.PHYSICAL, Branch.VIRTUAL, Branch.MIRRORED, Branch.SPURIOUS], Branch.OFF)

    def visible(self, points: Array) -> NDArray[np.bool_]:
        """Whether mirror points (N, 3) lie on the physical mirror and face the camera."""
        towards = np.einsum('ni,ni->n', self.cop - points, self.mirror.normal(points))
        return self.mirror.contains(points) & (towards > 0.0)

    def zeros_of_gamma(self, heights: ArrayLike) -> tuple[Array, NDArray[np.int_]]:
        """All of gamma's zeros on the visible mirror at some heights z (K,).

        For each z, P^2 + W Q^2 is a polynomial of degree 4 in y, and E of degree 1.

        :returns: mirror points (M, 3), and the :class:`Branch` of each (M,).
        """
        z = np.asarray(heights, dtype=float)
        reach = np.sqrt(np.maximum(-self.factors(np.zeros_like(z), z)[3], 0.0))
        z, reach = z[reach > 0.0], reach[reach > 0.0]
        which, y = self._slices(z, reach)
        base = self._base
        s = base.s(np.zeros_like(z), z)
        steep = np.abs(s) > _FLAT
        conic = -self.cop[1] * base.h(np.zeros_like(z), z) / np.where(steep, s, 1.0)
        steep &= np.abs(conic) < reach
        z = np.concatenate([z[which], z[steep]])
        y = np.concatenate([y, conic[steep]])
        spurious = np.arange(len(z)) >= len(which)
        w = np.minimum(self.factors(y, z)[3], 0.0)
        right = np.stack([np.sqrt(-w), y, z], axis=1)
        points = np.concatenate([right, right * [-1.0, 1.0, 1.0]])
        near = self._is_nearer(right)
        near = np.concatenate([near, ~near])
        _, ahead = self.along_line(points)
        branch = np.where(near, np.where(ahead > 0.0, Branch.PHYSICAL, Branch.VIRTUAL),
                          Branch.MIRRORED)
        branch = np.where(np.concatenate([spurious, spurious]), Branch.SPURIOUS, branch)
        seen = self.visible(points)
        return points[seen], branch[seen]

    def _is_nearer(self, points: Array) -> NDArray[np.bool_]:
        """Whether the line passes nearer to the ray of (x, y, z) than to that of (-x, y, z)."""
        return np.abs(self.side(points)) <= np.abs(self.side(points * [-1.0, 1.0, 1.0]))

    def _slices(self, z: Array, reach: Array) -> tuple[NDArray[np.intp], Array]:
        """Real roots y of the reduced curve at heights z (K,), |y| <= reach (K,).

        :returns: which height each root belongs to (M,), and y (M,).
        """
        # five samples give the quartic exactly; y in units of reach keeps it well conditioned
        nodes = np.cos(np.pi * (np.arange(5) + 0.5) / 5)
        samples = self.reduced(reach[:, None] * nodes, np.repeat(z[:, None], 5, axis=1))
        quartic = samples @ np.linalg.inv(np.vander(nodes, 5)).T
        size = np.abs(quartic).max(axis=1, initial=0.0)
        regular = size > 0.0
        leading = np.where(
            regular & (np.abs(quartic[:, 0]) > _NO_LEADING * size), quartic[:, 0],
            np.where(regular, _NO_LEADING * size, 1.0))
        roots = companion_roots(quartic[:, 1:] / leading[:, None])
        real = (np.abs(roots.imag) < _REAL_ROOT) & (np.abs(roots.real) <= 1.0)
        which, column = np.nonzero(real & regular[:, None])
        return which, roots.real[which, column] * reach[which]

    def physical(self, heights: ArrayLike, length: float) -> Array:
        """The line's image on the mirror by the curve's equation alone, in order along the line.

        :param heights: z (K,) to cut the curve at.
        :param length: only the part 0 <= lambda <= length, metres; infinite for the whole line.
        :returns: mirror points (M, 3) by rising lambda.
        """
        points, branch = self.zeros_of_gamma(heights)
        points = points[branch == Branch.PHYSICAL]
        on_line, _ = self.along_line(points)
        inside = np.isfinite(on_line) & ((on_line >= 0.0) | np.isinf(length)) & (
            on_line <= length)
        return points[inside][np.argsort(on_line[inside], kind='stable')]
