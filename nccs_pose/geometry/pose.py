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

"""Planar poses and rigid transforms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import math

from nccs_pose.errors import GeometryError
import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def wrap_angle(angle: ArrayLike) -> Array:
    """Wrap angles (...,) in radians to (-pi, pi]."""
    angle = np.asarray(angle, dtype=float)
    return -((-angle + math.pi) % (2.0 * math.pi) - math.pi)


def wrapped(angle: float) -> float:
    """As wrap_angle, for one number."""
    return -((-angle + math.pi) % (2.0 * math.pi) - math.pi)


def pose_differences(poses: Array, others: Array) -> Array:
    """Poses (..., 3) of x, y, yaw less others (..., 3), the difference of angles wrapped."""
    difference: Array = poses - others
    difference[..., 2] = wrap_angle(difference[..., 2])
    return difference


@dataclass(frozen=True)
class Pose2:
    """A planar pose, the rigid motion (x, y, yaw): ``p_a = T_a_b.apply(p_b)``.

    :ivar x: metres.
    :ivar y: metres.
    :ivar yaw: radians about z, counter-clockwise, wrapped to (-pi, pi].
    :raises GeometryError: if a component is not finite.
    """

    x: float = 0.0
    y: float = 0.0
    yaw: float = 0.0

    def __post_init__(self) -> None:
        x, y, yaw = self.x, self.y, self.yaw
        # Of hundreds of poses all are as they should be, most often.
        if type(x) is type(y) is type(yaw) is float and (
                -math.pi < yaw <= math.pi and math.isfinite(x) and math.isfinite(y)):
            return
        x, y, yaw = float(x), float(y), float(yaw)
        if not (math.isfinite(x) and math.isfinite(y) and math.isfinite(yaw)):
            raise GeometryError(f'pose ({x}, {y}, {yaw}) is not finite')
        object.__setattr__(self, 'x', x)
        object.__setattr__(self, 'y', y)
        object.__setattr__(self, 'yaw', wrapped(yaw))

    @classmethod
    def from_array(cls, array: Sequence[float] | Array) -> Pose2:
        """Build from (x, y, yaw)."""
        x, y, yaw = (float(v) for v in array)
        return cls(x, y, yaw)

    def as_array(self) -> Array:
        """Return (x, y, yaw) as an array (3,)."""
        return np.array([self.x, self.y, self.yaw])

    def minus(self, other: Pose2) -> Array:
        """Return (x, y, yaw) less another's as an array (3,), the difference of angles wrapped."""
        return np.array([
            self.x - other.x, self.y - other.y, wrapped(self.yaw - other.yaw)])

    @property
    def rotation(self) -> Array:
        """The rotation about z, (3, 3)."""
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])

    @property
    def translation(self) -> Array:
        """The translation (x, y, 0), (3,)."""
        return np.array([self.x, self.y, 0.0])

    def __matmul__(self, other: Pose2) -> Pose2:
        """Compose: ``T_a_c = T_a_b @ T_b_c``."""
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        return Pose2(
            self.x + c * other.x - s * other.y,
            self.y + s * other.x + c * other.y,
            self.yaw + other.yaw)

    def inverse(self) -> Pose2:
        """Return ``T_b_a``."""
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        return Pose2(-c * self.x - s * self.y, s * self.x - c * self.y, -self.yaw)

    def apply(self, points: ArrayLike) -> Array:
        """Map points (..., 2) or (..., 3) from frame b to frame a."""
        points = np.asarray(points, dtype=float)
        n = points.shape[-1]
        return points @ self.rotation[:n, :n].T + self.translation[:n]


@dataclass(frozen=True, eq=False)
class RigidTransform:
    """A rigid motion in space: ``p_a = T_a_b.apply(p_b)``.

    :ivar rotation: (3, 3), orthonormal with determinant 1.
    :ivar translation: (3,) metres.
    :raises GeometryError: if the rotation is none, or a value is not finite.
    """

    rotation: Array
    translation: Array

    def __post_init__(self) -> None:
        object.__setattr__(self, 'translation', checked_vector('translation', self.translation))
        object.__setattr__(self, 'rotation', checked_rotation(self.rotation))

    @classmethod
    def from_rpy(cls, rpy: ArrayLike, translation: ArrayLike) -> RigidTransform:
        """Build from roll, pitch, yaw (rad) with R = Rz(yaw) Ry(pitch) Rx(roll)."""
        roll, pitch, yaw = np.asarray(rpy, dtype=float)
        cr, sr, cp, sp = math.cos(roll), math.sin(roll), math.cos(pitch), math.sin(pitch)
        rx = np.array([[1.0, 0.0, 0.0], [0.0, cr, -sr], [0.0, sr, cr]])
        ry = np.array([[cp, 0.0, sp], [0.0, 1.0, 0.0], [-sp, 0.0, cp]])
        return cls(Pose2(yaw=yaw).rotation @ ry @ rx, np.asarray(translation, dtype=float))

    def rpy(self) -> Array:
        """Return roll, pitch, yaw (3,) in radians, the inverse of :meth:`from_rpy`."""
        r = self.rotation
        return np.array([
            math.atan2(r[2, 1], r[2, 2]),
            math.atan2(-r[2, 0], math.hypot(r[0, 0], r[1, 0])),
            math.atan2(r[1, 0], r[0, 0])])

    def __matmul__(self, other: RigidTransform) -> RigidTransform:
        """Compose: ``T_a_c = T_a_b @ T_b_c``."""
        return RigidTransform(
            self.rotation @ other.rotation, self.apply(other.translation))

    def inverse(self) -> RigidTransform:
        """Return ``T_b_a``."""
        return RigidTransform(self.rotation.T, -self.rotation.T @ self.translation)

    def apply(self, points: ArrayLike) -> Array:
        """Map points (..., 3) from frame b to frame a."""
        return np.asarray(points, dtype=float) @ self.rotation.T + self.translation

    def rotate(self, vectors: ArrayLike) -> Array:
        """Map directions (..., 3) from frame b to frame a."""
        return np.asarray(vectors, dtype=float) @ self.rotation.T


def checked_vector(name: str, value: ArrayLike) -> Array:
    """Return a vector (3,), a copy.

    :param name: what it is, for the message.
    :raises GeometryError: if it is not three finite numbers.
    """
    vector = np.array(value, dtype=float)
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise GeometryError(f'{name} {vector.tolist()} is not three finite numbers')
    return vector


def checked_rotation(rotation: ArrayLike) -> Array:
    """Return a rotation matrix (3, 3), cleaned of the rounding of hand-typed digits.

    :raises GeometryError: if it is further than 1e-6 from orthonormal, or a reflection.
    """
    rotation = np.array(rotation, dtype=float)
    if rotation.shape != (3, 3) or not np.isfinite(rotation).all():
        raise GeometryError(f'rotation {rotation.tolist()} is not a finite 3 x 3 matrix')
    error = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    if error > 1e-6 or np.linalg.det(rotation) < 0.0:
        raise GeometryError(
            f'rotation {rotation.tolist()} is not orthonormal with determinant +1 '
            f'(largest error {error:.2g})')
    if error < 1e-15:
        return rotation
    u, _, vt = np.linalg.svd(rotation)
    return u @ vt


def cross_matrix(vector: Array) -> Array:
    """The matrix (3, 3) that turns b into vector x b."""
    x, y, z = vector.tolist()
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def rotation_exp(vector: ArrayLike) -> Array:
    """Rotation matrix (3, 3) of a rotation vector (3,) in radians (Rodrigues)."""
    vector = np.asarray(vector, dtype=float)
    angle = float(np.linalg.norm(vector))
    k = cross_matrix(vector)
    # sinc keeps both series exact through angle = 0.
    a = np.sinc(angle / math.pi)
    b = 0.5 * np.sinc(0.5 * angle / math.pi) ** 2
    return np.eye(3) + a * k + b * (k @ k)
