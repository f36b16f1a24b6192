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

from nccs_pose.estimation.motion import carried_on, Prediction, Track
from nccs_pose.estimation.odometry import Wheels
from nccs_pose.geometry.pose import Array, Pose2


class GivenPose:
    """Where the robot was said to be, carried on from image to image until one decides.

    It was there at the first image that is asked about. The robot may drive on before any image
    shows where: on a map that repeats itself a pose that stayed behind would decide for another
    place.
    """

    def __init__(self, pose: Pose2, covariance: Array) -> None:
        """Take a pose over.

        :param pose: T_map_base.
        :param covariance: of (x, y, yaw) (3, 3).
        """
        self._told = Prediction(pose, covariance, by_odometry=False, is_given=True)
        self._track: Track | None = None
        # How far the wheels had rolled when they were first heard.
        self._way: float | None = None

    @property
    def is_new(self) -> bool:
        """Whether no image has been asked about yet."""
        return self._track is None

    def expected(self, stamp_ns: int, odometry: Wheels | None) -> Prediction | None:
        """Where the robot is at an image; None where it may be anywhere by now.

        :param odometry: what the wheels say then; without, the robot may have driven at any speed.
        """
        expected: Prediction | None = self._told
        if self._track is not None and self._track.stamp_ns != stamp_ns:
            carried = carried_on((), self._track, odometry, stamp_ns)
            expected = None if carried is None else replace(carried, is_given=True)
        # Without wheels what it may have driven since counts from the first image without.
        if expected is not None and (self._track is None or odometry is not None):
            if self._way is None and odometry is not None:
                self._way = odometry.way
            self._told = expected
            self._track = Track(
                stamp_ns, expected.pose, expected.carried, odometry, stamp_ns, self._way)
        return expected

    def forget_odometry(self) -> None:
        """No step of the wheels leads on from what they told until now."""
        if self._track is not None:
            self._track = replace(self._track, odometry=None)
