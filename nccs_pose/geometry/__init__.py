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

"""The mathematics the project exists for: mirror, camera, rays, lines, planar poses."""

from nccs_pose.geometry.camera import PinholeCamera
from nccs_pose.geometry.lines import Line, LineMap
from nccs_pose.geometry.mirror import QuadricMirror
from nccs_pose.geometry.pose import Pose2, RigidTransform, wrap_angle
from nccs_pose.geometry.rig import Rays, Rig

__all__ = [
    'Line', 'LineMap', 'PinholeCamera', 'Pose2', 'QuadricMirror', 'Rays', 'Rig',
    'RigidTransform', 'wrap_angle',
]
