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

"""A camera that froze, told from one that stands still."""

from __future__ import annotations

from nccs_pose.errors import FrameRefusedError
from nccs_pose.estimation.admission import Admission
from nccs_pose.estimation.odometry import Odometry
from nccs_pose.geometry import PinholeCamera, Pose2
import numpy as np
import pytest


def _image(height: int, seed: int) -> np.ndarray:
    """A black frame with some noise in the middle, where a mirror would be."""
    image = np.zeros((height, 64, 3), np.uint8)
    middle = slice(height // 4, height - height // 4)
    image[middle] = np.random.default_rng(seed).integers(100, 110, image[middle].shape)
    return image


def _admission(height: int, step: float) -> Admission:
    """One that has seen an image, after which the robot went so far, metres."""
    odometry = Odometry(clock_jump=1.0)
    odometry.add(0, Pose2(0.0, 0.0, 0.0))
    odometry.add(100, Pose2(step, 0.0, 0.0))
    admission = Admission(PinholeCamera(64, height, 50.0, 50.0, 32.0, 24.0), odometry, 1.0)
    assert admission.admit(0, _image(height, 0))
    return admission


@pytest.mark.parametrize('height', [24, 48, 90, 100, 120, 480, 960])
def test_an_image_is_frozen_only_if_the_robot_moved_and_no_pixel_changed(height: int) -> None:
    assert _admission(height, 0.1).admit(100, _image(height, 1))
    assert _admission(height, 0.0).admit(100, _image(height, 0))
    with pytest.raises(FrameRefusedError) as refused:
        _admission(height, 0.1).admit(100, _image(height, 0))
    assert refused.value.cause == 'frozen_image'


def test_a_frozen_camera_is_found_on_a_slow_robot_and_until_its_image_changes() -> None:
    odometry, still, other = Odometry(clock_jump=1.0), _image(48, 0), _image(48, 1)
    admission = Admission(PinholeCamera(64, 48, 50.0, 50.0, 32.0, 24.0), odometry, 1.0)
    frozen = []
    # More samples than are kept, ten of them an image, in which it moves 3 mm.
    for k in range(20_000):
        odometry.add(k * 10_000_000, Pose2(0.0003 * k, 0.0, 0.0))
        if k % 10 == 0 and k > 0:
            try:
                admission.admit(k * 10_000_000, still)
            except FrameRefusedError as error:
                frozen.append(error.cause)
    assert frozen == 1997 * ['frozen_image']
    assert admission.admit(200_000_000_000, other)
