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

"""Whether an image may show another place than a pose that holds on it.

Lines and strips that lie on one pose may lie on others too, where the map looks nearly the same.
On a sharp image the lines of the right one alone lie well; a coarse one leaves doubts.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import chain, islice

from nccs_pose.estimation.aligner import Aligner
from nccs_pose.estimation.alignment import Alignment
from nccs_pose.estimation.association import FittedCandidate
from nccs_pose.estimation.case import Case, Start, TRIED
from nccs_pose.estimation.judge import Found, Judge
from nccs_pose.estimation.ledger import ABOUT_AS_MUCH, AS_MUCH
from nccs_pose.estimation.many_poses import same_pose
from nccs_pose.estimation.options import LocaliserOptions
from nccs_pose.estimation.search import Searcher
from nccs_pose.estimation.verdict import lines_used, Objection
from nccs_pose.geometry.pose import Pose2

# On an image too coarse to show by itself which of two poses is right, how well lines lie tells
# only those apart that explain more than this of what should be seen and of what is, by three
# lines or more, and no more where one that lies on it was refused.
_PLAINLY_ALL = 0.9
# Nor does it tell a pose from one that shows as much, or this part of it.
_EQUALLY = 0.98
_DOUBTFUL = Objection(
    'its lines lie badly on the image, and another pose shows about as much', hidden=True)
_ON_A_CORNER = Objection(
    'it rests on two lines, and the image shows as much of another pose', hidden=True)
_TWO_COARSE = Objection('it rests on two lines, and they lie badly on the image', hidden=True)
_INCOMPLETE = Objection(
    'its lines lie badly on the image, and others that should be in view are not there',
    hidden=True)
# What rivals alone say against a pose.
DOUBTS = (_DOUBTFUL, _ON_A_CORNER, _TWO_COARSE)


class Rivals:
    """Looks for rivals of poses that hold on images of one rig and map."""

    def __init__(
        self, aligner: Aligner, searcher: Searcher, judge: Judge, symmetries: tuple[Pose2, ...],
        options: LocaliserOptions,
    ) -> None:
        """Prepare.

        :param symmetries: motions of the map that change nothing, without the identity.
        """
        self._aligner = aligner
        self._searcher = searcher
        self._judge = judge
        self._symmetries = symmetries
        self._options = options

    def doubt(self, case: Case, found: Found, *, has_refused: bool) -> Objection | None:
        """Why a pose that nothing predicted may be the wrong one; None if nothing is as good.

        On a sharp image three lines or more lie well on the right pose alone. Two lie well on any
        corner: no rival may show as much of the strips.

        On a coarse image lines lie badly on any pose, and how badly says little. Two lines then
        say nothing. Of a pose on three or more, all lines that should be in view have to be
        there, as the right pose may not have been tried: strips lie askew. And no other candidate
        may show as much by strips alone; only of a pose that explains nearly all, which leaves
        little to stand out by, they must show as much laid on the image as well. So must, in
        either case, places from where the map looks nearly the same.

        Where many places show as much, the image decides nothing, and there is no doubt to raise.

        :param has_refused: whether a pose that lies on the image was refused.
        """
        alignment, candidates = found.alignment, case.sight.candidates
        sharp, few = alignment.is_sharp, lines_used(alignment) < 3
        if sharp and not few:
            return None
        plain = not few and not has_refused and (
            min(found.claimed, alignment.explained) > _PLAINLY_ALL)
        if alignment.missing and not (plain or sharp):
            return _INCOMPLETE
        if case.gate is None and self.are_many(found, candidates):
            return None
        if few and not sharp:
            return _TWO_COARSE
        if sharp:
            alike = self._searcher.taken_for(alignment.pose, case.sight.segments)
            return _ON_A_CORNER if self._by_strips(found, (*candidates, *alike)) else None
        rivals = self._by_strips(found, candidates)
        if rivals and not plain:
            return _DOUBTFUL
        least_score = self._options.ambiguity_ratio * found.score if plain else 0.0
        doubted = any(
            self._shows_as_much(case, rival, found, least_score)
            for rival in _distinct(chain(rivals, self.taken_for(case, alignment))))
        return _DOUBTFUL if doubted else None

    def taken_for(self, case: Case, alignment: Alignment) -> Iterator[Start]:
        """From where the map looks nearly the same as from a pose that was laid on the image."""
        return map(Start.of, self._searcher.taken_for(alignment.pose, case.sight.segments))

    def are_many(self, held: Found, candidates: Sequence[FittedCandidate]) -> bool:
        """Whether more places than are laid on an image show as much as one that holds.

        Then it decides nothing, and those that it shows are all among the candidates.
        """
        least = self._options.ambiguity_ratio * held.by_strips
        equal = (c for c in candidates
                 if c.score >= least and not same_pose(c.pose, held.alignment.pose))
        return len(list(islice(equal, TRIED + 1))) > TRIED

    def _by_strips(self, found: Found, candidates: Sequence[FittedCandidate]) -> list[Start]:
        """Those of which the strips show as much as of a pose that holds."""
        least = self._options.ambiguity_ratio * found.by_strips
        return [
            Start.of(c) for c in candidates
            if c.score >= least and c.claimed > found.claimed - AS_MUCH
            and not self._are_alike(c.pose, found.alignment.pose)]

    def _are_alike(self, a: Pose2, b: Pose2) -> bool:
        """Whether two poses are the same, or twins on a symmetric map, which no image parts."""
        return any(same_pose(a, twin) for twin in (b, *(s @ b for s in self._symmetries)))

    def _shows_as_much(
        self, case: Case, rival: Start, found: Found, least_score: float,
    ) -> bool:
        """Whether a rival shows about as much, laid on the image, as a pose that holds.

        :param least_score: that one which shows less has to reach besides, for how well its lines
            lie.
        """
        least = ABOUT_AS_MUCH * found.shown
        for reach in rival.reaches:
            # What tapes look like is known by now.
            alignment = self._aligner.align(
                case.sight.image, rival.pose, found.alignment.colours, reach=reach)
            if alignment is None or self._are_alike(alignment.pose, found.alignment.pose):
                continue
            measured = self._judge.measured(
                alignment, case.sight.segments, rival.kept(alignment.pose))
            if measured.shown >= least and (
                    measured.score >= least_score or measured.shown > _EQUALLY * found.shown):
                return True
        return False


def _distinct(starts: Iterable[Start]) -> Iterator[Start]:
    """Without those on which strips lie as on one before."""
    before: list[Start] = []
    for start in starts:
        if not any(other.is_at(start.pose) for other in before):
            before.append(start)
            yield start
