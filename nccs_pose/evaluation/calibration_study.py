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

"""What the calibration reaches in simulation; its numbers stand in docs/calibration.md.

Run it with ``python -m nccs_pose.evaluation.calibration_study targets|rough|cost``.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace
import time

from nccs_pose.calibration.adjustment import adjust, ArrowSystem, posterior
from nccs_pose.calibration.judgement import frame_residual
from nccs_pose.calibration.observations import FrameObservation, Observations
from nccs_pose.calibration.options import CalibrationOptions
from nccs_pose.calibration.parameters import RigModel, RigParameters
from nccs_pose.calibration.prediction import predict_frame
from nccs_pose.calibration.problem import Problem
from nccs_pose.calibration.procedure import calibrate
from nccs_pose.errors import CalibrationError, GeometryError
from nccs_pose.geometry.lines import LineMap
from nccs_pose.geometry.mirror import QuadricMirror
from nccs_pose.geometry.pose import Array, Pose2, RigidTransform, rotation_exp
from nccs_pose.geometry.rig import Rig
from nccs_pose.simulation.scene import arena_map, arena_rig
from nccs_pose.simulation.table_one import CAMERA, look_at, TABLE_ONE
import numpy as np
from scipy.stats import chi2

Random = np.random.Generator
_X, _Y = 1.4, 0.9  # where the robot drives in the arena, metres either way: 0.4 m off the tapes
_FRAMES = 20
_DRIVE = 150  # images that calibrate looks at, of which it chooses
_POINTS = 150  # of a line: 75 on each edge of the tape
# How far off a rig drawn by ruler is: the camera's place, m, and its turn, rad.
_COP_OFF, _TURN_OFF = 3e-4, np.deg2rad(0.3)
_COARSE = 33  # steps along a line by which its length in the image is measured


def random_pose(rng: Random) -> Pose2:
    """A pose among the lines of the arena."""
    return Pose2(rng.uniform(-_X, _X), rng.uniform(-_Y, _Y), rng.uniform(-np.pi, np.pi))


def measured_frames(
    rig: Rig, line_map: LineMap, count: int, rng: Random, *, sigma: float = 0.2,
    points: int = 75,
) -> tuple[list[FrameObservation], Array]:
    """Frames of noisy points on the tapes' edges, and their true poses (F, 3).

    :param points: of each line, evenly spread in the image over what is seen of it.
    """
    frames: list[FrameObservation] = []
    poses: list[Array] = []
    while len(frames) < count:
        pose = random_pose(rng)
        ideal = predict_frame(
            rig, line_map, pose, sigma=sigma, points=points, stamp_ns=len(frames),
            along=_even_stations(rig, line_map, pose, points, rng))
        if len(ideal.lines) < 3:
            continue
        noise = sigma * rng.normal(size=ideal.points.pixels.shape)
        noisy = replace(ideal.points, pixels=ideal.points.pixels + noise)
        frames.append(replace(ideal, points=noisy))
        poses.append(pose.as_array())
    return frames, np.array(poses)


def _even_stations(
    rig: Rig, line_map: LineMap, pose: Pose2, count: int, rng: Random,
) -> Array:
    """Where along each line (L, count), 0 to 1, stations stand that are even in the image."""
    along = np.linspace(0.0, 1.0, _COARSE)
    world = (line_map.starts[:, None]
             + along[:, None] * (line_map.ends - line_map.starts)[:, None])
    pixels, seen = rig.project(pose.inverse().apply(world.reshape(-1, 3)))
    pixels, seen = pixels.reshape(*world.shape[:2], 2), seen.reshape(world.shape[:2])
    step = np.linalg.norm(np.diff(pixels, axis=1), axis=2)
    step = np.where(seen[:, 1:] & seen[:, :-1], step, 0.0)
    stations = np.zeros((len(line_map), count))
    for own, length in zip(stations, step):
        # What is hidden has no length; a tiny one keeps the curve invertible.
        arc = np.concatenate([[0.0], np.cumsum(length + 1e-9)])
        own[:] = np.interp((np.arange(count) + rng.uniform()) / count * arc[-1], arc, along)
    return stations


def _vector(rng: Random, size: int, length: float) -> Array:
    vector = rng.normal(size=size)
    return length * vector / np.linalg.norm(vector)


def off_in_each(rig: Rig, rng: Random) -> Rig:
    """The rig with each number of the camera's place and turn off, up or down."""
    signs = rng.choice([-1.0, 1.0], 5)
    return replace(
        rig, cop=rig.cop + _COP_OFF * np.array([0.0, *signs[:2]]),
        R_mirror_camera=rotation_exp(_TURN_OFF * signs[2:]) @ rig.R_mirror_camera)


def disturbed(
    rig: Rig, rng: Random, *, cop: float = _COP_OFF, tilt: float = _TURN_OFF,
    height: float = 0.0, rig_tilt: float = 0.0,
) -> Rig:
    """The rig as somebody might have drawn it, off by those lengths (m) and angles (rad)."""
    mounting = rig.T_base_mirror
    off = np.array([0.0, 0.0, height * rng.choice([-1.0, 1.0])])
    return replace(
        rig, cop=rig.cop + np.array([0.0, *_vector(rng, 2, cop)]),
        R_mirror_camera=rotation_exp(_vector(rng, 3, tilt)) @ rig.R_mirror_camera,
        T_base_mirror=RigidTransform(
            rotation_exp([*_vector(rng, 2, rig_tilt), 0.0]) @ mounting.rotation,
            mounting.translation + off))


def random_rig(kind: str, rng: Random) -> Rig:
    """A rig like the paper's of that kind, with other sizes, camera place and mounting."""
    like, scale = TABLE_ONE[kind], rng.uniform(0.85, 1.3)
    mirror = QuadricMirror(
        like.mirror.A, scale * like.mirror.B, scale**2 * like.mirror.C)
    cop = scale * like.cop + np.array([0.0, *rng.uniform(-3e-3, 3e-3, 2)])
    aim = rotation_exp(np.deg2rad(rng.uniform(-2.0, 2.0, 3)))
    mounting = RigidTransform.from_rpy(
        [np.pi + np.deg2rad(rng.uniform(-1, 1)), np.deg2rad(rng.uniform(-1, 1)),
         rng.uniform(-np.pi, np.pi)],
        [rng.uniform(-0.1, 0.1), rng.uniform(-0.1, 0.1), rng.uniform(0.6, 0.9)])
    rotation = look_at(cop, np.array([0.0, 0.0, mirror.apex_z])) @ aim
    return Rig(mirror, CAMERA, cop, rotation, mounting)


@dataclass(frozen=True)
class Bias:
    """Root mean square error of poses from noise-free frames: metres, radians."""

    position: float
    heading: float


def pose_bias(used: Rig, true: Rig, line_map: LineMap, rng: Random) -> Bias:
    """What a wrong rig does to poses of frames that no calibration has seen."""
    model, errors = RigModel(used, line_map), []
    for _ in range(_FRAMES):
        pose = random_pose(rng)
        ideal = predict_frame(true, line_map, pose, sigma=0.2)
        if len(ideal.lines) >= 3:
            found = Pose2.from_array(frame_residual(model, ideal, pose.as_array())[0])
            errors.append((pose.inverse() @ found).as_array())
    squares = np.mean(np.square(errors), axis=0)
    return Bias(float(np.sqrt(squares[0] + squares[1])), float(np.sqrt(squares[2])))


def deviation_of(true: Rig, parameters: RigParameters) -> Array:
    """Theta (P,) at which the parameters' rig is the true one (default free numbers)."""
    rough = parameters.rough.rig
    theta = np.zeros(len(parameters))
    turn = _rotation_vector(true.R_mirror_camera @ rough.R_mirror_camera.T)
    tilt = _rotation_vector(true.T_base_mirror.rotation @ rough.T_base_mirror.rotation.T)
    shift = true.T_base_mirror.translation - rough.T_base_mirror.translation
    values = dict(zip(('cop_x', 'cop_y', 'cop_z'), true.cop - rough.cop))
    values |= dict(zip(('camera_x', 'camera_y', 'camera_z'), turn))
    values |= {'height': shift[2], 'tilt_x': tilt[0], 'tilt_y': tilt[1]}
    for name, value in values.items():
        if name in parameters.index:
            theta[parameters.index[name]] = value
    return theta


def _rotation_vector(rotation: Array) -> Array:
    skew = 0.5 * np.array([
        rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0],
        rotation[1, 0] - rotation[0, 1]])
    sine = float(np.linalg.norm(skew))
    return skew * (np.arcsin(min(1.0, sine)) / sine if sine > 1e-12 else 1.0)


def squared_errors(
    theta: Array, true: Array, information: Array, spread: Array,
) -> tuple[float, int]:
    """Squared errors in standard deviations over the well seen directions, and how many."""
    scaled = information * np.outer(spread, spread)
    values, vectors = np.linalg.eigh(scaled)
    seen = values > 1e3
    along = vectors[:, seen].T @ ((theta - true) / spread)
    return float(np.sum(values[seen] * along**2)), int(seen.sum())


def cop_bound(
    true: Rig, line_map: LineMap, options: CalibrationOptions, frames: Observations, poses: Array,
) -> Array:
    """Cramer-Rao bound of the camera's place (y, z), metres, from frames at poses (F, 3)."""
    parameters = RigParameters(true, line_map, options)
    problem, theta = Problem(parameters, frames), np.zeros(len(parameters))
    problem.drop_feet(theta, poses)
    terms = problem.linearise(theta, poses)
    system = ArrowSystem.of(terms, terms.hit.astype(float), problem.slices)
    covariance = posterior(system.reduced()[0], parameters.spread)
    rows = [parameters.index['cop_y'], parameters.index['cop_z']]
    return np.asarray(np.sqrt(np.diag(covariance)[rows]))


@dataclass(frozen=True, eq=False)
class Target:
    """One rig that was known to be off, and calibrated.

    :ivar before: pose bias under the rough rig, mm.
    :ivar after: under the refined one, mm.
    :ivar cop: error of the camera's place (y, z) (2,), micrometres.
    :ivar bound: its Cramer-Rao bound (2,), micrometres.
    :ivar squared: squared errors in standard deviations, over the well seen directions.
    :ivar freedom: how many directions those are.
    :ivar seconds: processor time of the calibration.
    """

    before: float
    after: float
    cop: Array
    bound: Array
    squared: float
    freedom: int
    seconds: float


def run_target(
    true: Rig, options: CalibrationOptions, drive: int, points: int, rng: Random,
) -> Target:
    """Calibrate a rig of which each number is off by as much as a ruler is.

    :param drive: images that the frames are chosen of.
    :param points: of each line.
    """
    line_map, rough = arena_map(), off_in_each(true, rng)
    frames, poses = measured_frames(true, line_map, drive, rng, points=points)
    start = time.process_time()
    found = calibrate(rough, line_map, frames, options)
    seconds = time.process_time() - start
    rig, result, used = found.model.rig, found.adjustment, found.observations
    before = 1e3 * pose_bias(rough, true, line_map, rng).position
    after = 1e3 * pose_bias(rig, true, line_map, rng).position
    bound = cop_bound(true, line_map, options, used, poses[list(used.stamps_ns)])
    squared, freedom = squared_errors(
        result.theta, deviation_of(true, found.parameters), result.information,
        found.parameters.spread)
    return Target(before, after, 1e6 * (rig.cop[1:] - true.cop[1:]), 1e6 * bound, squared,
                  freedom, seconds)


def targets(
    kinds: Sequence[str], rigs: int, first: int, mounting: bool, drive: int, points: int,
) -> None:
    """20 frames x 4 lines at 0.2 px, each number 0.3 mm or 0.3 degrees off at first.

    :param mounting: whether height and tilt are free as well as the camera against the mirror.
    :param drive: images of which the 20 are chosen, every fifth of them held out.
    :param points: of each line.
    """
    options = CalibrationOptions(height=mounting, tilt=mounting, max_frames=_FRAMES)
    for kind in kinds:
        true = arena_rig() if kind == 'arena' else TABLE_ONE[kind]
        found = [
            run_target(true, options, drive, points, np.random.default_rng(seed))
            for seed in range(first, first + rigs)]
        print(f'{kind}: {_told(found)}', flush=True)


def _told(found: Sequence[Target]) -> str:
    """What the targets of one kind of rig come to."""
    before, after = np.array([t.before for t in found]), np.array([t.after for t in found])
    seconds = [t.seconds for t in found]
    total, freedom = sum(t.squared for t in found), sum(t.freedom for t in found)
    low, high = chi2.ppf([0.025, 0.975], freedom) / freedom
    far, small = before > 100.0, after < 0.5
    rms = np.sqrt(np.mean(np.square([t.cop for t in found]), axis=0))
    least = np.sqrt(np.mean(np.square([t.bound for t in found]), axis=0))
    return (
        f'{len(found)} rigs; pose bias, median (worst) {np.median(before):.0f} '
        f'({before.max():.0f}) -> {np.median(after):.3f} ({after.max():.3f}) mm, below 0.5 mm '
        f'{small.sum()} of {len(found)}; of the {far.sum()} that begin above 100 mm the worst '
        f'ends at {after[far].max(initial=0.0):.3f} mm; COP rms {rms[0]:.1f} and {rms[1]:.1f} um, '
        f'Cramer-Rao bound {least[0]:.1f} and {least[1]:.1f} um; chi2 per degree '
        f'{total / freedom:.3f} of {freedom} (95 % band {low:.3f} to {high:.3f}); '
        f'CPU {np.median(seconds):.2f} s, worst {max(seconds):.2f} s')


def rough_starts(kinds: Sequence[str], rigs: int, first: int) -> None:
    """COP within 3 mm, tilt within 2 degrees, height within 2 cm, other rigs every time."""
    line_map = arena_map()
    for kind in kinds:
        good, said, wrong, seconds = 0, 0, 0, []
        for seed in range(first, first + rigs):
            rng = np.random.default_rng(1000 + seed)
            true = random_rig(kind, rng)
            try:
                rough = disturbed(
                    true, rng, cop=3e-3 * np.sqrt(rng.uniform()),
                    tilt=np.deg2rad(2.0) * rng.uniform() ** (1 / 3), height=0.02 * rng.uniform(),
                    rig_tilt=np.deg2rad(0.15) * rng.uniform())
                frames, _ = measured_frames(true, line_map, 25, rng)
            except GeometryError:
                continue
            start = time.process_time()
            try:
                found = calibrate(rough, line_map, frames)
            except CalibrationError as error:
                said += 1
                print(f'  {kind} {seed}: {error}')
                continue
            seconds.append(time.process_time() - start)
            bias = pose_bias(found.model.rig, true, line_map, rng)
            if bias.position < 5e-3:
                good += 1
            elif not found.good:
                said += 1
            else:
                wrong += 1
                print(f'  {kind} {seed}: wrong, {bias}, {found.verdict}')
        print(f'{kind}: {good} of {good + said + wrong} found, {said} refused in words, '
              f'{wrong} wrong and not noticed; CPU {np.median(seconds):.1f} s, worst '
              f'{max(seconds):.1f} s', flush=True)


def cost() -> None:
    """CPU time of the adjustment alone."""
    line_map, true = arena_map(), arena_rig()
    for count in (20, 80, 320):
        rng = np.random.default_rng(0)
        frames, poses = measured_frames(true, line_map, count, rng)
        parameters = RigParameters(disturbed(true, rng), line_map)
        observations = Observations.stack(frames, line_map)
        start = time.process_time()
        result = adjust(parameters, observations, poses)
        seconds = time.process_time() - start
        print(f'{count} frames, {len(observations)} points: {seconds:.2f} s, '
              f'{result.iterations} steps, {1e3 * seconds / result.iterations / count:.3f} ms '
              'per step and frame')


def main() -> None:
    """Run one study."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('study', choices=('targets', 'rough', 'cost'))
    parser.add_argument('--rigs', type=int, default=50)
    parser.add_argument(
        '--hold-mounting', action='store_true', help='hold height and tilt, of targets')
    parser.add_argument('--first', type=int, default=0, help='first seed')
    parser.add_argument('--kind', action='append', help='arena, or a rig of Table I; repeatable')
    parser.add_argument(
        '--drive', type=int, default=_DRIVE, help='images to choose the frames of, of targets')
    parser.add_argument(
        '--points', type=int, default=_POINTS, help='of each line, of targets')
    arguments = parser.parse_args()
    if arguments.study == 'targets':
        targets(arguments.kind or ['arena', *TABLE_ONE], arguments.rigs,
                arguments.first, not arguments.hold_mounting, arguments.drive, arguments.points)
    elif arguments.study == 'rough':
        rough_starts(arguments.kind or list(TABLE_ONE), arguments.rigs, arguments.first)
    else:
        cost()


if __name__ == '__main__':
    main()
