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

"""How the robot moves: unicycle trajectories."""

from __future__ import annotations

import dataclasses
import math

from nccs_pose.geometry.pose import Pose2


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
