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

"""Numbers of robust estimation that the solvers have in common."""

from __future__ import annotations

from nccs_pose.geometry.pose import Array
from nccs_pose.vision.median import SIGMA_PER_MEDIAN, upper_median
import numpy as np

# Tuning constant of Cauchy's loss for 95 % efficiency under Gaussian noise.
CAUCHY = 2.385
# Beyond this many robust standard deviations a residual is no inlier's.
GATE = 3.0
# Where the lines say nothing the pose is still somewhere within 100 m and 10 rad: this keeps
# every covariance finite and positive definite, and is too weak to move any pose.
VAGUE_INFORMATION = np.diag([1e-4, 1e-4, 1e-2])


def robust_scale(e: Array) -> float:
    """Standard deviation of the bulk of whitened residuals (N,), never below the noise told."""
    size, low, high = np.abs(e), (len(e) - 1) // 2, len(e) // 2
    size.partition([low, high])
    return max(1.0, SIGMA_PER_MEDIAN * 0.5 * float(size[low] + size[high]))


def robust_variance(square: Array) -> float:
    """Its square, from the residuals' squares (N,); of an even number by the upper median."""
    return max(1.0, SIGMA_PER_MEDIAN**2 * upper_median(square))
