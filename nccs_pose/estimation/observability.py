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

"""What the lines in view cannot tell about a planar pose.

A planar motion that maps every line onto itself leaves every ray's S as it was, so no pixel can
tell the pose before from the pose after. There are three such motions:

- sliding along lines that are all horizontal and parallel;
- turning about a single vertical line;
- half a turn about a vertical axis that every horizontal line meets, while the only vertical
  line allowed is the axis itself. A single line and any two that are not parallel are such sets;
  slanted lines never are.

The first two, and what too few or badly placed pixels cannot tell, show in the eigenvectors of
the information matrix: :func:`unobserved_directions`. Half a turn gives a second pose that fits
as well: :func:`.global_pose.solve` returns both.
"""

from __future__ import annotations

from dataclasses import dataclass

from nccs_pose.geometry.pose import Array, Pose2
from nccs_pose.geometry.small_matrices import is_definite
import numpy as np
from numpy.typing import NDArray

# Two lines of a map written by hand are parallel when they are so up to this, rad.
_PARALLEL = 1e-6
# A component of a unit direction in (m, m, rad) that the words leave out.
_SILENT = 1e-3


@dataclass(frozen=True, eq=False)
class Unobserved:
    """A direction of the pose that the pixels do not fix.

    :ivar direction: unit vector (3,) in (x, y, yaw) of T_map_base; m, m, rad.
    :ivar words: for messages and diagnostics.
    """

    direction: Array
    words: str


def unobserved_directions(
    information: Array, pose: Pose2, *, limit: float = 1.0,
) -> tuple[Unobserved, ...]:
    """The eigenvectors of the information along which the pose is not fixed, worst first.

    :param information: of (x, y, yaw) (3, 3), in 1/m^2, 1/(m rad), 1/rad^2.
    :param pose: where it holds.
    :param limit: a direction is unobserved when its standard deviation, in metres and radians
        alike, is larger than this.
    """
    if is_definite(information, 1.0 / (limit * limit)):
        return ()
    values, vectors = np.linalg.eigh(information)
    found = []
    for value, vector in zip(values.tolist(), vectors.T):
        if value * limit * limit >= 1.0:
            break
        # The sign of an eigenvector means nothing: the largest component is made positive.
        vector = vector * np.sign(vector[np.argmax(np.abs(vector))])
        found.append(Unobserved(vector, _words(vector, pose)))
    return tuple(found)


def parallel_to(direction: Array, directions: Array) -> NDArray[np.bool_]:
    """Which of the directions (L, 3) of lines on the floor run along one (3,), either way (L,)."""
    x, y, _ = directions.T
    return np.asarray(np.abs(x * direction[1] - y * direction[0]) <= _PARALLEL)


def _words(direction: Array, pose: Pose2) -> str:
    """An infinitesimal motion of the pose in words: a sliding or a turning in the map."""
    vx, vy, turn = direction.tolist()
    if abs(turn) <= _SILENT:
        return f'position along ({vx:.3f}, {vy:.3f})'
    # The velocity of the robot is turn * J (position - centre), J the quarter turn.
    return f'turning about ({pose.x - vy / turn:.3f}, {pose.y + vx / turn:.3f}) m'
