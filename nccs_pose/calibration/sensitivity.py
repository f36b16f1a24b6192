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

"""The side residual of many frames and its derivatives by everything that shapes the rig.

With the reflected ray (r, m) and a line (d, mu) in the map frame, S = r . mu + d . (m x r) has
the derivatives a = dS/dr = mu + d x m and b = dS/dm = r x d. Everything else is the chain rule
run backwards through the reflection (the paper's eqs. 9 to 11), two vectors a point, whatever the
number of parameters:

    r = v - 2 k n,  k = v.n / n.n       a_v = a - 2 (a.n / n.n) n,  a_n = -2 ((a.n / n.n) r + k a)
    n = (x, y, A z + B / 2)             b' = b + (a_nx, a_ny, A a_nz)
    m = o + t v on the mirror           q = b'.v / n.v
    dS/do = b' - q n                    dS/dv = a_v + t dS/do
    dS/dA = a_nz z - q z^2 / 2          dS/dB = a_nz / 2 - q z / 2        dS/dC = q / 2
"""

from __future__ import annotations

from dataclasses import dataclass

from nccs_pose.calibration.observations import Observations
from nccs_pose.geometry.camera import PinholeCamera
from nccs_pose.geometry.lines import LineMap
from nccs_pose.geometry.pose import Array
from nccs_pose.geometry.rig import Rig
import numpy as np
from numpy.typing import NDArray

_TINY = 1e-12  # metres per pixel: below this a pixel does not tell where the line is


@dataclass(frozen=True, eq=False)
class IncidentRays:
    """Unit incident directions (N, 3) in the optical frame and their derivatives (N, 3, 2)."""

    direction: Array
    jacobian: Array

    @classmethod
    def of(cls, camera: PinholeCamera, pixels: Array) -> IncidentRays:
        """Look along pixels (N, 2)."""
        return cls(*camera.directions_with_jacobian(pixels))


@dataclass(frozen=True, eq=False)
class Sensitivity:
    """S of N points, and dS by what may move. Lengths in metres, angles in radians.

    :ivar side: S (N,).
    :ivar hit: whether the pixel sees the mirror and can tell where its line is (N,); where not,
        everything is zero.
    :ivar pixel: dS/d(u, v) (N, 2).
    :ivar pose: dS/d(x, y, yaw) of the frame's T_map_base (N, 3).
    :ivar cop: dS/do (N, 3).
    :ivar camera_rotation: by w with R_mirror_camera <- exp(w) R_mirror_camera (N, 3).
    :ivar mirror: by A, B, C (N, 3).
    :ivar mounting_rotation: by w with R_base_mirror <- exp(w) R_base_mirror (N, 3).
    :ivar mounting_translation: (N, 3).
    :ivar width: by the tape's width (N,).
    :ivar line_offset: by a shift of the line to its left (N,).
    :ivar line_turn: by a turn of the line about its middle, counter-clockwise (N,).
    """

    side: Array
    hit: NDArray[np.bool_]
    pixel: Array
    pose: Array
    cop: Array
    camera_rotation: Array
    mirror: Array
    mounting_rotation: Array
    mounting_translation: Array
    width: Array
    line_offset: Array
    line_turn: Array

    @property
    def slope(self) -> Array:
        """|dS/d(u, v)| (N,), metres per pixel; 1 where nothing is hit."""
        norm = np.sqrt(np.einsum('ni,ni->n', self.pixel, self.pixel))
        return np.where(self.hit, norm, 1.0)


def side_sensitivity(
    rig: Rig, line_map: LineMap, poses: Array, observations: Observations,
    incident: IncidentRays | None = None,
) -> Sensitivity:
    """S and its derivatives for every point.

    :param poses: T_map_base of every frame (F, 3): x, y, yaw.
    :param incident: of this camera and these pixels, if they are at hand.
    """
    incident = incident or IncidentRays.of(rig.camera, observations.pixels)
    frame, reflection = observations.frame, _Reflection(rig, incident)
    m = reflection.m

    turn = _yaw_matrices(poses[:, 2])
    to_map = (turn @ rig.T_base_mirror.rotation)[frame]
    r_map, arm = _rotate(to_map, reflection.r), _rotate(to_map, m)
    from_base = _rotate(turn[frame], np.broadcast_to(rig.T_base_mirror.translation, m.shape)) + arm
    m_map = from_base.copy()
    m_map[:, :2] += poses[frame, :2]
    line = EdgeLines(line_map, observations.line, observations.side)
    a = line.moment + np.cross(line.direction, m_map)
    b = np.cross(r_map, line.direction)
    side = _dot(r_map, a)

    torque = np.cross(r_map, a)
    pose = np.stack([b[:, 0], b[:, 1], torque[:, 2] + np.cross(from_base, b)[:, 2]], axis=1)
    back = np.swapaxes(turn[frame], 1, 2)
    mounting_rotation = _rotate(back, torque + np.cross(arm, b))
    mounting_translation = _rotate(back, b)
    tape = line.derivatives(r_map, m_map)

    to_mirror = np.swapaxes(to_map, 1, 2)
    by_v, cop, by_mirror = reflection.back(_rotate(to_mirror, a), _rotate(to_mirror, b))
    pixel = np.einsum('ni,nij->nj', by_v @ rig.R_mirror_camera, incident.jacobian)
    hit = reflection.hit & (np.abs(pixel).max(axis=1, initial=0.0) > _TINY)
    columns = (side, pixel, pose, cop, np.cross(reflection.v, by_v), by_mirror,
               mounting_rotation, mounting_translation, *tape)
    if not hit.all():
        for array in columns:
            array[~hit] = 0.0
    return Sensitivity(columns[0], hit, *columns[1:])


class _Reflection:
    """Rays reflected in the mirror frame, and the chain rule back through that (see the module).

    :ivar v: unit incident directions (N, 3).
    :ivar m: mirror points (N, 3), metres.
    :ivar r: unit reflected directions (N, 3).
    :ivar hit: whether there is a mirror point (N,); where not, the rest has no meaning.
    """

    def __init__(self, rig: Rig, incident: IncidentRays) -> None:
        self._mirror, self._cop = rig.mirror, rig.cop
        self.v = incident.direction @ rig.R_mirror_camera.T
        self.m, self.hit = rig.mirror.intersect(rig.cop, self.v)
        self._n = n = rig.mirror.normal(self.m)
        self._vn = np.where(self.hit, _dot(self.v, n), 1.0)
        self._nn = np.where(self.hit, _dot(n, n), 1.0)
        self._k = self._vn / self._nn
        self.r = self.v - (2.0 * self._k)[:, None] * n

    def back(self, a: Array, b: Array) -> tuple[Array, Array, Array]:
        """dS/dv, dS/do and dS/d(A, B, C), each (N, 3), from a = dS/dr and b = dS/dm (N, 3)."""
        n, z = self._n, self.m[:, 2]
        share = _dot(a, n) / self._nn
        a_v = a - (2.0 * share)[:, None] * n
        a_n = -2.0 * (share[:, None] * self.r + self._k[:, None] * a)
        b = b + a_n * [1.0, 1.0, self._mirror.A]
        q = _dot(b, self.v) / self._vn
        by_cop = b - q[:, None] * n
        t = np.linalg.norm(self.m - self._cop, axis=1)
        by_mirror = np.stack(
            [(a_n[:, 2] - 0.5 * q * z) * z, 0.5 * (a_n[:, 2] - q * z), 0.5 * q], axis=1)
        return a_v + t[:, None] * by_cop, by_cop, by_mirror


class EdgeLines:
    """The line, or edge of it, that each point is on.

    :ivar direction: (N, 3).
    :ivar moment: (N, 3), metres.
    """

    def __init__(
        self, line_map: LineMap, index: NDArray[np.intp], side: NDArray[np.int8],
    ) -> None:
        # A line that stands upright has no left; nothing of it can be shifted that way.
        self.direction = line_map.directions[index]
        self.left = line_map.lefts[index]
        self.half_side = 0.5 * side
        shift = self.half_side * line_map.widths[index]
        self.middle = (0.5 * (line_map.starts + line_map.ends))[index] + shift[:, None] * self.left
        self.moment = np.cross(self.middle, self.direction)

    def derivatives(self, r: Array, m: Array) -> tuple[Array, Array, Array]:
        """Derivatives of S by the tape's width, the line's offset and its turn (N,) each."""
        offset = _dot(r, np.cross(self.left, self.direction))
        # d <- d + phi left about the middle (the edge turns about the tape's own middle, which
        # differs from its own by half a width along d, a shift that a line does not feel).
        turn = _dot(r, np.cross(self.middle, self.left)) + _dot(self.left, np.cross(m, r))
        return self.half_side * offset, offset, turn


def _yaw_matrices(yaw: Array) -> Array:
    c, s = np.cos(yaw), np.sin(yaw)
    matrices = np.zeros((len(yaw), 3, 3))
    matrices[:, 0, 0], matrices[:, 0, 1], matrices[:, 1, 0], matrices[:, 1, 1] = c, -s, s, c
    matrices[:, 2, 2] = 1.0
    return matrices


def _rotate(matrices: Array, vectors: Array) -> Array:
    return np.einsum('nij,nj->ni', matrices, vectors)


def _dot(a: Array, b: Array) -> Array:
    return np.einsum('ni,ni->n', a, b)
