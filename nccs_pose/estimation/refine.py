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

"""Robust refinement of a planar pose over the pixels of known lines."""

from __future__ import annotations

from dataclasses import dataclass, replace
import math

from nccs_pose.errors import EstimationError
from nccs_pose.estimation.residual import check_rays_and_lines
from nccs_pose.estimation.side_form import SideForm
from nccs_pose.geometry.pose import Array, Pose2
from nccs_pose.geometry.rig import Rays
import numpy as np
from numpy.typing import NDArray

# Tuning constant of Cauchy's loss for 95 % efficiency under Gaussian noise.
_CAUCHY = 2.385
# Beyond this many robust standard deviations a pixel is no inlier.
_GATE = 3.0
# Where the lines say nothing the pose is still somewhere within 100 m and 10 rad: this keeps
# every covariance finite and positive definite, and is too weak to move any pose.
_VAGUE_INFORMATION = np.diag([1e-4, 1e-4, 1e-2, 0.0, 0.0, 0.0])


@dataclass(frozen=True, eq=False)
class Refinement:
    """A refined pose and what it rests on.

    :ivar pose: T_map_base.
    :ivar covariance: of (x, y, yaw), (3, 3); m^2, m rad, rad^2.
    :ivar information: of the inlying pixels alone (3, 3); singular where they see nothing.
    :ivar attitude: height, roll and pitch off the plane (3,); zero where they were held.
    :ivar residual: whitened residuals at the pose (N,).
    :ivar inlier: which pixels the pose rests on (N,).
    :ivar scale: robust standard deviation of the whitened residuals; 1 when the noise is as told.
    :ivar converged: whether the last step was negligible.
    """

    pose: Pose2
    covariance: Array
    information: Array
    attitude: Array
    residual: Array
    inlier: NDArray[np.bool_]
    scale: float
    converged: bool


@dataclass(frozen=True, eq=False)
class _Problem:
    """Pixels on their lines, and what is known of the unknowns beforehand.

    The unknowns are (x, y, yaw), followed by (z, roll, pitch) where those are free.
    """

    form: SideForm
    expected: Array
    information: Array

    def deviation(self, unknowns: Array) -> Array:
        difference = unknowns - self.expected
        difference[2] = math.remainder(difference[2], 2.0 * math.pi)
        return difference

    def cost(self, e: Array, width: float, unknowns: Array) -> float:
        """Cauchy's loss of the residuals (their squares at infinite width), and the prior."""
        loss = e @ e if np.isinf(width) else width**2 * np.log1p(np.square(e / width)).sum()
        deviation = self.deviation(unknowns)
        return float(loss + deviation @ self.information @ deviation)


def refine(
    rays: Rays,
    directions: Array,
    moments: Array,
    start: Pose2,
    *,
    sigma: Array | float = 1.0,
    sigma_world: float = 0.0,
    prior: tuple[Pose2, Array] | None = None,
    attitude_sigma: tuple[float, float] = (0.0, 0.0),
    calibration_sigma: float = 0.0,
    robust: bool = True,
    noise_known: bool = True,
    max_iterations: int = 30,
) -> Refinement:
    """Minimise the whitened residuals of N rays against the N lines that they should meet.

    Gauss-Newton with Levenberg's damping, first under Cauchy's loss with its scale estimated
    from the residuals, then by least squares over the inliers, from which the covariance comes.

    :param directions: unit directions of the lines in the map (N, 3).
    :param moments: their moments (N, 3), metres.
    :param start: where to begin, T_map_base.
    :param sigma: standard deviation of the pixels along the curve's normal, px.
    :param sigma_world: standard deviation of the lines' own position, metres.
    :param prior: a pose with its covariance (3, 3), weighed in like a measurement.
    :param attitude_sigma: how well the base's height is known to keep its plane, metres, and its
        roll and pitch, rad; what is known to zero is held, the rest is estimated beside the pose.
    :param calibration_sigma: what the calibration may shift the whole image by, px; no number of
        pixels averages it out, so it widens the covariance.
    :param robust: False takes every pixel for an inlier.
    :param noise_known: False takes ``sigma`` for relative and its scale from the residuals.
    :raises EstimationError: with fewer than three rays, a ray that missed the mirror, a line
        direction that is not of unit length, a sigma that is not positive, or a value that is
        not finite.
    """
    sigma = np.broadcast_to(np.asarray(sigma, dtype=float), (len(rays),))
    if len(rays) < 3:
        raise EstimationError(f'{len(rays)} pixels cannot fix a pose; at least 3 are needed')
    check_rays_and_lines(rays, directions, moments, sigma)
    expected, known = _prior(start, prior, attitude_sigma)
    form = SideForm(rays, directions, moments, sigma, sigma_world, len(expected) == 6)
    problem = _Problem(form, expected, known)
    unknowns = np.concatenate([start.as_array(), expected[3:]])
    inlier, scale, converged = np.ones(len(rays), dtype=bool), 1.0, True
    if robust:
        unknowns, e, jacobian, converged = _descend(problem, unknowns, True, max_iterations)
        scale = _robust_scale(e)
        inlier = np.abs(e) <= _GATE * scale
    trusted = problem if inlier.all() else replace(problem, form=form.of(inlier))
    unknowns, e, jacobian, finished = _descend(trusted, unknowns, False, max_iterations)
    if trusted is not problem:
        e, jacobian = form.residual(unknowns)
    normal = jacobian[inlier].T @ jacobian[inlier]
    # Residuals larger than the noise was told to be widen the claim; smaller ones do not
    # narrow it.
    degrees = max(1, int(inlier.sum()) - 3)
    inflation = float(e[inlier] @ e[inlier]) / degrees
    inflation = max(1.0, inflation) if noise_known else max(1e-6, inflation)
    covariance = np.linalg.inv(normal / inflation + known + _vague(len(known)))
    if calibration_sigma > 0.0:
        shift = form.image_shift(unknowns)[inlier]
        answer = covariance @ (jacobian[inlier].T @ shift) * (calibration_sigma / inflation)
        covariance = covariance + answer @ answer.T
    covariance = covariance[:3, :3]
    attitude = unknowns[3:] if len(unknowns) == 6 else np.zeros(3)
    return Refinement(
        Pose2.from_array(unknowns[:3]), 0.5 * (covariance + covariance.T), normal[:3, :3],
        attitude, e, inlier, scale, converged and finished)


def _prior(
    start: Pose2, prior: tuple[Pose2, Array] | None, attitude_sigma: tuple[float, float],
) -> tuple[Array, Array]:
    """Expected unknowns and the information about them, before any pixel is seen."""
    height, tilt = attitude_sigma
    free = height > 0.0 or tilt > 0.0
    expected = np.zeros(6 if free else 3)
    information = np.zeros((len(expected), len(expected)))
    expected[:3] = start.as_array() if prior is None else prior[0].as_array()
    if prior is not None:
        information[:3, :3] = np.linalg.inv(prior[1])
    if free:
        # A tenth of a micrometre and of a microradian stand for 'held'.
        information[3, 3] = 1.0 / max(height, 1e-7) ** 2
        information[4, 4] = information[5, 5] = 1.0 / max(tilt, 1e-7) ** 2
    return expected, information


def _vague(size: int) -> Array:
    return _VAGUE_INFORMATION[:size, :size]


def _robust_scale(e: Array) -> float:
    """Standard deviation of the bulk of whitened residuals, never below the noise told."""
    middle = [(len(e) - 1) // 2, len(e) // 2]
    return max(1.0, 1.4826 * float(np.partition(np.abs(e), middle)[middle].mean()))


def _descend(
    problem: _Problem, unknowns: Array, cauchy: bool, max_iterations: int,
) -> tuple[Array, Array, Array, bool]:
    """Levenberg-Marquardt.

    :returns: where it ends, residuals and their Jacobian there, and whether it converged.
    """
    damping, known = 0.0, problem.information + _vague(len(unknowns))
    e, jacobian = problem.form.residual(unknowns)
    for _ in range(max_iterations):
        width = _CAUCHY * _robust_scale(e) if cauchy else np.inf
        weight = 1.0 / (1.0 + np.square(e / width))
        weighted = jacobian.T * weight
        normal = weighted @ jacobian + known
        slope = weighted @ e + problem.information @ problem.deviation(unknowns)
        damped = normal + damping * np.diag(np.diag(normal)) if damping else normal
        step = -np.linalg.solve(damped, slope)
        trial = unknowns + step
        e_trial, jacobian_trial = problem.form.residual(trial)
        if problem.cost(e_trial, width, trial) <= problem.cost(e, width, unknowns):
            unknowns, e, jacobian = trial, e_trial, jacobian_trial
            damping *= 0.1 if damping > 1e-6 else 0.0
        else:
            damping = max(1e-3, 10.0 * damping)
        # A step far below what the pixels can tell ends the search; the robust stage only has to
        # find the inliers.
        if float(step @ normal @ step) < (1e-2 if cauchy else 1e-7):
            return unknowns, e, jacobian, True
        if damping > 1e8:
            return unknowns, e, jacobian, False
    return unknowns, e, jacobian, False
