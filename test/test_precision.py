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

"""The bound that the precision of a pose is measured against."""

from __future__ import annotations

import dataclasses

from nccs_pose.evaluation.precision import image_bound, image_information, straight_scene
from nccs_pose.geometry.pose import Pose2, RigidTransform
from nccs_pose.simulation.renderer import expected_image
from nccs_pose.simulation.scene import Scene
import numpy as np

POSE = Pose2(0.3, -0.2, 0.7)
STEP = 3e-4


def _seen(scene: Scene, x: float = 0.0, yaw: float = 0.0, height: float = 0.0) -> np.ndarray:
    mounting = scene.rig.T_base_mirror
    raised = RigidTransform(
        mounting.rotation, mounting.translation + np.array([0.0, 0.0, height]))
    rig = dataclasses.replace(scene.rig, T_base_mirror=raised)
    pose = Pose2(POSE.x + x, POSE.y, POSE.yaw + yaw)
    return expected_image(dataclasses.replace(scene, rig=rig), pose).astype(float).ravel()


def test_a_height_hardly_unknown_adds_what_least_squares_over_all_pixels_mistakes_it_for() -> None:
    scene = straight_scene(160, 0.05)
    slopes = [
        (_seen(scene, x=STEP) - _seen(scene, x=-STEP)) / (2.0 * STEP),
        (expected_image(scene, Pose2(POSE.x, POSE.y + STEP, POSE.yaw)).astype(float)
         - expected_image(scene, Pose2(POSE.x, POSE.y - STEP, POSE.yaw))).ravel() / (2.0 * STEP),
        (_seen(scene, yaw=STEP) - _seen(scene, yaw=-STEP)) / (2.0 * STEP)]
    raised = (_seen(scene, height=STEP) - _seen(scene, height=-STEP)) / (2.0 * STEP)
    mistaken, *_ = np.linalg.lstsq(np.transpose(slopes), raised, rcond=None)
    sigma, information = 3e-5, image_information(scene, POSE)
    added = image_bound(information, sigma) - image_bound(information)
    # Next to nothing is what the pixels themselves tell of so small a height.
    np.testing.assert_allclose(
        added, sigma**2 * np.outer(mistaken, mistaken), rtol=0.01,
        atol=0.01 * sigma**2 * float(mistaken @ mistaken))


def test_pixels_of_half_the_size_and_of_half_the_noise_allow_more() -> None:
    def of(width: int, noise: float) -> np.ndarray:
        return np.sqrt(np.diag(image_bound(image_information(straight_scene(width, noise), POSE))))

    coarse = of(160, 0.05)
    np.testing.assert_allclose(coarse / of(160, 0.025), 2.0, rtol=1e-3)
    # Four times the pixels, and twice as many px to the metre; but for the thinnest tapes.
    assert np.all(coarse / of(320, 0.05) > 2.0)
