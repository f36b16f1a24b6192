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

"""Where the robot should be by now: by wheel odometry, or by its last velocity."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from functools import cached_property
from itertools import pairwise
import math

from nccs_pose.estimation.odometry import Wheels
from nccs_pose.geometry.pose import Array, Pose2
from nccs_pose.geometry.small_matrices import inverse, is_definite
import numpy as np

# Without odometry a velocity is believed for so long, s.
_LONGEST_COAST = 1.0
# By so much (m, m and rad, deviations) the covariance of a prediction is inflated: it keeps the
# image, not the prediction, in charge.
_INFLATION = np.diag([0.02, 0.02, 0.015])**2
# What wheels gain in error over the first metre or radian; it grows with the square root.
_PER_METRE = (0.03, 0.03)
_YAW_PER_RADIAN = 0.05
# Besides, they may be larger or smaller than they are taken for, by this part.
_SCALE = 0.02
# Where no image watches them they may slip or spin by this part; one alone of two that are so far
# apart, metres, turns the robot by it.
_SLIP = 0.1
_APART = 0.4
# Without odometry: the speed and the acceleration that a robot may have, m/s and rad/s, a second.
SPEED = (1.0, 2.0)
_ACCELERATION = (1.0, 2.0)
# A prediction less sure than this, m and rad, leaves room for more than one place that looks the
# same: on a map of half-metre cells 2.5 deviations are halfway to the next.
_SURE = (0.1, 0.2)
# A change of velocity goes on if it is larger than so many deviations of what is known of it.
_CERTAIN = 2.0
# So many poses before the last one show how the velocity changes.
PAST = 3


@dataclass(frozen=True, eq=False)
class Track:
    """A pose that an image gave.

    :ivar stamp_ns: of the image.
    :ivar pose: T_map_base.
    :ivar covariance: of (x, y, yaw) (3, 3).
    :ivar wheels: what they said then; None without odometry.
    :ivar seen_ns: the last stamp at which the lines in view fixed every direction of the pose.
    :ivar seen_way: how far the wheels had rolled then, metres; None if they did not say.
    """

    stamp_ns: int
    pose: Pose2
    covariance: Array
    wheels: Wheels | None
    seen_ns: int
    seen_way: float | None = None


@dataclass(frozen=True)
class Flaw:
    """What wheels err by, in proportion to how far they roll; one sigma.

    :ivar way: as a part of the way.
    :ivar turn: of the yaw, as a part of the turn.
    :ivar bend: of the yaw, for every metre, as of wheels of two sizes, rad/m.
    """

    way: float = 0.0
    turn: float = 0.0
    bend: float = 0.0


class Slip(Enum):
    """Whether wheels may slip on a way that no image watches."""

    NONE = 'what they do is known'
    POSSIBLE = 'it may begin anywhere on the way, every metre or radian once'
    LIKELY = 'images speak against what they tell'

    def variance(self, rolled: float) -> float:
        """What it may add up to, from the beginning of the way on, m^2 or rad^2.

        On a way shorter than a metre or radian it is the less likely, the shorter that is.
        """
        if self is Slip.NONE:
            return 0.0
        share = min(rolled, 1.0) if self is Slip.POSSIBLE else 1.0
        return share * (_SLIP * rolled) ** 2


@dataclass(frozen=True, eq=False)
class Prediction:
    """A pose expected before its image is looked at.

    :ivar pose: T_map_base.
    :ivar carried: covariance of (x, y, yaw) (3, 3): of the pose it comes from, and of the way.
    :ivar by_odometry: whether wheels say so, or only the last velocity.
    :ivar is_given: whether it goes back to what somebody said, and not to an image.
    """

    pose: Pose2
    carried: Array
    by_odometry: bool
    is_given: bool = False

    @cached_property
    def covariance(self) -> Array:
        """What the image is weighed against: never so narrow that it would overrule the image."""
        return self.carried + _INFLATION

    @cached_property
    def information(self) -> Array:
        """The inverse of :attr:`covariance`."""
        return inverse(self.covariance)

    @cached_property
    def is_vague(self) -> bool:
        """Whether an image that agrees with it may show another place that looks the same."""
        (xx, xy, _), (_, yy, _), (_, _, tt) = self.carried.tolist()
        longest = 0.5 * (xx + yy) + math.hypot(0.5 * (xx - yy), xy)
        return self.is_given or longest > _SURE[0] ** 2 or tt > _SURE[1] ** 2

    def without_inflation(self, covariance: Array, solved: Array) -> Array:
        """A covariance (3, 3) after the image, with what the inflation brought in taken out.

        With the gain W = solved prior^-1 the solve gives W prior W^T + the image's part. Where
        the image says nothing, W is 1, and what is left of the pose's error is the carried one.

        :param covariance: of the pose: a multiple of the solve's, and more.
        :param solved: of the solve, which had this as its prior.
        """
        gain = solved.dot(self.information)
        multiple = max(1.0, float(covariance.trace() / solved.trace()))
        narrowed = covariance - gain.dot(multiple * self.covariance - self.carried).dot(gain.T)
        return narrowed if is_definite(narrowed) else covariance


NO_FLAW = Flaw()


def by_odometry(
    pose: Pose2, covariance: Array, before: Wheels, after: Wheels,
    seen_way: float | None = None, flaw: Flaw = NO_FLAW, slip: Slip = Slip.NONE,
) -> Prediction:
    """Carry a pose and its covariance on by what the wheels did between two moments.

    They err by the whole of their way, also where it leads back: by chance, which adds up in
    squares, and by their size, which adds up as it is. A leap of theirs may be no motion at all:
    it counts in full, and its turn swings all of the way. What they roll too far lies along a
    straight way, and where they swerve leads across it; of a way that bends both lie anywhere.

    :param seen_way: how far they had rolled when the pose was last fixed in every direction,
        metres; None for when they were asked first.
    :param flaw: what they are known to err by.
    :param slip: whether they may slip.
    """
    step = before.pose.inverse() @ after.pose
    moved = pose @ step
    distance = max(math.hypot(step.x, step.y), after.way - before.way)
    angle = max(abs(step.yaw), after.turn - before.turn)
    faster, faster_yaw = (a * after.unheard for a in _ACCELERATION)
    open_way = 0.0 if seen_way is None else max(before.way - seen_way, 0.0)
    scale = max(flaw.way, _SCALE) * math.sqrt(distance * (distance + 2.0 * open_way))
    leap, spin = (b - a for a, b in zip(before.leapt, after.leapt))
    slipped = slip.variance(distance)
    swerve = math.hypot(
        max(flaw.turn * angle, flaw.bend * distance),
        math.sqrt(slip.variance(angle) + slipped / _APART**2))
    sigma_yaw = math.hypot(
        _PER_METRE[1] * math.sqrt(distance), _YAW_PER_RADIAN * math.sqrt(angle), faster_yaw, spin,
        swerve)
    anywhere = _PER_METRE[0] ** 2 * distance + faster**2 + leap**2 + (spin * distance) ** 2
    rolled, swung = scale**2 + slipped, (0.5 * swerve * distance) ** 2
    # Of the way, what leads from the one pose straight to the other.
    x, y = ((b - a) / max(distance, 1e-9) for a, b in ((pose.x, moved.x), (pose.y, moved.y)))
    anywhere += max(1.0 - x * x - y * y, 0.0) * (rolled + swung)
    place = (
        anywhere + x * x * rolled + y * y * swung, x * y * (rolled - swung),
        anywhere + y * y * rolled + x * x * swung)
    carried = _carried(pose, covariance, moved, place, sigma_yaw)
    if open_way > 0.0:
        carried[:2, :2] += _slipping_on(covariance[:2, :2], slip, open_way, distance)
    return Prediction(moved, carried, True)


def _slipping_on(place: Array, slip: Slip, open_way: float, distance: float) -> Array:
    """What a slip that began before a step adds to the place's covariance (2, 2) on the step.

    It goes on only where images have left open how much it was: across lines that are in view
    every image says anew how far the robot has come.

    :param place: its covariance (2, 2) before the step.
    """
    before = slip.variance(open_way)
    more = slip.variance(open_way + distance) - before - slip.variance(distance)
    variance, axes = np.linalg.eigh(place)
    left_open = np.clip(variance / max(before, 1e-12), 0.0, 1.0)
    return (more * left_open * axes).dot(axes.T)


def by_velocity(past: Sequence[Track], last: Track, stamp_ns: int) -> Prediction | None:
    """Carry a pose on by its last velocity, and how that changes; None when it is too long ago.

    A direction that no image has fixed for a while is as uncertain as any acceleration since
    then could make it; without a velocity, as any speed could.

    :param past: the poses before the last one, in order; from PAST on its change is known.
    """
    dt, blind = (stamp_ns - last.stamp_ns) * 1e-9, (stamp_ns - last.seen_ns) * 1e-9
    if not 0.0 < dt <= blind <= _LONGEST_COAST:
        return None
    if not past:
        sigma, sigma_yaw = (speed * blind for speed in SPEED)
        return Prediction(last.pose, _carried(
            last.pose, last.covariance, last.pose, (sigma**2, 0.0, sigma**2), sigma_yaw), False)
    tracks = (*past[-PAST:], last)
    seconds = [(b.stamp_ns - a.stamp_ns) * 1e-9 for a, b in pairwise(tracks)]
    before = seconds[-1]
    if not 0.0 < before <= _LONGEST_COAST:
        return None
    velocities = [_step(a.pose, b.pose) / time for (a, b), time in zip(pairwise(tracks), seconds)]
    velocity = velocities[-1]
    if len(velocities) == PAST:
        change = _going_on(*(
            2.0 * (v - u) / (s + t)
            for (u, v), (s, t) in zip(pairwise(velocities), pairwise(seconds))))
        known = np.abs(change) > _CERTAIN * _sigma_of_change(tracks[-3:], seconds[-2:])
        velocity = velocity + 0.5 * (before + dt) * np.where(known, change, 0.0)
    moved = last.pose @ Pose2(*(dt * velocity).tolist())
    sigma, sigma_yaw = (0.5 * a * blind * (blind + before) for a in _ACCELERATION)
    return Prediction(
        moved, _carried(
            last.pose, last.covariance, moved, (sigma**2, 0.0, sigma**2), sigma_yaw), False)


def _step(before: Pose2, after: Pose2) -> Array:
    """The motion (x, y, yaw) from one pose to another, seen from the first (3,)."""
    step = before.inverse() @ after
    return np.array([step.x, step.y, step.yaw])


def _sigma_of_change(tracks: Sequence[Track], seconds: Sequence[float]) -> Array:
    """What the errors of three poses make of the change of velocity (3,), one sigma.

    :param seconds: between them.
    """
    s, t = seconds
    a, b, c = (track.covariance.diagonal() for track in tracks)
    variance = a / s**2 + b * (1.0 / s + 1.0 / t) ** 2 + c / t**2
    # The change is seen from the robot, which may look anywhere.
    variance = np.array([variance[0] + variance[1]] * 2 + [variance[2]])
    return 2.0 / (s + t) * np.sqrt(variance)


def _going_on(first: Array, second: Array) -> Array:
    """The change of velocity that goes on, of the last two in turn (3,), m/s^2 and rad/s^2.

    It is the last, but no more than twice the one before, and nothing where their signs differ:
    what a robot begins or ends at once, as it halts, leads nowhere.
    """
    lesser = np.sign(second) * np.minimum(2.0 * np.abs(first), np.abs(second))
    return np.where(first * second > 0.0, lesser, 0.0)


def _carried(
    pose: Pose2, covariance: Array, moved: Pose2, place: tuple[float, float, float],
    sigma_yaw: float,
) -> Array:
    """Covariance (3, 3) of a pose moved on: an error in yaw swings the step sideways.

    :param place: what the step adds to the covariance of (x, y): xx, xy and yy, m^2.
    :param sigma_yaw: of what it adds to the yaw, rad.
    """
    # How the place goes as the yaw does.
    a, b = pose.y - moved.y, moved.x - pose.x
    (xx, xy, xt), (_, yy, yt), (_, _, tt) = covariance.tolist()
    across_x, across_y = xt + a * tt, yt + b * tt
    mixed = xy + a * yt + b * across_x + place[1]
    return np.array([
        [xx + a * (xt + across_x) + place[0], mixed, across_x],
        [mixed, yy + b * (yt + across_y) + place[2], across_y],
        [across_x, across_y, tt + sigma_yaw**2]])
