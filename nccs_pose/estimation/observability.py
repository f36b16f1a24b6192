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

"""What a set of lines cannot tell about a planar pose.

A planar motion that maps every line onto itself leaves every ray's S as it was, so no pixel can
tell the pose before from the pose after. There are three such motions:

- sliding along lines that are all horizontal and parallel;
- turning about a single vertical line;
- half a turn about a vertical axis that every horizontal line meets, while the only vertical
  line allowed is the axis itself. A single line and any two that are not parallel are such sets;
  slanted lines never are.

They follow from the lines alone. What too few or badly placed pixels cannot tell shows in the
eigenvectors of the information matrix.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
import math

from nccs_pose.estimation.general_lines import ALIGNED
from nccs_pose.estimation.pose_monomials import feet_in_plan
from nccs_pose.geometry.pose import Array, Pose2
from nccs_pose.geometry.small_matrices import inverse_2x2, is_definite
import numpy as np

# Two lines of a map written by hand are parallel, or meet, when they do so up to this (rad, m).
COINCIDENT = 1e-6
# A component of a unit direction in (m, m, rad) that the words leave out.
_SILENT = 1e-3


@dataclass(frozen=True, eq=False)
class Symmetry:
    """The planar motions of the map that leave a set of lines as it is.

    :ivar words: what the set is, e.g. ``parallel lines``; empty without any symmetry.
    :ivar sliding: unit vector (2,) in the map along which the set can slide, or None.
    :ivar turning: the point (2,) about which the set can turn by any angle, or None.
    :ivar half_turn: the point (2,) about which half a turn maps the set onto itself, or None.
        With ``sliding`` it is one of many on the line.
    """

    words: str = ''
    sliding: Array | None = None
    turning: Array | None = None
    half_turn: Array | None = None

    def shifted(self, offset: Array) -> Symmetry:
        """The same, with its points moved by an offset (2,)."""
        return replace(
            self,
            turning=None if self.turning is None else self.turning + offset,
            half_turn=None if self.half_turn is None else self.half_turn + offset)


@dataclass(frozen=True, eq=False)
class Unobserved:
    """A direction of the pose that the pixels do not fix.

    :ivar direction: unit vector (3,) in (x, y, yaw) of T_map_base; m, m, rad.
    :ivar deviation: standard deviation along it; infinite where nothing is known.
    :ivar words: for messages and diagnostics.
    """

    direction: Array
    deviation: float
    words: str


def symmetry(directions: Array, moments: Array) -> Symmetry:
    """The symmetry of a set of lines.

    :param directions: unit directions in the map (L, 3).
    :param moments: their moments (L, 3), metres.
    """
    horizontal = np.abs(directions[:, 2]) <= ALIGNED
    vertical = (np.abs(directions[:, :2]) <= ALIGNED).all(axis=1)
    if not (horizontal | vertical).all():
        return Symmetry()
    feet = feet_in_plan(directions, moments)
    d, q, axes = directions[horizontal, :2], feet[horizontal], feet[vertical]
    if len(axes):
        if not _same(axes):
            return Symmetry()
        if not len(d):
            return Symmetry('one vertical line', turning=axes[0])
        if np.abs(_offsets(d, q, axes[0])).max() > COINCIDENT:
            return Symmetry()
        return Symmetry('lines through one vertical line', half_turn=axes[0])
    if np.abs(d[:, 0] * d[0, 1] - d[:, 1] * d[0, 0]).max() <= COINCIDENT:
        if np.abs(_offsets(d, q, q[0])).max() > COINCIDENT:
            return Symmetry('parallel lines', sliding=d[0])
        return Symmetry('one line', sliding=d[0], half_turn=q[0])
    # The point nearest to all of them, by least squares on their normals (-d_y, d_x).
    normals = np.stack([-d[:, 1], d[:, 0]], axis=1)
    (xx, xy), (_, yy) = (normals.T @ normals).tolist()
    x, y = (normals.T @ (normals * q).sum(axis=1)).tolist()
    a, b, c = inverse_2x2(xx, xy, yy)
    point = np.array([a * x + b * y, b * x + c * y])
    if np.abs(_offsets(d, q, point)).max() > COINCIDENT:
        return Symmetry()
    words = 'two lines that meet' if len(d) == 2 else 'concurrent lines'
    return Symmetry(words, half_turn=point)


def _same(points: Array) -> bool:
    return bool(np.abs(points - points[0]).max() <= COINCIDENT)


def _offsets(d: Array, q: Array, point: Array) -> Array:
    """Signed distances (L,) in plan from a point to the lines q + a d."""
    return d[:, 0] * (point[1] - q[:, 1]) - d[:, 1] * (point[0] - q[:, 0])


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
        certain = value > 1e-12 * max(values[-1], 1.0)
        found.append(Unobserved(
            vector, 1.0 / math.sqrt(value) if certain else math.inf, _words(vector, pose)))
    return tuple(found)


def _words(direction: Array, pose: Pose2) -> str:
    """An infinitesimal motion of the pose in words: a sliding or a turning in the map."""
    vx, vy, turn = direction.tolist()
    if abs(turn) <= _SILENT:
        return f'position along ({vx:.3f}, {vy:.3f})'
    # The velocity of the robot is turn * J (position - centre), J the quarter turn.
    return f'turning about ({pose.x - vy / turn:.3f}, {pose.y + vx / turn:.3f}) m'
