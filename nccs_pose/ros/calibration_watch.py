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

"""The calibration monitor beside the running localiser, and its line in /diagnostics."""

from __future__ import annotations

import math

from diagnostic_msgs.msg import DiagnosticStatus
from nccs_pose.calibration.monitor import CalibrationMonitor, Condition
from nccs_pose.estimation.estimate import Estimate
from nccs_pose.geometry.lines import LineMap
from nccs_pose.geometry.rig import Rig
from nccs_pose.ros.diagnostics import status

PERIOD_NS = 200_000_000
"""Images closer together are of the same place, and a look costs a millisecond or two."""


class CalibrationWatch:
    """Shows the monitor an estimate now and then."""

    def __init__(self, rig: Rig, line_map: LineMap) -> None:
        self._monitor = CalibrationMonitor(rig, line_map)
        self._last_ns: int | None = None

    def look(self, estimate: Estimate) -> None:
        """Show an estimate, unless one was shown a moment ago."""
        if self._last_ns is None or abs(estimate.stamp_ns - self._last_ns) >= PERIOD_NS:
            self._last_ns = estimate.stamp_ns
            self._monitor.add(estimate)

    def status(self, node: str) -> DiagnosticStatus:
        """What the residuals say of the rig; a warning when they suspect it."""
        verdict = self._monitor.verdict()
        level = (DiagnosticStatus.WARN if verdict.condition is Condition.SUSPECT
                 else DiagnosticStatus.OK)
        known = verdict.condition is not Condition.UNKNOWN  # else a zero is no good news
        return status(f'{node}: calibration', level, verdict.words, {
            'condition': verdict.condition.value, 'frames': verdict.frames,
            'statistic': float(verdict.statistic) if known else math.nan,
            'limit': float(verdict.limit) if known else math.nan,
            'pose_error_m': float(verdict.pose_error) if known else math.nan})
