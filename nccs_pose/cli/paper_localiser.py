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
"""The paper's chain as a localiser, to be replayed beside the project's own.

Fixed HSV threshold, blobs, 75 pixels of each, the paper's minimisation, warm-started from the
previous pose (carried on by odometry where it is fed). What the paper does by hand is done for
it: the first pose is the project's own, and each blob belongs to the line that is nearest by the
previous pose. It has no verdict and no covariance.
"""

from __future__ import annotations

import time

from nccs_pose.estimation.admission import Admission
from nccs_pose.estimation.estimate import Estimate, Quality, StageTimes, State
from nccs_pose.estimation.localiser import Localiser
from nccs_pose.estimation.odometry import Odometry
from nccs_pose.estimation.options import LocaliserOptions
from nccs_pose.estimation.paper import paper_estimate
from nccs_pose.geometry.lines import LineMap
from nccs_pose.geometry.pose import Array, Pose2
from nccs_pose.geometry.rig import Rig
from nccs_pose.vision.decode import Image
from nccs_pose.vision.line_points import LinePoints
from nccs_pose.vision.segment import find_blobs, hsv_mask
import numpy as np
from numpy.typing import NDArray

_PIXELS_PER_BLOB = 75
_REACH = 0.5
"""A blob further than this from every line, metres on the floor, is none."""


class PaperLocaliser:
    """Answers images as the paper does; called like `Localiser`."""

    def __init__(self, rig: Rig, line_map: LineMap, options: LocaliserOptions) -> None:
        self._rig, self._map = rig, line_map
        self._starter = Localiser(rig, line_map, options)
        self._odometry = Odometry(options.clock_jump)
        self._admission = Admission(rig.camera, self._odometry, options.clock_jump)
        self._last: tuple[int, Pose2] | None = None

    def add_odometry(self, stamp_ns: int, pose: Pose2) -> None:
        """Take a sample of wheel odometry, T_odom_base."""
        self._odometry.add(stamp_ns, pose)
        if self._last is None:
            self._starter.add_odometry(stamp_ns, pose)

    def process(self, stamp_ns: int, image: Image) -> Estimate:
        """Estimate the pose that an image was taken from.

        :raises FrameRefusedError: of the images that `Localiser` refuses.
        :raises EstimationError: if too few pixels of lines are found.
        """
        if not self._admission.admit(stamp_ns, image):
            self._odometry.clear()
            self._starter.reset()
            self._last = None
        if self._last is None:
            first = self._starter.process(stamp_ns, image)
            if first.pose is not None:
                self._last = (stamp_ns, first.pose)
            return first
        begin = time.perf_counter()
        start = self._carried_on(stamp_ns)
        pixels, label = self._line_pixels(image, start)
        detected = time.perf_counter()
        result = paper_estimate(
            self._rig, pixels, self._map.directions[label], self._map.moments[label], start)
        self._last = (stamp_ns, result.pose)
        return Estimate(
            stamp_ns, State.TRACKING, f"the paper's minimum ({result.message})", result.pose,
            points=LinePoints(pixels, np.ones(len(pixels)), label),
            quality=Quality(lines_used=len(np.unique(label)), points_used=len(label)),
            times=StageTimes(
                detect=detected - begin, refine=time.perf_counter() - detected))

    def _carried_on(self, stamp_ns: int) -> Pose2:
        assert self._last is not None
        stamp, pose = self._last
        before, now = self._odometry.at(stamp), self._odometry.at(stamp_ns)
        return pose if before is None or now is None else (
            pose @ before.pose.inverse() @ now.pose)

    def _line_pixels(self, image: Image, pose: Pose2) -> tuple[Array, NDArray[np.intp]]:
        """Pixels (N, 2) of the blobs that lie on lines, and which line (N,)."""
        chosen, labels = [], []
        for colour in sorted({line.colour for line in self._map}):
            blobs = find_blobs(hsv_mask(image, colour), _PIXELS_PER_BLOB)
            floor, reaches = self._rig.back_project(blobs.pixels).floor_points()
            distance = self._distances(pose.apply(floor), colour)
            for blob in range(int(blobs.label.max(initial=-1)) + 1):
                mine = (blobs.label == blob) & reaches
                if np.count_nonzero(mine) >= 5:
                    middle = np.median(distance[mine], axis=0)
                    if middle.min() < _REACH:
                        chosen.append(blobs.pixels[mine])
                        labels.append(np.full(np.count_nonzero(mine), middle.argmin()))
        if not chosen:
            return np.zeros((0, 2)), np.zeros(0, dtype=np.intp)
        return np.concatenate(chosen), np.concatenate(labels)

    def _distances(self, points: Array, colour: str) -> Array:
        """Distance (N, L) of floor points (N, 2) from the lines, infinite for other colours."""
        start, step = self._map.starts[:, :2], (self._map.ends - self._map.starts)[:, :2]
        since = points[:, None] - start
        share = np.einsum('nlk,lk->nl', since, step) / np.einsum('lk,lk->l', step, step)
        foot = np.clip(share, 0.0, 1.0)[:, :, None] * step
        distance = np.linalg.norm(since - foot, axis=2)
        return np.where([line.colour == colour for line in self._map], distance, np.inf)
