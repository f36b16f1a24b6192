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

"""The middleware's settings, for camera images and for trials beside other robots."""

from __future__ import annotations

import os

from nccs_pose.files.resources import share_directory

VARIABLE = 'FASTRTPS_DEFAULT_PROFILES_FILE'


def use_large_images() -> None:
    """Give this process the Fast DDS profile for large images, if the user chose none.

    Only what publishes images needs it, and before ROS is initialised.
    """
    profile = share_directory() / 'config' / 'fastdds_large_images.xml'
    if profile.is_file():
        os.environ.setdefault(VARIABLE, str(profile))


def stay_alone() -> None:
    """Keep this process and what it starts to a domain of their own, if the user chose none.

    Another robot's images would be localised and counted as well. Before ROS is initialised.
    """
    os.environ.setdefault('ROS_DOMAIN_ID', str(1 + os.getpid() % 99))
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
