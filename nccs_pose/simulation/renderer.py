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

"""From a scene and a pose to the image that the robot's camera takes there."""

from __future__ import annotations

from nccs_pose.geometry.pose import Pose2
from nccs_pose.simulation.bodies import body_overlay, paint_obstacle
from nccs_pose.simulation.floor_view import floor_view, FloorView
from nccs_pose.simulation.motion import integrate_twist, Twist
from nccs_pose.simulation.scene import Appearance, Room, Scene
from nccs_pose.simulation.sensors import expose, irradiate, respond
from nccs_pose.simulation.tape_coverage import tape_coverage
from nccs_pose.simulation.textures import (
    ceiling_colours,
    floor_brightness,
    floor_level,
    wall_colours,
)
import numpy as np

_PIECE = 1 << 14


def render(
    scene: Scene, pose: Pose2, rng: np.random.Generator, twist: Twist | None = None
) -> np.ndarray:
    """Take a picture.

    :param scene: what is there and the camera that looks at it.
    :param pose: of base_link in the map, in the middle of the exposure.
    :param rng: source of the sensor's noise.
    :param twist: the robot's motion; it smears the image when the sensor has an exposure time.
    :returns: (H, W, 3) uint8, BGR.
    """
    return expose(_irradiance(scene, pose, twist), scene.sensor, rng)


def expected_image(scene: Scene, pose: Pose2, twist: Twist | None = None) -> np.ndarray:
    """Give the picture before noise, rounding, clipping and compression.

    :returns: (H, W, 3) float32, BGR in grey levels (full scale 255); smooth in the pose, for
        Cramér-Rao bounds by finite differences.
    """
    return respond(_irradiance(scene, pose, twist), scene.sensor)


def _irradiance(scene: Scene, pose: Pose2, twist: Twist | None) -> np.ndarray:
    sensor, steps = scene.sensor, scene.sensor.exposure_steps
    if twist is None or sensor.exposure_time == 0.0 or steps == 1:
        return irradiate(paint(scene, pose), sensor)
    moments = ((np.arange(steps) + 0.5) / steps - 0.5) * sensor.exposure_time
    total = paint(scene, integrate_twist(pose, twist, float(moments[0])))
    for moment in moments[1:]:
        total += paint(scene, integrate_twist(pose, twist, float(moment)))
    total *= np.float32(1.0 / steps)
    return irradiate(total, sensor)


def paint(scene: Scene, pose: Pose2) -> np.ndarray:
    """Give the light that comes to each pixel, (H, W, 3) float32 BGR."""
    view, look = floor_view(scene.rig), scene.appearance
    colours = np.empty((len(view.pixel), 3), np.float32)
    colours[:] = look.background
    light = _light(view, look, pose)
    _paint_floor(colours, view, look, pose, light)
    _paint_tapes(colours, view, scene, pose, light)
    if look.room is not None:
        _paint_room(colours, view, look.room, pose)
    for obstacle in look.obstacles:
        paint_obstacle(colours, view, obstacle, pose)
    if look.body is not None:
        cop = scene.rig.T_base_mirror.apply(scene.rig.cop)
        index, own_colours = body_overlay(view, look.body, tuple(cop.tolist()))
        colours[index] = own_colours
    image = np.empty((view.height * view.width, 3), np.float32)
    image[:] = look.surround
    image[view.pixel] = colours
    return image.reshape(view.height, view.width, 3)


def _floor_on_map(view: FloorView, pose: Pose2) -> np.ndarray:
    """Give the map's x and y (2, F) float32 of the floor that each pixel sees."""
    return _turned(pose, view.floor.T) + pose.translation[:2, None].astype(np.float32)


def _turned(pose: Pose2, points: np.ndarray) -> np.ndarray:
    """Turn (2, N) float32; not by a matrix product, which every BLAS rounds in its own way."""
    (xx, xy), (yx, yy) = pose.rotation[:2, :2].astype(np.float32)
    x, y = points
    return np.stack([xx * x + xy * y, yx * x + yy * y])


def _light(view: FloorView, look: Appearance, pose: Pose2) -> np.ndarray:
    """Give the light on the floor of each pixel (F,) float32, 1 at the map's origin."""
    if look.light_gradient == (0.0, 0.0):
        return np.ones(len(view.floor), np.float32)
    x, y = _floor_on_map(view, pose)
    along_x, along_y = (np.float32(gradient) for gradient in look.light_gradient)
    return np.clip(1.0 + along_x * x + along_y * y, 0.3, 1.7)


def _paint_floor(
    colours: np.ndarray, view: FloorView, look: Appearance, pose: Pose2, light: np.ndarray
) -> None:
    if look.texture is not None:
        level = floor_level(look.texture, view.footprint)
        x, y = _floor_on_map(view, pose)
        light = light * floor_brightness(look.texture, x, y, level)
    floor = colours[: len(view.floor)]
    np.multiply(light[:, None], np.array(look.floor_colour, np.float32), out=floor)


def _paint_tapes(
    colours: np.ndarray, view: FloorView, scene: Scene, pose: Pose2, light: np.ndarray
) -> None:
    """Lay the tapes, then the patches, one over the other."""
    look, to_base = scene.appearance, pose.inverse()
    for tape in (*scene.line_map, *look.patches):
        index, coverage = tape_coverage(view, tape.transformed(to_base))
        share = coverage.astype(np.float32)[:, None]
        colour = np.array(look.line_colours[tape.colour], np.float32) * light[index, None]
        colours[index] = (1.0 - share) * colours[index] + share * colour


def _paint_room(colours: np.ndarray, view: FloorView, room: Room, pose: Pose2) -> None:
    """Put walls and ceiling in front of whatever the rays would meet behind them."""
    floor = _floor_on_map(view, pose)
    behind = ((floor[0] < room.x_min) | (floor[0] > room.x_max)
              | (floor[1] < room.y_min) | (floor[1] > room.y_max))
    index = np.r_[np.flatnonzero(behind), np.arange(len(view.floor), len(view.pixel))]
    # In pieces that the processor's cache holds.
    for first in range(0, len(index), _PIECE):
        piece = index[first : first + _PIECE]
        colours[piece] = _room_colours(
            view.origin[:, piece], view.direction[:, piece], room, pose)


def _room_colours(
    origin: np.ndarray, direction: np.ndarray, room: Room, pose: Pose2
) -> np.ndarray:
    """Give what rays (3, N) of base_link meet on the walls or the ceiling, (N, 3)."""
    low = np.array([[room.x_min], [room.y_min]], np.float32)
    high = np.array([[room.x_max], [room.y_max]], np.float32)
    start = _turned(pose, origin[:2]) + pose.translation[:2, None].astype(np.float32)
    across = _turned(pose, direction[:2])
    across[np.abs(across) < 1e-6] = 1e-6
    ranges = (np.where(across > 0.0, high, low) - start) / across
    # 0: the wall in the east or west is met first; 1: the one in the north or south.
    side = ranges[1] < ranges[0]
    range_ = np.maximum(np.minimum(ranges[0], ranges[1]), 0.0)
    height = origin[2] + range_ * direction[2]
    along = _round_the_room(room, start + range_ * across, across, side)
    seen = wall_colours(room, along, np.maximum(height, 0.0))
    over = np.flatnonzero(height > room.height)
    up = (np.float32(room.height) - origin[2, over]) / direction[2, over]
    seen[over] = ceiling_colours(room, *(start[:, over] + up * across[:, over]))
    return seen


def _round_the_room(
    room: Room, meets: np.ndarray, across: np.ndarray, side: np.ndarray
) -> np.ndarray:
    """Give the distance (N,) along the walls south, east, north, west of points (2, N)."""
    x, y = meets[0] - np.float32(room.x_min), meets[1] - np.float32(room.y_min)
    width, depth = np.float32(room.x_max - room.x_min), np.float32(room.y_max - room.y_min)
    east_west = y + np.where(across[0] > 0.0, width, width + depth + width)
    south_north = x + np.where(across[1] > 0.0, width + depth, np.float32(0.0))
    return np.where(side, south_north, east_west)
