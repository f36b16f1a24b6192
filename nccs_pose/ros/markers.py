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

"""What RViz shows: the map's lines, the points observed on them, the pose and its ellipse."""

from __future__ import annotations

import math

from geometry_msgs.msg import Point
from nccs_pose.estimation.estimate import Estimate
from nccs_pose.geometry.lines import LineMap
from nccs_pose.geometry.pose import Array, Pose2
from nccs_pose.geometry.rig import Rig
from nccs_pose.ros.conversions import ns_to_stamp, planar_to_pose, yaw_quaternion
import numpy as np
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

ELLIPSE_SIGMAS = 3.0
FLATNESS = 0.005
"""Height of what lies on the floor, metres."""

_MAP = ColorRGBA(r=0.1, g=0.7, b=0.2, a=1.0)
_OBSERVED = ColorRGBA(r=1.0, g=0.5, b=0.0, a=1.0)
_POSE = ColorRGBA(r=0.1, g=0.4, b=1.0, a=1.0)
_ELLIPSE = ColorRGBA(r=0.1, g=0.4, b=1.0, a=0.4)


def marker_array(frame: str, estimate: Estimate, rig: Rig, line_map: LineMap) -> MarkerArray:
    """Markers of one estimate in the map frame; what it does not know is deleted."""
    markers = [_map_lines(line_map), _observed(estimate, rig), *_pose(estimate)]
    for number, marker in enumerate(markers):
        marker.header.frame_id = frame
        marker.header.stamp = ns_to_stamp(estimate.stamp_ns)
        marker.id = number
        marker.ns = 'nccs_pose'
    return MarkerArray(markers=markers)


def _map_lines(line_map: LineMap) -> Marker:
    ends = [np.asarray(end, dtype=float) for line in line_map for end in (line.start, line.end)]
    marker = _marker(Marker.LINE_LIST, _MAP, max(line_map[0].width, 0.01))
    marker.points = _points(np.array(ends))
    return marker


def _observed(estimate: Estimate, rig: Rig) -> Marker:
    marker = _marker(Marker.POINTS, _OBSERVED, 0.02)
    marker.scale.y = 0.02
    if estimate.pose is None or estimate.points is None or not len(estimate.points):
        marker.action = Marker.DELETE
        return marker
    floor, reaches = rig.back_project(estimate.points.pixels).floor_points()
    in_map = estimate.pose.apply(floor[reaches])
    marker.points = _points(np.column_stack([in_map, np.full(len(in_map), FLATNESS)]))
    return marker


def _pose(estimate: Estimate) -> tuple[Marker, Marker]:
    arrow, ellipse = _marker(Marker.ARROW, _POSE, 0.4), _marker(Marker.CYLINDER, _ELLIPSE, 0.0)
    if estimate.pose is None or estimate.covariance is None:
        arrow.action = ellipse.action = Marker.DELETE
        return arrow, ellipse
    arrow.pose = planar_to_pose(estimate.pose)
    arrow.scale.y = arrow.scale.z = 0.05
    variances, axes = np.linalg.eigh(estimate.covariance[:2, :2])
    ellipse.pose = planar_to_pose(Pose2(estimate.pose.x, estimate.pose.y))
    ellipse.pose.orientation = yaw_quaternion(math.atan2(axes[1, 0], axes[0, 0]))
    # An ellipse of microns could not be seen.
    diameters = np.maximum(2.0 * ELLIPSE_SIGMAS * np.sqrt(np.maximum(variances, 0.0)), 0.005)
    ellipse.scale.x, ellipse.scale.y = (float(d) for d in diameters)
    ellipse.scale.z = FLATNESS
    return arrow, ellipse


def _marker(kind: int, colour: ColorRGBA, scale: float) -> Marker:
    marker = Marker(type=kind, action=Marker.ADD, color=colour)
    marker.scale.x = float(scale)
    marker.pose.orientation.w = 1.0
    return marker


def _points(points: Array) -> list[Point]:
    return [Point(x=float(x), y=float(y), z=float(z)) for x, y, z in points]
