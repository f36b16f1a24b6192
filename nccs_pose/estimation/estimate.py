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

"""What the localiser says of one frame."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum
import math
from typing import Literal, Protocol

from nccs_pose.geometry.pose import Array, Pose2
from nccs_pose.vision.line_points import LinePoints
import numpy as np
from numpy.typing import NDArray


class State(Enum):
    """How much the localiser knows.

    :ivar meaning: the definition, in words; those in `code` are options, their numbers are there.
    """

    meaning: str

    def __new__(cls, word: str, meaning: str) -> State:
        state = object.__new__(cls)
        state._value_ = word
        state.meaning = meaning
        return state

    SEARCHING = 'searching', (
        'No pose was held since the start, or since a reset or an initial pose: nothing in the '
        'images fits the map. None is given.')
    AMBIGUOUS = 'ambiguous', (
        'Two poses or more explain the image, and the second scores more than `ambiguity_ratio` '
        'of the best, in the mean of all images since they were first seen. All are candidates, '
        'the best first, none is given. On a map with many places alike these are hundreds: '
        'all that the strips of an image show, and what was carried on from the images before.')
    TRACKING = 'tracking', (
        'The pose explains the image: at least `least_explained` of the predicted line pixels '
        'are found, no line and no stretch of lines lies off by more than `largest_misfit`, no '
        'line is seen beside its place; and it lies within `innovation_gate` of the prediction '
        '(3 deviations where it rests on fewer than three lines), or two images in a row agree '
        'on it. Where the prediction is less sure than 10 cm or 0.2 rad (after a gap without '
        'odometry, below 3 images a second) or given by hand, no other place within it may look '
        'the same.')
    COASTING = 'coasting', (
        'The image says too little; the last pose is carried on by odometry, for `coast_time` at '
        'most and up to `coast_sigma`, unless an image shows another place. Its covariance grows '
        'with all of the way and all of the turns that the wheels have made, with what they may '
        'slip by while no image watches them, and with the time in which they were not heard.')
    LOST = 'lost', (
        'There was a pose, and it neither explains the image nor can be carried on. None is '
        'given.')


@dataclass(frozen=True)
class Candidate:
    """A pose that may be the right one, and the fraction of line-like pixels it explains."""

    pose: Pose2
    score: float


@dataclass(frozen=True, eq=False)
class Doubted:
    """A pose that was laid on the image and is not believed; the rig or the map may be to blame.

    :ivar pose: T_map_base.
    :ivar points: the line pixels it would rest on.
    """

    pose: Pose2
    points: LinePoints


@dataclass(frozen=True)
class Quality:
    """Signals of health that a covariance cannot give, of the pose or else the best candidate.

    What was not measured, as while coasting, is NaN: a zero would be the best or the worst value.

    :ivar lines_used: map lines that the pose rests on; 0 where it rests on no image.
    :ivar points_used: pixels that it rests on; 0 likewise.
    :ivar residual_px: root mean square residual, px.
    :ivar expected_px: what the noise measured in the image makes of it, px.
    :ivar explained: fraction of the predicted, visible line pixels that were found, 0 to 1.
    :ivar claimed: fraction of the line-like pixels in the image that the pose explains, 0 to 1;
        NaN where nothing was looked for. Line-like are the strips that a search finds; of a robot
        that is followed, all pixels of the lines' colours.
    :ivar ambiguity: score of the second best pose over that of the best, 0 to 1.
    :ivar unobserved: directions that the lines in view do not fix, in words.
    """

    lines_used: int = 0
    points_used: int = 0
    residual_px: float = math.nan
    expected_px: float = math.nan
    explained: float = math.nan
    claimed: float = math.nan
    ambiguity: float = math.nan
    unobserved: tuple[str, ...] = ()


Stage = Literal['predict', 'detect', 'associate', 'measure', 'refine']


@dataclass(frozen=True)
class StageTimes:
    """Seconds spent on one frame, by stage."""

    predict: float = 0.0
    detect: float = 0.0
    associate: float = 0.0
    measure: float = 0.0
    refine: float = 0.0

    @property
    def total(self) -> float:
        """All stages together, seconds."""
        return self.predict + self.detect + self.associate + self.measure + self.refine


@dataclass(frozen=True, eq=False)
class Estimate:
    """The answer to one frame.

    :ivar stamp_ns: the image's own stamp, nanoseconds.
    :ivar state: how much is known.
    :ivar reason: why, in words.
    :ivar pose: T_map_base; None where there is no trustworthy one.
    :ivar covariance: of (x, y, yaw) in the map, (3, 3); m^2, m rad, rad^2; None with the pose.
    :ivar candidates: poses that may be right, best first.
    :ivar points: the line pixels it rests on, labelled by the map's lines; None where none.
    :ivar quality: health signals.
    :ivar times: cost by stage.
    :ivar doubted: the pose that the image does not bear out, where no better one was found.
    """

    stamp_ns: int
    state: State
    reason: str
    pose: Pose2 | None = None
    covariance: Array | None = None
    candidates: tuple[Candidate, ...] = ()
    points: LinePoints | None = None
    quality: Quality = field(default_factory=Quality)
    times: StageTimes = field(default_factory=StageTimes)
    doubted: Doubted | None = None


class Answering(Protocol):
    """Whatever answers images like a localiser."""

    def process(self, stamp_ns: int, image: NDArray[np.uint8]) -> Estimate:
        """Answer an image; may refuse it with one of the project's errors."""

    def add_odometry(self, stamp_ns: int, pose: Pose2) -> None:
        """Take notice of the wheels; may refuse a sample with a FrameRefusedError."""
