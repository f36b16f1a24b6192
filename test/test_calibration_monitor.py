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

"""The monitor of the calibration: silent under a true rig, and right about what has moved."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise, product

from calibration_reader import read_calibration
from nccs_pose.calibration.judgement import frame_residual
from nccs_pose.calibration.monitor import CalibrationMonitor, Condition, MonitorOptions
from nccs_pose.calibration.parameters import RigModel
from nccs_pose.calibration.prediction import predict_frame
from nccs_pose.calibration.pulls import pull_statistics
from nccs_pose.estimation.estimate import Doubted, Estimate, State
from nccs_pose.estimation.localiser import Localiser
from nccs_pose.files.bags import BagReader, StampedImage
from nccs_pose.geometry.pose import Pose2, rotation_exp
from nccs_pose.simulation.drive import make_drive, render_frame
from nccs_pose.simulation.motion import figure_of_eight
from nccs_pose.simulation.scene import arena_map, arena_rig, ideal_scene
from nccs_pose.simulation.table_one import TABLE_ONE
import numpy as np
import pytest
from scipy.stats import chi2, kstest

LINES = arena_map()
RIGS = {'arena': arena_rig(), **TABLE_ONE}


def drive_past(monitor, used, true, rng, frames=25, *, sigma=0.2, points=30):
    """Show frames from all over the arena, seen with one rig and posed with another, in turn."""
    for number in range(frames):
        pose = Pose2(*rng.uniform([-1.0, -0.7, -3.0], [1.0, 0.7, 3.0]))
        ideal = predict_frame(true, LINES, pose, sigma=sigma, points=points, stamp_ns=number)
        pixels = ideal.points.pixels + sigma * rng.normal(size=ideal.points.pixels.shape)
        frame = replace(ideal, points=replace(ideal.points, pixels=pixels))
        found = frame_residual(RigModel(used, LINES), frame, pose.as_array())[0]
        if np.isfinite(found).all():
            monitor.add_frame(frame, Pose2.from_array(found))
        yield number


def verdict_after(*arguments, **options):
    """The monitor's verdict at the end of such a drive."""
    for _ in drive_past(*arguments, **options):
        pass
    return arguments[0].verdict()


def moved(rig, millimetres):
    return replace(rig, cop=rig.cop + 1e-3 * np.array([0.0, *millimetres]))


def test_pulls_of_noise_are_as_large_as_their_curvatures_say():
    rng, squared, scatter, surprise = np.random.default_rng(0), [], [], []
    for _ in range(300):
        roots = rng.normal(size=(12, 4, 4)) * [1.0, 10.0, 3.0, 30.0]
        curvatures = np.swapaxes(roots, 1, 2) @ roots
        slopes = np.einsum('kij,ki->kj', roots, rng.normal(size=(12, 4)))
        found = pull_statistics(slopes, curvatures, np.full(4, 100.0))
        assert found.freedom == 4
        squared.append(found.squared)
        scatter.append(found.scatter)
        surprise.append((found.scatter - 1.0) * np.sqrt(found.degrees / 2.0))
        threefold = pull_statistics(3.0 * slopes, curvatures, np.full(4, 100.0))
        assert threefold.scatter == pytest.approx(9.0 * found.scatter)
    assert kstest(squared, chi2(4).cdf).pvalue > 0.01
    assert np.mean(scatter) == pytest.approx(1.0, abs=4.0 * np.std(scatter) / np.sqrt(300))
    assert np.var(surprise) == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / 300))


def test_pulls_that_a_step_explains_are_no_scatter():
    rng, spread = np.random.default_rng(0), np.full(3, 10.0)
    roots = rng.normal(size=(9, 5, 3))
    curvatures = np.swapaxes(roots, 1, 2) @ roots
    found = pull_statistics(curvatures @ [3.0, -2.0, 5.0], curvatures, spread)
    assert found.squared > 100.0
    assert found.scatter < 1e-20


@pytest.mark.parametrize('name', RIGS)
def test_a_drive_of_two_hundred_frames_under_a_true_rig_raises_no_alarm(name):
    monitor = CalibrationMonitor(RIGS[name], LINES)
    assert monitor.verdict().condition is Condition.UNKNOWN
    verdicts = [monitor.verdict() for _ in drive_past(
        monitor, RIGS[name], RIGS[name], np.random.default_rng(3), frames=200)]
    judged = [v for v in verdicts if v.condition is not Condition.UNKNOWN]
    assert len(judged) > 180
    assert all(v.condition is Condition.GOOD for v in judged)
    assert all(v.statistic < v.limit for v in judged)
    assert judged[-1].pose_error < 1e-3
    monitor.reset()
    assert monitor.verdict().condition is Condition.UNKNOWN


def test_noise_is_called_structure_no_more_often_than_was_asked_for():
    options = MonitorOptions(least_frames=15, false_alarm=0.2)
    rng, exceeded = np.random.default_rng(8), 0
    for number in range(40):
        rig = list(RIGS.values())[number % 4]
        monitor = CalibrationMonitor(rig, LINES, options)
        last = verdict_after(monitor, rig, rig, rng, frames=15, points=16)
        exceeded += last.statistic > last.limit
    # Of 40 drives 8 may exceed it; 16 or more would have a chance of 1 in 500.
    assert exceeded < 16


def told_shift(verdict):
    assert verdict.condition is Condition.SUSPECT
    assert 'residuals suggest the mirror moved by about ' in verdict.words
    return float(verdict.words.split('about ')[1].split(' mm')[0])


@pytest.mark.parametrize('name', RIGS)
def test_a_mirror_that_moved_is_told_with_the_size_of_the_move(name):
    told = {}
    for size, angle in product((0.1, 0.3, 0.6), (0.2, 2.3)):
        true = moved(RIGS[name], (size * np.cos(angle), size * np.sin(angle)))
        told[size, angle] = told_shift(verdict_after(
            CalibrationMonitor(RIGS[name], LINES), RIGS[name], true,
            np.random.default_rng(1), frames=15, points=16))
    # Noise allows a hundredth of a millimetre, and as much is lost in two digits.
    assert max(abs(found - size) for (size, _), found in told.items()) < 0.03
    large = [found / size for (size, _), found in told.items() if size > 0.2]
    assert np.mean(large) == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize('shift', [(0.11, 0.28), (-0.3, -0.05)])
def test_images_that_are_hardly_followed_tell_the_size_of_the_move(shift):
    scene = ideal_scene(640)
    used = scene.rig
    # An ordinary lens: an ideal one is sharper than the localiser thinks before it has tracked.
    scene = replace(scene, rig=moved(used, shift), sensor=replace(scene.sensor, psf_sigma=0.65))
    drive = make_drive(figure_of_eight(), 16, rate=16 / 30)
    localiser, tracked = Localiser(used, LINES), 0
    monitor = CalibrationMonitor(used, LINES, MonitorOptions(least_frames=10))
    for frame in range(len(drive)):
        sample = render_frame(scene, drive, frame)
        estimate = localiser.process(sample.stamp_ns, sample.image)
        tracked += estimate.state is State.TRACKING
        monitor.add(estimate)
    assert tracked < 8
    assert told_shift(monitor.verdict()) == pytest.approx(np.hypot(*shift), rel=0.15)


def test_a_doubted_pose_on_two_lines_is_not_believed():
    """Half a turn about where two lines meet, they look the same."""
    rig, monitors = RIGS['arena'], []
    frame = predict_frame(rig, LINES, Pose2(0.3, 0.2, 0.5), sigma=0.2, points=20)
    for lines, state in product((2, 3), (State.LOST, State.TRACKING)):
        points = frame.points[frame.points.label < lines]
        pose = Pose2(0.3, 0.2, 0.5)
        estimate = (Estimate(0, state, 'whole lines lie 2 px off', doubted=Doubted(pose, points))
                    if state is State.LOST else Estimate(0, state, '', pose, points=points))
        monitors.append(CalibrationMonitor(rig, LINES))
        monitors[-1].add(estimate)
    assert [monitor.verdict().frames for monitor in monitors] == [0, 1, 1, 1]


def test_a_camera_that_turned_is_told():
    rig = RIGS['arena']
    turned = replace(
        rig, R_mirror_camera=rotation_exp([np.deg2rad(0.2), 0.0, 0.0]) @ rig.R_mirror_camera)
    monitor = CalibrationMonitor(rig, LINES)
    last = verdict_after(monitor, rig, turned, np.random.default_rng(3))
    assert last.condition is Condition.SUSPECT
    assert 'the camera turned by about 0.2' in last.words
    assert last.pose_error > 0.01


def test_a_robot_that_stands_is_one_place_and_images_without_a_pose_are_counted():
    rig, rng = RIGS['arena'], np.random.default_rng(0)
    monitor = CalibrationMonitor(rig, LINES)
    pose = Pose2(0.3, 0.2, 0.5)
    for number in range(30):
        frame = predict_frame(rig, LINES, pose, sigma=0.2, points=20, stamp_ns=number)
        monitor.add_frame(frame, Pose2(*(pose.as_array() + 0.002 * rng.normal(size=3))))
    monitor.add(Estimate(31, State.LOST, 'whole lines lie 2 px off'))
    verdict = monitor.verdict()
    assert verdict.condition is Condition.UNKNOWN
    assert verdict.frames == 1
    assert '1 of 31 images gave no pose' in verdict.words


def images(sequence, step):
    """Every so many-th image of a sequence's bag."""
    with BagReader(sequence / 'bag') as bag:
        events = (e for e in bag.events(odometry=False) if isinstance(e, StampedImage))
        for number, event in enumerate(events):
            if number % step == 0:
                yield event.stamp_ns, event.decode()


def test_ray_traced_drives_are_silent_under_their_own_rig_and_not_under_another(ray_traced):
    ends = []
    for name, shift in (
            ('dev_clean', (0.0, 0.0)), ('dev_room', (0.0, 0.0)), ('dev_room', (0.11, 0.28))):
        rig, line_map = read_calibration(ray_traced / name)
        used = moved(rig, shift)
        localiser = Localiser(used, line_map)
        monitor = CalibrationMonitor(used, line_map, MonitorOptions(least_frames=10))
        verdicts = []
        for stamp, image in images(ray_traced / name, 2):
            monitor.add(localiser.process(stamp, image))
            verdicts.append(monitor.verdict())
        conditions = [v.condition for v in verdicts]
        assert (Condition.SUSPECT in conditions) == any(shift)
        # Once it is sure it stays sure.
        judged = [c for c in conditions if c is not Condition.UNKNOWN]
        assert judged
        assert sum(a is not b for a, b in pairwise(judged)) <= 1
        ends.append(verdicts[-1])
    assert 'the mirror moved by about 0.' in ends[-1].words
