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

"""Random lines around a robot and the pixels that show them, for tests of the solvers."""

from __future__ import annotations

from dataclasses import dataclass
import math

from nccs_pose.geometry.pose import Pose2
from nccs_pose.geometry.rig import Rays, Rig
import numpy as np


@dataclass(frozen=True, eq=False)
class LabelledScene:
    """Lines (L, 3) in the map, a true pose, and noisy pixels (N, 2) with their line (N,)."""

    rig: Rig
    pose: Pose2
    directions: np.ndarray
    moments: np.ndarray
    pixels: np.ndarray
    label: np.ndarray

    @property
    def rays(self) -> Rays:
        """The pixels' rays."""
        return self.rig.back_project(self.pixels)

    @property
    def by_ray(self) -> tuple[Rays, np.ndarray, np.ndarray]:
        """Rays with the direction and the moment of the line of each."""
        return self.rays, self.directions[self.label], self.moments[self.label]


def observe(rig, pose, points, directions, *, count=20, noise=0.0, rng):
    """Pixels of lines through points (L, 3) along directions (L, 3), both in the map."""
    pixels, label = [], []
    for k, (q, d) in enumerate(zip(points, directions)):
        along = rng.uniform(-2.0, 2.0, 40 * count)
        seen = pose.inverse().apply(q + along[:, None] * d)
        distance = np.hypot(seen[:, 0], seen[:, 1])
        seen = seen[(distance > 0.25) & (distance < 3.0) & (np.abs(seen[:, 2]) < 0.7)]
        uv, visible = rig.project(seen)
        uv = uv[visible][:count]
        if len(uv) < count:
            return None
        pixels.append(uv)
        label += [k] * count
    pixels = np.concatenate(pixels)
    return LabelledScene(
        rig, pose, directions, np.cross(points, directions),
        pixels + noise * rng.standard_normal(pixels.shape), np.array(label))


def random_direction(kind: str, rng) -> np.ndarray:
    """A unit direction (3,): floor, vertical or slanted."""
    if kind == 'vertical':
        return np.array([0.0, 0.0, 1.0])
    if kind == 'floor':
        angle = rng.uniform(0.0, math.pi)
        return np.array([math.cos(angle), math.sin(angle), 0.0])
    d = rng.standard_normal(3)
    return d / np.linalg.norm(d)


def random_scene(rig, kinds, *, count=20, noise=0.0, rng) -> LabelledScene:
    """One random line of each kind, all well in view of a robot anywhere within 2 m."""
    while True:
        pose = Pose2(*rng.uniform(-2.0, 2.0, 2), rng.uniform(-math.pi, math.pi))
        bearing = rng.uniform(-math.pi, math.pi, len(kinds))
        range_ = rng.uniform(0.4, 2.0, len(kinds))
        on_floor = np.array([kind == 'floor' for kind in kinds])
        height = np.where(on_floor, 0.0, rng.uniform(0.0, 0.6, len(kinds)))
        points = pose.apply(
            np.stack([range_ * np.cos(bearing), range_ * np.sin(bearing), height], axis=1))
        directions = np.array([random_direction(kind, rng) for kind in kinds])
        scene = observe(rig, pose, points, directions, count=count, noise=noise, rng=rng)
        if scene is not None:
            return scene


def pose_error(pose: Pose2, truth: Pose2) -> np.ndarray:
    """(x, y, yaw) difference (3,), the angle wrapped."""
    e = pose.as_array() - truth.as_array()
    e[2] = math.remainder(e[2], 2.0 * math.pi)
    return e
