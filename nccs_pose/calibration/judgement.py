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

"""Residuals of frames that are posed one by one, under the rough rig and under the refined one."""

from __future__ import annotations

from dataclasses import dataclass

from nccs_pose.calibration.observations import FrameObservation
from nccs_pose.calibration.parameters import RigModel
from nccs_pose.calibration.sensitivity import EdgeLines
from nccs_pose.errors import EstimationError
from nccs_pose.estimation.refine import refine
from nccs_pose.geometry.pose import Array, Pose2
from nccs_pose.vision.median import SIGMA_PER_MEDIAN
import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Judgement:
    """Residuals of F frames, N points in all.

    :ivar pixels: the points (N, 2).
    :ivar line: the lines of the map that they are on (N,).
    :ivar residual_before: distance to the line under the rough rig (N,), px; NaN where the ray
        misses or no pose fits.
    :ivar residual_after: under the refined rig (N,), px.
    :ivar poses: under the refined rig (F, 3).
    :ivar after_whitened: robust residual of each frame in units of its noise (F,).
    """

    pixels: Array
    line: NDArray[np.intp]
    residual_before: Array
    residual_after: Array
    poses: Array
    after_whitened: Array

    @property
    def frames(self) -> int:
        """How many frames."""
        return len(self.poses)

    @property
    def before(self) -> float:
        """Robust standard deviation under the rough rig, px."""
        return robust_deviation(self.residual_before)

    @property
    def after(self) -> float:
        """Robust standard deviation under the refined rig, px."""
        return robust_deviation(self.residual_after)


def robust_deviation(residual: Array) -> float:
    """Standard deviation about zero of what is finite, by its median; NaN of nothing."""
    finite = np.abs(residual[np.isfinite(residual)])
    return SIGMA_PER_MEDIAN * float(np.median(finite)) if len(finite) else float('nan')


def judge(
    rough: RigModel, refined: RigModel, frames: list[FrameObservation], poses: Array,
) -> Judgement:
    """Pose each frame by itself under both rigs, from poses (F, 3) near the truth."""
    before, after, found, whitened = [], [], [], []
    same = rough is refined
    for frame, start in zip(frames, poses):
        pose, residual = frame_residual(refined, frame, start)
        after.append(residual)
        found.append(pose)
        whitened.append(robust_deviation(residual / frame.points.sigma))
        before.append(residual if same else frame_residual(rough, frame, start)[1])
    none = np.zeros(0)
    scores = np.array(whitened)
    return Judgement(
        np.concatenate([f.points.pixels for f in frames]) if frames else np.zeros((0, 2)),
        np.concatenate([f.points.label for f in frames]) if frames else np.zeros(0, dtype=np.intp),
        np.concatenate(before) if frames else none, np.concatenate(after) if frames else none,
        np.array(found).reshape(-1, 3), np.where(np.isfinite(scores), scores, np.inf))


def frame_residual(
    model: RigModel, frame: FrameObservation, start: Array,
) -> tuple[Array, Array]:
    """The pose (3,) of one frame, and its residuals (N,), px; NaN where there is none."""
    points = frame.points
    residual = np.full(len(points), np.nan)
    if not np.isfinite(start).all():
        return np.full(3, np.nan), residual
    rays = model.rig.back_project(points.pixels)
    hit = np.flatnonzero(rays.hit)
    lines = EdgeLines(model.line_map, points.label[hit], frame.side[hit])
    try:
        refined = refine(
            rays[hit], lines.direction, lines.moment, Pose2.from_array(start),
            sigma=points.sigma[hit])
    except EstimationError:
        return np.full(3, np.nan), residual
    residual[hit] = refined.residual * points.sigma[hit]
    return refined.pose.as_array(), residual
