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

"""A pose that somebody told: by hand, or from the last run."""

from __future__ import annotations

from dataclasses import replace

from nccs_pose.errors import EstimationError
from nccs_pose.estimation.course import Course
from nccs_pose.estimation.motion import Prediction, Track
from nccs_pose.estimation.odometry import Wheels
from nccs_pose.geometry.pose import Array, Pose2
import numpy as np


class GivenPose:
    """Where the robot was said to be, carried on from image to image until one decides.

    The pose holds for the first image that is asked about. The robot may drive on before any
    image shows where it is: on a map that repeats itself a pose that stayed behind would decide
    for another place.
    """

    def __init__(self, pose: Pose2, covariance: Array) -> None:
        """Take a pose over.

        :param pose: T_map_base.
        :param covariance: of (x, y, yaw) (3, 3), positive definite.
        :raises EstimationError: if the covariance is none.
        """
        given = np.array(covariance, dtype=float)
        if given.shape != (3, 3) or not np.isfinite(given).all() or (
                np.linalg.eigvalsh(0.5 * (given + given.T))[0] <= 0.0):
            raise EstimationError(
                f'{given.tolist()} is no covariance of (x, y, yaw): 3 x 3, positive definite')
        self._told = Prediction(pose, given, by_odometry=False, is_given=True)
        self._course = Course()
        # How far the wheels had rolled when they were first heard.
        self._way: float | None = None

    @property
    def is_new(self) -> bool:
        """Whether no image has been asked about yet."""
        return self._course.last is None

    def carried_on(self, stamp_ns: int, wheels: Wheels | None) -> Prediction | None:
        """Carry it on to an image: where the robot is there, None where it may be anywhere by now.

        :param wheels: what they say then; without, the robot may have driven at any speed.
        """
        expected: Prediction | None = self._told
        if not self.is_new:
            carried = self._course.at(stamp_ns, wheels)
            expected = None if carried is None else replace(carried, is_given=True)
        # Without wheels what it may have driven since counts from the first image without.
        if expected is not None and (self.is_new or wheels is not None):
            if self._way is None and wheels is not None:
                self._way = wheels.way
            self._course = Course(Track(
                stamp_ns, expected.pose, expected.carried, wheels, stamp_ns, self._way))
        return expected

    def forget_odometry(self) -> None:
        """No step of the wheels leads on from what they told until now."""
        self._course = self._course.without_odometry()
