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
"""Forward projection of points: where on the mirror the camera sees a point in space.

By Fermat, the mirror point m makes the path f(m) = |o - m| + |p - m| stationary. The mirror is
the boundary of a convex body, f is convex, and the mirror condition with (o - m).n > 0 and
(p - m).n > 0 is the optimality condition of min f over the body. Hence (i) a point has at most
one visible reflection, (ii) it has none exactly if the segment o-p meets the body, and (iii) a
candidate that satisfies the reflection law on the right sides *is* the reflection.

So most points take a few steps of Newton's method on f, and whatever does not end in such a
certificate goes to the polynomial of degree 8 (:mod:`nccs_pose.geometry.point_polynomial`), which
knows every candidate.
"""

from __future__ import annotations

from nccs_pose.errors import GeometryError
from nccs_pose.geometry.mirror import QuadricMirror
from nccs_pose.geometry.point_polynomial import PointConditions, real_roots
from nccs_pose.geometry.pose import Array
import numpy as np
from numpy.typing import ArrayLike, NDArray

_CHUNK = 2048  # points at a time: the working arrays stay in the processor's cache
_NEWTON_STEPS = 7  # what has no certificate by then goes to the polynomial
_POLISH_STEPS = 25  # from its roots, which may be far off where two of them meet
_SETTLED = 1e-10  # length of the last step, in distances of the camera from the apex
_LONGEST_STEP = 0.5  # likewise
_REAL_ROOT = 1e-3  # generous: double roots split by rounding; the certificate decides
_EQUATOR_MARGIN = 1.0 - 1e-9  # of r^2: at the equator of a spheroid h is zero
_INSIDE_EQUATOR = 0.98  # of the largest r^2: where a step ends that would go beyond
_STEEPEST_GUESS = 4.0  # tan of a normal's tilt, 76 degrees: no first guess lies nearer the equator
_OF_THE_CONE = 0.9  # of the tilt that a hyperboloid's normals come near to, far down its sides


def reflect_points(
    mirror: QuadricMirror, cop: ArrayLike, points: ArrayLike,
) -> tuple[Array, NDArray[np.bool_]]:
    """Mirror points in which a camera sees points in space.

    :param mirror: the mirror; only its physical sheet, cut at its rim, reflects.
    :param cop: centre of projection (3,) in the mirror frame, metres; x = 0, outside the mirror.
    :param points: points (N, 3) in the mirror frame, metres.
    :returns: mirror points (N, 3) in the mirror frame, metres, zero where not visible, and which
        are visible (N,): the reflection exists on the physical mirror, and the camera and the
        point are both in front of it. The image's border plays no part here.
    :raises GeometryError: if the centre of projection or a point is not finite or of the wrong
        shape, or if the centre of projection is off the plane x = 0 or inside the mirror.
    """
    cop = mirror.checked_cop(cop)
    points = np.asarray(points, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise GeometryError(f'points must have the shape (N, 3), got {points.shape}')
    if not np.isfinite(points).all():
        raise GeometryError('points must be finite, got NaN or infinity')

    scene = _Scene(mirror, cop)
    mirror_points = np.zeros_like(points)
    visible = np.zeros(len(points), dtype=bool)
    for start in range(0, len(points), _CHUNK):
        part = slice(start, start + _CHUNK)
        mirror_points[part], visible[part] = scene.reflect(points[part])
    return mirror_points, visible


class _Scene:
    """Mirror and camera with the mirror's apex at the origin and their distance as unit.

    There the mirror is r^2 + A z^2 + B z = 0 with B >= 0, and its physical sheet is the graph
    z(r^2) = -2 r^2 / (B + sqrt(B^2 - 4 A r^2)), h = A z + B / 2 = sqrt(B^2 - 4 A r^2) / 2.
    """

    def __init__(self, mirror: QuadricMirror, cop: Array) -> None:
        self.apex = np.array([0.0, 0.0, mirror.apex_z])
        self.mirror = mirror
        self.unit = float(np.linalg.norm(cop - self.apex))
        self.a = float(mirror.A)
        self.b = max(0.0, (mirror.B + 2 * mirror.A * mirror.apex_z) / self.unit)
        self.cop = (cop - self.apex) / self.unit
        # h must stay positive: on a spheroid the graph ends at its equator
        limit = self.b**2 / (4 * self.a) if self.a > 0.0 else np.inf
        self.r2_limit = _EQUATOR_MARGIN * limit

    def _height(self, r2: Array) -> tuple[Array, Array]:
        """Heights z and h of the sheet over x^2 + y^2 = r2."""
        root = np.sqrt(np.maximum(self.b**2 - 4 * self.a * r2, 0.0))
        total = self.b + root
        return -2 * r2 / np.where(total > 0.0, total, 1.0), root / 2

    def reflect(self, points: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Mirror points (N, 3) of points (N, 3), and which are visible (N,); all in metres."""
        p = (points - self.apex) / self.unit
        x, y = np.zeros(len(p)), np.zeros(len(p))
        found = np.zeros(len(p), dtype=bool)
        todo = np.flatnonzero(~self._occluded(p))
        start = self._first_guess(p[todo])
        x[todo], y[todo], found[todo] = self._newton(p[todo], *start, _NEWTON_STEPS)
        left = todo[~found[todo]]
        if len(left):
            x[left], y[left], found[left] = self._by_polynomial(p[left])
        m = np.stack([x, y, self._height(x * x + y * y)[0]], axis=-1) * self.unit + self.apex
        found &= self.mirror.contains(m)
        return np.where(found[:, None], m, 0.0), found

    def _occluded(self, p: Array) -> NDArray[np.bool_]:
        """Whether the segment from the camera to the point meets the mirror's (whole) body."""
        o, d = self.cop, p - self.cop
        q2 = d[:, 0] ** 2 + d[:, 1] ** 2 + self.a * d[:, 2] ** 2
        q1 = o[1] * d[:, 1] + self.a * o[2] * d[:, 2] + self.b / 2 * d[:, 2]
        q0 = o[1] ** 2 + (self.a * o[2] + self.b) * o[2]
        discriminant = q1 * q1 - q2 * q0
        root = np.sqrt(np.maximum(discriminant, 0.0))
        q = -(q1 + np.copysign(root, q1))
        hit = np.zeros(len(p), dtype=bool)
        for upper, lower in ((q, q2), (np.full_like(q, q0), q)):
            t = np.divide(upper, lower, out=np.full_like(q, -1.0), where=lower != 0.0)
            upright = (self.a > 0.0) | (self.a * (o[2] + t * d[:, 2]) + self.b / 2 > 0.0)
            hit |= (t > 0.0) & (t < 1.0) & upright
        return hit & (discriminant > 0.0)

    def _first_guess(self, p: Array) -> tuple[Array, Array]:
        """Two rounds of: normal = bisector of the two rays, mirror point = where it is normal."""
        m = np.zeros_like(p)
        for _ in range(2):
            e = _unit(self.cop - m) + _unit(p - m)
            # tan of the normal's tilt; a hyperboloid has no point with more than its cone's tilt
            lean = np.hypot(e[:, 0], e[:, 1])
            steepest = _OF_THE_CONE / np.sqrt(-self.a) if self.a < 0.0 else _STEEPEST_GUESS
            tilt = np.minimum(lean / np.maximum(e[:, 2], 1e-3), steepest)
            # (x, y) = tau tilt, h = tau, and h^2 = B^2 / 4 - A r^2
            r = tilt * self.b / 2 / np.sqrt(1.0 + self.a * tilt**2)
            r = r / np.where(lean > 0.0, lean, 1.0)
            x, y = e[:, 0] * r, e[:, 1] * r
            m = np.stack([x, y, self._height(x * x + y * y)[0]], axis=-1)
        return m[:, 0], m[:, 1]

    def _newton(
        self, p: Array, x: Array, y: Array, steps: int
    ) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Newton's method on the path's length over (x, y), and where it ends in a certificate."""
        p_x, p_y, p_z = p.T
        _, o_y, o_z = self.cop
        with np.errstate(all='ignore'):  # strays become NaN, get no certificate, and are dropped
            for step in range(steps + 1):
                z, h = self._height(x * x + y * y)
                h_inv = 1.0 / h
                u, v = x * h_inv, y * h_inv  # minus the slopes dz/dx and dz/dy
                a_y, a_z = o_y - y, o_z - z
                a_inv = 1.0 / np.sqrt(x * x + a_y * a_y + a_z * a_z)
                a_x, a_y, a_z = -x * a_inv, a_y * a_inv, a_z * a_inv
                b_x, b_y, b_z = p_x - x, p_y - y, p_z - z
                b_inv = 1.0 / np.sqrt(b_x * b_x + b_y * b_y + b_z * b_z)
                b_x, b_y, b_z = b_x * b_inv, b_y * b_inv, b_z * b_inv
                # tangents T1 = (1, 0, -u), T2 = (0, 1, -v): the slopes of both legs along them
                a_1, a_2 = a_x - u * a_z, a_y - v * a_z
                b_1, b_2 = b_x - u * b_z, b_y - v * b_z
                e_z = (a_z + b_z) * h_inv
                both = a_inv + b_inv
                h_11 = both * (1 + u * u) - a_inv * a_1 * a_1 - b_inv * b_1 * b_1
                h_12 = both * u * v - a_inv * a_1 * a_2 - b_inv * b_1 * b_2
                h_22 = both * (1 + v * v) - a_inv * a_2 * a_2 - b_inv * b_2 * b_2
                h_11 += e_z * (1 + self.a * u * u)
                h_12 += e_z * self.a * u * v
                h_22 += e_z * (1 + self.a * v * v)
                g_1, g_2 = a_1 + b_1, a_2 + b_2
                determinant = h_11 * h_22 - h_12 * h_12
                d_x = (h_22 * g_1 - h_12 * g_2) / determinant
                d_y = (h_11 * g_2 - h_12 * g_1) / determinant
                if step == steps:
                    break
                x, y = self._step(x, y, d_x, d_y)
            front = (a_x * u + a_y * v + a_z > 0.0) & (b_x * u + b_y * v + b_z > 0.0)
            settled = np.abs(d_x) + np.abs(d_y) <= _SETTLED
            return x, y, settled & front & (determinant > 0.0)

    def _step(
        self, x: Array, y: Array, d_x: Array, d_y: Array
    ) -> tuple[Array, Array]:
        """A step of no more than the longest, kept on the sheet."""
        short = np.minimum(1.0, _LONGEST_STEP / (np.abs(d_x) + np.abs(d_y)))
        x, y = x + short * d_x, y + short * d_y
        if np.isfinite(self.r2_limit):
            back = np.minimum(1.0, np.sqrt(_INSIDE_EQUATOR * self.r2_limit / (x * x + y * y)))
            x, y = x * back, y * back
        return x, y

    def _by_polynomial(self, p: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Every real root of the polynomial as a start; at most one of them is certified."""
        on_axis = self.cop[1] == 0.0
        lateral = np.hypot(p[:, 0], p[:, 1])
        q = np.column_stack([np.zeros(len(p)), lateral, p[:, 2]]) if on_axis else p
        quadric, cop = (self.a, self.b, 0.0), (self.cop[1], self.cop[2])
        roots, real = real_roots(PointConditions(quadric, cop, q).polynomial(), _REAL_ROOT)
        real &= (roots <= 1e-6) & (self.a * roots + self.b / 2 > 0.0)
        which, column = np.nonzero(real)
        z = np.minimum(roots[which, column], 0.0)
        y = PointConditions(quadric, cop, q[which]).y_of_z(z)
        r2 = np.maximum(-(self.a * z + self.b) * z, 0.0)
        y = np.clip(y, -np.sqrt(r2), np.sqrt(r2))
        # x has the sign of p_x: the mirrored point would make the path longer
        x = np.copysign(np.sqrt(np.maximum(r2 - y * y, 0.0)), q[which, 0])
        if on_axis:
            safe = np.where(lateral[which] > 0.0, lateral[which], 1.0)
            x, y = y * p[which, 0] / safe, y * p[which, 1] / safe
        x, y, sure = self._newton(p[which], x, y, _POLISH_STEPS)
        best_x, best_y = np.zeros(len(p)), np.zeros(len(p))
        found = np.zeros(len(p), dtype=bool)
        found[which[sure]] = True
        best_x[which[sure]], best_y[which[sure]] = x[sure], y[sure]
        return best_x, best_y, found


def _unit(vectors: Array) -> Array:
    norm = np.sqrt((vectors * vectors).sum(axis=-1, keepdims=True))
    return vectors / np.where(norm > 0.0, norm, 1.0)
