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

"""All poses for lines in general position, without an initial guess.

For a fixed yaw S is linear in (x, y), so the 7 x 7 Gram matrix G of its monomials gives the best
cost at that yaw as a ratio of two determinants: with the monomials written V(yaw) (x, y, 1) and
Q = V^T G V (3 x 3),

    J(yaw) = N / D,   N = det Q,   D = det Q[:2, :2].

N is a trigonometric polynomial of degree 4 and D one of degree 2 (the entries of Q have degree
2, but the highest terms cancel), so J' = 0 is one of degree 6: its at most 12 roots on the unit
circle z = exp(i yaw) are all stationary points, and nothing is searched for. Thirteen samples of
the yaw determine both polynomials exactly.
"""

from __future__ import annotations

import math

from nccs_pose.estimation.closed_form import horizontal_minima, vertical_minima
from nccs_pose.estimation.pose_monomials import Minimum, monomials_and_slopes
from nccs_pose.geometry.pose import Array, Pose2
from nccs_pose.geometry.small_matrices import inverse_2x2, ROUNDING
import numpy as np
from numpy.typing import NDArray

# A line is horizontal or vertical when its direction is so up to this (rad).
_ALIGNED = 1e-9
# A root this close to the unit circle is a real yaw: two that nearly meet leave it by the root
# of their rounding.
_ON_CIRCLE = 1e-4
_HARMONICS = np.arange(-6, 7)
# As many samples as N' D - N D' has coefficients.
COUNT = 13
YAWS = 2.0 * math.pi * np.arange(COUNT) / COUNT
# From samples at those yaws to Fourier coefficients, -6 to 6, and to the samples' derivatives.
_FOURIER = np.exp(-1j * _HARMONICS[:, None] * YAWS) / COUNT
_DERIVATIVE = (np.exp(1j * YAWS[:, None] * _HARMONICS) @ (
    1j * _HARMONICS[:, None] * _FOURIER)).real
# Places of a symmetric matrix (7, 7) that hold each of its entries once.
_UPPER = np.flatnonzero(np.triu(np.ones((7, 7))))


def _entries_of_q() -> Array:
    """Q_00, Q_11, Q_22, Q_01, Q_02, Q_12 at the sampled yaws, from _UPPER of G (78, 28)."""
    # V's columns are the monomials' slopes by x and y, and the monomials at the origin.
    v = np.array([monomials_and_slopes(0.0, 0.0, yaw)[[1, 2, 0]] for yaw in YAWS.tolist()])
    pairs = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
    whole = np.array([np.einsum('ka,kb->kab', v[:, i], v[:, j]) for i, j in pairs])
    both = whole + whole.swapaxes(2, 3) * (1.0 - np.eye(7))
    return both.reshape(6 * COUNT, 49)[:, _UPPER]


_SAMPLES = _entries_of_q()


def general_minima(gram: Array) -> tuple[Minimum, ...]:
    """All local minima, the global one first, for any lines but all horizontal or all vertical.

    :param gram: Gram matrix of S (7, 7).
    """
    yaws = _minima_of_slope(_slope(*ratio(gram)))
    if not len(yaws):
        # Flat up to rounding: any yaw is as good.
        yaws = YAWS
    return tuple(sorted(
        (minimum_at(gram, yaw) for yaw in yaws.tolist()), key=lambda m: m.cost))


def ratio(gram: Array) -> Array:
    """N and D at the sampled yaws (2, COUNT)."""
    q00, q11, q22, q01, q02, q12 = (_SAMPLES @ gram.take(_UPPER)).reshape(6, COUNT)
    minor = q00 * q11 - q01 * q01
    full = minor * q22 - q00 * q12 * q12 - q11 * q02 * q02 + 2.0 * q01 * q02 * q12
    return np.array([full, minor])


def _slope(full: Array, minor: Array) -> NDArray[np.complex128]:
    """Fourier coefficients (13,) of N' D - N D', which has the sign of J'."""
    return _FOURIER @ ((_DERIVATIVE @ full) * minor - full * (_DERIVATIVE @ minor))


def _minima_of_slope(slope: NDArray[np.complex128]) -> Array:
    """Yaws where a real trigonometric polynomial crosses zero upwards.

    :param slope: its Fourier coefficients from -degree to degree (2 degree + 1,).
    """
    size = np.abs(slope)
    strong = np.flatnonzero(size > ROUNDING * size.max())
    if not len(strong) or strong[0] == len(slope) // 2:
        return np.empty(0)
    degree = len(slope) // 2 - int(strong[0])
    slope = slope[strong[0]:len(slope) - strong[0]]
    companion = np.eye(2 * degree, k=-1, dtype=complex)
    companion[0] = -slope[-2::-1] / slope[-1]
    roots = np.linalg.eigvals(companion)
    yaws = np.angle(roots[np.abs(np.abs(roots) - 1.0) < _ON_CIRCLE])
    harmonics = np.arange(-degree, degree + 1)
    curvature = (np.exp(1j * yaws[:, None] * harmonics) @ (1j * harmonics * slope)).real
    return yaws[curvature > 0.0]


def minimum_at(gram: Array, yaw: float) -> Minimum:
    """The pose with the best translation at a yaw.

    :param gram: Gram matrix of S (7, 7).
    :param yaw: radians.
    """
    form = monomials_and_slopes(0.0, 0.0, yaw)[:3]
    (q22, q02, q12), (_, q00, q01), (_, _, q11) = (form @ gram @ form.T).tolist()
    a, b, d = inverse_2x2(q00, q01, q11)
    x, y = -a * q02 - b * q12, -b * q02 - d * q12
    cost = q22 + 2.0 * (x * q02 + y * q12) + x * x * q00 + 2.0 * x * y * q01 + y * y * q11
    return Minimum(Pose2(x, y, yaw), cost)


def all_minima(gram: Array, directions: Array) -> tuple[Minimum, ...]:
    """All local minima by the method that fits the lines, the global one first.

    :param gram: Gram matrix of S (7, 7).
    :param directions: unit directions of the lines (L, 3).
    """
    if are_horizontal(directions):
        return horizontal_minima(gram)
    if are_vertical(directions):
        return vertical_minima(gram)
    return general_minima(gram)


def are_horizontal(directions: Array) -> bool:
    """Whether all directions (L, 3) lie in the ground's plane."""
    return float(np.abs(directions[:, 2]).max()) <= _ALIGNED


def are_vertical(directions: Array) -> bool:
    """Whether all directions (L, 3) stand upright."""
    return float(np.abs(directions[:, :2]).max()) <= _ALIGNED
