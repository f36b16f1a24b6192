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

"""The tabulated floor against the exact maps that it stands in for."""

from __future__ import annotations

from dataclasses import replace

from nccs_pose.errors import GeometryError
from nccs_pose.geometry.floor_table import as_complex, as_points, FloorTable
from nccs_pose.geometry.pose import RigidTransform
from nccs_pose.geometry.rig import Rig
from nccs_pose.simulation.scene import arena_rig
from nccs_pose.simulation.table_one import TABLE_ONE
import numpy as np
import pytest

REACH = 4.0
RIGS = {'arena': arena_rig(), **TABLE_ONE}


@pytest.fixture(scope='module', params=RIGS)
def rig(request: pytest.FixtureRequest) -> Rig:
    return RIGS[request.param]


@pytest.fixture(scope='module')
def table(rig: Rig) -> FloorTable:
    return FloorTable(rig, REACH)


def _floor_points(rig: Rig, reach: float, n: int = 3000) -> np.ndarray:
    """Ground points spread evenly over a disc about the mirror's foot (N, 2)."""
    rng = np.random.default_rng(3)
    radius, azimuth = reach * np.sqrt(rng.random(n)), 2.0 * np.pi * rng.random(n)
    polar = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth)], axis=1)
    return rig.T_base_mirror.translation[:2] + polar


def test_pixels_of_ground_points_are_those_of_the_exact_projection(
        rig: Rig, table: FloorTable) -> None:
    points = _floor_points(rig, REACH)
    exact, visible = rig.project(np.column_stack([points, np.zeros(len(points))]))
    assert visible.sum() > 200
    error = np.linalg.norm(table.pixels(points) - exact, axis=1)[visible]
    # A tape is measured to some hundredths of a pixel.
    assert np.sqrt(np.mean(error**2)) < 2e-3
    assert error.max() < 2e-2


def test_derivatives_of_pixels_are_those_of_the_exact_projection(
        rig: Rig, table: FloorTable) -> None:
    points = _floor_points(rig, 1.5, 400)
    rng = np.random.default_rng(5)
    direction = rng.normal(size=points.shape)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)

    def exact(at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return rig.project(np.column_stack([at, np.zeros(len(at))]))

    h = 3e-3
    (ahead, a), (here, b), (behind, c) = (
        exact(points + step * direction) for step in (h, 0.0, -h))
    seen = a & b & c
    assert seen.sum() > 100
    found = table.expand(as_complex(points))
    _, by_step, by_conjugate, twice, mixed, conjugate_twice = found.terms
    step = as_complex(direction)
    back = step.conj()
    np.testing.assert_allclose(
        as_points(found.pixels)[seen], table.pixels(points)[seen], atol=1e-9)
    slope, bend = (ahead - behind) / (2.0 * h), (ahead + behind - 2.0 * here) / h**2
    found_slope = as_points(by_step * step + by_conjugate * back)
    assert np.abs(found_slope - slope)[seen].max() < 2e-3 * np.abs(slope[seen]).max()
    # The curve's bend counts over some pixels along it only.
    found_bend = as_points(twice * step**2 + 2.0 * mixed + conjugate_twice * back**2)
    assert np.median(np.abs(found_bend - bend)[seen]) < 0.01 * np.abs(bend[seen]).max()


def test_it_is_known_about_where_points_are_seen(rig: Rig, table: FloorTable) -> None:
    points = as_complex(_floor_points(rig, 1.2 * REACH))
    found, seen = table.outline(points)
    pixels = as_points(found)
    near = [table.sees_floor(pixels + 5.0 * np.array(way)) for way in (
        (0, 0), (1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (1, -1), (-1, 1), (-1, -1))]
    inside, outside = np.all(near, axis=0), ~np.any(near, axis=0)
    assert inside.sum() > 200
    assert outside.sum() > 200
    assert seen[inside].all()
    assert not seen[outside].any()
    assert np.abs(found - table.expand(points).pixels)[seen].max() < 0.3


def test_the_region_is_where_pixels_see_the_floor(rig: Rig, table: FloorTable) -> None:
    v, u = np.mgrid[0:rig.camera.height:7, 0:rig.camera.width:7]
    pixels = np.stack([u.ravel(), v.ravel()], axis=1).astype(float)
    points, reaches = rig.back_project(pixels).floor_points()
    distance = np.linalg.norm(points - rig.T_base_mirror.translation[:2], axis=1)
    truly = reaches & (distance < REACH)
    claimed = table.sees_floor(pixels)
    np.testing.assert_array_equal(claimed, table.region[v.ravel(), u.ravel()] > 0)
    # It never claims a pixel that sees none, and gives away no more than the region's border.
    assert not (claimed & ~truly).any()
    assert claimed.sum() > 0.93 * truly.sum()


def test_ground_points_of_pixels_agree_with_back_projection(rig: Rig, table: FloorTable) -> None:
    v, u = np.nonzero(table.region)
    rng = np.random.default_rng(4)
    index = rng.choice(len(u), 2000, replace=False)
    pixels = np.stack([u[index], v[index]], axis=1).astype(float)
    points, jacobian = table.floor(pixels)
    exact, _ = rig.back_project(pixels).floor_points()
    footprint = np.linalg.norm(jacobian, axis=(1, 2))
    error = np.linalg.norm(points - exact, axis=1) / footprint
    # As much as its documentation promises.
    assert np.median(error) < 0.1
    assert np.percentile(error, 95) < 0.5


def test_the_jacobian_of_ground_points_is_that_of_back_projection(
        rig: Rig, table: FloorTable) -> None:
    near = _floor_points(rig, 1.5, 500)
    exact, visible = rig.project(np.column_stack([near, np.zeros(len(near))]))
    pixels = exact[visible & table.sees_floor(exact)]
    _, jacobian = table.floor(pixels)
    h = 0.5
    for axis in range(2):
        step = h * np.eye(2)[axis]
        ahead, _ = rig.back_project(pixels + step).floor_points()
        behind, _ = rig.back_project(pixels - step).floor_points()
        numeric = (ahead - behind) / (2.0 * h)
        error = np.linalg.norm(jacobian[:, :, axis] - numeric, axis=1)
        assert np.median(error / np.linalg.norm(numeric, axis=1)) < 0.05


def test_pixels_outside_the_image_see_no_floor(table: FloorTable, rig: Rig) -> None:
    w, h = rig.camera.width, rig.camera.height
    outside = np.array([[-5.0, 10.0], [w + 3.0, 10.0], [10.0, -4.0], [10.0, h + 2.0],
                        [-1e9, 1e9], [1e9, -1e9]])
    assert not table.sees_floor(outside).any()


def test_the_floor_is_seen_where_the_nearest_pixel_of_the_region_says(
    table: FloorTable, rig: Rig,
) -> None:
    rng = np.random.default_rng(2)
    size = np.array([rig.camera.width, rig.camera.height])
    pixels = rng.uniform(-10.0, size + 10.0, (4000, 2))
    expected = []
    for u, v in pixels:
        column, row = round(u), round(v)
        inside = 0 <= column < size[0] and 0 <= row < size[1]
        expected.append(inside and table.region[row, column] > 0)
    assert 100 < sum(expected) < 3900
    np.testing.assert_array_equal(table.sees_floor(pixels), expected)


def test_a_mirror_under_the_floor_is_refused() -> None:
    rig = arena_rig()
    sunk = replace(rig, T_base_mirror=RigidTransform(
        rig.T_base_mirror.rotation, np.array([0.0, 0.0, -0.2])))
    with pytest.raises(GeometryError, match=r'-0\.2'):
        FloorTable(sunk, REACH)


def test_a_rig_that_looks_at_the_ceiling_is_refused() -> None:
    rig = arena_rig()
    # Without its rim, which would show the floor far away.
    up = replace(
        rig, mirror=replace(rig.mirror, rim_radius=0.5 * rig.mirror.rim_radius),
        T_base_mirror=RigidTransform(np.eye(3), np.array([0.0, 0.0, 0.75])))
    with pytest.raises(GeometryError, match='no floor'):
        FloorTable(up, REACH)


def test_a_mirror_that_hides_its_own_foot_shows_the_floor_round_it() -> None:
    rig = arena_rig()
    up = replace(rig, T_base_mirror=RigidTransform(np.eye(3), np.array([0.0, 0.0, 0.75])))
    table, points = FloorTable(up, REACH), _floor_points(up, REACH)
    exact, visible = up.project(np.column_stack([points, np.zeros(len(points))]))
    _, seen = table.outline(as_complex(points))
    assert not visible[np.linalg.norm(points, axis=1) < 0.2].any()
    known = visible & table.sees_floor(table.pixels(points)) & seen
    assert known.sum() > 0.9 * (visible & table.sees_floor(exact)).sum() > 200
    assert np.linalg.norm(table.pixels(points) - exact, axis=1)[known].max() < 2e-2
