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

"""Where the robot is by something else than the image: that decides between equal poses."""

from __future__ import annotations

from dataclasses import dataclass

from nccs_pose.estimation.alignment import close
from nccs_pose.estimation.many_poses import Poses
from nccs_pose.geometry.pose import Array, Pose2
from nccs_pose.geometry.small_matrices import inverse
import numpy as np
from numpy.typing import NDArray

# A pose elsewhere must score so much more than the one where the robot should be to unseat it.
BETTER = 0.15
# So well (m, m and rad, deviations) strips alone tell a pose.
_GUESSED = np.diag([0.05, 0.05, 0.02])**2


@dataclass(frozen=True, eq=False)
class Gate:
    """The validation gate about a prior or a prediction: poses that agree with it lie inside.

    :ivar pose: T_map_base.
    :ivar covariance: of (x, y, yaw) (3, 3).
    :ivar sigmas: how many deviations the robot may be off it.
    """

    pose: Pose2
    covariance: Array
    sigmas: float

    def contains(self, pose: Pose2, covariance: Array = _GUESSED) -> bool:
        """Whether a pose lies inside, as sure as its own covariance.

        :param covariance: of its (x, y, yaw) (3, 3); unless given, that of a guess by strips.
        """
        return close(pose, self.pose, self.covariance + covariance, self.sigmas)

    def contains_each(self, poses: Poses) -> NDArray[np.bool_]:
        """Which of H poses that strips tell lie inside (H,)."""
        off = poses.place - complex(self.pose.x, self.pose.y)
        turn = np.angle(poses.rotation * np.exp(-1j * self.pose.yaw))
        off = np.array([off.real, off.imag, turn])
        information = inverse(self.covariance + _GUESSED)
        return np.einsum('ih,ij,jh->h', off, information, off) <= self.sigmas**2
