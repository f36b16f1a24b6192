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
import math

from nccs_pose.estimation.association import Associator, Candidates, FittedCandidate
from nccs_pose.estimation.floor_points import PixelFloor
from nccs_pose.estimation.floor_segments import floor_segments, FloorSegment, widest_gap
from nccs_pose.estimation.gate import Gate
from nccs_pose.estimation.options import LocaliserOptions
from nccs_pose.estimation.strip_pairs import BEYOND
from nccs_pose.estimation.whole_lines import whole_lines
from nccs_pose.geometry.floor_table import FloorTable
from nccs_pose.geometry.lines import LineMap
from nccs_pose.geometry.pose import Pose2
from nccs_pose.vision.colour import LineColour
from nccs_pose.vision.faint_lines import faint_line_mask
from nccs_pose.vision.learned_contrast import feature_of, learned_colour
from nccs_pose.vision.reduced import ReducedView
from nccs_pose.vision.segment import (
    brightness,
    contrast_of,
    hsv_mask,
    Mask,
    raised_mask,
)
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
Masks = dict[str, Mask]
Colours = tuple[LineColour, ...]
Look = Callable[[NDArray[np.uint8], Strips, Colours], tuple[Strips, Colours]]


class Searcher:
    """Finds line-like strips in images and the poses that explain them, for one rig and map.

    :ivar first: the way to find the strips of an image that suffices for most.
    :ivar further: ways for the others, in groups that take turns from image to image. Each look
        takes the image as of :meth:`view`, the strips found before and what the tapes were
        thought to look like, and gives its own of both.
    """

    def __init__(self, table: FloorTable, line_map: LineMap, options: LocaliserOptions) -> None:
        # Strips run on over the joints of lines that the map draws in pieces.
        line_map = whole_lines(line_map)
        self._options = options
        self._widths: dict[str, float] = {}
        for line in line_map:
            self._widths[line.colour] = max(line.width, self._widths.get(line.colour, 0.0))
        # Where no tapes stand in a row, pieces in a row are one tape.
        self._longest = float(line_map.lengths.max()) if _in_a_row(line_map) else math.inf
        # They run on over gaps too, while they are no longer than some tape is.
        self._associator = Associator(
            line_map, table, whole_lines(line_map, widest_gap(self._longest, BEYOND)))
        # The paper's threshold is one of whole pixels.
        by_hsv, pitch = options.threshold == 'hsv', 1
        while not by_hsv and table.rig.camera.width >= 2 * pitch * _WIDTH:
            pitch *= 2
        self._view = ReducedView.of(table.region, pitch)
        self._floor = PixelFloor(self._view.pixels, pitch, table)
        # Things as wide are what a pixel of the view is compared with, px of the view.
        self._window = max(_LEAST_WINDOW, options.window // pitch)
        self.first: Look = self._first_look
        self.further: tuple[tuple[Look, ...], ...] = () if by_hsv else (
            (self._look_by_example, self._look_along),
            (self._look_along, self._look_along_by_example))

    def masks(self, image: NDArray[np.uint8]) -> Masks:
        """Where the floor in an image (H, W, 3) has the map's colours, each by itself."""
        return self._masks(self.view(image))

    def view(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """What of an image (H, W, 3) all looks take, (h, w, 3): its floor, made smaller."""
        return self._view.read(image)

    def _masks(self, part: NDArray[np.uint8]) -> Masks:
        return {colour: self._mask(part, colour) for colour in self._widths}

    def _first_look(
        self, part: NDArray[np.uint8], _: Strips, colours: Colours,
    ) -> tuple[Strips, Colours]:
        return self.strips(self._masks(part)), colours

    def _look_along(
        self, part: NDArray[np.uint8], _: Strips, colours: Colours,
    ) -> tuple[Strips, Colours]:
        """Look for what is no pixel's matter: lines, by all that they run over."""
        return self.strips({
            colour: self._faint(contrast_of(part, colour)) for colour in self._widths}), colours

    def _look_by_example(
        self, part: NDArray[np.uint8], known: Strips, colours: Colours,
    ) -> tuple[Strips, Colours]:
        """Look for what looks like the strips that are known."""
        return self._by_example(
            part, known, colours, lambda feature: self._raised(part, feature))

    def _look_along_by_example(
        self, part: NDArray[np.uint8], known: Strips, colours: Colours,
    ) -> tuple[Strips, Colours]:
        """Look along lines for what looks like the strips that are known."""
        return self._by_example(part, known, colours, self._faint)

    def _by_example(
        self, part: NDArray[np.uint8], known: Strips, colours: Colours,
        mask_of: Callable[[Mask], Mask],
    ) -> tuple[Strips, Colours]:
        """Learn the colours of which strips are known, and look again.

        :param mask_of: where tapes are, by a feature (h, w) that is high on them.
        """
        learned = []
        for colour in colours:
            examples = [strip.pixels for strip in known if strip.colour == colour.name]
            learned.append(colour if not examples else learned_colour(
                colour, part, self._view.places(np.concatenate(examples)), self._view.region,
                self._window))
        if all(seen is colour for seen, colour in zip(learned, colours)):
            return known, colours
        return self.strips({
            colour.name: mask_of(
                contrast_of(part, colour.name) if seen is colour else feature_of(part, seen))
            for seen, colour in zip(learned, colours)}), tuple(learned)

    def _mask(self, part: NDArray[np.uint8], colour: str) -> Mask:
        if self._options.threshold == 'hsv':
            return hsv_mask(part, colour)
        return self._raised(part, contrast_of(part, colour))

    def _raised(self, part: NDArray[np.uint8], feature: Mask) -> Mask:
        options = self._options
        return raised_mask(
            feature, brightness(part), options.noise_gate, options.least_contrast, self._window)

    def _faint(self, feature: Mask) -> Mask:
        return faint_line_mask(
            feature, self._view.region, self._options.noise_gate, self._window)

    def strips(self, masks: Masks) -> Strips:
        """Straight strips of the map's colours on the floor, the largest first."""
        found: list[FloorSegment] = []
        for colour, mask in masks.items():
            blobs = self._view.blobs(mask, _PIXELS_PER_BLOB)
            found.extend(floor_segments(
                blobs, self._floor, self._widths[colour], colour, longest=self._longest))
        return tuple(sorted(found, key=lambda s: -s.weight))

    def candidates(self, segments: Strips, gate: Gate | None = None) -> Candidates:
        """Poses that explain the strips; of too many those inside the gate."""
        return self._associator.candidates(segments, gate)

    def taken_for(self, pose: Pose2, segments: Strips) -> list[FittedCandidate]:
        """What a pose may be taken for in a coarse image."""
        return self._associator.taken_for(pose, segments)

    def on_lines(self, pose: Pose2, masks: Masks) -> float:
        """Which part of the pixels that have the map's colours a pose has on its lines, 0 to 1."""
        on = [self._associator.on_lines(
            pose, *self._floor.at(self._view.inside(mask)), self._widths[colour], colour)
            for colour, mask in masks.items()]
        count = sum(len(part) for part in on)
        return sum(int(np.count_nonzero(part)) for part in on) / count if count else 1.0

    def score(self, pose: Pose2, segments: Strips) -> tuple[float, float]:
        """How well a pose explains the strips, 0 to 1, and which part of them it explains."""
        return self._associator.score(pose, segments)


def _in_a_row(line_map: LineMap) -> bool:
    """Whether one line of a map goes on, after a gap, as another."""
    x, y = line_map.directions[:, :2].T
    straight = np.abs(x[:, None] * y - y[:, None] * x) <= _STRAIGHT
    np.fill_diagonal(straight, False)
    ends = np.stack([line_map.starts[:, :2], line_map.ends[:, :2]])
    for begin, outward in zip(ends, (-1.0, 1.0)):
        # From an end of each line to both ends of each other (2, L, L).
        dx, dy = np.moveaxis(ends[:, None] - begin[:, None], -1, 0)
        gap = outward * (dx * x[:, None] + dy * y[:, None])
        aside = np.abs(dy * x[:, None] - dx * y[:, None])
        if ((gap > 0.0) & (gap < _APART) & (aside < _STRAIGHT * _APART) & straight).any():
            return True
    return False
