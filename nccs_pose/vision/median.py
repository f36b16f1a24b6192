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

"""The median, without the care that numpy's takes of means and missing values."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

SIGMA_PER_MEDIAN = 1.4826
"""The standard deviation of Gaussian noise e over the median of |e|."""


def upper_median(values: NDArray[Any]) -> float:
    """The middle one of values of any shape, the upper of two."""
    ordered, middle = values.flatten(), values.size // 2
    ordered.partition(middle)
    return float(ordered[middle])


def noise_deviation(values: NDArray[Any]) -> float:
    """Standard deviation about zero of values of any shape, most of which are mere noise."""
    return SIGMA_PER_MEDIAN * upper_median(np.abs(values))
