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
from nccs_pose.estimation.robust import CAUCHY, GATE, robust_scale, VAGUE_INFORMATION
from nccs_pose.estimation.side_form import SideForm
from nccs_pose.geometry.pose import Array, Pose2
from nccs_pose.geometry.rig import Rays
from nccs_pose.geometry.small_matrices import inverse, solve_symmetric
import numpy as np
from numpy.typing import NDArray


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


class _Point(NamedTuple):
    """Unknowns (3,), with the residuals (N,) and their Jacobian (N, 3) there."""

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
    robust: bool = True,
    max_iterations: int = 30,
) -> Refinement:
    """Minimise the whitened residuals of N rays against the N lines that they should meet.

    Gauss-Newton with Levenberg's damping, first under Cauchy's loss with its scale estimated
    from the residuals, then by least squares over the inliers, from which the covariance comes.

    :param directions: unit directions of the lines in the map (N, 3).
    :param moments: their moments (N, 3), metres.
    :param start: where to begin, T_map_base.
    :param sigma: standard deviation of the pixels along the curve's normal, px, (N,) or one.
    :param sigma_world: standard deviation of the lines' own position, metres.
    :param robust: False takes every pixel for an inlier.
    :param max_iterations: of the robust stage, and as many of the other.
    :raises EstimationError: with fewer than three rays, a ray that missed the mirror, a line
        direction that is not of unit length, a sigma that is not positive, or a value that is
        not finite.
    """
    sigma = np.asarray(sigma, dtype=float)
    if len(rays) < 3:
        raise EstimationError(f'{len(rays)} pixels cannot fix a pose; at least 3 are needed')
    check_rays_and_lines(rays, directions, moments, sigma)
    form = SideForm(rays, directions, moments, sigma, sigma_world)
    unknowns = start.as_array()
    point, converged = _Point(unknowns, *form.residual(unknowns)), True
    inlier = np.ones(len(rays), dtype=bool)
    if robust:
        point, converged = _descend(form, point, None, max_iterations)
        inlier = np.abs(point.e) <= GATE * robust_scale(point.e)
    count = int(np.count_nonzero(inlier))
    trusted = inlier.astype(float) if count < len(inlier) else 1.0
    point, finished = _descend(form, point, trusted, max_iterations)
    e, jacobian = point.e, point.jacobian
    weighted = jacobian.T * trusted
    normal = weighted @ jacobian
    # Residuals larger than the noise was told to be widen the claim; smaller ones do not
    # narrow it.
    inflation = max(1.0, float(e @ (e * trusted)) / max(1, count - 3))
    covariance = inverse(normal / inflation + VAGUE_INFORMATION)
    return Refinement(
        Pose2.from_array(point.unknowns), 0.5 * (covariance + covariance.T), normal, np.zeros(3),
        e, inlier, converged and finished)


def _descend(
    form: SideForm, point: _Point, trusted: Array | float | None, max_iterations: int,
) -> tuple[_Point, bool]:
    """Levenberg-Marquardt.

    :param trusted: weights of the squares (N,), or one for all; None for Cauchy's loss.
    :returns: where it ends, and whether it converged.
    """
    damping, width = 0.0, math.inf
    for _ in range(max_iterations):
        e, weight = point.e, trusted
        if weight is None:
            width = CAUCHY * robust_scale(e)
            weight = 1.0 / (1.0 + e * e / width**2)
        weighted = point.jacobian.T * weight
        normal = weighted @ point.jacobian + VAGUE_INFORMATION
        damped = normal + damping * np.diag(np.diag(normal)) if damping else normal
        step = solve_symmetric(damped, weighted @ e)
        unknowns = point.unknowns - step
        trial = _Point(unknowns, *form.residual(unknowns))
        if _loss(trial.e, trusted, width) <= _loss(e, trusted, width):
            point = trial
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
