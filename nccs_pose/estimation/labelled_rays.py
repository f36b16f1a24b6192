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
    forms,
    monomials,
    monomials_jacobian,
    with_derivatives,
)
from nccs_pose.geometry.pose import Array, cross_matrix, Pose2
from nccs_pose.geometry.rig import Rays
from nccs_pose.geometry.small_matrices import solve_3x3
import numpy as np
from numpy.typing import ArrayLike, NDArray

# No line is nearer to the viewpoint than this many times the distance at which rays pass it.
_CLEAR = 5.0


class LabelledRays:
    """N rays, each against one line, in a map whose origin is moved to among the lines.

    Far from the origin moments are small differences of large numbers; and where the lines do
    not fix the position, the solvers take the one nearest to the origin.

    :ivar origin: the origin (2,) in the caller's map, metres.
    :ivar lines: unit directions of the lines that have rays, and their moments about the origin,
        metres, (L, 6).
    :ivar index: the line of each ray (N,), into these.
    :ivar sigma2: variances of the pixels (N,), or one for all, px^2.
    """

    def __init__(
        self,
        rays: Rays,
        directions: ArrayLike,
        moments: ArrayLike,
        label: ArrayLike,
        sigma: ArrayLike,
        sigma_world: float,
    ) -> None:
        """See :func:`nccs_pose.estimation.global_pose.solve` for parameters and errors."""
        lines = _checked_lines(directions, moments)
        label = _checked_labels(label, len(rays), len(lines))
        sigma = _checked_sigma(sigma, len(rays))
        if not (math.isfinite(sigma_world) and sigma_world >= 0.0):
            raise EstimationError(f'sigma_world = {sigma_world} m: must be finite, not negative')
        use = rays.hit & (label >= 0)
        count = int(np.count_nonzero(use))
        if count < 3:
            raise EstimationError(
                f'too few pixels: {count} that hit the mirror and belong to a line; '
                'a pose needs at least 3')
        if count < len(use):
            rays, label = rays[use], label[use]
            sigma = sigma[use] if sigma.ndim else sigma
        self._rays = _checked_rays(rays)
        used = np.bincount(label, minlength=len(lines)) > 0
        self.index = label
        if not used.all():
            self.index, lines = (np.cumsum(used) - 1)[label], lines[used]
        self.origin = _middle(lines)
        lines[:, 3:] = _moments_about(self.origin, lines[:, :3], lines[:, 3:])
        self.lines = lines
        self.sigma2 = sigma * sigma
        self._sigma2_world = sigma_world**2
        self._forms = forms(self._rays, self.lines, self.index)

    def __len__(self) -> int:
        return len(self.index)

    @property
    def directions(self) -> Array:
        """Unit directions of the lines (L, 3)."""
        return self.lines[:, :3]

    @property
    def rows(self) -> Array:
        """Coefficients of S (7, N), metres."""
        return self._forms[:, 0]

    def variance(self, pose: Pose2) -> Array:
        """Variance of S (N,): sigma_px^2 |dS/du|^2 + sigma_w^2 |r x d'|^2, m^2."""
        gradient = monomials(pose) @ self._forms[:, 1:].reshape(7, -1)
        gradient *= gradient
        variance = self.sigma2 * (gradient[:len(self)] + gradient[len(self):])
        if self._sigma2_world > 0.0:
            d = (self.directions @ pose.rotation).T.take(self.index, axis=1)
            cosine = (self._rays[:3, 0] * d).sum(axis=0)
            variance += self._sigma2_world * (1.0 - cosine * cosine)
        # A ray along its line, or a pixel where nothing changes, says nothing.
        return np.maximum(variance, 1e-30)

    @cached_property
    def _viewpoint(self) -> tuple[Array, float]:
        """The point (3,) nearest to all rays, in or close to the mirror, and their RMS distance.

        The point v minimises sum |w - v x r|^2, so sum (1 - r r^T) v = sum r x w.
        """
        rays = self._rays[:, 0]
        sums = (rays @ rays.T).tolist()
        # Parallel rays pass no point; the small term takes one.
        count = len(self) * (1.0 + 1e-9)
        feet = sums[1][5] - sums[2][4], sums[2][3] - sums[0][5], sums[0][4] - sums[1][3]
        x, y, z = solve_3x3(
            count - sums[0][0], -sums[0][1], count - sums[1][1], -sums[0][2], -sums[1][2],
            count - sums[2][2], *feet) or (0.0, 0.0, 0.0)
        squares = sums[3][3] + sums[4][4] + sums[5][5] - x * feet[0] - y * feet[1] - z * feet[2]
        return np.array([x, y, z]), math.sqrt(max(0.0, squares) / len(self))

    @cached_property
    def _nearest(self) -> Array:
        """How far along each ray (N,) from its foot its line must be at least, metres.

        Not in the mirror: that is, some times further from the viewpoint than the rays miss it.
        """
        point, miss = self._viewpoint
        return point @ self._rays[:3, 0] + _CLEAR * miss

    def _lines_in_base(self, pose: Pose2) -> tuple[Array, Array]:
        """Line of each ray in base_link: d' and mu', (3, N) both."""
        lines = (into_base(pose) @ self.lines.T).take(self.index, axis=1)
        return lines[:3], lines[3:]

    def central_information(self, pose: Pose2) -> Array:
        """Information (3, 3) of a central camera at the viewpoint that sees the same lines.

        Its rays are ours, turned into the plane through the viewpoint and the line.
        """
        across = cross_matrix(self._viewpoint[0])
        d, mu = self._lines_in_base(pose)
        normal = mu - across @ d
        normal /= np.sqrt(np.maximum((normal * normal).sum(axis=0), 1e-30))
        r = self._rays[:3, 0]
        r = r - (r * normal).sum(axis=0) * normal
        central = forms(np.concatenate([r, across @ r])[:, None], self.lines, self.index)[:, 0]
        jacobian = monomials_jacobian(pose).T @ central
        return (jacobian / self.variance(pose)) @ jacobian.T

    def in_front(self, pose: Pose2) -> float:
        """Fraction of the rays that pass their line in front of the mirror.

        S is also zero where a ray prolonged backwards meets the line, and next to zero for all
        rays at once where the line goes through the mirror itself.
        """
        d, mu = self._lines_in_base(pose)
        r, w = self._rays[:3, 0], self._rays[3:, 0]
        normal = (
            r[1] * d[2] - r[2] * d[1], r[2] * d[0] - r[0] * d[2], r[0] * d[1] - r[1] * d[0])
        cosine = (r * d).sum(axis=0)
        # The ray's point nearest to the line lies at along / |r x d|^2 from its foot.
        along = (normal * (mu - cosine * w)).sum(axis=0)
        ahead = along > self._nearest * (1.0 - cosine * cosine)
        return float(np.count_nonzero(ahead)) / len(ahead)


def into_base(pose: Pose2) -> Array:
    """The matrix (6, 6) that takes lines (d, mu) from the map into base_link.

    d' = R^T d and mu' = R^T (mu - (x, y, 0) x d).
    """
    (c, s, x, y, p, q, _) = monomials(pose).tolist()
    return np.array([
        [c, s, 0.0, 0.0, 0.0, 0.0], [-s, c, 0.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0, 0.0, 0.0],
        [0.0, 0.0, -q, c, s, 0.0], [0.0, 0.0, p, -s, c, 0.0], [y, -x, 0.0, 0.0, 0.0, 1.0]])


def _moments_about(origin: Array, directions: Array, moments: Array) -> Array:
    """Moments (L, 3) of lines about a point (2,) on the ground, mu - o x d."""
    # d times the matrix is d x o.
    return moments + directions @ cross_matrix(np.append(origin, 0.0))


def _middle(lines: Array) -> Array:
    """Mean in plan (2,) of the points d x mu of lines (L, 6) that are nearest to the origin."""
    (_, _, xz), (_, _, yz), (zx, zy, _) = (lines[:, :3].T @ lines[:, 3:]).tolist()
    return np.array([(yz - zy) / len(lines), (zx - xz) / len(lines)])


def _checked_lines(directions: ArrayLike, moments: ArrayLike) -> Array:
    """Lines (L, 6) with unit directions."""
    directions, moments = np.asarray(directions, dtype=float), np.asarray(moments, dtype=float)
    if directions.size == 0:
        raise EstimationError('no lines: a pose needs at least one')
    for name, array in (('directions', directions), ('moments', moments)):
        if array.shape != (len(directions), 3):
            raise EstimationError(
                f'{name} of the lines of shape {array.shape}: expected ({len(directions)}, 3)')
    lines = np.concatenate([directions, moments], axis=1)
    if not np.isfinite(lines).all():
        _name_infinite('directions of the lines', directions)
        _name_infinite('moments of the lines', moments)
    length = np.sqrt((directions * directions).sum(axis=1))
    if not length.all():
        raise EstimationError(f'line {int(np.argmin(length))}: its direction has length zero')
    lines /= length[:, None]
    return lines


def _checked_labels(label: ArrayLike, n_rays: int, n_lines: int) -> NDArray[np.intp]:
    label = np.asarray(label)
    if label.shape != (n_rays,) or label.dtype.kind not in 'iu':
        raise EstimationError(
            f'labels of shape {label.shape} and type {label.dtype}: expected {n_rays} integers, '
            'one for each ray')
    if n_rays and label.max() >= n_lines:
        raise EstimationError(f'label {int(label.max())}: there are only {n_lines} lines')
    return label.astype(np.intp, copy=False)


def _checked_sigma(sigma: ArrayLike, n_rays: int) -> Array:
    sigma = np.asarray(sigma, dtype=float)
    if sigma.shape not in ((), (n_rays,)):
        raise EstimationError(f'sigma of shape {sigma.shape}: expected one or {n_rays}')
    least, most = float(sigma.min()), float(sigma.max())
    if not 0.0 < least <= most < math.inf:
        raise EstimationError(f'sigma = {least} px: must be positive and finite')
    return sigma


def _checked_rays(rays: Rays) -> Array:
    """(r, w) and its derivatives by u and v, (6, 3, N)."""
    coordinates = with_derivatives(rays)
    if not np.isfinite(coordinates).all():
        _name_infinite('ray directions', rays.direction)
        _name_infinite('ray moments', rays.moment)
        _name_infinite('derivatives of ray directions', rays.direction_jacobian)
        _name_infinite('derivatives of ray moments', rays.moment_jacobian)
    return coordinates


def _name_infinite(name: str, values: Array) -> None:
    finite = np.isfinite(values)
    if not finite.all():
        row = int(np.argwhere(~finite)[0, 0])
        raise EstimationError(f'{name}: row {row} is not finite ({values[row].tolist()})')
