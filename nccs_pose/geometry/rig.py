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

"""The rig: mirror, camera and mounting; from pixels to rays in base_link and back."""

from __future__ import annotations

from dataclasses import dataclass, replace

from nccs_pose.errors import GeometryError
from nccs_pose.geometry.camera import PinholeCamera
from nccs_pose.geometry.mirror import QuadricMirror
from nccs_pose.geometry.pose import Array, checked_rotation, RigidTransform
from nccs_pose.geometry.projection import reflect_points
import numpy as np
from numpy.typing import ArrayLike, NDArray


@dataclass(frozen=True, eq=False)
class Rays:
    """Reflected rays in base_link, one per pixel, and how they turn with the pixel.

    :ivar direction: unit direction r (N, 3), away from the mirror.
    :ivar moment: Plücker moment w = m x r (N, 3), metres, with m the mirror point.
    :ivar direction_jacobian: dr/d(u, v) (N, 3, 2).
    :ivar moment_jacobian: dw/d(u, v) (N, 3, 2).
    :ivar hit: whether the pixel sees the mirror (N,); where not, the rest is zero.
    """

    direction: Array
    moment: Array
    direction_jacobian: Array
    moment_jacobian: Array
    hit: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.hit)

    def __getitem__(self, index: NDArray[np.bool_] | NDArray[np.intp] | slice) -> Rays:
        return Rays(
            self.direction[index], self.moment[index], self.direction_jacobian[index],
            self.moment_jacobian[index], self.hit[index])

    def floor_points(self) -> tuple[Array, NDArray[np.bool_]]:
        """Where the rays meet the ground z = 0 of base_link.

        With r x w = m - (m . r) r, the foot of the ray, it is found without m itself.

        :returns: points (N, 2) in metres, zero where there is none, and which rays reach (N,).
        """
        r, w = self.direction, self.moment
        reaches = self.hit & (r[:, 2] < -1e-9)
        rz = np.where(reaches, r[:, 2], -1.0)
        # w = p x r with p_z = 0 gives w_x = p_y r_z and w_y = -p_x r_z.
        points = np.stack([-w[:, 1] / rz, w[:, 0] / rz], axis=1)
        return np.where(reaches[:, None], points, 0.0), reaches


@dataclass(frozen=True, eq=False)
class Rig:
    """A non-central catadioptric camera on a robot.

    :ivar mirror: the quadric, in its own frame.
    :ivar camera: the perspective camera.
    :ivar cop: centre of projection o = (0, o_y, o_z) in the mirror frame (3,), metres.
    :ivar R_mirror_camera: turns optical-frame directions into the mirror frame (3, 3).
    :ivar T_base_mirror: the mounting on the robot.
    :raises GeometryError: if the camera is inside the mirror, off the plane x = 0, or cannot
        see the mirror.
    """

    mirror: QuadricMirror
    camera: PinholeCamera
    cop: Array
    R_mirror_camera: Array
    T_base_mirror: RigidTransform

    def __post_init__(self) -> None:
        cop = self.mirror.checked_cop(self.cop)
        object.__setattr__(self, 'cop', cop)
        object.__setattr__(self, 'R_mirror_camera', checked_rotation(self.R_mirror_camera))
        camera = self.camera
        u, v = np.meshgrid(
            np.linspace(0.0, camera.width - 1.0, 48), np.linspace(0.0, camera.height - 1.0, 36))
        if not self.mirror_points(np.stack([u.ravel(), v.ravel()], axis=1))[1].any():
            raise GeometryError(
                f'the camera at {cop.tolist()} does not see the mirror: no pixel of its image '
                'back-projects onto it')

    def scaled(self, factor: float) -> Rig:
        """The same rig with its camera read out at another resolution."""
        return replace(self, camera=self.camera.scaled(factor))

    def mirror_points(self, pixels: ArrayLike) -> tuple[Array, NDArray[np.bool_]]:
        """Mirror points m (N, 3) in the mirror frame of pixels (N, 2), and which hit (N,)."""
        directions = self.camera.directions(np.asarray(pixels, dtype=float))
        return self.mirror.intersect(self.cop, directions @ self.R_mirror_camera.T)

    def back_project(self, pixels: ArrayLike) -> Rays:
        """Reflected rays in base_link of pixels (N, 2), with exact derivatives by the pixel.

        Incident ray v, mirror point m, normal n, reflected ray r = v - 2 n (v.n)/(n.n)
        (the paper's eq. 9; eq. 10 is the same without the division, eq. 11 is v).
        """
        seen, slopes = self.camera.directions_with_jacobian(np.asarray(pixels, dtype=float))
        # Components first, then value and derivatives by u and v, (3, 3, N): what is done to all
        # pixels lies in one piece.
        v: Array = np.empty((3, 3, len(seen)))
        v[:, 0], v[:, 1:] = seen.T, slopes.transpose(1, 2, 0)
        v = (self.R_mirror_camera @ v.reshape(3, -1)).reshape(v.shape)
        points, hit = self.mirror.intersect(self.cop, v[:, 0].T)
        m, n = np.empty_like(v), np.empty_like(v)
        m[:, 0], n[:, 0] = points.T, self.mirror.normal(points).T
        # m = o + t v stays on the surface: n . dm = 0.
        vn = (v * n[:, :1]).sum(axis=0)
        # Rows that miss are computed with harmless numbers and blanked at the end.
        vn[0] = np.where(hit, vn[0], 1.0)
        t = np.sqrt(np.square(m[:, 0] - self.cop[:, None]).sum(axis=0))
        m[:, 1:] = t * (v[:, 1:] - v[:, :1] * (vn[1:] / vn[0]))
        n[:, 1:] = m[:, 1:]
        n[2, 1:] *= self.mirror.A
        # k = 2 (v.n) / (n.n) and its derivatives.
        vn[1:] += (v[:, :1] * n[:, 1:]).sum(axis=0)
        nn = (n * n[:, :1]).sum(axis=0)
        nn[0] = np.where(hit, nn[0], 1.0)
        k = 2.0 * vn[0] / nn[0]
        dk = 2.0 * (vn[1:] - k * nn[1:]) / nn[0]
        r = v - k * n
        r[:, 1:] -= n[:, :1] * dk
        return self._rays_in_base(m, r, hit)

    def _rays_in_base(self, m: Array, r: Array, hit: NDArray[np.bool_]) -> Rays:
        """From points and directions in the mirror's frame, with their derivatives (3, 3, N)."""
        m, r = (
            (self.T_base_mirror.rotation @ a.reshape(3, -1)).reshape(a.shape) for a in (m, r))
        m[:, 0] += self.T_base_mirror.translation[:, None]
        w = _cross(m[:, :1], r)
        w[:, 1:] += _cross(m[:, 1:], r[:, :1])
        if not hit.all():
            r[..., ~hit] = w[..., ~hit] = 0.0
        return Rays(
            r[:, 0].T, w[:, 0].T, r[:, 1:].transpose(2, 0, 1), w[:, 1:].transpose(2, 0, 1), hit)

    def project(self, points: ArrayLike) -> tuple[Array, NDArray[np.bool_]]:
        """Pixels (N, 2) of points (N, 3) in base_link, and which are seen in the image (N,).

        Rows that are not seen are zero where the mirror or the camera cannot show the point.
        """
        in_mirror = self.T_base_mirror.inverse().apply(points)
        m, visible = reflect_points(self.mirror, self.cop, in_mirror)
        pixels, in_front = self.camera.project((m - self.cop) @ self.R_mirror_camera)
        seen = visible & in_front
        return np.where(seen[:, None], pixels, 0.0), seen & self.camera.contains(pixels)


def _cross(a: Array, b: Array) -> Array:
    """Cross products of vectors whose components come first (3, ...)."""
    return np.stack([
        a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])
