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

"""The perspective camera, with the distortion models of sensor_msgs/CameraInfo."""

from __future__ import annotations

from dataclasses import dataclass, replace
import math

from nccs_pose.errors import GeometryError
from nccs_pose.geometry.pose import Array
import numpy as np
from numpy.typing import ArrayLike, NDArray

_COEFFICIENTS = {'plumb_bob': 5, 'rational_polynomial': 8}
# Newton's method that inverts the distortion, in units of the image plane (focal lengths).
_MOST_STEPS = 20
# Far outside the calibrated field the model folds over; short steps keep the iterate finite.
_LONGEST_STEP = 0.5
_LAST_STEP = 1e-14
# A point is an inverse if it is distorted to within this of what was asked for.
_INVERTED = 1e-10
# Where the model's derivative has a smaller determinant it folds over.
_LEAST_DETERMINANT = 1e-6


@dataclass(frozen=True)
class PinholeCamera:
    """A pinhole with radial and tangential distortion (OpenCV's models).

    Pixel (0, 0) is the centre of the top-left pixel, u right, v down; the optical frame has z
    forward, x right, y down.

    :ivar width: pixels.
    :ivar height: pixels.
    :ivar fx: pixels.
    :ivar fy: pixels.
    :ivar cx: pixels.
    :ivar cy: pixels.
    :ivar distortion_model: ``plumb_bob`` or ``rational_polynomial``.
    :ivar distortion: k1 k2 p1 p2 k3 [k4 k5 k6]; empty for none.
    :raises GeometryError: if a value is no camera's.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion_model: str = 'plumb_bob'
    distortion: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if self.width < 1 or self.height < 1:
            raise GeometryError(f'camera: size {self.width} x {self.height} is no image size')
        values = (self.fx, self.fy, self.cx, self.cy, *self.distortion)
        if not all(math.isfinite(v) for v in values) or min(self.fx, self.fy) <= 0.0:
            raise GeometryError(
                f'camera: fx = {self.fx}, fy = {self.fy}, cx = {self.cx}, cy = {self.cy}, '
                f'distortion {list(self.distortion)}: focal lengths must be positive and all '
                'values finite')
        if self.distortion_model not in _COEFFICIENTS:
            raise GeometryError(
                f'camera: distortion_model {self.distortion_model!r} is not one of '
                f'{", ".join(_COEFFICIENTS)}')
        most = _COEFFICIENTS[self.distortion_model]
        if len(self.distortion) > most:
            raise GeometryError(
                f'camera: {self.distortion_model} has {most} distortion coefficients, '
                f'not {len(self.distortion)}')
        object.__setattr__(self, 'distortion', tuple(float(v) for v in self.distortion))

    @classmethod
    def from_K(
        cls, width: int, height: int, K: ArrayLike, distortion_model: str = 'plumb_bob',
        distortion: ArrayLike = (),
    ) -> PinholeCamera:
        """Build from the matrix K (3, 3), or its nine numbers, and CameraInfo's d.

        :raises GeometryError: if K is not [fx 0 cx; 0 fy cy; 0 0 1].
        """
        k = np.asarray(K, dtype=float).reshape(-1)
        pattern = k.size == 9 and np.allclose(k[[1, 3, 6, 7]], 0.0) and math.isclose(k[8], 1.0)
        if not pattern:
            raise GeometryError(f'camera: K = {k.tolist()} is not [fx 0 cx; 0 fy cy; 0 0 1]')
        coefficients = tuple(float(v) for v in np.asarray(distortion, dtype=float).reshape(-1))
        return cls(width, height, float(k[0]), float(k[4]), float(k[2]), float(k[5]),
                   distortion_model, coefficients)

    @property
    def K(self) -> Array:
        """The calibration matrix (3, 3)."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def scaled(self, factor: float) -> PinholeCamera:
        """The same camera read out at another resolution (pixel centres stay centres)."""
        return replace(
            self, width=round(self.width * factor), height=round(self.height * factor),
            fx=self.fx * factor, fy=self.fy * factor,
            cx=(self.cx + 0.5) * factor - 0.5, cy=(self.cy + 0.5) * factor - 0.5)

    def contains(self, pixels: Array) -> NDArray[np.bool_]:
        """Whether pixels (..., 2) lie in the image, to its outermost pixel centres."""
        u, v = pixels[..., 0], pixels[..., 1]
        return (u >= 0.0) & (u <= self.width - 1.0) & (v >= 0.0) & (v <= self.height - 1.0)

    def directions(self, pixels: Array) -> Array:
        """Unit directions (N, 3) in the optical frame of pixels (N, 2).

        Zero where the distortion model has no inverse.
        """
        return self.directions_with_jacobian(pixels)[0]

    def directions_with_jacobian(self, pixels: Array) -> tuple[Array, Array]:
        """Unit directions (N, 3) of pixels (N, 2), and their derivatives (N, 3, 2) by them."""
        pixels = np.asarray(pixels, dtype=float)
        focal = np.array([self.fx, self.fy])
        distorted = (pixels - [self.cx, self.cy]) / focal
        if any(self.distortion):
            plane, inverse, valid = self._undistort(distorted)
            jacobian = inverse / focal
        else:
            plane, valid = distorted, None
            jacobian = np.broadcast_to(np.diag(1.0 / focal), (len(pixels), 2, 2))
        scale = 1.0 / np.sqrt(1.0 + np.einsum('ni,ni->n', plane, plane))
        direction = np.empty((len(plane), 3))
        direction[:, :2] = plane * scale[:, None]
        direction[:, 2] = scale
        # d(p / |p|) = (I - v v^T) dp / |p| with dp in the image plane.
        jacobian = jacobian * scale[:, None, None]
        along = np.einsum('ni,nij->nj', direction[:, :2], jacobian)
        derivative = -direction[:, :, None] * along[:, None, :]
        derivative[:, :2] += jacobian
        if valid is not None and not valid.all():
            direction[~valid] = 0.0
            derivative[~valid] = 0.0
        return direction, derivative

    def project(self, directions: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Pixels (N, 2) of directions (N, 3) in the optical frame, and which lie in front (N,).

        Rows that lie behind the camera are zero.
        """
        directions = np.asarray(directions, dtype=float)
        in_front = directions[:, 2] > 0.0
        depth = np.where(in_front, directions[:, 2], 1.0)
        plane = directions[:, :2] / depth[:, None]
        if any(self.distortion):
            plane = self._distort(plane)[0]
        pixels = plane * [self.fx, self.fy] + [self.cx, self.cy]
        return np.where(in_front[:, None], pixels, 0.0), in_front

    def _distort(self, plane: Array) -> tuple[Array, Array]:
        """Distorted image-plane points (N, 2) and their derivatives (N, 2, 2)."""
        k = np.zeros(8)
        k[:len(self.distortion)] = self.distortion
        k1, k2, p1, p2, k3, k4, k5, k6 = k
        x, y = plane[:, 0], plane[:, 1]
        r2 = x * x + y * y
        above = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        below = 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6))
        radial = above / below
        slope = ((k1 + r2 * (2.0 * k2 + 3.0 * k3 * r2)) - radial
                 * (k4 + r2 * (2.0 * k5 + 3.0 * k6 * r2))) / below
        out = np.stack([
            x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y], axis=1)
        jacobian = np.empty((len(plane), 2, 2))
        jacobian[:, 0, 0] = radial + 2.0 * x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
        jacobian[:, 1, 1] = radial + 2.0 * y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x
        jacobian[:, 0, 1] = 2.0 * x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y
        jacobian[:, 1, 0] = jacobian[:, 0, 1]
        return out, jacobian

    def _undistort(self, distorted: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Invert :meth:`_distort` by Newton's method.

        :returns: plane points (N, 2), derivative of the inverse (N, 2, 2), converged (N,).
        """
        plane = distorted.copy()
        for _ in range(_MOST_STEPS):
            error, inverse, _ = self._inversion_error(plane, distorted)
            step = np.einsum('nij,nj->ni', inverse, error)
            plane -= np.clip(step, -_LONGEST_STEP, _LONGEST_STEP)
            if np.abs(step).max(initial=0.0) < _LAST_STEP:
                break
        error, inverse, regular = self._inversion_error(plane, distorted)
        return plane, inverse, regular & (np.abs(error).max(axis=1, initial=0.0) < _INVERTED)

    def _inversion_error(
        self, plane: Array, distorted: Array,
    ) -> tuple[Array, Array, NDArray[np.bool_]]:
        """How far off plane points (N, 2) are that should be distorted to others (N, 2).

        :returns: the distorted points less those that were asked for (N, 2), the inverse of the
            derivative (N, 2, 2), and whether the model does not fold over there (N,).
        """
        out, jacobian = self._distort(plane)
        determinant = (jacobian[:, 0, 0] * jacobian[:, 1, 1]
                       - jacobian[:, 0, 1] * jacobian[:, 1, 0])
        trace = jacobian[:, 0, 0] + jacobian[:, 1, 1]
        regular = (determinant > _LEAST_DETERMINANT) & (trace > 0.0)
        adjugate = np.empty_like(jacobian)
        adjugate[:, 0, 0], adjugate[:, 1, 1] = jacobian[:, 1, 1], jacobian[:, 0, 0]
        adjugate[:, 0, 1], adjugate[:, 1, 0] = -jacobian[:, 0, 1], -jacobian[:, 1, 0]
        inverse = adjugate / np.where(regular, determinant, 1.0)[:, None, None]
        return out - distorted, inverse, regular
