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
from dataclasses import dataclass, replace
from functools import lru_cache

from nccs_pose.estimation.alignment import Alignment, close, leaves_open, Pass
from nccs_pose.estimation.measuring import LEAST_STATIONS, LINEAR_PX, Measurer
from nccs_pose.estimation.options import LocaliserOptions
from nccs_pose.estimation.prediction import BandPredictor, Places
from nccs_pose.estimation.shift_solve import Prior
from nccs_pose.geometry.floor_table import FloorTable
from nccs_pose.geometry.lines import LineMap
from nccs_pose.geometry.pose import Array, Pose2
from nccs_pose.vision.colour import LineColour
from nccs_pose.vision.profiles import ROUGH_BLUR
import numpy as np
from numpy.typing import NDArray

# Stations stand no closer in the image than this, px; of a short piece there are fewer.
SPACING = 2.0
# To follow a robot, stations are chosen for poses on a lattice of this spacing, m and rad: from
# anywhere near one of these they look about as evenly spaced, and most images need no new choice.
# So many choices are remembered, as a robot may stand where several meet.
_CHOSEN_APART = (0.25, 0.4)
_REMEMBERED = 4
# Where the image is sharp, so that a tape is found from nearby only, or the start is a little off,
# a first, rough pass takes one station in so many.
_FEW = 4
# Where more curve than this is in view, px, these few show what tapes look like as well, and a
# second pass takes one in so many.
_LONG = 2000.0
_MORE = 2
# A start that should be off by LINEAR_PX at most, but is moved by more than this, px, in its first
# pass is nowhere near.
_ASTRAY_PX = 5.0
# Poses this close, m and rad, are refined to the same one.
_SAME = (0.01, 0.005)
_ITERATIONS = 8
# A pose has settled when its last step moved no station by more than this share of the blur, or
# was below half a standard deviation. (Profiles miss a hundredth or two of a larger shift, all of
# them alike: three times this share cost half a standard deviation.)
_SETTLED_BLURS = 0.1
_SETTLED = 0.5
# To follow a robot one pass is enough if it misses less of its step than so many standard
# deviations. It misses the part MISSED, and MISSED_BEYOND times the square of the blurs that it
# moves a station by.
_FOLLOWED = 0.2
_MISSED = 0.01
_MISSED_BEYOND = 0.05
# No pose has settled in a pass that learned a blur so different, px, from the one it went by: a
# template too soft or too sharp takes a step for larger or smaller than it is.
_LEARNED_BLUR = 0.1
# Up to a step so large, px, what stations slide by is proportional to it: they are measured again
# without a look at the image.
_SLIDING_PX = 1.0
# After a step larger than this the stations are chosen anew, px.
_MOVED_PX = 3.0
# A pose that still moves in the last pass is given if it does by less than this, m and rad; it is
# uncertain by that step besides.
_LAST_STEP = 0.005
# A pose has to rest on so much curve, px.
_LEAST_LENGTH = 192.0
# From its first pass on, a pose that is searched has to show this part of what it must in the end.
_AT_FIRST = 0.8
# A pass that moves no station further than this, px, shows the lines that the last will.
_NEARLY = 1.0


@dataclass(frozen=True, eq=False)
class _State:
    """What is known of a pose from one pass over an image to the next.

    :ivar pose: T_map_base.
    :ivar attitude: of the base off its plane, (z, roll, pitch) (3,), metres and rad.
    :ivar colours: what the tapes look like.
    :ivar is_tried: whether a pass over some of the stations has been made.
    """

    pose: Pose2
    attitude: Array
    colours: tuple[LineColour, ...]
    is_tried: bool = False


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
        prior: Prior | None = None,
        hopeless: Callable[[Alignment], bool] | None = None,
        laid: Pose2 | None = None,
    ) -> Alignment | None:
        """Lay a pose on the image from a start near it.

        :param image: (H, W, 3) uint8 BGR.
        :param reach: how far off the start may be, px. Beyond two pixels bands of this half width
            are searched first; 0 is for a start that is most likely right.
        :param prior: carries the directions that the lines in view do not fix.
        :param hopeless: says of a pose that has nearly settled whether it is refused in any case.
            If so it is given as it is, which saves the last passes; so is one of which the lines
            leave a direction open.
        :param laid: the pose that the same start came to with a smaller reach. A search is not
            followed if it leads there, or back to the start, or leaves a direction open.
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
        begun = self._begun(image, places, _State(pose, np.zeros(3), colours), prior, reach)
        return None if begun is None else self._settled(
            image, places, begun, prior, followed=reach == 0.0, hopeless=hopeless)

    def _settled(
        self, image: NDArray[np.uint8], places: Places, state: _State, prior: Prior | None, *,
        followed: bool, hopeless: Callable[[Alignment], bool] | None,
    ) -> Alignment | None:
        """Pass over an image until the pose moves no more, or will be refused in any case.

        :param places: where the stations stand to begin with.
        :param followed: whether the start is most likely right: one pass may do.
        :param hopeless: as of :meth:`align`.
        """
        before = state.pose
        for k in range(_ITERATIONS):
            look = self._measurer.look(image, places, state.pose, state.attitude, state.colours)
            if look is None:
                return None
            measured = self._measurer.measure(look, prior, state.colours)
            if measured is None or measured.length < _LEAST_LENGTH:
                return None
            if not followed and (measured.alignment.explained
                                 < _AT_FIRST * self._options.least_explained):
                return None
            pose, covariance = measured.refinement.pose, measured.refinement.covariance
            steady = _is_steady(state.colours, measured.colours)
            blurs = measured.moved / _sharpest(measured.colours)
            # The pass has missed about this part of its step.
            part = _MISSED + _MISSED_BEYOND * blurs**2
            if steady and (blurs < _SETTLED_BLURS or close(
                    pose, state.pose, covariance, _FOLLOWED / part if followed else _SETTLED)):
                return measured.alignment
            if hopeless is not None and _is_in_vain(
                    measured, hopeless, steady=steady, first=k == 0, tried=state.is_tried):
                return measured.alignment
            # Measured again, it misses that part of that part.
            if followed and steady and measured.moved < _SLIDING_PX and close(
                    pose, state.pose, covariance, _FOLLOWED / part**2):
                return self._measurer.measure_again(look, measured).alignment
            # Stations that come and go near their thresholds can keep it stepping to and fro
            # between two poses: it stops at the one where the last of all passes would end.
            returns = (_ITERATIONS - k) % 2 == 1 and steady and close(
                pose, before, covariance, _SETTLED)
            last, before, state = measured, state.pose, _State(
                pose, measured.refinement.attitude, measured.colours, state.is_tried)
            if returns:
                break
            if measured.moved > _MOVED_PX:
                places = self._places(pose)
        step = state.pose.minus(before)
        if np.abs(step).max() > _LAST_STEP:
            return None
        return replace(last.alignment, covariance=covariance + np.outer(step, step))

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
        self, image: NDArray[np.uint8], start: Pose2, prior: Prior | None,
        colours: tuple[LineColour, ...], reach: float, laid: Pose2 | None,
    ) -> Pose2 | None:
        """Where a search across the bands leads; None where to nothing, or to nothing new."""
        # About as much is in view from where it leads.
        if self._places(start).length < _AT_FIRST * _LEAST_LENGTH:
            return None
        searched = self._measurer.search(image, start, prior, colours, reach)
        if searched is None or (laid is not None and (
                leaves_open(searched) or _near(searched.pose, laid)
                or _near(searched.pose, start))):
            return None
        return searched.pose

    def _begun(
        self, image: NDArray[np.uint8], places: Places, start: _State, prior: Prior | None,
        reach: float,
    ) -> _State | None:
        """What to go on from with all stations.

        A start that may be off is corrected by passes over some of them, until all would hardly
        say anything else. None where it may be off, and too little is found.
        """
        inexact = _sharpest(start.colours) < ROUGH_BLUR or 0.0 < reach <= LINEAR_PX
        long = reach > 0.0 and places.length > _LONG
        if not (inexact or long) or len(places) < _FEW * LEAST_STATIONS:
            return start
        followed, state = reach == 0.0, start
        if followed:
            # It may be so far off that it takes two.
            steps: tuple[int, ...] = (_FEW, _FEW)
        else:
            steps = (_FEW, _MORE) if long else (_FEW,)
        for k, step in enumerate(steps):
            sharpest = _sharpest(state.colours)
            look = self._measurer.look(
                image, places.every(step), state.pose, state.attitude, state.colours,
                rough=not long or (k == 0 and sharpest < ROUGH_BLUR))
            measured = None if look is None else self._measurer.measure(
                look, prior, state.colours)
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
            # A lean so small that profiles bear it needs no bands of its own.
            leans = np.abs(measured.leant).max() > _SETTLED_BLURS * sharpest
            before, state = state, _State(
                measured.refinement.pose,
                measured.refinement.attitude if leans else state.attitude, measured.colours,
                is_tried=True)
            if near and _is_steady(before.colours, state.colours):
                break
        return state


def _is_in_vain(
    measured: Pass, hopeless: Callable[[Alignment], bool], *, steady: bool, first: bool,
    tried: bool,
) -> bool:
    """Whether a pose will be refused in any case, though it has not settled.

    The first pass learns what tapes look like, and may miss what the next one finds. If it misses
    nothing, which way lines run does not depend on how blurred they are.

    :param hopeless: as of :meth:`Aligner.align`.
    :param steady: whether the pass learned hardly another blur than was known.
    :param first: whether it is the first over all stations.
    :param tried: whether one over some of them came before.
    """
    alignment = measured.alignment
    if measured.moved >= LINEAR_PX:
        return False
    if (not first or (tried and not alignment.missing)) and (
            steady or alignment.is_sharp) and leaves_open(measured.refinement):
        return True
    return not first and steady and measured.moved < _NEARLY and hopeless(alignment)


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
