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
pixel, by the base's height, roll and pitch, and the cosine between ray and line: each is S of
another ray. All are rows of one array, and a pose costs one small matrix product.
"""

from __future__ import annotations

from nccs_pose.estimation.pose_monomials import monomial_rows, monomials_and_slopes
from nccs_pose.geometry.pose import Array
from nccs_pose.geometry.rig import Rays
import numpy as np


class SideForm:
    """Whitened residuals of N rays against N lines, as functions of pose and attitude."""

    def __init__(
        self, rays: Rays, directions: Array, moments: Array, sigma: Array, sigma_world: float,
        with_attitude: bool,
    ) -> None:
        """Prepare the rows.

        :param directions: unit directions of the lines in the map (N, 3).
        :param moments: their moments (N, 3), metres.
        :param sigma: standard deviation of the pixels along the curve's normal, px (N,).
        :param sigma_world: standard deviation of the lines' own position, metres.
        :param with_attitude: whether height, roll and pitch are unknowns too.
        """
        r, w = rays.direction, rays.moment
        ray = [r, rays.direction_jacobian[:, :, 0], rays.direction_jacobian[:, :, 1]]
        moment = [w, rays.moment_jacobian[:, :, 0], rays.moment_jacobian[:, :, 1]]
        zero = np.zeros(len(r))
        if with_attitude:
            # A base that rises or turns by a little moves its rays: w by e_z x r; r and w by
            # e_x x, and by e_y x.
            ray += [np.zeros_like(r), np.column_stack([zero, -r[:, 2], r[:, 1]]),
                    np.column_stack([r[:, 2], zero, -r[:, 0]])]
            moment += [np.column_stack([-r[:, 1], r[:, 0], zero]),
                       np.column_stack([zero, -w[:, 2], w[:, 1]]),
                       np.column_stack([w[:, 2], zero, -w[:, 0]])]
        if sigma_world > 0.0:
            ray.append(np.zeros_like(r))
            moment.append(r)
        rows = monomial_rows(np.array(ray), np.array(moment), directions, moments)
        # by monomial (7, K, N): what belongs to one pixel lies apart, and vectors in one piece
        self._rows = np.ascontiguousarray(np.moveaxis(rows, 2, 0))
        self._variance = np.square(sigma)
        self._world_variance = sigma_world**2
        self._with_attitude = with_attitude

    def residual(self, unknowns: Array) -> tuple[Array, Array]:
        """Residuals e (N,) and their Jacobian (N, 3), or (N, 6) with the attitude.

        e = S / sqrt(sigma^2 |dS/du|^2 + sigma_w^2 |r x d|^2). The attitude is small: S is taken
        as linear in it, and its effect on the weight is left out.

        :param unknowns: (x, y, yaw), followed by (z, roll, pitch) with the attitude.
        """
        form = monomials_and_slopes(*unknowns[:3].tolist())
        values = (form @ self._rows.reshape(7, -1)).reshape(4, *self._rows.shape[1:])
        s, s_pose = values[0, 0], values[1:, 0]
        g_u, g_v = values[0, 1], values[0, 2]
        variance = self._variance * (g_u * g_u + g_v * g_v)
        half_slope = self._variance * (values[1:, 1] * g_u + values[1:, 2] * g_v)
        if self._world_variance > 0.0:
            cosine = values[0, -1]
            variance = variance + self._world_variance * (1.0 - cosine * cosine)
            half_slope = half_slope - self._world_variance * cosine * values[1:, -1]
        # A ray along the line, or a pixel where nothing changes, has no distance to tell.
        variance = np.maximum(variance, 1e-30)
        scale = 1.0 / np.sqrt(variance)
        if self._with_attitude:
            s = s + unknowns[3:] @ values[0, 3:6]
        jacobian = scale * (s_pose - s / variance * half_slope)
        if self._with_attitude:
            jacobian = np.vstack([jacobian, scale * values[0, 3:6]])
        return s * scale, jacobian.T

    def image_shift(self, unknowns: Array) -> Array:
        """de/d(u, v) (N, 2): what a shift of the whole image does to the residuals."""
        form = monomials_and_slopes(*unknowns[:3].tolist())[0]
        g_u, g_v = form @ self._rows[:, 1], form @ self._rows[:, 2]
        variance = self._variance * (g_u * g_u + g_v * g_v)
        return (np.stack([g_u, g_v]) / np.sqrt(np.maximum(variance, 1e-30))).T

    def of(self, chosen: Array) -> SideForm:
        """The same for some of the pixels."""
        part = object.__new__(SideForm)
        part.__dict__.update(self.__dict__)
        part._rows = np.ascontiguousarray(self._rows[:, :, chosen])
        part._variance = self._variance[chosen]
        return part
