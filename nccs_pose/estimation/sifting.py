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

from collections.abc import Sequence, Set
from dataclasses import dataclass
from itertools import islice
import math

from nccs_pose.estimation.alignment import Aligner, Alignment, LINEAR_PX
from nccs_pose.estimation.association import FittedCandidate, same_pose
from nccs_pose.estimation.estimate import Candidate
from nccs_pose.estimation.hypotheses import Hypothesis
from nccs_pose.estimation.judge import explains_nearly_all, fit_of, Found, is_expected, Judge
from nccs_pose.estimation.motion import Prediction
from nccs_pose.estimation.options import LocaliserOptions
from nccs_pose.estimation.sights import ALL_STRIPS, Sight
from nccs_pose.estimation.told import Told
from nccs_pose.estimation.verdict import misses_lines, Objection
from nccs_pose.geometry.pose import Pose2
import numpy as np

# Candidates that are laid on the image.
_TRIED = 6
# They lie within this of the truth in the image, px.
_SEARCH_BAND = 5.0
# Only those count that score this fraction of the best.
_WORTH_TRYING = 0.6
# An image on which lines lie as well as this shows by itself which of two poses is right.
_SHARP = 0.8
# So does a pose that explains more than this of what should be seen and of what is.
_PLAINLY_ALL = 0.9
# Where the image moves a pose by less than this, m and rad, the strips lie on it as they did.
_AS_LAID = (0.03, 0.01)
_DOUBTFUL = Objection(
    'its lines lie badly on the image, and another pose shows about as much', hidden=True)


@dataclass(frozen=True, eq=False)
class Refused:
    """A pose that was laid on the image, and what the image says against it."""

    objection: Objection | None = None
    alignment: Alignment | None = None


@dataclass(frozen=True, eq=False)
class Sifted:
    """What a search of the whole image leaves.

    :ivar held: poses that explain the image, best first.
    :ivar hidden: poses that would, if something hid the lines that they miss.
    :ivar refused: the others, the best first.
    :ivar open: poses that may explain it as well as the best of those that hold, but were not
        laid on it, or that it cannot tell from another; their scores are no higher than its.
    """

    held: list[Found]
    hidden: list[Candidate]
    refused: list[Refused]
    open: list[Candidate]


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
    :ivar before: what was refused at other looks at the same image.
    """

    sight: Sight
    doubts: Set[int]
    prediction: Prediction | None
    told: Told | None
    before: Sequence[Refused]


class Sifter:
    """Lays poses on images of one rig and map."""

    def __init__(
        self, aligner: Aligner, judge: Judge, symmetries: tuple[Pose2, ...],
        options: LocaliserOptions,
    ) -> None:
        """Prepare.

        :param symmetries: motions of the map that change nothing, without the identity.
        """
        self._aligner = aligner
        self._judge = judge
        self._symmetries = symmetries
        self._options = options

    def sift(self, case: Case, hypotheses: tuple[Hypothesis, ...]) -> Sifted:
        """Lay hypotheses, the best candidates and their twins on an image."""
        sight, told = case.sight, case.told
        options = self._options
        candidates = sight.candidates
        if told is not None and len(candidates) > _TRIED:
            candidates = tuple(sorted(candidates, key=lambda c: not told.holds(c.pose)))
        starts = [_Start(h.pose, options.band) for h in hypotheses]
        starts += [_Start.of(c) for c in candidates[:_TRIED]
                   if c.score >= _WORTH_TRYING * sight.promise]
        left = list(candidates[_TRIED:])
        sifted = Sifted([], [], [], [])
        doubtful: list[Found] = []
        equal: list[Pose2] = []
        seen: list[Pose2] = []
        # An image shows of these what it showed of the pose whose twins they are.
        twins: list[Pose2] = []
        best: tuple[_Start, Found] | None = None
        undecided = False
        for start in starts:
            if any(same_pose(start.pose, pose) for pose in (*seen, *twins)):
                continue
            if best is not None and not self._rivals(start, *best):
                continue
            if undecided:
                # What the image shows of the hypotheses is among the candidates.
                left += [start.strips] if start.strips is not None else []
                continue
            if case.prediction is None and start.strips is not None:
                against = self._judge.beforehand(start.strips)
                if against is not None:
                    sifted.refused.append(Refused(against))
                    sifted.hidden.append(Candidate(start.pose, start.strips.score))
                    continue
            verdict = self._again(case, start) or self._verdict(case, start, seen)
            pose = start.pose if verdict is None else verdict[0].pose
            own = [s @ pose for s in self._symmetries]
            if told is None and (verdict is None or verdict[1] is not _DOUBTFUL):
                twins += own
            if verdict is None:
                continue
            alignment, found = verdict
            seen.append(pose)
            if isinstance(found, Objection):
                sifted.refused.append(Refused(found, alignment))
                if found is _DOUBTFUL:
                    doubtful.append(self._measured(sight, start, alignment))
                elif found.hidden:
                    shown = self._measured(sight, start, alignment)
                    alike = (pose, *own) if told is None else (pose,)
                    sifted.hidden.extend(Candidate(p, shown.by_strips) for p in alike)
                continue
            sifted.held.append(found)
            for twin in own:
                if told is not None and told.holds(twin):
                    starts.append(_Start(twin, _SEARCH_BAND))
                else:
                    equal.append(twin)
            if best is None or found.score > best[1].score:
                best = start, found
            undecided = told is None and (
                len(self._equals(sifted.held)) > 1 or self._is_repeated(best[1], candidates))
        sifted.held.sort(key=lambda f: -f.score)
        if best is not None:
            self._leave_open(sifted, best[1], left, equal, doubtful, seen)
        return sifted

    def _is_repeated(self, held: Found, candidates: Sequence[FittedCandidate]) -> bool:
        """Whether more places than are laid on an image show as much as one that holds.

        Then it decides nothing, and those that it shows are all among the candidates.
        """
        least = self._options.ambiguity_ratio * held.by_strips
        equal = (c for c in candidates
                 if c.score >= least and not same_pose(c.pose, held.alignment.pose))
        return len(list(islice(equal, _TRIED + 1))) > _TRIED

    def _equals(self, found: list[Found]) -> list[Found]:
        """Those of some poses that explain an image about as well as the best of them."""
        most = max((f.score for f in found), default=0.0)
        return [f for f in found if f.score >= self._options.ambiguity_ratio * most]

    def _leave_open(
        self, sifted: Sifted, best: Found, left: list[FittedCandidate], equal: list[Pose2],
        doubtful: list[Found], seen: list[Pose2],
    ) -> None:
        """Add the poses that are left open, beside the best that holds, and what may be hidden.

        :param left: candidates that were not laid on the image.
        :param equal: twins of what holds that were not.
        :param doubtful: what was, and shows about as much as another pose.
        :param seen: all that was laid on the image.
        """
        ratio = self._options.ambiguity_ratio
        for found in doubtful:
            pose = found.alignment.pose
            if found.score >= ratio * best.score:
                sifted.open.append(Candidate(pose, min(found.score, best.score)))
            else:
                sifted.hidden.append(Candidate(pose, found.by_strips))
        # A twin shows what the pose that holds does, even if it was laid on the image and refused.
        twins, seen = [found.alignment.pose for found in sifted.held], list(seen)
        for pose in equal:
            if not any(same_pose(pose, twin) for twin in twins):
                twins.append(pose)
                sifted.open.append(Candidate(pose, best.score))
        seen += twins
        # Candidates differ among themselves.
        for strips in left:
            share = min(strips.score / best.by_strips, 1.0)
            if share >= ratio and not any(same_pose(strips.pose, pose) for pose in seen):
                sifted.open.append(Candidate(strips.pose, share * best.score))
        sifted.open.sort(key=lambda candidate: -candidate.score)

    def _verdict(
        self, case: Case, start: _Start, seen: list[Pose2],
    ) -> tuple[Alignment, Found | Objection] | None:
        """Lay a pose on the image, and judge it; None where it does not lie, or was seen before.

        Its surroundings are searched only where it does not fit, or where a line that it misses
        may be there.
        """
        sight, verdict = case.sight, None
        for reach in (LINEAR_PX, start.reach):
            if reach == LINEAR_PX and start.misfit >= LINEAR_PX:
                continue
            alignment = self._aligner.align(
                sight.image, start.pose, sight.colours, reach=reach,
                hopeless=misses_lines if case.prediction is None else None)
            if alignment is None:
                continue
            if any(same_pose(alignment.pose, pose) for pose in seen):
                return verdict
            expected = self._expected(case, alignment)
            found = self._judge.found(
                sight.image, alignment, sight.segments, case.doubts, expected=expected,
                strips=start.kept(alignment.pose))
            verdict = alignment, self._unless_doubtful(case, found, expected)
            if isinstance(verdict[1], Found) or not alignment.missing:
                break
        return verdict

    def _again(self, case: Case, start: _Start) -> tuple[Alignment, Found | Objection] | None:
        """Judge a pose that was laid on the image at another look by what is new at this one.

        None where it was not, or where other colours may show lines that it missed.
        """
        for refused in case.before:
            alignment, against = refused.alignment, refused.objection
            if alignment is None or against is None or alignment.missing or not same_pose(
                    start.pose, alignment.pose):
                continue
            if not against.hidden:
                return alignment, against
            expected = self._expected(case, alignment)
            found = self._judge.by_strips(
                alignment, case.sight.segments, expected=expected,
                strips=start.kept(alignment.pose))
            return alignment, self._unless_doubtful(case, found, expected)
        return None

    def _expected(self, case: Case, alignment: Alignment) -> bool:
        return is_expected(alignment, case.prediction, self._options.innovation_gate)

    def _measured(self, sight: Sight, start: _Start, alignment: Alignment) -> Found:
        """How much a pose explains that was refused."""
        return self._judge.measured(alignment, sight.segments, start.kept(alignment.pose))

    def _unless_doubtful(
        self, case: Case, found: Found | Objection, expected: bool,
    ) -> Found | Objection:
        """A verdict, unless the strips speak as much for another pose, and the image for neither.

        An image so coarse that lines lie badly on it is no verdict on another pose: the right one
        may not be laid on it at all, and the next may be. Where it decides nothing there is no
        doubt.
        """
        if isinstance(found, Objection) or expected:
            return found
        alignment, candidates = found.alignment, case.sight.candidates
        sharp = fit_of(float(np.mean(alignment.points.sigma**2))) > _SHARP
        if sharp or min(found.claimed, alignment.explained) > _PLAINLY_ALL:
            return found
        if case.told is None and self._is_repeated(found, candidates):
            return found
        least = self._options.ambiguity_ratio * found.by_strips
        rivals = any(c.score >= least and not same_pose(c.pose, alignment.pose)
                     for c in candidates)
        return _DOUBTFUL if rivals else found

    def _rivals(self, start: _Start, held_from: _Start, held: Found) -> bool:
        """Whether what a pose shows on the strips leaves it a chance against one that holds.

        No pose scores more on the image than the root of what it scores on the strips, times
        what is left of that by how far they lie off its lines; and where the strips show all that
        the pose that holds expects, and nothing else, they tell rivals as well as the image: but
        for one that leaves no strip unexplained, of which more may be there than the strips show.
        """
        if start.strips is None:
            return True
        ratio, score = self._options.ambiguity_ratio, start.strips.score
        if explains_nearly_all(held) and score < ratio * held.by_strips and (
                start.strips.claimed < ALL_STRIPS):
            return False
        excess = max(start.misfit**2 - held_from.misfit**2, 0.0)
        return math.sqrt(score) * fit_of(excess) >= ratio * held.score
