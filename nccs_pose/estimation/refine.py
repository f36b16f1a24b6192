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

import numpy as np
from numpy.typing import NDArray

from nccs_pose.errors import EstimationError
from nccs_pose.estimation.residual import whitened_residual
from nccs_pose.geometry.pose import Array, Pose2, wrap_angle
from nccs_pose.geometry.rig import Rays

# Tuning constant of Cauchy's loss for 95 % efficiency under Gaussian noise.
_CAUCHY = 2.385
# Beyond this many robust standard deviations a pixel is no inlier.
_GATE = 3.0
# Where the lines say nothing the pose is still somewhere within 100 m and 10 rad: this keeps
# every covariance finite and positive definite, and is too weak to move any pose.
_VAGUE_INFORMATION = np.diag([1e-4, 1e-4, 1e-2])


@dataclass(frozen=True, eq=False)
class Refinement:
    """A refined pose and what it rests on.

    :ivar pose: T_map_base.
    :ivar covariance: of (x, y, yaw), (3, 3); m^2, m rad, rad^2.
    :ivar information: of the inlying pixels alone (3, 3); singular where they see nothing.
    :ivar residual: whitened residuals at the pose (N,).
    :ivar inlier: which pixels the pose rests on (N,).
    :ivar scale: robust standard deviation of the whitened residuals; 1 when the noise is as told.
    :ivar converged: whether the last step was negligible.
    """

    pose: Pose2
    covariance: Array
    information: Array
    residual: Array
    inlier: NDArray[np.bool_]
    scale: float
    converged: bool


def refine(
    rays: Rays,
    directions: Array,
    moments: Array,
    start: Pose2,
    *,
    sigma: Array | float = 1.0,
    sigma_world: float = 0.0,
    prior: tuple[Pose2, Array] | None = None,
    robust: bool = True,
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
    :param robust: False takes every pixel for an inlier.
    :raises EstimationError: with fewer than three rays, or a ray that missed the mirror.
    """
    if len(rays) < 3:
        raise EstimationError(f'{len(rays)} pixels cannot fix a pose; at least 3 are needed')
    if not rays.hit.all():
        raise EstimationError(f'{int((~rays.hit).sum())} of {len(rays)} pixels miss the mirror')
    sigma = np.broadcast_to(np.asarray(sigma, dtype=float), (len(rays),))
    everything = np.ones(len(rays), dtype=bool)
    data = (rays, directions, moments, sigma, sigma_world)
    pose, converged = start, True
    inlier, scale = everything, 1.0
    if robust:
        pose, converged = _descend(data, pose, prior, everything, True, max_iterations)
        e, _ = whitened_residual(rays, directions, moments, pose, sigma, sigma_world)
        scale = _robust_scale(e)
        inlier = np.abs(e) <= _GATE * scale
    pose, finished = _descend(data, pose, prior, inlier, False, max_iterations)
    e, jacobian = whitened_residual(rays, directions, moments, pose, sigma, sigma_world)
    information = jacobian[inlier].T @ jacobian[inlier]
    # Residuals larger than the noise was told to be widen the claim; smaller ones do not
    # narrow it.
    degrees = max(1, int(inlier.sum()) - 3)
    inflation = max(1.0, float(e[inlier] @ e[inlier]) / degrees)
    total = information / inflation + _prior_terms(prior, pose)[0] + _VAGUE_INFORMATION
    covariance = np.linalg.inv(total)
    return Refinement(
        pose, 0.5 * (covariance + covariance.T), information, e, inlier, scale,
        converged and finished)


def _robust_scale(e: Array) -> float:
    """Standard deviation of the bulk of whitened residuals, never below the noise told."""
    return max(1.0, 1.4826 * float(np.median(np.abs(e))))


def _prior_terms(prior: tuple[Pose2, Array] | None, pose: Pose2) -> tuple[Array, Array]:
    """Information (3, 3) of the prior and its weighted deviation (3,) at a pose."""
    if prior is None:
        return np.zeros((3, 3)), np.zeros(3)
    deviation = pose.as_array() - prior[0].as_array()
    deviation[2] = wrap_angle(deviation[2])
    information = np.linalg.inv(prior[1])
    return information, information @ deviation


def _descend(
    data: tuple[Rays, Array, Array, Array, float],
    pose: Pose2,
    prior: tuple[Pose2, Array] | None,
    inlier: NDArray[np.bool_],
    cauchy: bool,
    max_iterations: int,
) -> tuple[Pose2, bool]:
    """Levenberg-Marquardt from a pose; returns where it ends and whether it converged."""
    if not inlier.all():
        rays, directions, moments, sigma, sigma_world = data
        data = (rays[inlier], directions[inlier], moments[inlier], sigma[inlier], sigma_world)
    damping = 0.0
    e, jacobian = whitened_residual(*data[:3], pose, *data[3:])
    for _ in range(max_iterations):
        width = _CAUCHY * _robust_scale(e) if cauchy else np.inf
        weight = 1.0 / (1.0 + (e / width) ** 2)
        information, pull = _prior_terms(prior, pose)
        normal = (jacobian * weight[:, None]).T @ jacobian + information + _VAGUE_INFORMATION
        slope = jacobian.T @ (weight * e) + pull
        step = -np.linalg.solve(normal + damping * np.diag(np.diag(normal)), slope)
        trial = Pose2.from_array(pose.as_array() + step)
        e_trial, jacobian_trial = whitened_residual(*data[:3], trial, *data[3:])
        if _cost(e_trial, width, prior, trial) <= _cost(e, width, prior, pose):
            pose, e, jacobian = trial, e_trial, jacobian_trial
            damping *= 0.1 if damping > 1e-6 else 0.0
        else:
            damping = max(1e-3, 10.0 * damping)
        # A step far below what the pixels can tell ends the search.
        if float(step @ normal @ step) < 1e-10:
            return pose, True
        if damping > 1e8:
            return pose, False
    return pose, False


def _cost(e: Array, width: float, prior: tuple[Pose2, Array] | None, pose: Pose2) -> float:
    """Cauchy's loss of the residuals, or their squares for an infinite width, and the prior."""
    loss = e @ e if np.isinf(width) else width**2 * np.log1p((e / width) ** 2).sum()
    if prior is None:
        return float(loss)
    deviation = pose.as_array() - prior[0].as_array()
    deviation[2] = wrap_angle(deviation[2])
    return float(loss + deviation @ _prior_terms(prior, pose)[1])
