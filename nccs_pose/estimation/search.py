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

"""Where the robot can be, from one image and nothing else."""

from __future__ import annotations

import cv2
from nccs_pose.estimation.association import global_candidates, score_pose
from nccs_pose.estimation.estimate import Candidate
from nccs_pose.estimation.floor_segments import floor_segments, FloorSegment
from nccs_pose.estimation.options import LocaliserOptions
from nccs_pose.geometry.floor_table import FloorTable
from nccs_pose.geometry.lines import LineMap
from nccs_pose.geometry.pose import Pose2
from nccs_pose.vision.segment import chromatic_mask, find_blobs, hsv_mask, Segmentation
import numpy as np
from numpy.typing import NDArray

# Enough for a blob over all lines of a field at once.
_PIXELS_PER_BLOB = 400
# With fewer strips than this the image is looked at again, for tapes spread out by blur.
_ENOUGH = 3


class Searcher:
    """Finds line-like strips in images and the poses that explain them, for one rig and map."""

    def __init__(self, table: FloorTable, line_map: LineMap, options: LocaliserOptions) -> None:
        self._table = table
        self._map = line_map
        self._options = options
        self._colours = tuple(dict.fromkeys(line.colour for line in line_map))
        rows, columns = np.flatnonzero(table.region.any(1)), np.flatnonzero(table.region.any(0))
        self._rows = slice(int(rows[0]), int(rows[-1]) + 1)
        self._columns = slice(int(columns[0]), int(columns[-1]) + 1)
        self._region = np.ascontiguousarray(table.region[self._rows, self._columns])

    def segmentation(
        self, image: NDArray[np.uint8], colour: str, *, narrow: bool = False,
    ) -> Segmentation:
        """Blobs of one colour where the image shows the floor, or only their ridges."""
        part = image[self._rows, self._columns]
        options = self._options
        if options.threshold == 'hsv':
            mask = hsv_mask(part, colour)
        else:
            mask = chromatic_mask(
                part, colour, options.noise_gate, options.least_contrast, options.window,
                narrow=narrow)
        found = find_blobs(cv2.bitwise_and(mask, self._region), _PIXELS_PER_BLOB)
        origin = np.array([self._columns.start, self._rows.start], dtype=float)
        return Segmentation(found.mask, found.pixels + origin, found.label, found.weight)

    def segments(self, image: NDArray[np.uint8]) -> tuple[FloorSegment, ...]:
        """Straight strips of the map's colours on the floor."""
        found = self._strips(image, narrow=False)
        if len(found) < _ENOUGH and self._options.threshold == 'chromaticity':
            ridges = self._strips(image, narrow=True)
            found = ridges if len(ridges) > len(found) else found
        return tuple(sorted(found, key=lambda s: -s.weight))

    def _strips(self, image: NDArray[np.uint8], *, narrow: bool) -> list[FloorSegment]:
        found: list[FloorSegment] = []
        for colour in self._colours:
            widths = [line.width for line in self._map if line.colour == colour]
            found.extend(floor_segments(
                self.segmentation(image, colour, narrow=narrow), self._table, max(widths),
                colour))
        return found

    def candidates(self, segments: tuple[FloorSegment, ...]) -> tuple[Candidate, ...]:
        """Poses that explain the strips, best first."""
        return global_candidates(segments, self._map, self._table)

    def score(self, pose: Pose2, segments: tuple[FloorSegment, ...]) -> tuple[float, float]:
        """How well a pose explains the strips, 0 to 1, and which part of them it explains."""
        return score_pose(pose, segments, self._map, self._table)
