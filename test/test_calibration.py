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

"""Calibration: derivatives, adjustment, gauge, refusals and the monitor, on simulated pixels."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

from nccs_pose.calibration.adjustment import adjust, ArrowSystem
from nccs_pose.calibration.frames import choose, frame_information
from nccs_pose.calibration.gauge import gauges, pose_uncertainty, weak_directions
from nccs_pose.calibration.judgement import frame_residual
from nccs_pose.calibration.observations import FrameObservation, Observations
from nccs_pose.calibration.options import CalibrationOptions
from nccs_pose.calibration.parameters import left_jacobian, RigModel, RigParameters
from nccs_pose.calibration.prediction import predict_frame
from nccs_pose.calibration.problem import Problem
from nccs_pose.calibration.procedure import calibrate
from nccs_pose.calibration.sensitivity import side_sensitivity
from nccs_pose.errors import CalibrationError
from nccs_pose.estimation.residual import lines_in_base, side
from nccs_pose.evaluation.calibration_report import cell_means, report_figures, report_text
from nccs_pose.evaluation.calibration_study import (
    deviation_of,
    disturbed,
    measured_frames,
    pose_bias,
    random_rig,
    squared_errors,
)
from nccs_pose.geometry.lines import LineMap
from nccs_pose.geometry.mirror import QuadricMirror
from nccs_pose.geometry.pose import Pose2, RigidTransform, rotation_exp
from nccs_pose.simulation.scene import arena_map, arena_rig
from nccs_pose.simulation.table_one import TABLE_ONE
import numpy as np
import pytest
from scipy.stats import chi2

LINES = arena_map()
RIGS = {'arena': arena_rig(), **TABLE_ONE}
EVERYTHING = CalibrationOptions(
    mirror=True, principal_point=True, focal_length=True, tape_width=True,
    rough_cop_sideways=3e-3)


def scattered(rig, count=90, frames=3):
    """Pixels anywhere on the mirror, with arbitrary lines, sides and poses."""
    rng = np.random.default_rng(5)
    pixels = rng.uniform([350, 250], [850, 550], (count, 2))
    pixels = pixels[rig.back_project(pixels).hit]
    n = len(pixels)
    observations = Observations(
        pixels, rng.uniform(0.1, 1.0, n), rng.integers(0, 4, n),
        rng.integers(-1, 2, n).astype(np.int8), np.sort(rng.integers(0, frames, n)),
        tuple(range(frames)))
    poses = np.column_stack([rng.uniform(-1, 1, (frames, 2)), rng.uniform(-3, 3, frames)])
    return observations, poses


def bent(rig):
    """The rig with lens distortion and a tilted mounting, so that no term is zero."""
    return replace(
        rig, camera=replace(rig.camera, distortion=(-0.1, 0.02, 0.001, -0.002)),
        T_base_mirror=RigidTransform.from_rpy([3.15, -0.02, -0.7], [0.03, 0.01, 0.75]))


@pytest.mark.parametrize('name', RIGS)
def test_side_and_its_pixel_derivative_agree_with_the_estimator(name):
    rig = bent(RIGS[name])
    observations, poses = scattered(rig, frames=1)
    middle = replace(observations, side=np.zeros(len(observations), dtype=np.int8))
    own = side_sensitivity(rig, LINES, poses, middle)
    rays, pose = rig.back_project(middle.pixels), Pose2.from_array(poses[0])
    lines = LINES.directions[middle.line], LINES.moments[middle.line]
    np.testing.assert_allclose(own.side, side(rays, *lines, pose), atol=1e-13)
    d, mu = lines_in_base(*lines, pose)
    by_pixel = (np.einsum('nij,ni->nj', rays.direction_jacobian, mu)
                + np.einsum('nij,ni->nj', rays.moment_jacobian, d))
    np.testing.assert_allclose(own.pixel, by_pixel, atol=1e-13)


def test_an_edge_is_the_line_that_the_map_gives_for_it():
    rig = RIGS['arena']
    observations, poses = scattered(rig, frames=1)
    own = side_sensitivity(rig, LINES, poses, observations)
    edges = [(line.edges()[0], line, line.edges()[1]) for line in LINES]
    chosen = [edges[line][side + 1] for line, side in zip(observations.line, observations.side)]
    expected = side(
        rig.back_project(observations.pixels), np.array([e.direction for e in chosen]),
        np.array([e.moment for e in chosen]), Pose2.from_array(poses[0]))
    np.testing.assert_allclose(own.side, expected, atol=1e-13)


@pytest.mark.parametrize('name', RIGS)
def test_every_derivative_agrees_with_a_numeric_one(name):
    rig = bent(RIGS[name])
    observations, poses = scattered(rig)
    parameters = RigParameters(rig, LINES, EVERYTHING, ['south', 'east'], hold_gauge=False)
    rng = np.random.default_rng(1)
    theta = 0.2 * parameters.spread * rng.normal(size=len(parameters))

    def sensitivity(theta, poses):
        model = parameters.model(theta)
        return side_sensitivity(model.rig, model.line_map, poses, observations)

    here = sensitivity(theta, poses)
    columns = parameters.columns(
        theta, here, parameters.model(theta), observations.pixels, observations.line)
    for i, parameter in enumerate(parameters.parameters):
        step = np.zeros(len(parameters))
        step[i] = 1e-5 * parameter.spread
        after, before = sensitivity(theta + step, poses), sensitivity(theta - step, poses)
        good = after.hit & before.hit
        numeric = (after.side - before.side) / (2.0 * step[i])
        np.testing.assert_allclose(
            columns[good, i], numeric[good], atol=2e-7 * np.abs(columns[:, i]).max(),
            err_msg=parameter.name)
    for i in range(3):
        step = np.zeros_like(poses)
        step[:, i] = 1e-6
        numeric = sensitivity(theta, poses + step).side - sensitivity(theta, poses - step).side
        np.testing.assert_allclose(here.pose[:, i], numeric / 2e-6, atol=1e-8)


def test_left_jacobian_turns_a_step_of_the_vector_into_a_step_of_the_rotation():
    for vector in ([0.3, -0.2, 0.5], [1e-6, 2e-6, -1e-6], [0.0, 0.0, 0.0]):
        for axis in 1e-6 * np.eye(3):
            expected = rotation_exp(np.array(vector) + axis) @ rotation_exp(vector).T
            found = rotation_exp(left_jacobian(np.array(vector)) @ axis)
            np.testing.assert_allclose(found, expected, atol=1e-12)


def test_a_camera_pushed_sideways_sees_what_a_turned_mirror_frame_says():
    rig, push = RIGS['arena'], 4e-4
    parameters = RigParameters(rig, LINES, EVERYTHING)
    theta = np.zeros(len(parameters))
    theta[parameters.index['cop_x']] = push
    moved = parameters.model(theta).rig
    assert moved.cop[0] == 0.0
    # The camera's place and direction in base_link are what was asked for, mirror frame or not.
    place = moved.T_base_mirror.apply(moved.cop)
    wanted = rig.T_base_mirror.apply(rig.cop + push * np.eye(3)[0])
    np.testing.assert_allclose(place, wanted, atol=1e-15)
    np.testing.assert_allclose(
        moved.T_base_mirror.rotation @ moved.R_mirror_camera,
        rig.T_base_mirror.rotation @ rig.R_mirror_camera, atol=1e-15)
    axis = np.array([0.0, 0.0, 1.0])
    np.testing.assert_allclose(
        moved.T_base_mirror.rotate(axis), rig.T_base_mirror.rotate(axis), atol=1e-15)


def test_a_mirror_that_shrinks_below_its_rim_takes_the_rim_along():
    true = RIGS['arena']
    half = replace(true, mirror=replace(true.mirror, rim_radius=0.03))
    parameters = RigParameters(true, LINES, EVERYTHING)
    theta = np.zeros(len(parameters))
    theta[parameters.index['mirror_C']] = -1e-6
    smaller = parameters.model(theta, with_rim=True).rig.mirror
    assert smaller.rim_radius == np.sqrt(true.mirror.C - 1e-6) < true.mirror.rim_radius
    assert RigParameters(half, LINES, EVERYTHING).model(
        theta, with_rim=True).rig.mirror.rim_radius == 0.03
    # A drive under a mirror 2 % smaller than its rough rig says.
    rng = np.random.default_rng(3)
    small = replace(true, mirror=QuadricMirror(1.0, 0.0, 0.96 * true.mirror.C))
    frames, _ = measured_frames(small, LINES, 25, rng, points=40)
    found = calibrate(true, LINES, frames, CalibrationOptions(mirror=True))
    mirror = found.model.rig.mirror
    assert mirror.rim_radius == np.sqrt(mirror.C) < true.mirror.rim_radius
    assert 'it was cut to that' in report_text(found)


def test_schur_elimination_solves_the_same_system_as_a_dense_solver():
    rig = RIGS['hyperbolic']
    frames, poses = measured_frames(rig, LINES, 4, np.random.default_rng(0), points=20)
    parameters = RigParameters(rig, LINES)
    problem = Problem(parameters, Observations.stack(frames, LINES))
    terms = problem.linearise(np.zeros(len(parameters)), poses)
    system = ArrowSystem.of(terms, np.ones(len(problem.observations)), problem.slices)
    theta = 0.1 * parameters.spread
    step, pose_steps = system.solve(theta, parameters.spread, 0.0)
    p, f = len(parameters), len(frames)
    jacobian = np.zeros((len(terms.residual), p + 3 * f))
    jacobian[:, :p] = terms.by_rig
    for k, rows in enumerate(problem.slices):
        jacobian[rows, p + 3 * k:p + 3 * k + 3] = terms.by_pose[rows]
    prior = np.zeros((p, p + 3 * f))
    prior[:, :p] = np.diag(1.0 / parameters.spread)
    rows = np.concatenate([jacobian, prior])
    right = np.concatenate([terms.residual, theta / parameters.spread])
    scale = np.linalg.norm(rows, axis=0)
    dense = -np.linalg.lstsq(rows / scale, right, rcond=None)[0] / scale
    sigma = np.sqrt(np.diag(np.linalg.inv((rows / scale).T @ (rows / scale)))) / scale
    # The poses' vague prior is the only difference; it moves nothing by a thousandth of sigma.
    assert np.abs((step - dense[:p]) / sigma[:p]).max() < 1e-3
    assert np.abs((pose_steps.ravel() - dense[p:]) / sigma[p:]).max() < 1e-3


@pytest.mark.parametrize('name', RIGS)
def test_perfect_pixels_give_the_perfect_rig(name):
    rng, true = np.random.default_rng(2), RIGS[name]
    rough = disturbed(true, rng, height=5e-3)
    poses = [Pose2(x, y, yaw) for x, y, yaw in rng.uniform([-1, -0.7, -3], [1, 0.7, 3], (12, 3))]
    frames = [predict_frame(true, LINES, pose, sigma=1e-4, points=30) for pose in poses]
    parameters = RigParameters(rough, LINES)
    start = np.array([pose.as_array() for pose in poses]) + rng.normal(size=(12, 3)) * 0.05
    found = adjust(parameters, Observations.stack(frames, LINES), start)
    assert found.converged
    # The heading of base_link alone is the rough rig's; the prior shares it out.
    assert np.abs(found.model.rig.cop - true.cop).max() < 1e-8
    assert abs(found.model.rig.T_base_mirror.translation[2]
               - true.T_base_mirror.translation[2]) < 1e-7
    assert np.abs(found.residual * 1e-4).max() < 1e-6
    assert found.model.rig.mirror == true.mirror


def test_errors_are_as_large_as_the_standard_deviations_say():
    total, freedom = 0.0, 0
    for seed in range(12):
        rng = np.random.default_rng(seed)
        name = list(RIGS)[seed % 4]
        frames, poses = measured_frames(RIGS[name], LINES, 12, rng, points=40)
        parameters = RigParameters(disturbed(RIGS[name], rng), LINES)
        found = adjust(parameters, Observations.stack(frames, LINES), poses)
        true = deviation_of(RIGS[name], parameters)
        one, k = squared_errors(found.theta, true, found.information, parameters.spread)
        total, freedom = total + one, freedom + k
    assert freedom >= 12 * 5
    low, high = chi2.ppf([0.005, 0.995], freedom)
    assert low < total < high


def test_what_is_weakly_seen_is_off_by_no_more_than_it_says():
    """Derivatives that follow the pixels' noise would put it off by five standard deviations."""
    for seed, kind in enumerate(('hyperbolic', 'parabolic', 'hyperbolic', 'parabolic')):
        rng, true = np.random.default_rng(5 + seed), RIGS[kind]
        frames, poses = measured_frames(true, LINES, 20, rng)
        for option, name, wanted in (
                ('principal_point', 'cy', 2.0), ('focal_length', 'focal', -0.003)):
            camera = true.camera
            camera = (replace(camera, cy=camera.cy - wanted) if name == 'cy' else
                      replace(camera, fx=camera.fx / (1 + wanted), fy=camera.fy / (1 + wanted)))
            parameters = RigParameters(
                replace(disturbed(true, rng), camera=camera), LINES,
                CalibrationOptions(**{option: True}))
            found = adjust(parameters, Observations.stack(frames, LINES), poses)
            k = parameters.index[name]
            sigma = np.sqrt(found.covariance[k, k])
            assert sigma < 0.7 * parameters.spread[k]
            assert abs(found.theta[k] - wanted) < 3.0 * sigma


def test_outliers_do_not_move_the_rig():
    rng, true = np.random.default_rng(4), RIGS['arena']
    frames, poses = measured_frames(true, LINES, 15, rng, points=40)
    spoilt = []
    for frame in frames:
        pixels = frame.points.pixels.copy()
        bad = rng.random(len(pixels)) < 0.1
        pixels[bad] += rng.uniform(-30.0, 30.0, (bad.sum(), 2))
        spoilt.append(replace(frame, points=replace(frame.points, pixels=pixels)))
    parameters = RigParameters(disturbed(true, rng), LINES)
    found = adjust(parameters, Observations.stack(spoilt, LINES), poses)
    one, k = squared_errors(
        found.theta, deviation_of(true, parameters), found.information, parameters.spread)
    assert one < chi2.ppf(0.999, k)


@pytest.mark.parametrize('name', ['arena', 'parabolic'])
def test_calibration_takes_decimetres_of_bias_away(name):
    rng, true = np.random.default_rng(7), RIGS[name]
    rough = disturbed(true, rng)
    frames, _ = measured_frames(true, LINES, 25, rng)
    found = calibrate(rough, LINES, frames)
    assert found.good
    assert found.observations.frames == 20
    assert pose_bias(rough, true, LINES, rng).position > 0.03
    assert pose_bias(found.model.rig, true, LINES, rng).position < 5e-4
    # The held-out frames see noise alone, and the rough rig's error before.
    assert found.held_out.before > 3.0 * found.held_out.after
    assert found.held_out.after == pytest.approx(0.2, rel=0.1)
    text = report_text(found, ('picture.png',))
    for word in ('Verdict', 'centre of projection', 'held out', '![picture.png]'):
        assert word in text
    assert all(figure.axes for figure in report_figures(found).values())


@pytest.mark.parametrize('kind', TABLE_ONE)
def test_a_rig_known_by_its_drawing_is_found(kind):
    rng = np.random.default_rng(11)
    true = random_rig(kind, rng)
    rough = disturbed(true, rng, cop=2.5e-3, tilt=np.deg2rad(1.7), height=0.02)
    frames, _ = measured_frames(true, LINES, 14, rng, points=40)
    found = calibrate(rough, LINES, frames)
    assert found.good
    assert pose_bias(found.model.rig, true, LINES, rng).position < 2e-3


def test_a_free_line_and_the_tape_width_are_found():
    rng, true = np.random.default_rng(3), RIGS['spherical']
    frames, poses = measured_frames(true, LINES, 15, rng)
    shifted = [line if line.name != 'east' else replace(
        line, start=line.start + 0.012 * np.eye(3)[0], end=line.end + 0.02 * np.eye(3)[0])
        for line in LINES]
    told = LineMap(tuple(replace(line, width=line.width + 1.5e-3) for line in shifted))
    parameters = RigParameters(
        disturbed(true, rng), told, CalibrationOptions(tape_width=True), ['east'])
    found = adjust(parameters, Observations.stack(frames, told), poses)
    sigma = np.sqrt(np.diag(found.covariance))
    width = parameters.index['tape_width']
    assert found.theta[width] == pytest.approx(-1.5e-3, abs=4.0 * sigma[width])
    assert sigma[width] < 2e-4
    east, wanted = found.model.line_map[1], LINES[1]
    middle = 0.5 * (east.start + east.end)
    distance = (middle - wanted.start) @ np.cross([0.0, 0.0, 1.0], wanted.direction)
    assert abs(distance) < 1e-3
    assert np.cross(east.direction, wanted.direction)[2] == pytest.approx(0.0, abs=1e-3)


def weak_words(name, options):
    rng = np.random.default_rng(5)
    frames, poses = measured_frames(RIGS[name], LINES, 12, rng, points=40)
    parameters = RigParameters(RIGS[name], LINES, options, hold_gauge=False)
    found = adjust(parameters, Observations.stack(frames, LINES), poses)
    return weak_directions(found.information, parameters, found.model)


def test_the_gauges_are_found_and_named():
    sphere = weak_words('spherical', CalibrationOptions())
    about = [weak for weak in sphere if "the sphere's centre" in weak.words]
    assert len(about) == 3  # two turns, and the heading of base_link mixed with them
    assert all(weak.held and 'held by the rough rig' in weak.words for weak in about)
    assert any('roll of the rig' in weak.words for weak in about)
    parabola = weak_words('parabolic', CalibrationOptions())
    assert len(parabola) == 1
    assert parabola[0].words.startswith('heading of base_link')
    size = weak_words('hyperbolic', CalibrationOptions(mirror=True, focal_length=True))
    text = ' '.join(weak.words for weak in size)
    assert 'size of the mirror with the distance of the camera' in text
    assert 'focal length with the distance of the camera' in text
    assert 'place of the mirror along its axis' in text


def test_a_turn_about_the_centre_of_a_sphere_changes_no_picture():
    rig = RIGS['arena']
    parameters = RigParameters(rig, LINES, EVERYTHING, hold_gauge=False)
    names = dict(gauges(parameters, RigModel(rig, LINES)))
    moves = names["turn of the mirror frame about the sphere's centre"]
    points = predict_frame(rig, LINES, Pose2(0.2, -0.1, 0.7), sigma=1.0, points=9)
    world = Pose2(0.2, -0.1, 0.7).inverse().apply(np.concatenate([LINES.starts, LINES.ends]))
    before, seen = rig.project(world)
    assert len(points.points) and seen.all()
    for move, control in zip(moves.T[:2], ('cop_z', 'camera_x')):
        theta = 1e-5 * move
        after, _ = parameters.model(theta).rig.project(world)
        # A pixel or so per 1e-3 rad of the camera alone; second order of 1e-5 when all turn. A
        # turn about the third axis is left to the pose: it is taken out of the pixels' motion.
        turn = parameters.model(np.zeros_like(theta)).rig.project(
            Pose2(yaw=1e-5).apply(world))[0] - before
        motion = (after - before).ravel()
        left = motion - turn.ravel() * (motion @ turn.ravel()) / (turn.ravel() @ turn.ravel())
        alone = np.zeros_like(theta)
        alone[parameters.index[control]] = 1e-5 * 0.06
        other = parameters.model(alone).rig.project(world)[0] - before
        assert np.abs(left).max() < 0.02 * np.abs(other).max()


def test_frames_are_chosen_for_what_they_add():
    rng, rig = np.random.default_rng(8), RIGS['parabolic']
    alike = [Pose2(0.3, 0.2, 0.1 + 1e-3 * k) for k in range(6)]
    same = [predict_frame(rig, LINES, pose, sigma=0.2, points=20) for pose in alike]
    spread, poses = measured_frames(rig, LINES, 5, rng, points=20)
    parameters = RigParameters(rig, LINES)
    all_poses = np.concatenate([[pose.as_array() for pose in alike], poses])
    told = frame_information(
        parameters, same + spread, all_poses, np.zeros(len(parameters)))
    scaled = told.information * np.outer(parameters.spread, parameters.spread)

    def knowledge(rows):
        return np.linalg.slogdet(np.eye(len(parameters)) + scaled[list(rows)].sum(axis=0))[1]

    chosen = choose(told, parameters.spread, 4)
    assert len(set(chosen.tolist())) == 4
    assert sum(chosen < 6) <= 2
    # What greed over a submodular gain is sure to reach of the best choice there is.
    best = max(knowledge(rows) for rows in combinations(range(11), 4))
    assert knowledge(chosen) >= (1.0 - 1.0 / np.e) * best
    assert knowledge(chosen) > knowledge(range(4))


def noisy(rig, pose, rng, stamp=0, sigma=0.2):
    frame = predict_frame(rig, LINES, pose, sigma=sigma, points=30, stamp_ns=stamp)
    pixels = frame.points.pixels + sigma * rng.normal(size=frame.points.pixels.shape)
    return replace(frame, points=replace(frame.points, pixels=pixels))


def test_a_line_that_is_not_where_the_map_says_widens_the_deviations_or_spoils_the_verdict():
    rng, true = np.random.default_rng(3), RIGS['arena']
    frames, _ = measured_frames(true, LINES, 25, rng)
    rough = disturbed(true, rng)
    shift, found = np.array([1.0, 0.5, 0.0]), {}
    for metres in (0.0, 0.03, 0.1):
        lines = list(LINES)
        lines[1] = replace(
            lines[1], start=lines[1].start + metres * shift, end=lines[1].end + metres * shift)
        found[metres] = calibrate(rough, LineMap(tuple(lines)), frames)
    assert found[0.0].good
    assert found[0.0].adjustment.shared == 1.0
    assert 'share errors' in found[0.03].verdict
    assert found[0.03].uncertainty.position > 5.0 * found[0.0].uncertainty.position
    assert not found[0.1].good
    assert 'a line of the map' in found[0.1].verdict


def test_bad_input_is_refused_in_words():
    rng, rig = np.random.default_rng(1), RIGS['parabolic']
    frames, _ = measured_frames(rig, LINES, 12, rng, points=30)
    with pytest.raises(CalibrationError, match='in none of 0 frames two lines'):
        calibrate(rig, LINES, [])
    with pytest.raises(CalibrationError, match=r'only 3 of 3 frames .* at least 5'):
        calibrate(rig, LINES, frames[:3])
    with pytest.raises(CalibrationError, match="'attic' cannot be freed: the map has south"):
        calibrate(rig, LINES, frames, free_lines=['attic'])
    with pytest.raises(CalibrationError, match='at least two must stay'):
        calibrate(rig, LINES, frames, free_lines=['south', 'east', 'north'])
    with pytest.raises(CalibrationError, match='label 3 is no line of a map of 3'):
        Observations.stack(frames, LineMap(tuple(LINES)[:3]))


def test_frames_from_one_place_are_refused_with_where_to_drive():
    rng, rig = np.random.default_rng(1), RIGS['parabolic']
    alike = [noisy(rig, Pose2(0.9, 0.6, 0.4), rng, k, sigma=0.5) for k in range(6)]
    with pytest.raises(CalibrationError, match=r'too few or too similar.*drive next.*x = '):
        calibrate(disturbed(rig, rng), LINES, alike, CalibrationOptions(pose_error=1e-3))
    # What all of them share, no number of them shows.
    sharp = [noisy(rig, Pose2(0.9, 0.6, 0.4), rng, k, sigma=0.002) for k in range(8)]
    with pytest.raises(CalibrationError, match=r'from 1 place over .* too similar.*next.*x = '):
        calibrate(disturbed(rig, rng), LINES, sharp)


def test_a_wrong_map_and_a_wrong_mirror_are_not_fitted():
    rng, rig = np.random.default_rng(1), RIGS['hyperbolic']
    frames, _ = measured_frames(rig, LINES, 8, rng, points=20)
    longer = LineMap(tuple(
        replace(line, start=line.start * [1.0, 1.3, 1.0], end=line.end * [1.0, 0.8, 1.0])
        for line in LINES))
    with pytest.raises(CalibrationError, match='the map, the kind of mirror'):
        calibrate(rig, longer, frames)
    with pytest.raises(CalibrationError, match='the map, the kind of mirror'):
        calibrate(replace(RIGS['spherical'], mirror=QuadricMirror(1.0, 0.0, 6e-4)), LINES, frames)


def test_the_pose_error_of_an_uncertain_rig_is_that_of_sampled_rigs():
    rng, rig = np.random.default_rng(6), RIGS['arena']
    frames, poses = measured_frames(rig, LINES, 10, rng, points=40)
    parameters = RigParameters(rig, LINES)
    found = adjust(parameters, Observations.stack(frames, LINES), poses)
    sigma = np.zeros(len(parameters))
    sigma[parameters.index['cop_z']] = 2e-5
    told = pose_uncertainty(found.pose_gain, found.poses, np.diag(sigma**2))
    moved = RigModel(parameters.model(found.theta + sigma).rig, LINES)
    errors = []
    for frame, pose in zip(frames, found.poses):
        after = Pose2.from_array(frame_residual(moved, frame, pose)[0])
        errors.append((Pose2.from_array(pose).inverse() @ after).as_array())
    errors = np.array(errors)
    rest = errors - errors.mean(axis=0)
    assert told.position == pytest.approx(
        np.sqrt(np.mean(rest[:, 0] ** 2 + rest[:, 1] ** 2)), rel=0.1)
    assert told.base_position == pytest.approx(np.hypot(*errors.mean(axis=0)[:2]), rel=0.2)


def test_simulated_stations_stand_evenly_in_the_image():
    frames, _ = measured_frames(
        RIGS['hyperbolic'], LINES, 4, np.random.default_rng(0), sigma=1e-6, points=40)
    for frame in frames:
        for line, edge in set(zip(frame.points.label, frame.side)):
            own = frame.points.pixels[(frame.points.label == line) & (frame.side == edge)]
            step = np.linalg.norm(np.diff(own, axis=0), axis=1)
            # Evenly spread over the floor they would differ by a factor of up to seven.
            assert step.max() < 1.6 * step.min()


def test_cells_average_what_falls_into_them():
    rng = np.random.default_rng(0)
    at = rng.uniform(0.0, 1.0, (4000, 2))
    x, y, mean = cell_means(at, 3.0 * (at[:, 0] > 0.5), cells=4)
    assert len(x) == len(y) == 5
    np.testing.assert_allclose(mean[0], 0.0)
    np.testing.assert_allclose(mean[3], 3.0)


def test_a_thinned_frame_keeps_every_edge():
    frame = predict_frame(RIGS['arena'], LINES, Pose2(), sigma=0.2, points=60)
    thin = frame.thinned(5)
    assert set(zip(thin.points.label, thin.side)) == set(zip(frame.points.label, frame.side))
    assert len(thin.points) <= 5 * len(set(zip(thin.points.label, thin.side)))
    with pytest.raises(CalibrationError, match='do not belong together'):
        FrameObservation(0, frame.points, frame.side[:-1])
