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

"""What the stages of one frame cost."""

from __future__ import annotations

import time

from nccs_pose.estimation.estimate import Stage, StageTimes


class Stopwatch:
    """Seconds by stage, by the clock."""

    def __init__(self) -> None:
        """Start."""
        self._last = time.perf_counter()
        self._seconds: dict[Stage, float] = {}

    def lap(self, stage: Stage) -> None:
        """End a stage; it may have several laps."""
        now = time.perf_counter()
        self._seconds[stage] = self._seconds.get(stage, 0.0) + now - self._last
        self._last = now

    @property
    def times(self) -> StageTimes:
        """The sums of all laps so far."""
        return StageTimes(**self._seconds)
