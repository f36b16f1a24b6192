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

"""The paper's reflection curve as it is printed: the polynomials c1 to c11, gamma and x.

Section II of Mateus, Miraldo and Lima, with the print corrected where it is wrong:

- the point k on the axis is m - n, not m + n: k = (0, 0, z - A z - B/2) (the print has + B/2);
- n = (x, y, A z + B/2) is half of the gradient of Omega (harmless, used as printed);
- x = c11 / c10 with c11 = c3 c9 - c4 c8 and c10 = c2 c8 - c1 c9.

:mod:`nccs_pose.geometry.reflection_curve` has the same curve in closed form; this module is the
paper with its own names, for reading, testing and comparing.
"""

from __future__ import annotations

from dataclasses import dataclass

from nccs_pose.errors import GeometryError
from nccs_pose.geometry.mirror import QuadricMirror
from nccs_pose.geometry.pose import Array, checked_vector
import numpy as np
from numpy.typing import ArrayLike


@dataclass(frozen=True, eq=False)
class Bivariate:
    """A polynomial in (y, z).

    :ivar coefficients: (I, J), of y^i z^j at [i, j].
    """

    coefficients: Array

    def __add__(self, other: Bivariate) -> Bivariate:
        a, b = self.coefficients, other.coefficients
        total = np.zeros(np.maximum(a.shape, b.shape))
        total[:a.shape[0], :a.shape[1]] += a
        total[:b.shape[0], :b.shape[1]] += b
        return Bivariate(total)

    def __sub__(self, other: Bivariate) -> Bivariate:
        return self + (-1.0) * other

    def __mul__(self, other: Bivariate) -> Bivariate:
        a, b = self.coefficients, other.coefficients
        product = np.zeros((a.shape[0] + b.shape[0] - 1, a.shape[1] + b.shape[1] - 1))
        for i, j in np.argwhere(a):
            product[i:i + b.shape[0], j:j + b.shape[1]] += a[i, j] * b
        return Bivariate(product)

    def __rmul__(self, factor: float) -> Bivariate:
        return Bivariate(factor * self.coefficients)

    def __call__(self, y: ArrayLike, z: ArrayLike) -> Array:
        """Value at y and z, of one shape."""
        in_z = np.polynomial.polynomial.polyval(np.asarray(y, dtype=float), self.coefficients)
        return np.polynomial.polynomial.polyval(np.asarray(z, dtype=float), in_z, tensor=False)

    def monomials(self, relative: float = 1e-12) -> list[tuple[int, int]]:
        """Powers (i, j) whose coefficient exceeds ``relative`` times the largest one."""
        size = np.abs(self.coefficients)
        return [(int(i), int(j)) for i, j in np.argwhere(size > relative * size.max())]


def _poly(*terms: tuple[int, int, float]) -> Bivariate:
    """Sum of c y^i z^j from (i, j, c)."""
    coefficients = np.zeros((1 + max(i for i, _, _ in terms), 1 + max(j for _, j, _ in terms)))
    for i, j, c in terms:
        coefficients[i, j] += c
    return Bivariate(coefficients)


@dataclass(frozen=True, eq=False)
class MirrorPolynomials:
    """What depends on mirror and camera only, as polynomials in the mirror point's (y, z).

    :ivar h: A z + B/2, the normal's z.
    :ivar s: z of k - o, with k = m - n on the mirror's axis (eq. 5, its sign of B put right).
    :ivar W: y^2 + A z^2 + B z - C; x^2 = -W on the mirror.
    :ivar N: n.n on the mirror.
    :ivar L: v_i.n on the mirror, the polar plane of o.
    :ivar E: s y + o_y h; zero where o, k and m are in line in the plane x = 0.
    :ivar v_y: y of the reflected ray, N v_i - 2 n L (eq. 10 over 4).
    :ivar v_z: z of the reflected ray; v_i = m - o (eq. 11).
    """

    h: Bivariate
    s: Bivariate
    W: Bivariate
    N: Bivariate
    L: Bivariate
    E: Bivariate
    v_y: Bivariate
    v_z: Bivariate


def mirror_polynomials(mirror: QuadricMirror, cop: Array) -> MirrorPolynomials:
    """The polynomials of a mirror and a centre of projection (3,), common to all lines."""
    a, b, c = mirror.A, mirror.B, mirror.C
    _, o_y, o_z = (float(v) for v in cop)
    y, z = _poly((1, 0, 1.0)), _poly((0, 1, 1.0))
    h = _poly((0, 1, a), (0, 0, b / 2))
    s = _poly((0, 1, 1 - a), (0, 0, -b / 2 - o_z))
    w = _poly((2, 0, 1.0), (0, 2, a), (0, 1, b), (0, 0, -c))
    # n.n = C - A z^2 - B z + h^2, with the powers of z collected so that a sphere's cancel exactly
    n = _poly((0, 2, a * (a - 1)), (0, 1, b * (a - 1)), (0, 0, c + b * b / 4))
    el = _poly((0, 0, c - o_z * b / 2), (1, 0, -o_y), (0, 1, -(b / 2 + a * o_z)))
    e = s * y + o_y * h
    v_y = n * (y - _poly((0, 0, o_y))) - 2.0 * y * el
    v_z = n * (z - _poly((0, 0, o_z))) - 2.0 * h * el
    return MirrorPolynomials(h, s, w, n, el, e, v_y, v_z)


@dataclass(frozen=True, eq=False)
class PaperPolynomials:
    """c1 to c11 (eqs. 6 to 14) of one line, with p(lambda) = q + lambda d.

    x = -(c3 lambda + c4) / (c1 lambda + c2)            (eq. 6, the reflection plane)
    c5 lambda^2 + c6 lambda + c7 = 0                    (eq. 7, in the mirror's equation)
    lambda = -c9 / c8                                   (eq. 12, the reflected ray)
    gamma = c5 c9^2 - c6 c8 c9 + c7 c8^2                (eq. 13)
    x = c11 / c10                                       (eq. 14)
    """

    c1: Bivariate
    c2: Bivariate
    c3: Bivariate
    c4: Bivariate
    c5: Bivariate
    c6: Bivariate
    c7: Bivariate
    c8: Bivariate
    c9: Bivariate
    c10: Bivariate
    c11: Bivariate
    gamma: Bivariate


def paper_polynomials(
    mirror: QuadricMirror, cop: ArrayLike, q: ArrayLike, d: ArrayLike,
) -> PaperPolynomials:
    """The paper's polynomials for the line q + lambda d (3,), (3,) in the mirror frame.

    :param cop: o = (0, o_y, o_z) (3,), in the unit of length of mirror and q (metres, or any).
    :raises GeometryError: if d is zero, anything is not finite, or o is off the plane x = 0 or
        inside the mirror.
    """
    o = mirror.checked_cop(cop)
    q, d = checked_vector('q', q), checked_vector('d', d)
    if not d.any():
        raise GeometryError('the line has the direction d = 0')
    base = mirror_polynomials(mirror, o)
    y, z, one = _poly((1, 0, 1.0)), _poly((0, 1, 1.0)), _poly((0, 0, 1.0))

    # eq. 6: p(lambda), k and o span the plane (eq. 3), m lies in it
    c1 = d[1] * base.s + (d[2] * o[1]) * one
    c2 = (q[1] - o[1]) * base.s + (o[1] * (q[2] - o[2])) * one
    c3 = (-d[0]) * base.E
    c4 = (-q[0]) * base.E
    # eq. 7: that x in the mirror's equation x^2 + W = 0
    c5 = c3 * c3 + base.W * c1 * c1
    c6 = 2.0 * (c3 * c4 + base.W * c1 * c2)
    c7 = c4 * c4 + base.W * c2 * c2
    # eq. 12: the first component of v_r x (p - m) = 0 (eq. 8), the one without x. The leading
    # terms of v_y z - v_z y cancel, so it is written without them.
    c8 = d[2] * base.v_y - d[1] * base.v_z
    across = base.N * (o[2] * y - o[1] * z) - 2.0 * base.L * y * (z - base.h)
    c9 = q[2] * base.v_y - q[1] * base.v_z - across
    # eqs. 13 and 14
    gamma = c5 * c9 * c9 - c6 * c8 * c9 + c7 * c8 * c8
    c10 = c2 * c8 - c1 * c9
    c11 = c3 * c9 - c4 * c8
    return PaperPolynomials(c1, c2, c3, c4, c5, c6, c7, c8, c9, c10, c11, gamma)
