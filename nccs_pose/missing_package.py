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

"""A package that is not installed, in one sentence."""

from __future__ import annotations


def missing_package(error: ModuleNotFoundError) -> str:
    """Say which package is missing, and what brings it.

    :raises ModuleNotFoundError: the same, if the module is one of the project's own.
    """
    name = (error.name or '').partition('.')[0]
    if name in ('', 'nccs_pose'):
        raise error
    if name == 'rclpy' or name.endswith(('_msgs', '_srvs', '_interfaces')):
        source = 'it belongs to ROS 2 Jazzy, which is not installed or not sourced'
    else:
        source = "pip install 'nccs_pose[pip]' brings it"
    return f'needs the Python package {name}: {source}.'
