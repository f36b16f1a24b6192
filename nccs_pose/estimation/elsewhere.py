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

"""Whether an image that agrees with an expected pose shows another place as well, or better."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import islice

from nccs_pose.estimation.aligner import Aligner
from nccs_pose.estimation.alignment import Alignment, leaves_open
from nccs_pose.estimation.association import Candidates, FittedCandidate
from nccs_pose.estimation.case import SEARCH_BAND
from nccs_pose.estimation.gate import BETTER, Gate
from nccs_pose.estimation.judge import fit_of
from nccs_pose.estimation.ledger import Refused
from nccs_pose.estimation.many_poses import Poses, same_pose, unlike
from nccs_pose.estimation.motion import Prediction
from nccs_pose.estimation.observability import parallel_to
from nccs_pose.estimation.options import LocaliserOptions
from nccs_pose.estimation.search import Searcher, Strips
from nccs_pose.estimation.shift_solve import Prior
from nccs_pose.estimation.verdict import contradiction, is_suspect, Objection
from nccs_pose.geometry.lines import LineMap
from nccs_pose.geometry.pose import Array, Pose2
import numpy as np
from numpy.typing import NDArray

# Lines across which a pose is laid on the next parallel one are so far apart at least, metres.
_APART = 0.1
# So many other poses are laid on an image: of those across parallel lines the nearest, of those of
# which strips show more the best.
_TRIED = 4
# A place where the robot may be lies within so many deviations of a vague prediction: what that
# reckons with is the most that a robot does, not what it happens to do.
_GATE = 3.0
# Lines lie better elsewhere if they explain so much more there, counting how well they lie.
_FITS_BETTER = 0.05
_FITS_ELSEWHERE = Objection('its lines lie better on another pose')
_ANOTHER = Objection('another pose explains the image better')
_AS_WELL = Objection('another place where the robot may be by now explains the image as well')


def leaves_room(alignment: Alignment, claimed: float) -> bool:
    """Whether a pose leaves so much unexplained that another could explain more.

    :param claimed: fraction of the line-coloured pixels that lie on its lines.
    """
    # No score exceeds 1.
    return bool(alignment.missing) or min(claimed, alignment.explained) + BETTER < 1.0


class Elsewhere:
    """Looks for other places, on one map, that an image shows."""

    def __init__(
        self, aligner: Aligner, searcher: Searcher, line_map: LineMap, options: LocaliserOptions,
    ) -> None:
        self._aligner = aligner
        self._searcher = searcher
        self._map = line_map
        self._options = options

    def refused(
        self, image: NDArray[np.uint8], alignment: Alignment, prediction: Prediction,
        segments: Strips,
    ) -> Refused | None:
        """What the whole image says against a pose that was laid on it; None if nothing.

        A prediction that is sure decides between places that look the same; where it is vague
        there may be several of them where the robot can be.

        :param image: (H, W, 3) uint8 BGR.
        :param segments: the strips in it.
        """
        against = contradiction(alignment, segments, self._map)
        if against is not None:
            return Refused(against, alignment)
        if is_suspect(alignment) and self._fits_better(image, alignment, segments):
            # Without the alignment, which others would have to beat by what they explain.
            return Refused(_FITS_ELSEWHERE, misled=True)
        vague = prediction.is_vague
        here, claimed = self._searcher.score(alignment.pose, segments)
        if not vague and here + BETTER >= 1.0:
            return None
        sigmas = min(_GATE, self._options.innovation_gate)
        gate = Gate(prediction.pose, prediction.covariance, sigmas)
        found = self._searcher.candidates(segments, gate if vague else None)
        better = (c for c in found.fitted if c.score > here + BETTER)
        if self._explains_more(image, alignment, claimed, better):
            return Refused(_ANOTHER, alignment)
        if vague and (self._shows_as_much(found, alignment, here, gate)
                      or self._is_one_of_parallels(image, alignment, prediction, gate)):
            # Without the alignment, which others would have to beat: it is no worse than they are.
            return Refused(_AS_WELL)
        return None

    def _explains_more(
        self, image: NDArray[np.uint8], alignment: Alignment, claimed: float,
        others: Iterable[FittedCandidate],
    ) -> bool:
        """Whether one of the poses of which strips show more does so on the image as well.

        Strips miss what is far or thin, so that of a map with many lines they show most where it
        has fewest: from its edge.

        :param claimed: which part of the strips the pose itself explains.
        """
        least = min(claimed, alignment.explained) + BETTER
        promising = (c for c in others
                     if c.claimed > least and not same_pose(c.pose, alignment.pose))
        for candidate in islice(promising, _TRIED):
            other = self._aligner.align(
                image, candidate.pose, alignment.colours, reach=SEARCH_BAND)
            if other is not None and other.explained > least and not same_pose(
                    other.pose, alignment.pose):
                return True
        return False

    def _fits_better(
        self, image: NDArray[np.uint8], alignment: Alignment, segments: Strips,
    ) -> bool:
        """Whether the lines lie better on a place from where the map looks nearly the same."""
        here = _worth(alignment)
        for place in self._searcher.taken_for(alignment.pose, segments):
            other = self._aligner.align(
                image, place.pose, alignment.colours, reach=SEARCH_BAND)
            if other is None or same_pose(other.pose, alignment.pose):
                continue
            if _worth(other) > here + _FITS_BETTER:
                return True
        return False

    def _shows_as_much(
        self, found: Candidates, alignment: Alignment, here: float, gate: Gate,
    ) -> bool:
        """Whether strips show as much of another pose inside the gate."""
        least = self._options.ambiguity_ratio * here
        others = found.others[unlike(found.others, Poses.of([alignment.pose]))]
        return bool(gate.contains_each(others).any()) or any(
            c.score >= least and gate.contains(c.pose) and not same_pose(c.pose, alignment.pose)
            for c in found.fitted)

    def _is_one_of_parallels(
        self, image: NDArray[np.uint8], alignment: Alignment, prediction: Prediction, gate: Gate,
    ) -> bool:
        """Whether a pose on parallel lines alone lies as well on others inside the gate.

        These fix no pose, so that no search of the whole image finds them.
        """
        if not leaves_open(alignment.refinement):
            return False
        least = self._options.ambiguity_ratio * alignment.explained
        places = (Pose2(alignment.pose.x + x, alignment.pose.y + y, alignment.pose.yaw)
                  for x, y in self._steps_across(alignment.lines[0]).tolist())
        for pose in islice(filter(gate.contains, places), _TRIED):
            other = self._aligner.align(
                image, pose, alignment.colours, reach=self._options.band,
                prior=Prior(pose, prediction.information))
            if other is not None and other.explained >= least:
                return True
        return False

    def _steps_across(self, line: int) -> Array:
        """What lays a map's lines on parallel ones of their colour (K, 2), metres, least first."""
        normal = self._map[line].left[:2]
        parallel = parallel_to(self._map[line].direction, self._map.directions)
        parallel &= np.array([other.colour == self._map[line].colour for other in self._map])
        across = self._map.starts[parallel, :2] @ normal
        steps = np.unique(np.round((across[:, None] - across) / _APART)) * _APART
        steps = steps[steps != 0.0]
        return steps[np.argsort(np.abs(steps)), None] * normal


def _worth(alignment: Alignment) -> float:
    """How much a pose explains of what should be seen, counting how well its lines lie."""
    return alignment.explained * fit_of(alignment.points.variance)
