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

"""Poses to begin with: each frame alone, under a rough rig that may be millimetres off.

Such a rig bends the floor, and the closed form's global minimum is then often not the robot's
pose but one from which the lines are far away and every residual is small. So all headings are
tried, each with the position that suits it best, and judged by more than the closed form sees:
the tapes end somewhere, and a pose from which they would have to go on beyond their ends is wrong.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from nccs_pose.calibration.observations import FrameObservation
from nccs_pose.errors import EstimationError
from nccs_pose.estimation.global_pose import solve
from nccs_pose.estimation.pose_monomials import gram, monomial_rows
from nccs_pose.estimation.refine import refine
from nccs_pose.estimation.residual import lines_in_base, side_gradient
from nccs_pose.geometry.lines import LineMap
from nccs_pose.geometry.pose import Array, Pose2
from nccs_pose.geometry.rig import Rays, Rig
import numpy as np
from numpy.typing import NDArray

_HEADINGS = 36
_REFINED = 4  # best headings that are refined and judged again
_EXPECTED = 8.0  # px: what a rough rig may be off without being wrong
_MOST_POINTS = 160


@dataclass(frozen=True, eq=False)
class _Frame:
    """One frame's rays with the lines (N, 3) that they should meet."""

    rays: Rays
    line_map: LineMap
    label: NDArray[np.intp]
    rows: Array

    @classmethod
    def of(cls, rig: Rig, line_map: LineMap, frame: FrameObservation) -> _Frame:
        rays = rig.back_project(frame.points.pixels)
        keep = np.flatnonzero(rays.hit)
        keep = keep[np.linspace(0, len(keep) - 1, min(len(keep), _MOST_POINTS)).astype(int)]
        rays, label = rays[keep], frame.points.label[keep]
        rows = monomial_rows(
            rays.direction, rays.moment, line_map.directions[label], line_map.moments[label])
        return cls(rays, line_map, label, rows)

    def residual(self, pose: Pose2) -> tuple[Array, Array]:
        """Sampson distance (N,), px, and |dS/du| (N,), metres per pixel."""
        d, mu = self.line_map.directions[self.label], self.line_map.moments[self.label]
        slope = np.linalg.norm(side_gradient(self.rays, d, mu, pose), axis=1)
        slope = np.maximum(slope, 1e-12)
        d, mu = lines_in_base(d, mu, pose)
        side = (np.einsum('ni,ni->n', self.rays.direction, mu)
                + np.einsum('ni,ni->n', self.rays.moment, d))
        return side / slope, slope

    def overshoot(self, pose: Pose2) -> Array:
        """How far beyond the line's ends the ray passes it (N,), metres."""
        d, mu = lines_in_base(
            self.line_map.directions[self.label], self.line_map.moments[self.label], pose)
        r, w = self.rays.direction, self.rays.moment
        # Point of the line nearest to the ray, and where between its ends it lies.
        cross = np.cross(d, r)
        foot = np.cross(d, mu)
        along = np.einsum('ni,ni->n', np.cross(r, w) - foot, d - np.einsum(
            'ni,ni->n', d, r)[:, None] * r) / np.maximum(
                np.einsum('ni,ni->n', cross, cross), 1e-9)
        start = np.einsum('ni,ni->n', pose.inverse().apply(
            self.line_map.starts[self.label]) - foot, d)
        along = along - start
        return np.maximum(np.maximum(-along, along - self.line_map.lengths[self.label]), 0.0)

    def score(self, pose: Pose2) -> float:
        """How badly the pose explains the points: a robust mean of distances to the tapes."""
        residual, slope = self.residual(pose)
        beyond = self.overshoot(pose) * np.abs(self.rays.direction[:, 2]) / slope
        squared = (residual**2 + 0.1 * beyond**2) / _EXPECTED**2
        return float(np.log1p(squared).mean())

    def at_heading(self, yaw: float) -> Pose2:
        """The best position for that heading; S is linear in it."""
        pose = Pose2(0.0, 0.0, yaw)
        weight = np.ones(len(self.rays))
        for _ in range(3):
            pose = _best_position(gram(self.rows, weight), yaw)
            residual, slope = self.residual(pose)
            weight = 1.0 / (slope**2 * (1.0 + (residual / _EXPECTED) ** 2))
        return pose


def _best_position(matrix: Array, yaw: float) -> Pose2:
    """Minimise a Gram form (7, 7) over (x, y) at a fixed yaw."""
    c, s = np.cos(yaw), np.sin(yaw)
    form = np.zeros((7, 3))
    form[0, 2], form[1, 2], form[6, 2], form[2, 0], form[3, 1] = c, s, 1.0, 1.0, 1.0
    form[4:6, :2] = [[c, s], [-s, c]]
    q = form.T @ matrix @ form
    block = q[:2, :2] + 1e-9 * np.trace(q[:2, :2]) * np.eye(2) + 1e-300 * np.eye(2)
    x, y = -np.linalg.solve(block, q[:2, 2])
    return Pose2(float(x), float(y), yaw)


def first_pose(
    rig: Rig, line_map: LineMap, frame: FrameObservation, *, rough: bool = True,
) -> tuple[Pose2 | None, float]:
    """The pose that explains one frame of known labels best, and its score (0 is perfect).

    The tape's edges count as its middle: under a rough rig half a width is little.

    :param rough: whether the rig may be millimetres off; if not, the closed form is enough.
    """
    data = _Frame.of(rig, line_map, frame)
    if len(data.rays) < 6 or len(np.unique(data.label)) < 2:
        return None, float('inf')
    if rough:
        poses = [data.at_heading(yaw) for yaw in np.linspace(-np.pi, np.pi, _HEADINGS, False)]
        order = np.argsort([data.score(pose) for pose in poses])
        poses = [poses[index] for index in order[:_REFINED]]
    else:
        poses = [solution.pose for solution in solve(
            data.rays, line_map.directions, line_map.moments, data.label)]
    best, lowest = None, float('inf')
    for pose in poses:
        try:
            refined = refine(
                data.rays, line_map.directions[data.label], line_map.moments[data.label],
                pose, sigma=2.0, max_iterations=15)
        except EstimationError:
            continue
        score = data.score(refined.pose)
        if score < lowest:
            best, lowest = refined.pose, score
    return best, lowest


def first_poses(
    rig: Rig, line_map: LineMap, frames: list[FrameObservation], *, rough: bool = True,
) -> tuple[Array, Array]:
    """The same for many frames: T_map_base (F, 3), NaN where there is none, and scores (F,)."""
    middle = LineMap(tuple(replace(line, width=0.0) for line in line_map), line_map.frame)
    poses, scores = np.full((len(frames), 3), np.nan), np.full(len(frames), np.inf)
    for f, frame in enumerate(frames):
        pose, scores[f] = first_pose(rig, middle, frame, rough=rough)
        if pose is not None:
            poses[f] = pose.as_array()
    return poses, scores
