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
from collections.abc import Sequence

from nccs_pose.estimation.aligner import Aligner
from nccs_pose.estimation.alignment import Alignment
from nccs_pose.estimation.case import Case, SEARCH_BAND, Start, TRIED
from nccs_pose.estimation.hypotheses import Hypothesis
from nccs_pose.estimation.judge import Found, is_expected, Judge
from nccs_pose.estimation.ledger import Ledger, Sifted
from nccs_pose.estimation.many_poses import same_pose
from nccs_pose.estimation.options import LocaliserOptions
from nccs_pose.estimation.rivals import DOUBTS, Rivals
from nccs_pose.estimation.verdict import misses_lines, Objection
from nccs_pose.geometry.pose import Pose2

# Without a gate the search of an image ends after so many candidates that do not hold: in all of
# seven hundred first images that showed a pose it was one of these.
_IN_VAIN = 4
# Only candidates that score this fraction of the best, or are where the robot should be, are laid
# on the image: one that holds is the best by strips or nearly so (a thousand that held had 0.93 of
# its score or more).
_WORTH_TRYING = 0.75


class Sifter:
    """Finds the poses that hold on images of one rig and map."""

    def __init__(
        self, aligner: Aligner, judge: Judge, rivals: Rivals, symmetries: tuple[Pose2, ...],
        options: LocaliserOptions,
    ) -> None:
        """Prepare.

        :param symmetries: motions of the map that change nothing, without the identity.
        """
        self._aligner = aligner
        self._judge = judge
        self._rivals = rivals
        self._symmetries = symmetries
        self._options = options

    def sift(self, case: Case, hypotheses: Sequence[Hypothesis]) -> Sifted:
        """Lay hypotheses, the best candidates and their twins on an image."""
        candidates, gate = case.sight.candidates, case.gate
        if gate is not None and len(candidates) > TRIED:
            candidates = tuple(sorted(candidates, key=lambda c: not gate.contains(c.pose)))
        ledger = Ledger(
            self._symmetries, gate, self._options.ambiguity_ratio, candidates[TRIED:],
            case.sight.others)
        starts = deque(Start(h.pose, self._options.band) for h in hypotheses)
        for c in candidates[:TRIED]:
            if c.score >= _WORTH_TRYING * case.sight.promise or (
                    gate is not None and gate.contains(c.pose)):
                starts.append(Start.of(c))
            else:
                ledger.pass_over(c)
        undecided, in_vain = False, 0
        while starts:
            start = starts.popleft()
            if ledger.knows(start.pose):
                continue
            if start.candidate is not None and ledger.beats(start.candidate):
                ledger.pass_over(start.candidate)
                continue
            if undecided or (in_vain >= _IN_VAIN and gate is None):
                # What the image shows of the hypotheses is among the candidates.
                if start.candidate is not None:
                    ledger.leave(start.candidate)
                continue
            tried = self._tried(case, start, ledger)
            if isinstance(tried, Found):
                starts += (Start(twin, SEARCH_BAND)
                           for twin in ledger.hold(tried, start.candidate))
                undecided = self._is_undecided(case, ledger)
                continue
            if tried is not None and not tried.is_sharp:
                starts.extendleft(self._rivals.taken_for(case, tried))
            if start.candidate is not None and ledger.best is None:
                in_vain += 1
        return ledger.closed()

    def _tried(self, case: Case, start: Start, ledger: Ledger) -> Found | Alignment | None:
        """A pose laid on the image, with what it explains if it holds; None where it does not lie.

        What came of one that does not hold is in the ledger.
        """
        if case.prediction is None and start.candidate is not None:
            against = self._judge.beforehand(start.candidate, self._aligner.lines_in_view)
            if against is not None:
                ledger.rule_out(start.candidate, against)
                return None
        verdict = self._again(case, start, ledger) or self._verdict(case, start, ledger)
        if verdict is None or verdict[1] not in DOUBTS:
            ledger.settle_twins(start.pose)
        if verdict is None:
            return None
        alignment, found = verdict
        if isinstance(found, Found):
            return found
        shown = self._judge.measured(alignment, case.sight.segments, start.kept(alignment.pose))
        if found in DOUBTS:
            ledger.doubt(found, shown)
        elif found.hidden:
            ledger.hide(found, shown)
        else:
            ledger.refuse(found, shown)
        return alignment

    def _is_undecided(self, case: Case, ledger: Ledger) -> bool:
        """Whether an image decides nothing between poses that hold, nor does anything else."""
        best = ledger.best
        return best is not None and case.gate is None and (
            ledger.is_tied() or self._rivals.are_many(best, case.sight.candidates))

    def _verdict(
        self, case: Case, start: Start, ledger: Ledger,
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
                sight.image, alignment, sight.segments, case.history, expected=expected,
                candidate=start.kept(alignment.pose)), expected)
            verdict = alignment, found
            if isinstance(found, Found) or not self._judge.may_miss(alignment, found):
                break
        return verdict

    def _again(
        self, case: Case, start: Start, ledger: Ledger,
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
            if not (against.hidden or against.by_strips) or misses_lines(alignment):
                return alignment, against
            expected = self._expected(case, alignment)
            found = self._judge.by_strips(
                alignment, case.sight.segments, expected=expected,
                candidate=start.kept(alignment.pose))
            return alignment, self._unless_doubtful(case, ledger, found, expected)
        return None

    def _expected(self, case: Case, alignment: Alignment) -> bool:
        return is_expected(alignment, case.prediction, self._options.innovation_gate)

    def _unless_doubtful(
        self, case: Case, ledger: Ledger, found: Found | Objection, expected: bool,
    ) -> Found | Objection:
        """A verdict, unless a rival leaves it in doubt."""
        if isinstance(found, Objection) or expected:
            return found
        return self._rivals.doubt(case, found, has_refused=ledger.has_refused) or found
