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

from dataclasses import dataclass
import math
from typing import NamedTuple

from nccs_pose.errors import EstimationError
from nccs_pose.estimation.residual import check_rays_and_lines
from nccs_pose.estimation.side_form import SideForm
from nccs_pose.geometry.pose import Array, Pose2
from nccs_pose.geometry.rig import Rays
from nccs_pose.geometry.small_matrices import inverse, solution
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
    :ivar converged: whether the last step was negligible.
    """

    pose: Pose2
    covariance: Array
    information: Array
    attitude: Array
    residual: Array
    inlier: NDArray[np.bool_]
    converged: bool


@dataclass(frozen=True, eq=False)
class _Problem:
    """Pixels on their lines, and what is known of the unknowns beforehand.

    The unknowns are (x, y, yaw), followed by (z, roll, pitch) where those are free.

    :ivar information: about them; None where nothing is known.
    """

    form: SideForm
    expected: Array
    information: Array | None

    def pull(self, unknowns: Array) -> tuple[float, Array | float]:
        """Cost of the deviation from what is known, and half its slope."""
        if self.information is None:
            return 0.0, 0.0
        deviation = unknowns - self.expected
        deviation[2] = math.remainder(deviation[2], 2.0 * math.pi)
        slope = self.information @ deviation
        return float(deviation @ slope), slope


class _Point(NamedTuple):
    """Unknowns, with the residuals (N,) and their Jacobian (N, P) there."""

    unknowns: Array
    e: Array
    jacobian: Array


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
    sigma = np.asarray(sigma, dtype=float)
    if len(rays) < 3:
        raise EstimationError(f'{len(rays)} pixels cannot fix a pose; at least 3 are needed')
    check_rays_and_lines(rays, directions, moments, sigma)
    expected, information = _prior(start, prior, attitude_sigma)
    form = SideForm(rays, directions, moments, sigma, sigma_world, len(expected) == 6)
    problem = _Problem(form, expected, information)
    known = _VAGUE_INFORMATION[:len(expected), :len(expected)]
    if information is not None:
        known = information + known
    unknowns = np.concatenate([start.as_array(), expected[3:]])
    point, converged = _Point(unknowns, *form.residual(unknowns)), True
    inlier = np.ones(len(rays), dtype=bool)
    if robust:
        point, converged = _descend(problem, known, point, None, max_iterations)
        inlier = np.abs(point.e) <= _GATE * _robust_scale(point.e)
    count = int(np.count_nonzero(inlier))
    trusted = inlier.astype(float) if count < len(inlier) else 1.0
    point, finished = _descend(problem, known, point, trusted, max_iterations)
    e, jacobian = point.e, point.jacobian
    weighted = jacobian.T * trusted
    normal = weighted @ jacobian
    # Residuals larger than the noise was told to be widen the claim; smaller ones do not
    # narrow it.
    inflation = float(e @ (e * trusted)) / max(1, count - 3)
    inflation = max(1.0, inflation) if noise_known else max(1e-6, inflation)
    covariance = inverse(normal / inflation + known)
    if calibration_sigma > 0.0:
        shift = form.image_shift(point.unknowns)
        answer = covariance @ (weighted @ shift) * (calibration_sigma / inflation)
        covariance = covariance + answer @ answer.T
    covariance = covariance[:3, :3]
    attitude = point.unknowns[3:] if len(expected) == 6 else np.zeros(3)
    return Refinement(
        Pose2.from_array(point.unknowns[:3]), 0.5 * (covariance + covariance.T), normal[:3, :3],
        attitude, e, inlier, converged and finished)


def _prior(
    start: Pose2, prior: tuple[Pose2, Array] | None, attitude_sigma: tuple[float, float],
) -> tuple[Array, Array | None]:
    """Expected unknowns and the information about them, if any, before any pixel is seen."""
    height, tilt = attitude_sigma
    free = height > 0.0 or tilt > 0.0
    expected = np.zeros(6 if free else 3)
    expected[:3] = start.as_array() if prior is None else prior[0].as_array()
    if prior is None and not free:
        return expected, None
    information = np.zeros((len(expected), len(expected)))
    if prior is not None:
        information[:3, :3] = np.linalg.inv(prior[1])
    if free:
        # A tenth of a micrometre and of a microradian stand for 'held'.
        information[3, 3] = 1.0 / max(height, 1e-7) ** 2
        information[4, 4] = information[5, 5] = 1.0 / max(tilt, 1e-7) ** 2
    return expected, information


def _robust_scale(e: Array) -> float:
    """Standard deviation of the bulk of whitened residuals, never below the noise told."""
    size, low, high = np.abs(e), (len(e) - 1) // 2, len(e) // 2
    size.partition([low, high])
    return max(1.0, 1.4826 * 0.5 * float(size[low] + size[high]))


def _descend(
    problem: _Problem, known: Array, point: _Point, trusted: Array | float | None,
    max_iterations: int,
) -> tuple[_Point, bool]:
    """Levenberg-Marquardt.

    :param known: what makes the normal equations regular (P, P).
    :param trusted: weights of the squares (N,), or one for all; None for Cauchy's loss.
    :returns: where it ends, and whether it converged.
    """
    damping, width = 0.0, math.inf
    pull, pull_slope = problem.pull(point.unknowns)
    for _ in range(max_iterations):
        e, weight = point.e, trusted
        if weight is None:
            width = _CAUCHY * _robust_scale(e)
            weight = 1.0 / (1.0 + e * e / width**2)
        weighted = point.jacobian.T * weight
        normal = weighted @ point.jacobian + known
        damped = normal + damping * np.diag(np.diag(normal)) if damping else normal
        step = solution(damped, weighted @ e + pull_slope)
        unknowns = point.unknowns - step
        trial = _Point(unknowns, *problem.form.residual(unknowns))
        pull_there, slope_there = problem.pull(unknowns)
        if _loss(trial.e, trusted, width) + pull_there <= _loss(e, trusted, width) + pull:
            point, pull, pull_slope = trial, pull_there, slope_there
            damping *= 0.1 if damping > 1e-6 else 0.0
        else:
            damping = max(1e-3, 10.0 * damping)
        # A step far below what the pixels can tell ends the search; the robust stage only has to
        # find the inliers.
        if float(step @ normal @ step) < (1e-2 if trusted is None else 1e-7):
            return point, True
        if damping > 1e8:
            return point, False
    return point, False


def _loss(e: Array, trusted: Array | float | None, width: float) -> float:
    """Sum of the residuals' trusted squares, or of Cauchy's loss of this width."""
    if trusted is None:
        return width**2 * float(np.log1p(e * e / width**2).sum())
    return float(e @ (e * trusted))
