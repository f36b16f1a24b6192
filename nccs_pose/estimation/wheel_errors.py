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

"""What images have shown of how far wheels err."""

from __future__ import annotations

from dataclasses import dataclass, replace
import math

from nccs_pose.estimation.motion import by_odometry, Flaw, NO_FLAW, Track
from nccs_pose.geometry.pose import wrapped

# Wheels are held against the images after every step of so many metres or radians: in a shorter
# one the images' own errors are as large, and a robot that stands makes none.
_STEP = 0.1
# A step that is so many metres or radians back counts 1 / e.
_MEMORY = 2.0
# What these deviations of the images' and the wheels' known errors explain is no flaw.
_EXPLAINED = 2.0
# A step that turns by less than this, rad/m, is straight.
_STRAIGHT = 0.3


@dataclass(frozen=True)
class Tally:
    """Sums over the last steps, in which the images' own errors all but cancel.

    :ivar rolled: metres or radians.
    :ivar error: of the wheels, along with what they rolled.
    :ivar variance: of the error, as far as it is known.
    """

    rolled: float = 0.0
    error: float = 0.0
    variance: float = 0.0

    def after(self, faded: float, rolled: float, error: float, variance: float) -> Tally:
        """The sums after one more step.

        :param faded: how much all before it still counts.
        """
        return Tally(
            faded * self.rolled + rolled, faded * self.error + error,
            faded**2 * self.variance + variance)

    @property
    def flaw(self) -> float:
        """What the wheels err by, as a part of what they roll; 0 to 1."""
        unexplained = self.error**2 - _EXPLAINED**2 * self.variance
        if unexplained <= 0.0:
            return 0.0
        return math.sqrt(unexplained / max(self.rolled**2, unexplained))


@dataclass(frozen=True)
class WheelErrors:
    """Wheels held against the images that fixed every direction of the pose.

    :ivar flaw: what they err by.
    :ivar begin: where the step began that is not yet counted; None without odometry.
    """

    flaw: Flaw = NO_FLAW
    begin: Track | None = None
    _way: Tally = Tally()
    _turn: Tally = Tally()
    _bend: Tally = Tally()

    def begun_at(self, track: Track | None) -> WheelErrors:
        """The same, with the next step begun anew."""
        return replace(self, begin=track)

    def after(self, track: Track) -> WheelErrors:
        """What is known after one more image that fixes every direction of the pose."""
        begin, wheels = self.begin, track.wheels
        if begin is None or begin.wheels is None or wheels is None:
            return self.begun_at(track)
        way, turn = wheels.way - begin.wheels.way, wheels.turn - begin.wheels.turn
        if way < _STEP and turn < _STEP:
            return self
        predicted = by_odometry(begin.pose, begin.covariance, begin.wheels, wheels)
        x, y = predicted.pose.x - begin.pose.x, predicted.pose.y - begin.pose.y
        length = math.hypot(x, y) or 1.0
        x, y = x / length, y / length
        further = x * (track.pose.x - predicted.pose.x) + y * (track.pose.y - predicted.pose.y)
        turned = wrapped(predicted.pose.yaw - begin.pose.yaw)
        spun = wrapped(track.pose.yaw - predicted.pose.yaw)
        if max(abs(further), abs(spun)) > way + turn:
            # No wheels err by more than they roll: the robot was carried, or found elsewhere.
            return self.begun_at(track)
        (xx, xy, _), (_, yy, _), (_, _, tt) = (predicted.carried + track.covariance).tolist()
        faded = math.exp(-(way + turn) / _MEMORY)
        ways = self._way.after(
            faded, way, further, x * x * xx + 2.0 * x * y * xy + y * y * yy)
        turns = self._turn.after(faded, turn, math.copysign(1.0, turned) * spun, tt)
        bends = self._bend
        # A turn's own error says nothing of a bend, and what is known of one does not fade by it.
        if turn < _STRAIGHT * way:
            ahead = x * math.cos(begin.pose.yaw) + y * math.sin(begin.pose.yaw)
            bends = bends.after(faded, way, math.copysign(1.0, ahead) * spun, tt)
        return WheelErrors(
            Flaw(ways.flaw, turns.flaw, bends.flaw), track, ways, turns, bends)


UNCHECKED = WheelErrors()
