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

"""Whether an answer is wrong: one rule for every count of wrong poses."""

from __future__ import annotations

from dataclasses import dataclass
import math

from nccs_pose.estimation.estimate import Estimate
from nccs_pose.geometry.pose import Pose2
import numpy as np

# Closer than both of these is right, whatever the covariance says.
RIGHT_DISTANCE = 0.05
RIGHT_ANGLE = math.radians(1.0)
# Standard deviations (of the error as a whole) that a pose may be off by its own covariance.
RIGHT_SIGMAS = 5.0


@dataclass(frozen=True)
class PoseError:
    """How far an answer is off; NaN without a pose.

    :ivar distance: in m.
    :ivar angle: in rad, 0 to pi.
    :ivar sigmas: the error as a whole by the answer's own covariance; NaN if that is none.
    """

    distance: float = math.nan
    angle: float = math.nan
    sigmas: float = math.nan

    @classmethod
    def of(cls, estimate: Estimate, truth: Pose2) -> PoseError:
        """Of an estimate of the pose that an image was taken from."""
        if estimate.pose is None or estimate.covariance is None:
            return cls()
        error = estimate.pose.minus(truth)
        try:
            squared = float(error @ np.linalg.solve(estimate.covariance, error))
        except np.linalg.LinAlgError:
            squared = math.nan
        sigmas = math.sqrt(squared) if squared >= 0.0 else math.nan
        return cls(math.hypot(error[0], error[1]), abs(float(error[2])), sigmas)

    @property
    def given(self) -> bool:
        """Whether there is a pose."""
        return not math.isnan(self.distance)

    @property
    def right(self) -> bool:
        """Within 50 mm and 1 degree."""
        return self.given and self.distance <= RIGHT_DISTANCE and self.angle <= RIGHT_ANGLE

    @property
    def wrong(self) -> bool:
        """Neither right nor within 5 sigma; a covariance that is none excuses nothing."""
        return self.given and not self.right and not self.sigmas <= RIGHT_SIGMAS
