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

"""Solid things that stand in the mirror's view: obstacles in the room, the robot itself."""

from __future__ import annotations

import functools

from nccs_pose.geometry.pose import Pose2
from nccs_pose.simulation.floor_view import FloorView
from nccs_pose.simulation.scene import Obstacle, RobotBody
import numpy as np

# The light comes from here in the frame of the thing; what is turned away keeps the ambient part.
_SUN = np.array([0.6, 0.8])
_AMBIENT = 0.6


def paint_obstacle(
    colours: np.ndarray, view: FloorView, obstacle: Obstacle, pose: Pose2
) -> None:
    """Paint a cylinder of the map over what is behind it, in place.

    :param colours: of the view's pixels (N, 3) float32.
    :param view: of the rig.
    :param obstacle: the cylinder.
    :param pose: of base_link in the map.
    """
    centre = pose.inverse().apply(np.array([[obstacle.x, obstacle.y]]))[0]
    _paint_cylinder(colours, view, centre, obstacle.radius, obstacle.bottom, obstacle.top,
                    np.array(obstacle.colour))


@functools.lru_cache(maxsize=4)
def body_overlay(
    view: FloorView, body: RobotBody, cop: tuple[float, float, float]
) -> tuple[np.ndarray, np.ndarray]:
    """Paint the robot's deck, mast and camera once for all frames.

    :param view: of the rig.
    :param body: the robot.
    :param cop: the camera's centre of projection in base_link.
    :returns: positions among the view's pixels (K,) and their colours (K, 3) float32.
    """
    colours = np.full((len(view.pixel), 3), np.nan, np.float32)
    down = np.flatnonzero(view.direction[2] < -0.05)
    origin, direction = view.origin[:, down], view.direction[:, down]
    range_ = (body.height - origin[2]) / direction[2]
    x, y = np.abs(origin[:2] + range_ * direction[:2])
    half_length, half_width = 0.5 * body.length, 0.5 * body.width
    # The deck is a rectangle with its corners cut.
    cut = 0.75 * (half_length + half_width)
    on_deck = (range_ > 0.0) & (x < half_length) & (y < half_width) & (x + y < cut)
    rim = np.minimum(half_length - x, half_width - y)[on_deck] < 0.02
    deck = down[on_deck]
    colours[deck] = body.colour
    colours[deck[rim]] *= np.float32(1.8)
    _paint_cylinder(colours, view, np.array([body.mast_x, body.mast_y]), body.mast_radius,
                    body.height, 3.0, np.array(body.mast_colour))
    # The camera is where all rays come from: a ball about its centre of projection.
    offset = np.array(cop, np.float32)[:, None] - view.origin
    along = np.sum(offset * view.direction, axis=0)
    miss = np.sum(offset * offset, axis=0) - along**2
    colours[(along > 0.0) & (miss < body.camera_radius**2)] = body.camera_colour
    index = np.flatnonzero(~np.isnan(colours[:, 0]))
    return index, colours[index]


def _paint_cylinder(
    colours: np.ndarray, view: FloorView, centre: np.ndarray, radius: float, bottom: float,
    top: float, colour: np.ndarray,
) -> None:
    """Paint side and lid of a vertical cylinder, all in base_link."""
    axis = centre.astype(np.float32)
    x, y = axis[:, None] - view.origin[:2]
    dx, dy = view.direction[:2]
    # Rays whose horizontal track passes the axis within the radius, and ahead of the mirror.
    cross, along, squared = x * dy - y * dx, x * dx + y * dy, dx * dx + dy * dy
    index = np.flatnonzero((cross * cross < np.float32(radius**2) * squared) & (along > 0.0))
    cross, along, squared = cross[index], along[index], np.maximum(squared[index], 1e-12)
    origin, direction = view.origin[:, index], view.direction[:, index]
    enters = (along - np.sqrt(radius**2 * squared - cross**2)) / squared
    point = origin + enters * direction
    side = (enters > 0.0) & (point[2] > bottom) & (point[2] < top)
    normal = (point[:2] - axis[:, None]) / radius
    shade = _AMBIENT + (1.0 - _AMBIENT) * np.maximum(_SUN @ normal, 0.0)
    colours[index[side]] = shade[side, None] * colour
    falls = direction[2] < -1e-3
    down = np.where(falls, (top - origin[2]) / np.where(falls, direction[2], -1.0), -1.0)
    lid = origin[:2] + down * direction[:2] - axis[:, None]
    on_lid = (down > 0.0) & (np.sum(lid * lid, axis=0) < radius**2)
    colours[index[on_lid]] = 1.1 * colour
