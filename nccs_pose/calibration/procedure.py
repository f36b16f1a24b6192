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

"""The whole calibration: from labelled measurements of a drive to a rig and a verdict on it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from nccs_pose.calibration.adjustment import adjust, Adjustment, ArrowSystem
from nccs_pose.calibration.first_poses import first_poses
from nccs_pose.calibration.frames import advice, choose, count_places, frame_information, Terrain
from nccs_pose.calibration.gauge import (
    pose_uncertainty,
    PoseUncertainty,
    weak_directions,
    WeakDirection,
)
from nccs_pose.calibration.judgement import judge, Judgement
from nccs_pose.calibration.observations import (
    evenly,
    FrameObservation,
    LEAST_LINES,
    Observations,
)
from nccs_pose.calibration.options import CalibrationOptions
from nccs_pose.calibration.parameters import RigModel, RigParameters
from nccs_pose.calibration.problem import Problem
from nccs_pose.calibration.rough_start import Start, start
from nccs_pose.errors import CalibrationError
from nccs_pose.geometry.lines import LineMap
from nccs_pose.geometry.pose import Array
from nccs_pose.geometry.rig import Rig
import numpy as np
from numpy.typing import NDArray

_START_FRAMES = 12
_MOST_SCALE = 2.0  # residuals over the noise that was measured
_NO_WORSE = 1.5  # held-out residuals over those of the fit


@dataclass(frozen=True, eq=False)
class Calibration:
    """A refined rig, what it rests on, and what it is worth.

    :ivar parameters: what was free, around the rough rig.
    :ivar adjustment: the result.
    :ivar observations: what entered the fit.
    :ivar weak: what the lines do not tell.
    :ivar seen_covariance: of theta where the rough values hold nothing: without the directions
        that are held (P, P).
    :ivar uncertainty: what the remaining uncertainty means for the poses of the drive.
    :ivar fit: residuals of the fitted frames, each posed by itself, before and after.
    :ivar held_out: the same for frames that did not enter the fit.
    :ivar verdict: whether the rig is to be used, in words.
    :ivar good: whether it is.
    """

    parameters: RigParameters
    adjustment: Adjustment
    observations: Observations
    weak: tuple[WeakDirection, ...]
    seen_covariance: Array
    uncertainty: PoseUncertainty
    fit: Judgement
    held_out: Judgement
    verdict: str
    good: bool

    @property
    def model(self) -> RigModel:
        """The refined rig and map."""
        return self.adjustment.model


def calibrate(
    rig: Rig, line_map: LineMap, frames: Sequence[FrameObservation],
    options: CalibrationOptions | None = None, free_lines: Sequence[str] = (),
    poses: Array | None = None,
) -> Calibration:
    """Refine a rough rig from what a drive shows.

    :param poses: T_map_base of the frames (F, 3) under the rough rig, NaN where unknown; None:
        they are found from the measurements alone.
    :raises CalibrationError: with a sentence that says what is missing and what to drive next.
    """
    options = options or CalibrationOptions()
    parameters = RigParameters(rig, line_map, options, free_lines)
    usable = [i for i, frame in enumerate(frames) if len(frame.lines) >= LEAST_LINES]
    _demand_frames(len(usable), len(frames), options.min_frames)
    thin = [frames[i].thinned(options.points_per_edge) for i in usable]
    given = None if poses is None else np.asarray(poses, dtype=float)[usable]

    first = _start(parameters, thin, given)
    theta = first.adjustment.theta
    all_poses, agree = _pose_all(thin, first)
    judges = np.zeros(len(thin), dtype=bool)
    judges[options.held_out - 1::options.held_out] = True
    pool = np.flatnonzero(agree & ~judges)
    _demand_frames(len(pool), len(frames), options.min_frames)
    told = frame_information(parameters, [thin[i] for i in pool], all_poses[pool], theta)
    chosen = np.sort(pool[choose(told, parameters.spread, options.max_frames)])
    observations = Observations.stack([thin[i] for i in chosen], line_map)
    result = adjust(parameters, observations, all_poses[chosen], theta=theta)
    _demand_knowledge(parameters, result, observations, options)

    held = np.flatnonzero(judges)
    model, rough = result.model, parameters.rough
    fit = judge(rough, model, [thin[i] for i in chosen], result.poses)
    held_out = judge(rough, model, [thin[i] for i in held], all_poses[held])
    uncertainty = pose_uncertainty(result.pose_gain, result.poses, result.covariance)
    good, verdict = _verdict(first, result, uncertainty, fit, held_out, options)
    return Calibration(
        parameters, result, observations, _weak(parameters, model, observations, result, options),
        seen_covariance(result.information, parameters.spread),
        uncertainty, fit, held_out, verdict, good)


def converge(
    parameters: RigParameters, frames: Sequence[FrameObservation], poses: Array,
    options: CalibrationOptions,
) -> Array:
    """Theta (P,) that explains frames with known poses (F, 3) at all; no verdict on it yet.

    :raises CalibrationError: if nothing explains them.
    """
    usable = [i for i, frame in enumerate(frames) if len(frame.lines) >= LEAST_LINES]
    _demand_frames(len(usable), len(frames), 1)
    thin = [frames[i].thinned(options.points_per_edge) for i in usable]
    return _start(parameters, thin, np.asarray(poses, dtype=float)[usable]).adjustment.theta


def seen_covariance(information: Array, spread: Array) -> Array:
    """Covariance (P, P) of theta if the directions that are held by the rough rig were exact."""
    scaled = information * np.outer(spread, spread)
    values, vectors = np.linalg.eigh(0.5 * (scaled + scaled.T))
    inverse = np.where(values >= 1.0, 1.0 / (1.0 + np.maximum(values, 0.0)), 0.0)
    return (vectors * inverse) @ vectors.T * np.outer(spread, spread)


def _weak(
    parameters: RigParameters, model: RigModel, observations: Observations, result: Adjustment,
    options: CalibrationOptions,
) -> tuple[WeakDirection, ...]:
    """What the lines do not tell, of everything that could have been free around the result."""
    names = [parameters.rough.line_map[i].name for i in parameters.lines]
    all_of_it = RigParameters(model.rig, model.line_map, options, names, hold_gauge=False)
    terms = Problem(all_of_it, observations).linearise(np.zeros(len(all_of_it)), result.poses)
    system = ArrowSystem.of(terms, result.inlier.astype(float), observations.slices())
    information = system.reduced()[0] / max(1.0, result.reduced_chi2, result.shared)
    return weak_directions(information, all_of_it, model)


def _start(
    parameters: RigParameters, frames: list[FrameObservation], poses: Array | None,
) -> Start:
    """Refine from some frames, enough to pose the others."""
    if poses is not None:
        known = np.flatnonzero(np.isfinite(poses[:, 0]))
        if len(known) < _START_FRAMES // 2:
            poses = None
    if poses is None:
        found = start(parameters, [frames[i] for i in evenly(len(frames), _START_FRAMES)])
    else:
        rows = known[evenly(len(known), 2 * _START_FRAMES)]
        found = start(parameters, [frames[i] for i in rows], poses[rows])
        if not found.settled:
            return _start(parameters, frames, None)
    if not found.settled:
        scale = found.adjustment.scale
        raise CalibrationError(
            f'the rig did not converge: at best {100.0 * found.agreement:.0f} % of the frames '
            f'agree, with residuals of {scale:.1f} times their noise; the map, the kind of '
            'mirror or the labels of the lines are wrong, or the rough rig is off by more than '
            'its stated spread')
    return found


def _pose_all(
    frames: list[FrameObservation], first: Start,
) -> tuple[Array, NDArray[np.bool_]]:
    """Pose every frame under the first refined rig.

    :returns: poses (F, 3), and which frames agree with the rig (F,).
    """
    model = first.adjustment.model
    poses, _ = first_poses(model.rig, model.line_map, frames, rough=False)
    judged = judge(model, model, frames, poses)
    limit = 3.0 * max(1.0, first.adjustment.scale)
    return judged.poses, judged.after_whitened <= limit


def _demand_frames(usable: int, frames: int, least: int) -> None:
    if usable == 0:
        raise CalibrationError(
            f'in none of {frames} frames two lines of the map were seen: is it the right map, '
            'and are the lines of its colour?')
    if usable < least:
        raise CalibrationError(
            f'only {usable} of {frames} frames show two lines or more and can be used; at least '
            f'{least} are needed: drive through the middle of the lines and turn on '
            'the spot at several places')


def _demand_knowledge(
    parameters: RigParameters, result: Adjustment, observations: Observations,
    options: CalibrationOptions,
) -> None:
    """Refuse frames that leave the rig unknown, with what to drive next."""
    terrain = Terrain(
        parameters, result.theta, result.model, float(np.median(observations.sigma)))
    error, _ = terrain.position_error(result.information)
    places = count_places(result.poses)
    if error <= options.pose_error and places >= options.min_frames:
        return
    span = np.ptp(result.poses[:, :2], axis=0)
    lacking = (
        f'at least {options.min_frames} places are needed' if places < options.min_frames else
        f'elsewhere on the map the pose could be off by {1e3 * error:.0f} mm (allowed: '
        f'{1e3 * options.pose_error:.0f} mm)')
    raise CalibrationError(
        f'{observations.frames} frames from {places} {"place" if places == 1 else "places"} over '
        f'{span[0]:.1f} m x {span[1]:.1f} m are too few or too similar: {lacking}; '
        f'{advice(terrain.suggestions(result.information))}')


def _verdict(
    first: Start, result: Adjustment, uncertainty: PoseUncertainty, fit: Judgement,
    held_out: Judgement, options: CalibrationOptions,
) -> tuple[bool, str]:
    """Whether the rig is to be used, and why."""
    if not result.converged:
        return False, 'not to be used: the adjustment did not converge'
    if held_out.frames and held_out.after > _NO_WORSE * max(fit.after, 1e-3):
        return False, (
            f'not to be used: frames held out from the fit have residuals of '
            f'{held_out.after:.3f} px, the fitted ones {fit.after:.3f} px')
    if result.scale > _MOST_SCALE:
        return False, (
            f'not to be used: the residuals are {result.scale:.1f} times the noise that was '
            "measured; a line of the map, the mirror's shape or the intrinsics are not as told")
    if uncertainty.position > options.pose_error:
        return False, (
            f'not to be used: the pose may still be off by {1e3 * uncertainty.position:.1f} mm '
            f'(allowed: {1e3 * options.pose_error:.1f} mm)')
    noise = f'{result.scale:.2f} times the noise that was measured'
    words = (
        f'to be used: residuals went from {held_out.before:.3f} px to {held_out.after:.3f} px '
        f'on {held_out.frames} frames held out from the fit ({noise}); '
        f'{100.0 * first.agreement:.0f} % of the first frames agreed')
    if result.shared > 1.0:
        words += (
            f'; the points of a frame share errors, which make the standard deviations '
            f'{np.sqrt(result.shared):.1f} times as large')
    return True, words
