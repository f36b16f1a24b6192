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

"""The pose from shifts measured across predicted bands: robust, linear, with its covariance.

A station whose tape lies delta beside its prediction says delta = J . (step of the pose), with J
from the prediction itself. That is the residual S in pixels to first order about the predicted
pose; who predicts again at the pose found makes it exact.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property
from typing import NamedTuple

from nccs_pose.estimation.common_errors import common_variance, sums_of_neighbours
from nccs_pose.estimation.refine import Refinement
from nccs_pose.estimation.robust import CAUCHY, GATE, robust_variance, VAGUE_INFORMATION
from nccs_pose.geometry.pose import Array, Pose2
from nccs_pose.geometry.small_matrices import solve_definite
from nccs_pose.vision.bands import runs
import numpy as np
from numpy.typing import NDArray

# Tukey's biweight forgets what lies beyond this many, and keeps 98 % of the efficiency under
# Gaussian noise. No group weighs nothing at all, so that no sum is empty.
_FORGOTTEN = 6.0
_NOTHING = 1e-6
# A fit is held by this part of its weights at least.
_LEAST_HELD = 0.3
_ITERATIONS = 8
# The robust stage only has to find the weights. After a step below this, in squared deviations of
# the pose, the next is about a fifth of it, and moves no group's residual by as much as a tenth of
# its own.
_FOUND = 1.0
_ONE = np.eye(6)


class Prior(NamedTuple):
    """A pose that is weighed in like a measurement, T_map_base, and its information (3, 3)."""

    pose: Pose2
    information: Array


@dataclass(frozen=True, eq=False)
class WeighedShifts:
    """What N shifts say of the pose by the weights that they have been given.

    :ivar start: the predicted pose, T_map_base.
    :ivar free: which of (x, y, yaw, z, roll, pitch) are unknown (K,).
    :ivar rows: d(shift)/d(unknowns) over the standard deviations (K, N).
    :ivar sigma: these, px (N,).
    :ivar root: of the weights (N,).
    :ivar inlier: which the pose rests on (N,).
    :ivar label: map line of each (N,).
    :ivar first: the first of each sum of neighbours whose errors are looked at together (G,).
    :ivar known: information about the unknowns beforehand (K, K).
    :ivar told: that times what is expected of them (K,).
    :ivar image_sigma: as of :func:`weigh_shifts`.
    """

    start: Pose2
    free: NDArray[np.intp]
    rows: Array
    sigma: Array
    root: Array
    inlier: NDArray[np.bool_]
    label: NDArray[np.intp]
    first: NDArray[np.intp]
    known: Array
    told: Array
    image_sigma: Array | None

    def solve(self, shift: Array) -> Refinement:
        """Weigh shifts (N,) into one step of the pose, with its covariance.

        :param shift: those that were weighed, px, or what they turn out to be.
        """
        weighed, normal, fitted, leverage, held = self._fit
        right_side = shift / self.sigma
        right = weighed.dot(right_side * self.root)
        # The prior's share is weighed against residuals of the size that they have.
        e = (right_side - fitted.dot(right + self.told).dot(self.rows)) * self.root
        inflation = max(common_variance(e, leverage, self.label, self.first) / held**2, 1e-6)
        covariance = solve_definite(
            normal / inflation + self.known, _ONE[:len(self.free), :len(self.free)])
        unknowns = covariance @ (right / inflation + self.told)
        if self.image_sigma is not None:
            moved = self.image_sigma * (self.root / self.sigma)[:, None]
            answer = covariance @ (weighed @ moved) / inflation
            covariance = covariance + answer @ answer.T
        step = np.zeros(6)
        step[self.free] = unknowns
        x, y, yaw = step[:3].tolist()
        return Refinement(
            Pose2(self.start.x + x, self.start.y + y, self.start.yaw + yaw),
            0.5 * (covariance + covariance.T)[:3, :3], normal[:3, :3], step[3:],
            right_side - unknowns.dot(self.rows), self.inlier, True)

    @cached_property
    def _fit(self) -> tuple[Array, Array, Array, Array, float]:
        """What a fit has whatever the shifts are.

        :returns: the rows, weighed (K, N); their normal matrix (K, K); with what is known
            beforehand, the inverse of that; how far each shift's error moves its own fit (N,); and
            by which part of its weights the fit is held.
        """
        weighed = self.rows * self.root
        normal = weighed.dot(weighed.T)
        fitted = solve_definite(
            normal + self.known, _ONE[:len(self.free), :len(self.free)])
        leverage = (fitted.dot(weighed) * weighed).sum(axis=0)
        # Of the biweight, psi' over the weight is 5 - 4 / root.
        held = 5.0 - 4.0 * leverage.dot(1.0 / self.root) / max(leverage.sum(), 1e-12)
        return weighed, normal, fitted, leverage, max(float(held), _LEAST_HELD)


def weigh_shifts(
    shift: Array,
    sigma: Array,
    slide: Array,
    group: NDArray[np.intp],
    label: NDArray[np.intp],
    start: Pose2,
    *,
    prior: Prior | None = None,
    attitude_sigma: tuple[float, float] = (0.0, 0.0),
    image_sigma: Array | None = None,
) -> WeighedShifts:
    """Weigh N measured shifts by how well they agree on a step of the pose.

    Re-weighted least squares under Cauchy's loss with its scale estimated from the residuals,
    then weights of Tukey's biweight, from which the covariance comes; ``sigma`` is taken for
    relative there, its scale comes from the residuals and from what neighbours have in common.
    What is robustly weighted is the sum of neighbours' residuals: what disturbs a stretch of line
    disturbs all of it, and shows in the sum before it shows in any one.

    A weight that falls pulls a fit on as it moves: an error moves it 1 / (1 - s) times as far as
    it would with the weights held, where 1 - s is the mean of psi' over that of the weights. So
    the variance of an M-estimate is E psi^2 / (E psi')^2. A gate's fall cannot be measured from
    the few groups that stand at it, and is steep where errors are no Gaussian's (coarse JPEG, a
    floor with texture: up to half of the variance); the biweight's is a mean over all of them.

    :param shift: of the stations (N,), px.
    :param sigma: their standard deviations (N,), px.
    :param slide: d(shift)/d(x, y, yaw, z, roll, pitch) (N, 6).
    :param group: of neighbours that each belongs to (N,), those of a group together.
    :param label: map line of each (N,), ascending, along each line in order.
    :param start: the predicted pose, T_map_base.
    :param prior: what is known of the pose beforehand.
    :param attitude_sigma: how well the base's height is known to keep its plane, metres, and its
        roll and pitch, rad; what is known to zero is held.
    :param image_sigma: d(shift)/d(u, v) of the whole image times what the calibration may shift it
        by (N, 2), px; None where that is nothing.
    """
    free, known, told = _prior(start, prior, attitude_sigma)
    rows = np.empty((len(free) + 1, len(shift)))
    np.divide(slide.T.take(free, axis=0), sigma, out=rows[:-1])
    np.divide(shift, sigma, out=rows[-1])
    first, members = runs(group)
    # The sum of each group's columns as one whitened column.
    square = _robust(np.add.reduceat(rows, first, axis=1) / np.sqrt(members), known, told)
    inlier = (square <= GATE**2).repeat(members)
    root = np.maximum(1.0 - square / _FORGOTTEN**2, _NOTHING).repeat(members)
    return WeighedShifts(
        start, free, rows[:-1], sigma, root, inlier, label, sums_of_neighbours(first, label),
        known, told, image_sigma)


def _robust(equations: Array, known: Array, told: Array) -> Array:
    """Re-weighted least squares under Cauchy's loss.

    :param equations: whitened, by unknowns and what they should come to (K + 1, G).
    :param known: information about the unknowns beforehand (K, K), and times what they are
        expected to be, ``told`` (K,).
    :returns: squares of the equations' residuals, in those of robust standard deviations (G,).
    """
    unknowns: NDArray[np.floating] = np.zeros(len(told))
    e = equations[-1]
    for _ in range(_ITERATIONS):
        square = e * e
        width = CAUCHY**2 * robust_variance(square)
        weight = width / (width + square)
        weighed = (equations * weight).dot(equations.T)
        normal = weighed[:-1, :-1] + known
        before = unknowns
        unknowns = solve_definite(normal, weighed[:-1, -1] + told)
        e = _residual(equations, unknowns)
        step = unknowns - before
        if step.dot(normal).dot(step) < _FOUND:
            break
    square = np.square(e, dtype=float)
    square /= robust_variance(square)
    return square


def _prior(
    start: Pose2, prior: Prior | None, attitude_sigma: tuple[float, float],
) -> tuple[NDArray[np.intp], Array, Array]:
    """Free unknowns, the information about them (K, K), and that times their expected step (K,).

    The step is from the start; what is merely vague expects none.
    """
    free, vague = _unknowns(*attitude_sigma)
    information, told = vague.copy(), np.zeros(len(free))
    if prior is not None:
        information[:3, :3] += prior.information
        told[:3] = prior.information.dot(prior.pose.minus(start))
    return free, information, told


@cache
def _unknowns(height: float, tilt: float) -> tuple[NDArray[np.intp], Array]:
    """Free unknowns (K,) with these deviations, and the information about them (K, K)."""
    sigmas = np.array([height, tilt, tilt])
    free = np.array([0, 1, 2, *(3 + np.flatnonzero(sigmas > 0.0))], dtype=np.intp)
    information = np.diag([*np.diag(VAGUE_INFORMATION), *sigmas[sigmas > 0.0]**-2.0])
    return free, information


def _residual(rows: Array, unknowns: NDArray[np.floating]) -> Array:
    """Of equations (K + 1, N) at the unknowns (K,)."""
    return rows[-1] - unknowns.dot(rows[:-1])
