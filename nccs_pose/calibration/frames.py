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

"""Which frames to calibrate from, and where to drive for the ones that are missing.

Every frame brings its own information on the rig, what is left of it once its pose is free. The
frames that together bring most, one after the other, are the diverse ones; a frame like the ones
before brings little. Poses that the robot did not visit are judged in the same way, on what the
map's lines would show there.
"""

from __future__ import annotations

from dataclasses import dataclass

from nccs_pose.calibration.adjustment import ArrowSystem, posterior
from nccs_pose.calibration.gauge import pose_uncertainty
from nccs_pose.calibration.observations import FrameObservation, Observations
from nccs_pose.calibration.parameters import RigModel, RigParameters
from nccs_pose.calibration.prediction import predict_frame
from nccs_pose.calibration.problem import Problem
from nccs_pose.geometry.pose import Array, Pose2, pose_differences
import numpy as np
from numpy.typing import NDArray

# Frames nearer than this (m, m, rad) are from one place: they share their errors.
PLACE = np.array([0.05, 0.05, 0.1])
_GRID = 5  # places each way
_HEADINGS = 6
_PREDICTED_POINTS = 16  # of each line, at a place that the robot has not visited
_SUGGESTIONS = 3


@dataclass(frozen=True, eq=False)
class FrameInformation:
    """What each of F frames tells of the rig.

    :ivar information: (F, P, P).
    :ivar pose_gain: -dpose/dtheta (F, 3, P).
    :ivar poses: T_map_base (F, 3).
    """

    information: Array
    pose_gain: Array
    poses: Array


def frame_information(
    parameters: RigParameters, frames: list[FrameObservation], poses: Array, theta: Array,
) -> FrameInformation:
    """What frames at poses (F, 3) tell of the rig at theta (P,)."""
    observations = Observations.stack(frames, parameters.rough.line_map)
    problem = Problem(parameters, observations, check=False)
    terms = problem.linearise(theta, poses)
    weight = terms.hit.astype(float)
    system = ArrowSystem.of(terms, weight, problem.slices)
    return FrameInformation(system.pulls()[1], system.reduced()[2], np.asarray(poses))


def choose(frames: FrameInformation, spread: Array, most: int) -> NDArray[np.intp]:
    """The frames that together tell most, in the order of what they add (D-optimal, greedy)."""
    scaled = frames.information * np.outer(spread, spread)
    total = np.eye(len(spread))
    left = list(range(len(scaled)))
    chosen: list[int] = []
    while left and len(chosen) < most:
        gains = np.linalg.slogdet(total + scaled[left])[1]
        best = left.pop(int(np.argmax(gains)))
        chosen.append(best)
        total = total + scaled[best]
    return np.array(chosen, dtype=np.intp)


def same_place(a: Array, b: Array) -> bool:
    """Whether two poses (3,) are of one place."""
    return bool((np.abs(pose_differences(a, b)) < PLACE).all())


def count_places(poses: Array) -> int:
    """From how many places poses (F, 3) are."""
    found: list[Array] = []
    for pose in poses:
        if not any(same_place(pose, other) for other in found):
            found.append(pose)
    return len(found)


@dataclass(frozen=True)
class Suggestion:
    """A place worth driving to.

    :ivar pose: T_map_base.
    :ivar position_error: what pose error the rig's uncertainty would mean after it, metres.
    """

    pose: Pose2
    position_error: float


class Terrain:
    """Places all over the map, and what the lines would show there."""

    def __init__(
        self, parameters: RigParameters, theta: Array, model: RigModel, sigma: float,
    ) -> None:
        points = np.concatenate([model.line_map.starts, model.line_map.ends])[:, :2]
        low, high = points.min(axis=0), points.max(axis=0)
        edge = 0.15 * (high - low)
        poses = [
            Pose2(float(x), float(y), float(yaw))
            for x in np.linspace(low[0] + edge[0], high[0] - edge[0], _GRID)
            for y in np.linspace(low[1] + edge[1], high[1] - edge[1], _GRID)
            for yaw in np.linspace(-np.pi, np.pi, _HEADINGS, endpoint=False)]
        frames = [
            predict_frame(model.rig, model.line_map, pose, sigma=sigma, points=_PREDICTED_POINTS)
            for pose in poses]
        # Only where enough can be seen for a pose.
        seen = [i for i, frame in enumerate(frames) if len(frame.lines) >= 3]
        self.poses = [poses[i] for i in seen]
        self.spread = parameters.spread
        self.frames = None if not seen else frame_information(
            parameters, [frames[i] for i in seen], np.array([p.as_array() for p in self.poses]),
            theta)

    def position_error(self, information: Array) -> tuple[float, float]:
        """Pose error that a rig known that well means, over all places: metres, radians."""
        if self.frames is None:
            return float('inf'), float('inf')
        found = pose_uncertainty(
            self.frames.pose_gain, self.frames.poses, posterior(information, self.spread))
        return found.position, found.heading

    def suggestions(self, information: Array) -> list[Suggestion]:
        """Where to drive next, the most telling place first."""
        if self.frames is None:
            return []
        found: list[Suggestion] = []
        total = information.copy()
        # A real frame shows many more points than were predicted: every place counts equally.
        for _ in range(_SUGGESTIONS):
            errors = [self.position_error(total + extra)[0] for extra in self.frames.information]
            best = int(np.argmin(errors))
            total = total + self.frames.information[best]
            found.append(Suggestion(self.poses[best], errors[best]))
        return found


def advice(suggestions: list[Suggestion]) -> str:
    """The same in a sentence."""
    if not suggestions:
        return 'no place on the map shows three lines to this rig'
    places = '; '.join(
        f'x = {s.pose.x:.1f} m, y = {s.pose.y:.1f} m, heading {np.rad2deg(s.pose.yaw):.0f}°'
        for s in suggestions)
    return f'drive next, in this order, to about: {places}'
