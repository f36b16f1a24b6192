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

"""The residual of many pixels, prepared once and evaluated at many poses.

S is linear in the ray (r, w) and in seven monomials of the pose. So are its derivatives by the
pixel and the cosine between ray and line: each is S of another ray. All are rows of one array, and
a pose costs one small matrix product.
"""

from __future__ import annotations

from nccs_pose.estimation.pose_monomials import forms, monomials_and_slopes, with_derivatives
from nccs_pose.geometry.pose import Array
from nccs_pose.geometry.rig import Rays
import numpy as np


class SideForm:
    """Whitened residuals of N rays against N lines, as functions of the pose."""

    def __init__(
        self, rays: Rays, directions: Array, moments: Array, sigma: Array | float,
        sigma_world: float,
    ) -> None:
        """Prepare the rows.

        :param directions: unit directions of the lines in the map (N, 3).
        :param moments: their moments (N, 3), metres.
        :param sigma: standard deviation of the pixels along the curve's normal, px, (N,) or one.
        :param sigma_world: standard deviation of the lines' own position, metres.
        """
        self._in_world = sigma_world > 0.0
        ray = with_derivatives(rays, int(self._in_world))
        ray[:, 1:3] *= sigma
        if self._in_world:
            # S of (0, r) is the cosine between ray and line.
            ray[:3, -1], ray[3:, -1] = 0.0, sigma_world * ray[:3, 0]
        # By monomial (7, K, N): what belongs to one pixel lies apart, and vectors in one piece.
        self._rows = forms(ray, np.concatenate([directions, moments], axis=1))
        self._world_variance = sigma_world**2

    def residual(self, unknowns: Array) -> tuple[Array, Array]:
        """Residuals e (N,) and their Jacobian (N, 3).

        e = S / sqrt(sigma^2 |dS/du|^2 + sigma_w^2 |r x d|^2).

        :param unknowns: (x, y, yaw).
        """
        form = monomials_and_slopes(*unknowns.tolist())
        values = (form @ self._rows.reshape(7, -1)).reshape(4, *self._rows.shape[1:])
        s, gradient = values[:, 0], values[:, 1:3]
        # The variance, and half its slopes by the pose.
        products = gradient * gradient[0]
        variances = products[:, 0] + products[:, 1]
        if self._in_world:
            variances -= values[:, -1] * values[0, -1]
            variances[0] += self._world_variance
        # A ray along the line, or a pixel where nothing changes, has no distance to tell.
        variance = np.maximum(variances[0], 1e-30)
        scale = 1.0 / np.sqrt(variance)
        e = s[0] * scale
        jacobian = s[1:] * scale
        jacobian -= variances[1:] * (e / variance)
        return e, jacobian.T
