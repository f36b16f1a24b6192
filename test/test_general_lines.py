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

"""Vertical, slanted and mixed lines: brute force, PoseLib, truth and the virtual branch."""

from __future__ import annotations

import math

from hypothesis import given
from hypothesis import strategies as st
from labelled_scene import pose_error, random_direction, random_scene
from nccs_pose.errors import EstimationError
from nccs_pose.estimation.general_lines import all_minima, general_minima, ratio, YAWS
from nccs_pose.estimation.global_minimum import global_minimum, is_global, proved_minimum
from nccs_pose.estimation.global_pose import best_pose, solve
from nccs_pose.estimation.local_minimum import minimum_near
from nccs_pose.estimation.pose_monomials import gram, monomial_rows, monomials
from nccs_pose.estimation.refine import refine
from nccs_pose.estimation.residual import side, whitened_residual
from nccs_pose.geometry.pose import Pose2
from nccs_pose.geometry.rig import Rays
from nccs_pose.simulation.table_one import TABLE_ONE
import numpy as np
import pytest
from scipy.optimize import least_squares

RIGS = sorted(TABLE_ONE)
GENERAL = ('slanted',) * 5
MIXED = ('floor', 'floor', 'vertical', 'slanted', 'slanted')
# 1, 0, cos yaw, sin yaw, .. sin 4 yaw at the sampled yaws.
FOURIER = np.exp(1j * YAWS[:, None] * np.arange(5)).view(float)
SLANTED = np.array([[0.6, 0.0, 0.8]])
# Median of chi-square with 3 degrees of freedom.
MEDIAN_NEES = 2.366


def best_at(rows, yaws):
    """Cost (K,) and translation (K, 2) at each yaw, by linear least squares on the rows."""
    cost, translation = [], []
    for yaw in yaws:
        # S is affine in (x, y): its constant and slopes from three evaluations.
        base = rows @ monomials(Pose2(0.0, 0.0, yaw))
        slopes = np.stack([
            rows @ monomials(Pose2(1.0, 0.0, yaw)) - base,
            rows @ monomials(Pose2(0.0, 1.0, yaw)) - base], axis=1)
        t = np.linalg.lstsq(slopes, -base, rcond=None)[0]
        cost.append(np.sum((base + slopes @ t) ** 2))
        translation.append(t)
    return np.array(cost), np.array(translation)


def brute_force(rows, count=720):
    """All local minima: a dense grid in yaw, then scipy from each of its valleys."""
    yaws = np.linspace(-math.pi, math.pi, count, endpoint=False)
    cost, translation = best_at(rows, yaws)
    valleys = np.flatnonzero((cost < np.roll(cost, 1)) & (cost <= np.roll(cost, -1)))
    found = []
    for k in valleys:
        fit = least_squares(
            lambda v: rows @ monomials(Pose2.from_array(v)), [*translation[k], yaws[k]],
            xtol=1e-15, ftol=1e-15, gtol=1e-15)
        found.append((2.0 * fit.cost, Pose2.from_array(fit.x)))
    return sorted(found, key=lambda entry: entry[0])


@pytest.mark.parametrize('name', RIGS)
@pytest.mark.parametrize('kinds', [GENERAL, MIXED], ids=['slanted', 'mixed'])
@pytest.mark.parametrize('noise', [0.0, 1.0, 30.0])
def test_all_minima_against_a_grid_and_scipy(name, kinds, noise):
    scene = random_scene(
        TABLE_ONE[name], kinds, count=6, noise=noise, rng=np.random.default_rng(1))
    rays, directions, moments = scene.by_ray
    rows = monomial_rows(rays.direction, rays.moment, directions, moments)[rays.hit]
    minima, expected = general_minima(gram(rows.T, 1.0)), brute_force(rows)
    assert len(minima) == len(expected)
    for minimum, (cost, pose) in zip(minima, expected):
        assert np.abs(pose_error(minimum.pose, pose)).max() < 1e-5
        assert minimum.cost == pytest.approx(cost, rel=1e-6, abs=1e-12)


@pytest.mark.parametrize('seed', range(4))
def test_any_gram_matrix(seed):
    """Random forms have up to six minima, far more than lines make; none may be missed."""
    rng = np.random.default_rng(seed)
    several = 0
    for _ in range(8):
        rows = rng.standard_normal((rng.integers(4, 20), 7)) * 10.0 ** rng.uniform(-1, 1, 7)
        cost, _ = best_at(rows, np.linspace(-math.pi, math.pi, 1000, endpoint=False))
        valleys = np.count_nonzero((cost < np.roll(cost, 1)) & (cost <= np.roll(cost, -1)))
        minima = general_minima(gram(rows.T, 1.0))
        assert len(minima) == valleys
        assert minima[0].cost <= cost.min() * (1.0 + 1e-9)
        exact, translation = best_at(rows, [minima[0].pose.yaw])
        assert minima[0].cost == pytest.approx(exact[0], rel=1e-6)
        assert minima[0].pose.translation[:2] == pytest.approx(translation[0], rel=1e-6)
        several += valleys > 1
    assert several


@pytest.mark.parametrize('seed', range(4))
def test_what_is_proved_to_be_the_global_minimum_is(seed):
    """Forms made at random: nothing better on a dense grid, and no other minimum is proved."""
    rng = np.random.default_rng(seed)
    proved = refuted = 0
    for _ in range(20):
        rows = rng.standard_normal((rng.integers(4, 20), 7)) * 10.0 ** rng.uniform(-1, 1, 7)
        gram_matrix = gram(rows.T, 1.0)
        cost, _ = best_at(rows, np.linspace(-math.pi, math.pi, 180, endpoint=False))
        found = proved_minimum(gram_matrix)
        if found is not None:
            proved += 1
            assert found.cost <= cost.min() * (1.0 + 1e-9)
            exact, translation = best_at(rows, [found.pose.yaw])
            assert found.cost == pytest.approx(exact[0], rel=1e-6)
            assert found.pose.translation[:2] == pytest.approx(translation[0], rel=1e-6)
        best, *others = general_minima(gram_matrix)
        assert global_minimum(gram_matrix, SLANTED).cost == pytest.approx(best.cost, rel=1e-6)
        coefficients = np.linalg.lstsq(FOURIER, ratio(gram_matrix).T, rcond=None)[0]
        assert not any(is_global(coefficients, m.pose.yaw) for m in others)
        refuted += len(others)
    assert proved and refuted


@pytest.mark.parametrize('name', RIGS)
def test_the_minimum_that_lines_make_is_mostly_proved(name):
    """That is what makes it quick: else all minima are found."""
    rng, proved = np.random.default_rng(11), 0
    for _ in range(20):
        scene = random_scene(TABLE_ONE[name], GENERAL, noise=1.0, rng=rng)
        rays, directions, moments = scene.by_ray
        rows = monomial_rows(rays.direction, rays.moment, directions, moments).T
        proved += proved_minimum(gram(rows, 1.0)) is not None
    assert proved >= 16


def test_a_twin_is_not_proved_to_be_the_only_one():
    """The same form seen after half a turn about (0.4, -0.3), added to itself."""
    rng = np.random.default_rng(1)
    rows = rng.standard_normal((20, 7))
    # c, s, x, y, p, q, 1 of the pose turned: (-c, -s, 0.8 - x, -0.6 - y, p', q', 1), and p' =
    # -c (0.8 - x) - s (-0.6 - y), q' = -c (-0.6 - y) + s (0.8 - x).
    turn = np.diag([-1.0, -1.0, -1.0, -1.0, 1.0, 1.0, 1.0])
    turn[2, 6], turn[3, 6] = 0.8, -0.6
    turn[4, :2], turn[5, :2] = (-0.8, 0.6), (0.6, 0.8)
    both = np.concatenate([rows, rows @ turn])
    minima = general_minima(gram(both.T, 1.0))
    assert minima[0].cost == pytest.approx(minima[1].cost)
    assert proved_minimum(gram(both.T, 1.0)) is None
    assert global_minimum(gram(both.T, 1.0), SLANTED).cost == pytest.approx(minima[0].cost)


@pytest.mark.parametrize('kinds', [GENERAL, MIXED, ('floor',) * 4, ('vertical',) * 4])
def test_a_minimum_follows_the_weights(kinds):
    """Newton's method from the old minimum against all minima found anew."""
    scene = random_scene(TABLE_ONE['parabolic'], kinds, noise=3.0, rng=np.random.default_rng(9))
    rays, directions, moments = scene.by_ray
    rows = monomial_rows(rays.direction, rays.moment, directions, moments).T
    old = all_minima(gram(rows, 1.0), scene.directions)[0]
    weighted = gram(rows, np.random.default_rng(10).uniform(0.2, 5.0, rows.shape[1]))
    new = minimum_near(weighted, scene.directions, old.pose)
    expected = all_minima(weighted, scene.directions)[0]
    assert 1e-5 < np.abs(pose_error(new.pose, old.pose)).max() < 0.1
    assert np.abs(pose_error(new.pose, expected.pose)).max() < 1e-7
    assert new.cost == pytest.approx(expected.cost, rel=1e-6)


@pytest.mark.parametrize('kinds', [GENERAL, MIXED], ids=['slanted', 'mixed'])
@pytest.mark.parametrize('name', RIGS)
def test_reduced_cost_is_a_ratio_of_low_degrees(name, kinds):
    """Det Q has degree 4 and its 2 x 2 minor degree 2, where counting says 6 and 4."""
    scene = random_scene(
        TABLE_ONE[name], kinds, noise=5.0, count=6, rng=np.random.default_rng(2))
    rays, directions, moments = scene.by_ray
    rows = monomial_rows(rays.direction, rays.moment, directions, moments)
    full, minor = [], []
    for yaw in 2.0 * math.pi * np.arange(32) / 32:
        base = monomials(Pose2(0.0, 0.0, yaw))
        v = np.stack([
            monomials(Pose2(1.0, 0.0, yaw)) - base, monomials(Pose2(0.0, 1.0, yaw)) - base,
            base], axis=1)
        q = (rows @ v).T @ (rows @ v)
        full.append(np.linalg.det(q))
        minor.append(np.linalg.det(q[:2, :2]))
    full, minor = np.abs(np.fft.rfft(full)), np.abs(np.fft.rfft(minor))
    assert full[4] > 1e-9 * full[0] and full[5:].max() < 1e-12 * full[0]
    assert minor[2] > 1e-9 * minor[0] and minor[3:].max() < 1e-12 * minor[0]


@pytest.mark.parametrize('name', RIGS)
def test_poselib_agrees_without_noise(name):
    """Its upright generalised point-to-line solver: four rays, gravity along y, free height."""
    poselib = pytest.importorskip('poselib', reason='PoseLib is not installed')
    rng = np.random.default_rng(3)
    # A cyclic change of axes puts our z where its y is.
    turn = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    for _ in range(20):
        scene = random_scene(TABLE_ONE[name], ('slanted',) * 4, count=1, rng=rng)
        rays = scene.rays
        found = poselib.ugp4pl(
            np.cross(rays.direction, rays.moment) @ turn.T, rays.direction @ turn.T,
            np.cross(scene.directions, scene.moments) @ turn.T, scene.directions @ turn.T)
        planar = []
        for solution in found:
            rotation, t = turn.T @ solution.R @ turn, turn.T @ solution.t
            position = -rotation.T @ t
            if abs(position[2]) < 1e-6:
                planar.append(Pose2(
                    position[0], position[1], math.atan2(rotation[0, 1], rotation[0, 0])))
        ours = solve(rays, scene.directions, scene.moments, scene.label)
        assert len(planar) == 1
        assert min(np.abs(pose_error(s.pose, planar[0])).max() for s in ours) < 1e-6
        assert np.abs(pose_error(ours[0].pose, scene.pose)).max() < 1e-6


@pytest.mark.parametrize('kinds', [GENERAL, MIXED, ('vertical',) * 5],
                         ids=['slanted', 'mixed', 'vertical'])
@pytest.mark.parametrize('name', RIGS)
def test_five_lines_never_fail_and_reach_the_bound(name, kinds):
    """One pixel of noise, no initial guess: one pose, with the accuracy it claims."""
    rng = np.random.default_rng(4)
    nees = []
    for _ in range(40):
        scene = random_scene(TABLE_ONE[name], kinds, noise=1.0, rng=rng)
        found = solve(scene.rays, scene.directions, scene.moments, scene.label)
        assert len(found) == 1
        e = pose_error(found[0].pose, scene.pose)
        assert math.hypot(e[0], e[1]) < 0.5 and abs(e[2]) < math.radians(5.0)
        nees.append(e @ found[0].information @ e)
    # 40 trials know the median to 10 %.
    assert 0.75 < math.sqrt(np.median(nees) / MEDIAN_NEES) < 1.25


@pytest.mark.parametrize('name', RIGS)
def test_refinement_ends_at_the_minimum_that_scipy_finds(name):
    scene = random_scene(TABLE_ONE[name], MIXED, noise=2.0, rng=np.random.default_rng(6))
    rays, directions, moments = scene.by_ray
    start = solve(scene.rays, scene.directions, scene.moments, scene.label, sigma=2.0)[0].pose
    ours = refine(rays, directions, moments, start, sigma=2.0, robust=False)
    fit = least_squares(
        lambda v: whitened_residual(rays, directions, moments, Pose2.from_array(v), 2.0)[0],
        scene.pose.as_array(), xtol=1e-15, ftol=1e-15, gtol=1e-15)
    assert np.abs(pose_error(ours.pose, Pose2.from_array(fit.x))).max() < 1e-5


def test_vertical_lines_behind_the_rays_are_no_pose():
    """The robot turned round sees the same rays prolonged backwards: refused, not returned."""
    scene = random_scene(TABLE_ONE['spherical'], ('vertical',) * 5, rng=np.random.default_rng(7))
    rays, directions, moments = scene.by_ray
    turned = Pose2(scene.pose.x, scene.pose.y, scene.pose.yaw + math.pi)
    # The camera is nearly central: the virtual pose is next to this one, and S next to zero.
    assert np.abs(side(rays, directions, moments, turned)).max() < 0.05
    found = solve(scene.rays, scene.directions, scene.moments, scene.label, sigma=20.0)
    assert len(found) == 1
    assert np.abs(pose_error(found[0].pose, scene.pose)).max() < 1e-8


@pytest.mark.parametrize('kinds', [('floor',) * 4, MIXED, ('vertical',) * 5],
                         ids=['floor', 'mixed', 'vertical'])
def test_rays_that_point_away_are_refused(kinds):
    """Rays reversed end for end meet the same lines, all behind the mirror."""
    scene = random_scene(TABLE_ONE['spherical'], kinds, rng=np.random.default_rng(8))
    rays = scene.rays
    reversed_ = Rays(
        -rays.direction, -rays.moment, -rays.direction_jacobian, -rays.moment_jacobian, rays.hit)
    assert np.abs(side(reversed_, *scene.by_ray[1:], scene.pose)).max() < 1e-9
    if kinds == ('vertical',) * 5:
        # Reversed, the true pose's virtual neighbour is the real one.
        found = solve(reversed_, scene.directions, scene.moments, scene.label)
        assert abs(math.remainder(found[0].pose.yaw - scene.pose.yaw, 2 * math.pi)) > 3.0
    else:
        for estimator in (solve, best_pose):
            with pytest.raises(EstimationError, match='behind the mirror'):
                estimator(reversed_, scene.directions, scene.moments, scene.label)


@given(
    st.lists(st.sampled_from(['floor', 'vertical', 'slanted']), min_size=1, max_size=4),
    st.integers(3, 12), st.integers(0, 1000), st.booleans())
def test_nonsense_gives_a_finite_pose_or_a_refusal(kinds, count, seed, same_pixel):
    """Pixels that show none of the lines, all in one place or anywhere."""
    rng = np.random.default_rng(seed)
    rig = TABLE_ONE['hyperbolic']
    pixels = rng.uniform([300.0, 100.0], [900.0, 700.0], (count, 2))
    if same_pixel:
        pixels[:] = pixels[0]
    directions = np.array([random_direction(kind, rng) for kind in kinds])
    moments = np.cross(rng.uniform(-3.0, 3.0, (len(kinds), 3)), directions)
    label = rng.integers(0, len(kinds), count)
    try:
        found = solve(rig.back_project(pixels), directions, moments, label)
    except EstimationError:
        return
    assert found
    for solution in found:
        assert math.isfinite(solution.chi2) and np.isfinite(solution.information).all()
        if solution.covariance is not None:
            assert np.linalg.eigvalsh(solution.covariance).min() > 0.0
