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

"""A first guess of the camera's place from the mirror's outline in the image.

The rim is a circle of known radius: its image's cone of rays, v^T Q v = 0, gives the circle's
place and the direction of its axis, up to one choice of two (Chen, Wu and Wada, ECCV 2004). A
mirror that hides its own rim shows its occluding contour instead; for a sphere that is a circular
cone, which gives the centre, and the turn about the centre is held by the rough rig.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from nccs_pose.calibration.options import CalibrationOptions
from nccs_pose.errors import CalibrationError, GeometryError
from nccs_pose.geometry.pose import Array, rotation_exp
from nccs_pose.geometry.rig import Rig
import numpy as np

_POINTS = 240  # of an outline
_SPREADS = 3.0  # how many standard deviations off the rough rig may be


@dataclass(frozen=True, eq=False)
class Circle:
    """A circle in the optical frame: centre (3,) in metres, unit axis (3,) towards the camera."""

    centre: Array
    axis: Array


def circle_poses(directions: Array, radius: float) -> tuple[Circle, Circle]:
    """The two circles of that radius (m) whose points are seen in directions (N, 3).

    :raises CalibrationError: if the directions lie on no elliptic cone.
    """
    plane = directions[:, :2] / directions[:, 2:]
    # Centred and scaled, the normal equations of the conic are well conditioned.
    middle = plane.mean(axis=0)
    size = float(np.sqrt(np.mean((plane - middle) ** 2)))
    x, y = ((plane - middle) / size).T
    rows = np.stack([x * x, 2 * x * y, y * y, 2 * x, 2 * y, np.ones_like(x)], axis=1)
    a, b, c, d, e, f = np.linalg.svd(rows, full_matrices=False)[2][-1]
    unshift = np.array([
        [1.0 / size, 0.0, -middle[0] / size], [0.0, 1.0 / size, -middle[1] / size],
        [0.0, 0.0, 1.0]])
    cone = unshift.T @ np.array([[a, b, d], [b, c, e], [d, e, f]]) @ unshift
    values, vectors = np.linalg.eigh(cone)
    if np.sum(values > 0.0) == 1:
        values, vectors = -values[::-1], vectors[:, ::-1]
    if not (values[0] < 0.0 < values[1]):
        raise CalibrationError("the mirror's outline is no ellipse")
    l3, l2, l1 = values
    vectors = vectors[:, ::-1]  # to the order l1 >= l2 > 0 > l3
    lean = np.sqrt((l1 - l2) / (l1 - l3))
    upright = np.sqrt((l2 - l3) / (l1 - l3))
    distance = l2 * radius / np.sqrt(-l1 * l3)
    found = []
    for sign in (1.0, -1.0):
        axis = vectors @ np.array([sign * lean, 0.0, -upright])
        centre = distance * vectors @ np.array([
            sign * l3 / l2 * lean, 0.0, -l1 / l2 * upright])
        centre = centre if centre[2] > 0.0 else -centre
        found.append(Circle(centre, axis if axis @ centre < 0.0 else -axis))
    return found[0], found[1]


def rig_from_outline(
    rig: Rig, pixels: Array, options: CalibrationOptions | None = None,
) -> Rig:
    """The rough rig with its camera placed by pixels (N, 2) on the mirror's outline.

    Of two possible rigs, the one whose camera looks more like the rough one's.

    :param options: how rough the rig is.
    :raises CalibrationError: if the rim's radius is not known, or the outline is not the rim
        and the mirror no sphere, or no such rig can be, or it is too far from the rough one.
    """
    options = options or CalibrationOptions()
    if rig.mirror.rim_radius is None:
        raise CalibrationError('the mirror has no rim_radius: the image cannot tell its distance')
    if len(pixels) < 6:
        raise CalibrationError(f"{len(pixels)} points of the mirror's outline are too few")
    directions = rig.camera.directions(pixels)
    if rim_is_seen(rig):
        found = [_placed(rig, circle) for circle in circle_poses(
            directions, rig.mirror.rim_radius)]
        possible = [r for r in found if r is not None]
    elif rig.mirror.kind == 'sphere':
        placed = _placed_sphere(rig, directions)
        possible = [placed] if placed is not None else []
    else:
        raise CalibrationError(
            f'the {rig.mirror.kind} hides its own rim from this camera: its outline is no circle '
            'of the rim')
    if not possible:
        raise CalibrationError("the mirror's outline puts the camera where it cannot be")
    found_rig = min(possible, key=lambda r: _turn(r.R_mirror_camera @ rig.R_mirror_camera.T))
    _demand_near(found_rig, rig, options)
    return found_rig


def _demand_near(found: Rig, rough: Rig, options: CalibrationOptions) -> None:
    """Refuse a rig whose mirror stands, seen from the camera, where the rough one cannot."""
    apex = np.array([0.0, 0.0, rough.mirror.apex_z])
    there, here = (r.R_mirror_camera.T @ (apex - r.cop) for r in (found, rough))
    off = float(np.linalg.norm(there - here))
    most = _SPREADS * float(np.hypot(
        options.rough_cop, np.linalg.norm(here) * options.rough_camera_tilt))
    if off > most:
        raise CalibrationError(
            f"the ellipse that was found puts the mirror {1e3 * off:.1f} mm from where the rough "
            f"rig has it (allowed: {1e3 * most:.1f} mm); it is not the mirror's outline, or the "
            'rough rig or rim_radius is wrong')


def rim_points(rig: Rig, count: int = _POINTS) -> Array:
    """Points (N, 3) of the rim in the mirror frame."""
    rim, mirror = rig.mirror.rim_radius, rig.mirror
    if rim is None:
        raise CalibrationError('the mirror has no rim_radius')
    angle = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    return np.stack(
        [rim * np.cos(angle), rim * np.sin(angle), np.full(count, mirror.z_min)], axis=1)


def rim_is_seen(rig: Rig) -> bool:
    """Whether the rim is in front of the mirror's own curve, under a rig that may be rough."""
    points = rim_points(rig)
    facing = np.einsum('ni,ni->n', rig.mirror.normal(points), rig.cop - points)
    return bool((facing > 0.0).mean() > 0.8)


def outline_points(rig: Rig, count: int = _POINTS) -> Array:
    """Pixels (N, 2) of the outline: the rim, or a sphere's occluding contour."""
    if rim_is_seen(rig):
        points = rim_points(rig, count)
    elif rig.mirror.kind == 'sphere':
        centre = np.array([0.0, 0.0, rig.mirror.centre_z])
        to_camera = rig.cop - centre
        distance = float(np.linalg.norm(to_camera))
        squared = rig.mirror.squared_radius
        along = to_camera / distance
        across = np.linalg.svd(along[None])[2][1:]
        radius = np.sqrt(squared * (1.0 - squared / distance**2))
        angle = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
        points = (centre + squared / distance * along
                  + radius * (np.cos(angle)[:, None] * across[0]
                              + np.sin(angle)[:, None] * across[1]))
    else:
        raise CalibrationError(f'the {rig.mirror.kind} hides its own rim from this camera')
    pixels, front = rig.camera.project((points - rig.cop) @ rig.R_mirror_camera)
    return pixels[front]


def _placed(rig: Rig, circle: Circle) -> Rig | None:
    """The rig whose rim is that circle."""
    z = circle.axis
    origin = circle.centre - rig.mirror.z_min * z
    cop = -origin
    height = float(cop @ z)
    aside = cop - height * z
    off = float(np.linalg.norm(aside))
    side = -1.0 if rig.cop[1] < 0.0 else 1.0
    # A camera on the axis has no side; any azimuth will do, best the rough one.
    y = side * aside / off if off > 1e-9 else _perpendicular(rig.R_mirror_camera[1], z)
    rotation = np.stack([np.cross(y, z), y, z])
    return _built(rig, np.array([0.0, side * off, height]), rotation)


def _placed_sphere(rig: Rig, directions: Array) -> Rig | None:
    """The rig whose sphere has its outline in those directions, turned as the rough one."""
    # v . a = cos(alpha) for all v: linear in a / cos(alpha).
    scaled = np.linalg.lstsq(directions, np.ones(len(directions)), rcond=None)[0]
    cosine = 1.0 / float(np.linalg.norm(scaled))
    if cosine >= 1.0:
        return None
    distance = np.sqrt(rig.mirror.squared_radius / (1.0 - cosine**2))
    to_camera = -rig.R_mirror_camera @ (distance * cosine * scaled)
    # The camera's direction is the rough one's; so that it stays at x = 0, turn it about the
    # sphere's centre by as little as will do.
    in_plane = to_camera * [0.0, 1.0, 1.0]
    axis = np.cross(to_camera, in_plane)
    sine = float(np.linalg.norm(axis)) / float(
        np.linalg.norm(to_camera) * np.linalg.norm(in_plane))
    turn = rotation_exp(axis * (np.arcsin(sine) / max(float(np.linalg.norm(axis)), 1e-30)))
    cop = turn @ to_camera + np.array([0.0, 0.0, rig.mirror.centre_z])
    cop[0] = 0.0  # but for rounding
    return _built(rig, cop, turn @ rig.R_mirror_camera)


def _built(rig: Rig, cop: Array, rotation: Array) -> Rig | None:
    try:
        return replace(rig, cop=cop, R_mirror_camera=rotation)
    except GeometryError:
        return None


def _perpendicular(vector: Array, axis: Array) -> Array:
    across = vector - (vector @ axis) * axis
    return across / np.linalg.norm(across)


def _turn(rotation: Array) -> float:
    """Angle of a rotation, radians."""
    return float(np.arccos(np.clip(0.5 * (np.trace(rotation) - 1.0), -1.0, 1.0)))
