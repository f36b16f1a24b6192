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

"""The reflection curve: the paper's polynomials, the closed form, the branches, the trace."""

from __future__ import annotations

from nccs_pose.errors import GeometryError
from nccs_pose.estimation.residual import side
from nccs_pose.geometry.line_trace import trace_line, trace_pieces
from nccs_pose.geometry.lines import Line
from nccs_pose.geometry.mirror import QuadricMirror
from nccs_pose.geometry.paper_polynomials import (
    Bivariate,
    mirror_polynomials,
    paper_polynomials,
)
from nccs_pose.geometry.pose import Pose2
from nccs_pose.geometry.projection import reflect_points
from nccs_pose.geometry.reflection_curve import Branch, ReflectionCurve
from nccs_pose.simulation.table_one import TABLE_ONE
import numpy as np
import pytest

UNIT = 0.03  # metres: the size of the mirrors, so that coefficients compare by size
RNG_LINES = 40
# c1 ... c11, gamma, its monomials, E, and what of gamma depends on the line, with its monomials
DEGREES = {
    'hyperbolic': ([1, 1, 2, 2, 4, 4, 4, 3, 3, 4, 5], 10, 53, 2, 6, 25),
    'parabolic': ([1, 1, 2, 2, 4, 4, 4, 2, 3, 4, 5], 10, 46, 2, 6, 23),
    'spherical': ([0, 0, 1, 1, 2, 2, 2, 2, 2, 2, 3], 6, 25, 1, 4, 15),
}
GENERIC = {
    'oblate spheroid': (QuadricMirror(2.3, 0.01, 900e-6, 0.02), np.array([0.0, 0.013, 0.08])),
    'prolate spheroid': (QuadricMirror(0.4, -0.01, 900e-6, 0.02), np.array([0.0, -0.02, 0.08])),
    'hyperboloid': (QuadricMirror(-0.6, 5e-3, -80e-6), np.array([0.0, 0.01, 0.05])),
    'on axis': (QuadricMirror(-1.2, 3.4e-3, -33.2e-6), np.array([0.0, 0.0, 0.025])),
}
SCENES = {name: (rig.mirror, rig.cop) for name, rig in TABLE_ONE.items()} | GENERIC


def scaled(mirror: QuadricMirror, cop: np.ndarray) -> tuple[QuadricMirror, np.ndarray]:
    return QuadricMirror(mirror.A, mirror.B / UNIT, mirror.C / UNIT**2), cop / UNIT


def random_lines(count: int, seed: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Feet 0.3 to 3 m from the mirror, and unit directions."""
    rng = np.random.default_rng(seed)
    lines = []
    for _ in range(count):
        foot = rng.normal(size=3)
        foot *= rng.uniform(0.3, 3.0) / np.linalg.norm(foot)
        d = np.cross(foot, rng.normal(size=3))
        lines.append((foot, d / np.linalg.norm(d)))
    return lines


def heights(mirror: QuadricMirror, count: int = 120) -> np.ndarray:
    lowest = max(mirror.z_min, mirror.apex_z - 0.04)
    return lowest + (mirror.apex_z - lowest) * (np.arange(count) + 0.5) / count


def degree(polynomial: Bivariate, relative: float = 1e-12) -> int:
    """Total degree, without what rounding left."""
    return max(i + j for i, j in polynomial.monomials(relative))


@pytest.mark.parametrize('name', TABLE_ONE)
def test_degrees_of_the_polynomials(name: str) -> None:
    mirror, cop = scaled(*SCENES[name])
    base = mirror_polynomials(mirror, cop)
    degrees, gamma, monomials, conic, _, _ = DEGREES[name]
    for q, d in random_lines(5, seed=1):
        c = paper_polynomials(mirror, cop, q / UNIT, d)
        assert [degree(getattr(c, f'c{i}')) for i in range(1, 12)] == degrees
        assert degree(c.gamma) == gamma
        assert len(c.gamma.monomials()) == monomials
        assert degree(base.E) == conic


@pytest.mark.parametrize('name', TABLE_ONE)
def test_gamma_is_reducible(name: str) -> None:
    """As gamma = E^2 g with g of degree 6 (4), coefficient by coefficient."""
    mirror, cop = scaled(*SCENES[name])
    base = mirror_polynomials(mirror, cop)
    *_, total, monomials = DEGREES[name]
    size = 8
    nodes = np.cos(np.pi * (np.arange(size) + 0.5) / size)
    y, z = np.meshgrid(nodes, nodes, indexing='ij')
    inverse = np.linalg.inv(np.vander(nodes, size, increasing=True))
    for q, d in random_lines(5, seed=2):
        curve = ReflectionCurve(mirror, cop, q / UNIT, d)
        coefficients = inverse @ curve.reduced(y, z) @ inverse.T  # interpolation of the values
        reduced = type(base.E)(coefficients)
        assert degree(reduced, 1e-9) == total
        assert len(reduced.monomials(1e-9)) == monomials
        gamma = paper_polynomials(mirror, cop, q / UNIT, d).gamma
        difference = base.E * base.E * reduced - gamma
        assert np.abs(difference.coefficients).max() < 1e-10 * np.abs(gamma.coefficients).max()


@pytest.mark.parametrize('name', SCENES)
def test_closed_form_equals_the_polynomials(name: str) -> None:
    mirror, cop = SCENES[name]
    rng = np.random.default_rng(3)
    y, z = rng.uniform(-0.03, 0.03, (2, 300))
    for q, d in random_lines(RNG_LINES, seed=4):
        c = paper_polynomials(mirror, cop, q, d)
        curve = ReflectionCurve(mirror, cop, q, d)
        e, p, q_, _ = curve.factors(y, z)
        # relative to the value, and where it passes through zero to its typical size
        for ours, paper in (
                (curve.gamma(y, z), c.gamma(y, z)), (e * p, c.c11(y, z)), (e * q_, c.c10(y, z))):
            floor = 1e-3 * np.median(np.abs(paper))
            assert (np.abs(ours - paper) / np.maximum(np.abs(paper), floor)).max() < 1e-8


@pytest.mark.parametrize('name', SCENES)
def test_gamma_on_the_mirror_is_side_times_mirrored_side(name: str) -> None:
    """On the mirror gamma = E^2 S(x) S(-x), and S is the Plücker product of ray and line."""
    mirror, cop = SCENES[name]
    rng = np.random.default_rng(5)
    z = heights(mirror)
    y = rng.uniform(-1.0, 1.0, len(z)) * 0.01
    w = y**2 + mirror.A * z**2 + mirror.B * z - mirror.C
    points = np.stack([np.sqrt(np.maximum(-w, 0.0)), y, z], axis=1)[w < 0.0]
    n = mirror.normal(points)
    v_i = points - cop
    v_r = (np.sum(n * n, axis=1, keepdims=True) * v_i
           - 2.0 * n * np.sum(v_i * n, axis=1, keepdims=True))
    for q, d in random_lines(RNG_LINES, seed=6):
        curve = ReflectionCurve(mirror, cop, q, d)
        product = np.einsum('ni,ni->n', v_r, np.cross(d, q - points))
        assert curve.side(points) == pytest.approx(
            product, rel=1e-7, abs=1e-9 * np.abs(product).max())
        e, _, _, _ = curve.factors(points[:, 1], points[:, 2])
        product = e**2 * curve.side(points) * curve.side(points * [-1.0, 1.0, 1.0])
        gamma = curve.gamma(points[:, 1], points[:, 2])
        assert product == pytest.approx(gamma, rel=1e-7, abs=1e-9 * np.abs(gamma).max())


@pytest.mark.parametrize('name', TABLE_ONE)
def test_the_curve_has_the_estimators_side_by_the_factor_that_it_says(name: str) -> None:
    """P - x Q = -N |v_i| S, with the S of unit rays and of lines in the map."""
    rig = TABLE_ONE[name]
    pixels = np.random.default_rng(3).uniform((0, 0), (1200, 800), (200, 2))
    points, hit = rig.mirror_points(pixels)
    points, rays = points[hit], rig.back_project(pixels[hit])
    assert len(points) > 20
    n = (rig.mirror.normal(points)**2).sum(axis=1)
    scale = -n * np.linalg.norm(points - rig.cop, axis=1)
    for q, d in random_lines(RNG_LINES, seed=6):
        line = Line(q, q + d)
        lines = (np.tile(v, (len(points), 1)) for v in (line.direction, line.moment))
        expected = scale * side(rays, *lines, Pose2())
        found = ReflectionCurve.of_line(rig, line).side(points)
        assert found == pytest.approx(expected, rel=1e-7, abs=1e-9 * np.abs(expected).max())


@pytest.mark.parametrize('name', TABLE_ONE)
def test_projected_points_lie_on_the_curve(name: str) -> None:
    """The check of the paper's figure: Agrawal's projection against gamma and x."""
    mirror, cop = SCENES[name]
    rng = np.random.default_rng(7)
    tested = 0
    for q, d in random_lines(RNG_LINES, seed=8):
        points = q + rng.uniform(-2.0, 2.0, (50, 1)) * d
        m, visible = reflect_points(mirror, cop, points)
        m = m[visible]
        c = paper_polynomials(mirror, cop, q, d)
        curve = ReflectionCurve(mirror, cop, q, d)
        assert curve.distance(m).max(initial=0.0) < 1e-9
        c5, c6, c7, c8, c9 = (getattr(c, f'c{i}')(m[:, 1], m[:, 2]) for i in range(5, 10))
        terms = np.stack([c5 * c9**2, -c6 * c8 * c9, c7 * c8**2])
        relative = np.abs(terms.sum(axis=0)) / np.abs(terms).sum(axis=0)
        assert relative.max(initial=0.0) < 1e-8
        far = np.abs(c.c10(m[:, 1], m[:, 2])) > 1e-3 * np.median(np.abs(c.c10(m[:, 1], m[:, 2])))
        x = c.c11(m[:, 1], m[:, 2]) / c.c10(m[:, 1], m[:, 2])
        assert x[far] == pytest.approx(m[far, 0], abs=1e-8)
        assert (curve.branch(m) == Branch.PHYSICAL).all()
        tested += len(m)
    assert tested > 500


def test_the_prints_sign_of_k_is_wrong() -> None:
    """With k = m + n, as printed, eq. 6 gives another x; for a sphere there is no difference.

    The numbers are those of docs/paper.md.
    """
    def printed_x(mirror: QuadricMirror, cop: np.ndarray, q, d, m) -> np.ndarray:
        # eq. 6 by its own words: the plane of p(lambda), o and the printed k, solved for x
        k_z = m[:, 2] - mirror.A * m[:, 2] + mirror.B / 2
        lam, _ = ReflectionCurve(mirror, cop, q, d).along_line(m)
        p = q + lam[:, None] * d
        k = np.stack([0 * k_z, 0 * k_z, k_z], axis=1)
        normal = np.cross(p - cop, k - cop)
        return -((m[:, 1:] - cop[1:]) * normal[:, 1:]).sum(axis=1) / normal[:, 0]

    errors = {}
    for name, rig in TABLE_ONE.items():
        relative = []
        for q, d in random_lines(400, seed=9):
            m, visible = reflect_points(
                rig.mirror, rig.cop, q + np.linspace(-2.0, 2.0, 41)[:, None] * d)
            m = m[visible]
            relative.append(np.abs(printed_x(rig.mirror, rig.cop, q, d, m) / m[:, 0] - 1.0))
        errors[name] = float(np.median(np.concatenate(relative)))
    assert errors['spherical'] < 1e-9
    assert errors['hyperbolic'] == pytest.approx(0.26, abs=0.02)
    assert errors['parabolic'] == pytest.approx(3.34, abs=0.1)


@pytest.mark.parametrize('name', TABLE_ONE)
def test_branches_are_told_apart(name: str) -> None:
    mirror, cop = SCENES[name]
    count = np.zeros(len(Branch), dtype=int)
    for q, d in random_lines(RNG_LINES, seed=10):
        curve = ReflectionCurve(mirror, cop, q, d)
        m, branch = curve.zeros_of_gamma(heights(mirror))
        count += np.bincount(branch, minlength=len(Branch))
        # gamma is zero on all of them
        c = paper_polynomials(mirror, cop, q, d)
        typical = np.median(np.abs(c.gamma(m[:, 1] + 0.003, m[:, 2])))
        assert np.median(np.abs(c.gamma(m[:, 1], m[:, 2]))) < 1e-9 * typical
        # and only the first is seen: projecting the line's points again gives exactly it
        along, ahead = curve.along_line(m)
        again, visible = reflect_points(mirror, cop, q + along[:, None] * d)
        same = visible & (np.linalg.norm(again - m, axis=1) < 1e-7)
        assert same[branch == Branch.PHYSICAL].all()
        assert not same[branch == Branch.VIRTUAL].any()
        assert (ahead[branch == Branch.VIRTUAL] < 0.0).all()
        flipped = curve.branch(m[branch == Branch.MIRRORED] * [-1.0, 1.0, 1.0])
        assert np.isin(flipped, [Branch.PHYSICAL, Branch.VIRTUAL]).all()
    share = count / count.sum()
    assert count[Branch.OFF] == 0
    assert 0.10 < share[Branch.PHYSICAL] < 0.25
    assert 0.25 < share[Branch.MIRRORED] < 0.45
    assert share[Branch.SPURIOUS] > 0.15


def test_the_spurious_conic_is_the_same_for_all_lines() -> None:
    mirror, cop = SCENES['hyperbolic']
    zeros = []
    for q, d in random_lines(3, seed=11):
        m, branch = ReflectionCurve(mirror, cop, q, d).zeros_of_gamma(heights(mirror))
        zeros.append(m[branch == Branch.SPURIOUS])
    assert len(zeros[0]) > 20
    assert zeros[0] == pytest.approx(zeros[1], abs=0.0)
    assert zeros[0] == pytest.approx(zeros[2], abs=0.0)


@pytest.mark.parametrize('name', TABLE_ONE)
def test_the_curve_equation_and_the_points_projection_draw_the_same_line(name: str) -> None:
    mirror, cop = SCENES[name]
    drawn = 0
    for q, d in random_lines(RNG_LINES, seed=12):
        curve = ReflectionCurve(mirror, cop, q, d)
        m = curve.physical(heights(mirror), length=2.0)
        along, _ = curve.along_line(m)
        assert (np.diff(along) >= 0.0).all()
        assert (along >= 0.0).all()
        assert (along <= 2.0).all()
        again, visible = reflect_points(mirror, cop, curve.point + along[:, None] * d)
        assert visible.all()
        assert np.linalg.norm(again - m, axis=1).max(initial=0.0) < 1e-7
        drawn += len(m)
    assert drawn > 400


@pytest.mark.parametrize('direction', [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
def test_lines_along_the_axes_have_a_curve_too(direction: list) -> None:
    """The paper's x = P / Q fails for a line parallel to x (Q = 0); the branch does not."""
    mirror, cop = SCENES['spherical']
    curve = ReflectionCurve(mirror, cop, np.array([-0.2, -0.1, 0.2]), np.array(direction))
    if direction[0]:
        assert np.abs(curve.factors(0.01, 0.01)[2]) == 0.0
    m = curve.physical(heights(mirror), length=np.inf)
    assert len(m) > 10
    along, _ = curve.along_line(m)
    again, visible = reflect_points(mirror, cop, curve.point + along[:, None] * curve.direction)
    assert visible.all()
    assert np.linalg.norm(again - m, axis=1).max() < 1e-6


@pytest.mark.parametrize('name', TABLE_ONE)
def test_trace_in_the_image(name: str) -> None:
    rig = TABLE_ONE[name]
    line = Line([-1.5, 0.8, 0.0], [1.5, 0.6, 0.0])
    pieces = trace_pieces(rig, line, spacing=2.0)
    assert len(pieces) >= 1
    curve = ReflectionCurve.of_line(rig, line)
    for pixels in pieces:
        m, hit = rig.mirror_points(pixels)
        assert hit.all()
        assert rig.camera.contains(pixels).all()
        assert curve.distance(m).max() < 1e-7
        along, ahead = curve.along_line(m)
        assert (np.diff(along) > 0.0).all()
        assert (ahead > 0.0).all()
        assert np.linalg.norm(np.diff(pixels, axis=0), axis=1).max() <= 2.0
        # a piece ends with the segment or where the line leaves the image
        for end, a in ((pixels[0], along[0]), (pixels[-1], along[-1])):
            at_border = min(*end, *(np.array([1199.0, 799.0]) - end)) < 0.1
            assert at_border or min(a, line.length - a) < 1e-6
    assert trace_line(rig, line, spacing=2.0) == pytest.approx(np.concatenate(pieces))


def test_trace_of_what_the_mirror_hides_is_empty() -> None:
    rig = TABLE_ONE['spherical']
    above = Line([-0.01, 0.0, 3.0], [0.01, 0.0, 3.0])
    assert trace_line(rig, above).shape == (0, 2)
    assert trace_pieces(rig, above) == ()


def test_impossible_lines_are_refused_by_name() -> None:
    mirror, cop = SCENES['spherical']
    with pytest.raises(GeometryError, match='d = 0'):
        paper_polynomials(mirror, cop, [1.0, 0.0, 0.0], [0.0, 0.0, 0.0])
    with pytest.raises(GeometryError, match='d = 0'):
        ReflectionCurve(mirror, cop, np.ones(3), np.zeros(3))
    with pytest.raises(GeometryError, match='point'):
        ReflectionCurve(mirror, cop, np.array([0.0, np.nan, 0.0]), np.ones(3))
    with pytest.raises(GeometryError, match='finite'):
        paper_polynomials(mirror, cop, [np.inf, 0.0, 0.0], [0.0, 0.0, 1.0])
    for make in (paper_polynomials, ReflectionCurve):
        with pytest.raises(GeometryError, match='inside the mirror'):
            make(mirror, np.array([0.0, 0.0, 0.02]), np.ones(3), np.ones(3))
        with pytest.raises(GeometryError, match='x must be 0'):
            make(mirror, np.array([0.01, 0.0, 0.06]), np.ones(3), np.ones(3))
    with pytest.raises(GeometryError, match='spacing'):
        trace_line(TABLE_ONE['spherical'], Line([0, 1, 0], [1, 1, 0]), spacing=0.0)
