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

"""What a frame would show: the edges of the map's tapes, as a rig sees them from a pose."""

from __future__ import annotations

from nccs_pose.calibration.observations import FrameObservation
from nccs_pose.geometry.lines import LineMap
from nccs_pose.geometry.pose import Array, Pose2
from nccs_pose.geometry.rig import Rig
from nccs_pose.vision.line_points import LinePoints
import numpy as np


def predict_frame(
    rig: Rig, line_map: LineMap, pose: Pose2, *, sigma: float, points: int = 75, stamp_ns: int = 0,
    along: Array | None = None,
) -> FrameObservation:
    """Noise-free points on both edges of every line, where the mirror shows them.

    :param sigma: standard deviation to give them, px; it is not applied.
    :param points: how many of each line, both edges together (a line without a width: all on
        its middle).
    :param along: where along the lines, 0 at the start to 1 at the end: (points,) for all of
        them, or (L, points), each its own; None: evenly.
    """
    stations = np.linspace(0.0, 1.0, points) if along is None else along
    world, label, side = [], [], []
    for index, (line, share) in enumerate(
            zip(line_map, np.broadcast_to(stations, (len(line_map), points)))):
        sides = np.where(np.arange(points) % 2, 1, -1) if line.width > 0.0 else np.zeros(points)
        world.append(line.start + share[:, None] * (line.end - line.start)
                     + (0.5 * line.width * sides)[:, None] * line.left)
        label.append(np.full(points, index))
        side.append(sides)
    pixels, seen = rig.project(pose.inverse().apply(np.concatenate(world)))
    labels = np.concatenate(label).astype(np.intp)[seen]
    return FrameObservation(
        stamp_ns, LinePoints(pixels[seen], np.full(len(labels), sigma), labels),
        np.concatenate(side).astype(np.int8)[seen])
