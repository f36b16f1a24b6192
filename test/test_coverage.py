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
from nccs_pose.evaluation.coverage import (
    coverage_table,
    Covered,
    play_trial,
    run_scenario,
    Scenario,
    SCENARIOS,
)
from nccs_pose.evaluation.pose_error import PoseError
from nccs_pose.geometry.lines import LineMap
from nccs_pose.geometry.rig import Rig
from nccs_pose.simulation.scene import ideal_scene
import numpy as np
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


def test_what_is_left_between_people_is_no_pose_where_strips_show_two() -> None:
    # The 592nd trial: half a turn round four lines were found, two thirds of each, a pixel off,
    # and of the right pose, of which strips show as much, too little was left to lay it on.
    people = next(s for s in SCENARIOS if s.name == 'textured arena 640, people')
    scene = people.scene()
    pose, estimate = play_trial(
        Localiser(scene.rig, scene.line_map, people.options), people, scene, 591, seed=11)
    assert not PoseError.of(estimate, pose).wrong


def test_scenarios_err_independently() -> None:
    named = [Scenario(name, lambda: ideal_scene(640, 0.02)) for name in ('a', 'b')]
    a, b = (run_scenario(scenario, 3, seed=2).error for scenario in named)
    assert np.abs(a - b).min() > 0.0
    np.testing.assert_array_equal(a, run_scenario(named[0], 3, seed=2).error)


def test_the_last_row_is_all_answers_together() -> None:
    # Errors of one sigma in each direction of 30 trials, of two in each of 10.
    rows = [
        Covered(Scenario(name, ideal_scene), trials, np.full((count, 3), size),
                np.tile(np.eye(3), (count, 1, 1)))
        for name, trials, count, size in (('good', 40, 30, 1.0), ('bad', 20, 10, 2.0))]
    last = [cell.strip() for cell in coverage_table(rows).splitlines()[-1].split('|')[1:-1]]
    low, high = chi2.ppf([0.025, 0.975], 120) / 40
    assert last == [
        'all', '40 of 60', f'{(30 * 3 + 10 * 12) / 40:.2f}', f'{low:.2f} to {high:.2f}',
        '0.750', '1.000', '1.000', '', '', 'too sure']


def test_wheels_are_as_uncertain_in_every_trial() -> None:
    # Three of four tapes gone, most images are refused: the pose is carried on by the wheels.
    one = Scenario('one line', lambda: ideal_scene(640, 0.02), seen=('west',))
    yaw_sigma = np.sqrt(run_scenario(one, 6, seed=2).covariance[:, 2, 2])
    carried = yaw_sigma[yaw_sigma > 0.005]
    assert len(carried) >= 3
    np.testing.assert_allclose(carried, carried[0], rtol=1e-3)
