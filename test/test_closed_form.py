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

"""The closed form for floor lines: brute force, truth, symmetry and refusals."""

from __future__ import annotations

from dataclasses import replace
import math

from hypothesis import example, given
from hypothesis import strategies as st
from labelled_scene import observe, pose_error, random_scene
from nccs_pose.errors import EstimationError
from nccs_pose.estimation.closed_form import circle_minima, horizontal_minima, vertical_minima
from nccs_pose.estimation.global_pose import best_pose, solve
from nccs_pose.estimation.labelled_rays import LabelledRays
from nccs_pose.estimation.pose_monomials import gram, monomial_rows, monomials, monomials_jacobian
from nccs_pose.estimation.refine import refine
from nccs_pose.estimation.residual import side
from nccs_pose.geometry.pose import Pose2
from nccs_pose.geometry.rig import Rays
from nccs_pose.geometry.small_matrices import (
    inverse,
    inverse_2x2,
    inverse_3x3,
    is_definite,
    solve_3x3,
    solve_if_definite,
    solve_symmetric,
)
from nccs_pose.simulation.table_one import TABLE_ONE
import numpy as np
import pytest
from scipy.optimize import least_squares

FLOOR = ('floor',) * 4
RIGS = sorted(TABLE_ONE)
# sqrt of the median of chi-square with 3 degrees of freedom.
MEDIAN_NEES = 2.366


def brute_force(rows):
    """Distinct local minima of |rows . monomials|^2 from a grid of starts, best first."""
    found = []
    for yaw in np.linspace(-math.pi, math.pi, 12, endpoint=False):
        for x, y in ((-2.0, -2.0), (2.0, 2.0)):
            fit = least_squares(
                lambda v: rows @ monomials(Pose2.from_array(v)), [x, y, yaw],
                xtol=1e-15, ftol=1e-15, gtol=1e-15)
            pose = Pose2.from_array(fit.x)
            if fit.status > 0 and not any(
                    np.abs(pose_error(pose, other)).max() < 1e-3 for _, other in found):
                found.append((2.0 * fit.cost, pose))
    return sorted(found, key=lambda entry: entry[0])


def assert_same_minima(minima, rows):
    expected = brute_force(rows)
    assert len(minima) == len(expected)
    for minimum, (cost, pose) in zip(minima, expected):
        assert np.abs(pose_error(minimum.pose, pose)).max() < 1e-5
        assert minimum.cost == pytest.approx(cost, rel=1e-6)


@pytest.mark.parametrize('name', RIGS)
def test_monomials_are_the_side_operator(name):
    rng = np.random.default_rng(1)
    scene = random_scene(TABLE_ONE[name], ('floor', 'vertical', 'slanted'), rng=rng)
    rays, directions, moments = scene.by_ray
    rows = monomial_rows(rays.direction, rays.moment, directions, moments)
    for pose in (scene.pose, Pose2(-3.0, 1.0, 2.0)):
        assert rows @ monomials(pose) == pytest.approx(
            side(rays, directions, moments, pose), abs=1e-13)


def test_derivative_of_the_monomials():
    pose, h = Pose2(1.3, -0.7, 2.1), 1e-6
    numeric = np.stack([
        (monomials(Pose2.from_array(pose.as_array() + h * e))
         - monomials(Pose2.from_array(pose.as_array() - h * e))) / (2.0 * h)
        for e in np.eye(3)], axis=1)
    assert monomials_jacobian(pose) == pytest.approx(numeric, abs=1e-8)


def test_side_of_a_floor_line_is_a_distance_on_the_floor():
    """S = r_z times the signed distance from the line to the ray's floor point."""
    scene = random_scene(
        TABLE_ONE['spherical'], FLOOR, noise=20.0, rng=np.random.default_rng(2))
    rays, directions, moments = scene.by_ray
    points, reaches = rays.floor_points()
    points = scene.pose.apply(points)
    # The distance of p to a horizontal line: d_x p_y - d_y p_x + mu_z.
    distance = directions[:, 0] * points[:, 1] - directions[:, 1] * points[:, 0] + moments[:, 2]
    s = side(rays, directions, moments, scene.pose)
    assert reaches.sum() > 60
    assert s[reaches] == pytest.approx((rays.direction[:, 2] * distance)[reaches], abs=1e-12)


@pytest.mark.parametrize('seed', range(5))
def test_minima_on_the_circle_against_a_grid(seed):
    """All local minima, inside and outside the astroid and in the hard case g . f = 0."""
    rng = np.random.default_rng(seed)
    yaw = np.linspace(-math.pi, math.pi, 20000, endpoint=False)
    circle = np.stack([np.cos(yaw), np.sin(yaw)])
    for k in range(60):
        b = rng.standard_normal((2, 2))
        h, g = b @ b.T, rng.standard_normal(2) * 10.0 ** rng.uniform(-8.0, 1.0)
        if k % 5 == 0:
            g[:] = 0.0
        if k % 5 == 1:
            values, vectors = np.linalg.eigh(h)
            g = vectors[:, 1] * rng.normal() * (values[1] - values[0])
        j = np.einsum('ik,ij,jk->k', circle, h, circle) + 2.0 * g @ circle
        expected = yaw[(j < np.roll(j, 1)) & (j <= np.roll(j, -1))]
        found = np.array(circle_minima(h[0, 0], h[0, 1], h[1, 1], *g))
        costs = np.einsum('ki,ij,kj->k', found, h, found) + 2.0 * found @ g
        assert costs[0] <= j.min() + 1e-12
        assert costs[0] == pytest.approx(j.min(), abs=1e-5)
        assert len(found) == len(expected)
        turns = np.arctan2(found[:, 1], found[:, 0])[:, None] - expected
        assert np.abs(np.remainder(turns + math.pi, 2 * math.pi) - math.pi).min(0).max() < 1e-3


@pytest.mark.parametrize('name', RIGS)
@pytest.mark.parametrize('noise', [1.0, 30.0])
def test_floor_minima_against_brute_force(name, noise):
    rng = np.random.default_rng(3)
    scene = random_scene(TABLE_ONE[name], FLOOR, count=8, noise=noise, rng=rng)
    rays, directions, moments = scene.by_ray
    rows = monomial_rows(rays.direction, rays.moment, directions, moments)[rays.hit]
    assert_same_minima(horizontal_minima(gram(rows.T, 1.0)), rows)


@pytest.mark.parametrize('name', RIGS)
def test_vertical_minima_against_brute_force(name):
    rng = np.random.default_rng(4)
    scene = random_scene(TABLE_ONE[name], ('vertical',) * 4, count=8, noise=3.0, rng=rng)
    rays, directions, moments = scene.by_ray
    rows = monomial_rows(rays.direction, rays.moment, directions, moments)
    assert_same_minima(vertical_minima(gram(rows.T, 1.0)), rows)


@pytest.mark.parametrize('name', RIGS)
def test_exact_pixels_give_the_exact_pose(name):
    rng = np.random.default_rng(5)
    for _ in range(20):
        scene = random_scene(TABLE_ONE[name], FLOOR, rng=rng)
        best = solve(scene.rays, scene.directions, scene.moments, scene.label)[0]
        assert np.abs(pose_error(best.pose, scene.pose)).max() < 1e-8


@pytest.mark.parametrize('name', RIGS)
def test_lines_at_several_heights_are_still_in_closed_form(name):
    rng = np.random.default_rng(6)
    scene = None
    while scene is None:
        points = np.array([[1.0, 0, 0.0], [0, 1.2, 0.3], [-1.1, 0, 0.55], [0, -0.9, 0.1]])
        directions = np.array([[0.0, 1, 0], [0.8, 0.6, 0], [0.6, 0.8, 0], [1, 0, 0]])
        pose = Pose2(*rng.uniform(-0.3, 0.3, 2), rng.uniform(-3.0, 3.0))
        scene = observe(TABLE_ONE[name], pose, points, directions, rng=rng)
    best = solve(scene.rays, scene.directions, scene.moments, scene.label)[0]
    assert np.abs(pose_error(best.pose, scene.pose)).max() < 1e-8


@pytest.mark.parametrize('name', RIGS)
def test_four_floor_lines_never_fail_and_reach_the_bound(name):
    """One pixel of noise, no initial guess: all poses found, with the accuracy they claim."""
    rng = np.random.default_rng(7)
    nees, refined = [], []
    for _ in range(60):
        scene = random_scene(TABLE_ONE[name], FLOOR, noise=1.0, rng=rng)
        best = solve(scene.rays, scene.directions, scene.moments, scene.label)[0]
        e = pose_error(best.pose, scene.pose)
        assert math.hypot(e[0], e[1]) < 0.5 and abs(e[2]) < math.radians(5.0)
        # The bound: the information at the truth.
        at_truth = np.linalg.inv(best.covariance)
        nees.append(e @ at_truth @ e)
        rays, directions, moments = scene.by_ray
        hit = rays.hit
        e = pose_error(
            refine(rays[hit], directions[hit], moments[hit], best.pose, robust=False).pose,
            scene.pose)
        refined.append(e @ at_truth @ e)
    assert 0.8 < math.sqrt(np.median(nees) / MEDIAN_NEES) < 1.2
    assert np.median(nees) < 1.15 * np.median(refined)


def test_noise_on_the_lines_is_weighed_in():
    """Variance of S against numeric derivatives by the pixel and by moving the line."""
    rng = np.random.default_rng(8)
    scene = random_scene(TABLE_ONE['hyperbolic'], ('floor', 'slanted', 'vertical'), rng=rng)
    sigma = rng.uniform(0.5, 2.0, len(scene.label))
    data = LabelledRays(
        scene.rays, scene.directions, scene.moments, scene.label, sigma, sigma_world=0.03)
    # The same pose in the map whose origin lies among the lines.
    pose = Pose2(scene.pose.x - data.origin[0], scene.pose.y - data.origin[1], scene.pose.yaw)
    _, directions, moments = scene.by_ray
    expected = np.zeros(len(sigma))
    for step in np.eye(2) * 1e-4:
        ahead = side(scene.rig.back_project(scene.pixels + step), directions, moments, scene.pose)
        back = side(scene.rig.back_project(scene.pixels - step), directions, moments, scene.pose)
        expected += (sigma * (ahead - back) / 2e-4) ** 2
    for axis in np.eye(3):
        across = axis - (directions @ axis)[:, None] * directions
        moved = moments + np.cross(across, directions)
        shift = side(scene.rays, directions, moved, scene.pose) - side(
            scene.rays, directions, moments, scene.pose)
        expected += (0.03 * shift) ** 2
    assert data.variance(pose) == pytest.approx(expected, rel=1e-6)


def moved(scene, motion):
    """The scene's lines after a planar motion of the map."""
    directions = scene.directions @ motion.rotation.T
    moments = scene.moments @ motion.rotation.T + np.cross(motion.translation, directions)
    return directions, moments


POSES = st.builds(
    Pose2, st.floats(-50.0, 50.0), st.floats(-50.0, 50.0), st.floats(-math.pi, math.pi))
KINDS = st.sampled_from([FLOOR, ('floor', 'vertical', 'slanted', 'slanted'), ('vertical',) * 4])


@given(POSES, KINDS, st.integers(0, 1000))
def test_a_motion_of_the_map_moves_the_pose(motion, kinds, seed):
    scene = random_scene(
        TABLE_ONE['spherical'], kinds, count=8, noise=1.0, rng=np.random.default_rng(seed))
    here = solve(scene.rays, scene.directions, scene.moments, scene.label)
    there = solve(scene.rays, *moved(scene, motion), scene.label)
    assert len(here) == len(there)
    for a, b in zip(here, there):
        # The starts are unweighted about the same lines: nothing but rounding may differ.
        assert np.abs(pose_error(b.pose, motion @ a.pose)).max() < 1e-7
        assert b.chi2 == pytest.approx(a.chi2, rel=1e-6)


@given(KINDS, st.integers(0, 1000))
def test_order_sign_and_length_mean_nothing(kinds, seed):
    """Pixels and lines in another order, directions of other sign and length: the same pose."""
    rng = np.random.default_rng(seed)
    scene = random_scene(TABLE_ONE['parabolic'], kinds, count=8, noise=1.0, rng=rng)
    expected = solve(scene.rays, scene.directions, scene.moments, scene.label)[0]
    pixels, lines = rng.permutation(len(scene.label)), rng.permutation(len(kinds))
    factor = (rng.uniform(0.1, 5.0, len(kinds)) * rng.choice([-1, 1], len(kinds)))[:, None]
    found = solve(
        scene.rays[pixels], (factor * scene.directions)[lines], (factor * scene.moments)[lines],
        np.argsort(lines)[scene.label[pixels]])[0]
    assert np.abs(pose_error(found.pose, expected.pose)).max() < 1e-7


@given(st.floats(0.01, 100.0), KINDS)
def test_a_world_of_another_size(scale, kinds):
    scene = random_scene(
        TABLE_ONE['spherical'], kinds, count=8, noise=1.0, rng=np.random.default_rng(9))
    small = solve(scene.rays, scene.directions, scene.moments, scene.label)[0]
    rays = scene.rays
    large = solve(
        Rays(rays.direction, scale * rays.moment, rays.direction_jacobian,
             scale * rays.moment_jacobian, rays.hit),
        scene.directions, scale * scene.moments, scene.label)[0]
    expected = Pose2(scale * small.pose.x, scale * small.pose.y, small.pose.yaw)
    assert np.abs(pose_error(large.pose, expected)).max() < 1e-7 * max(1.0, scale)


def test_pixels_off_the_mirror_and_without_a_line_are_left_out():
    scene = random_scene(
        TABLE_ONE['spherical'], FLOOR, noise=1.0, rng=np.random.default_rng(10))
    expected = solve(scene.rays, scene.directions, scene.moments, scene.label)[0]
    pixels = np.concatenate([scene.pixels, [[0.0, 0.0], [600.0, 700.0]]])
    label = np.append(scene.label, [2, -1])
    rays = scene.rig.back_project(pixels)
    assert not rays.hit[-2]
    found = solve(rays, scene.directions, scene.moments, label)[0]
    assert found.pose == expected.pose


def bad_inputs():
    scene = random_scene(TABLE_ONE['spherical'], FLOOR, rng=np.random.default_rng(11))
    good = {
        'rays': scene.rays, 'directions': scene.directions, 'moments': scene.moments,
        'label': scene.label}
    rays = scene.rays
    nan_ray = rays.direction.copy()
    nan_ray[7, 1] = np.nan
    nan_line, zero_line = scene.moments.copy(), scene.directions.copy()
    nan_line[2, 0] = np.inf
    zero_line[3] = 0.0
    label = scene.label.copy()
    label[5] = 4
    few = np.where(np.arange(len(label)) < 2, scene.label, -1)
    changes = {
        'no lines': {'directions': np.zeros((0, 3)), 'moments': np.zeros((0, 3))},
        'too few pixels: 2': {'label': few},
        'too few pixels: 0': {'rays': rays[:0], 'label': label[:0]},
        'ray directions: row 7 is not finite': {
            'rays': Rays(nan_ray, rays.moment, rays.direction_jacobian,
                         rays.moment_jacobian, rays.hit)},
        'moments of the lines: row 2 is not finite': {'moments': nan_line},
        'line 3: its direction has length zero': {'directions': zero_line},
        'label 4: there are only 4 lines': {'label': label},
        'labels of shape': {'label': label[:-1]},
        'type float64': {'label': scene.label.astype(float)},
        'moments of the lines of shape': {'moments': scene.moments[:3]},
        'sigma = 0.0 px': {'sigma': 0.0},
        'sigma = nan px': {'sigma': np.nan},
        'sigma of shape': {'sigma': np.ones(3)},
        'sigma_world = -1.0 m': {'sigma_world': -1.0},
    }
    return [pytest.param(good | change, words, id=words) for words, change in changes.items()]


@pytest.mark.parametrize('estimator', [solve, best_pose])
@pytest.mark.parametrize(('arguments', 'words'), bad_inputs())
def test_bad_input_is_named(arguments, words, estimator):
    with pytest.raises(EstimationError, match=words):
        estimator(**arguments)


@pytest.mark.parametrize('derivatives', [False, True])
@pytest.mark.parametrize('part', ['direction', 'moment'])
def test_every_part_of_a_ray_is_checked(part, derivatives):
    scene = random_scene(TABLE_ONE['spherical'], FLOOR, rng=np.random.default_rng(11))
    field = f'{part}_jacobian' if derivatives else part
    values = getattr(scene.rays, field).copy()
    values[9, 2] = np.inf
    rays = replace(scene.rays, **{field: values})
    name = f'derivatives of ray {part}s' if derivatives else f'ray {part}s'
    for estimator in (solve, best_pose):
        with pytest.raises(EstimationError, match=f'^{name}: row 9 is not finite'):
            estimator(rays, scene.directions, scene.moments, scene.label)


@pytest.mark.parametrize('kinds', [
    FLOOR, ('vertical',) * 4, ('slanted',) * 5, ('floor', 'floor', 'vertical', 'slanted')])
@pytest.mark.parametrize('name', RIGS)
def test_the_best_pose_alone_is_the_best_of_all(name, kinds):
    """Other ways to the same minimum: all of them by eigenvalues, then a step on the rows."""
    rng = np.random.default_rng(12)
    for _ in range(10):
        scene = random_scene(TABLE_ONE[name], kinds, noise=1.0, rng=rng)
        arguments = scene.rays, scene.directions, scene.moments, scene.label
        sigma = rng.uniform(0.5, 2.0, len(scene.label))
        pose, covariance = best_pose(*arguments, sigma=sigma, sigma_world=0.01)
        expected = solve(*arguments, sigma=sigma, sigma_world=0.01)[0]
        assert np.abs(pose_error(pose, expected.pose)).max() < 1e-7
        assert covariance == pytest.approx(expected.covariance, rel=1e-5, abs=1e-12)


def test_the_best_pose_alone_must_be_fixed():
    lines = np.array([[0.0, 0.8, 0.0], [0.1, -0.7, 0.0]]), np.array([[1.0, 0.3, 0.0]] * 2)
    scene = observe(
        TABLE_ONE['spherical'], Pose2(0.1, 0.1, 0.4), *lines, rng=np.random.default_rng(13))
    with pytest.raises(EstimationError, match='open'):
        best_pose(scene.rays, scene.directions, scene.moments, scene.label)


@given(st.floats(0.1, 10.0), st.integers(0, 1000))
# Two rows that are almost one.
@example(1.0, 300)
def test_small_matrices_against_lapack(scale, seed):
    rows = np.random.default_rng(seed).standard_normal((6, 3)) * [1.0, scale, scale**2]
    m, g = rows.T @ rows, rows[0]
    inverse = np.linalg.inv(m)
    assert inverse_3x3(m) == pytest.approx(inverse, rel=1e-6, abs=1e-9 * inverse.max())
    solved = solve_3x3(m[0, 0], m[0, 1], m[1, 1], m[0, 2], m[1, 2], m[2, 2], *g)
    assert solved == pytest.approx(np.linalg.solve(m, g), rel=1e-6, abs=1e-9)
    a, b, d = inverse_2x2(m[0, 0], m[0, 1], m[1, 1])
    assert np.array([[a, b], [b, d]]) == pytest.approx(np.linalg.inv(m[:2, :2]), rel=1e-6)
    # Of too few rows nothing is left but rounding; the two by two has its pseudo-inverse then.
    flat = rows[:2].T @ rows[:2]
    assert inverse_3x3(flat) is None
    assert solve_3x3(
        flat[0, 0], flat[0, 1], flat[1, 1], flat[0, 2], flat[1, 2], flat[2, 2], *g) is None
    line = np.outer(rows[0, :2], rows[0, :2])
    a, b, d = inverse_2x2(line[0, 0], line[0, 1], line[1, 1])
    assert np.array([[a, b], [b, d]]) == pytest.approx(np.linalg.pinv(line), rel=1e-6)


@given(st.lists(st.floats(0.01, 100.0), min_size=3, max_size=3),
       st.lists(st.booleans(), min_size=3, max_size=3), st.integers(0, 1000))
def test_only_positive_definite_matrices_are_solved(sizes, negative, seed):
    values = np.where(negative, -1.0, 1.0) * sizes
    axes = np.linalg.qr(np.random.default_rng(seed).standard_normal((3, 3)))[0]
    m = (axes * values) @ axes.T
    m = 0.5 * (m + m.T)
    g = axes[0] + 0.1
    definite = not any(negative)
    for matrix in (m, np.diag(values)):
        assert (solve_if_definite(matrix, g) is not None) == definite
        assert (inverse_3x3(matrix) is not None) == is_definite(matrix) == definite
        assert is_definite(matrix, values.min() - 1e-3)
        assert not is_definite(matrix, values.min() + 1e-3)
        # LAPACK takes over.
        assert matrix @ solve_symmetric(matrix, g) == pytest.approx(g, rel=1e-6, abs=1e-9)
        assert matrix @ inverse(matrix) == pytest.approx(np.eye(3), abs=1e-8)
