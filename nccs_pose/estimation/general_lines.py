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
circle z = exp(i yaw) are all stationary points, and nothing is searched for. Sixteen samples of
the yaw determine both polynomials exactly. Once the weights are known to change little, Newton's
method on J' takes a minimum to its new place.
"""

from __future__ import annotations

import math

from nccs_pose.estimation.closed_form import (
    horizontal_minima,
    inverse_2x2,
    ROUNDING,
    vertical_minima,
)
from nccs_pose.estimation.pose_monomials import Minimum
from nccs_pose.geometry.pose import Array, Pose2
import numpy as np
from numpy.typing import NDArray

# A line is horizontal or vertical when its direction is so up to this (rad).
ALIGNED = 1e-9
# A root this close to the unit circle is a real yaw: two that nearly meet leave it by the root
# of their rounding.
_ON_CIRCLE = 1e-4
# Newton's method is given up further from its start than this (rad), or after so many steps.
_ASTRAY = 0.1
_NEWTON_STEPS = 8
_HARMONICS = np.arange(-6, 7)
_YAWS = 2.0 * math.pi * np.arange(16) / 16
# From samples at those yaws to Fourier coefficients, -6 to 6, and to the samples' derivatives.
_FOURIER = np.exp(-1j * _HARMONICS[:, None] * _YAWS) / 16
_DERIVATIVE = (np.exp(1j * _YAWS[:, None] * _HARMONICS) @ (
    1j * _HARMONICS[:, None] * _FOURIER)).real


def _parametrisation(yaws: Array) -> Array:
    """V (K, 7, 3): the monomials at each yaw (K,) as a form in (x, y, 1)."""
    c, s, v = np.cos(yaws), np.sin(yaws), np.zeros((len(yaws), 7, 3))
    v[:, 0, 2], v[:, 1, 2] = c, s
    v[:, 2, 0] = v[:, 3, 1] = v[:, 6, 2] = 1.0
    v[:, 4, 0], v[:, 4, 1] = c, s
    v[:, 5, 0], v[:, 5, 1] = -s, c
    return v


def _entries_of_q() -> Array:
    """Q_00, Q_11, Q_22, Q_01, Q_02, Q_12 at the sampled yaws, from the entries of G (96, 49)."""
    v = _parametrisation(_YAWS)
    pairs = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
    return np.concatenate([
        np.einsum('ka,kb->kab', v[:, :, i], v[:, :, j]).reshape(16, 49) for i, j in pairs])


_SAMPLES = _entries_of_q()


def general_minima(gram: Array) -> tuple[Minimum, ...]:
    """All local minima, the global one first, for any lines but all horizontal or all vertical.

    :param gram: Gram matrix of S (7, 7).
    """
    yaws = _minima_of_slope(_slope(gram))
    if not len(yaws):
        # Flat up to rounding: any yaw is as good.
        return _minima_at(gram, _YAWS)[:1]
    return _minima_at(gram, yaws)


def _slope(gram: Array) -> NDArray[np.complex128]:
    """Fourier coefficients (13,) of N' D - N D', which has the sign of J'."""
    q00, q11, q22, q01, q02, q12 = (_SAMPLES @ gram.ravel()).reshape(6, 16)
    minor = q00 * q11 - q01 * q01
    full = minor * q22 - q00 * q12 * q12 - q11 * q02 * q02 + 2.0 * q01 * q02 * q12
    return _FOURIER @ ((_DERIVATIVE @ full) * minor - full * (_DERIVATIVE @ minor))


def _minimum_downhill(gram: Array, yaw: float) -> Minimum | None:
    """The minimum that Newton's method on J' reaches from a yaw; None where it strays."""
    coefficients, start = _slope(gram), yaw
    both = np.stack([coefficients, 1j * _HARMONICS * coefficients], axis=1)
    for _ in range(_NEWTON_STEPS):
        slope, curvature = (np.exp(1j * yaw * _HARMONICS) @ both).real.tolist()
        if curvature <= 0.0 or abs(slope) > _ASTRAY * curvature or abs(yaw - start) > _ASTRAY:
            return None
        yaw -= slope / curvature
        if abs(slope) < 1e-12 * curvature:
            return _minima_at(gram, np.array([yaw]))[0]
    return None


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


def _minima_at(gram: Array, yaws: Array) -> tuple[Minimum, ...]:
    """The best translation for each yaw (K,), the best of all first."""
    v = _parametrisation(yaws)
    q = np.swapaxes(v, 1, 2) @ gram @ v
    minima = []
    for yaw, form in zip(yaws.tolist(), q):
        x, y = (-inverse_2x2(form[:2, :2]) @ form[:2, 2]).tolist()
        place = np.array([x, y, 1.0])
        minima.append(Minimum(Pose2(x, y, yaw), float(place @ form @ place)))
    return tuple(sorted(minima, key=lambda m: m.cost))


def all_minima(gram: Array, directions: Array) -> tuple[Minimum, ...]:
    """All local minima by the method that fits the lines, the global one first.

    :param gram: Gram matrix of S (7, 7).
    :param directions: unit directions of the lines (L, 3).
    """
    if _are_horizontal(directions):
        return horizontal_minima(gram)
    if _are_vertical(directions):
        return vertical_minima(gram)
    return general_minima(gram)


def _are_horizontal(directions: Array) -> bool:
    return bool((np.abs(directions[:, 2]) <= ALIGNED).all())


def _are_vertical(directions: Array) -> bool:
    return bool((np.abs(directions[:, :2]) <= ALIGNED).all())


def minimum_near(gram: Array, directions: Array, yaw: float) -> Minimum:
    """The local minimum that belongs to a yaw from which it cannot be far.

    :param gram: Gram matrix of S (7, 7).
    :param directions: unit directions of the lines (L, 3).
    """
    if not _are_horizontal(directions) and not _are_vertical(directions):
        found = _minimum_downhill(gram, yaw)
        if found is not None:
            return found
    return min(
        all_minima(gram, directions),
        key=lambda m: abs(math.remainder(m.pose.yaw - yaw, 2.0 * math.pi)))
