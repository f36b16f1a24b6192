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

"""The three cameras of the paper's Table I, in metres.

The paper gives mirrors and centres of projection, read as millimetres, and neither the camera's
matrix nor where it looks. Assumed here: 1200 x 800 pixels with f = 750 px, as in its author's
later public code, aimed at the mirror's apex, and the mirror hung 0.75 m above the ground with
its axis pointing down.
"""

from __future__ import annotations

from nccs_pose.geometry.camera import PinholeCamera
from nccs_pose.geometry.mirror import QuadricMirror
from nccs_pose.geometry.pose import Array, RigidTransform
from nccs_pose.geometry.rig import Rig
import numpy as np

CAMERA = PinholeCamera(1200, 800, 750.0, 750.0, 599.5, 399.5)
MOUNTING = RigidTransform.from_rpy([np.pi, 0.0, 0.0], [0.0, 0.0, 0.75])


def look_at(cop: Array, target: Array) -> Array:
    """R_mirror_camera (3, 3) of a camera at ``cop`` aimed at ``target``, both on x = 0 (3,).

    The image's u axis is the mirror's x axis.
    """
    forward = (target - cop) / np.linalg.norm(target - cop)
    right = np.array([1.0, 0.0, 0.0])
    return np.stack([right, np.cross(forward, right), forward], axis=1)


def table_one_rig(mirror: QuadricMirror, cop: Array, camera: PinholeCamera = CAMERA) -> Rig:
    """A rig with that mirror and centre of projection (3,), looking at the apex."""
    return Rig(mirror, camera, cop, look_at(cop, np.array([0.0, 0.0, mirror.apex_z])), MOUNTING)


def hyperbolic_rig() -> Rig:
    """Table I, hyperbolic; the mirror is the lower of the two sheets."""
    return table_one_rig(QuadricMirror(-1.2, 3.4e-3, -33.2e-6), np.array([0.0, 0.025, 0.025]))


def parabolic_rig() -> Rig:
    """Table I, parabolic."""
    return table_one_rig(QuadricMirror(0.0, 20.4e-3, 53.2e-6), np.array([0.0, 0.030, 0.020]))


def spherical_rig() -> Rig:
    """Table I, spherical."""
    return table_one_rig(QuadricMirror(1.0, 0.0, 900e-6), np.array([0.0, -0.015, 0.055]))


TABLE_ONE = {
    'hyperbolic': hyperbolic_rig(),
    'parabolic': parabolic_rig(),
    'spherical': spherical_rig(),
}
