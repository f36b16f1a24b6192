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

"""What the stand-in camera can be told.

No ROS is needed to read this module: the reference page is made from it.
"""

from __future__ import annotations

from dataclasses import dataclass

from nccs_pose.options import check_options, option
from nccs_pose.simulation.scene import arena_scene, ideal_scene

SCENES = {'arena': arena_scene, 'ideal': ideal_scene}


@dataclass(frozen=True)
class CameraOptions:
    """Parameters of the node `stand_in_camera`."""

    rig_file: str = option('config/arena_640_rig.yaml', doc='Rig to render with (YAML).')
    map_file: str = option('config/arena_map.yaml', doc='Map of the lines (YAML).')
    scene: str = option(
        'arena', choices=tuple(SCENES),
        doc='Look: arena is a room with an ordinary camera, ideal is grey floor and tapes.')
    rate: float = option(5.0, unit='Hz', low=0.1, high=120.0, doc='Images a second.')
    duration: float = option(600.0, unit='s', low=1.0, high=7200.0, doc='Length of the drive.')
    speed: float = option(0.35, unit='m/s', low=0.01, high=3.0, doc='Speed of the robot.')
    image_transport: str = option(
        'raw', choices=('raw', 'compressed'), doc='Publish image or image/compressed.')
    frame_prefix: str = option('', doc='Goes before odom, base_link and camera_optical.')
    seed: int = option(0, low=0, high=2**31 - 1, doc='Seed of the noise.')

    def __post_init__(self) -> None:
        check_options(self)
