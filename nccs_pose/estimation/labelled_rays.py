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

"""Rays with the lines that they should meet, checked and made ready for solving."""

from __future__ import annotations

from functools import cached_property
import math

from nccs_pose.errors import EstimationError
from nccs_pose.estimation.pose_monomials import (
    feet_in_plan,
    monomial_rows,
    monomials,
    monomials_jacobian,
)
from nccs_pose.geometry.pose import Array, Pose2
from nccs_pose.geometry.rig import Rays
import numpy as np
from numpy.typing import ArrayLike

# No line is nearer to the viewpoint than this many times the distance at which rays pass it.
_CLEAR = 5.0


class LabelledRays:
    """N rays, each against one line, in a map whose origin is moved to among the lines.

    Far from the origin moments are small differences of large numbers; and where the lines do
    not fix the position, the solvers take the one nearest to the origin.

    :ivar origin: the origin (2,) in the caller's map, metres.
    :ivar directions: unit directions of the lines that have rays (L, 3).
    :ivar moments: their moments (L, 3) about the origin, metres.
    :ivar index: the line of each ray (N,), into these.
    :ivar sigma2: variances of the pixels (N,), px^2.
    """

    def __init__(
        self,
        rays: Rays,
        directions: ArrayLike,
        moments: ArrayLike,
        label: ArrayLike,
        sigma: ArrayLike = 1.0,
        sigma_world: float = 0.0,
    ) -> None:
        """See :func:`nccs_pose.estimation.global_pose.solve` for parameters and errors."""
        directions, moments = _checked_lines(directions, moments)
        label = _checked_labels(label, len(rays), len(directions))
        sigma = np.asarray(sigma, dtype=float)
        if sigma.shape not in ((), label.shape):
            raise EstimationError(f'sigma of shape {sigma.shape}: expected one or {len(rays)}')
        if not (np.isfinite(sigma).all() and (sigma > 0.0).all()):
            raise EstimationError(f'sigma = {sigma.min()} px: must be positive and finite')
        if not (math.isfinite(sigma_world) and sigma_world >= 0.0):
            raise EstimationError(f'sigma_world = {sigma_world} m: must be finite, not negative')
        use = rays.hit & (label >= 0)
        if use.sum() < 3:
            raise EstimationError(
                f'too few pixels: {int(use.sum())} that hit the mirror and belong to a line; '
                'a pose needs at least 3')
        self.rays = rays = rays if use.all() else rays[use]
        _check_finite('ray directions', rays.direction)
        _check_finite('ray moments', rays.moment)
        _check_finite('derivatives of ray directions', rays.direction_jacobian)
        _check_finite('derivatives of ray moments', rays.moment_jacobian)
        label = label[use]
        used = np.zeros(len(directions), dtype=bool)
        used[label] = True
        self.index = (np.cumsum(used) - 1)[label]
        self.directions = directions[used]
        self.origin = feet_in_plan(self.directions, moments[used]).mean(axis=0)
        self.moments = moments_about(self.origin, self.directions, moments[used])
        self.sigma2 = (sigma[use] if sigma.ndim else np.full(len(label), sigma)) ** 2
        self._sigma2_world = sigma_world**2

    def __len__(self) -> int:
        return len(self.index)

    @cached_property
    def rows(self) -> Array:
        """Coefficients of S (N, 7), metres."""
        return monomial_rows(
            self.rays.direction, self.rays.moment,
            self.directions[self.index], self.moments[self.index])

    @cached_property
    def _gradient_rows(self) -> Array:
        """Coefficients of dS/du and dS/dv (2, N, 7), metres per pixel."""
        return monomial_rows(
            self.rays.direction_jacobian.transpose(2, 0, 1),
            self.rays.moment_jacobian.transpose(2, 0, 1),
            self.directions[self.index], self.moments[self.index])

    def variance(self, pose: Pose2) -> Array:
        """Variance of S (N,): sigma_px^2 |dS/du|^2 + sigma_w^2 |r x d'|^2, m^2."""
        gradient = self._gradient_rows @ monomials(pose)
        variance = self.sigma2 * (gradient[0] ** 2 + gradient[1] ** 2)
        if self._sigma2_world > 0.0:
            d = (self.directions @ pose.rotation)[self.index]
            cosine = np.einsum('ni,ni->n', self.rays.direction, d)
            variance = variance + self._sigma2_world * (1.0 - cosine * cosine)
        # A ray along its line, or a pixel where nothing changes, says nothing.
        return np.maximum(variance, 1e-30)

    @cached_property
    def _viewpoint(self) -> Array:
        """The point (3,) nearest to all rays, in or close to the mirror."""
        r, w = self.rays.direction, self.rays.moment
        # r x w is the foot of the ray. Parallel rays pass no point; the small term takes one.
        across = r.T @ w
        feet = np.array([
            across[1, 2] - across[2, 1], across[2, 0] - across[0, 2], across[0, 1] - across[1, 0]])
        return np.linalg.solve(len(r) * (1.0 + 1e-9) * np.eye(3) - r.T @ r, feet)

    @cached_property
    def _central_moment(self) -> Array:
        """Moments (N, 3) of the rays, moved so that all pass through the viewpoint, metres."""
        x, y, z = self._viewpoint.tolist()
        rx, ry, rz = self.rays.direction.T
        return np.array([y * rz - z * ry, z * rx - x * rz, x * ry - y * rx]).T

    @cached_property
    def _nearest(self) -> Array:
        """How far along each ray (N,) from its foot its line must be at least, metres.

        Not in the mirror: that is, some times further from the viewpoint than the rays miss it.
        """
        miss = self.rays.moment - self._central_moment
        radius = math.sqrt(float((miss * miss).sum()) / len(miss))
        return self.rays.direction @ self._viewpoint + _CLEAR * radius

    def _lines_in_base(self, pose: Pose2) -> tuple[Array, Array]:
        """Line of each ray in base_link: d' and mu', (3, N) both."""
        moments = moments_about(np.array([pose.x, pose.y]), self.directions, self.moments)
        rotation = pose.rotation
        return (self.directions @ rotation)[self.index].T, (moments @ rotation)[self.index].T

    def central_information(self, pose: Pose2) -> Array:
        """Information (3, 3) of a central camera at the viewpoint that sees the same lines.

        Its rays are ours, turned into the plane through the viewpoint and the line.
        """
        x, y, z = self._viewpoint.tolist()
        d, mu = self._lines_in_base(pose)
        normal = mu - np.array([y * d[2] - z * d[1], z * d[0] - x * d[2], x * d[1] - y * d[0]])
        normal = normal / np.sqrt(np.maximum((normal * normal).sum(axis=0), 1e-30))
        r = self.rays.direction.T
        r = r - (r * normal).sum(axis=0) * normal
        w = np.array([y * r[2] - z * r[1], z * r[0] - x * r[2], x * r[1] - y * r[0]])
        jacobian = monomial_rows(
            r.T, w.T, self.directions[self.index], self.moments[self.index],
        ) @ monomials_jacobian(pose)
        return (jacobian / self.variance(pose)[:, None]).T @ jacobian

    def in_front(self, pose: Pose2) -> float:
        """Fraction of the rays that pass their line in front of the mirror.

        S is also zero where a ray prolonged backwards meets the line, and next to zero for all
        rays at once where the line goes through the mirror itself.
        """
        d, mu = self._lines_in_base(pose)
        r, w = self.rays.direction.T, self.rays.moment.T
        normal = (
            r[1] * d[2] - r[2] * d[1], r[2] * d[0] - r[0] * d[2], r[0] * d[1] - r[1] * d[0])
        cosine = r[0] * d[0] + r[1] * d[1] + r[2] * d[2]
        # The ray's point nearest to the line lies at along / |r x d|^2 from its foot.
        along = sum(n * (m - cosine * v) for n, m, v in zip(normal, mu, w))
        return float(np.mean(along > self._nearest * (1.0 - cosine * cosine)))


def moments_about(origin: Array, directions: Array, moments: Array) -> Array:
    """Moments (L, 3) of lines about a point (2,) on the ground, mu - o x d."""
    ox, oy = origin.tolist()
    dx, dy, dz = directions.T
    return moments - np.array([oy * dz, -ox * dz, ox * dy - oy * dx]).T


def _checked_lines(directions: ArrayLike, moments: ArrayLike) -> tuple[Array, Array]:
    """Lines (L, 3), (L, 3) with unit directions."""
    directions, moments = np.asarray(directions, dtype=float), np.asarray(moments, dtype=float)
    if directions.size == 0:
        raise EstimationError('no lines: a pose needs at least one')
    for name, array in (('directions', directions), ('moments', moments)):
        if array.shape != (len(directions), 3):
            raise EstimationError(
                f'{name} of the lines of shape {array.shape}: expected ({len(directions)}, 3)')
        _check_finite(f'{name} of the lines', array)
    length = np.sqrt((directions * directions).sum(axis=1))
    if not length.all():
        raise EstimationError(f'line {int(np.argmin(length))}: its direction has length zero')
    return directions / length[:, None], moments / length[:, None]


def _checked_labels(label: ArrayLike, n_rays: int, n_lines: int) -> Array:
    label = np.asarray(label)
    if label.shape != (n_rays,) or not np.issubdtype(label.dtype, np.integer):
        raise EstimationError(
            f'labels of shape {label.shape} and type {label.dtype}: expected {n_rays} integers, '
            'one for each ray')
    if n_rays and label.max() >= n_lines:
        raise EstimationError(f'label {int(label.max())}: there are only {n_lines} lines')
    return label


def _check_finite(name: str, values: Array) -> None:
    if not np.isfinite(values).all():
        row = int(np.argwhere(~np.isfinite(values))[0, 0])
        raise EstimationError(f'{name}: row {row} is not finite ({values[row].tolist()})')
