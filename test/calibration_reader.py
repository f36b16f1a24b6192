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
"""A sequence's calibration.yaml (the ray tracer's own layout) as a rig and a map."""

from __future__ import annotations

from pathlib import Path

from nccs_pose.geometry.camera import PinholeCamera
from nccs_pose.geometry.lines import Line, LineMap
from nccs_pose.geometry.mirror import QuadricMirror
from nccs_pose.geometry.pose import RigidTransform
from nccs_pose.geometry.rig import Rig
import numpy as np
import yaml


def read_calibration(sequence: Path) -> tuple[Rig, LineMap]:
    """Read the exact rig and map of a ray-traced sequence's folder."""
    content = yaml.safe_load((Path(sequence) / 'calibration.yaml').read_text())
    mirror, camera = content['mirror'], content['camera']
    mounting, lines = content['T_base_mirror'], content['lines']
    rig = Rig(
        mirror=QuadricMirror(
            mirror['A'], mirror['B'], mirror['C'], rim_radius=mirror['rim_radius']),
        camera=PinholeCamera.from_K(
            camera['image_width'], camera['image_height'],
            np.reshape(camera['K'], (3, 3)), camera['distortion_model'], camera['distortion']),
        cop=np.array(camera['cop_mirror']),
        R_mirror_camera=np.reshape(camera['R_mirror_camera'], (3, 3)),
        # The file says the transform twice; the matrix needs no convention of angles.
        T_base_mirror=RigidTransform(
            np.reshape(mounting['matrix'], (4, 4))[:3, :3], np.array(mounting['translation'])),
    )
    line_map = LineMap(tuple(
        Line(
            np.array(item['start']), np.array(item['end']), width=lines['width'], colour='green',
            name=f'line{item["id"]}')
        for item in lines['items']))
    return rig, line_map
