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

"""The trials by which covariances are judged."""

from __future__ import annotations

import math

from nccs_pose.estimation.localiser import Localiser
from nccs_pose.evaluation import coverage
from nccs_pose.evaluation.coverage import run_scenario, Scenario
from nccs_pose.geometry.lines import LineMap
from nccs_pose.geometry.rig import Rig
from nccs_pose.simulation.scene import ideal_scene
import pytest
from scipy.stats import chi2

TRIALS = 24
UNEVEN = Scenario(
    'uneven', lambda: ideal_scene(640, 0.02), tilt=math.radians(0.3))


def test_a_floor_as_uneven_as_told_is_within_the_covariance() -> None:
    covered = run_scenario(UNEVEN, TRIALS, seed=2)
    assert covered.consistency.count == TRIALS
    assert covered.consistency.mean_nees * TRIALS < chi2.ppf(0.9999, 3 * TRIALS)


def test_a_floor_more_uneven_than_told_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    def told_level(rig: Rig, line_map: LineMap, _: object) -> Localiser:
        return Localiser(rig, line_map)

    monkeypatch.setattr(coverage, 'Localiser', told_level)
    covered = run_scenario(UNEVEN, TRIALS, seed=2)
    assert covered.verdict == 'too sure'
    assert covered.consistency.mean_nees * TRIALS > 10.0 * chi2.ppf(0.9999, 3 * TRIALS)
