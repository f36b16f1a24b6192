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
"""The polynomial of a point's reflection (Agrawal, Taguchi and Ramalingam, 2011).

A point p, a camera at o = (0, o_y, o_z) and the mirror x^2 + y^2 + A z^2 + B z - C = 0 leave one
unknown, the height z of the mirror point m. Two conditions tie x and y to it:

    plane        p, o and k = (0, 0, z - h) are coplanar with m:   D x = p_x (s y + o_y h)
    reflection   (p - k) is parallel, in the plane x = 0, to the reflected ray from k:
                 a2 y^2 + b2 y + c2 = 0

with h = A z + B/2, s = z - h - o_z, D = (p_y - o_y) s + o_y (p_z - o_z). Elimination of x and y
leaves G(z) of degree 8; 7 for a paraboloid, 4 for a sphere, and 6 with the camera on the axis.
The plain resultant is D^2 G.
"""

from __future__ import annotations

from collections.abc import Sequence

from nccs_pose.geometry.pose import Array
import numpy as np
from numpy.typing import NDArray

Polynomial = Sequence[Array | float]
"""Coefficients by rising power of z, each an array (N,) or a number common to all points."""


def _times(*factors: Polynomial) -> Polynomial:
    product: list[Array | float] = [1.0]
    for factor in factors:
        terms: list[Array | float] = [0.0] * (len(product) + len(factor) - 1)
        for i, a in enumerate(product):
            for j, b in enumerate(factor):
                terms[i + j] = terms[i + j] + a * b
        product = terms
    return product


def _plus(*summands: Polynomial) -> Polynomial:
    total: list[Array | float] = [0.0] * max(map(len, summands))
    for summand in summands:
        for i, a in enumerate(summand):
            total[i] = total[i] + a
    return total


def _scaled(factor: float | Array, polynomial: Polynomial) -> Polynomial:
    return [factor * a for a in polynomial]


class PointConditions:
    """The polynomials in z that a point's two reflection conditions are made of.

    quadric: (A, B, C) of the mirror; cop: (o_y, o_z); points: (N, 3) in the mirror frame, in the
    same unit of length (any: metres, millimetres, or scaled to 1).
    """

    def __init__(
        self,
        quadric: tuple[float, float, float],
        cop: tuple[float, float],
        points: Array,
    ) -> None:
        a, b, c = quadric
        o_y, o_z = cop
        self.p_x, self.p_y, self.p_z = points.T
        self.o_y = o_y
        p_y, p_z = self.p_y, self.p_z
        z = [0.0, 1.0]
        self.h = [b / 2, a]
        self.s = [-b / 2 - o_z, 1 - a]
        k_z = [-b / 2, 1 - a]
        n_squared = _plus([c, -b, -a], _times(self.h, self.h))
        l_0 = [c - o_z * b / 2, -(b / 2 + a * o_z)]
        self.w_0 = [-c, b, a]
        k_to_p = _plus(k_z, [-p_z])
        self.d = _plus(_scaled(p_y - o_y, self.s), [o_y * (p_z - o_z)])
        self.a2 = _scaled(-2 * o_y, k_to_p)
        self.b2 = _scaled(
            -1.0,
            _plus(
                _scaled(o_z - p_z, n_squared),
                _scaled(-2.0, _times(l_0, k_to_p)),
                _scaled(2 * o_y * p_y, self.h),
            ),
        )
        ahead = _plus(_scaled(p_y - o_y, _plus(z, [-o_z])), [o_y * (p_z - o_z)])
        self.c2 = _plus(
            _scaled(-1.0, _times(n_squared, ahead)), _scaled(2 * p_y, _times(l_0, self.h))
        )
        # F = 2 o_y^2 h^2 + 2 s h L0 - s N (z - o_z): what is left where p_x carries everything
        self.f = _plus(
            _scaled(2 * o_y**2, _times(self.h, self.h)),
            _scaled(2.0, _times(self.s, self.h, l_0)),
            _scaled(-1.0, _times(self.s, n_squared, _plus(z, [-o_z]))),
        )

    def polynomial(self) -> Array:
        """G(z), whose roots hold the heights of the mirror points, by falling power.

        (N, 9) coefficients; (N, 7) with the camera on the axis.

        On the axis the points must already be turned about it into the plane x = 0.
        """
        c2_w = _plus(self.c2, _scaled(-1.0, _times(self.w_0, self.a2)))
        in_plane = _plus(_times(c2_w, c2_w), _times(self.w_0, self.b2, self.b2))
        if self.o_y == 0.0:
            return self._stacked(in_plane, 6)
        square = self.p_x**2
        f2 = _scaled(square, _times(self.s, self.s))
        f1 = _scaled(2 * self.o_y * square, _times(self.s, self.h))
        f0 = _scaled(self.o_y**2 * square, _times(self.h, self.h))
        f2_c2_f0_a2 = _plus(_times(f2, self.c2), _scaled(-1.0, _times(f0, self.a2)))
        f2_b2_f1_a2 = _plus(_times(f2, self.b2), _scaled(-1.0, _times(f1, self.a2)))
        f1_c2_f0_b2 = _plus(_times(f1, self.c2), _scaled(-1.0, _times(f0, self.b2)))
        mixed = _plus(
            _scaled(2.0, _times(f2_c2_f0_a2, c2_w)),
            _times(f2_b2_f1_a2, self.w_0, self.b2),
            _scaled(-1.0, _times(self.b2, f1_c2_f0_b2)),
        )
        whole = _plus(
            _scaled(square**2, _times(self.f, self.f)),
            mixed,
            _times(self.d, self.d, in_plane),
        )
        return self._stacked(whole, 8)

    def _stacked(self, polynomial: Polynomial, degree: int) -> Array:
        # every power above the degree cancels identically; what floating point leaves is dropped
        rows = [np.broadcast_to(a, self.p_x.shape) for a in polynomial[: degree + 1]]
        return np.stack(rows[::-1], axis=-1)

    def y_of_z(self, z: Array) -> Array:
        """The mirror point's y at height z: common root of the two conditions; z (N,) -> (N,)."""
        a2, b2, c2, h, s, d, w_0 = (
            _value(p, z) for p in (self.a2, self.b2, self.c2, self.h, self.s, self.d, self.w_0)
        )
        square = self.p_x**2
        # plane condition squared, with x^2 = -(y^2 + W0): e2 y^2 + e1 y + e0 = 0
        e2 = square * s * s + d * d
        e1 = 2 * self.o_y * square * s * h
        e0 = self.o_y**2 * square * h * h + d * d * w_0
        numerator = a2 * e0 - e2 * c2
        denominator = e2 * b2 - a2 * e1
        return np.divide(
            numerator, denominator, out=np.zeros_like(numerator), where=denominator != 0.0
        )


def _value(polynomial: Polynomial, z: Array) -> Array:
    total = np.zeros_like(z)
    for a in reversed(polynomial):
        total = total * z + a
    return total


def companion_roots(coefficients: Array) -> NDArray[np.complex128]:
    """All roots (N, degree) of monic polynomials z^degree + c_1 z^(degree - 1) + ...

    Eigenvalues of the companion matrices, batched.

    :param coefficients: c_1, c_2, ... (N, degree).
    """
    count, degree = coefficients.shape
    companion = np.zeros((count, degree, degree))
    companion[:, 0] = -coefficients
    companion[:, np.arange(1, degree), np.arange(degree - 1)] = 1.0
    return np.asarray(np.linalg.eigvals(companion), dtype=np.complex128)


def real_roots(coefficients: Array, tolerance: float) -> tuple[Array, NDArray[np.bool_]]:
    """Real parts of all roots (N, degree), and which are real to the tolerance times 1 + |z|.

    Leading coefficients that vanish for every point (the sphere's, the paraboloid's) lower the
    degree.

    :param coefficients: of each polynomial by falling power (N, degree + 1).
    """
    size = np.abs(coefficients).max(axis=1, keepdims=True)
    scaled = coefficients / np.where(size > 0.0, size, 1.0)
    significant = np.abs(scaled).max(axis=0, initial=0.0) > 1e-12
    if not significant.any():
        return np.zeros((len(scaled), 0)), np.zeros((len(scaled), 0), dtype=bool)
    scaled = scaled[:, int(np.argmax(significant)) :]
    # a point whose own leading coefficient vanishes has its last root at infinity
    leading = np.where(np.abs(scaled[:, 0]) > 1e-300, scaled[:, 0], 1e-300)
    roots = companion_roots(np.clip(scaled[:, 1:] / leading[:, None], -1e150, 1e150))
    real = np.abs(roots.imag) <= tolerance * (1.0 + np.abs(roots.real))
    return roots.real, real
