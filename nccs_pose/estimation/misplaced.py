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

"""Whether a line is seen beside the place where a pose says that it should be.

An occluded line is nowhere. One that lies a few pixels beside its place says that the map, the
rig or the pose is wrong, and the pixels cannot tell which.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass

from nccs_pose.estimation.alignment import Alignment
from nccs_pose.estimation.options import LocaliserOptions
from nccs_pose.estimation.prediction import BandPredictor
from nccs_pose.estimation.verdict import DISTURBED, line_offsets
from nccs_pose.geometry.floor_table import FloorTable
from nccs_pose.geometry.lines import LineMap
from nccs_pose.geometry.pose import Array, Pose2
from nccs_pose.vision.bands import Bands
from nccs_pose.vision.colour import LineColour
from nccs_pose.vision.median import upper_median
from nccs_pose.vision.profile_search import contrast_across, overlap
from nccs_pose.vision.profiles import fit_profiles, read_bands
import numpy as np
from numpy.typing import NDArray

# Stations of a line that is looked for stand so close, px.
_CLOSE = 4.0
# So many stations have to be in view.
_LEAST_STATIONS = 10
# A line is looked for up to this far beside its place, metres, in steps of this, px; turned by
# this much more or less at its ends than in its middle, as parts of the shift's range.
_NEAR = 0.4
_STEP = 0.5
_TURNS = (-0.5, -0.25, 0.0, 0.25, 0.5)
# A tape shows contrast between these, as fractions of what tapes show here, and so much more than
# there is at the predicted place.
_CONTRAST = (0.25, 2.0)
_BETTER = (0.15, 3.0)
# Where it is off by less than this, px, its profiles say by how much.
_CAPTURED = 1.0
# A tape this wide, px, of which this part is found in its place is there.
_PLAIN_WIDTH = 1.0
_PLAIN_SHARE = 0.8
# One that should be as wide as this, px, is found in its place if it is there.
_FOUND_WIDTH = 0.7
# What is thinner than this, px, is outshone by what surrounds it.
_LEAST_WIDTH = 0.31
# Beside its place a line is when it is off by this, px, and by so many standard deviations; and by
# more than what surrounds a tape shifts it.
_BESIDE = 0.5
_EVIDENT = 5.0
# It is in its place when it is off by less than this for certain, px.
_IN_PLACE = 0.5
# What lies this near another line, metres beyond its footprint, is that line.
_ON_ANOTHER = 0.05


@dataclass(frozen=True)
class Placement:
    """Where a line is seen.

    :ivar beside: how far beside its predicted place, px; None where it is not seen there.
    :ivar confirmed: whether it is certainly seen in its place.
    """

    beside: float | None = None
    confirmed: bool = False


def plainly_in_place(alignment: Alignment) -> frozenset[int]:
    """Lines that the pose itself rests on, most of each, where they are.

    They need no second look at the image.
    """
    mean, deviation = line_offsets(alignment, len(alignment.support))
    return frozenset(np.flatnonzero(
        (alignment.support >= _PLAIN_SHARE)
        & (np.abs(mean) + 2.0 * deviation < _IN_PLACE)).tolist())


class LineFinder:
    """Finds the lines of one map in their places or beside them, for one rig."""

    def __init__(
        self, predictor: BandPredictor, table: FloorTable, line_map: LineMap,
        options: LocaliserOptions,
    ) -> None:
        self._predictor = predictor
        self._table = table
        self._map = line_map
        self._options = options

    def placements(
        self, image: NDArray[np.uint8], alignment: Alignment, lines: Collection[int],
    ) -> Iterator[tuple[int, Placement]]:
        """Where some lines are seen, each looked for when it is asked for.

        :param image: (H, W, 3) uint8 BGR.
        :param alignment: the pose that was laid on it.
        :param lines: by their index in the map.
        """
        colours = {colour.name: colour for colour in alignment.colours}
        places = self._predictor.places(
            alignment.pose, _CLOSE, self._options.stations, lines)
        bands, slide = self._predictor.bands(places, alignment.pose)
        moved = slide[:, 3:] @ alignment.refinement.attitude
        for k in sorted(lines):
            own = bands.label == k
            yield k, self._placement(
                image, k, bands[own], moved[own], colours[self._map[k].colour], alignment.pose)

    def _placement(
        self, image: NDArray[np.uint8], line: int, bands: Bands, moved: Array,
        colour: LineColour, pose: Pose2,
    ) -> Placement:
        """Where one line is seen.

        :param line: its index in the map.
        :param bands: its stations, as the pose predicts them on a flat floor.
        :param moved: where height, roll and pitch move them (N,), px across.
        """
        if len(bands) < _LEAST_STATIONS:
            return Placement()
        width = 2.0 * upper_median(bands.half_width)
        fit, _ = fit_profiles(read_bands(image, bands, colour), bands, colour)
        found = int(fit.found.sum())
        mean, deviation = _mean_shift(
            (fit.shift - moved)[fit.found], fit.sigma[fit.found]) if found else (0.0, np.inf)
        off = abs(mean)
        confirmed = off + 2.0 * deviation < _IN_PLACE
        # No need to look for what is plainly there.
        if confirmed and width >= _PLAIN_WIDTH and found >= _PLAIN_SHARE * len(bands):
            return Placement(confirmed=True)
        scale = bands.half_width / (0.5 * self._map[line].width)
        least = max(_BESIDE, DISTURBED / width)
        # Profiles say where a tape is that is near; and would so wide a one, were it in its place.
        near = found >= _LEAST_STATIONS and off <= 2.0 * _CAPTURED
        captured = least if not near and width >= _FOUND_WIDTH else _CAPTURED
        shift = self._strongest(image, bands, moved, colour, scale, captured)
        if shift is None:
            return Placement()
        if float(np.mean(np.abs(shift))) <= captured:
            if not near:
                return Placement()
            if off <= max(least, _EVIDENT * deviation):
                return Placement(confirmed=confirmed)
            shift = np.full(len(bands), mean)
        if width < _LEAST_WIDTH or self._is_another(line, bands, shift + moved, pose):
            return Placement()
        return Placement(beside=float(np.mean(np.abs(shift))))

    def _strongest(
        self, image: NDArray[np.uint8], bands: Bands, moved: Array, colour: LineColour,
        scale: Array, captured: float,
    ) -> Array | None:
        """Shifts (N,), px, at which a line as a whole is seen best; None where it is not seen.

        A tape of half a pixel is lost in the noise of each of its stations, and plain in all of
        them together: the contrast of the whole line is laid out over where it may lie on the
        floor.

        :param scale: of the image across the line (N,), px per metre.
        :param captured: what lies further off than this, px, must show more there than in its
            place.
        """
        reach, usual = self._options.band, upper_median(scale)
        farthest = min(_NEAR, reach / usual)
        steps = int(np.ceil(farthest * usual / _STEP))
        parallel = farthest / max(steps, 1) * np.arange(-steps, steps + 1.0)
        turn = farthest * np.outer(_TURNS, np.linspace(-1.0, 1.0, len(bands)))
        # (T, D, N), metres on the floor and then px across.
        shift = (parallel[:, None] + turn[:, None, :]) * scale
        side = min(reach, float(np.abs(shift).max())) + 1.0
        places, contrast, power = contrast_across(image, bands, colour, side, _STEP)
        at = np.clip((shift + moved - places[0]) / _STEP, 0.0, len(places) - 1.001)
        low = at.astype(int)
        station = np.arange(len(bands))
        here = contrast[station, low]
        here = here + (at - low) * (contrast[station, low + 1] - here)
        within = np.abs(shift) <= reach
        weight = np.where(within, power, 0.0)
        total = weight.sum(axis=-1)
        mean = (weight * here).sum(axis=-1) / np.maximum(total, 1e-9)
        mean = np.where(total >= 0.5 * power.sum(), mean, -np.inf)
        best = np.unravel_index(int(mean.argmax()), mean.shape)
        offset = float(np.mean(np.abs(shift[best])))
        level, noise = _mean_and_deviation(here[best], weight[best])
        own = here[len(_TURNS) // 2, steps]
        better, certain = _mean_and_deviation(here[best] - own, weight[best])
        if not max(_CONTRAST[0], _EVIDENT * noise) < level < _CONTRAST[1]:
            return None
        if offset > captured:
            if better < max(_BETTER[0], _BETTER[1] * certain):
                return None
            # What is seen in its place, and is not the blur of what is beside it, is the line.
            left = own - here[best] * overlap(bands, colour, shift[best])
            level, noise = _mean_and_deviation(left, weight[best])
            if level > max(_CONTRAST[0], _BETTER[1] * noise):
                return None
        return shift[best]

    def _is_another(self, k: int, bands: Bands, shift: Array, pose: Pose2) -> bool:
        """Whether what is seen lies on another line of the map."""
        floor, jacobian = self._table.floor(bands.midline + shift[:, None] * bands.across)
        footprint = np.sqrt(np.einsum('pij,pij->p', jacobian, jacobian))
        at = pose.apply(floor)
        for other, line in enumerate(self._map):
            if other == k or line.colour != self._map[k].colour:
                continue
            direction = line.direction[:2]
            offset = at - line.start[:2]
            along = offset @ direction
            across = np.abs(offset @ line.left[:2])
            on = (across < _ON_ANOTHER + footprint) & (along > 0.0) & (along < line.length)
            if on.mean() > 0.5:
                return True
        return False


def _mean_shift(shift: Array, sigma: Array) -> tuple[float, float]:
    """Mean of shifts (N,) and its standard deviation, no less than they scatter."""
    weight = 1.0 / sigma**2
    mean = float(weight @ shift / weight.sum())
    spread = float(weight @ (shift - mean) ** 2) / len(shift)
    return mean, float(np.sqrt(max(1.0, spread) / weight.sum()))


def _mean_and_deviation(value: Array, weight: Array) -> tuple[float, float]:
    """Weighted mean of values (N,) and its standard deviation, as they scatter."""
    total = float(weight.sum())
    mean = float(weight @ value) / total
    return mean, float(np.sqrt(weight**2 @ (value - mean) ** 2)) / total
