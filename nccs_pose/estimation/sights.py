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

"""One look at an image after the other, until one shows where the robot can be."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

from nccs_pose.estimation.association import ALL_STRIPS, FittedCandidate
from nccs_pose.estimation.floor_segments import FloorSegment
from nccs_pose.estimation.frame import Frame
from nccs_pose.estimation.gate import Gate
from nccs_pose.estimation.ledger import AS_MUCH
from nccs_pose.estimation.many_poses import Poses
from nccs_pose.estimation.search import Searcher
from nccs_pose.vision.colour import LineColour
import numpy as np
from numpy.typing import NDArray

# A best pose with this score leaves nothing to look for; one with half of that is worth a try when
# the next scores less than this part of it.
_PLAIN = 0.8
_RIVAL = 0.8
# A place is one of many when more poses than this score so and leave none of so many strips
# unexplained.
_MANY = 6
_LEAST_STRIPS = 3


@dataclass(frozen=True, eq=False)
class Sight:
    """What a look at an image shows.

    :ivar image: (H, W, 3) uint8 BGR.
    :ivar segments: the strips in it.
    :ivar candidates: poses that explain them, best first.
    :ivar others: poses that leave no strip unexplained, but were not looked at as closely.
    :ivar colours: what tapes look like to begin with.
    """

    image: NDArray[np.uint8]
    segments: tuple[FloorSegment, ...]
    candidates: tuple[FittedCandidate, ...]
    others: Poses
    colours: tuple[LineColour, ...]

    @property
    def promise(self) -> float:
        """Score of the best pose, 0 if there is none."""
        return self.candidates[0].score if self.candidates else 0.0

    @property
    def is_promising(self) -> bool:
        """Whether the best pose leaves little to look for, or is far better than all others.

        No rival of one that leaves no strip unexplained is what leaves some.
        """
        if self.promise > _PLAIN or self.promise <= 0.5 * _PLAIN:
            return self.promise > _PLAIN
        best, *others = self.candidates
        least = best.claimed - AS_MUCH if best.claimed > ALL_STRIPS else 0.0
        return not any(
            c.score >= _RIVAL * best.score and c.claimed >= least for c in others)

    @property
    def is_of_many_places(self) -> bool:
        """Whether many places show all that is seen here: more of it would tell none of them."""
        equal = [c for c in self.candidates
                 if c.claimed > ALL_STRIPS and c.score > _RIVAL * self.promise]
        return len(equal) > _MANY and len(self.segments) >= _LEAST_STRIPS


def sights(
    frame: Frame, searcher: Searcher, colours: tuple[LineColour, ...], gate: Gate | None, *,
    in_vain: int,
) -> Iterator[Sight]:
    """Look at an image in one way after the other, for sights on which poses are worth a try.

    Worth a try are promising sights or, if there is none, the best of all. So is one that many
    places show alike: it may prove at once that the image decides nothing. If it seemed to decide,
    it comes again at the end, when nothing better was seen.

    A look costs time: try what it shows before the next is asked for.

    :param colours: what tapes look like to begin with.
    :param gate: where the robot is by something else than the image.
    :param in_vain: how many images before this one were searched and showed nothing; from one to
        the next the groups of further looks take turns.
    """
    groups = searcher.further
    further = groups[in_vain % len(groups)] if groups else ()
    best: Sight | None = None
    tried: list[Sight] = []
    view = searcher.view(frame.image)
    for look in (searcher.first, *further):
        segments, shown = look(view, best.segments if best is not None else (), colours)
        if best is not None and segments is best.segments:
            continue
        frame.watch.lap('detect')
        sight = Sight(frame.image, segments, *searcher.candidates(segments, gate), shown)
        frame.watch.lap('associate')
        if best is None or sight.promise > best.promise:
            best = sight
        elif shown is not colours:
            # What tapes look like was learned, if not more of them found.
            sight = best = replace(best, colours=shown)
        if sight.is_promising:
            tried.append(sight)
        if sight.is_promising or sight.is_of_many_places:
            yield sight
        if len(tried) > 1 and best.promise > _PLAIN:
            return
    if best is not None and best not in tried:
        yield best
