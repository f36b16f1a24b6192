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

from nccs_pose.estimation.labelled_rays import into_base
from nccs_pose.estimation.pose_monomials import with_derivatives
from nccs_pose.estimation.refine import refine, Refinement
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
    rays: Rays | None = None,
    sigma: float = 1.0,
    sigma_world: float = 0.0,
) -> Refinement:
    """Minimise the distances of N pixels from the images of their lines.

    :param pixels: (N, 2), all of which hit the mirror.
    :param directions: unit directions of the lines in the map (N, 3).
    :param moments: their moments (N, 3), metres.
    :param start: where to begin, T_map_base.
    :param rays: those of the pixels, where they are at hand.
    :param sigma: standard deviation of the pixels in u and in v, px.
    :param sigma_world: standard deviation of the lines' own position, metres.
    :raises EstimationError: as :func:`nccs_pose.estimation.refine.refine` does.
    """
    if rays is None:
        rays = rig.back_project(pixels)
    refined = refine(rays, directions, moments, start, sigma=sigma, sigma_world=sigma_world)
    lines = into_base(refined.pose) @ np.concatenate([directions, moments], axis=1).T
    places = pixels - _offsets(rays, lines, sigma, sigma_world)
    rays = _to_first_order(rig.back_project(places), pixels - places, rays)
    return refine(rays, directions, moments, refined.pose, sigma=sigma, sigma_world=sigma_world)


def _offsets(rays: Rays, lines: Array, sigma: float, sigma_world: float) -> Array:
    """How far (N, 2) the pixels are from where their lines are most likely seen.

    :param lines: (d, mu) in base_link, one for each ray (6, N).
    """
    # S of a ray is r mu + w d; that of its derivatives is the gradient of S.
    coordinates = with_derivatives(rays)
    s, *gradient = (coordinates * np.roll(lines, 3, axis=0)[:, None]).sum(axis=0)
    g = np.array(gradient)
    variance = sigma**2 * (g * g).sum(axis=0)
    if sigma_world > 0.0:
        cosine = (coordinates[:3, 0] * lines[:3]).sum(axis=0)
        variance += sigma_world**2 * (1.0 - cosine * cosine)
    return (g * (sigma**2 * s / np.maximum(variance, 1e-30))).T


def _to_first_order(rays: Rays, offset: Array, otherwise: Rays) -> Rays:
    """The rays (N,) that pixels at some offset (N, 2) have to first order.

    :param otherwise: their own rays, for where there is none to begin with.
    """
    direction, moment = (
        value + jacobian[..., 0] * offset[:, :1] + jacobian[..., 1] * offset[:, 1:]
        for value, jacobian in (
            (rays.direction, rays.direction_jacobian), (rays.moment, rays.moment_jacobian)))
    found = direction, moment, rays.direction_jacobian, rays.moment_jacobian
    if not rays.hit.all():
        # A place beside the mirror has no ray.
        own = (otherwise.direction, otherwise.moment, otherwise.direction_jacobian,
               otherwise.moment_jacobian)
        for array, instead in zip(found, own):
            array[~rays.hit] = instead[~rays.hit]
    return Rays(*found, otherwise.hit)
