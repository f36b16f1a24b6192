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

"""Sets of lines that leave something open: every pose that they allow is returned."""

from __future__ import annotations

import math

from labelled_scene import observe, pose_error, random_scene
from nccs_pose.errors import EstimationError
from nccs_pose.estimation.global_pose import solve
from nccs_pose.estimation.observability import unobserved_directions
from nccs_pose.estimation.residual import whitened_residual
from nccs_pose.geometry.pose import Pose2
from nccs_pose.simulation.table_one import TABLE_ONE
import numpy as np
import pytest

RIGS = sorted(TABLE_ONE)
UP = (0.0, 0.0, 1.0)


def floor(x, y, bearing, z=0.0):
    """A horizontal line through a point: (q, d)."""
    return (x, y, z), (math.cos(bearing), math.sin(bearing), 0.0)


# Sets of lines that half a turn about a point maps onto themselves, and the point.
TWINS = {
    'two lines that meet': ([floor(0.7, 0.2, 0.3), floor(0.7, 0.2, 1.9)], (0.7, 0.2)),
    'two lines at two heights': ([floor(0.7, 0.2, 0.3), floor(0.7, 0.2, 1.9, 0.4)], (0.7, 0.2)),
    'concurrent lines': ([floor(-0.5, 0.6, b) for b in (0.3, 1.2, 2.5)], (-0.5, 0.6)),
    'lines through one vertical line': (
        [((0.6, -0.5, 0.0), UP), floor(0.6, -0.5, 0.4), floor(0.6, -0.5, 2.0)], (0.6, -0.5)),
}
PARALLEL = [floor(0.0, 0.8, 0.3), floor(0.1, -0.7, 0.3)]
ONE_LINE = [floor(0.4, 0.8, 0.3)]
ONE_VERTICAL_LINE = [((0.6, -0.5, 0.0), UP)]


def seen_by(name, lines, *, noise=0.0, seed=0):
    """A scene with these lines from a random pose near the map's origin."""
    points, directions = (np.array(column, dtype=float) for column in zip(*lines))
    rng = np.random.default_rng(seed)
    scene = None
    while scene is None:
        pose = Pose2(*rng.uniform(-0.3, 0.3, 2), rng.uniform(-math.pi, math.pi))
        scene = observe(TABLE_ONE[name], pose, points, directions, noise=noise, rng=rng)
    return scene


@pytest.mark.parametrize('name', RIGS)
@pytest.mark.parametrize('noise', [0.0, 1.0])
@pytest.mark.parametrize('words', TWINS)
def test_both_twins_are_returned(words, noise, name):
    lines, centre = TWINS[words]
    scene = seen_by(name, lines, noise=noise)
    found = solve(scene.rays, scene.directions, scene.moments, scene.label)
    assert len(found) == 2
    assert found[0].chi2 == pytest.approx(found[1].chi2, rel=1e-6, abs=1e-9)
    twin = Pose2(*(2.0 * np.array(centre) - found[0].pose.translation[:2]),
                 found[0].pose.yaw + math.pi)
    assert np.abs(pose_error(found[1].pose, twin)).max() < 1e-6
    # One of them is the true one, as well as its covariance says.
    e = [pose_error(solution.pose, scene.pose) for solution in found]
    if noise == 0.0:
        assert min(np.abs(v).max() for v in e) < 1e-7
    else:
        assert min(v @ s.information @ v for v, s in zip(e, found)) < 20.0
    assert all(s.unobserved == () for s in found)


@pytest.mark.parametrize('name', RIGS)
@pytest.mark.parametrize('noise', [0.0, 1.0])
def test_parallel_lines_leave_the_position_along_them(noise, name):
    scene = seen_by(name, PARALLEL, noise=noise)
    found = solve(scene.rays, scene.directions, scene.moments, scene.label)
    assert len(found) == 1 and found[0].covariance is None
    along = scene.directions[0]
    (open_,) = found[0].unobserved
    assert np.abs(np.cross(open_.direction, along)[2]) < 1e-9 and abs(open_.direction[2]) < 1e-9
    assert open_.words == 'position along (0.955, 0.296)'
    e = pose_error(found[0].pose, scene.pose)
    e[:2] -= (e[:2] @ along[:2]) * along[:2]
    assert np.abs(e).max() < (1e-8 if noise == 0.0 else 0.05)
    # The open direction costs nothing: slid along it the pose is just as good.
    slid = Pose2.from_array(found[0].pose.as_array() + 0.5 * open_.direction)
    here, there = (
        whitened_residual(*scene.by_ray, pose)[0] for pose in (found[0].pose, slid))
    assert there @ there == pytest.approx(here @ here, rel=0.3, abs=1e-9)


@pytest.mark.parametrize('noise', [0.0, 1.0])
def test_one_line_leaves_the_position_along_it_and_a_twin(noise):
    scene = seen_by('spherical', ONE_LINE, noise=noise)
    found = solve(scene.rays, scene.directions, scene.moments, scene.label)
    assert len(found) == 2
    assert abs(math.remainder(
        found[0].pose.yaw - found[1].pose.yaw - math.pi, 2.0 * math.pi)) < 1e-6
    for solution in found:
        (open_,) = solution.unobserved
        assert open_.words == 'position along (0.955, 0.296)'
    best = min(found, key=lambda s: abs(pose_error(s.pose, scene.pose)[2]))
    assert abs(pose_error(best.pose, scene.pose)[2]) < (1e-8 if noise == 0.0 else 0.05)


@pytest.mark.parametrize('name', RIGS)
def test_one_vertical_line_leaves_the_turning_about_it(name):
    scene = seen_by(name, ONE_VERTICAL_LINE)
    for solution in solve(scene.rays, scene.directions, scene.moments, scene.label):
        # A single bearing: of the three only the turning of the robot itself is fixed.
        assert len(solution.unobserved) == 2
        span = np.stack([open_.direction for open_ in solution.unobserved])
        turning = np.array([
            -(solution.pose.y + 0.5), solution.pose.x - 0.6, 1.0])
        turning /= np.linalg.norm(turning)
        assert np.linalg.norm(span @ turning) == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize('name', RIGS)
@pytest.mark.parametrize('kinds', [('vertical', 'vertical'), ('slanted',)],
                         ids=['two vertical lines', 'one slanted line'])
def test_what_only_the_distance_between_rays_could_tell_is_open(kinds, name):
    """A central camera cannot place itself by these; ours could only without any noise."""
    for seed in range(8):
        scene = random_scene(
            TABLE_ONE[name], kinds, noise=1.0, rng=np.random.default_rng(seed + 10))
        try:
            found = solve(scene.rays, scene.directions, scene.moments, scene.label)
        except EstimationError as error:
            # The fit drew the line into the mirror: refused, in words.
            assert 'the lines too few' in str(error)
            continue
        assert all(s.unobserved and s.covariance is None for s in found)


def test_nearly_concurrent_lines_give_both_poses_and_others_one():
    """A triangle of 3 mm and of 60 cm, at one pixel of noise."""
    for size, count in ((0.003, 2), (0.6, 1)):
        lines = [floor(-0.3, 0.6, 0.3), floor(-0.3, 0.6, 1.3), floor(-0.3 + size, 0.6, 2.4)]
        scene = seen_by('spherical', lines, noise=1.0, seed=3)
        found = solve(scene.rays, scene.directions, scene.moments, scene.label)
        assert len(found) == count
        assert min(np.abs(pose_error(s.pose, scene.pose)).max() for s in found) < 0.1


@pytest.mark.parametrize('seed', range(5))
def test_three_pixels_give_both_poses(seed):
    """The minimal case: three pixels of three floor lines fit exactly twice, or once."""
    rng = np.random.default_rng(seed)
    scene = random_scene(TABLE_ONE['spherical'], ('floor',) * 3, count=1, rng=rng)
    found = solve(scene.rays, scene.directions, scene.moments, scene.label)
    exact = [s for s in found if s.chi2 < 1e-6]
    assert len(exact) == 2
    assert min(np.abs(pose_error(s.pose, scene.pose)).max() for s in exact) < 1e-7


def test_directions_in_words():
    """A turning about a point, known nowhere and known weakly."""
    pose = Pose2(1.0, 2.0, 0.5)
    # The robot on a circle about (3, 1): (dx, dy) = dyaw * J (p - c) = dyaw * (-1, -2).
    turning = np.array([-1.0, -2.0, 1.0]) / math.sqrt(6.0)
    others = np.linalg.svd(turning[None])[2][1:]
    information = 1e4 * others.T @ others
    (open_,) = unobserved_directions(information, pose)
    assert np.abs(open_.direction @ turning) == pytest.approx(1.0)
    assert open_.words == 'turning about (3.000, 1.000) m'
    weak = unobserved_directions(information + 0.01 * np.outer(turning, turning), pose)
    assert [open_.words for open_ in weak] == ['turning about (3.000, 1.000) m']
    assert unobserved_directions(information + 4.0 * np.outer(turning, turning), pose) == ()
    assert len(unobserved_directions(np.zeros((3, 3)), pose)) == 3
    # Known in yaw alone, as by a compass; and in all but one.
    assert len(unobserved_directions(np.diag([0.0, 0.5, 1e6]), pose)) == 2
    assert len(unobserved_directions(np.diag([1e6, 0.5, 1e6]), pose)) == 1
    assert len(unobserved_directions(np.diag([0.9, 0.9, 1e6]), pose, limit=1.1)) == 0
