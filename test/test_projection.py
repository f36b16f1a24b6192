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

"""Forward projection of points, against Fermat's principle, back-projection and the polynomial."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st
from nccs_pose.errors import GeometryError
from nccs_pose.geometry.mirror import QuadricMirror
from nccs_pose.geometry.point_polynomial import PointConditions, real_roots
from nccs_pose.geometry.projection import _Scene, reflect_points
from nccs_pose.simulation.table_one import TABLE_ONE
import numpy as np
import pytest
from scipy.optimize import minimize

SCENES = {name: (rig.mirror, rig.cop) for name, rig in TABLE_ONE.items()} | {
    'sphere, on axis': (QuadricMirror(1.0, 0.0, 900e-6, 0.029), np.array([0.0, 0.0, 0.057])),
    'paraboloid, on axis': (
        QuadricMirror(0.0, 20.4e-3, 53.2e-6, 0.03), np.array([0.0, 0.0, 0.05])),
    'hyperboloid, on axis': (
        QuadricMirror(-1.2, 3.4e-3, -33.2e-6, 0.03), np.array([0.0, 0.0, 0.05])),
    'oblate spheroid': (QuadricMirror(3.0, 0.01, 900e-6, 0.02), np.array([0.0, 0.01, 0.08])),
    'prolate spheroid': (QuadricMirror(0.5, 0.01, 900e-6, 0.02), np.array([0.0, -0.01, 0.08])),
    'cone': (QuadricMirror(-1.0, 0.0, 0.0, 0.03), np.array([0.0, 0.01, 0.08])),
}
DEGREES = {'hyperbolic': 8, 'parabolic': 7, 'spherical': 4, 'hyperboloid, on axis': 6}


def reflected(mirror: QuadricMirror, cop: np.ndarray, m: np.ndarray) -> np.ndarray:
    """Unit reflected rays (N, 3) at mirror points, straight from the law of reflection."""
    n = mirror.normal(m)
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    v = m - cop
    v = v - 2.0 * np.einsum('ni,ni->n', v, n)[:, None] * n
    return v / np.linalg.norm(v, axis=1, keepdims=True)


def lit_points(
    mirror: QuadricMirror, cop: np.ndarray, count: int, seed: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Random mirror points that the camera sees, and a point in space on each reflected ray."""
    rng = np.random.default_rng(seed)
    radius = (mirror.rim_radius or 0.03) * np.sqrt(rng.uniform(0.0, 1.0, count))
    angle = rng.uniform(-np.pi, np.pi, count)
    flat = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.ones(count)], axis=1)
    # straight down onto the sheet from far above: z from the mirror's own equation
    height = [
        max(
            z for z in np.real(np.roots([mirror.A, mirror.B, r * r - mirror.C]))
            if mirror.A * z + mirror.B / 2 > 0.0)
        for r in radius]
    m = np.where([True, True, False], flat, np.array(height)[:, None])
    facing = np.einsum('ni,ni->n', cop - m, mirror.normal(m)) > 0.0
    m = m[facing]
    distance = np.exp(rng.uniform(np.log(1e-3), np.log(10.0), len(m)))
    return m, m + distance[:, None] * reflected(mirror, cop, m)


def polynomial(
    mirror: QuadricMirror, cop: np.ndarray, points: np.ndarray, unit: float,
) -> np.ndarray:
    """G(z) of points, all lengths in a unit; on the axis they are turned into the plane x = 0."""
    if cop[1] == 0.0:
        radius = np.hypot(points[:, 0], points[:, 1])
        points = np.column_stack([np.zeros(len(points)), radius, points[:, 2]])
    quadric = mirror.A, mirror.B / unit, mirror.C / unit**2
    return PointConditions(quadric, tuple(cop[1:] / unit), points / unit).polynomial()


def space_points(count: int, seed: int) -> np.ndarray:
    """Points all round the mirror, 5 mm to 3 m away."""
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return direction * np.exp(rng.uniform(np.log(5e-3), np.log(3.0), count))[:, None]


@pytest.mark.parametrize('name', SCENES)
def test_every_lit_point_is_found_where_it_was_reflected(name: str) -> None:
    mirror, cop = SCENES[name]
    m, points = lit_points(mirror, cop, 6000, seed=1)
    found, visible = reflect_points(mirror, cop, points)
    assert len(m) > 2000
    assert visible.all()
    assert np.linalg.norm(found - m, axis=1).max() < 1e-9  # metres: 1e-6 mm


@pytest.mark.parametrize('name', SCENES)
def test_no_reflection_is_invented(name: str) -> None:
    mirror, cop = SCENES[name]
    points = space_points(6000, seed=2)
    m, visible = reflect_points(mirror, cop, points)
    assert 0.1 < visible.mean() < 0.95
    assert not m[~visible].any()
    m, p = m[visible], points[visible]
    n = mirror.normal(m)
    assert np.abs(mirror.level(m)).max() < 1e-14
    assert mirror.contains(m).all()
    assert (np.einsum('ni,ni->n', cop - m, n) > 0.0).all()
    assert (np.einsum('ni,ni->n', p - m, n) > 0.0).all()
    away = (p - m) / np.linalg.norm(p - m, axis=1, keepdims=True)
    assert np.linalg.norm(away - reflected(mirror, cop, m), axis=1).max() < 1e-6


@pytest.mark.parametrize('name', TABLE_ONE)
def test_the_reflection_is_the_shortest_path(name: str) -> None:
    """Fermat: a general minimiser, which knows no law of reflection, finds the same points."""
    mirror, cop = SCENES[name]
    points = space_points(60, seed=3)
    m, visible = reflect_points(mirror, cop, points)
    checked = 0
    for point, mirror_point in zip(points[visible][:25], m[visible][:25]):

        def path(xy: np.ndarray, point: np.ndarray = point) -> float:
            r2 = float(xy @ xy) * 1e-4
            depth = mirror.C + (mirror.B**2 / (4 * mirror.A) if mirror.A else 0.0)
            if mirror.A > 0.0 and r2 >= depth:
                return 1e6 + r2
            if mirror.A == 0.0:
                z = (mirror.C - r2) / mirror.B
            else:
                root = np.sqrt((depth - r2) / mirror.A)
                z = -mirror.B / (2 * mirror.A) + np.copysign(root, mirror.A)
            q = np.array([xy[0] * 1e-2, xy[1] * 1e-2, z])
            return 100.0 * float(np.linalg.norm(q - cop) + np.linalg.norm(q - point))

        best = minimize(
            path, np.zeros(2), method='Nelder-Mead',
            options={'xatol': 1e-9, 'fatol': 1e-14, 'maxiter': 2000})
        assert best.x * 1e-2 == pytest.approx(mirror_point[:2], abs=1e-7)
        assert path(mirror_point[:2] * 1e2) <= best.fun + 1e-12
        checked += 1
    assert checked >= 20


@pytest.mark.parametrize('name', TABLE_ONE)
def test_invisible_means_behind_the_mirror(name: str) -> None:
    """Without a rim, what is not seen is exactly what the mirror's body hides from the camera."""
    mirror, cop = SCENES[name]
    points = space_points(3000, seed=4)
    _, visible = reflect_points(mirror, cop, points)
    along = np.linspace(0.0, 1.0, 4001)[1:]
    hidden = np.zeros(len(points), dtype=bool)
    for i, point in enumerate(points):
        on_segment = cop + along[:, None] * (point - cop)
        inside = mirror.level(on_segment) < 0.0
        if mirror.A < 0.0:  # the camera itself sits in the other sheet
            inside &= mirror.A * on_segment[:, 2] + mirror.B / 2 > 0.0
        hidden[i] = inside.any()
    # sampling misses segments that cut less than a step of the surface
    assert not (hidden & visible).any()
    assert (~hidden & ~visible).mean() < 2e-3


@pytest.mark.parametrize('name', DEGREES)
def test_degree_of_the_polynomial(name: str) -> None:
    mirror, cop = SCENES[name]
    points = space_points(200, seed=5)
    coefficients = polynomial(mirror, cop, points, 1e-3)
    relative = np.abs(coefficients) / np.abs(coefficients).max(axis=1, keepdims=True)
    top = coefficients.shape[1] - 1
    degree = DEGREES[name]
    assert relative[:, : top - degree].max(initial=0.0) < 1e-13
    assert np.median(relative[:, top - degree]) > 1e-13


@pytest.mark.parametrize('name', [name for name in SCENES if name != 'cone'])
def test_reflections_are_roots_of_the_polynomial(name: str) -> None:
    """G and its resultant know nothing of Fermat's path; every reflection is one of its roots."""
    mirror, cop = SCENES[name]
    m, points = lit_points(mirror, cop, 400, seed=6)
    points = points[np.abs(points[:, 0]) > 1e-3]
    m, _ = reflect_points(mirror, cop, points)
    unit = 0.05
    coefficients = polynomial(mirror, cop, points, unit)
    roots, real = real_roots(coefficients, 1e-3)
    away = np.where(real, np.abs(roots - m[:, 2:] / unit), np.inf).min(axis=1)
    assert np.median(away) < 1e-11
    assert away.max() < 1e-3


@given(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0), st.floats(-0.5, 2.0))
def test_mirror_symmetry(x: float, y: float, z: float) -> None:
    """The scene is symmetric about the plane x = 0, so is the projection."""
    mirror, cop = SCENES['hyperbolic']
    m, visible = reflect_points(mirror, cop, np.array([[x, y, z], [-x, y, z]]))
    assert visible[0] == visible[1]
    assert m[1] * [-1.0, 1.0, 1.0] == pytest.approx(m[0], abs=1e-15)


@pytest.mark.parametrize('name', SCENES)
def test_special_places(name: str) -> None:
    """On the axis, in the plane of symmetry, at the camera, and where D = 0."""
    mirror, cop = SCENES[name]
    _, o_y, o_z = cop
    spread = np.linspace(0.1, 2.0, 7)
    zero = np.zeros_like(spread)
    points = np.concatenate([
        np.stack([zero, zero, o_z + spread], axis=1),
        np.stack([zero, spread, zero + 0.2], axis=1),
        np.stack([spread, zero, zero + 0.2], axis=1),
        np.stack([1e-12 * spread, o_y * (1 + spread), o_z * (1 + spread)], axis=1),
        np.stack([spread, zero + o_y, zero + o_z], axis=1)])
    m, visible = reflect_points(mirror, cop, points)
    lit = visible.copy()
    assert np.isfinite(m).all()
    if mirror.rim_radius is None:
        assert visible.all()
    away = points[lit] - m[lit]
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    assert np.linalg.norm(away - reflected(mirror, cop, m[lit]), axis=1).max(initial=0.0) < 1e-9


def test_a_camera_on_the_axis_sees_a_round_world() -> None:
    mirror, cop = SCENES['paraboloid, on axis']
    angle = np.linspace(-np.pi, np.pi, 50)
    points = np.stack([np.cos(angle), np.sin(angle), np.full(50, 0.3)], axis=1)
    m, visible = reflect_points(mirror, cop, points)
    assert visible.all()
    assert np.hypot(m[:, 0], m[:, 1]) == pytest.approx(np.hypot(*m[0, :2]), rel=1e-12)
    assert np.arctan2(m[1:-1, 1], m[1:-1, 0]) == pytest.approx(angle[1:-1], abs=1e-12)


def test_scale_does_not_matter() -> None:
    mirror, cop = SCENES['hyperbolic']
    points = space_points(500, seed=7)
    m, visible = reflect_points(mirror, cop, points)
    large = QuadricMirror(mirror.A, mirror.B * 1e3, mirror.C * 1e6)
    m_large, visible_large = reflect_points(large, cop * 1e3, points * 1e3)
    assert (visible == visible_large).all()
    assert m_large == pytest.approx(m * 1e3, abs=1e-9)


def test_rim_cuts_the_mirror() -> None:
    whole, cop = SCENES['spherical']
    cut = QuadricMirror(whole.A, whole.B, whole.C, 0.012)
    points = space_points(2000, seed=8)
    m, seen_whole = reflect_points(whole, cop, points)
    _, seen_cut = reflect_points(cut, cop, points)
    assert (seen_cut == (seen_whole & (np.hypot(m[:, 0], m[:, 1]) <= 0.012))).all()


@pytest.mark.parametrize(
    'cop, points, word',
    [
        ([0.0, 0.0, np.nan], [[1.0, 0.0, 0.0]], 'cop'),
        ([0.0, 0.0], [[1.0, 0.0, 0.0]], 'cop'),
        ([0.01, 0.0, 0.06], [[1.0, 0.0, 0.0]], r'0\.01.*x must be 0'),
        ([0.0, 0.0, 0.02], [[1.0, 0.0, 0.0]], 'inside'),
        ([0.0, 0.0, 0.06], [[1.0, 0.0, np.inf]], 'points'),
        ([0.0, 0.0, 0.06], [1.0, 0.0, 0.0], 'points'),
    ])
def test_impossible_input_is_refused_by_name(cop: list, points: list, word: str) -> None:
    with pytest.raises(GeometryError, match=word):
        reflect_points(QuadricMirror(1.0, 0.0, 900e-6), cop, points)


def test_no_points_is_no_problem() -> None:
    mirror, cop = SCENES['spherical']
    m, visible = reflect_points(mirror, cop, np.zeros((0, 3)))
    assert m.shape == (0, 3)
    assert visible.shape == (0,)


@pytest.mark.parametrize('name', SCENES)
def test_the_polynomial_alone_finds_the_same(name: str) -> None:
    """The way that a point takes when Newton's steps end without a certificate."""
    mirror, cop = SCENES[name]
    points = space_points(1000, seed=9)
    m, visible = reflect_points(mirror, cop, points)
    scene = _Scene(mirror, cop)
    x, y, found = scene._by_polynomial((points[visible] - scene.apex) / scene.unit)
    assert found.all()
    again = np.stack([x, y], axis=1) * scene.unit
    assert np.linalg.norm(again - m[visible, :2], axis=1).max() < 1e-9


@pytest.mark.parametrize('name', TABLE_ONE)
def test_extreme_points_give_finite_answers(name: str) -> None:
    mirror, cop = SCENES[name]
    apex = np.array([0.0, 0.0, mirror.apex_z])
    near = apex + np.array([0.0, 0.0, 1e-9])
    seen = np.array([cop, near, [1e9, 1e9, 1e9], [1e-300, 0.0, 1.0], [1e100, 0.0, 0.0]])
    m, visible = reflect_points(mirror, cop, seen)
    assert visible.all()
    assert np.abs(mirror.level(m)).max() < 1e-15
    # at the apex itself and below it there is nothing to see
    m, visible = reflect_points(mirror, cop, np.stack([apex, apex - np.array([0.0, 0.0, 1e-3])]))
    assert not visible.any()
    assert not m.any()
