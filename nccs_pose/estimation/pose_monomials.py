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

so that the squares of S over any number of pixels are one 7 x 7 Gram matrix, by rows and columns
of (c, s, x, y, p, q, 1). Horizontal lines have no p, q; vertical lines have no x, y. Everything
here works on sums of squares of that form.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

from nccs_pose.geometry.pose import Array, Pose2
from nccs_pose.geometry.rig import Rays
import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Minimum:
    """A local minimum of a weighted sum of squares of S.

    :ivar pose: T_map_base.
    :ivar cost: the sum there, as the Gram matrix gives it (it may round to below zero).
    """

    pose: Pose2
    cost: float


def _per_line() -> Array:
    """What S needs of a line, as a matrix (14, 6) on (d, mu): see :func:`forms`."""
    d_x, d_y, d_z, mu_x, mu_y, mu_z = np.eye(6)
    return np.array([
        mu_x, mu_y, mu_z, d_x, d_y, d_z, mu_y, -mu_x, d_y, -d_x, -d_y, d_x, d_z, -d_z])


_PER_LINE = _per_line()


def forms(rays: Array, lines: Array, index: NDArray[np.intp] | None = None) -> Array:
    """Coefficients of S (7, K, N) of K times N rays, each N against their lines.

    They are linear in the ray: with its derivative by the pixel in its place they are those of
    the derivative of S.

    :param rays: (r, w) of each ray, or of what stands in its place (6, K, N); w in metres.
    :param lines: (d, mu) in the map (L, 6), with unit directions d; mu in metres.
    :param index: the line of each ray (N,); None where there is a line for each, in order.
    """
    per_line = _PER_LINE @ lines.T
    line = (per_line if index is None else per_line.take(index, axis=1))[:, None]
    rows = np.empty((7, *rays.shape[1:]))
    # r mu + w d, component by component: x and y belong to c, z to 1.
    product = rays * line[:6]
    product[:3] += product[3:]
    np.add(product[0], product[1], out=rows[0])
    rows[6] = product[2]
    across = rays.reshape(2, 3, *rays.shape[1:])[:, :2] * line[6:10].reshape(2, 2, 1, -1)
    across[0] += across[1]
    np.add(across[0, 0], across[0, 1], out=rows[1])
    np.multiply(rays[2], line[10:12], out=rows[2:4])
    np.multiply(rays[1::-1], line[12:], out=rows[4:6])
    return rows


def monomial_rows(ray: Array, ray_moment: Array, directions: Array, moments: Array) -> Array:
    """The same as rows: coefficients of S (N, 7) of N rays against N lines.

    :param ray: directions r (N, 3), or their derivatives (2, N, 3).
    :param ray_moment: moments w (N, 3), metres, or their derivatives (2, N, 3).
    :param directions: unit directions of the lines in the map (N, 3).
    :param moments: their moments (N, 3), metres.
    """
    rays = np.concatenate([ray, ray_moment], axis=-1).T
    columns = rays.reshape(6, len(directions), -1).transpose(0, 2, 1)
    rows = forms(columns, np.concatenate([directions, moments], axis=1))
    return rows[:, 0].T if ray.ndim == 2 else rows.transpose(1, 2, 0)


def with_derivatives(rays: Rays, more: int = 0) -> Array:
    """(r, w) of N rays and its derivatives by u and v, (6, 3 + more, N).

    :param more: places behind those that are left to be filled.
    """
    coordinates = np.empty((6, 3 + more, len(rays)))
    coordinates[:3, 0] = rays.direction.T
    coordinates[3:, 0] = rays.moment.T
    coordinates[:3, 1:3] = rays.direction_jacobian.transpose(1, 2, 0)
    coordinates[3:, 1:3] = rays.moment_jacobian.transpose(1, 2, 0)
    return coordinates


def gram(rows: Array, weights: Array | float) -> Array:
    """Gram matrix (7, 7) of rows (7, N) with a weight each (N,), or one for all."""
    return (rows * weights) @ rows.T


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
