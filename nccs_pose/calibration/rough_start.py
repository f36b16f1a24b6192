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

"""From a rough rig to a refined one: first poses, adjustment, and the poses again.

Under a rough rig some frames begin at a wrong pose. They bend the rig a little, not beyond the
others' agreement; under the refined rig they are posed again, and so on until nothing changes. If
that ends badly, other rigs within the rough one's spread are tried as starts.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from nccs_pose.calibration.adjustment import adjust, Adjustment
from nccs_pose.calibration.first_poses import first_poses
from nccs_pose.calibration.observations import evenly, FrameObservation, Observations
from nccs_pose.calibration.parameters import RigParameters
from nccs_pose.errors import CalibrationError, GeometryError
from nccs_pose.geometry.pose import Array, pose_differences
import numpy as np
from numpy.typing import NDArray

_ROUNDS = 6
_GOOD_FRAME = 0.85  # fraction of a frame's points that must be inliers
_GOOD_SCALE = 3.0  # robust residual in units of the noise as told
_SAMPLED = 6  # frames by which starts are judged
_TRIED = 3  # starts that are tried beside the rough rig
_GOOD_FRAMES = 0.7  # fraction of frames that must agree


@dataclass(frozen=True, eq=False)
class Start:
    """A rig that explains the frames, or the best there was.

    :ivar adjustment: over the frames that are used.
    :ivar used: indices of those frames.
    :ivar agreement: fraction of all frames that the rig explains.
    """

    adjustment: Adjustment
    used: NDArray[np.intp]
    agreement: float

    @property
    def settled(self) -> bool:
        """Whether the adjustment converged and explains most frames at about the noise told."""
        return (self.adjustment.converged and self.adjustment.scale <= _GOOD_SCALE
                and self.agreement >= _GOOD_FRAMES)

    @property
    def merit(self) -> float:
        """The larger, the better."""
        return self.agreement / self.adjustment.scale


def start(
    parameters: RigParameters, frames: list[FrameObservation], poses: Array | None = None,
) -> Start:
    """Refine a rough rig from frames of known labels.

    :param poses: T_map_base of every frame (F, 3) where something knows them, NaN where not.
    :raises CalibrationError: if no frame has a pose, or nothing fits.
    """
    best, failure = None, None
    for theta in _starts(parameters, frames):
        try:
            found = _settle(parameters, frames, theta, poses)
        except (CalibrationError, GeometryError) as error:
            failure = failure or error
            continue
        if best is None or found.merit > best.merit:
            best = found
        if best.settled:
            break
    if best is None:
        raise failure or CalibrationError('no frame has a pose under the rough rig')
    return best


def _starts(parameters: RigParameters, frames: list[FrameObservation]) -> Iterator[Array]:
    """The rough rig, then the rigs in its neighbourhood under which frames look best."""
    yield np.zeros(len(parameters))
    some = [frames[i] for i in evenly(len(frames), _SAMPLED)]
    judged = []
    for theta in _neighbours(parameters):
        try:
            model = parameters.model(theta)
        except GeometryError:
            continue
        scores = first_poses(model.rig, model.line_map, some)[1]
        judged.append((float(np.median(scores)), theta))
    judged.sort(key=lambda entry: entry[0])
    for _, theta in judged[:_TRIED]:
        yield theta


def _neighbours(parameters: RigParameters) -> Iterator[Array]:
    for name in ('cop_y', 'cop_z', 'camera_x', 'camera_y'):
        for sign in (1.0, -1.0):
            theta = np.zeros(len(parameters))
            theta[parameters.index[name]] = 0.6 * sign * parameters.spread[parameters.index[name]]
            yield theta


def _settle(
    parameters: RigParameters, frames: list[FrameObservation], theta: Array,
    poses: Array | None,
) -> Start:
    """Alternate adjustment and new poses for the frames that disagree."""
    model = parameters.model(theta)
    poses = np.full((len(frames), 3), np.nan) if poses is None else poses.copy()
    lost = np.flatnonzero(np.isnan(poses[:, 0]))
    poses[lost] = first_poses(model.rig, model.line_map, [frames[i] for i in lost])[0]
    result, agreement, used = None, -1.0, np.empty(0, dtype=np.intp)
    for _ in range(_ROUNDS):
        used = np.flatnonzero(np.isfinite(poses[:, 0]))
        if len(used) == 0:
            raise CalibrationError(
                f'none of {len(frames)} frames has a pose under the rough rig: wrong map, wrong '
                'kind of mirror, or a rough rig too far off')
        observations = Observations.stack([frames[i] for i in used], parameters.rough.line_map)
        result = adjust(parameters, observations, poses[used], theta=theta)
        theta, poses[used] = result.theta, result.poses
        good = np.zeros(len(frames), dtype=bool)
        good[used] = [result.inlier[rows].mean() >= _GOOD_FRAME for rows in observations.slices()]
        bad = np.flatnonzero(~good)
        improved = good.mean() > agreement
        agreement = float(good.mean())
        if not len(bad) or not improved:
            break
        again = first_poses(
            result.model.rig, result.model.line_map, [frames[i] for i in bad])[0]
        if not _moved(poses[bad], again).any():
            break
        poses[bad] = again
    assert result is not None
    kept = np.flatnonzero(good[used])
    if 2 <= len(kept) < len(used):
        # Frames that never agreed, e.g. with a wrong label, have no say in the end.
        result = adjust(parameters, observations.chosen(kept), poses[used[kept]], theta=theta)
        used = used[kept]
    return Start(result, used, agreement)


def _moved(before: Array, after: Array) -> NDArray[np.bool_]:
    """Which poses (F, 3) changed by more than a few centimetres or degrees."""
    change = pose_differences(after, before)
    return np.asarray(~(np.abs(change) < 0.03).all(axis=1))  # a pose that is new has moved
