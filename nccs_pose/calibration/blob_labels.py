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

"""Which blob is which line, under a rig too rough to follow the lines in the image.

A rig that is millimetres off bends the floor so much that no strip on it is straight, so nothing
is asked of single blobs: every assignment of the largest blobs to the lines is posed (see
:mod:`nccs_pose.calibration.first_poses`) and the best is kept, unless a second is as good.
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import permutations

from nccs_pose.calibration.first_poses import first_pose
from nccs_pose.calibration.observations import evenly, FrameObservation
from nccs_pose.estimation.options import LocaliserOptions
from nccs_pose.geometry.lines import LineMap
from nccs_pose.geometry.pose import Array, Pose2
from nccs_pose.geometry.rig import Rig
from nccs_pose.vision.line_points import LinePoints
from nccs_pose.vision.segment import chromatic_mask, find_blobs
import numpy as np
from numpy.typing import NDArray

_FRAMES = 8
_MOST_LINES = 5  # more have too many assignments to try all
_LARGEST = 4  # blobs that are tried
_POINTS = 30  # of each blob
_SIGMA = 1.5  # px: a blob's pixels lie all over the tape's width
_DISTINCT = 1.15  # a second assignment must be worse by this factor
_MASK = LocaliserOptions()  # how it tells a line's colour from its surroundings


def label_blobs(
    rig: Rig, line_map: LineMap, images: Iterable[tuple[int, NDArray[np.uint8]]],
) -> tuple[list[FrameObservation], Array]:
    """Frames whose largest blobs could be told apart, and their poses (F, 3) under this rig."""
    frames: list[FrameObservation] = []
    poses: list[Array] = []
    if len(line_map) > _MOST_LINES:
        return frames, np.zeros((0, 3))
    every = list(images)
    for index in evenly(len(every), _FRAMES):
        stamp_ns, image = every[index]
        found = _assign(rig, line_map, stamp_ns, image)
        if found is not None:
            frames.append(found[0])
            poses.append(found[1].as_array())
    return frames, np.array(poses).reshape(-1, 3)


def _assign(
    rig: Rig, line_map: LineMap, stamp_ns: int, image: NDArray[np.uint8],
) -> tuple[FrameObservation, Pose2] | None:
    blobs = _blobs(rig, line_map, image)
    if len(blobs) < 3:
        return None
    pixels = np.concatenate(blobs)
    blob = np.repeat(np.arange(len(blobs)), [len(b) for b in blobs])
    results = []
    for lines in permutations(range(len(line_map)), len(blobs)):
        points = LinePoints(pixels, np.full(len(pixels), _SIGMA), np.array(lines)[blob])
        frame = FrameObservation.of_middles(stamp_ns, points)
        pose, score = first_pose(rig, line_map, frame)
        if pose is not None:
            results.append((score, frame, pose))
    if not results:
        return None
    results.sort(key=lambda entry: entry[0])
    if len(results) > 1 and results[1][0] < _DISTINCT * results[0][0]:
        return None
    return results[0][1], results[0][2]


def _blobs(rig: Rig, line_map: LineMap, image: NDArray[np.uint8]) -> list[Array]:
    """Pixels (N, 2) of the blobs of most pixels whose rays reach the floor."""
    found: list[Array] = []
    for colour in dict.fromkeys(line.colour for line in line_map):
        mask = chromatic_mask(
            image, colour, _MASK.noise_gate, _MASK.least_contrast, _MASK.window)
        segmentation = find_blobs(mask, _POINTS)
        sees = rig.back_project(segmentation.pixels).floor_points()[1]
        for label in range(segmentation.label.max(initial=-1) + 1):
            pixels = segmentation.pixels[(segmentation.label == label) & sees]
            if len(pixels) > _POINTS // 2:
                found.append(pixels)
    return found[:min(_LARGEST, len(line_map))]
