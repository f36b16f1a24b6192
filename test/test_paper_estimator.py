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
"""The paper's estimator: its polynomials against the curve's, its gradients, its convergence."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations_with_replacement

from nccs_pose.errors import EstimationError
from nccs_pose.estimation.bound import cramer_rao_bound
from nccs_pose.estimation.paper import (
    P_MONOMIALS,
    paper_estimate,
    PaperFrame,
    PaperProblem,
    Q_MONOMIALS,
)
from nccs_pose.geometry.lines import Line
from nccs_pose.geometry.pose import Pose2, RigidTransform
from nccs_pose.geometry.reflection_curve import ReflectionCurve
from nccs_pose.geometry.rig import Rig
from nccs_pose.simulation.table_one import TABLE_ONE
import numpy as np
import pytest
from scipy.optimize import approx_fprime

POSE = Pose2(0.3, -0.2, 0.7)
START = Pose2(0.36, -0.12, 0.78)
LINES = (
    Line([-1.0, -1.0, 0.1], [1.0, -1.0, 0.4]),
    Line([1.0, -1.0, 0.0], [1.0, 1.2, 0.0]),
    Line([1.0, 1.0, 0.0], [-1.0, 1.0, 0.2]),
    Line([-1.0, 1.0, 0.0], [-1.0, -1.0, 0.3]),
    Line([-0.5, -1.0, 0.0], [-0.5, -1.0, 0.3]),
)
MOUNTINGS = {
    'axis down': RigidTransform.from_rpy([np.pi, 0.0, 0.0], [0.0, 0.0, 0.75]),
    'axis down, off centre, turned': RigidTransform.from_rpy([np.pi, 0.0, 0.9], [0.1, -0.2, 0.6]),
    'axis up': RigidTransform.from_rpy([0.0, 0.0, -0.4], [0.1, 0.05, 0.3]),
}


def scene(rig: Rig, seed: int = 0, per_line: int = 20) -> tuple:
    """Pixels of the lines from POSE, and each pixel's line (directions, moments, index)."""
    rng = np.random.default_rng(seed)
    pixels, index = [], []
    for i, line in enumerate(LINES):
        points = line.start + rng.uniform(0.0, 1.0, (4 * per_line, 1)) * (line.end - line.start)
        found, seen = rig.project(POSE.inverse().apply(points))
        pixels.append(found[seen][:per_line])
        index += [i] * len(pixels[-1])
    d = np.array([LINES[i].direction for i in index])
    mu = np.array([LINES[i].moment for i in index])
    return np.concatenate(pixels), d, mu, np.array(index)


def problem_of(rig: Rig) -> tuple[PaperProblem, np.ndarray, np.ndarray]:
    pixels, d, mu, index = scene(rig)
    points, hit = rig.mirror_points(pixels)
    assert hit.all()
    assert len(points) >= 60
    return PaperProblem(rig, points, d, mu), points, index


@pytest.mark.parametrize('mounting', MOUNTINGS)
def test_the_papers_transform_is_the_mountings(mounting: str) -> None:
    """p^C = R p^W + t, with W the turned map, is T_mirror_base T_base_map exactly."""
    rig = replace(TABLE_ONE['spherical'], T_base_mirror=MOUNTINGS[mounting])
    frame = PaperFrame.of_rig(rig)
    c, s, t_x, t_y = frame.parameters(POSE)
    rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    points = np.random.default_rng(1).normal(size=(20, 3))
    paper = points @ frame.turn.T @ rotation.T + [t_x, t_y, frame.t_z]
    chain = rig.T_base_mirror.inverse().apply(POSE.inverse().apply(points))
    assert paper == pytest.approx(chain, abs=1e-12)
    assert frame.pose(np.array([c, s, t_x, t_y])).as_array() == pytest.approx(POSE.as_array())


@pytest.mark.parametrize('name', TABLE_ONE)
def test_gamma_r_is_the_curves_gamma_of_the_moved_line(name: str) -> None:
    rig = TABLE_ONE[name]
    problem, points, index = problem_of(rig)
    rng = np.random.default_rng(2)
    for _ in range(5):
        pose = Pose2(*rng.uniform(-1.0, 1.0, 3))
        gamma, _ = problem.gamma_r(problem.frame.parameters(pose))
        for i, line in enumerate(LINES):
            curve = ReflectionCurve.of_line(rig, line.transformed(pose.inverse()))
            expected = curve.gamma(points[index == i, 1], points[index == i, 2])
            scale = np.abs(expected).max()
            assert gamma[index == i] == pytest.approx(expected, rel=1e-7, abs=1e-11 * scale)


def test_degrees_and_monomials_in_the_pose() -> None:
    """P: degree 2, 9 monomials; Q: 1, 4; gamma_r: 4, 47, as a polynomial in c, s, t_x, t_y."""
    def squares(monomials: tuple) -> set:
        pairs = combinations_with_replacement(monomials, 2)
        return {''.join(sorted((a + b).replace('1', ''))) for a, b in pairs}

    both = squares(P_MONOMIALS) | squares(Q_MONOMIALS)
    assert (len(P_MONOMIALS), len(Q_MONOMIALS), len(both)) == (9, 4, 47)
    assert max(map(len, both)) == 4
    # and gamma_r is one of degree 4: along any straight line its fifth difference vanishes
    problem, _, _ = problem_of(TABLE_ONE['hyperbolic'])
    rng = np.random.default_rng(3)
    origin, along = rng.normal(size=(2, 4))
    values = np.stack([problem.gamma_r(origin + k * along)[0] for k in range(6)])
    assert np.abs(np.diff(values, 4, axis=0)).max() > 1e-3 * np.abs(values).max()
    assert np.abs(np.diff(values, 5, axis=0)).max() < 1e-10 * np.abs(values).max()


@pytest.mark.parametrize('name', TABLE_ONE)
def test_analytic_gradients(name: str) -> None:
    problem, _, _ = problem_of(TABLE_ONE[name])
    at = problem.frame.parameters(START)
    gamma, slope = problem.gamma_r(at)
    scale = np.abs(gamma).max()
    for i in range(0, len(gamma), 7):
        numeric = approx_fprime(at, lambda v, i=i: problem.gamma_r(v)[0][i] / scale, 1e-7)
        assert slope[i] / scale == pytest.approx(numeric, rel=1e-4, abs=1e-5)
    value, slope = problem.g2(at)
    numeric = approx_fprime(at, lambda v: problem.g2(v)[0] / value, 1e-8)
    assert slope / value == pytest.approx(numeric, rel=1e-3, abs=1e-3)


@pytest.mark.parametrize('name', TABLE_ONE)
def test_the_truth_satisfies_everything(name: str) -> None:
    problem, _, _ = problem_of(TABLE_ONE[name])
    truth = problem.frame.parameters(POSE)
    far = np.abs(problem.gamma_r(problem.frame.parameters(START))[0]).mean()
    assert np.abs(problem.gamma_r(truth)[0]).max() < 1e-10 * far
    assert problem.g2(truth)[0] < 1e-18


@pytest.mark.parametrize('use_g2', [False, True])
@pytest.mark.parametrize('name', TABLE_ONE)
def test_noise_free_pixels_give_the_pose(name: str, use_g2: bool) -> None:
    pixels, d, mu, _ = scene(TABLE_ONE[name])
    found = paper_estimate(TABLE_ONE[name], pixels, d, mu, START, use_g2=use_g2)
    assert found.pose.as_array() == pytest.approx(POSE.as_array(), abs=1e-5)
    assert abs(found.g1) < 1e-9
    c, s = np.cos(found.theta), np.sin(found.theta)
    t = found.translation
    frame = PaperFrame.of_rig(TABLE_ONE[name])
    again = frame.pose(np.array([c, s, t[0], t[1]]))
    assert again.as_array() == pytest.approx(found.pose.as_array(), abs=1e-9)


@pytest.mark.parametrize('name', TABLE_ONE)
def test_noisy_pixels_give_a_pose_near_by(name: str) -> None:
    rig = TABLE_ONE[name]
    pixels, d, mu, _ = scene(rig)
    rays = rig.back_project(pixels)
    bound = cramer_rao_bound(rays, d, mu, POSE, sigma=0.5)
    noise = np.random.default_rng(4).normal(scale=0.5, size=pixels.shape)
    found = paper_estimate(rig, pixels + noise, d, mu, START, use_g2=False)
    error = found.pose.as_array() - POSE.as_array()
    problem = PaperProblem(rig, rig.mirror_points(pixels + noise)[0], d, mu)
    there = problem.frame.parameters(found.pose)
    truth = problem.frame.parameters(POSE)
    assert np.abs(problem.gamma_r(there)[0]).mean() < np.abs(problem.gamma_r(truth)[0]).mean()
    assert error @ np.linalg.inv(bound) @ error < 3 * 40.0**2
    with_g2 = paper_estimate(rig, pixels + noise, d, mu, START)
    assert np.isfinite(with_g2.pose.as_array()).all()
    assert with_g2.g2 > 0.0  # it cannot be met


def test_the_bound_falls_with_pixels_and_rises_with_noise() -> None:
    rig = TABLE_ONE['spherical']
    pixels, d, mu, index = scene(rig)
    rays = rig.back_project(pixels)
    one = cramer_rao_bound(rays, d, mu, POSE, sigma=1.0)
    two = cramer_rao_bound(rays, d, mu, POSE, sigma=2.0)
    assert two == pytest.approx(4.0 * one)
    fewer = np.arange(len(pixels)) % 2 == 0
    half = cramer_rao_bound(rays[fewer], d[fewer], mu[fewer], POSE, sigma=1.0)
    assert (np.linalg.eigvalsh(half - one) > 0.0).all()
    mixed = cramer_rao_bound(rays, d, mu, POSE, sigma=1.0, sigma_world=0.01)
    assert (np.linalg.eigvalsh(mixed - one) > 0.0).all()
    on_floor = index == 1  # a single floor line says nothing of the position along it
    with pytest.raises(EstimationError, match='unobserved'):
        cramer_rao_bound(rays[on_floor], d[on_floor], mu[on_floor], POSE)


@pytest.mark.parametrize(
    'change, word',
    [
        ({'sigma': 0.0}, 'sigma'),
        ({'sigma': np.nan}, 'sigma'),
        ({'directions': 0.0}, 'unit length'),
        ({'directions': np.nan}, 'directions of the lines'),
        ({'moments': np.inf}, 'moments of the lines'),
    ])
def test_a_bound_without_meaning_is_refused_by_name(change: dict, word: str) -> None:
    pixels, d, mu, _ = scene(TABLE_ONE['spherical'])
    rays = TABLE_ONE['spherical'].back_project(pixels)
    d = d if 'directions' not in change else np.full_like(d, change['directions'])
    mu = mu if 'moments' not in change else np.full_like(mu, change['moments'])
    with pytest.raises(EstimationError, match=word):
        cramer_rao_bound(rays, d, mu, POSE, sigma=change.get('sigma', 1.0))


def test_a_lines_direction_along_the_cameras_x_makes_g2_singular() -> None:
    """Q is proportional to d'_y for a floor line: x = P / Q has no meaning where it is zero."""
    rig = TABLE_ONE['spherical']
    line = Line([-1.0, 0.8, 0.0], [1.0, 0.8, 0.0])
    pixels, seen = rig.project(line.start + np.linspace(0, 1, 40)[:, None] * [2.0, 0.0, 0.0])
    points, _ = rig.mirror_points(pixels[seen])
    count = len(points)
    problem = PaperProblem(
        rig, points, np.tile(line.direction, (count, 1)), np.tile(line.moment, (count, 1)))
    truth = problem.frame.parameters(Pose2())
    q = problem.q_rows @ np.array([truth[0], truth[1], truth[3], 1.0])
    typical = np.abs(problem.q_rows).max()
    assert np.abs(q).max() < 1e-12 * typical
    value, slope = problem.g2(truth)
    assert np.isfinite(value)
    assert np.isfinite(slope).all()


def test_a_tilted_mounting_is_treated_as_straight() -> None:
    straight = TABLE_ONE['spherical']
    tilt = RigidTransform.from_rpy([np.pi + np.radians(0.5), 0.0, 0.0], [0.0, 0.0, 0.75])
    tilted = replace(straight, T_base_mirror=tilt)
    assert PaperFrame.of_rig(tilted).turn == pytest.approx(PaperFrame.of_rig(straight).turn)
    pixels, d, mu, _ = scene(tilted)
    found = paper_estimate(tilted, pixels, d, mu, START, use_g2=False)
    miss = np.hypot(found.pose.x - POSE.x, found.pose.y - POSE.y)
    assert 1e-3 < miss < 0.2


@pytest.mark.parametrize(
    'change, word',
    [
        (lambda p, d, mu: (p[:2], d[:2], mu[:2]), '2 pixels'),
        (lambda p, d, mu: (p, d[:-1], mu), 'directions of shape'),
        (lambda p, d, mu: (p * np.nan, d, mu), 'pixels are not all finite'),
        (lambda p, d, mu: (p, d * 0.0, mu), 'unit length'),
        (lambda p, d, mu: (np.vstack([p[:-1], [[1e6, 1e6]]]), d, mu), 'miss the mirror'),
    ])
def test_impossible_input_is_refused_by_name(change, word: str) -> None:
    pixels, d, mu, _ = scene(TABLE_ONE['spherical'])
    pixels, d, mu = change(pixels, d, mu)
    with pytest.raises(EstimationError, match=word):
        paper_estimate(TABLE_ONE['spherical'], pixels, d, mu, START)
