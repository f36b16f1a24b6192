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

"""Which poses that were laid on an image hold, and why the others do not: what all of it says."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
import math

from nccs_pose.estimation.alignment import Alignment, close, leaves_open
from nccs_pose.estimation.association import FittedCandidate
from nccs_pose.estimation.floor_segments import FloorSegment
from nccs_pose.estimation.line_history import BEYOND_DOUBT, LineHistory, WEAK
from nccs_pose.estimation.misplaced import LineFinder, plainly_in_place
from nccs_pose.estimation.motion import Prediction
from nccs_pose.estimation.observability import parallel_to
from nccs_pose.estimation.options import LocaliserOptions
from nccs_pose.estimation.search import Searcher
from nccs_pose.estimation.verdict import (
    contradiction,
    is_weak,
    line_name,
    lines_used,
    Objection,
    objection,
)
from nccs_pose.geometry.lines import LineMap
from nccs_pose.geometry.pose import Pose2
import numpy as np
from numpy.typing import NDArray

# Without a prediction a pose on two lines must explain this fraction of what should be seen and of
# what is seen, one on three lines that of either; more lines speak for themselves. Where one
# is missing, fewer strips than this are no evidence: they lie on lines at any pose made of them.
_MOST = 0.85
_LEAST_STRIPS = 3
# Out of nothing a pose must rest on most of each of two lines that are so wide in the image, px:
# thinner ones are found on whatever is near, as the floor's edge.
_BROAD = 0.6
# Residuals of this root mean square count half, px.
_HALF_AS_GOOD = 1.0
# A pose that rests on three lines and explains this part of the image explains nearly all.
_NEARLY_ALL = 0.85
# A pose on fewer than three lines, or a bad fit, has to be where it is expected, within so many
# deviations.
_WEAK_GATE = 3.0
_NOTHING = Objection('no line-like strip in the image lies on any of its lines')
_UNFIXED = Objection('the lines that it rests on do not fix a pose')


@dataclass(frozen=True, eq=False)
class Found:
    """A pose laid on an image, and how much that shows of it; as a verdict, one that holds.

    :ivar alignment: as laid on the image.
    :ivar claimed: fraction of the line-like pixels that it explains; NaN if not looked at.
    :ivar score: how much it explains altogether, 0 to 1.
    :ivar by_strips: how much by the strips alone; NaN if not looked at.
    """

    alignment: Alignment
    claimed: float
    score: float
    by_strips: float = float('nan')

    @property
    def shown(self) -> float:
        """How much it explains, however well its lines lie on the image, 0 to 1."""
        return _shown(self.by_strips, self.alignment)


class Judge:
    """Judges poses laid on images of one rig and map."""

    def __init__(
        self, searcher: Searcher, finder: LineFinder, line_map: LineMap,
        options: LocaliserOptions,
    ) -> None:
        self._searcher = searcher
        self._finder = finder
        self._map = line_map
        self._options = options

    def objection(
        self, image: NDArray[np.uint8], alignment: Alignment, history: LineHistory, *,
        expected: bool,
    ) -> Objection | None:
        """What an image says against a pose that was laid on it; None if nothing.

        :param history: what images have said of the lines before.
        :param expected: whether a prediction agrees with the pose.
        """
        return objection(
            alignment, self._map, self._options, expected=expected,
        ) or self._objection_of_places(image, alignment, history, expected)

    def _objection_of_places(
        self, image: NDArray[np.uint8], alignment: Alignment, history: LineHistory, expected: bool,
    ) -> Objection | None:
        """What lines say that leave a question, looked for in their places and beside them."""
        # Out of nothing every line in view is looked at, else those that leave a question.
        least = WEAK if expected else np.inf
        support = alignment.support.tolist()
        asked = {*(k for k, part in enumerate(support) if part < least),
                 *(k for k in history.doubted if support[k] >= 0.0)}
        if asked:
            asked -= plainly_in_place(alignment) | history.unasked(alignment)
        if not asked:
            return None
        for k, seen in self._finder.placements(image, alignment, asked):
            if seen.beside is not None:
                return Objection(
                    f'{line_name(self._map, k)} is seen {seen.beside:.1f} px beside its place',
                    line=k)
            others = lines_used(alignment) - (alignment.support[k] >= WEAK)
            if k in history.doubted and not seen.confirmed and others < BEYOND_DOUBT:
                return Objection(
                    f'{line_name(self._map, k)} was seen beside its place, and not in it since')
        return None

    def found(
        self, image: NDArray[np.uint8], alignment: Alignment,
        segments: tuple[FloorSegment, ...], history: LineHistory, *, expected: bool,
        candidate: FittedCandidate | None,
    ) -> Found | Objection:
        """Judge a pose by the whole image.

        :param candidate: what the strips say of it, if that is known.
        """
        # What no lines hold in its place tells nothing of where other lines are.
        if leaves_open(alignment.refinement):
            return _UNFIXED
        return self.objection(image, alignment, history, expected=expected) or self.by_strips(
            alignment, segments, expected=expected, candidate=candidate)

    def may_miss(self, alignment: Alignment, against: Objection) -> bool:
        """Whether lines that a refused pose misses may be near their places.

        Where all that are in view are parallel, none of them would fix it.
        """
        if against is not _UNFIXED:
            return bool(alignment.missing)
        in_view = self._map.directions[alignment.support >= 0.0]
        return not parallel_to(in_view[0], in_view).all()

    def by_strips(
        self, alignment: Alignment, segments: tuple[FloorSegment, ...], *, expected: bool,
        candidate: FittedCandidate | None,
    ) -> Found | Objection:
        """Judge a pose against which the image itself says nothing; see :meth:`found`."""
        against = contradiction(alignment, segments, self._map)
        if against is not None:
            return against
        found = self.measured(alignment, segments, candidate)
        if found.score <= 0.0:
            return _NOTHING
        return found if expected else _too_little(found, len(segments)) or found

    def beforehand(
        self, candidate: FittedCandidate, lines_in_view: Callable[[Pose2], int],
    ) -> Objection | None:
        """What strips alone say against a pose that nothing expects; None if nothing.

        :param lines_in_view: how many lines should be seen from a pose.
        """
        if candidate.claimed >= _MOST:
            return None
        seen = lines_in_view(candidate.pose)
        return _unexplained(seen) if seen < 3 else None

    def measured(
        self, alignment: Alignment, segments: tuple[FloorSegment, ...],
        candidate: FittedCandidate | None = None,
    ) -> Found:
        """How much a pose explains, whether it holds or not; see :meth:`found`."""
        score, claimed = (candidate.score, candidate.claimed) if candidate is not None else (
            self._searcher.score(alignment.pose, segments))
        return Found(
            alignment, claimed, _shown(score, alignment) * fit_of(alignment.points.variance),
            score)


def _too_little(found: Found, strips: int) -> Objection | None:
    """Why a pose that nothing expects rests on too little; None if it does not.

    :param strips: how many the image shows.
    """
    alignment, used = found.alignment, lines_used(found.alignment)
    weaker, stronger = sorted((found.claimed, alignment.explained))
    if alignment.missing and strips < _LEAST_STRIPS:
        stronger = alignment.explained
    if {1: weaker, 2: weaker, 3: stronger}.get(used, 1.0) < _MOST:
        return _unexplained(used)
    broad = set(alignment.whole[
        (alignment.support > WEAK) & (alignment.width >= _BROAD)].tolist())
    if len(broad) < 2:
        return Objection(
            f'all but {len(broad)} of the lines that it rests on are thinner than {_BROAD} px',
            hidden=True)
    return None


def _unexplained(lines: int) -> Objection:
    return Objection(f'it rests on {lines} lines and leaves too much unexplained', hidden=True)


def _shown(by_strips: float, alignment: Alignment) -> float:
    """How much a pose explains by strips and by the lines that should be seen, 0 to 1."""
    return math.sqrt(by_strips * alignment.explained)


def fit_of(square: float) -> float:
    """What a fit counts with so large a mean square residual, px^2; 1 for a perfect one.

    Where a room looks almost the same from two places this decides, not what is explained.
    """
    return 1.0 / (1.0 + square / _HALF_AS_GOOD**2)


def explains_nearly_all(found: Found) -> bool:
    """Whether a pose leaves neither lines nor strips of any size unexplained."""
    return (lines_used(found.alignment) >= 3
            and min(found.claimed, found.alignment.explained) >= _NEARLY_ALL)


def is_expected(alignment: Alignment, prediction: Prediction | None, sigmas: float) -> bool:
    """Whether a pose is where a prediction says, within so many deviations."""
    if prediction is None:
        return False
    if is_weak(alignment):
        sigmas = min(sigmas, _WEAK_GATE)
    return close(
        alignment.pose, prediction.pose, prediction.covariance + alignment.covariance, sigmas)
