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

"""How the robot moves: planar trajectories of a robot that cannot move sideways."""

from __future__ import annotations

import dataclasses
import math
from typing import Protocol

from nccs_pose.errors import SimulationError
from nccs_pose.geometry.pose import Pose2
import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline

_WAYPOINTS = 6  # of a random loop
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(5)  # found once: each pose of a loop needs them


@dataclasses.dataclass(frozen=True)
class Twist:
    """Velocity of a robot that cannot move sideways.

    :ivar forward: along x of base_link, m/s.
    :ivar turn: about z, rad/s.
    """

    forward: float = 0.0
    turn: float = 0.0


def integrate_twist(pose: Pose2, twist: Twist, duration: float) -> Pose2:
    """Give the pose after a constant twist of `duration` s (may be negative): a circular arc."""
    distance, angle = twist.forward * duration, twist.turn * duration
    half = 0.5 * angle
    # The chord of the arc: distance * sin(half) / half, in the direction of half the angle.
    chord = distance * (math.sin(half) / half if abs(half) > 1e-8 else 1.0)
    return pose @ Pose2(chord * math.cos(half), chord * math.sin(half), angle)


class Trajectory(Protocol):
    """Where the robot is and how it moves, at any time t >= 0 in s."""

    def pose(self, t: float) -> Pose2:
        """Give the pose of base_link in the map."""

    def twist(self, t: float) -> Twist:
        """Give its velocity, consistent with the poses."""


class Loop:
    """A closed smooth track through waypoints, driven again and again at one speed.

    The track is a periodic cubic spline; the robot looks along it, so that it never slips
    sideways, and its turn rate is speed times curvature.
    """

    def __init__(self, waypoints: ArrayLike, speed: float) -> None:
        """Lay the track.

        :param waypoints: (N, 2) in the map, m; N >= 3, none equal to the next.
        :param speed: m/s.
        :raises SimulationError: if the waypoints make no loop or the speed is not positive.
        """
        points = np.asarray(waypoints, dtype=float)
        if points.ndim != 2 or points.shape[1] != 2 or len(points) < 3:
            raise SimulationError(f'a loop needs (N, 2) waypoints, N >= 3, not {points.shape}')
        if not (math.isfinite(speed) and speed > 0.0):
            raise SimulationError(f'loop speed must be > 0 m/s, is {speed}')
        closed = np.vstack([points, points[:1]])
        chords = np.linalg.norm(np.diff(closed, axis=0), axis=1)
        if not chords.min() > 1e-6:
            raise SimulationError(f'waypoint {int(chords.argmin())} of the loop equals the next')
        self.speed = speed
        # The square root of the chords as knots keeps the track from overshooting.
        knots = np.r_[0.0, np.cumsum(np.sqrt(chords))]
        self._track = CubicSpline(knots, closed, bc_type='periodic')
        self._velocity, self._acceleration = self._track.derivative(1), self._track.derivative(2)
        self._knots = np.linspace(0.0, knots[-1], 200 * len(points) + 1)
        self._lengths = self._measure(self._knots)
        self.length = float(self._lengths[-1])

    def _measure(self, knots: np.ndarray) -> np.ndarray:
        """Length of the track up to each knot, by Gauss-Legendre over each piece."""
        half = 0.5 * np.diff(knots)
        at = knots[:-1, None] + half[:, None] * (1.0 + _NODES)
        speed = np.linalg.norm(self._velocity(at), axis=-1)
        return np.r_[0.0, np.cumsum(half * (speed @ _WEIGHTS))]

    def _parameter(self, t: float) -> float:
        """Spline parameter after t s: looked up, then one Newton step on the length."""
        target = (self.speed * t) % self.length
        i = int(np.searchsorted(self._lengths, target, side='right')) - 1
        i = min(max(i, 0), len(self._knots) - 2)
        left, right = self._knots[i], self._knots[i + 1]
        share = (target - self._lengths[i]) / (self._lengths[i + 1] - self._lengths[i])
        guess = left + share * (right - left)
        travelled = self._lengths[i] + self._measure(np.array([left, guess]))[-1]
        return float(guess + (target - travelled) / np.linalg.norm(self._velocity(guess)))

    def pose(self, t: float) -> Pose2:
        parameter = self._parameter(t)
        (x, y), (vx, vy) = self._track(parameter), self._velocity(parameter)
        return Pose2(float(x), float(y), math.atan2(vy, vx))

    def twist(self, t: float) -> Twist:
        parameter = self._parameter(t)
        (vx, vy), (ax, ay) = self._velocity(parameter), self._acceleration(parameter)
        return Twist(self.speed, self.speed * float(vx * ay - vy * ax) / math.hypot(vx, vy) ** 3)


def figure_of_eight(speed: float = 0.35, phase: float = 0.0) -> Loop:
    """Give a lying figure of eight, 2.2 x 1.3 m about the map's origin: turns both ways.

    :param speed: m/s.
    :param phase: where it begins: 0 in the middle, -pi/2 at the end of least x, rad.
    """
    angle = phase + np.arange(16) * (2.0 * np.pi / 16)
    points = np.stack([1.1 * np.sin(angle), 0.65 * np.sin(2.0 * angle)], axis=1)
    return Loop(points, speed)


def random_loop(rng: np.random.Generator, speed: float = 0.35) -> Loop:
    """Give a smooth loop of its own for every generator, about the map's origin.

    Its waypoints stay within 1.2 m of the origin along x and 0.8 m along y.
    """
    step = 2.0 * np.pi / _WAYPOINTS
    angle = step * (np.arange(_WAYPOINTS) + rng.uniform(-0.15, 0.15, _WAYPOINTS))
    angle += rng.uniform(0.0, 2.0 * np.pi)
    radius = rng.uniform(0.65, 1.0, _WAYPOINTS)
    way = rng.choice([-1.0, 1.0])
    ellipse = np.stack([np.cos(angle), way * np.sin(angle)], axis=1)
    return Loop(radius[:, None] * ellipse * np.array([1.2, 0.8]), speed)
