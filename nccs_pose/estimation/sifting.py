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

"""Which of many poses hold when they are laid on the image itself."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping, Sequence, Set
from dataclasses import dataclass
from itertools import chain, islice

from nccs_pose.estimation.aligner import Aligner, LINEAR_PX
from nccs_pose.estimation.alignment import Alignment
from nccs_pose.estimation.association import FittedCandidate
from nccs_pose.estimation.hypotheses import Hypothesis
from nccs_pose.estimation.judge import Found, is_expected, Judge
from nccs_pose.estimation.ledger import ABOUT_AS_MUCH, AS_MUCH, Ledger, Refused, Sifted
from nccs_pose.estimation.many_poses import same_pose
from nccs_pose.estimation.motion import Prediction
from nccs_pose.estimation.options import LocaliserOptions
from nccs_pose.estimation.search import Searcher
from nccs_pose.estimation.sights import Sight
from nccs_pose.estimation.told import Told
from nccs_pose.estimation.verdict import lines_used, misses_lines, Objection
from nccs_pose.geometry.pose import Pose2
import numpy as np

# Candidates that are laid on the image, and those after which it shows none where nothing tells
# where to look: of seven hundred first images that showed a pose all did at one of these.
_TRIED = 6
_IN_VAIN = 4
# They lie within this of the truth in the image, px.
_SEARCH_BAND = 5.0
# Only those count that score this fraction of the best, or are where the robot should be: one that
# holds is the best by strips or nearly so (0.93 of its score or more, of a thousand that held).
_WORTH_TRYING = 0.75
# On an image too coarse to show by itself which of two poses is right, how well lines lie tells
# only those apart that explain more than this of what should be seen and of what is, by three
# lines or more, and no more where one that lies on it was refused.
_PLAINLY_ALL = 0.9
# Where the image moves a pose by less than this, m and rad, the strips lie on it as they did.
_AS_LAID = (0.03, 0.01)
_DOUBTFUL = Objection(
    'its lines lie badly on the image, and another pose shows about as much', hidden=True)
_ON_A_CORNER = Objection(
    'it rests on two lines, and the image shows as much of another pose', hidden=True)
_INCOMPLETE = Objection(
    'its lines lie badly on the image, and others that should be in view are not there',
    hidden=True)


@dataclass(frozen=True)
class _Start:
    """A pose to lay on an image.

    :ivar reach: how far it may be off in the image, px.
    :ivar strips: what they say of it; None if it has to be tried in any case.
    """

    pose: Pose2
    reach: float
    strips: FittedCandidate | None = None

    @classmethod
    def of(cls, candidate: FittedCandidate) -> _Start:
        """From what the strips say."""
        return cls(candidate.pose, _SEARCH_BAND, candidate)

    @property
    def misfit(self) -> float:
        """How far the strips lie off its lines, px."""
        return 0.0 if self.strips is None else self.strips.misfit

    @property
    def reaches(self) -> tuple[float, ...]:
        """How far around it to look, px: at its place first, if its strips lie there."""
        return (LINEAR_PX, self.reach) if self.misfit < LINEAR_PX else (self.reach,)

    def kept(self, pose: Pose2) -> FittedCandidate | None:
        """What the strips say of the pose that it became on the image; None where that is new."""
        moved = np.abs(pose.minus(self.pose))
        near = max(moved[0], moved[1]) < _AS_LAID[0] and moved[2] < _AS_LAID[1]
        return self.strips if near else None


@dataclass(frozen=True, eq=False)
class Case:
    """A look at an image, and what else is known when poses are judged by it.

    :ivar sight: what the look shows.
    :ivar doubts: lines that were seen beside their place and not in it since.
    :ivar prediction: of the pose, if there is one.
    :ivar told: where the robot is by something else than the image, which can decide between
        equal poses: those that are there come first. Without it two equal poses are enough to
        know that the image does not decide, and no more are laid on it.
    :ivar before: what came of other looks at the same image.
    """

    sight: Sight
    doubts: Set[int]
    prediction: Prediction | None
    told: Told | None
    before: Mapping[Sight, Sifted]

    @property
    def refused(self) -> Iterator[tuple[Sight, Refused]]:
        """What was refused at these."""
        return ((sight, refused) for sight, sifted in self.before.items()
                for refused in sifted.refused)


class Sifter:
    """Lays poses on images of one rig and map."""

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

    def sift(self, case: Case, hypotheses: Sequence[Hypothesis]) -> Sifted:
        """Lay hypotheses, the best candidates and their twins on an image."""
        candidates, told = case.sight.candidates, case.told
        if told is not None and len(candidates) > _TRIED:
            candidates = tuple(sorted(candidates, key=lambda c: not told.holds(c.pose)))
        ledger = Ledger(
            self._symmetries, told, self._options.ambiguity_ratio, candidates[_TRIED:],
            case.sight.others)
        starts = deque(_Start(h.pose, self._options.band) for h in hypotheses)
        for c in candidates[:_TRIED]:
            if c.score >= _WORTH_TRYING * case.sight.promise or (
                    told is not None and told.holds(c.pose)):
                starts.append(_Start.of(c))
            else:
                ledger.pass_over(c)
        undecided, in_vain = False, 0
        while starts:
            start = starts.popleft()
            if ledger.knows(start.pose):
                continue
            if start.strips is not None and ledger.beats(start.strips):
                ledger.pass_over(start.strips)
                continue
            if undecided or (in_vain >= _IN_VAIN and told is None):
                # What the image shows of the hypotheses is among the candidates.
                if start.strips is not None:
                    ledger.leave(start.strips)
                continue
            tried = self._tried(case, start, ledger)
            if isinstance(tried, Found):
                starts += (_Start(twin, _SEARCH_BAND)
                           for twin in ledger.hold(tried, start.strips))
                undecided = self._is_undecided(case, ledger)
                continue
            if tried is not None and not tried.is_sharp:
                starts.extendleft(self._taken_for(case, tried))
            if start.strips is not None and ledger.best is None:
                in_vain += 1
        return ledger.closed()

    def _taken_for(self, case: Case, alignment: Alignment) -> Iterator[_Start]:
        """From where the map looks nearly the same as from a pose that was laid on the image."""
        return map(_Start.of, self._searcher.taken_for(alignment.pose, case.sight.segments))

    def _tried(self, case: Case, start: _Start, ledger: Ledger) -> Found | Alignment | None:
        """A pose laid on the image, with what it explains if it holds; None where it does not lie.

        What came of one that does not hold is in the ledger.
        """
        if case.prediction is None and start.strips is not None:
            against = self._judge.beforehand(start.strips, self._aligner.lines_in_view)
            if against is not None:
                ledger.rule_out(start.strips, against)
                return None
        verdict = self._again(case, start, ledger) or self._verdict(case, start, ledger)
        if verdict is None or verdict[1] is not _DOUBTFUL:
            ledger.begin(start.pose)
        if verdict is None:
            return None
        alignment, found = verdict
        if isinstance(found, Found):
            return found
        if found in (_DOUBTFUL, _ON_A_CORNER):
            ledger.doubt(found, self._measured(case.sight, start, alignment))
        elif found.hidden:
            ledger.hide(found, self._measured(case.sight, start, alignment))
        else:
            ledger.refuse(found, alignment)
        return alignment

    def _is_undecided(self, case: Case, ledger: Ledger) -> bool:
        """Whether an image decides nothing between poses that hold, nor does anything else."""
        best = ledger.best
        return best is not None and case.told is None and (
            ledger.is_tied() or self._has_many_equals(best, case.sight.candidates))

    def _has_many_equals(self, held: Found, candidates: Sequence[FittedCandidate]) -> bool:
        """Whether more places than are laid on an image show as much as one that holds.

        Then it decides nothing, and those that it shows are all among the candidates.
        """
        least = self._options.ambiguity_ratio * held.by_strips
        equal = (c for c in candidates
                 if c.score >= least and not same_pose(c.pose, held.alignment.pose))
        return len(list(islice(equal, _TRIED + 1))) > _TRIED

    def _verdict(
        self, case: Case, start: _Start, ledger: Ledger,
    ) -> tuple[Alignment, Found | Objection] | None:
        """Lay a pose on the image, and judge it; None where it does not lie, or was seen before.

        Its surroundings are searched only where it does not fit, or where a line that it misses
        may be there.
        """
        sight, verdict = case.sight, None
        for reach in start.reaches:
            alignment = self._aligner.align(
                sight.image, start.pose, sight.colours, reach=reach,
                hopeless=misses_lines if case.prediction is None else None,
                laid=None if verdict is None else verdict[0].pose)
            if alignment is None:
                continue
            if ledger.was_laid(alignment.pose):
                return verdict
            expected = self._expected(case, alignment)
            found = self._unless_doubtful(case, ledger, self._judge.found(
                sight.image, alignment, sight.segments, case.doubts, expected=expected,
                strips=start.kept(alignment.pose)), expected)
            verdict = alignment, found
            if isinstance(found, Found) or not self._judge.may_miss(alignment, found):
                break
        return verdict

    def _again(
        self, case: Case, start: _Start, ledger: Ledger,
    ) -> tuple[Alignment, Found | Objection] | None:
        """Judge a pose that was laid on the image at another look by what is new at this one.

        None where it was not, or where other colours may show lines that it missed.
        """
        for sight, refused in case.refused:
            alignment, against = refused.alignment, refused.objection
            if alignment is None or against is None or not same_pose(
                    start.pose, alignment.pose):
                continue
            if alignment.missing and sight.colours is not case.sight.colours:
                continue
            if not against.hidden or misses_lines(alignment):
                return alignment, against
            expected = self._expected(case, alignment)
            found = self._judge.by_strips(
                alignment, case.sight.segments, expected=expected,
                strips=start.kept(alignment.pose))
            return alignment, self._unless_doubtful(case, ledger, found, expected)
        return None

    def _expected(self, case: Case, alignment: Alignment) -> bool:
        return is_expected(alignment, case.prediction, self._options.innovation_gate)

    def _measured(self, sight: Sight, start: _Start, alignment: Alignment) -> Found:
        """How much a pose explains that was refused."""
        return self._judge.measured(alignment, sight.segments, start.kept(alignment.pose))

    def _unless_doubtful(
        self, case: Case, ledger: Ledger, found: Found | Objection, expected: bool,
    ) -> Found | Objection:
        """A verdict, unless the strips speak as much for another pose, and the image for neither.

        On an image so coarse that lines lie badly on it how well they lie says little, and what a
        pose shows of strips and lines has to stand out among those that lie on it, and where the
        map looks nearly the same. Nor need the right one be among these, since strips lie askew: a
        pose has to show all the lines that should be in view. One that explains nearly all, which
        leaves little to stand out by, is in doubt only where another lies as well. Two lines lie
        well on any corner, and what shows a rival may be too little to lay it on. Where the image
        decides nothing there is no doubt.
        """
        if isinstance(found, Objection) or expected:
            return found
        alignment, candidates = found.alignment, case.sight.candidates
        sharp, few = alignment.is_sharp, lines_used(alignment) < 3
        if sharp and not few:
            return found
        plain = not few and not ledger.has_refused and (
            min(found.claimed, alignment.explained) > _PLAINLY_ALL)
        if alignment.missing and not (plain or sharp):
            return _INCOMPLETE
        if case.told is None and self._has_many_equals(found, candidates):
            return found
        rivals = self._rivals(found, candidates)
        if few and rivals:
            return _ON_A_CORNER
        if sharp:
            return found
        least_score = self._options.ambiguity_ratio * found.score if plain else 0.0
        doubted = any(
            self._shows_as_much(case, rival, found, least_score)
            for rival in chain(rivals, self._taken_for(case, alignment)))
        return _DOUBTFUL if doubted else found

    def _rivals(self, found: Found, candidates: Sequence[FittedCandidate]) -> list[_Start]:
        """Those of which the strips show as much as of a pose that holds."""
        least = self._options.ambiguity_ratio * found.by_strips
        return [
            _Start.of(c) for c in candidates
            if c.score >= least and c.claimed > found.claimed - AS_MUCH
            and not self._are_alike(c.pose, found.alignment.pose)]

    def _are_alike(self, a: Pose2, b: Pose2) -> bool:
        """Whether two poses are the same, or twins on a symmetric map, which no image parts."""
        return any(same_pose(a, twin) for twin in (b, *(s @ b for s in self._symmetries)))

    def _shows_as_much(
        self, case: Case, rival: _Start, found: Found, least_score: float,
    ) -> bool:
        """Whether a rival shows about as much, laid on the image, as a pose that holds.

        :param least_score: that it has to reach besides, for how well its lines lie.
        """
        least = ABOUT_AS_MUCH * found.shown
        for reach in rival.reaches:
            # What tapes look like is known by now.
            alignment = self._aligner.align(
                case.sight.image, rival.pose, found.alignment.colours, reach=reach)
            if alignment is None or self._are_alike(alignment.pose, found.alignment.pose):
                continue
            measured = self._measured(case.sight, rival, alignment)
            if measured.shown >= least and measured.score >= least_score:
                return True
        return False
