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

"""Poses among which the images have not decided yet, carried on until they do.

Every hypothesis keeps the score of each image that it explained. One that stops explaining what
others explain is dropped; one that is alone, or clearly the best of all images together, and
explained two images at least, is chosen. A single lucky image decides nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from nccs_pose.estimation.estimate import Candidate
from nccs_pose.estimation.many_poses import same_pose
from nccs_pose.estimation.motion import SPEED
from nccs_pose.estimation.odometry import Wheels
from nccs_pose.geometry.pose import Pose2

# Images that a hypothesis must have explained before it is chosen among several.
LEAST_IMAGES = 2


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """A pose that may be the right one.

    :ivar pose: T_map_base at the last image that was looked at.
    :ivar scores: its score in each image that it explained, 0 to 1.
    :ivar apart: how far the robot may be from there by now, metres and rad: by what the wheels
        leapt since or, without wheels, by what it may have driven.
    """

    pose: Pose2
    scores: tuple[float, ...]
    apart: tuple[float, float] = (0.0, 0.0)

    @property
    def mean(self) -> float:
        """Mean score."""
        return sum(self.scores) / len(self.scores)

    @property
    def candidate(self) -> Candidate:
        """What is said of it to others."""
        return Candidate(self.pose, self.mean)


@dataclass(frozen=True, eq=False)
class OpenPoses:
    """The hypotheses that are left open, as of the last image that showed any of them.

    :ivar hypotheses: the best first; none where there is nothing to decide.
    :ivar stamp_ns: of that image.
    :ivar wheels: what they said then; None without odometry.
    """

    hypotheses: tuple[Hypothesis, ...] = ()
    stamp_ns: int = 0
    wheels: Wheels | None = None

    def __bool__(self) -> bool:
        """Whether anything is left to decide."""
        return bool(self.hypotheses)

    def at(self, stamp_ns: int, wheels: Wheels | None) -> tuple[Hypothesis, ...]:
        """Where they are by another image; without wheels still there, or somewhere near.

        :param wheels: what they say then.
        """
        if self.wheels is None or wheels is None:
            seconds = 1e-9 * (stamp_ns - self.stamp_ns)
            step, (way, turn) = Pose2(0.0, 0.0, 0.0), (speed * seconds for speed in SPEED)
        else:
            step = self.wheels.pose.inverse() @ wheels.pose
            way, turn = (b - a for a, b in zip(self.wheels.leapt, wheels.leapt))
        return tuple(
            replace(h, pose=h.pose @ step, apart=(h.apart[0] + way, h.apart[1] + turn))
            for h in self.hypotheses)


def confronted(
    hypotheses: Sequence[Hypothesis], held: Sequence[tuple[Pose2, float]],
) -> tuple[Hypothesis, ...]:
    """The hypotheses after an image, best first: the poses that it shows, each with its scores.

    :param hypotheses: those before it, in their new place.
    :param held: every pose that explains the image, with its score.
    """
    found = []
    for pose, score in held:
        before = max(
            (h for h in hypotheses if same_pose(h.pose, pose, h.apart)),
            key=lambda h: h.mean, default=None)
        found.append(Hypothesis(pose, (*(before.scores if before is not None else ()), score)))
    return tuple(sorted(found, key=lambda h: -h.mean))


def ambiguity(hypotheses: Sequence[Hypothesis]) -> float:
    """Score of the second over that of the best, 0 where there is no second."""
    return hypotheses[1].mean / hypotheses[0].mean if len(hypotheses) > 1 else 0.0
