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

"""The residual and its refinement against geometry, finite differences, scipy and statistics."""

from __future__ import annotations

from dataclasses import replace

from hypothesis import given
from hypothesis import strategies as st
from nccs_pose.errors import EstimationError
from nccs_pose.estimation.refine import refine
from nccs_pose.estimation.residual import lines_in_base, side, whitened_residual
from nccs_pose.estimation.side_form import SideForm
from nccs_pose.geometry import Line, LineMap, Pose2, Rays, Rig
from nccs_pose.simulation.table_one import TABLE_ONE
import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.stats import chi2

MIXED = LineMap((
    Line([-1.6, -1.55, 0.0], [1.25, -1.65, 0.0]), Line([1.75, -1.2, 0.0], [1.95, 1.05, 0.0]),
    Line([1.05, 1.55, 0.0], [-1.45, 1.85, 0.0]), Line([-2.1, 1.2, 0.0], [-1.8, -0.9, 0.0]),
    Line([1.2, 1.1, 0.0], [1.2, 1.1, 0.6]), Line([-1.0, 1.2, 0.1], [0.4, 1.5, 0.5])))
FLOOR = LineMap(MIXED.lines[:4])


def seen(
    rig: Rig, line_map: LineMap, pose: Pose2, n: int, rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray]:
    """Pixels of n random points a line that the rig sees from a pose, and their labels."""
    pixels, labels = [], []
    for k, line in enumerate(line_map):
        points = line.start + rng.uniform(0, line.length, (6 * n, 1)) * line.direction
        found, visible = rig.project(pose.inverse().apply(points))
        pixels.append(found[visible][:n])
        labels.append(np.full(len(pixels[-1]), k))
    return np.concatenate(pixels), np.concatenate(labels)


def problem(
    name: str, line_map: LineMap, pose: Pose2, n: int, noise: float, seed: int,
) -> tuple[Rays, np.ndarray, np.ndarray]:
    """Rays of noisy pixels with the lines that they belong to."""
    rng = np.random.default_rng(seed)
    rig = TABLE_ONE[name]
    pixels, label = seen(rig, line_map, pose, n, rng)
    rays = rig.back_project(pixels + noise * rng.normal(size=pixels.shape))
    label = label[rays.hit]
    return rays[rays.hit], line_map.directions[label], line_map.moments[label]


@pytest.mark.parametrize('name', TABLE_ONE)
def test_side_is_the_distance_between_ray_and_line_times_the_sine_between_them(name: str) -> None:
    rays, d, mu = problem(name, MIXED, Pose2(0.1, -0.2, 0.7), 30, 3.0, 0)
    pose = Pose2(0.13, -0.1, 0.75)
    origin = np.cross(rays.direction, rays.moment)
    a, u = pose.apply(origin), pose.apply(rays.direction) - pose.translation
    q = np.cross(d, mu)
    common = np.cross(u, d)
    distance = np.einsum('ni,ni->n', q - a, common) / np.linalg.norm(common, axis=1)
    sine = np.linalg.norm(common, axis=1)
    s = side(rays, d, mu, pose)
    np.testing.assert_allclose(np.abs(s), np.abs(distance * sine), atol=1e-12)


@pytest.mark.parametrize('name', TABLE_ONE)
@pytest.mark.parametrize('sigma_world', [0.0, 0.02])
def test_jacobians_agree_with_finite_differences(name: str, sigma_world: float) -> None:
    rays, d, mu = problem(name, MIXED, Pose2(0.1, -0.2, 0.7), 20, 2.0, 1)
    at = np.array([0.12, -0.15, 0.72])
    sigma = np.linspace(0.1, 2.0, len(rays))
    _, exact = whitened_residual(rays, d, mu, Pose2.from_array(at), sigma, sigma_world)
    for k in range(3):
        step = np.zeros(3)
        step[k] = 1e-6
        plus, minus = (whitened_residual(
            rays, d, mu, Pose2.from_array(at + way * step), sigma, sigma_world)[0]
            for way in (1, -1))
        numeric = (plus - minus) / 2e-6
        np.testing.assert_allclose(exact[:, k], numeric, rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize('name', TABLE_ONE)
@pytest.mark.parametrize('sigma_world', [0.0, 0.01])
def test_the_prepared_form_is_the_residual(name: str, sigma_world: float) -> None:
    rays, d, mu = problem(name, MIXED, Pose2(0.1, -0.2, 0.7), 20, 2.0, 1)
    pose, sigma = np.array([0.12, -0.15, 0.72]), np.linspace(0.1, 2.0, len(rays))
    e, jacobian = SideForm(rays, d, mu, sigma, sigma_world).residual(pose)
    expected, slopes = whitened_residual(
        rays, d, mu, Pose2.from_array(pose), sigma, sigma_world)
    np.testing.assert_allclose(e, expected, atol=1e-9)
    np.testing.assert_allclose(jacobian, slopes, atol=1e-7)


@pytest.mark.parametrize('name', TABLE_ONE)
def test_the_residual_is_the_distance_in_the_image(name: str) -> None:
    rig, pose = TABLE_ONE[name], Pose2(0.1, -0.2, 0.7)
    pixels, label = seen(rig, FLOOR, pose, 20, np.random.default_rng(2))
    rays = rig.back_project(pixels)
    d, mu = FLOOR.directions[label], FLOOR.moments[label]
    in_base, moment = lines_in_base(d, mu, pose)
    gradient = (np.einsum('nij,ni->nj', rays.direction_jacobian, moment)
                + np.einsum('nij,ni->nj', rays.moment_jacobian, in_base))
    normal = gradient / np.linalg.norm(gradient, axis=1, keepdims=True)
    for shift in (0.5, -0.2):
        moved = rig.back_project(pixels + shift * normal)
        e, _ = whitened_residual(moved, d, mu, pose)
        # First order in the shift: the curve bends by less than 1 % of it.
        np.testing.assert_allclose(e[moved.hit], shift, rtol=0.02)


@given(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5), st.floats(-3.1, 3.1),
       st.sampled_from(sorted(TABLE_ONE)))
def test_noise_free_pixels_give_the_pose_back(x: float, y: float, yaw: float, name: str) -> None:
    truth = Pose2(x, y, yaw)
    rays, d, mu = problem(name, MIXED, truth, 20, 0.0, 3)
    found = refine(rays, d, mu, truth @ Pose2(0.1, -0.08, 0.1))
    error = found.pose.inverse() @ truth
    assert found.converged
    assert np.hypot(error.x, error.y) < 1e-8
    assert abs(error.yaw) < 1e-8


@pytest.mark.parametrize('name', TABLE_ONE)
def test_scipy_reaches_the_same_minimum(name: str) -> None:
    rays, d, mu = problem(name, MIXED, Pose2(0.1, -0.2, 0.7), 20, 1.0, 4)
    found = refine(rays, d, mu, Pose2(0.12, -0.2, 0.7), robust=False)
    other = least_squares(
        lambda p: whitened_residual(rays, d, mu, Pose2.from_array(p))[0], [0.12, -0.2, 0.7],
        xtol=1e-14, ftol=1e-14, gtol=1e-14)
    np.testing.assert_allclose(found.pose.as_array(), other.x, atol=1e-7)


def test_a_third_of_gross_outliers_moves_the_pose_within_its_noise() -> None:
    truth = Pose2(0.1, -0.2, 0.7)
    rays, d, mu = problem('spherical', FLOOR, truth, 75, 0.5, 5)
    wrong = np.random.default_rng(6).uniform(size=len(rays)) < 0.33
    others = FLOOR.lines[0]
    d, mu = d.copy(), mu.copy()
    d[wrong], mu[wrong] = others.direction, others.moment
    found = refine(rays, d, mu, Pose2(0.13, -0.22, 0.72), sigma=0.5)
    error = (found.pose.as_array() - truth.as_array())
    assert error @ np.linalg.solve(found.covariance, error) < chi2.ppf(0.9999, 3)


def test_the_covariance_is_that_of_the_errors() -> None:
    truth, scores = Pose2(0.1, -0.2, 0.7), []
    for seed in range(200):
        rays, d, mu = problem('spherical', FLOOR, truth, 25, 0.7, 100 + seed)
        found = refine(rays, d, mu, truth, sigma=0.7)
        error = found.pose.as_array() - truth.as_array()
        scores.append(error @ np.linalg.solve(found.covariance, error))
    low, high = chi2.ppf([0.0005, 0.9995], 3 * len(scores))
    assert low < np.sum(scores) < high


def test_a_single_line_leaves_its_own_direction_open_and_finite() -> None:
    rays, d, mu = problem('spherical', LineMap(FLOOR.lines[:1]), Pose2(0.0, 0.0, 0.3), 75, 0.2, 7)
    found = refine(rays, d, mu, Pose2(0.0, 0.0, 0.3), sigma=0.2)
    along = FLOOR.lines[0].direction[:2]
    across = np.array([-along[1], along[0]])
    c = found.covariance[:2, :2]
    assert np.linalg.eigvalsh(found.covariance).min() > 0.0
    assert along @ c @ along > 1e3
    assert across @ c @ across < 1e-3


def test_too_few_pixels_are_refused() -> None:
    rays, d, mu = problem('spherical', FLOOR, Pose2(), 1, 0.0, 9)
    with pytest.raises(EstimationError, match='2 pixels'):
        refine(rays[:2], d[:2], mu[:2], Pose2())


@pytest.mark.parametrize(
    ('change', 'word'),
    [
        (lambda r, d, mu: (replace(r, direction=r.direction * np.nan), d, mu), 'ray directions'),
        (lambda r, d, mu: (replace(r, moment=r.moment * np.inf), d, mu), 'ray moments'),
        (lambda r, d, mu: (r, d * np.nan, mu), 'directions of the lines'),
        (lambda r, d, mu: (r, d * 0.0, mu), 'unit length'),
        (lambda r, d, mu: (r, d, mu * np.nan), 'moments of the lines'),
        (lambda r, d, mu: (replace(r, hit=r.hit & False), d, mu), 'miss the mirror'),
    ])
def test_impossible_input_is_refused_by_name(change, word: str) -> None:
    rays, d, mu = change(*problem('spherical', FLOOR, Pose2(), 5, 0.0, 9))
    with pytest.raises(EstimationError, match=word):
        refine(rays, d, mu, Pose2())


@pytest.mark.parametrize('sigma', [0.0, -1.0, np.nan, np.inf])
def test_impossible_noise_is_refused(sigma: float) -> None:
    with pytest.raises(EstimationError, match='sigma'):
        refine(*problem('spherical', FLOOR, Pose2(), 5, 0.0, 9), Pose2(), sigma=sigma)
