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

"""Small symmetric matrices, without numpy's ceremony.

Two and three rows go number by number, quicker than any call; more of them to LAPACK itself.
"""

from __future__ import annotations

from nccs_pose.geometry.pose import Array
import numpy as np
from scipy.linalg.lapack import dposv

# Relative size below which a pivot of a Gram matrix is nothing but rounding.
ROUNDING = 1e-12


def inverse_2x2(a: float, b: float, d: float) -> tuple[float, float, float]:
    """Inverse of [[a, b], [b, d]], as its entries, for a matrix that is nowhere negative.

    The pseudo-inverse where it is singular.
    """
    determinant, trace = a * d - b * b, a + d
    if determinant > ROUNDING * trace * trace:
        return d / determinant, -b / determinant, a / determinant
    if trace > 0.0:
        return a / (trace * trace), b / (trace * trace), d / (trace * trace)
    return 0.0, 0.0, 0.0


def solve_3x3(
    xx: float, xy: float, yy: float, xz: float, yz: float, zz: float,
    gx: float, gy: float, gz: float,
) -> tuple[float, float, float] | None:
    """Solution of H v = g, with H positive definite beyond rounding; else None."""
    minor, trace = xx * yy - xy * xy, xx + yy
    if not (trace > 0.0 and minor > ROUNDING * trace * trace):
        return None
    ax, ay = (yy * xz - xy * yz) / minor, (xx * yz - xy * xz) / minor
    bx, by = (yy * gx - xy * gy) / minor, (xx * gy - xy * gx) / minor
    pivot = zz - xz * ax - yz * ay
    # The determinant, since a small minor has lost digits of the pivot.
    if not minor * pivot > ROUNDING * xx * yy * abs(zz):
        return None
    z = (gz - xz * bx - yz * by) / pivot
    return bx - ax * z, by - ay * z, z


def solve_if_definite(matrix: Array, right: Array) -> Array | None:
    """As :func:`solve_3x3`, for a matrix (3, 3) and a right side (3,)."""
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = matrix.tolist()
    found = solve_3x3(xx, xy, yy, xz, yz, zz, *right.tolist())
    return None if found is None else np.array(found)


def is_definite(matrix: Array, least: float = 0.0) -> bool:
    """Whether all eigenvalues of a symmetric matrix (3, 3) are larger, beyond rounding."""
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = matrix.tolist()
    return solve_3x3(
        xx - least, xy, yy - least, xz, yz, zz - least, 0.0, 0.0, 0.0) is not None


def solve_each_definite(matrices: Array, right: Array) -> Array:
    """Solutions (H, 3) of systems (H, 3, 3) that are positive definite, far beyond rounding."""
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = matrices.transpose(1, 2, 0)
    gx, gy, gz = right.T
    one, other, first = xy / xx, xz / xx, gx / xx
    a, b, c = yy - one * xy, yz - one * xz, zz - other * xz
    second, last = (gy - one * gx) / a, gz - other * gx
    share = b / a
    z = (last - b * second) / (c - share * b)
    y = second - share * z
    return np.array([first - one * y - other * z, y, z]).T


def solve_symmetric(matrix: Array, right: Array) -> Array:
    """Solution (P,) of any regular, symmetric system (P, P)."""
    found = solve_if_definite(matrix, right) if len(right) == 3 else None
    return np.asarray(np.linalg.solve(matrix, right), dtype=float) if found is None else found


def inverse_3x3(matrix: Array) -> Array | None:
    """Inverse of a symmetric matrix (3, 3), positive definite beyond rounding; else None."""
    (a, b, c), (_, d, e), (_, _, f) = matrix.tolist()
    p, q, r = d * f - e * e, c * e - b * f, b * e - c * d
    s, t, u = a * f - c * c, b * c - a * e, a * d - b * b
    determinant = a * p + b * q + c * r
    if not (a > 0.0 and u > 0.0 and determinant > ROUNDING * a * d * f):
        return None
    return np.array([[p, q, r], [q, s, t], [r, t, u]]) / determinant


def inverse(matrix: Array) -> Array:
    """Inverse (P, P) of any regular, symmetric matrix (P, P)."""
    found = inverse_3x3(matrix) if len(matrix) == 3 else None
    return np.asarray(np.linalg.inv(matrix), dtype=float) if found is None else found


def solve_definite(matrix: Array, right: Array) -> Array:
    """Solution (P,) or (P, K) of a system (P, P) by Cholesky's factors.

    :raises numpy.linalg.LinAlgError: where the matrix is not positive definite.
    """
    _, found, failed = dposv(matrix, right)
    if failed:
        raise np.linalg.LinAlgError('the matrix is not positive definite')
    return np.asarray(found)
