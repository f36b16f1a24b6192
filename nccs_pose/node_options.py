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

"""What the node itself can be told; what the estimator can be told is LocaliserOptions.

No ROS is needed to read this module: the reference page is made from it.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

from nccs_pose.errors import OptionError
from nccs_pose.options import check_options, option


@dataclass(frozen=True)
class NodeOptions:
    """Parameters of the node `localiser` that are no business of the estimator."""

    rig_file: str = option(
        '', doc='Rig calibration (YAML). A relative path is looked for where the node was '
        'started, then in the share directory.')
    map_file: str = option(
        '', doc='Map of the lines (YAML). A relative path is looked for as of rig_file.')
    image_transport: str = option(
        'raw', choices=('raw', 'compressed'),
        doc='raw subscribes image, compressed subscribes image/compressed.')
    autostart: bool = option(
        True, doc='Configure and activate at start; false waits for a lifecycle manager.')
    map_frame: str = option(
        'map', doc='Frame of the lines and of the pose; the map file has to say the same.')
    odom_frame: str = option('odom', doc='Frame of the odometry (frame_prefix goes before it).')
    base_frame: str = option(
        'base_link', doc='Frame of the robot on the ground (frame_prefix goes before it).')
    frame_prefix: str = option(
        '', doc='Goes before odom_frame and base_frame, e.g. robot1/ for several robots.')
    tf_mode: str = option(
        'none', choices=('none', 'map_to_odom', 'map_to_base'),
        doc='Transform to broadcast: map_to_odom where something else broadcasts odom to '
            'base_link, map_to_base where nothing does. Needs tf2_ros.')
    transform_tolerance: float = option(
        0.0, unit='s', low=0.0, high=10.0, live=True,
        doc="How long after the image's stamp a broadcast transform stays good (as in AMCL). "
            'The pose itself is always stamped with the image.')
    camera_info_check: str = option(
        'refuse', choices=('refuse', 'warn', 'off'), live=True,
        doc='What a camera_info that contradicts the rig does: refuse withholds poses until one '
            'agrees again, warn only says so.')
    camera_info_tolerance: float = option(
        0.02, low=0.0, high=1.0, live=True,
        doc='Largest difference of focal lengths and principal point between camera_info and '
            'rig, as a fraction of the focal length.')
    set_initial_pose: bool = option(
        False, doc='Start from initial_pose_* instead of from nothing.')
    initial_pose_x: float = option(
        0.0, unit='m', low=-1e8, high=1e8, doc='Initial pose in the map frame.')
    initial_pose_y: float = option(
        0.0, unit='m', low=-1e8, high=1e8, doc='Initial pose in the map frame.')
    initial_pose_yaw: float = option(
        0.0, unit='rad', low=-2.0 * math.pi, high=2.0 * math.pi,
        doc='Initial pose in the map frame.')
    initial_pose_sigma: float = option(
        0.5, unit='m', low=1e-3, high=100.0,
        doc='Standard deviation of x and y of an initial pose that brings no covariance.')
    initial_pose_sigma_yaw: float = option(
        0.26, unit='rad', low=1e-3, high=math.pi,
        doc='Standard deviation of the yaw of an initial pose that brings no covariance.')
    saved_pose_file: str = option(
        '', doc='Where the last good pose is kept for the next start; empty keeps none.')
    saved_pose_interval: float = option(
        10.0, unit='s', low=0.1, high=3600.0, doc='How often the pose is saved while tracking.')
    diagnostics_period: float = option(
        1.0, unit='s', low=0.05, high=10.0,
        doc='How often /diagnostics is published; a change of state is published at once.')
    silence_warning: float = option(
        5.0, unit='s', low=0.5, high=3600.0, live=True,
        doc='After so long without an image the node says what it waits for.')

    def __post_init__(self) -> None:
        check_options(self)
        for name in ('map_frame', 'odom_frame', 'base_frame'):
            frame = getattr(self, name)
            if not frame or frame.startswith('/'):
                raise OptionError(f'{name} = {frame!r}: a frame is not empty and has no leading /')
        if self.frame_prefix.startswith('/'):
            raise OptionError(f'frame_prefix = {self.frame_prefix!r}: a frame has no leading /')

    @property
    def odom(self) -> str:
        """The odometry frame with its prefix."""
        return self.frame_prefix + self.odom_frame

    @property
    def base(self) -> str:
        """The robot's frame with its prefix."""
        return self.frame_prefix + self.base_frame
