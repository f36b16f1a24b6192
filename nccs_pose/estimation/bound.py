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
"""The Cramér-Rao bound: how well any unbiased estimator can know the pose from these pixels.

A pixel of a line tells of the pose by its distance across the line's image only (where along the
line its point lay is unknown, and eliminating it leaves just that), so the information is that of
the whitened residual at the true pose and the pixels without noise.
"""

from __future__ import annotations

from nccs_pose.errors import EstimationError
from nccs_pose.estimation.residual import check_rays_and_lines, whitened_residual
from nccs_pose.geometry.pose import Array, Pose2
from nccs_pose.geometry.rig import Rays
import numpy as np


def cramer_rao_bound(
    rays: Rays,
    directions: Array,
    moments: Array,
    pose: Pose2,
    *,
    sigma: Array | float = 1.0,
    sigma_world: float = 0.0,
) -> Array:
    """Smallest covariance (3, 3) of (x, y, yaw) in m^2, m rad, rad^2.

    :param rays: of the pixels without noise (N,).
    :param directions: unit directions of the lines in the map, one row per ray (N, 3).
    :param moments: their moments (N, 3), metres.
    :param pose: the true T_map_base.
    :param sigma: standard deviation of the pixels, in each of u and v, px.
    :param sigma_world: standard deviation of each coordinate of the world's points, metres.
    :raises EstimationError: if these pixels do not fix the pose at all, and as
        :func:`nccs_pose.estimation.residual.check_rays_and_lines` does.
    """
    sigma = np.broadcast_to(np.asarray(sigma, dtype=float), (len(rays),))
    check_rays_and_lines(rays, directions, moments, sigma)
    _, jacobian = whitened_residual(rays, directions, moments, pose, sigma, sigma_world)
    information = jacobian.T @ jacobian
    values = np.linalg.eigvalsh(information)
    if values[0] <= 1e-12 * values[-1]:
        raise EstimationError(
            f'no bound: {len(rays)} pixels leave a direction of the pose unobserved')
    return np.linalg.inv(information)
