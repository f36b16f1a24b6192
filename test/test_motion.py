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

"""Trajectories against closed forms and integration, wheel odometry against its statistics."""

from __future__ import annotations

import dataclasses
import math

from hypothesis import given
from hypothesis import strategies as st
from nccs_pose.errors import SimulationError
from nccs_pose.geometry.pose import Pose2
from nccs_pose.simulation.drive import (
    ImageSample,
    make_drive,
    measure_odometry,
    OdometrySample,
    render_frame,
    stream,
    WheelModel,
)
from nccs_pose.simulation.motion import (
    figure_of_eight,
    integrate_twist,
    Loop,
    random_loop,
    Twist,
)
from nccs_pose.simulation.scene import arena_scene
import numpy as np
import pytest
from scipy.integrate import solve_ivp

PERFECT = WheelModel(left_scale=1.0, right_scale=1.0, noise=0.0)


@dataclasses.dataclass(frozen=True)
class Arc:
    """Constant twist: a circle, a straight line, a turn on the spot, or rest."""

    start: Pose2
    velocity: Twist

    def pose(self, t: float) -> Pose2:
        return integrate_twist(self.start, self.velocity, t)

    def twist(self, t: float) -> Twist:
        return self.velocity


def period(loop: Loop) -> float:
    """Time for one round, s."""
    return loop.length / loop.speed


@given(st.floats(-1.0, 1.0), st.floats(-3.0, 3.0), st.floats(-3.0, 3.0), st.floats(-2.0, 2.0))
def test_an_arc_is_the_integral_of_the_twist(forward, turn, yaw, duration):
    def rates(_: float, state: np.ndarray) -> list[float]:
        return [forward * math.cos(state[2]), forward * math.sin(state[2]), turn]

    solution = solve_ivp(rates, (0.0, duration), [0.4, -0.3, yaw], rtol=1e-9, atol=1e-10)
    pose = integrate_twist(Pose2(0.4, -0.3, yaw), Twist(forward, turn), duration)
    x, y, angle = solution.y[:, -1]
    assert (pose.x, pose.y) == pytest.approx((x, y), abs=1e-7)
    assert math.cos(pose.yaw - angle) == pytest.approx(1.0, abs=1e-12)


def test_known_arcs():
    start = Pose2(1.0, 2.0, 0.5)
    straight = integrate_twist(start, Twist(0.5, 0.0), 2.0)
    assert straight.as_array() == pytest.approx([1 + math.cos(0.5), 2 + math.sin(0.5), 0.5])
    quarter = integrate_twist(Pose2(), Twist(math.pi / 2, math.pi / 2), 1.0)
    assert quarter.as_array() == pytest.approx([1.0, 1.0, math.pi / 2])
    back = integrate_twist(integrate_twist(start, Twist(0.3, 1.0), 1.7), Twist(0.3, 1.0), -1.7)
    assert back.as_array() == pytest.approx(start.as_array())


@pytest.mark.parametrize('loop', [
    figure_of_eight(), *(random_loop(np.random.default_rng(seed)) for seed in range(3))])
def test_a_loop_moves_as_its_twist_says_and_never_sideways(loop):
    step = 1e-5
    for t in np.linspace(0.0, 1.3 * period(loop), 60):
        before, after = loop.pose(t), loop.pose(t + step)
        moved = before.inverse() @ after
        twist = loop.twist(t + 0.5 * step)
        assert twist.forward == loop.speed
        assert moved.x / step == pytest.approx(loop.speed, abs=1e-5)
        # The chord of an arc turns half as much as its tangent.
        assert moved.y / step == pytest.approx(0.5 * loop.speed * twist.turn * step, abs=1e-6)
        assert moved.yaw / step == pytest.approx(twist.turn, abs=1e-4)


def test_a_loop_has_its_length_passes_its_waypoints_and_closes():
    angle = np.arange(64) * (2.0 * np.pi / 64)
    circle = 0.8 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    loop = Loop(circle, speed=0.4)
    assert loop.length == pytest.approx(2.0 * np.pi * 0.8, rel=1e-5)
    for k in (0, 14, 40):
        pose = loop.pose(k / 64 * period(loop))
        assert (pose.x, pose.y) == pytest.approx(tuple(circle[k]), abs=1e-6)
        assert math.cos(pose.yaw - angle[k] - np.pi / 2) == pytest.approx(1.0, abs=1e-6)
        assert loop.twist(k / 64 * period(loop)).turn == pytest.approx(0.5, abs=1e-3)
    first, again = loop.pose(0.3), loop.pose(0.3 + period(loop))
    assert again.as_array() == pytest.approx(first.as_array(), abs=1e-9)


def test_random_loops_stay_in_the_arena_and_differ():
    middles = []
    for seed in range(20):
        loop = random_loop(np.random.default_rng(seed))
        times = np.linspace(0.0, period(loop), 50)
        points = np.array([loop.pose(t).as_array()[:2] for t in times])
        assert (np.abs(points) < [1.4, 1.0]).all()
        assert max(abs(loop.twist(t).turn) for t in times) < 3.0
        middles.append(tuple(points[10]))
    assert len(set(middles)) == 20


@pytest.mark.parametrize(('waypoints', 'speed', 'words'), [
    ([[0, 0], [1, 0]], 1.0, 'N >= 3'),
    ([[0, 0], [1, 0], [1, 0], [0, 1]], 1.0, 'waypoint 1'),
    ([[0, 0], [1, 0], [0, 1]], 0.0, 'speed must be > 0'),
])
def test_a_loop_that_cannot_be_driven_is_refused(waypoints, speed, words):
    with pytest.raises(SimulationError, match=words):
        Loop(waypoints, speed)


def test_perfect_wheels_measure_the_drive():
    loop = figure_of_eight()
    start, worst = loop.pose(0.0), []
    for rate in (20.0, 40.0, 80.0):
        perfect = dataclasses.replace(PERFECT, rate=rate)
        samples = make_drive(loop, 60, wheels=perfect, start_ns=5_000_000_000).odometry
        true = [start.inverse() @ loop.pose((s.stamp_ns - 5_000_000_000) * 1e-9) for s in samples]
        errors = [s.pose.as_array() - pose.as_array() for s, pose in zip(samples, true)]
        worst.append(np.linalg.norm(errors, axis=1).max())
    # Arcs approach the track with the square of their number.
    assert worst[0] < 1e-3
    assert worst[0] / worst[1] == pytest.approx(4.0, rel=0.15)
    assert worst[1] / worst[2] == pytest.approx(4.0, rel=0.15)
    arc = Arc(Pose2(0.3, 0.1, 2.0), Twist(0.4, -0.8))
    for sample in measure_odometry(arc, 3.0, PERFECT, np.random.default_rng(0), 0):
        true = integrate_twist(Pose2(), arc.velocity, sample.stamp_ns * 1e-9)
        assert sample.pose.as_array() == pytest.approx(true.as_array(), abs=1e-9)
        assert sample.stamp_ns == 0 or sample.twist.turn == pytest.approx(-0.8)


def test_wheel_scales_show_as_length_and_as_bend():
    wheels = WheelModel(track=0.3, left_scale=1.02, right_scale=0.99, noise=0.0)
    straight = measure_odometry(
        Arc(Pose2(), Twist(0.5, 0.0)), 4.0, wheels, np.random.default_rng(0), 0)[-1]
    seconds = straight.stamp_ns * 1e-9
    assert straight.twist.forward == pytest.approx(0.5 * 1.005)
    assert straight.pose.yaw == pytest.approx(seconds * 0.5 * (0.99 - 1.02) / 0.3)
    spin = measure_odometry(
        Arc(Pose2(), Twist(0.0, 0.5)), 4.0, wheels, np.random.default_rng(0), 0)[-1]
    assert spin.twist.turn == pytest.approx(0.5 * 1.005)


def test_wheel_noise_grows_with_the_square_root_of_the_path():
    wheels = WheelModel(track=0.33, left_scale=1.0, right_scale=1.0, noise=0.005)
    arc = Arc(Pose2(), Twist(0.5, 0.0))
    runs = [measure_odometry(arc, 1.95, wheels, np.random.default_rng(seed), 0)[-1].pose
            for seed in range(400)]
    # After 2 s and 1 m: each wheel is off by 0.005 m, independently.
    x, yaw = np.array([run.x for run in runs]), np.array([run.yaw for run in runs])
    assert x.std() == pytest.approx(0.005 / math.sqrt(2.0), rel=0.15)
    assert yaw.std() == pytest.approx(0.005 * math.sqrt(2.0) / 0.33, rel=0.15)
    assert abs(yaw.mean()) < 4.0 * yaw.std() / 20.0
    at_rest = measure_odometry(
        Arc(Pose2(), Twist()), 1.0, wheels, np.random.default_rng(0), 0)[-1].pose
    assert at_rest.as_array() == pytest.approx(np.zeros(3))


def test_a_stream_is_in_order_and_every_frame_can_be_taken_again():
    scene = arena_scene(160)
    wheels = WheelModel()
    drive = make_drive(figure_of_eight(), 8, 10.0, wheels, np.random.default_rng(2))
    samples = list(stream(scene, drive, seed=5))
    stamps = [sample.stamp_ns for sample in samples]
    assert stamps == sorted(stamps)
    images = [sample for sample in samples if isinstance(sample, ImageSample)]
    reports = [sample for sample in samples if isinstance(sample, OdometrySample)]
    assert tuple(image.stamp_ns for image in images) == drive.stamps_ns
    assert np.diff(drive.stamps_ns).tolist() == [100_000_000] * 7
    assert tuple(reports) == drive.odometry
    assert reports[0].stamp_ns <= images[0].stamp_ns < images[-1].stamp_ns < reports[-1].stamp_ns
    np.testing.assert_array_equal(images[6].image, render_frame(scene, drive, 6, 5).image)
    assert (images[6].image != render_frame(scene, drive, 6, 4).image).any()
    assert images[6].pose == drive.poses[6] == figure_of_eight().pose(0.6)


def test_a_drive_without_frames_is_refused():
    with pytest.raises(SimulationError, match='0 frames'):
        make_drive(figure_of_eight(), 0)
    with pytest.raises(SimulationError, match='track must be > 0, is -1'):
        WheelModel(track=-1)
