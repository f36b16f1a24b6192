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

from collections.abc import Callable
from itertools import permutations
import math

from nccs_pose.estimation.association import FittedCandidate, global_candidates, score_pose
from nccs_pose.estimation.floor_segments import floor_segments, FloorSegment
from nccs_pose.estimation.options import LocaliserOptions
from nccs_pose.geometry.floor_table import FloorTable
from nccs_pose.geometry.lines import LineMap
from nccs_pose.geometry.pose import Pose2
from nccs_pose.vision.colour import LineColour
from nccs_pose.vision.learned_contrast import feature_of, learned_colour
from nccs_pose.vision.reduced import ReducedView
from nccs_pose.vision.segment import brightness, chromatic_mask, hsv_mask, Mask, raised_mask
import numpy as np
from numpy.typing import NDArray

# Enough for a blob over all lines of a field at once.
_PIXELS_PER_BLOB = 400
# Lines are looked for in an image halved as often as it stays so wide, px; there the surroundings
# of a pixel are no narrower than this.
_WIDTH = 320
_LEAST_WINDOW = 5

# Tapes in a row are parallel to so much, rad, and end this close before another one, metres.
_STRAIGHT = 0.1
_APART = 1.0

Strips = tuple[FloorSegment, ...]
Colours = tuple[LineColour, ...]
Look = Callable[[NDArray[np.uint8], Strips, Colours], tuple[Strips, Colours]]


class Searcher:
    """Finds line-like strips in images and the poses that explain them, for one rig and map.

    :ivar first: the way to find the strips of an image that suffices for most.
    :ivar further: ways for the others, in groups that belong together. Each look takes the strips
        found before and what the tapes were thought to look like, and gives its own of both.
    """

    def __init__(self, table: FloorTable, line_map: LineMap, options: LocaliserOptions) -> None:
        self._table = table
        self._map = line_map
        self._options = options
        self._widths: dict[str, float] = {}
        for line in line_map:
            self._widths[line.colour] = max(line.width, self._widths.get(line.colour, 0.0))
        # Where no tapes stand in a row, pieces in a row are one tape.
        self._longest = float(line_map.lengths.max()) if _in_a_row(line_map) else math.inf
        # The paper's threshold is one of whole pixels.
        by_hsv, pitch = options.threshold == 'hsv', 1
        while not by_hsv and table.rig.camera.width >= 2 * pitch * _WIDTH:
            pitch *= 2
        self._view = ReducedView.of(table.region, pitch)
        self._closer = ReducedView.of(table.region, max(pitch // 2, 1))
        self.first: Look = self._first_look
        self.further: tuple[tuple[Look, ...], ...] = () if by_hsv else (
            (self._look_by_example,), (self._closer_look, self._look_by_example))

    def segments(self, image: NDArray[np.uint8]) -> Strips:
        """Straight strips of the map's colours on the floor, the largest first."""
        return self._look(image, self._view)

    def _first_look(
        self, image: NDArray[np.uint8], _: Strips, colours: Colours,
    ) -> tuple[Strips, Colours]:
        return self.segments(image), colours

    def _closer_look(
        self, image: NDArray[np.uint8], _: Strips, colours: Colours,
    ) -> tuple[Strips, Colours]:
        # A tape hardly brighter than the pattern of its floor shows in a sharp image, and only
        # where what is brighter to one side does not count.
        return self._look(image, self._closer, ridges=True), colours

    def _look(
        self, image: NDArray[np.uint8], view: ReducedView, *, ridges: bool = False,
    ) -> Strips:
        part = view.read(image)
        masks = {c: self._mask(part, c, view, ridges=ridges) for c in self._widths}
        return self._strips(masks, view)

    def _mask(
        self, part: NDArray[np.uint8], colour: str, view: ReducedView, *, ridges: bool = False,
    ) -> Mask:
        options = self._options
        if options.threshold == 'hsv':
            return hsv_mask(part, colour)
        return chromatic_mask(
            part, colour, options.noise_gate, options.least_contrast, self._window(view),
            ridges=ridges)

    def _look_by_example(
        self, image: NDArray[np.uint8], known: Strips, colours: Colours,
    ) -> tuple[Strips, Colours]:
        """Look for what looks like the strips that are known."""
        options, view = self._options, self._view
        part, window = view.read(image), self._window(view)
        masks, learned = {}, []
        for colour in colours:
            examples = [strip.pixels for strip in known if strip.colour == colour.name]
            seen = colour if not examples else learned_colour(
                colour, part, view.places(np.concatenate(examples)), view.region, window)
            learned.append(seen)
            masks[colour.name] = self._mask(part, colour.name, view) if seen is colour else (
                raised_mask(feature_of(part, seen), brightness(part), options.noise_gate,
                            options.least_contrast, window))
        if all(seen is colour for seen, colour in zip(learned, colours)):
            return known, colours
        return self._strips(masks, view), tuple(learned)

    def _window(self, view: ReducedView) -> int:
        return max(_LEAST_WINDOW, self._options.window // view.pitch)

    def _strips(self, masks: dict[str, Mask], view: ReducedView) -> Strips:
        found: list[FloorSegment] = []
        for colour, mask in masks.items():
            found.extend(floor_segments(
                view.blobs(mask, _PIXELS_PER_BLOB), self._table, self._widths[colour], colour,
                longest=self._longest))
        return tuple(sorted(found, key=lambda s: -s.weight))

    def candidates(self, segments: Strips) -> tuple[FittedCandidate, ...]:
        """Poses that explain the strips, best first."""
        return global_candidates(segments, self._map, self._table)

    def score(self, pose: Pose2, segments: Strips) -> tuple[float, float]:
        """How well a pose explains the strips, 0 to 1, and which part of them it explains."""
        return score_pose(pose, segments, self._map, self._table)


def _in_a_row(line_map: LineMap) -> bool:
    """Whether one line of a map goes on, after a gap, as another."""
    for a, b in permutations(line_map, 2):
        if float(np.linalg.norm(np.cross(a.direction, b.direction))) > _STRAIGHT:
            continue
        for end, outward in ((a.start, -a.direction), (a.end, a.direction)):
            for other in (b.start, b.end):
                gap = float((other - end) @ outward)
                aside = float(np.linalg.norm(other - end - gap * outward))
                if 0.0 < gap < _APART and aside < _STRAIGHT * _APART:
                    return True
    return False
