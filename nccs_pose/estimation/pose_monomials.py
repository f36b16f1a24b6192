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

"""S as a linear form in seven monomials of the planar pose.

With T_map_base = (x, y, yaw), c = cos yaw, s = sin yaw and (p, q) = R^T (x, y), the position
seen from base_link, the side operator of a reflected ray (r, w) and a line (d, mu) is

    S =   c [r_x mu_x + r_y mu_y + w_x d_x + w_y d_y]
        + s [r_x mu_y - r_y mu_x + w_x d_y - w_y d_x]
        - x r_z d_y + y r_z d_x  +  p r_y d_z - q r_x d_z  +  r_z mu_z + w_z d_z

so that the squares of S over any number of pixels are one 7 x 7 Gram matrix. Horizontal lines
have no p, q; vertical lines have no x, y. Everything here works on sums of squares of that form.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

from nccs_pose.geometry.pose import Array, Pose2
import numpy as np

# Rows and columns of the Gram matrix.
MONOMIALS = ('c', 's', 'x', 'y', 'p', 'q', '1')


@dataclass(frozen=True)
class Minimum:
    """A local minimum of a weighted sum of squares of S.

    :ivar pose: T_map_base.
    :ivar cost: the sum there, as the Gram matrix gives it (it may round to below zero).
    """

    pose: Pose2
    cost: float


def monomial_rows(ray: Array, ray_moment: Array, directions: Array, moments: Array) -> Array:
    """Coefficients of S (N, 7) of N rays against the N lines that they should meet.

    They are linear in the ray: with its derivatives by the pixel in its place they are those of
    the derivatives of S, (2, N, 7).

    :param ray: directions r (N, 3), or their derivatives (2, N, 3).
    :param ray_moment: moments w (N, 3), metres, or their derivatives (2, N, 3).
    :param directions: unit directions of the lines in the map (N, 3).
    :param moments: their moments (N, 3), metres.
    """
    rx, ry, rz = ray[..., 0], ray[..., 1], ray[..., 2]
    wx, wy, wz = ray_moment[..., 0], ray_moment[..., 1], ray_moment[..., 2]
    dx, dy, dz = directions.T
    mx, my, mz = moments.T
    rows = np.empty((7, *rx.shape))
    rows[0] = rx * mx + ry * my + wx * dx + wy * dy
    rows[1] = rx * my - ry * mx + wx * dy - wy * dx
    rows[2] = -rz * dy
    rows[3] = rz * dx
    rows[4] = ry * dz
    rows[5] = -rx * dz
    rows[6] = rz * mz + wz * dz
    return rows.T if rows.ndim == 2 else rows.transpose(1, 2, 0)


def gram(rows: Array, weights: Array) -> Array:
    """Gram matrix (7, 7) of rows (N, 7) with a weight each (N,)."""
    return (rows * weights[:, None]).T @ rows


def monomials(pose: Pose2) -> Array:
    """The monomials (7,) of a pose."""
    return monomials_and_slopes(pose.x, pose.y, pose.yaw)[0]


def monomials_jacobian(pose: Pose2) -> Array:
    """Their derivatives by (x, y, yaw), (7, 3)."""
    return monomials_and_slopes(pose.x, pose.y, pose.yaw)[1:].T


def monomials_and_slopes(x: float, y: float, yaw: float) -> Array:
    """The monomials of a pose, and below them their derivatives by x, y and yaw, (4, 7)."""
    c, s = math.cos(yaw), math.sin(yaw)
    p, q = c * x + s * y, c * y - s * x
    return np.array([
        [c, s, x, y, p, q, 1.0], [0.0, 0.0, 1.0, 0.0, c, -s, 0.0],
        [0.0, 0.0, 0.0, 1.0, s, c, 0.0], [-s, c, 0.0, 0.0, q, -p, 0.0]])


def feet_in_plan(directions: Array, moments: Array) -> Array:
    """Points d x mu of lines (L, 3) nearest to the origin, without their height, (L, 2)."""
    dx, dy, dz = directions.T
    mx, my, mz = moments.T
    return np.array([dy * mz - dz * my, dz * mx - dx * mz]).T
