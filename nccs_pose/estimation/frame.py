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

"""An image, and what is known of it before anybody looks at it."""

from __future__ import annotations

from dataclasses import dataclass

from nccs_pose.estimation.motion import Prediction
from nccs_pose.estimation.odometry import Wheels
from nccs_pose.estimation.stopwatch import Stopwatch
import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Frame:
    """One image on its way through the localiser.

    :ivar stamp_ns: the image's own stamp, nanoseconds.
    :ivar image: (H, W, 3) uint8 BGR.
    :ivar wheels: what the wheels say at that stamp; None without odometry.
    :ivar prediction: the pose that the last ones lead to; None where they lead nowhere.
    :ivar watch: takes the time that each stage costs.
    """

    stamp_ns: int
    image: NDArray[np.uint8]
    wheels: Wheels | None
    prediction: Prediction | None
    watch: Stopwatch
