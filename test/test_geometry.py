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

"""Laws of poses, lines, mirror, camera and rig, each against an independent statement."""

from __future__ import annotations

import cv2
from hypothesis import given
from hypothesis import strategies as st
from nccs_pose.errors import GeometryError
from nccs_pose.geometry import (
    Line,
    LineMap,
    PinholeCamera,
    Pose2,
    QuadricMirror,
    Rig,
    RigidTransform,
    wrap_angle,
)
from nccs_pose.geometry.pose import rotation_exp
from nccs_pose.geometry.small_matrices import solve_definite
from nccs_pose.simulation.table_one import look_at, MOUNTING, TABLE_ONE
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

finite = st.floats(-5.0, 5.0)
angles = st.floats(-10.0, 10.0)
poses = st.builds(Pose2, finite, finite, angles)
MIRRORS = {
    **{name: rig.mirror for name, rig in TABLE_ONE.items()},
    'oblate': QuadricMirror(1.7, 0.004, 0.0011),
    'prolate': QuadricMirror(0.4, -0.003, 0.0006),
    'flat hyperboloid': QuadricMirror(-0.3, 0.01, -0.0006),
}
RIGS = {**TABLE_ONE, **{
    name: Rig(mirror, TABLE_ONE['spherical'].camera, np.array([0.0, 0.012, 0.07]),
              look_at(np.array([0.0, 0.012, 0.07]), np.array([0.0, 0.0, mirror.apex_z])),
              RigidTransform.from_rpy([3.1, 0.03, -0.7], [0.05, -0.02, 0.8]))
    for name, mirror in MIRRORS.items() if name not in TABLE_ONE}}


def some_pixels(rig: Rig, n: int = 400, seed: int = 0) -> np.ndarray:
    """Draw pixels that see the mirror."""
    rng = np.random.default_rng(seed)
    pixels = rng.uniform([0.0, 0.0], [rig.camera.width - 1, rig.camera.height - 1], (n, 2))
    # A grazing ray turns infinitely fast; finite differences across it mean nothing.
    m, hit = rig.mirror_points(pixels)
    n_m = rig.mirror.normal(m)
    v = m - rig.cop
    grazing = np.einsum('ni,ni->n', n_m, v) > -0.15 * np.linalg.norm(n_m, axis=1) * \
        np.linalg.norm(v, axis=1)
    return pixels[hit & ~grazing]


@given(poses, poses, poses)
def test_planar_poses_form_a_group_that_acts_on_points(a: Pose2, b: Pose2, c: Pose2) -> None:
    points = np.array([[0.3, -2.0], [1.0, 4.0]])
    np.testing.assert_allclose((a @ b).apply(points), a.apply(b.apply(points)), atol=1e-12)
    left, right = (a @ b) @ c, a @ (b @ c)
    np.testing.assert_allclose(left.apply(points), right.apply(points), atol=1e-12)
    np.testing.assert_allclose((a @ a.inverse()).apply(points), points, atol=1e-12)


@given(st.floats(-1e3, 1e3))
def test_wrapped_angles_are_the_same_direction_in_the_half_open_interval(angle: float) -> None:
    wrapped = float(wrap_angle(angle))
    assert -np.pi < wrapped <= np.pi
    assert abs(np.exp(1j * wrapped) - np.exp(1j * angle)) < 1e-9


def test_wrap_angle_keeps_pi() -> None:
    assert float(wrap_angle(np.pi)) == np.pi
    assert float(wrap_angle(-np.pi)) == np.pi


@given(st.lists(st.floats(-3.0, 3.0), min_size=3, max_size=3), angles, angles, angles)
def test_rotations_agree_with_scipy(vector: list, roll: float, pitch: float, yaw: float) -> None:
    np.testing.assert_allclose(
        rotation_exp(vector), Rotation.from_rotvec(vector).as_matrix(), atol=1e-12)
    transform = RigidTransform.from_rpy([roll, pitch, yaw], [1.0, 2.0, 3.0])
    np.testing.assert_allclose(
        transform.rotation, Rotation.from_euler('xyz', [roll, pitch, yaw]).as_matrix(), atol=1e-12)
    again = RigidTransform.from_rpy(transform.rpy(), transform.translation)
    np.testing.assert_allclose(again.rotation, transform.rotation, atol=1e-9)


@given(poses)
def test_lines_keep_their_points_when_moved(pose: Pose2) -> None:
    line = Line([0.5, -1.0, 0.0], [2.0, 3.0, 0.0], width=0.05)
    moved = line.transformed(pose)
    point = pose.apply(line.start + 0.3 * line.direction)
    # A point is on a line when p x d = mu.
    np.testing.assert_allclose(np.cross(point, moved.direction), moved.moment, atol=1e-12)
    right, left = moved.edges()
    assert abs(np.linalg.norm(np.cross(left.start - right.start, moved.direction)) - 0.05) < 1e-12
    assert np.cross(moved.direction, left.start - right.start)[2] > 0.0


@pytest.mark.parametrize('name', MIRRORS)
def test_intersections_lie_on_the_near_side_of_the_physical_sheet(name: str) -> None:
    mirror = MIRRORS[name]
    rng = np.random.default_rng(1)
    origin = np.array([0.0, 0.013, 0.06])
    directions = rng.normal(size=(3000, 3)) - [0.0, 0.0, 1.5]
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    points, hit = mirror.intersect(origin, directions)
    assert 50 < hit.sum() < len(hit)
    on = points[hit]
    # A mirror without a rim is met as far as 100 m away: rounding counts against the distance.
    size = 1.0 + np.einsum('ni,ni->n', on, on)
    np.testing.assert_allclose(mirror.level(on) / size, 0.0, atol=1e-14)
    np.testing.assert_allclose(
        np.cross(on - origin, directions[hit]) / size[:, None], 0.0, atol=1e-14)
    assert (np.einsum('ni,ni->n', mirror.normal(on), directions[hit]) < 0.0).all()
    # Marching along each ray finds the body just where the formula says, or nowhere.
    t = np.linspace(0.0, 0.3, 3001)
    march = origin + t[:, None, None] * directions[:200]
    inside = (mirror.level(march) < 0.0) & (mirror.A * march[..., 2] + 0.5 * mirror.B > 0.0)
    first = np.where(inside.any(axis=0), t[inside.argmax(axis=0)], np.inf)
    distance = np.where(hit[:200], np.linalg.norm(points[:200] - origin, axis=1), np.inf)
    near = distance < 0.29
    assert (np.abs(first[near] - distance[near]) < 2e-3).mean() > 0.98
    # A sphere's lower half is no part of the mirror: such rays enter there and do not hit.
    assert np.isinf(first[~hit[:200]]).all() or mirror.A > 0.0


def test_the_hyperbolic_mirror_is_the_lower_sheet() -> None:
    mirror = MIRRORS['hyperbolic']
    assert abs(mirror.apex_z - -4.031e-3) < 1e-6
    assert mirror.kind == 'hyperboloid'
    assert not mirror.contains(np.array([0.0, 0.0, 6.864e-3]))


@pytest.mark.parametrize('coefficients, word', [
    ((1.0, 0.0, -1.0), 'no real surface'), ((0.0, 0.0, 1.0), 'paraboloid'),
    ((0.0, -0.02, 1.0), 'paraboloid'), ((-1.0, 0.0, 1.0), 'one sheet'),
    ((float('nan'), 0.0, 1.0), 'A = nan')])
def test_a_quadric_that_is_no_mirror_is_refused(coefficients: tuple, word: str) -> None:
    with pytest.raises(GeometryError, match=word):
        QuadricMirror(*coefficients)


@pytest.mark.parametrize('rim', [0.02, 0.005])
def test_the_rim_cuts_the_mirror_at_its_radius(rim: float) -> None:
    for mirror in MIRRORS.values():
        cut = QuadricMirror(mirror.A, mirror.B, mirror.C, rim_radius=rim)
        at = np.array([rim, 0.0, cut.z_min])
        assert abs(cut.level(at)) < 1e-12
        assert cut.contains(at - [0.0, 0.0, 0.0])
        assert not cut.contains(at - [0.0, 0.0, 1e-5])


@pytest.mark.parametrize('model, distortion', [
    ('plumb_bob', [-0.21, 0.06, 0.001, -0.002, -0.005]),
    ('rational_polynomial', [0.4, -0.1, 0.0005, 0.001, 0.01, 0.6, -0.05, 0.02])])
def test_distortion_agrees_with_opencv_and_inverts(model: str, distortion: list) -> None:
    camera = PinholeCamera(640, 480, 500.0, 510.0, 321.0, 238.0, model, tuple(distortion))
    rng = np.random.default_rng(2)
    pixels = rng.uniform([0, 0], [639, 479], (300, 2))
    directions, jacobian = camera.directions_with_jacobian(pixels)
    expected, _ = cv2.projectPoints(
        directions.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), camera.K, np.array(distortion))
    np.testing.assert_allclose(expected.reshape(-1, 2), pixels, atol=1e-6)
    again, in_front = camera.project(directions)
    assert in_front.all()
    np.testing.assert_allclose(again, pixels, atol=1e-8)
    step = 1e-4
    for k in range(2):
        shift = np.zeros(2)
        shift[k] = step
        ahead, behind = camera.directions(pixels + shift), camera.directions(pixels - shift)
        numeric = (ahead - behind) / (2 * step)
        np.testing.assert_allclose(jacobian[:, :, k], numeric, atol=1e-9)


def test_a_pixel_beyond_the_distortion_model_has_no_direction() -> None:
    camera = PinholeCamera(640, 480, 200.0, 200.0, 320.0, 240.0, 'plumb_bob', (-0.5, 0.0))
    assert (camera.directions(np.array([[0.0, 0.0]])) == 0.0).all()
    assert np.linalg.norm(camera.directions(np.array([[300.0, 200.0]]))) == pytest.approx(1.0)


@pytest.mark.parametrize('name', RIGS)
def test_back_projection_obeys_the_law_of_reflection(name: str) -> None:
    rig = RIGS[name]
    pixels = some_pixels(rig)
    rays = rig.back_project(pixels)
    m, hit = rig.mirror_points(pixels)
    assert hit.all() and rays.hit.all()
    to_mirror = rig.T_base_mirror.inverse()
    r = to_mirror.rotate(rays.direction)
    v = (m - rig.cop) / np.linalg.norm(m - rig.cop, axis=1, keepdims=True)
    n = rig.mirror.normal(m)
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    # In the plane of incidence, and with equal angles on the other side of the normal.
    np.testing.assert_allclose(np.einsum('ni,ni->n', np.cross(v, n), r), 0.0, atol=1e-12)
    np.testing.assert_allclose(
        np.einsum('ni,ni->n', r, n), -np.einsum('ni,ni->n', v, n), atol=1e-12)
    np.testing.assert_allclose(np.einsum('ni,ni->n', r, r), 1.0, atol=1e-12)
    # The ray passes through the mirror point.
    m_base = rig.T_base_mirror.apply(m)
    np.testing.assert_allclose(np.cross(m_base, rays.direction), rays.moment, atol=1e-13)


@pytest.mark.parametrize('name', RIGS)
def test_ray_jacobians_agree_with_finite_differences(name: str) -> None:
    rig = RIGS[name]
    pixels = some_pixels(rig)
    rays = rig.back_project(pixels)
    step = 1e-3
    for k in range(2):
        shift = np.zeros(2)
        shift[k] = step
        plus, minus = rig.back_project(pixels + shift), rig.back_project(pixels - shift)
        both = plus.hit & minus.hit
        for exact, a, b in (
                (rays.direction_jacobian, plus.direction, minus.direction),
                (rays.moment_jacobian, plus.moment, minus.moment)):
            np.testing.assert_allclose(
                exact[both, :, k], ((a - b) / (2 * step))[both], rtol=1e-4, atol=1e-7)


@pytest.mark.parametrize('name', RIGS)
def test_points_on_a_reflected_ray_project_to_its_pixel(name: str) -> None:
    rig = RIGS[name]
    pixels = some_pixels(rig, seed=3)
    rays = rig.back_project(pixels)
    m = rig.T_base_mirror.apply(rig.mirror_points(pixels)[0])
    for distance in (0.05, 0.7, 4.0):
        again, visible = rig.project(m + distance * rays.direction)
        assert visible.all()
        np.testing.assert_allclose(again, pixels, atol=1e-6)


def test_floor_points_are_where_the_ray_meets_the_ground() -> None:
    rig = RIGS['spherical']
    rays = rig.back_project(some_pixels(rig))
    floor, reaches = rays.floor_points()
    assert reaches.sum() > 20
    points = np.column_stack([floor, np.zeros(len(floor))])[reaches]
    np.testing.assert_allclose(
        np.cross(points, rays.direction[reaches]), rays.moment[reaches], atol=1e-9)


def test_pixels_that_miss_the_mirror_say_so_without_nan() -> None:
    rig = RIGS['spherical']
    rays = rig.back_project(np.array([[0.0, 0.0], [599.5, 399.5]]))
    assert rays.hit.tolist() == [False, True]
    for array in (rays.direction, rays.moment, rays.direction_jacobian, rays.moment_jacobian):
        assert np.isfinite(array).all()
        assert (array[0] == 0.0).all()


def test_rigs_that_cannot_be_are_refused_by_name() -> None:
    good = TABLE_ONE['spherical']
    with pytest.raises(GeometryError, match='inside the mirror'):
        Rig(good.mirror, good.camera, np.array([0.0, 0.0, 0.01]), np.eye(3), MOUNTING)
    with pytest.raises(GeometryError, match='does not see the mirror'):
        Rig(good.mirror, good.camera, good.cop, np.eye(3), MOUNTING)
    with pytest.raises(GeometryError, match='x must be 0'):
        beside = good.cop + np.array([0.001, 0.0, 0.0])
        Rig(good.mirror, good.camera, beside, good.R_mirror_camera, MOUNTING)
    with pytest.raises(GeometryError, match='orthonormal'):
        Rig(good.mirror, good.camera, good.cop, 1.1 * good.R_mirror_camera, MOUNTING)


def test_lines_that_are_none_are_refused_by_name() -> None:
    with pytest.raises(GeometryError, match=r"'a'.*coincide"):
        Line([1, 2, 0], [1, 2, 0], name='a')
    with pytest.raises(GeometryError, match='horizontal'):
        Line([0, 0, 0], [0, 0, 1], width=0.05)
    with pytest.raises(GeometryError, match='no line'):
        LineMap(())
    with pytest.raises(GeometryError, match='finite'):
        Pose2(float('nan'), 0.0, 0.0)


def test_a_scaled_camera_sees_the_same_directions() -> None:
    camera = TABLE_ONE['parabolic'].camera
    half = camera.scaled(0.5)
    # The corner of the image is at pixel -0.5 whatever the resolution.
    corner = np.array([[-0.5, -0.5]])
    np.testing.assert_allclose(camera.directions(corner), half.directions(corner), atol=1e-12)
    assert (half.width, half.height) == (600, 400)


@given(poses, poses)
def test_the_difference_of_poses_is_that_of_numbers_with_the_angle_wrapped(
    a: Pose2, b: Pose2,
) -> None:
    difference = a.minus(b)
    np.testing.assert_allclose(difference[:2], [a.x - b.x, a.y - b.y], atol=1e-12)
    turn = Rotation.from_euler('z', a.yaw) * Rotation.from_euler('z', b.yaw).inv()
    # As angles, not as numbers: half a turn is both -pi and pi.
    assert abs(np.exp(1j * difference[2]) - np.exp(1j * turn.as_rotvec()[2])) < 1e-9
    assert abs(difference[2]) <= np.pi


def test_a_definite_system_is_solved_and_another_is_refused() -> None:
    rng = np.random.default_rng(0)
    root = rng.standard_normal((4, 4))
    matrix, right = root @ root.T, rng.standard_normal((4, 3))
    np.testing.assert_allclose(matrix @ solve_definite(matrix, right), right, atol=1e-10)
    np.testing.assert_allclose(
        matrix @ solve_definite(matrix, right[:, 0]), right[:, 0], atol=1e-10)
    with pytest.raises(np.linalg.LinAlgError):
        solve_definite(np.diag([1.0, -1.0]), np.ones(2))
