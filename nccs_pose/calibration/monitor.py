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

"""Is the calibration still good? Watched while driving, from what the localiser measures anyway.

Every tracked frame pulls at the rig: the slope g of its squared residuals, with its pose left
free, and their curvature I. Under a true rig the pulls of many places cancel; under a rig that has
moved they add up, and one Gauss-Newton step d = -(sum I)^-1 sum g says where to. It is reported
when the sum is too large for chance and when the step would move the poses by more than a
tolerance. Chance is as large as the noise that the image shows, or as what the step leaves of the
pulls, g + I d, shows it to be. Frames from one place share their errors, so a place counts once,
however long the robot stands there.

Feed it every answer of the localiser, whatever its state, and ask when the diagnostics are due::

    monitor = CalibrationMonitor(rig, line_map)  # those of the localiser
    monitor.add(localiser.process(stamp_ns, image))  # in the order of the images
    verdict = monitor.verdict()
    if verdict.condition is Condition.SUSPECT:
        warn(verdict.words)  # 'residuals suggest the mirror moved by about 0.3 mm ...'

:meth:`CalibrationMonitor.add` takes a millisecond or two, :meth:`CalibrationMonitor.verdict`
about one, or fifty when it suspects; :meth:`CalibrationMonitor.reset` when the rig or the map is
another.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from enum import Enum

from nccs_pose.calibration.adjustment import ArrowSystem, rig_step
from nccs_pose.calibration.frames import same_place
from nccs_pose.calibration.gauge import pose_uncertainty
from nccs_pose.calibration.observations import (
    evenly,
    FrameObservation,
    LEAST_LINES,
    Observations,
    observed,
)
from nccs_pose.calibration.options import CalibrationOptions
from nccs_pose.calibration.parameters import RigParameters
from nccs_pose.calibration.problem import Problem
from nccs_pose.calibration.pulls import pull_statistics
from nccs_pose.errors import GeometryError
from nccs_pose.estimation.estimate import Estimate
from nccs_pose.estimation.robust import robust_scale
from nccs_pose.geometry.lines import LineMap
from nccs_pose.geometry.pose import Array, Pose2
from nccs_pose.geometry.rig import Rig
from nccs_pose.options import check_options, option
import numpy as np
from scipy.stats import f as fisher

_GATE = 4.0  # robust standard deviations of a frame
_LEAST_POINTS = 12  # fewer tell a frame's outliers from its noise by chance only
# By so many places, and points of each line, the parts that may have moved are told apart.
_WITNESSES, _WITNESS_POINTS = 16, 20
_STEPS = 3
_HELD = 1e-12  # spread of what is held, in any unit


@dataclass(frozen=True)
class MonitorOptions:
    """Options of the calibration monitor.

    :raises OptionError: naming an option outside its range.
    """

    memory: int = option(
        200, low=10, high=100000, doc='Places after which the first one is forgotten.')
    least_frames: int = option(
        15, low=5, high=10000, doc='Places from which frames must have come before anything is '
        'said.')
    false_alarm: float = option(
        1e-4, low=1e-12, high=0.5, doc='Probability that noise alone is called structure.')
    pose_error: float = option(
        5e-3, unit='m', low=1e-5, high=1.0, doc='Smallest pose error that is worth a warning.')
    points_per_line: int = option(
        40, low=3, high=1000, doc='Points of a line that are looked at in a frame.')

    def __post_init__(self) -> None:
        check_options(self)


class Condition(Enum):
    """What the residuals say of the rig."""

    UNKNOWN = 'unknown'
    """Too few frames, or too alike."""
    GOOD = 'good'
    """The residuals are noise, or their structure moves no pose noticeably."""
    SUSPECT = 'suspect'
    """The rig has moved, or never was as its file says."""


@dataclass(frozen=True)
class Verdict:
    """What the monitor says.

    :ivar condition: good, suspect or unknown.
    :ivar words: a sentence for diagnostics.
    :ivar frames: from how many places frames have come that it rests on.
    :ivar statistic: the squared sum of the pulls in units of chance.
    :ivar limit: what chance does not exceed, but for ``false_alarm``.
    :ivar pose_error: by how much poses would move under the rig that the residuals ask for,
        metres.
    """

    condition: Condition
    words: str
    frames: int
    statistic: float
    limit: float
    pose_error: float


@dataclass(eq=False)
class _Place:
    """The mean of what frames from one place say.

    :ivar frame: the first of them, what is no outlier, thinned.
    :ivar pose: its pose (3,).
    :ivar information: I (P, P).
    :ivar slope: g (P,).
    :ivar gain: -dpose/dtheta (3, P).
    :ivar frames: how many.
    """

    frame: FrameObservation
    pose: Array
    information: Array
    slope: Array
    gain: Array
    frames: int = 1

    def average(self, information: Array, slope: Array, gain: Array) -> None:
        """Take one more frame into the mean."""
        self.frames += 1
        self.information += (information - self.information) / self.frames
        self.slope += (slope - self.slope) / self.frames
        self.gain += (gain - self.gain) / self.frames


class CalibrationMonitor:
    """Accumulates pulls at the rig, frame by frame.

    :param rig: the rig that the localiser uses.
    :param line_map: the map that it uses.
    """

    def __init__(
        self, rig: Rig, line_map: LineMap, options: MonitorOptions | None = None,
    ) -> None:
        self.options = options or MonitorOptions()
        # Nothing is known of how a rig moves: every number may, within its rough spread.
        self._parameters = RigParameters(
            rig, line_map, CalibrationOptions(rough_cop_sideways=3e-3))
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self._places: deque[_Place] = deque(maxlen=self.options.memory)
        self._asked = self._mute = 0

    def add(self, estimate: Estimate) -> None:
        """Look at one answer of the localiser: a pose on two lines, or a doubted one on three."""
        found = observed(estimate, doubted=True)
        if found is None or len(found[0].lines) < LEAST_LINES:
            self._asked, self._mute = self._asked + 1, self._mute + 1
        else:
            self.add_frame(*found)

    def add_frame(self, frame: FrameObservation, pose: Pose2) -> None:
        """Look at measurements of one frame and the pose that they gave."""
        self._asked += 1
        if len(frame.lines) < LEAST_LINES:
            return
        frame = frame.thinned(self.options.points_per_line)
        observations = Observations.stack([frame], self._parameters.rough.line_map)
        problem = Problem(self._parameters, observations, check=False)
        here, as_told = pose.as_array(), np.zeros(len(self._parameters))
        problem.drop_feet(as_told, here[None])
        terms = problem.linearise(as_told, here[None])
        if terms.hit.sum() < _LEAST_POINTS:
            return
        scale = robust_scale(terms.residual[terms.hit])
        # Least squares over what is no outlier: a weight that falls with the residual would make
        # the step that the pulls ask for too short.
        inlier = terms.hit & (np.abs(terms.residual) <= _GATE * scale)
        system = ArrowSystem.of(terms, inlier.astype(float), problem.slices)
        information, slope, gain = system.reduced()
        if self._places and same_place(here, self._places[-1].pose):
            self._places[-1].average(information, slope, gain[0])
        else:
            witness = FrameObservation(
                frame.stamp_ns, frame.points[inlier], frame.side[inlier]).thinned(_WITNESS_POINTS)
            self._places.append(_Place(witness, here, information, slope, gain[0]))

    def verdict(self) -> Verdict:
        """What the frames so far say."""
        places = len(self._places)
        if places < self.options.least_frames:
            return Verdict(
                Condition.UNKNOWN, f'calibration not judged yet: frames from {places} of '
                f'{self.options.least_frames} places; {self._mute} of {self._asked} images gave '
                'no pose to judge it by', places, 0.0, float('inf'), 0.0)
        slopes = np.array([place.slope for place in self._places])
        curvatures = np.array([place.information for place in self._places])
        statistic, limit = self._regularity(slopes, curvatures)
        pull, information = slopes.sum(axis=0), curvatures.sum(axis=0)
        spread = self._parameters.spread
        step = rig_step(information, pull, np.zeros(len(spread)), spread)
        error = self._pose_error(step)
        if statistic <= limit:
            words = f'calibration good: residuals from {places} places are noise'
        elif error <= self.options.pose_error:
            words = (f'calibration good: residuals from {places} places ask for pose changes of '
                     f'{1e3 * error:.1f} mm')
        else:
            return Verdict(
                Condition.SUSPECT, f'{self._suspicion()}; poses are off by up to '
                f'about {_significant(1e3 * error)} mm: calibrate again', places, statistic,
                limit, error)
        return Verdict(Condition.GOOD, words, places, statistic, limit, error)

    def _regularity(self, slopes: Array, curvatures: Array) -> tuple[float, float]:
        """The summed pull against chance, for slopes (K, P) and curvatures (K, P, P)."""
        found = pull_statistics(slopes, curvatures, self._parameters.spread)
        if not found.freedom:
            return 0.0, float('inf')
        # One degree of freedom a place for the size of chance, however many parts each has.
        limit = found.freedom * float(
            fisher.isf(self.options.false_alarm, found.freedom, len(slopes) - 1))
        return found.squared / max(1.0, found.scatter), limit

    def _pose_error(self, step: Array) -> float:
        gains = np.array([place.gain for place in self._places])
        poses = np.array([place.pose for place in self._places])
        moved = pose_uncertainty(gains, poses, np.outer(step, step))
        return float(np.hypot(moved.position, moved.base_position))

    def _suspicion(self) -> str:
        """The single part whose move explains the residuals best, and by how much it moved.

        Poses give way to a move, and far enough to bend what is straight for the pulls: here each
        part is solved for together with the poses.
        """
        places = list(self._places)
        rows = evenly(len(places), _WITNESSES)
        observations = Observations.stack(
            [places[k].frame for k in rows], self._parameters.rough.line_map)
        problem = Problem(self._parameters, observations, check=False)
        poses = np.array([places[k].pose for k in rows])
        least, words = np.inf, ''
        for group in dict.fromkeys(p.group for p in self._parameters.parameters):
            free = np.array([p.group == group for p in self._parameters.parameters])
            try:
                move, left = self._move(problem, poses, free)
            except GeometryError:
                continue  # a camera inside the mirror: what moved is something else
            if left < least:
                least, words = left, _MOVES[group](float(np.linalg.norm(move)))
        return f'residuals suggest {words}'

    def _move(self, problem: Problem, poses: Array, free: Array) -> tuple[Array, float]:
        """How far (P,) some numbers moved if nothing else did, and the squares that are left."""
        spread = np.where(free, self._parameters.spread, _HELD)
        theta = np.zeros(len(spread))
        terms = problem.linearise(theta, poses)
        for _ in range(_STEPS):
            system = ArrowSystem.of(terms, terms.hit.astype(float), problem.slices)
            step, pose_step = system.solve(theta, spread, 0.0)
            theta, poses = theta + step, poses + pose_step
            terms = problem.linearise(theta, poses)
        return theta, float(np.sum(terms.residual**2))


def _significant(value: float) -> str:
    return f'{value:.2g}' if value < 100.0 else f'{value:.0f}'


_MOVES = {
    'centre of projection': lambda d: f'the mirror moved by about {_significant(1e3 * d)} mm '
                                      'against the camera',
    'camera against mirror': lambda d: f'the camera turned by about '
                                       f'{_significant(float(np.rad2deg(d)))}° against the mirror',
    'height': lambda d: f"the mirror's height is off by about {_significant(1e3 * d)} mm",
    'tilt of the rig': lambda d: f'the whole rig tilts by about '
                                 f'{_significant(float(np.rad2deg(d)))}° more than told',
}
