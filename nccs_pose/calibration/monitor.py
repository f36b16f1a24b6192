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

Every tracked frame pulls at the rig: the slope of its squared residuals, with its pose left free.
Under a true rig the pulls of many frames cancel; under a rig that has moved they add up, and one
Gauss-Newton step says where to. It is reported when the pulls are too regular to be chance and
when what they ask for would move the poses by more than a tolerance.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from enum import Enum

from nccs_pose.calibration.adjustment import ArrowSystem, Problem
from nccs_pose.calibration.gauge import pose_uncertainty
from nccs_pose.calibration.observations import FrameObservation, Observations
from nccs_pose.calibration.options import CalibrationOptions
from nccs_pose.calibration.parameters import RigParameters
from nccs_pose.estimation.estimate import Estimate, State
from nccs_pose.geometry.lines import LineMap
from nccs_pose.geometry.pose import Array, Pose2
from nccs_pose.geometry.rig import Rig
from nccs_pose.options import check_options, option
import numpy as np
from scipy.stats import chi2

_CAUCHY = 2.385
_LEAST_LINES = 3


@dataclass(frozen=True)
class MonitorOptions:
    """Options of the calibration monitor.

    :raises OptionError: naming an option outside its range.
    """

    memory: int = option(
        200, low=10, high=100000, doc='Frames after which what was seen is forgotten to 1/e.')
    least_frames: int = option(
        15, low=2, high=10000, doc='Frames before anything is said.')
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
    :ivar frames: how many frames it rests on.
    :ivar statistic: regularity of the pulls, chi-squared with ``freedom`` degrees under noise.
    :ivar limit: what noise alone does not exceed.
    :ivar pose_error: by how much poses would move under the rig that the residuals ask for,
        metres.
    """

    condition: Condition
    words: str
    frames: int
    statistic: float
    limit: float
    pose_error: float


class CalibrationMonitor:
    """Accumulates pulls at the rig, frame by frame; a few milliseconds each.

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
        p = len(self._parameters)
        self._information, self._scatter = np.zeros((p, p)), np.zeros((p, p))
        self._slope, self._weight, self._frames = np.zeros(p), 0.0, 0
        self._gains: deque[tuple[Array, Array]] = deque(maxlen=50)

    def add(self, estimate: Estimate) -> None:
        """Look at one answer of the localiser; only tracked ones with three lines count."""
        if estimate.state is State.TRACKING and estimate.pose is not None and estimate.points:
            points = estimate.points[estimate.points.label >= 0]
            frame = FrameObservation(
                estimate.stamp_ns, points, np.zeros(len(points), dtype=np.int8))
            self.add_frame(frame, estimate.pose)

    def add_frame(self, frame: FrameObservation, pose: Pose2) -> None:
        """Look at measurements of one frame and the pose that they gave."""
        if len(frame.lines) < _LEAST_LINES:
            return
        observations = Observations.stack(
            [frame.thinned(self.options.points_per_line)], self._parameters.rough.line_map)
        problem = Problem(self._parameters, observations, check=False)
        terms = problem.linearise(np.zeros(len(self._parameters)), pose.as_array()[None])
        if terms.hit.sum() < 12:
            return
        scale = max(1.0, 1.4826 * float(np.median(np.abs(terms.residual[terms.hit]))))
        weight = terms.hit / (1.0 + (terms.residual / (_CAUCHY * scale)) ** 2)
        system = ArrowSystem.of(terms, weight, problem.slices)
        information, slope, gain = system.reduced()
        keep = 1.0 - 1.0 / self.options.memory
        self._information = keep * self._information + information
        self._scatter = keep * self._scatter + np.outer(slope, slope)
        self._slope = keep * self._slope + slope
        self._weight = keep * self._weight + 1.0
        self._frames += 1
        self._gains.append((gain[0], pose.as_array()))

    def verdict(self) -> Verdict:
        """What the frames so far say."""
        if self._frames < self.options.least_frames:
            return Verdict(
                Condition.UNKNOWN, f'calibration not judged yet: {self._frames} of '
                f'{self.options.least_frames} frames', self._frames, 0.0, float('inf'), 0.0)
        statistic, limit = self._regularity()
        step = self._step(np.ones(len(self._parameters), dtype=bool))
        error = self._pose_error(step)
        if statistic <= limit or error <= self.options.pose_error:
            return Verdict(
                Condition.GOOD, f'calibration good: residuals over {self._frames} frames ask for '
                f'pose changes of {1e3 * error:.1f} mm', self._frames, statistic, limit, error)
        return Verdict(
            Condition.SUSPECT, f'{self._suspicion()}; poses are off by up to about '
            f'{_significant(1e3 * error)} mm: calibrate again', self._frames, statistic, limit,
            error)

    def _regularity(self) -> tuple[float, float]:
        """The summed pull against what independent pulls of that size would sum to."""
        spread = self._parameters.spread
        scaled = self._information * np.outer(spread, spread)
        values, vectors = np.linalg.eigh(scaled)
        seen = vectors[:, values > 1.0]
        if not seen.shape[1]:
            return 0.0, float('inf')
        pull = seen.T @ (spread * self._slope)
        # Noise as told, or as large as the pulls themselves show it to be.
        told = np.diag(values[values > 1.0])
        shown = seen.T @ (self._scatter * np.outer(spread, spread)) @ seen
        mean = np.outer(pull, pull) / self._weight
        covariance = np.maximum(1.0, _ratio(shown - mean, told)) * told
        freedom = seen.shape[1]
        return (float(pull @ np.linalg.solve(covariance, pull)),
                float(chi2.isf(self.options.false_alarm, freedom)))

    def _step(self, free: Array) -> Array:
        """What change of the free numbers (P,) of the rig the pulls ask for, (P,)."""
        spread = self._parameters.spread[free]
        information = self._information[np.ix_(free, free)]
        step = np.zeros(len(self._parameters))
        scaled = information * np.outer(spread, spread) + np.eye(len(spread))
        step[free] = -spread * np.linalg.solve(scaled, spread * self._slope[free])
        return step

    def _pose_error(self, step: Array) -> float:
        gains = np.array([gain for gain, _ in self._gains])
        poses = np.array([pose for _, pose in self._gains])
        moved = pose_uncertainty(gains, poses, np.outer(step, step))
        return float(np.hypot(moved.position, moved.base_position))

    def _suspicion(self) -> str:
        """The single part whose move explains the pulls best, and by how much it moved."""
        groups = {p.group for p in self._parameters.parameters}
        best, words = -1.0, ''
        for group in sorted(groups):
            free = np.array([p.group == group for p in self._parameters.parameters])
            step = self._step(free)
            explained = -float(self._slope @ step)
            if explained > best:
                size = float(np.linalg.norm(step))
                best, words = explained, _MOVES[group](size)
        return f'residuals suggest {words}'


def _ratio(shown: Array, told: Array) -> float:
    """How much larger one covariance is than another, on average over directions."""
    return float(np.trace(np.linalg.solve(told, shown))) / len(told)


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
