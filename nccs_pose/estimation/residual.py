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

"""The residual S: how far a reflected ray passes from the line that it should meet.

S = r . mu + w . d is the Plücker side operator (reciprocal product) of the reflected ray (r, w)
and the line (d, mu): zero just when they meet. On the mirror the paper's curve is
gamma = E^2 S(x, y, z) S(-x, y, z) (eq. 13 factored), so S keeps the branch that is physical and
drops the mirrored and the spurious one. (There S is that of a ray which is not of unit length and
a line of the other sense: P - x Q = -N |v_i| S, see :mod:`nccs_pose.geometry.reflection_curve`.)
Divided by |dS/d(u, v)| it is the distance in the image, to first order, from the pixel to the
line's reflection curve (Sampson).

Rays are in base_link, lines in the map; the pose is T_map_base.
"""

from __future__ import annotations

from nccs_pose.errors import EstimationError
from nccs_pose.geometry.pose import Array, Pose2
from nccs_pose.geometry.rig import Rays
import numpy as np

_Z = np.array([0.0, 0.0, 1.0])


def check_rays_and_lines(rays: Rays, directions: Array, moments: Array, sigma: Array) -> None:
    """Refuse what no residual can be made of.

    :param directions: of the lines in the map (N, 3).
    :param moments: their moments (N, 3), metres.
    :param sigma: standard deviations of the pixels (N,), px.
    :raises EstimationError: for a ray that missed the mirror, a direction that is not of unit
        length, a sigma that is not positive, or a value that is not finite.
    """
    if not rays.hit.all():
        raise EstimationError(f'{int((~rays.hit).sum())} of {len(rays)} pixels miss the mirror')
    for name, value in (
            ('ray directions', rays.direction), ('ray moments', rays.moment),
            ('derivatives of ray directions', rays.direction_jacobian),
            ('derivatives of ray moments', rays.moment_jacobian),
            ('directions of the lines', directions), ('moments of the lines', moments),
            ('sigma', sigma)):
        if not np.isfinite(value).all():
            raise EstimationError(f'{name}: not all finite')
    if not (sigma > 0.0).all():
        raise EstimationError(f'sigma = {sigma.min()} px: must be positive')
    length2 = np.einsum('ni,ni->n', directions, directions)
    if not (np.abs(length2 - 1.0) < 1e-6).all():
        raise EstimationError('directions of the lines: not all of unit length')


def lines_in_base(directions: Array, moments: Array, pose: Pose2) -> tuple[Array, Array]:
    """Plücker coordinates in base_link of map lines (N, 3), (N, 3).

    d' = R^T d and mu' = R^T (mu - p x d), with R and p of T_map_base: the paper's eq. 16, whose
    (R, t) is the inverse motion.
    """
    rotation = pose.rotation
    return directions @ rotation, (moments - np.cross(pose.translation, directions)) @ rotation


def side(rays: Rays, directions: Array, moments: Array, pose: Pose2) -> Array:
    """S (N,) in metres of N rays against the N lines that they should meet.

    :param directions: unit directions of the lines in the map (N, 3).
    :param moments: their moments (N, 3), metres.
    """
    d, mu = lines_in_base(directions, moments, pose)
    return np.einsum('ni,ni->n', rays.direction, mu) + np.einsum('ni,ni->n', rays.moment, d)


def whitened_residual(
    rays: Rays,
    directions: Array,
    moments: Array,
    pose: Pose2,
    sigma: Array | float = 1.0,
    sigma_world: float = 0.0,
) -> tuple[Array, Array]:
    """Residuals e = S / sqrt(sigma^2 |dS/du|^2 + sigma_w^2 |r x d|^2) and their Jacobian.

    With ``sigma`` = 1 px and no world noise, e is the Sampson distance in pixels.

    :param sigma: standard deviation of the pixels along the curve's normal, px, (N,) or one.
    :param sigma_world: standard deviation of the lines' own position across themselves, metres.
    :returns: e (N,), no unit, and de/d(x, y, yaw) (N, 3), exact.
    """
    rotation = pose.rotation
    d, mu = lines_in_base(directions, moments, pose)
    # d and mu turn with the pose: d(R^T a)/dyaw = -z x (R^T a), dmu'/dp = R^T (d x e).
    d_yaw = -np.cross(_Z, d)
    mu_yaw = -np.cross(_Z, mu)
    mu_x = np.cross(d, rotation[0])
    mu_y = np.cross(d, rotation[1])

    r, w, dr, dw = rays.direction, rays.moment, rays.direction_jacobian, rays.moment_jacobian
    s = _dot(r, mu) + _dot(w, d)
    gradient = _pull(dr, mu) + _pull(dw, d)
    s_pose = np.stack([_dot(r, mu_x), _dot(r, mu_y), _dot(r, mu_yaw) + _dot(w, d_yaw)], axis=1)
    gradient_pose = np.stack(
        [_pull(dr, mu_x), _pull(dr, mu_y), _pull(dr, mu_yaw) + _pull(dw, d_yaw)], axis=1)

    sigma2 = np.asarray(sigma, dtype=float) ** 2
    variance = sigma2 * _dot(gradient, gradient)
    half_slope = np.reshape(sigma2, (-1, 1)) * np.einsum('nkj,nj->nk', gradient_pose, gradient)
    if sigma_world > 0.0:
        cosine = _dot(r, d)
        variance = variance + sigma_world**2 * (1.0 - cosine**2)
        half_slope[:, 2] -= sigma_world**2 * cosine * _dot(r, d_yaw)
    # A ray along the line, or a pixel where nothing changes, has no distance to tell.
    variance = np.maximum(variance, 1e-30)
    scale = 1.0 / np.sqrt(variance)
    e = s * scale
    jacobian = scale[:, None] * (s_pose - (s / variance)[:, None] * half_slope)
    return e, jacobian


def _dot(a: Array, b: Array) -> Array:
    return np.einsum('ni,ni->n', a, b)


def _pull(jacobian: Array, vector: Array) -> Array:
    """Derivative (N, 2) by the pixel of a product with a ray's component."""
    return np.einsum('nij,ni->nj', jacobian, vector)
