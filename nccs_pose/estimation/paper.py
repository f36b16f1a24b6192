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
"""The paper's estimator, faithfully: mean |gamma_r| over (c, s, t_x, t_y) under g_1 and g_2.

Section III of Mateus, Miraldo and Lima; a named baseline, not what the localiser uses. Lines go
from the world to the mirror frame by p^C = R p^W + t with R a turn by theta about the mirror's
axis and t_z known (eq. 15, eq. 16), which makes the curve of each mirror point a polynomial

    gamma_r(c, s, t_x, t_y) = E^2 (P^2 + W Q^2),   P of degree 2 (9 monomials), Q of degree 1 (4)

of degree 4 (47 monomials; eq. 17, eq. 19). The problem (eq. 21) is

    min mean |gamma_r|   s.t.   g_1 = c^2 + s^2 - 1 = 0,   g_2 = mean (x - P / Q)^2 = 0

solved by SLSQP with analytic gradients in the place of MATLAB's fmincon, from a first guess; the
inverse transform at the end (eq. 22) gives T_map_base. What the print leaves open: g_2 is the
mean over the points, and the overall scale of gamma_r is set to 1 at the start, which moves no
minimum.
With noise g_2 = 0 has no solution, hence the option to leave it out. As printed, the points weigh
by the sizes of their polynomials, which differ by orders of magnitude over a mirror; dividing each
by the norm of its coefficients, which the paper does not do, is the other option.

The paper's motion is parallel to the mirror's xy-plane. A rig whose mirror is tilted against
base_link is therefore treated as if it hung straight: the tilt is dropped, and costs roughly
tilt x distance to the lines (1 degree: 17 mm at 1 m). The project's own estimators have no such
restriction.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
import math

from nccs_pose.errors import EstimationError
from nccs_pose.geometry.paper_polynomials import mirror_polynomials
from nccs_pose.geometry.pose import Array, cross_matrix, Pose2
from nccs_pose.geometry.rig import Rig
import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import minimize

# (c, s, t_x, t_y) that each monomial of P is the product of: c^2 + s^2 stays unsubstituted.
P_MONOMIALS = ('cc', 'ss', 'cx', 'sx', 'cy', 'sy', 'c', 's', 'x')
Q_MONOMIALS = ('c', 's', 'y', '1')
_MOST_ITERATIONS = 100


@dataclass(frozen=True, eq=False)
class PaperEstimate:
    """What the paper's problem ended in.

    :ivar pose: T_map_base.
    :ivar theta: turn from the world to the camera frame, radians (the paper's R, eq. 15).
    :ivar translation: (t_x, t_y, t_z) from the world to the camera frame, metres (the paper's t).
    :ivar g1: c^2 + s^2 - 1 where it ended.
    :ivar g2: mean (x - P / Q)^2 where it ended, square metres.
    :ivar iterations: of SLSQP.
    :ivar converged: what SLSQP says; rarely true with g_2 and noise.
    :ivar message: SLSQP's own words.
    """

    pose: Pose2
    theta: float
    translation: Array
    g1: float
    g2: float
    iterations: int
    converged: bool
    message: str


@dataclass(frozen=True, eq=False)
class PaperFrame:
    """Between T_map_base and the paper's (c, s, t_x, t_y), for a mounting taken as straight.

    The paper's world is the map turned by a fixed ``turn``, such that its z axis is the mirror's.

    :ivar turn: rotation from the map to the paper's world (3, 3).
    :ivar sense: +1 where theta = yaw (mirror axis down), -1 where theta = -yaw (up).
    :ivar mounting: ``turn`` times the mirror's position in base_link (3,), metres.
    """

    turn: Array
    sense: float
    mounting: Array

    @classmethod
    def of_rig(cls, rig: Rig) -> PaperFrame:
        """Drop the mounting's tilt."""
        into_mirror = rig.T_base_mirror.rotation.T
        up = into_mirror[:, 2]
        axis = np.array([0.0, 0.0, math.copysign(1.0, up[2])])
        # smallest rotation from the tilted axis to the mirror's own (Rodrigues)
        v, cosine = np.cross(up, axis), float(up @ axis)
        cross = cross_matrix(v)
        turn = (np.eye(3) + cross + cross @ cross / (1.0 + cosine)) @ into_mirror
        return cls(turn, -axis[2], turn @ rig.T_base_mirror.translation)

    @property
    def t_z(self) -> float:
        """The paper's known constant c^te, metres."""
        return -float(self.mounting[2])

    def parameters(self, pose: Pose2) -> Array:
        """(c, s, t_x, t_y) of a pose."""
        theta = float(self.sense * pose.yaw)
        t = -Pose2(yaw=theta).rotation @ self.turn @ pose.translation - self.mounting
        return np.array([math.cos(theta), math.sin(theta), t[0], t[1]])

    def pose(self, parameters: Array) -> Pose2:
        """T_map_base of (c, s, t_x, t_y), by the paper's inverse transform (eq. 22)."""
        c, s, t_x, t_y = parameters
        theta = math.atan2(s, c)
        moved = np.array([t_x + self.mounting[0], t_y + self.mounting[1], 0.0])
        x, y, _ = self.turn.T @ (-Pose2(yaw=theta).rotation.T @ moved)
        return Pose2(x, y, self.sense * theta)


class PaperProblem:
    """gamma_r and g_2 of M mirror points, each with its line, and their gradients.

    :param rig: mirror, camera and mounting.
    :param points: mirror points (M, 3) in the mirror frame, metres.
    :param directions: unit directions of the lines in the map (M, 3).
    :param moments: their moments (M, 3), metres.
    :param normalised: divide each point's gamma_r by the size of its coefficients.
    """

    def __init__(
        self, rig: Rig, points: Array, directions: Array, moments: Array, *,
        normalised: bool = False,
    ) -> None:
        self.frame = PaperFrame.of_rig(rig)
        self.x = points[:, 0]
        _, y, z = points.T
        base = mirror_polynomials(rig.mirror, rig.cop)
        h, w, n, el, e, v_y, v_z = (
            f(y, z) for f in (base.h, base.W, base.N, base.L, base.E, base.v_y, base.v_z))
        self.W, self.E = w, e
        _, o_y, o_z = rig.cop
        d_x, d_y, d_z = (directions @ self.frame.turn.T).T
        mu_x, mu_y, mu_z = (moments @ self.frame.turn.T).T
        t_z, across, zero = self.frame.t_z, v_y * z - v_z * y, np.zeros_like(y)
        # P = -(v_y mu'_y + v_z mu'_z) + d'_x (v_y z - v_z y), d' = R d, mu' = R mu + t x d'
        self.p_rows = np.stack([
            -v_z * mu_z, -v_z * mu_z, -v_z * d_y, -v_z * d_x, v_z * d_x, -v_z * d_y,
            -v_y * (mu_y + t_z * d_x) + across * d_x,
            -v_y * (mu_x - t_z * d_y) - across * d_y,
            v_y * d_z], axis=1)
        # Q = N (mu'_x - o_y d_z + o_z d'_y) - 2 L (mu'_x + d'_y (z - h))
        on_mu, on_d_y = n - 2.0 * el, n * o_z - 2.0 * el * (z - h)
        self.q_rows = np.stack([
            on_mu * (mu_x - t_z * d_y) + on_d_y * d_y,
            on_mu * (-mu_y - t_z * d_x) + on_d_y * d_x,
            on_mu * d_z,
            -n * o_y * d_z + zero], axis=1)
        if normalised:
            squares = (self.p_rows**2).sum(axis=1) + np.abs(w) * (self.q_rows**2).sum(axis=1)
            self.E = 1.0 / np.sqrt(np.maximum(squares, 1e-300))

        self.dq = np.stack(
            [self.q_rows[:, 0], self.q_rows[:, 1], zero, self.q_rows[:, 2]], axis=1)
        # SLSQP asks for values, gradients and constraints one by one: each place is computed once
        self._p_and_q = lru_cache(maxsize=1)(self._p_and_q_at)
        self._g2 = lru_cache(maxsize=1)(self._g2_at)

    def _p_and_q_at(
        self, c: float, s: float, t_x: float, t_y: float,
    ) -> tuple[Array, Array, Array]:
        """P and Q (M,), and the gradient of P (M, 4)."""
        slopes = np.array([
            [2 * c, 0, 0, 0], [0, 2 * s, 0, 0], [t_x, 0, c, 0], [0, t_x, s, 0],
            [t_y, 0, 0, c], [0, t_y, 0, s], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]])
        p = self.p_rows @ (c * c, s * s, c * t_x, s * t_x, c * t_y, s * t_y, c, s, t_x)
        return p, self.q_rows @ (c, s, t_y, 1.0), self.p_rows @ slopes

    def gamma_r(self, parameters: Array) -> tuple[Array, Array]:
        """gamma_r (M,) (eq. 17, eq. 19) and its gradient by (c, s, t_x, t_y) (M, 4)."""
        p, q, dp = self._p_and_q(*parameters.tolist())
        square = self.E**2
        gamma = square * (p * p + self.W * q * q)
        return gamma, 2.0 * square[:, None] * (p[:, None] * dp + (self.W * q)[:, None] * self.dq)

    def g2(self, parameters: Array) -> tuple[float, Array]:
        """Mean (x - P / Q)^2 (eq. 20) in square metres and its gradient (4,)."""
        return self._g2(*parameters.tolist())

    def _g2_at(self, c: float, s: float, t_x: float, t_y: float) -> tuple[float, Array]:
        p, q, dp = self._p_and_q(c, s, t_x, t_y)
        # a pole of x: kept finite, as far away as it likes
        q = np.where(np.abs(q) > 1e-30, q, 1e-30)
        x = p / q
        off = self.x - x
        slope = (off * x / q) @ self.dq - (off / q) @ dp
        return float(off @ off) / len(off), 2.0 * slope / len(off)


def paper_estimate(
    rig: Rig,
    pixels: ArrayLike,
    directions: ArrayLike,
    moments: ArrayLike,
    start: Pose2,
    *,
    use_g2: bool = True,
    normalised: bool = False,
) -> PaperEstimate:
    """The pose by the paper's problem (eq. 21).

    :param pixels: (M, 2), each on the image of its line.
    :param directions: unit directions of the lines in the map, one row per pixel (M, 3).
    :param moments: their moments (M, 3), metres.
    :param start: first guess of T_map_base; the paper takes the previous frame's pose.
    :param use_g2: whether to demand g_2 = 0.
    :param normalised: divide each point's gamma_r by the size of its coefficients.
    :raises EstimationError: with fewer than three pixels, with a pixel that misses the mirror,
        for a direction that is not of unit length, or for values that are not finite.
    """
    pixels, directions, moments = (
        np.asarray(v, dtype=float) for v in (pixels, directions, moments))
    for name, value, columns in (
            ('pixels', pixels, 2), ('directions', directions, 3), ('moments', moments, 3)):
        if value.ndim != 2 or value.shape != (len(pixels), columns):
            raise EstimationError(
                f'{name} of shape {value.shape}: expected ({len(pixels)}, {columns})')
        if not np.isfinite(value).all():
            raise EstimationError(f'{name} are not all finite')
    if not (np.abs(np.linalg.norm(directions, axis=1) - 1.0) < 1e-6).all():
        raise EstimationError('directions are not all of unit length')
    if len(pixels) < 3:
        raise EstimationError(f'{len(pixels)} pixels cannot fix a pose; at least 3 are needed')
    points, hit = rig.mirror_points(pixels)
    if not hit.all():
        raise EstimationError(f'{int((~hit).sum())} of {len(pixels)} pixels miss the mirror')
    problem = PaperProblem(rig, points, directions, moments, normalised=normalised)
    return _solve(problem, start, use_g2)


def _solve(problem: PaperProblem, start: Pose2, use_g2: bool) -> PaperEstimate:
    first = problem.frame.parameters(start)
    scale = float(np.abs(problem.gamma_r(first)[0]).mean())
    scale = scale if scale > 0.0 else 1.0

    # in units of the start's own violation, as the objective
    unit = max(problem.g2(first)[0], 1e-30)
    best, best_merit = first, math.inf

    def objective(parameters: Array) -> tuple[float, Array]:
        nonlocal best, best_merit
        gamma, slope = problem.gamma_r(parameters)
        value = float(np.abs(gamma).mean()) / scale
        merit = value + abs(_g1(parameters))
        if use_g2:
            merit += problem.g2(parameters)[0] / unit
        if merit < best_merit:
            best, best_merit = parameters.copy(), merit
        return value, np.sign(gamma) @ slope / (len(gamma) * scale)

    constraints = [{
        'type': 'eq', 'fun': _g1, 'jac': lambda v: np.array([2.0 * v[0], 2.0 * v[1], 0.0, 0.0])}]
    if use_g2:
        constraints.append({
            'type': 'eq',
            'fun': lambda v: problem.g2(v)[0] / unit,
            'jac': lambda v: problem.g2(v)[1] / unit})
    result = minimize(
        objective, first, jac=True, method='SLSQP', constraints=constraints,
        options={'maxiter': _MOST_ITERATIONS, 'ftol': 1e-12})
    # Where the constraints cannot be met SLSQP may give back its start: take the best it saw.
    found: Array = result.x if result.success else best
    if not np.isfinite(found).all() or math.hypot(found[0], found[1]) < 1e-12:
        found = first
    c, s, t_x, t_y = found
    return PaperEstimate(
        problem.frame.pose(found), math.atan2(s, c), np.array([t_x, t_y, problem.frame.t_z]),
        _g1(found), problem.g2(found)[0],
        int(result.nit), bool(result.success), str(result.message))


def _g1(parameters: Array) -> float:
    """c^2 + s^2 - 1 (eq. 18)."""
    return float(parameters[0] ** 2 + parameters[1] ** 2 - 1.0)
