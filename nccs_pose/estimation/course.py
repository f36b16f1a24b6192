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

"""The poses that the last images gave, and where they lead."""

from __future__ import annotations

from dataclasses import dataclass, replace
import math

from nccs_pose.estimation.motion import by_odometry, by_velocity, PAST, Prediction, Slip, Track
from nccs_pose.estimation.odometry import Wheels
from nccs_pose.estimation.wheel_errors import UNCHECKED, WheelErrors
from nccs_pose.geometry.pose import Array, Pose2


@dataclass(frozen=True, eq=False)
class Course:
    """The way of a robot through the last images.

    :ivar last: the last pose; None before the first.
    :ivar past: the poses before it, in order, as far back as velocities lead to the last one.
    :ivar errors: what the images have shown of how far the wheels err.
    """

    last: Track | None = None
    past: tuple[Track, ...] = ()
    errors: WheelErrors = UNCHECKED

    def at(
        self, stamp_ns: int, wheels: Wheels | None, *, doubted: bool = False,
    ) -> Prediction | None:
        """Where the robot should be: by the wheels, or by its velocity where they are silent.

        :param wheels: what they say at the stamp; None without odometry.
        :param doubted: whether images since the last pose speak against what they say.
        :returns: None without any pose, or where the last one is too long ago.
        """
        last = self.last
        if last is None:
            return None
        if last.wheels is not None and wheels is not None:
            return by_odometry(
                last.pose, last.covariance, last.wheels, wheels, last.seen_way,
                self.errors.flaw, Slip.LIKELY if doubted else Slip.POSSIBLE)
        return by_velocity(self.past, last, stamp_ns)

    def seconds_to(self, stamp_ns: int) -> float:
        """Seconds from the last pose to a stamp; infinite without any pose."""
        return math.inf if self.last is None else (stamp_ns - self.last.stamp_ns) * 1e-9

    def after(
        self, stamp_ns: int, pose: Pose2, covariance: Array, wheels: Wheels | None, *,
        is_fixed: bool, is_jump: bool = False,
    ) -> Course:
        """The course after one more image.

        :param pose: T_map_base at the image.
        :param covariance: of its (x, y, yaw) (3, 3).
        :param wheels: what they say at the stamp; None without odometry.
        :param is_fixed: whether the lines in view fix every direction of the pose.
        :param is_jump: whether the pose may be elsewhere than the last ones led.
        """
        last = self.last
        seen_ns, seen_way = stamp_ns, None if wheels is None else wheels.way
        if last is not None and not is_fixed:
            seen_ns, seen_way = last.seen_ns, last.seen_way
        track = Track(stamp_ns, pose, covariance, wheels, seen_ns, seen_way)
        # A step that also sets right what the images before had left open is no velocity.
        sets_right = is_fixed and last is not None and last.seen_ns < last.stamp_ns
        errors = self.errors
        # A robot that was found elsewhere has not come there on its wheels.
        if is_jump or last is None:
            errors = errors.begun_at(track if is_fixed else None)
        elif is_fixed:
            errors = errors.after(track)
        if last is None or is_jump or sets_right:
            return Course(track, (), errors)
        return Course(track, (*self.past, last)[-PAST:], errors)

    def without_odometry(self) -> Course:
        """The course once the wheels' reckoning has broken off: no step leads on from there."""
        return self if self.last is None else replace(
            self, last=replace(self.last, wheels=None), errors=self.errors.begun_at(None))
