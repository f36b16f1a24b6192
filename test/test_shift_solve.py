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

"""The step that shifts across bands ask for: derivatives, priors, outliers, covariance."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

from nccs_pose.estimation.prediction import BandPredictor
from nccs_pose.estimation.refine import Refinement
from nccs_pose.estimation.shift_solve import Prior, weigh_shifts
from nccs_pose.geometry.floor_table import FloorTable
from nccs_pose.geometry.lines import Line, LineMap
from nccs_pose.geometry.pose import Pose2, RigidTransform
from nccs_pose.geometry.rig import Rig
from nccs_pose.simulation.scene import arena_map, arena_rig
import numpy as np
import pytest
from scipy.optimize import least_squares

POSE = Pose2(0.3, -0.2, 0.6)
RIG, MAP = arena_rig(), arena_map()


@pytest.fixture(scope='module')
def slide() -> np.ndarray:
    """d(shift)/d(x, y, yaw, z, roll, pitch) of the stations seen from POSE (N, 6)."""
    predictor = BandPredictor(FloorTable(RIG, 5.0), MAP)
    return predictor.bands(predictor.places(POSE, 16.0, 75), POSE)[1]


def _solved(shift: np.ndarray, *rest: Any, **options: Any) -> Refinement:
    return weigh_shifts(shift, *rest, **options).solve(shift)


def _each(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Groups of stations of which each stands for itself, on one line."""
    return np.arange(count), np.zeros(count, dtype=int)


def _off_plane(rig: Rig, unknown: int, step: float) -> Rig:
    """The rig on a base that has risen, or turned about its x or y axis, by a little."""
    rpy, rise = np.zeros(3), np.zeros(3)
    if unknown == 3:
        rise[2] = step
    else:
        rpy[unknown - 4] = step
    return dataclasses.replace(
        rig, T_base_mirror=RigidTransform.from_rpy(rpy, rise) @ rig.T_base_mirror)


@pytest.mark.parametrize('unknown', range(6))
def test_stations_move_as_the_exact_projection_of_their_points_does(unknown: int) -> None:
    predictor = BandPredictor(FloorTable(RIG, 5.0), MAP)
    places = predictor.places(POSE, 16.0, 75)
    bands, slide = predictor.bands(places, POSE)
    assert len(bands) == len(places) > 50
    on_map = np.array([
        MAP[k].start + d * MAP[k].direction
        for k, d in zip(places.number.tolist(), places.distance.tolist())])
    h = 1e-4

    def across(step: float) -> np.ndarray:
        pose = POSE.as_array()
        if unknown < 3:
            pose[unknown] += step
        rig = RIG if unknown < 3 else _off_plane(RIG, unknown, step)
        pixels, seen = rig.project(Pose2.from_array(pose).inverse().apply(on_map))
        assert seen.all()
        return np.einsum('ni,ni->n', pixels, bands.across)

    numeric = (across(h) - across(-h)) / (2.0 * h)
    assert np.abs(numeric - slide[:, unknown]).max() < 2e-3 * np.abs(numeric).max()


@pytest.mark.parametrize('degrees', [0.1, 0.3, 0.6])
def test_stations_are_predicted_under_a_base_that_leans_and_has_risen(degrees: float) -> None:
    predictor = BandPredictor(FloorTable(RIG, 5.0), MAP)
    places = predictor.places(POSE, 16.0, 75)
    roll, pitch, rise = math.radians(degrees), -0.7 * math.radians(degrees), 0.002
    bands, _ = predictor.bands(places, POSE, np.array([rise, roll, pitch]))
    leaning = dataclasses.replace(RIG, T_base_mirror=RigidTransform.from_rpy(
        (roll, pitch, 0.0), (0.0, 0.0, rise)) @ RIG.T_base_mirror)
    pixels, seen = leaning.project(POSE.inverse().apply(np.array([
        MAP[k].start + d * MAP[k].direction
        for k, d in zip(places.number.tolist(), places.distance.tolist())])))
    level, _ = predictor.bands(places, POSE)
    assert len(bands) == len(level) == seen.sum()
    # Along the tape a station may stand where it likes.
    off = np.abs(np.einsum('ni,ni->n', bands.midline - pixels, bands.across))
    moved = np.abs(np.einsum('ni,ni->n', level.midline - pixels, level.across))
    assert moved.max() > 3.0 * degrees
    # What many stations tell together is ten times finer than a hundredth of a pixel.
    assert off.max() < 0.003


def test_no_station_stands_where_another_tape_is_beside_it() -> None:
    # Two tapes that run together, and one that crosses one of them.
    close = LineMap(tuple(
        Line(np.array([*start, 0.0]), np.array([*end, 0.0]), 0.05)
        for start, end in [((1.5, -1.0), (1.7, 1.3)), ((1.4, -1.0), (1.45, 0.3)),
                           ((0.9, 0.8), (2.1, 0.9))]))
    predictor = BandPredictor(FloorTable(RIG, 5.0), close)
    places = predictor.places(POSE, 2.0, 150)
    bands, _ = predictor.bands(places, POSE)
    nearest = np.full(len(bands), np.inf)
    for k, other in enumerate(close):
        along = np.linspace(0.0, other.length, 2000)[:, None]
        left = 0.5 * other.width * np.array([-other.direction[1], other.direction[0], 0.0])
        edges = np.concatenate([
            other.start + along * other.direction + side * left for side in (-1.0, 1.0)])
        pixels, seen = RIG.project(POSE.inverse().apply(edges))
        distance = np.linalg.norm(bands.midline[:, None] - pixels[seen], axis=2).min(axis=1)
        nearest = np.where(bands.label == k, nearest, np.minimum(
            nearest, distance - bands.half_width))
    assert (np.bincount(bands.label, minlength=3) > 10).all()
    assert len(bands) < len(places) - 10
    # Of the 4 px some are lost where the other tape lies ahead: along a tape the image is finer.
    assert nearest.min() > 2.5


def test_every_line_has_whole_groups_of_neighbours() -> None:
    # Where they cross, stations of both are given up.
    crossing = LineMap(tuple(
        Line(np.array([*start, 0.0]), np.array([*end, 0.0]), 0.05)
        for start, end in [((1.5, -1.0), (1.7, 1.3)), ((0.9, 0.3), (2.1, 0.4))]))
    predictor = BandPredictor(FloorTable(RIG, 5.0), crossing)
    places = predictor.places(POSE, 2.0, 75)
    for chosen in (places, places.every(4)):
        bands, slide = predictor.bands(chosen, POSE)
        assert bands.members > 1
        assert len(slide) == len(bands)
        for number in (chosen.number, bands.label):
            assert (np.bincount(number) % bands.members == 0).all()
    # As long a stretch of line as may share one floor, px.
    assert 10.0 < bands.members * bands.spacing.mean() < 24.0
    kept = predictor.bands(places, POSE)[0]
    assert 0 < len(places) - len(kept) < 0.3 * len(places)


def test_without_outliers_it_is_weighted_least_squares(slide: np.ndarray) -> None:
    rng = np.random.default_rng(1)
    sigma = rng.uniform(0.5, 2.0, len(slide))
    shift = slide[:, :3] @ [0.004, -0.006, 0.003] + 0.01 * sigma * rng.uniform(
        -1.0, 1.0, len(slide))
    found = _solved(shift, 0.01 * sigma, slide, *_each(len(slide)), POSE)
    assert found.inlier.all()
    best = least_squares(lambda v: (shift - slide[:, :3] @ v) / sigma, np.zeros(3), xtol=1e-15)
    np.testing.assert_allclose(
        found.pose.as_array(), POSE.as_array() + best.x, atol=1e-6)


def test_a_third_of_outliers_changes_little(slide: np.ndarray) -> None:
    rng = np.random.default_rng(2)
    step = np.array([0.004, -0.006, 0.003])
    shift = slide[:, :3] @ step + 0.02 * rng.standard_normal(len(slide))
    wrong = rng.random(len(slide)) < 0.3
    shift[wrong] += rng.uniform(0.5, 3.0, int(wrong.sum()))
    found = _solved(shift, np.full(len(slide), 0.02), slide, *_each(len(slide)), POSE)
    assert not found.inlier[wrong].any()
    error = found.pose.as_array() - POSE.as_array() - step
    assert error @ np.linalg.solve(found.covariance, error) < 16.3


def test_what_disturbs_a_stretch_is_seen_in_its_sum() -> None:
    predictor = BandPredictor(FloorTable(RIG, 5.0), MAP)
    slide = predictor.bands(predictor.places(POSE, 2.0, 75), POSE)[1]
    group, sigma = np.arange(len(slide)) // 6, np.full(len(slide), 0.02)
    rng = np.random.default_rng(8)
    refused, squares = [], []
    for _ in range(100):
        # No station tells by itself that it is 2.5 sigma off; six of them do together.
        wrong = np.isin(group, rng.permutation(group[-1] + 1)[:6])
        shift = 0.02 * rng.standard_normal(len(slide)) + 0.05 * wrong
        each = _solved(shift, sigma, slide, *_each(len(slide)), POSE)
        found = _solved(shift, sigma, slide, group, np.zeros(len(slide), int), POSE)
        refused.append([(~found.inlier[wrong]).mean(), (~found.inlier[~wrong]).mean()])
        squares.append([
            np.square(way.pose.as_array() - POSE.as_array()) for way in (found, each)])
    caught, lost = np.mean(refused, axis=0)
    assert caught > 0.8
    assert lost < 0.1
    by_sum, one_by_one = np.sqrt(np.mean(squares, axis=0))
    assert (by_sum < 0.7 * one_by_one).all()


@pytest.mark.parametrize('attitude', [(0.0, 0.0), (0.001, 0.0), (0.001, 0.003)])
def test_the_covariance_is_the_scatter(
        slide: np.ndarray, attitude: tuple[float, float]) -> None:
    rng = np.random.default_rng(3)
    deviation = np.array([attitude[0], attitude[1], attitude[1]])
    nees = []
    for _ in range(300):
        off = deviation * rng.standard_normal(3)
        shift = slide[:, 3:] @ off + 0.05 * rng.standard_normal(len(slide))
        found = _solved(
            shift, np.full(len(slide), 0.05), slide, *_each(len(slide)), POSE,
            attitude_sigma=attitude)
        error = found.pose.as_array() - POSE.as_array()
        nees.append(error @ np.linalg.solve(found.covariance, error))
    # 99.9 % band of the mean of 300 chi-squares with three degrees of freedom.
    assert 2.55 < np.mean(nees) < 3.49


def test_errors_of_which_some_are_large_let_the_pose_slide(slide: np.ndarray) -> None:
    # The more of them stand where their weights fall, the further an error moves the pose.
    rng = np.random.default_rng(11)
    nees = []
    for _ in range(600):
        size = np.where(rng.random(len(slide)) < 0.2, 0.15, 0.05)
        shift = size * rng.standard_normal(len(slide))
        found = _solved(
            shift, np.full(len(slide), 0.05), slide, *_each(len(slide)), POSE)
        error = found.pose.as_array() - POSE.as_array()
        nees.append(error @ np.linalg.solve(found.covariance, error))
    # 99.9 % band of the mean of 600 chi-squares with three degrees of freedom.
    assert 2.68 < np.mean(nees) < 3.34


def test_the_sigma_told_is_relative(slide: np.ndarray) -> None:
    shift = 0.05 * np.random.default_rng(4).standard_normal(len(slide))
    one = _solved(shift, np.full(len(slide), 0.05), slide, *_each(len(slide)), POSE)
    two = _solved(shift, np.full(len(slide), 0.1), slide, *_each(len(slide)), POSE)
    np.testing.assert_allclose(one.covariance, two.covariance, rtol=0.1)


def test_a_prior_decides_what_the_stations_leave_open(slide: np.ndarray) -> None:
    # Stations that move with x alone say nothing of y and yaw.
    blind = np.zeros_like(slide)
    blind[:, 0] = 300.0
    covariance = np.diag([1.0, 0.04, 0.01])
    found = _solved(
        np.full(len(slide), 3.0), np.full(len(slide), 0.05), blind, *_each(len(slide)), POSE,
        prior=Prior(Pose2(0.3, 0.1, 0.5), np.linalg.inv(covariance)))
    np.testing.assert_allclose(found.pose.as_array(), [0.31, 0.1, 0.5], atol=1e-3)
    np.testing.assert_allclose(np.diag(found.covariance)[1:], [0.04, 0.01], rtol=1e-2)


def test_what_the_calibration_shifts_no_number_of_stations_averages_out(
        slide: np.ndarray) -> None:
    across = np.random.default_rng(5).normal(size=(len(slide), 2))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    # Far below the noise told, all weights are one.
    shift = 0.0001 * np.random.default_rng(6).standard_normal(len(slide))
    sigma = np.full(len(slide), 0.001)
    found = _solved(shift, sigma, slide, *_each(len(slide)), POSE, image_sigma=0.1 * across)
    # A shift of the image by (u, v) moves the pose by -G (u, v), G from least squares.
    moved = np.linalg.lstsq(slide[:, :3], across, rcond=None)[0]
    expected = 0.01 * moved @ moved.T
    np.testing.assert_allclose(found.covariance, expected, rtol=0.05, atol=1e-9)
