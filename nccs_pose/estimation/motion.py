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

"""Where the robot should be by now: wheel odometry, or its last velocity."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass

from nccs_pose.geometry.pose import Array, Pose2, wrap_angle
import numpy as np

# Odometry further from a stamp than this says nothing about it, ns.
_LONGEST_GAP_NS = 250_000_000
# Without odometry a velocity is believed for so long, s.
_LONGEST_COAST = 1.0
_KEPT = 4000
# What a prediction may be off by: a floor, and a part of the motion (odometry); an
# acceleration (constant velocity). The floor keeps the image, not the prediction, in charge.
_FLOOR_SIGMA = (0.02, 0.015)
_ODOMETRY_SHARE = 0.1
_YAW_PER_METRE = 0.05
_ACCELERATION = (1.0, 2.0)


@dataclass(frozen=True, eq=False)
class Prediction:
    """A pose expected before its image is looked at.

    :ivar pose: T_map_base.
    :ivar covariance: of (x, y, yaw) (3, 3).
    :ivar by_odometry: whether wheels say so, or only the last velocity.
    """

    pose: Pose2
    covariance: Array
    by_odometry: bool


class Odometry:
    """Wheel odometry, interpolated at any stamp it covers."""

    def __init__(self) -> None:
        self._stamps: list[int] = []
        self._poses: list[Pose2] = []

    def add(self, stamp_ns: int, pose: Pose2) -> None:
        """Take one sample; one that is not newer than the last is no news."""
        if self._stamps and stamp_ns <= self._stamps[-1]:
            return
        self._stamps.append(stamp_ns)
        self._poses.append(pose)
        if len(self._stamps) > 2 * _KEPT:
            del self._stamps[:_KEPT], self._poses[:_KEPT]

    def clear(self) -> None:
        """Forget everything, as after a jump of the clock."""
        self._stamps.clear()
        self._poses.clear()

    def at(self, stamp_ns: int) -> Pose2 | None:
        """T_odom_base at a stamp; carried on a little past the last sample, else None."""
        n = len(self._stamps)
        if n < 2 or stamp_ns < self._stamps[0] - 1:
            return None
        right = min(max(bisect_right(self._stamps, stamp_ns), 1), n - 1)
        left = right - 1
        t0, t1 = self._stamps[left], self._stamps[right]
        beyond = stamp_ns - t1
        if beyond > _LONGEST_GAP_NS or t1 - t0 > 4 * _LONGEST_GAP_NS:
            return None
        share = (stamp_ns - t0) / (t1 - t0)
        step = self._poses[left].inverse() @ self._poses[right]
        return self._poses[left] @ Pose2(share * step.x, share * step.y, share * step.yaw)


def by_odometry(pose: Pose2, covariance: Array, before: Pose2, after: Pose2) -> Prediction:
    """Carry a pose and its covariance on by what the wheels did between two stamps."""
    step = before.inverse() @ after
    distance = float(np.hypot(step.x, step.y))
    sigma = _FLOOR_SIGMA[0] + _ODOMETRY_SHARE * distance
    sigma_yaw = (_FLOOR_SIGMA[1] + _ODOMETRY_SHARE * abs(step.yaw) + _YAW_PER_METRE * distance)
    return Prediction(pose @ step, _carried(pose, covariance, step, sigma, sigma_yaw), True)


def by_velocity(
    before: Pose2, before_ns: int, last: Pose2, covariance: Array, last_ns: int, stamp_ns: int,
) -> Prediction | None:
    """Carry a pose on by the velocity between the last two; None when that is too long ago."""
    dt, past = (stamp_ns - last_ns) * 1e-9, (last_ns - before_ns) * 1e-9
    if not 0.0 < dt <= _LONGEST_COAST or not 0.0 < past <= _LONGEST_COAST:
        return None
    twist = before.inverse() @ last
    share = dt / past
    step = Pose2(share * twist.x, share * twist.y, share * float(wrap_angle(twist.yaw)))
    sigma = _FLOOR_SIGMA[0] + 0.5 * _ACCELERATION[0] * dt * (dt + past)
    sigma_yaw = _FLOOR_SIGMA[1] + 0.5 * _ACCELERATION[1] * dt * (dt + past)
    return Prediction(last @ step, _carried(last, covariance, step, sigma, sigma_yaw), False)


def _carried(
    pose: Pose2, covariance: Array, step: Pose2, sigma: float, sigma_yaw: float,
) -> Array:
    """Covariance (3, 3) after a step: an error in yaw swings the step sideways."""
    swing = pose.rotation @ step.translation
    jacobian = np.eye(3)
    jacobian[0, 2], jacobian[1, 2] = -swing[1], swing[0]
    noise = np.diag([sigma**2, sigma**2, sigma_yaw**2])
    return jacobian @ covariance @ jacobian.T + noise
