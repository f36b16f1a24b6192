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

from dataclasses import replace

from nccs_pose.calibration.observations import FrameObservation
from nccs_pose.errors import EstimationError
from nccs_pose.estimation.global_pose import solve
from nccs_pose.estimation.pose_monomials import monomial_rows
from nccs_pose.estimation.refine import refine
from nccs_pose.geometry.lines import LineMap
from nccs_pose.geometry.pose import Array, Pose2
from nccs_pose.geometry.rig import Rig
import numpy as np

_HEADINGS = 36
_REFINED = 4  # best headings that are refined and judged again
_EXPECTED = 8.0  # px: what a rough rig may be off without being wrong
_MOST_POINTS = 160


class _Frame:
    """One frame's rays with the lines that they should meet, for K poses at a time."""

    def __init__(self, rig: Rig, line_map: LineMap, frame: FrameObservation) -> None:
        rays = rig.back_project(frame.points.pixels)
        keep = np.flatnonzero(rays.hit)
        keep = keep[np.linspace(0, len(keep) - 1, min(len(keep), _MOST_POINTS)).astype(int)]
        self.rays, self.label = rays[keep], frame.points.label[keep]
        lines = line_map.directions[self.label], line_map.moments[self.label]
        self.lines = lines
        self._rows = monomial_rows(self.rays.direction, self.rays.moment, *lines)
        self._slopes = monomial_rows(
            np.moveaxis(self.rays.direction_jacobian, 2, 0),
            np.moveaxis(self.rays.moment_jacobian, 2, 0), *lines)
        floor, reaches = self.rays.floor_points()
        start = line_map.starts[self.label]
        self._floor, self._start, self._along = floor, start[:, :2], lines[0][:, :2]
        self._length = line_map.lengths[self.label]
        # Where a line ends is judged on the floor; one that hangs above it has no end there.
        self._ends = reaches & (np.abs(start[:, 2]) < 0.01) & (np.abs(lines[0][:, 2]) < 0.01)

    def residual(self, poses: Array) -> tuple[Array, Array]:
        """Sampson distances (K, N), px, and |dS/du| (K, N), metres per pixel, at poses (K, 3)."""
        x, y, yaw = poses.T
        c, s = np.cos(yaw), np.sin(yaw)
        monomials = np.stack([c, s, x, y, c * x + s * y, c * y - s * x, np.ones_like(x)])
        du, dv = self._slopes @ monomials
        slope = np.maximum(np.hypot(du, dv), 1e-12).T
        return (self._rows @ monomials).T / slope, slope

    def overshoot(self, poses: Array) -> Array:
        """How far beyond the line's ends the floor point lies (K, N), metres."""
        x, y, yaw = poses.T[:, :, None]
        c, s = np.cos(yaw), np.sin(yaw)
        px, py = self._floor.T
        at_x, at_y = c * px - s * py + x - self._start[:, 0], s * px + c * py + y
        along = at_x * self._along[:, 0] + (at_y - self._start[:, 1]) * self._along[:, 1]
        beyond = np.maximum(np.maximum(-along, along - self._length), 0.0)
        return np.where(self._ends, beyond, 0.0)

    def scores(self, poses: Array) -> Array:
        """How badly poses (K, 3) explain the points: robust means of distances to the tapes."""
        residual, slope = self.residual(poses)
        beyond = self.overshoot(poses) * np.abs(self.rays.direction[:, 2]) / slope
        squared = (residual**2 + 0.1 * beyond**2) / _EXPECTED**2
        return np.log1p(squared).mean(axis=1)

    def at_headings(self, yaw: Array) -> Array:
        """Poses (K, 3): for each heading (K,) its best position; S is linear in it."""
        c, s = np.cos(yaw), np.sin(yaw)
        # S in the monomials (x, y, 1) at each heading.
        form = np.zeros((len(yaw), 7, 3))
        form[:, 0, 2], form[:, 1, 2], form[:, 6, 2] = c, s, 1.0
        form[:, 2, 0] = form[:, 3, 1] = 1.0
        form[:, 4, 0], form[:, 4, 1], form[:, 5, 0], form[:, 5, 1] = c, s, -s, c
        rows = self._rows @ form
        weight = np.ones((len(yaw), len(self._rows)))
        poses = np.zeros((len(yaw), 3))
        poses[:, 2] = yaw
        for _ in range(3):
            q = np.matmul(np.swapaxes(rows, 1, 2), rows * weight[:, :, None])
            trace = q[:, 0, 0] + q[:, 1, 1]
            block = q[:, :2, :2] + (1e-9 * trace + 1e-300)[:, None, None] * np.eye(2)
            poses[:, :2] = -np.linalg.solve(block, q[:, :2, 2:])[:, :, 0]
            residual, slope = self.residual(poses)
            weight = 1.0 / (slope**2 * (1.0 + (residual / _EXPECTED) ** 2))
        return poses


def first_pose(
    rig: Rig, line_map: LineMap, frame: FrameObservation, *, rough: bool = True,
) -> tuple[Pose2 | None, float]:
    """The pose that explains one frame of known labels best, and its score (0 is perfect).

    The tape's edges count as its middle: under a rough rig half a width is little.

    :param rough: whether the rig may be millimetres off; if not, the closed form is enough.
    """
    data = _Frame(rig, line_map, frame)
    if len(data.rays) < 6 or len(np.unique(data.label)) < 2:
        return None, float('inf')
    if rough:
        poses = data.at_headings(np.linspace(-np.pi, np.pi, _HEADINGS, endpoint=False))
        poses = poses[np.argsort(data.scores(poses))[:_REFINED]]
    else:
        poses = np.array([solution.pose.as_array() for solution in solve(
            data.rays, line_map.directions, line_map.moments, data.label)])
    found = []
    for pose in poses:
        try:
            found.append(refine(
                data.rays, *data.lines, Pose2.from_array(pose), sigma=2.0,
                max_iterations=15).pose)
        except EstimationError:
            continue
    if not found:
        return None, float('inf')
    scores = data.scores(np.array([pose.as_array() for pose in found]))
    best = int(np.argmin(scores))
    return found[best], float(scores[best])


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
