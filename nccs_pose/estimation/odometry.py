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

"""Wheel odometry: what it says at any stamp that it covers, and how much it may have missed."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass
import math

from nccs_pose.errors import FrameRefusedError
from nccs_pose.geometry.pose import Pose2, wrapped

# Odometry further from a stamp than this says nothing about it, ns.
_LONGEST_GAP_NS = 250_000_000
_KEPT = 4000
# Less than this, m and rad, is no way: the samples of wheels that stand may tremble.
_JITTER = (0.01, 0.01)
# So many samples in a row before the last one say that this was stamped ahead of its time; fewer
# came late.
_DISORDERED = 3
# Wheels roll and turn no faster, m/s and rad/s, for no longer than this without a word, s. What
# goes this much further, m and rad, from one sample to the next is another start of odometry;
# less may be the stamps'.
_FASTEST = (10.0, 20.0)
_LONGEST_ROLL = 1.0
_LEAP = (0.1, 0.2)
# They stop at once, or go on about as fast as over the last so many ns: but for what wheels speed
# up by, m/s^2 and rad/s^2, and for this, m and rad. A sample that goes further may be another
# start of odometry too; all the more after a silence, in which they may have done anything.
_WINDOW_NS = 50_000_000
_SPEEDING_UP = (3.0, 6.0)
_UNEVEN = (0.05, 0.05)


@dataclass(frozen=True)
class Wheels:
    """What wheels say at some moment.

    :ivar pose: T_odom_base.
    :ivar way: how far they have rolled since odometry began, metres, to and fro.
    :ivar turn: how much they have turned the robot since, rad, to and fro.
    :ivar unheard: what an acceleration of 1 m/s^2 or rad/s^2 may add, as they were not heard just
        then, metres or rad: much in a gap between two samples and past the last one.
    :ivar leapt: how far they have gone, metres and rad, that they can hardly have rolled.
    """

    pose: Pose2
    way: float = 0.0
    turn: float = 0.0
    unheard: float = 0.0
    leapt: tuple[float, float] = (0.0, 0.0)


class Odometry:
    """Wheel odometry, interpolated at any stamp it covers."""

    def __init__(self, clock_jump: float) -> None:
        """Begin.

        :param clock_jump: a stamp that goes back further than this is a new start, s.
        """
        self._clock_jump = clock_jump
        self._stamps: list[int] = []
        self._poses: list[Pose2] = []
        # Ways and turns up to each of them, and of both what they leapt; and the last pose up to
        # which ways and turns were counted.
        self._rolled: list[tuple[float, float, float, float]] = []
        self._counted = Pose2(0.0, 0.0, 0.0)
        self._late = 0

    def add(self, stamp_ns: int, pose: Pose2) -> None:
        """Take one sample; one that is not newer than the last is no news, but for several.

        :raises FrameRefusedError: `odom_jump`, if the sample does not follow on the last: all
            before it is forgotten, and it is the first.
        """
        if self._is_late(stamp_ns):
            return
        jump = self._jump(stamp_ns, pose)
        if jump:
            self.clear()
        way, turn, leap, spin = self._rolled[-1] if self._rolled else (0.0, 0.0, 0.0, 0.0)
        step, turned = _apart(self._counted, pose) if self._rolled else (math.inf, math.inf)
        if step > _JITTER[0] or turned > _JITTER[1]:
            if self._rolled:
                way, turn = way + step, turn + turned
            self._counted = pose
        if len(self._rolled) > 1:
            by, turned_by = self._unexplained(stamp_ns, pose)
            leap, spin = leap + by, spin + turned_by
        self._stamps.append(stamp_ns)
        self._poses.append(pose)
        self._rolled.append((way, turn, leap, spin))
        if len(self._stamps) > 2 * _KEPT:
            del self._stamps[:_KEPT], self._poses[:_KEPT], self._rolled[:_KEPT]
        if jump:
            raise FrameRefusedError('odom_jump', f'odom: {jump}; odometry begins anew')

    def _is_late(self, stamp_ns: int) -> bool:
        """Whether a sample is no news; what is ahead of several in a row is forgotten."""
        ahead = self._stamps[-1] - stamp_ns if self._stamps else -1
        if 0 <= ahead <= 1e9 * self._clock_jump:
            self._late += ahead > 0
            if self._late < _DISORDERED:
                return True
            begin = bisect_right(self._stamps, stamp_ns)
            del self._stamps[begin:], self._poses[begin:], self._rolled[begin:]
        self._late = 0
        return False

    def _jump(self, stamp_ns: int, pose: Pose2) -> str:
        """How a sample does not follow on the last; empty if it does."""
        if not self._stamps:
            return ''
        seconds = 1e-9 * (stamp_ns - self._stamps[-1])
        if seconds < -self._clock_jump:
            return f'the stamps jumped back by {-seconds:.3f} s'
        way, turn = _apart(self._poses[-1], pose)
        time = min(seconds, _LONGEST_ROLL)
        if seconds > 0.0 and (
                way > _LEAP[0] + _FASTEST[0] * time or turn > _LEAP[1] + _FASTEST[1] * time):
            return f'{way:.3g} m and {turn:.3g} rad in {seconds:.3f} s are more than wheels can do'
        return ''

    def _unexplained(self, stamp_ns: int, pose: Pose2) -> tuple[float, float]:
        """How far a sample goes, metres and rad, if further than wheels do after the last."""
        last_ns, last = self._stamps[-1], self._poses[-1]
        seconds = 1e-9 * (stamp_ns - last_ns)
        begin = self._begin_of_window()
        window = 1e-9 * (last_ns - self._stamps[begin])
        rolled = self._poses[begin].inverse() @ last
        share = seconds / window
        went_on = last @ Pose2(share * rolled.x, share * rolled.y, share * rolled.yaw)
        heard = min(seconds, 1e-9 * _LONGEST_GAP_NS)
        way, turn = (
            further if further > 0.5 * faster * heard * (heard + window) + uneven else 0.0
            for further, faster, uneven in zip(
                map(min, _apart(last, pose), _apart(went_on, pose)), _SPEEDING_UP, _UNEVEN))
        return way, turn

    def _begin_of_window(self) -> int:
        """The sample from which on it is seen how fast the wheels roll at the last one."""
        return max(bisect_right(self._stamps, self._stamps[-1] - _WINDOW_NS) - 1, 0)

    @property
    def last_ns(self) -> int | None:
        """The stamp of the last sample; None without any."""
        return self._stamps[-1] if self._stamps else None

    def clear(self) -> None:
        """Forget everything, as after a jump of the clock."""
        self._stamps.clear()
        self._poses.clear()
        self._rolled.clear()
        self._late = 0

    def at(self, stamp_ns: int) -> Wheels | None:
        """What the wheels say at a stamp; carried on a little past the last sample, else None."""
        n = len(self._stamps)
        if n < 2 or stamp_ns < self._stamps[0] - 1:
            return None
        right = min(max(bisect_right(self._stamps, stamp_ns), 1), n - 1)
        # Past the last sample it goes on as over a while: the last two may be of one moment.
        left = right - 1 if stamp_ns <= self._stamps[-1] else self._begin_of_window()
        t0, t1 = self._stamps[left], self._stamps[right]
        since, until = stamp_ns - t0, t1 - stamp_ns
        if -until > _LONGEST_GAP_NS or t1 - t0 > 4 * _LONGEST_GAP_NS:
            return None
        share = since / (t1 - t0)
        a, b = self._poses[left], self._poses[right]
        way, turn, leap, spin = (u + share * (v - u) for u, v in zip(
            self._rolled[left], self._rolled[right]))
        return Wheels(
            Pose2(a.x + share * (b.x - a.x), a.y + share * (b.y - a.y),
                  a.yaw + share * wrapped(b.yaw - a.yaw)),
            # By so much a parabola leaves the straight line through two of its points.
            way, turn, 0.5e-18 * abs(since * until), (leap, spin))


def _apart(a: Pose2, b: Pose2) -> tuple[float, float]:
    """How far apart two poses are, metres and rad."""
    return math.hypot(b.x - a.x, b.y - a.y), abs(wrapped(b.yaw - a.yaw))
