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

"""What came of the poses that were laid on one image, one after the other."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
import math

from nccs_pose.estimation.alignment import Alignment
from nccs_pose.estimation.association import ALL_STRIPS, FittedCandidate
from nccs_pose.estimation.estimate import Candidate
from nccs_pose.estimation.gate import Gate
from nccs_pose.estimation.judge import explains_nearly_all, fit_of, Found
from nccs_pose.estimation.many_poses import Poses, same_pose, unlike
from nccs_pose.estimation.verdict import Objection
from nccs_pose.geometry.pose import Pose2
import numpy as np

# A pose that leaves more of the strips unexplained than another by this much is no rival of it:
# where a coarse image seemed to show a wrong pose, the right one explained as much or more.
AS_MUCH = 0.05
# Nor is one that shows less than this part of what it shows, on the image and by strips: of wrong
# poses that seemed right on a coarse image all but one of 88 had a rival that showed more.
ABOUT_AS_MUCH = 0.9


@dataclass(frozen=True, eq=False)
class Refused:
    """A pose that was laid on the image, and what the image says against it.

    :ivar objection: None if nothing lay there to object to.
    :ivar alignment: the pose; None where it is not to be compared with others.
    :ivar misled: whether the prediction itself may be of another place of a map nearly symmetric:
        then no pose is believed for being expected.
    """

    objection: Objection | None = None
    alignment: Alignment | None = None
    misled: bool = False


@dataclass(frozen=True, eq=False)
class Sifted:
    """What a search of the whole image leaves.

    :ivar held: poses that explain the image, best first.
    :ivar hidden: poses that would, if something hid the lines that they miss.
    :ivar refused: the others, the best first.
    :ivar open: poses that may explain it as well as the best of those that hold, but were not
        laid on it, or that it cannot tell from another, best first; their scores are no higher
        than its.
    :ivar rest: poses that explain the strips as well, but of which these show fewer lines; they
        were not laid on it either.
    :ivar others: more poses that leave no strip unexplained, which were not looked at closely.
    """

    held: list[Found]
    hidden: list[Candidate]
    refused: list[Refused]
    open: list[Candidate]
    rest: list[Candidate]
    others: Poses


class Ledger:
    """Which poses of an image are known, and what is known of them.

    A symmetric map has twins of every pose, of which the image shows the same.

    :ivar best: of the poses that hold, None if none does.
    """

    def __init__(
        self, symmetries: Sequence[Pose2], gate: Gate | None, ratio: float,
        left: Iterable[FittedCandidate], others: Poses,
    ) -> None:
        """Begin.

        :param symmetries: motions of the map that change nothing, without the identity.
        :param gate: where the robot is by something else than the image; without it nothing is
            learned of a twin by laying it on the image too.
        :param ratio: a pose that scores this part of the best is its equal.
        :param left: candidates that are not to be laid on the image.
        :param others: poses that leave no strip unexplained, besides the candidates.
        """
        self.best: Found | None = None
        # What the strips say of the pose that the best started from; None if nothing.
        self._best_candidate: FittedCandidate | None = None
        self._symmetries = symmetries
        self._gate = gate
        self._ratio = ratio
        # Poses that lie on the image, whatever it says of them.
        self._laid: list[Pose2] = []
        # Twins of which nothing more would be learned.
        self._settled: list[Pose2] = []
        self._held: list[Found] = []
        self._refused: list[Refused] = []
        # The most that the image shows of a pose that it speaks against.
        self._most_refused = 0.0
        self._hidden: list[Candidate] = []
        # What would hold, if something hid what they miss.
        self._excused: list[Found] = []
        # What would hold, if another pose did not show about as much.
        self._doubtful: list[Found] = []
        # Twins of what holds that are not laid on the image themselves.
        self._equal: list[Pose2] = []
        self._left = list(left)
        self._passed_over: list[FittedCandidate] = []
        self._others = others

    def knows(self, pose: Pose2) -> bool:
        """Whether a pose need not be laid on the image: it or its twin was."""
        return any(same_pose(pose, other) for other in (*self._laid, *self._settled))

    def was_laid(self, pose: Pose2) -> bool:
        """Whether a pose is one that lies on the image."""
        return any(same_pose(pose, other) for other in self._laid)

    @property
    def has_refused(self) -> bool:
        """Whether a pose that lies on the image was refused."""
        return len(self._laid) > len(self._held)

    def is_tied(self) -> bool:
        """Whether several poses explain the image about as well as the best of them."""
        return self.best is not None and len(
            [f for f in self._held if f.score >= self._ratio * self.best.score]) > 1

    def beats(self, candidate: FittedCandidate) -> bool:
        """Whether a pose, by what strips show of it, has no chance against the best that holds.

        On the image no pose scores more than the square root of what it scores by strips, times
        what is left of that by how far these lie off its lines. And where the best pose explains
        nearly all, the strips alone tell its rivals from it; but for a rival that leaves no strip
        unexplained, since more of its lines may be in the image than the strips show.
        """
        best, ratio = self.best, self._ratio
        if best is None:
            return False
        if explains_nearly_all(best) and candidate.score < ratio * best.by_strips and (
                candidate.claimed < ALL_STRIPS):
            return True
        misfit = 0.0 if self._best_candidate is None else self._best_candidate.misfit
        excess = max(candidate.misfit**2 - misfit**2, 0.0)
        return math.sqrt(candidate.score) * fit_of(excess) < ratio * best.score

    def leave(self, candidate: FittedCandidate) -> None:
        """Leave a candidate that was not laid on the image."""
        self._left.append(candidate)

    def pass_over(self, candidate: FittedCandidate) -> None:
        """Leave a candidate that is no rival of the best pose that holds."""
        self._passed_over.append(candidate)

    def rule_out(self, candidate: FittedCandidate, against: Objection) -> None:
        """Refuse a candidate by its strips alone, unless something is hidden."""
        self._refused.append(Refused(against))
        self._hidden.append(Candidate(candidate.pose, candidate.score))

    def settle_twins(self, pose: Pose2) -> None:
        """Note that nothing more would be learned of the twins of a pose that was tried.

        Twins of where it starts would come to twins of where it ends.
        """
        if self._gate is None:
            self._settled += self._twins(pose)

    def hold(self, found: Found, candidate: FittedCandidate | None) -> list[Pose2]:
        """Note a pose that holds.

        :param candidate: what the strips say of the pose that it started from; None if nothing.
        :returns: those of its twins that have to be laid on the image too.
        """
        self._laid.append(found.alignment.pose)
        self.settle_twins(found.alignment.pose)
        self._held.append(found)
        if self.best is None or found.score > self.best.score:
            self.best, self._best_candidate = found, candidate
        twins, gate = self._twins(found.alignment.pose), self._gate
        there = [gate is not None and gate.contains(twin) for twin in twins]
        self._equal += [twin for twin, near in zip(twins, there) if not near]
        return [twin for twin, near in zip(twins, there) if near]

    def doubt(self, against: Objection, shown: Found) -> None:
        """Note a pose that would hold, if another did not show about as much."""
        self._laid.append(shown.alignment.pose)
        self._refused.append(Refused(against, shown.alignment))
        self._doubtful.append(shown)

    def refuse(self, against: Objection, shown: Found) -> None:
        """Note a pose that does not hold."""
        self._note(against, shown.alignment)
        self._most_refused = max(self._most_refused, shown.shown)

    def hide(self, against: Objection, shown: Found) -> None:
        """Note a pose that would hold, if something hid the lines that it misses."""
        pose = shown.alignment.pose
        self._note(against, shown.alignment)
        alike = (pose, *self._twins(pose)) if self._gate is None else (pose,)
        self._hidden.extend(Candidate(p, shown.by_strips) for p in alike)
        self._excused.append(shown)

    def _note(self, against: Objection, alignment: Alignment) -> None:
        self._laid.append(alignment.pose)
        self.settle_twins(alignment.pose)
        self._refused.append(Refused(against, alignment))

    def closed(self) -> Sifted:
        """What is left when no more poses are laid on the image."""
        # Where the image shows more of a pose that it speaks against, it is the right one, and the
        # rig or the map is off: the robot leans, or a line was moved.
        held = _ranked([f for f in self._held if f.shown + AS_MUCH >= self._most_refused])
        if not held:
            return Sifted(held, self._hidden, self._refused, [], [], self._others)
        best, poses = held[0], [f.alignment.pose for f in held]
        twins = self._equal_to_none(poses)
        known = Poses.of([*poses, *twins, *self._laid])
        least, least_shown = self._ratio * best.by_strips, self._ratio * best.shown
        left_open = [
            # One that explains nearly all, and more than the best does, leaves the best in doubt.
            *(Candidate(f.alignment.pose, best.score) for f in self._excused
              if explains_nearly_all(f) and f.score > best.score),
            # How well lines lie says little on an image that leaves such doubts.
            *(Candidate(f.alignment.pose, min(f.shown / best.shown, 1.0) * best.score)
              for f in self._doubtful if f.shown >= least_shown),
            # A twin shows what the pose that holds does, even if it was laid on it and refused.
            *(Candidate(twin, best.score) for twin in twins),
            *self._unlaid([c for c in self._left if c.score >= least], known, best)]
        hidden = [*self._hidden, *(Candidate(f.alignment.pose, f.by_strips)
                                   for f in self._doubtful if f.shown < least_shown)]
        # More of the lines of what explains the same strips may be there than they show.
        less = (*(c for c in self._left if c.score < least), *self._passed_over)
        rest = self._unlaid(
            [c for c in less if c.claimed > best.claimed - AS_MUCH], known, best)
        others = self._others
        if len(others):
            others = others[unlike(others, known)]
        return Sifted(
            held, hidden, self._refused, sorted(left_open, key=lambda c: -c.score), rest, others)

    def _twins(self, pose: Pose2) -> list[Pose2]:
        return [s @ pose for s in self._symmetries]

    def _equal_to_none(self, poses: list[Pose2]) -> list[Pose2]:
        """Twins of what holds that are the same as none of some poses, nor as one another."""
        new: list[Pose2] = []
        for twin in self._equal:
            if not any(same_pose(twin, pose) for pose in (*poses, *new)):
                new.append(twin)
        return new

    def _unlaid(
        self, left: list[FittedCandidate], known: Poses, best: Found,
    ) -> list[Candidate]:
        """Candidates that were not laid on the image, nor their likes."""
        if not left:
            return []
        poses = Poses.of([candidate.pose for candidate in left])
        # They differ among themselves.
        new = unlike(poses, known)
        score = np.minimum(
            np.array([candidate.score for candidate in left]) / best.by_strips, 1.0) * best.score
        poses = poses[new]
        if self.best is not None and self._best_candidate is not None:
            # Strips that lie askew do so at all places where they look the same.
            poses = poses @ (self._best_candidate.pose.inverse() @ self.best.alignment.pose)
        return [Candidate(*of) for of in zip(poses.listed(), score[new].tolist())]


def _ranked(held: list[Found]) -> list[Found]:
    """Poses that hold, best first.

    One that shows less than another, or misses lines where that misses none, is worth no more, as
    well as its lines lie: those that lie badly may be among what it does without.
    """
    worth = [
        min(f.score, max((
            g.score for g in held
            if g.shown > f.shown or (f.alignment.missing and not g.alignment.missing)),
            default=1.0))
        for f in held]
    capped = [replace(f, score=score) for f, score in zip(held, worth)]
    return sorted(capped, key=lambda f: (-f.score, len(f.alignment.missing), -f.shown))
