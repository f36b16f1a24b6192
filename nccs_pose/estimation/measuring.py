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

"""Stations of tapes read from an image, and measured once or more: each time a pose comes out."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

from nccs_pose.estimation.alignment import Pass
from nccs_pose.estimation.options import LocaliserOptions
from nccs_pose.estimation.prediction import BandPredictor, Places
from nccs_pose.estimation.refine import Refinement
from nccs_pose.estimation.shift_solve import Prior, weigh_shifts, WeighedShifts
from nccs_pose.estimation.whole_lines import first_pieces
from nccs_pose.geometry.floor_table import FloorTable
from nccs_pose.geometry.lines import LineMap
from nccs_pose.geometry.pose import Array, Pose2
from nccs_pose.vision.bands import Bands
from nccs_pose.vision.colour import LineColour
from nccs_pose.vision.profile_products import Reading
from nccs_pose.vision.profile_search import search_profiles
from nccs_pose.vision.profiles import fit_again, fit_profiles, ProfileFit, read_bands
import numpy as np
from numpy.typing import NDArray

# A pose rests on so many stations.
LEAST_STATIONS = 12
# A profile is linear in its shift for about so many pixels.
LINEAR_PX = 2.0
# A search takes so many stations of each line, this far apart (px) or more.
_SEARCHED = 25
_SEARCHED_SPACING = 8.0
# A pass misses less than this part of the way to where it leads.
_MOST_MISSED = 0.5

# Which of a row of things: a slice, or a mask.
Selection = slice | NDArray[np.bool_]
_ALL = slice(None)


class Part(NamedTuple):
    """The stations of one colour.

    :ivar colour: its number.
    :ivar own: which of all stations they are.
    :ivar groups: which of all groups of stations.
    :ivar bands: theirs.
    """

    colour: int
    own: Selection
    groups: Selection
    bands: Bands


@dataclass(frozen=True, eq=False)
class Look:
    """Stations where a pose predicts them, and the pixels about them.

    :ivar pose: T_map_base that predicts them.
    :ivar attitude: and the base's (z, roll, pitch) off its plane (3,), metres and rad.
    :ivar slide: d(their place across)/d(x, y, yaw, z, roll, pitch) (6, N), px per metre and rad.
    :ivar read: the stations of each colour, and their pixels.
    :ivar rough: whether only some of the pixels are.
    """

    pose: Pose2
    attitude: Array
    bands: Bands
    slide: Array
    read: tuple[tuple[Part, Reading], ...]
    rough: bool

    def beside(self, pose: Pose2, attitude: Array) -> Array:
        """How far beside the bands another pose has the stations (N,), px, to first order.

        :param attitude: the base's (z, roll, pitch) off its plane with it (3,).
        """
        return pose.minus(self.pose).dot(self.slide[:3]) + (
            attitude - self.attitude).dot(self.slide[3:])


class Measurer:
    """Measures the tapes of one map for one rig."""

    def __init__(self, table: FloorTable, line_map: LineMap, options: LocaliserOptions) -> None:
        self.predictor = BandPredictor(table, line_map)
        self._whole = first_pieces(line_map)
        self._options = options
        names = tuple(dict.fromkeys(line.colour for line in line_map))
        self._colour_of_line = np.array([names.index(line.colour) for line in line_map])
        self.nominal_colours = tuple(LineColour.nominal(name, options.blur) for name in names)

    def look(
        self, image: NDArray[np.uint8], places: Places, pose: Pose2, attitude: Array,
        colours: tuple[LineColour, ...], *, rough: bool = False,
    ) -> Look | None:
        """Read stations where a pose predicts them; None with too few of them.

        :param image: (H, W, 3) uint8 BGR.
        :param attitude: the base's (z, roll, pitch) off its plane as known so far (3,): what is
            measured from there is small, and a profile is true to small shifts only.
        """
        bands, slide = self.predictor.bands(places, pose, attitude)
        if len(bands) < LEAST_STATIONS:
            return None
        read = tuple(
            (part, read_bands(image, part.bands, colours[part.colour], rough=rough))
            for part in self._parts(bands))
        return Look(pose, attitude, bands, slide.T, read, rough)

    def measure(
        self, look: Look, prior: Prior | None, colours: tuple[LineColour, ...],
    ) -> Pass | None:
        """Measure what was read, and solve; None where too few stations are felt."""
        bands, slide, learned = look.bands, look.slide, list(colours)
        n = len(bands)
        shift, sigma, found = np.empty(n), np.empty(n), np.empty(n, dtype=bool)
        for part, reading in look.read:
            fit, learned[part.colour] = fit_profiles(
                reading, part.bands, colours[part.colour], rough=look.rough)
            shift[part.own], sigma[part.own], found[part.own] = fit.shift, fit.sigma, fit.found
        felt = found & (np.abs(shift) < LINEAR_PX + 2.0 * sigma)
        used, = felt.nonzero()
        if len(used) < LEAST_STATIONS:
            return None
        weighed = self._weigh(
            (shift + look.attitude.dot(slide[3:])).take(used), sigma.take(used),
            slide.take(used, axis=1).T, used, bands, look.pose, prior)
        return self._pass(look, weighed, ProfileFit(shift, sigma, found), used, tuple(learned))

    def measure_again(self, look: Look, first: Pass) -> Pass:
        """What a pass comes to without what it missed: profiles are true to small shifts only.

        The same pixels are measured again from the pose that the pass led to, which must not be
        so far that what stations slide by is no longer proportional to the step. Each station
        keeps its weight, and moves by as much as its group turns out to lie elsewhere.
        """
        bands, fit = look.bands, first.fit
        beside = look.beside(first.refinement.pose, first.refinement.attitude)
        weight = fit.sigma**-2.0
        shared = _by_group(weight * fit.shift, bands) / _by_group(weight, bands)
        missed, colours = np.empty(len(shared)), list(first.colours)
        for part, reading in look.read:
            shift, found, colours[part.colour] = fit_again(
                reading, part.bands, colours[part.colour], beside[part.own], rough=look.rough)
            missed[part.groups] = np.where(found, shift - shared[part.groups], 0.0)
        # What was missed is a part of the way.
        most = _MOST_MISSED * np.abs(beside)
        shift = fit.shift + np.minimum(np.maximum(missed.repeat(bands.members), -most), most)
        return self._pass(
            look, first.weighed, replace(fit, shift=shift), first.used, tuple(colours))

    def search(
        self, image: NDArray[np.uint8], start: Pose2, prior: Prior | None,
        colours: tuple[LineColour, ...], reach: float,
    ) -> Refinement | None:
        """Look for the tapes up to so many pixels beside where a pose predicts them, and solve.

        :param image: (H, W, 3) uint8 BGR.
        :param start: the predicted pose, T_map_base.
        :param colours: what the tapes look like, one for each class.
        :param reach: to either side, px.
        :returns: None where too few stations show one.
        """
        places = self.predictor.places(start, _SEARCHED_SPACING, _SEARCHED)
        bands, slide = self.predictor.bands(places, start)
        shift, found = np.zeros(len(bands)), np.zeros(len(bands), dtype=bool)
        for part in self._parts(bands):
            if len(part.bands) >= LEAST_STATIONS:
                fit = search_profiles(image, part.bands, colours[part.colour], reach)
                shift[part.own], found[part.own] = fit.shift, fit.found
        index, = found.nonzero()
        if len(index) < LEAST_STATIONS:
            return None
        measured = shift[index]
        return self._weigh(
            measured, np.ones(len(index)), slide[index], index, bands, start, prior,
        ).solve(measured)

    def _parts(self, bands: Bands) -> list[Part]:
        """The stations of each colour that any have."""
        if len(self.nominal_colours) == 1:
            return [Part(0, _ALL, _ALL, bands)]
        colour = self._colour_of_line[bands.label]
        return [Part(k, colour == k, (colour == k)[::bands.members], bands[colour == k])
                for k in np.unique(colour).tolist()]

    def _pass(
        self, look: Look, weighed: WeighedShifts, fit: ProfileFit, used: NDArray[np.intp],
        colours: tuple[LineColour, ...],
    ) -> Pass:
        by_attitude = look.slide[3:]
        refinement = weighed.solve((fit.shift + look.attitude.dot(by_attitude)).take(used))
        leant = (refinement.attitude - look.attitude).dot(by_attitude)
        moved = look.beside(refinement.pose, refinement.attitude)
        return Pass(weighed, refinement, look.bands, fit, used, float(np.abs(moved).max()), leant,
                    colours, self._whole)

    def _weigh(
        self, shift: Array, sigma: Array, slide: Array, index: NDArray[np.intp], bands: Bands,
        start: Pose2, prior: Prior | None,
    ) -> WeighedShifts:
        """Weigh what some stations say of the pose.

        :param shift: of them (N,), px.
        :param sigma: its standard deviation (N,), px.
        :param slide: d(shift)/d(x, y, yaw, z, roll, pitch) (N, 6).
        :param index: which of the bands they are (N,).
        """
        options, image_sigma = self._options, None
        if options.calibration_sigma > 0.0:
            image_sigma = options.calibration_sigma * bands.across.take(index, axis=0)
        return weigh_shifts(
            shift, sigma, slide, index // bands.members, bands.label.take(index), start,
            prior=prior, attitude_sigma=(options.height_sigma, options.tilt_sigma),
            image_sigma=image_sigma)


def _by_group(values: Array, bands: Bands) -> Array:
    """Sums over each group (G,) of what stations have (N,)."""
    return values.reshape(-1, bands.members).sum(axis=1)
