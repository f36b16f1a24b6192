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

"""Refinement for coarse pixels: the distance to the curve in the place of Sampson's.

Sampson's distance S / |dS/d(u, v)| takes the curve, and how fast the ray turns, at the noisy
pixel. With some pixels of noise they are others where the line's image really is. So each pixel
p gets the place u where its line is most likely seen, with g = dS/d(u, v),

    u = p - sigma^2 g S / (sigma^2 |g|^2 + sigma_w^2 |r x d|^2),

and counts by the ray that it has to first order from there, r(u) + dr/du (p - u). One such step
takes the pose from 1.13 to 1.23 times the Cramér-Rao bound, at 10 px of noise, to 1.05 to 1.10.
Below a pixel of noise, where the localiser works, it changes nothing.
"""

from __future__ import annotations

from nccs_pose.estimation.refine import refine, Refinement
from nccs_pose.estimation.residual import lines_in_base, side, side_gradient
from nccs_pose.geometry.pose import Array, Pose2
from nccs_pose.geometry.rig import Rays, Rig
import numpy as np


def refine_in_image(
    rig: Rig,
    pixels: Array,
    directions: Array,
    moments: Array,
    start: Pose2,
    *,
    sigma: float = 1.0,
    sigma_world: float = 0.0,
) -> Refinement:
    """Minimise the distances of N pixels from the images of their lines.

    :param pixels: (N, 2), all of which hit the mirror.
    :param directions: unit directions of the lines in the map (N, 3).
    :param moments: their moments (N, 3), metres.
    :param start: where to begin, T_map_base.
    :param sigma: standard deviation of the pixels in u and in v, px.
    :param sigma_world: standard deviation of the lines' own position, metres.
    :raises EstimationError: as :func:`nccs_pose.estimation.refine.refine` does.
    """
    rays = rig.back_project(pixels)
    refined = refine(rays, directions, moments, start, sigma=sigma, sigma_world=sigma_world)
    places = _likely_places(
        rig, pixels, rays, directions, moments, refined.pose, sigma, sigma_world)
    rays = _to_first_order(rig.back_project(places), pixels - places)
    return refine(rays, directions, moments, refined.pose, sigma=sigma, sigma_world=sigma_world)


def _likely_places(
    rig: Rig, pixels: Array, rays: Rays, directions: Array, moments: Array, pose: Pose2,
    sigma: float, sigma_world: float,
) -> Array:
    """Where (N, 2) the lines are most likely seen, of which the pixels are noisy."""
    g = side_gradient(rays, directions, moments, pose)
    s = side(rays, directions, moments, pose)
    d, _ = lines_in_base(directions, moments, pose)
    across = np.cross(rays.direction, d)
    variance = (sigma**2 * np.einsum('ni,ni->n', g, g)
                + sigma_world**2 * np.einsum('ni,ni->n', across, across))
    moved = pixels - sigma**2 * g * (s / np.maximum(variance, 1e-30))[:, None]
    # a place beside the mirror has no ray
    return np.where(rig.mirror_points(moved)[1][:, None], moved, pixels)


def _to_first_order(rays: Rays, offset: Array) -> Rays:
    """The rays (N,) that pixels at some offset (N, 2) have to first order."""
    return Rays(
        rays.direction + np.einsum('nij,nj->ni', rays.direction_jacobian, offset),
        rays.moment + np.einsum('nij,nj->ni', rays.moment_jacobian, offset),
        rays.direction_jacobian, rays.moment_jacobian, rays.hit)
