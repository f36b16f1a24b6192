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

"""A pose made exact against one image: predict the bands, measure the profiles, refine."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache

from nccs_pose.estimation.alignment import Alignment, close, leaves_open
from nccs_pose.estimation.measuring import LEAST_STATIONS, LINEAR_PX, Measurer
from nccs_pose.estimation.options import LocaliserOptions
from nccs_pose.estimation.prediction import BandPredictor, Places
from nccs_pose.geometry.floor_table import FloorTable
from nccs_pose.geometry.lines import LineMap
from nccs_pose.geometry.pose import Array, Pose2
from nccs_pose.vision.colour import LineColour
from nccs_pose.vision.profiles import ROUGH_BLUR
import numpy as np
from numpy.typing import NDArray

# Stations stand no closer in the image than this, px; of a short piece there are fewer.
SPACING = 2.0
# To follow a robot they are chosen for poses so far apart, m and rad: one in between sees those of
# the nearest about as evenly spaced, and a robot has moved so little in most images that no others
# are needed. So many choices are remembered, as it may stand where two meet.
_CHOSEN_APART = (0.25, 0.4)
_REMEMBERED = 4
# Where the image is sharp, so that a tape is felt from nearby only, or the start a little off, a
# first, rough pass takes one station of so many. On more curve than this, px, these few show what
# tapes look like as well, and a second pass takes some too.
_SOME = (4, 2)
_LONG = 2000.0
# What a first pass moves a start by more than this, px, that should be off by less than that, is
# nowhere near.
_ASTRAY_PX = 5.0
# A search that ends this near a pose, m and rad, is refined to it.
_SAME = (0.01, 0.005)
_ITERATIONS = 8
# The poses have settled when the last step moved no station by more than this share of the blur
# (profiles miss a hundredth or two of a larger shift, all of them alike: three times as much cost
# half a standard deviation), or when it was below half a standard deviation.
_SETTLED_BLURS = 0.1
_SETTLED = 0.5
# Of a robot that is followed one pass is enough if it misses no more of its step than so many
# standard deviations: this part of it and, times the square of the blurs that it moves a station
# by, that part.
_FOLLOWED = 0.2
_MISSED = 0.01
_MISSED_BEYOND = 0.05
# Nor does a pass count that has just learned a blur so different, px: a template too soft or too
# sharp takes a step for larger or smaller than it is.
_LEARNED_BLUR = 0.1
# Up to a step so large, px, what stations slide by is proportional to it: they are measured again
# without a look at the image.
_SLIDING_PX = 1.0
# After a step larger than this the stations are chosen anew, px.
_MOVED_PX = 3.0
# What still steps at the end, by less than this (m and rad), is uncertain by that much more.
_LAST_STEP = 0.005
# A pose rests on so much of curve, px.
_LEAST_LENGTH = 192.0
# Of a searched pose this part of what must be found at the end has to be found from the first.
_HOPELESS = 0.8
# A pass that moves no station further than this, px, shows the lines that the last will.
_NEARLY = 1.0


class Aligner:
    """Lays poses on images for one rig and map."""

    def __init__(self, table: FloorTable, line_map: LineMap, options: LocaliserOptions) -> None:
        self._measurer = Measurer(table, line_map, options)
        # Lines are counted before they are measured.
        self._places = lru_cache(1)(self._places_for)
        self._chosen = lru_cache(_REMEMBERED)(self._choose)
        self._options = options

    @property
    def predictor(self) -> BandPredictor:
        """What tells where the map's tapes are seen."""
        return self._measurer.predictor

    @property
    def nominal_colours(self) -> tuple[LineColour, ...]:
        """The map's colours before any image."""
        return self._measurer.nominal_colours

    def align(
        self,
        image: NDArray[np.uint8],
        start: Pose2,
        colours: tuple[LineColour, ...],
        *,
        reach: float = 0.0,
        prior: tuple[Pose2, Array] | None = None,
        hopeless: Callable[[Alignment], bool] | None = None,
        laid: Pose2 | None = None,
    ) -> Alignment | None:
        """Lay a pose on the image from a start near it.

        :param image: (H, W, 3) uint8 BGR.
        :param reach: how far off the start may be, px. Beyond two pixels bands of this half width
            are searched first; 0 is for a start that is most likely right.
        :param prior: a pose with its information (3, 3): carries the directions that the lines in
            view do not fix.
        :param hopeless: whether a pose that will not move any further is refused in any case: one
            that is comes back as it is, before it has settled; so does one of which a direction
            is left open.
        :param laid: what the start was laid to by what is near its place. No search is followed
            that leads there, or to the start again, or that leaves a direction of the pose open.
        :returns: None where too little of what the start predicts is found, where a search leads
            to nothing new, or where the poses do not settle.
        """
        pose = start
        if reach > LINEAR_PX:
            searched = self._searched(image, start, prior, colours, reach, laid)
            if searched is None:
                return None
            pose = searched
        places = self._places(pose) if reach > 0.0 else self._places_near(pose)
        if len(places) < LEAST_STATIONS or places.length < _LEAST_LENGTH:
            return None
        begun = self._begun(image, places, pose, prior, colours, reach)
        if begun is None:
            return None
        tried = begun[0] is not pose
        pose, attitude, colours = begun
        before = pose
        for k in range(_ITERATIONS):
            look = self._measurer.look(image, places, pose, attitude, colours)
            if look is None:
                return None
            measured = self._measurer.measure(look, prior, colours)
            if measured is None or measured.length < _LEAST_LENGTH:
                return None
            known, colours = colours, measured.colours
            result, last = measured.refinement, measured
            if reach > 0.0 and (measured.alignment.explained
                                < _HOPELESS * self._options.least_explained):
                return None
            steady, blurs = _is_steady(known, colours), measured.moved / _sharpest(colours)
            part = _MISSED + _MISSED_BEYOND * blurs**2
            settled = steady and (blurs < _SETTLED_BLURS or close(
                result.pose, pose, result.covariance,
                _SETTLED if reach > 0.0 else _FOLLOWED / part))
            # The first pass learns what tapes look like, and may miss what the next one finds. If
            # it misses nothing, which way lines run does not depend on how blurred they are.
            if hopeless is not None and measured.moved < LINEAR_PX:
                settled = settled or (
                    (k > 0 or (tried and not measured.alignment.missing))
                    and (steady or measured.alignment.is_sharp) and leaves_open(result)) or (
                    k > 0 and steady and measured.moved < _NEARLY
                    and hopeless(measured.alignment))
            if settled:
                return measured.alignment
            # Measured again, it misses that part of that part.
            if reach == 0.0 and steady and measured.moved < _SLIDING_PX and close(
                    result.pose, pose, result.covariance, _FOLLOWED / part**2):
                return self._measurer.measure_again(look, measured).alignment
            # Stations that come and go near their thresholds can keep it stepping to and fro: it
            # ends as the last pass would.
            returns = (_ITERATIONS - k) % 2 == 1 and steady and close(
                result.pose, before, result.covariance, _SETTLED)
            before, pose, attitude = pose, result.pose, result.attitude
            if returns:
                break
            if measured.moved > _MOVED_PX:
                places = self._places(pose)
        step = pose.minus(before)
        if np.abs(step).max() > _LAST_STEP:
            return None
        return replace(
            last.alignment, covariance=result.covariance + np.outer(step, step))

    def lines_in_view(self, pose: Pose2) -> int:
        """How many lines a pose says that an image shows."""
        return len(np.unique(self._places(pose).number))

    def _places_for(self, pose: Pose2) -> Places:
        """Stations for a pose, chosen for it."""
        return self._measurer.predictor.places(pose, SPACING, self._options.stations)

    def _places_near(self, pose: Pose2) -> Places:
        """The same, chosen for the nearest pose of a lattice."""
        metres, radians = _CHOSEN_APART
        return self._chosen(
            round(pose.x / metres), round(pose.y / metres), round(pose.yaw / radians))

    def _choose(self, column: int, row: int, turn: int) -> Places:
        metres, radians = _CHOSEN_APART
        return self._places(Pose2(metres * column, metres * row, radians * turn))

    def _searched(
        self, image: NDArray[np.uint8], start: Pose2, prior: tuple[Pose2, Array] | None,
        colours: tuple[LineColour, ...], reach: float, laid: Pose2 | None,
    ) -> Pose2 | None:
        """Where a search across the bands leads; None where to nothing, or to nothing new."""
        # About as much is in view from where it leads.
        if self._places(start).length < _HOPELESS * _LEAST_LENGTH:
            return None
        searched = self._measurer.search(image, start, prior, colours, reach)
        if searched is None or (laid is not None and (
                leaves_open(searched) or _near(searched.pose, laid)
                or _near(searched.pose, start))):
            return None
        return searched.pose

    def _begun(
        self, image: NDArray[np.uint8], places: Places, start: Pose2,
        prior: tuple[Pose2, Array] | None, colours: tuple[LineColour, ...], reach: float,
    ) -> tuple[Pose2, Array, tuple[LineColour, ...]] | None:
        """The pose, the base's attitude and the colours to go on from.

        Where the start may be off they are of passes over some of the stations, until all will
        hardly say anything else. None where it may be, and too little is found.
        """
        pose, attitude = start, np.zeros(3)
        inexact = _sharpest(colours) < ROUGH_BLUR or 0.0 < reach <= LINEAR_PX
        long = reach > 0.0 and places.length > _LONG
        if not (inexact or long) or len(places) < _SOME[0] * LEAST_STATIONS:
            return pose, attitude, colours
        followed = reach == 0.0
        # A robot that is followed may be so far off that it takes two.
        for k, step in enumerate(_SOME[:1] * 2 if followed else _SOME[:1 + long]):
            sharpest = _sharpest(colours)
            look = self._measurer.look(
                image, places.every(step), pose, attitude, colours,
                rough=not long or (k == 0 and sharpest < ROUGH_BLUR))
            measured = None if look is None else self._measurer.measure(look, prior, colours)
            if look is None or measured is None:
                if inexact and reach > 0.0:
                    return None
                break
            if 0.0 < reach <= LINEAR_PX and measured.moved > _ASTRAY_PX:
                return None
            near = measured.moved < LINEAR_PX
            # Of a step within the blur a rough pass misses less than settled poses may differ by.
            if followed and near and measured.moved > sharpest:
                measured = self._measurer.measure_again(look, measured)
            # What profiles bear needs no bands of its own.
            leans = np.abs(measured.leant).max() > _SETTLED_BLURS * sharpest
            pose, attitude = measured.refinement.pose, (
                measured.refinement.attitude if leans else attitude)
            known, colours = colours, measured.colours
            if near and _is_steady(known, colours):
                break
        return pose, attitude, colours


def _near(a: Pose2, b: Pose2) -> bool:
    """Whether two poses are so near that passes lead from either to the same."""
    x, y, yaw = np.abs(a.minus(b)).tolist()
    return bool(max(x, y) < _SAME[0] and yaw < _SAME[1])


def _sharpest(colours: tuple[LineColour, ...]) -> float:
    """The least blur of colours, px."""
    return min(colour.blur for colour in colours)


def _is_steady(known: tuple[LineColour, ...], learned: tuple[LineColour, ...]) -> bool:
    """Whether a pass learned hardly another blur than was known."""
    return max(abs(a.blur - b.blur) for a, b in zip(known, learned)) < _LEARNED_BLUR
