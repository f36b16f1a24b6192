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
"""Metrics against trajectories and covariances whose answers are known beforehand."""

from __future__ import annotations

import json
import math

from hypothesis import given
from hypothesis import strategies as st
from nccs_pose.evaluation.metrics import (
    compare,
    consistency,
    expected_coverage,
    interpolate,
    nees,
    Statistic,
    summarise,
)
from nccs_pose.evaluation.tables import as_numbers, consistency_table, summary_table, table
from nccs_pose.evaluation.trajectory import Trajectory
from nccs_pose.geometry.pose import Pose2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

T0 = 1_700_000_000_123_456_789
MS = 1_000_000


def arc(stamps_ns: np.ndarray) -> np.ndarray:
    """A circle of radius 1 m, 0.3 rad/s, that passes yaw = pi."""
    angle = 0.3 * (stamps_ns - T0) * 1e-9 + 2.0
    return np.column_stack([np.cos(angle), np.sin(angle), angle + np.pi / 2])


def wrapped(poses: np.ndarray) -> np.ndarray:
    out = poses.copy()
    out[:, 2] = np.arctan2(np.sin(poses[:, 2]), np.cos(poses[:, 2]))
    return out


TRUTH_STAMPS = T0 + np.arange(0, 3000, 50) * MS
TRUTH = Trajectory(TRUTH_STAMPS, wrapped(arc(TRUTH_STAMPS)))


def test_a_known_offset_comes_back_as_the_error() -> None:
    stamps = T0 + np.arange(7, 2900, 83) * MS
    offset = np.array([0.03, -0.04, 0.01])
    errors = compare(Trajectory(stamps, wrapped(arc(stamps) + offset)), TRUTH)
    assert errors.index.tolist() == list(range(len(stamps)))
    # between samples 50 ms apart a chord is at most (0.3 * 0.05)^2 / 8 = 28 um from its arc
    np.testing.assert_allclose(errors.error, np.tile(offset, (len(stamps), 1)), atol=3e-5)
    np.testing.assert_allclose(errors.translation, 0.05, atol=3e-5)
    np.testing.assert_allclose(errors.yaw, 0.01, atol=1e-9)


@given(st.floats(-3.0, 3.0), st.floats(-3.0, 3.0), st.integers(0, 100))
def test_yaw_is_interpolated_as_rotations_are(start: float, end: float, share: int) -> None:
    if abs(abs(Pose2(yaw=end - start).yaw) - math.pi) < 1e-3:
        return  # half a turn: either way is the short one
    two = Trajectory([T0, T0 + 100 * MS], [[0, 0, start], [1, -2, end]])
    poses, known = interpolate(two, np.array([T0 + share * MS]))
    assert known.all()
    slerp = Slerp([0, 100], Rotation.from_euler('z', [[start], [end]]))(share)
    assert abs(Pose2(yaw=poses[0, 2] - slerp.as_euler('zyx')[0]).yaw) < 1e-9
    np.testing.assert_allclose(poses[0, :2], [share / 100, -share / 50], atol=1e-12)


def test_no_truth_is_made_up_outside_or_across_gaps() -> None:
    truth = Trajectory(
        [T0, T0 + 100 * MS, T0 + 900 * MS], [[0, 0, 0], [1, 0, 0], [9, 0, 0]])
    asked = T0 + np.array([-2, -1, 0, 50, 100, 101, 500, 899, 900, 901, 950]) * MS
    poses, known = interpolate(truth, asked)
    assert known.tolist() == [
        False, True, True, True, True, True, False, True, True, True, False]
    np.testing.assert_allclose(
        poses[known][:, 0], [0, 0, 0.5, 1, 1, 9, 9, 9])
    poses, known = interpolate(truth, asked, max_gap=1.0)
    assert known.tolist() == [False] + [True] * 9 + [False]
    assert poses[6, 0] == pytest.approx(5.0)
    assert not interpolate(Trajectory([], []), asked)[1].any()


def test_an_exact_stamp_gets_its_own_sample_even_at_a_teleport() -> None:
    truth = Trajectory([T0, T0 + 1, T0 + 2], [[0, 0, 0], [5, 0, 1], [5, 1, 1]])
    poses, known = interpolate(truth, np.array([T0, T0 + 1, T0 + 2]))
    assert known.all()
    np.testing.assert_array_equal(poses, truth.poses)


def test_disordered_and_repeated_stamps_do_not_matter() -> None:
    order = np.random.default_rng(1).permutation(len(TRUTH))
    shuffled = Trajectory(
        np.r_[TRUTH.stamps_ns[order], TRUTH.stamps_ns[:3]],
        np.r_[TRUTH.poses[order], TRUTH.poses[:3] + 1])
    stamps = T0 + np.arange(400, 900, 7) * MS
    np.testing.assert_array_equal(
        interpolate(shuffled, stamps)[0], interpolate(TRUTH, stamps)[0])


def test_statistics_of_known_values() -> None:
    assert Statistic.of(np.array([3.0, 1.0, 2.0, 4.0])) == Statistic(2.5, math.sqrt(7.5), 4.0)
    assert all(math.isnan(v) for v in vars(Statistic.of(np.zeros(0))).values())


def gaussian(count: int, scale: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(4)
    factors = rng.normal(size=(count, 3, 3)) * [1e-3, 1e-2, 1e-4]
    covariances = factors @ factors.transpose(0, 2, 1) + 1e-8 * np.eye(3)
    roots = np.linalg.cholesky(covariances)
    error = np.einsum('nij,nj->ni', roots, rng.normal(size=(count, 3)))
    return scale * error, covariances


def test_true_covariances_are_found_true_and_small_ones_small() -> None:
    error, covariance = gaussian(4000)
    result = consistency(error, covariance)
    low, high = result.band
    assert low < result.mean_nees < high
    np.testing.assert_allclose(
        result.coverage, np.tile([[0.6827], [0.9545], [0.9973]], 3), atol=0.025)
    np.testing.assert_allclose(expected_coverage(), [0.6827, 0.9545, 0.9973], atol=1e-4)
    # the band by brute force: means of 4000 draws of a chi-square with 3 degrees of freedom
    means = np.random.default_rng(0).chisquare(3 * 4000, 20000) / 4000
    np.testing.assert_allclose(result.band, np.percentile(means, [2.5, 97.5]), atol=0.004)
    proud = consistency(2.0 * error, covariance)
    assert proud.mean_nees == pytest.approx(4.0 * result.mean_nees)
    assert proud.mean_nees > proud.band[1]
    assert proud.coverage[0].max() < 0.45


def test_nees_is_the_squared_mahalanobis_distance() -> None:
    error, covariance = gaussian(20)
    expected = [e @ np.linalg.inv(c) @ e for e, c in zip(error, covariance)]
    np.testing.assert_allclose(nees(error, covariance), expected, rtol=1e-6)


def test_tables_show_mm_and_degrees_and_numbers_si() -> None:
    offset = np.array([0.003, 0.004, math.radians(0.5)])
    estimated = Trajectory(TRUTH_STAMPS[:5], TRUTH.poses[:5] + offset)
    errors = compare(estimated, TRUTH)
    summary = summarise(errors, frames=7, answered=6)
    text = summary_table(summary)
    assert '6 of 7 frames answered, 1 not; 5 compared' in text
    row = next(line for line in text.splitlines() if 'translation' in line)
    assert [cell.strip() for cell in row.strip('|').split('|')] == [
        'translation (mm)', '5.00', '5.00', '5.00']
    assert '0.5000' in next(line for line in text.splitlines() if 'yaw' in line)
    result = consistency(errors.error, np.tile(np.diag([36e-6, 64e-6, 1e-4]), (5, 1, 1)))
    numbers = json.loads(json.dumps(as_numbers(summary, result)))
    assert numbers['translation_m']['rmse'] == pytest.approx(0.005)
    assert numbers['yaw_rad']['max'] == pytest.approx(math.radians(0.5))
    assert numbers['nees']['mean'] == pytest.approx(0.25 + 0.25 + math.radians(0.5)**2 / 1e-4)
    assert numbers['coverage']['1_sigma'] == {'x': 1.0, 'y': 1.0, 'yaw': 1.0}
    assert 'NEES 1.26 over 5 poses' in consistency_table(result)


def test_nothing_to_compare_is_nothing_not_a_crash() -> None:
    empty = compare(Trajectory([], []), TRUTH)
    summary = summarise(empty, frames=3, answered=0)
    assert json.loads(json.dumps(as_numbers(summary, consistency(empty.error, np.zeros((0, 3, 3)))
                                            )))['translation_m']['rmse'] is None
    assert '0 of 3 frames' in summary_table(summary)


def test_a_table_is_aligned_markdown() -> None:
    lines = table([['', 'a'], ['long name', '1'], ['b', '100']]).splitlines()
    assert len({len(line) for line in lines}) == 1
    assert lines[1] == '|:----------|----:|'
