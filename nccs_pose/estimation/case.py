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

"""What poses that are laid on an image start from, and what else is known when they are judged."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from nccs_pose.estimation.association import FittedCandidate
from nccs_pose.estimation.gate import Gate
from nccs_pose.estimation.ledger import Refused, Sifted
from nccs_pose.estimation.line_history import LineHistory
from nccs_pose.estimation.measuring import LINEAR_PX
from nccs_pose.estimation.motion import Prediction
from nccs_pose.estimation.sights import Sight
from nccs_pose.geometry.pose import Pose2
import numpy as np

# So many candidates at most are laid on an image; they lie within so many px of the truth there.
TRIED = 6
SEARCH_BAND = 5.0
# Where the image moves a pose by less than this, m and rad, the strips lie on it as they did.
_AS_LAID = (0.03, 0.01)


@dataclass(frozen=True)
class Start:
    """A pose to lay on an image.

    :ivar reach: how far it may be off in the image, px.
    :ivar candidate: what the strips say of it; None if it has to be tried in any case.
    """

    pose: Pose2
    reach: float
    candidate: FittedCandidate | None = None

    @classmethod
    def of(cls, candidate: FittedCandidate) -> Start:
        """From what the strips say."""
        return cls(candidate.pose, SEARCH_BAND, candidate)

    @property
    def misfit(self) -> float:
        """How far the strips lie off its lines, px."""
        return 0.0 if self.candidate is None else self.candidate.misfit

    @property
    def reaches(self) -> tuple[float, ...]:
        """How far around it to look, px: at its place first, if its strips lie there."""
        return (LINEAR_PX, self.reach) if self.misfit < LINEAR_PX else (self.reach,)

    def kept(self, pose: Pose2) -> FittedCandidate | None:
        """What the strips say of the pose that it became on the image; None where that is new."""
        return self.candidate if self.is_at(pose) else None

    def is_at(self, pose: Pose2) -> bool:
        """Whether the strips lie on a pose as they do on this."""
        moved = np.abs(pose.minus(self.pose))
        return bool(max(moved[0], moved[1]) < _AS_LAID[0] and moved[2] < _AS_LAID[1])


@dataclass(frozen=True, eq=False)
class Case:
    """A look at an image, and what else is known when poses are judged by it.

    :ivar sight: what the look shows.
    :ivar history: what images have said of the lines before.
    :ivar prediction: of the pose, if there is one.
    :ivar gate: where the robot is by something else than the image, which can decide between
        equal poses: those that are there come first. Without it two equal poses are enough to
        know that the image does not decide, and no more are laid on it.
    :ivar before: what came of other looks at the same image.
    """

    sight: Sight
    history: LineHistory
    prediction: Prediction | None
    gate: Gate | None
    before: Mapping[Sight, Sifted]

    @property
    def refused(self) -> Iterator[tuple[Sight, Refused]]:
        """What was refused at these."""
        return ((sight, refused) for sight, sifted in self.before.items()
                for refused in sifted.refused)
