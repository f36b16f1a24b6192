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

"""Joint refinement of rig and poses over all line measurements.

Minimises sum rho(e / sigma) + |theta / spread|^2 over theta and every frame's pose by Levenberg's
method, e the distance in the image from a measured pixel to its line's curve (see
:mod:`nccs_pose.calibration.problem`). The normal matrix is an arrow: 3 x 3 pose blocks that meet
only in the rig's block, so the poses are eliminated one by one and the cost is linear in their
number.
"""

from __future__ import annotations

from dataclasses import dataclass

from nccs_pose.calibration.observations import Observations
from nccs_pose.calibration.parameters import RigModel, RigParameters
from nccs_pose.calibration.problem import Linearisation, Problem
from nccs_pose.calibration.pulls import pull_statistics
from nccs_pose.errors import CalibrationError, GeometryError
from nccs_pose.estimation.robust import CAUCHY, robust_scale, VAGUE_INFORMATION
from nccs_pose.geometry.pose import Array
import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

_GATE = 4.0  # robust standard deviations; 6 in 100 000 good pixels lie outside
_CHANCE = 1e-3  # probability with which noise as told widens the claims
_SOUND = 5.0  # robust residual in units of the noise as told, beyond which nothing fits yet
_FEET = 2  # how often the feet of the perpendiculars are dropped
_MOST_STEPS = 60
_MISSED = 1e3  # whitened residual of a pixel whose ray misses the mirror: costly, but no pull


@dataclass(frozen=True, eq=False)
class ArrowSystem:
    """Normal equations of F frames: rig (P), poses (F, 3), and what couples them.

    :ivar rigs: each frame's part of the rig's block (F, P, P).
    :ivar poses: (F, 3, 3).
    :ivar coupling: (F, 3, P).
    :ivar rig_slopes: each frame's part (F, P).
    :ivar pose_slopes: (F, 3).
    """

    rigs: Array
    poses: Array
    coupling: Array
    rig_slopes: Array
    pose_slopes: Array

    @property
    def rig(self) -> Array:
        """The rig's block (P, P)."""
        return self.rigs.sum(axis=0)

    @classmethod
    def of(cls, terms: Linearisation, weight: Array, slices: list[slice]) -> ArrowSystem:
        """Accumulate with weights (N,)."""
        p = terms.by_rig.shape[1]
        both = np.concatenate([terms.by_pose, terms.by_rig], axis=1)
        weighted = both * weight[:, None]
        rigs, slopes = np.zeros((len(slices), p, p)), np.zeros((len(slices), p))
        poses, coupling = np.zeros((len(slices), 3, 3)), np.zeros((len(slices), 3, p))
        pose_slopes = np.zeros((len(slices), 3))
        for f, rows in enumerate(slices):
            block = weighted[rows].T @ both[rows]
            pull = weighted[rows].T @ terms.residual[rows]
            poses[f], coupling[f] = block[:3, :3], block[:3, 3:]
            rigs[f], pose_slopes[f], slopes[f] = block[3:, 3:], pull[:3], pull[3:]
        return cls(rigs, poses, coupling, slopes, pose_slopes)

    def reduced(self, damping: float = 0.0) -> tuple[Array, Array, Array]:
        """Eliminate the poses (Schur's complement).

        :returns: information on the rig (P, P), its slope (P,), and -dpose/drig (F, 3, P), how
            the poses give way to the rig.
        """
        gain = np.linalg.solve(self._damped_poses(damping), self.coupling)
        rig = self.rig
        rig = rig + damping * np.diag(np.diag(rig))
        return (rig - np.einsum('fip,fiq->pq', self.coupling, gain),
                self.rig_slopes.sum(axis=0) - np.einsum('fip,fi->p', gain, self.pose_slopes),
                np.asarray(gain, dtype=float))

    def pulls(self) -> tuple[Array, Array]:
        """Slope (F, P) and curvature (F, P, P) of each frame alone, its pose eliminated."""
        gain = np.linalg.solve(self._damped_poses(0.0), self.coupling)
        return (self.rig_slopes - np.einsum('fip,fi->fp', gain, self.pose_slopes),
                self.rigs - np.einsum('fip,fiq->fpq', self.coupling, gain))

    def solve(self, theta: Array, spread: Array, damping: float) -> tuple[Array, Array]:
        """Step of the rig (P,) and of the poses (F, 3)."""
        information, slope, gain = self.reduced(damping)
        step = rig_step(information, slope, theta, spread)
        alone = np.linalg.solve(
            self._damped_poses(damping), self.pose_slopes[:, :, None])[:, :, 0]
        return step, -alone - gain @ step

    def _damped_poses(self, damping: float) -> Array:
        """The poses' blocks (F, 3, 3) that are solved with, regular whatever a frame shows."""
        diagonal = np.einsum('fii->fi', self.poses)
        return np.asarray(
            self.poses + VAGUE_INFORMATION + damping * np.eye(3) * diagonal[:, None, :])


@dataclass(frozen=True, eq=False)
class Adjustment:
    """A refined rig with its poses, and what it rests on.

    :ivar model: rig (with its rim) and map.
    :ivar theta: deviation from the rough values (P,).
    :ivar poses: T_map_base of every frame (F, 3).
    :ivar information: what the data say of theta with the poses eliminated, without the rough
        values (P, P); widened by the scatter of the residuals.
    :ivar covariance: of theta, data and rough values together (P, P).
    :ivar pose_gain: -dpose/dtheta of each frame (F, 3, P).
    :ivar residual: whitened residuals (N,).
    :ivar inlier: which points it rests on (N,).
    :ivar scale: robust standard deviation of the residuals; 1 when the noise is as told.
    :ivar reduced_chi2: of the inliers, per degree of freedom.
    :ivar shared: scatter of the frames' pulls over that of independent noise; 1 if it is chance.
    :ivar converged: whether the last step was negligible.
    :ivar iterations: steps taken.
    """

    model: RigModel
    theta: Array
    poses: Array
    information: Array
    covariance: Array
    pose_gain: Array
    residual: Array
    inlier: NDArray[np.bool_]
    scale: float
    reduced_chi2: float
    shared: float
    converged: bool
    iterations: int


def adjust(
    parameters: RigParameters, observations: Observations, poses: Array, *,
    theta: Array | None = None,
) -> Adjustment:
    """Refine the rig and the poses together.

    First under Cauchy's loss with its scale estimated from the residuals, then by least squares
    over the inliers with derivatives on the curves, from which the covariance comes.

    :param poses: where to begin, T_map_base of every frame (F, 3).
    :param theta: where to begin, deviation from the rough rig (P,); None: at it.
    :raises CalibrationError: with too few points for the free numbers.
    """
    problem = Problem(parameters, observations)
    theta = np.zeros(len(parameters)) if theta is None else np.array(theta, dtype=float)
    everything = np.ones(len(observations), dtype=bool)
    found = _descend(problem, theta, np.array(poses, dtype=float), everything, cauchy=True)
    converged, steps = found.converged, found.steps
    scale = _robust_scale(found.terms)
    inlier = found.terms.hit & (np.abs(found.terms.residual) <= _GATE * scale)
    if inlier.sum() < 3 * observations.frames + len(parameters):
        raise CalibrationError(
            f'only {int(inlier.sum())} of {len(observations)} points lie on the lines that they '
            'should be on: wrong map, wrong mirror, or a rough rig too far off')
    for _ in range(_FEET):
        # Curves that are far from the pixels say nothing of where on them the feet would be.
        if scale <= _SOUND:
            problem.drop_feet(found.theta, found.poses)
        found = _descend(problem, found.theta, found.poses, inlier, cauchy=False)
        steps += found.steps
    e = found.terms.residual[inlier]
    degrees = max(1, len(e) - 3 * observations.frames - len(parameters))
    reduced = float(e @ e) / degrees
    system = ArrowSystem.of(found.terms, inlier.astype(float), problem.slices)
    shared = _shared_scatter(system, parameters.spread)
    information, _, gain = system.reduced()
    # Residuals larger than the noise was told to be widen the claim, and so do errors that the
    # points of a frame share; smaller ones do not narrow it.
    information = 0.5 * (information + information.T) / max(1.0, reduced, shared)
    return Adjustment(
        parameters.model(found.theta, with_rim=True), found.theta, found.poses, information,
        posterior(information, parameters.spread), gain, found.terms.residual, inlier, scale,
        reduced, shared, converged and found.converged, steps)


def _shared_scatter(system: ArrowSystem, spread: Array) -> float:
    """Scatter of the frames' pulls over that of independent noise; 1 if it is chance."""
    found = pull_statistics(*system.pulls(), spread)
    degrees = max(found.degrees, 1.0)
    by_chance = float(chi2.isf(_CHANCE, degrees)) / degrees
    return found.scatter if found.scatter > by_chance else 1.0


def rig_step(information: Array, slope: Array, theta: Array, spread: Array) -> Array:
    """The step (P,) from theta to the least of data and rough values together.

    :param information: of the data, the poses eliminated (P, P).
    :param slope: of half their squares there (P,).
    """
    # In units of the spread the matrix is well scaled, whatever the parameters' units.
    scaled = information * np.outer(spread, spread) + np.eye(len(spread))
    return np.asarray(-spread * np.linalg.solve(scaled, spread * slope + theta / spread))


def posterior(information: Array, spread: Array) -> Array:
    """Covariance (P, P) of data with this information and rough values with that spread."""
    scaled = information * np.outer(spread, spread) + np.eye(len(spread))
    covariance = np.linalg.inv(0.5 * (scaled + scaled.T)) * np.outer(spread, spread)
    return 0.5 * (covariance + covariance.T)


def _robust_scale(terms: Linearisation) -> float:
    residual = terms.residual[terms.hit]
    return robust_scale(residual) if len(residual) else _MISSED


@dataclass(frozen=True, eq=False)
class _Descent:
    """Where the method ended.

    :ivar theta: deviation from the rough rig (P,).
    :ivar poses: T_map_base of every frame (F, 3).
    :ivar terms: residuals and derivatives there.
    :ivar converged: whether the last step was negligible.
    :ivar steps: how many were taken.
    """

    theta: Array
    poses: Array
    terms: Linearisation
    converged: bool
    steps: int


def _descend(
    problem: Problem, theta: Array, poses: Array, chosen: NDArray[np.bool_], *, cauchy: bool,
) -> _Descent:
    """Levenberg-Marquardt over the chosen points (N,), under Cauchy's loss or least squares."""
    spread, damping = problem.parameters.spread, 0.0
    terms = problem.linearise(theta, poses)
    for iteration in range(_MOST_STEPS):
        width = CAUCHY * _robust_scale(terms) if cauchy else np.inf
        weight = chosen / (1.0 + (terms.residual / width) ** 2)
        system = ArrowSystem.of(terms, weight, problem.slices)
        step, pose_step = system.solve(theta, spread, damping)
        size = _squared_size(system, step, pose_step, spread)
        here = _cost(terms, chosen, width, theta, spread)
        try:
            trial = problem.linearise(theta + step, poses + pose_step)
            better = _cost(trial, chosen, width, theta + step, spread) <= here
        except GeometryError:
            better = False  # no such rig, e.g. a camera inside the mirror
        if better:
            theta, poses, terms = theta + step, poses + pose_step, trial
            damping *= 0.1 if damping > 1e-6 else 0.0
        else:
            damping = max(1e-3, 10.0 * damping)
        # A step of a thousandth of what the data can tell ends the search.
        if size < 1e-6:
            return _Descent(theta, poses, terms, True, iteration + 1)
        if damping > 1e8:
            break
    return _Descent(theta, poses, terms, False, iteration + 1)


def _squared_size(system: ArrowSystem, step: Array, pose_step: Array, spread: Array) -> float:
    """How long a step is in standard deviations, squared."""
    total = step @ system.rig @ step + np.sum((step / spread) ** 2)
    total += np.einsum('fi,fij,fj->', pose_step, system.poses, pose_step)
    total += 2.0 * np.einsum('fi,fip,p->', pose_step, system.coupling, step)
    return float(total)


def _cost(
    terms: Linearisation, chosen: NDArray[np.bool_], width: float, theta: Array, spread: Array,
) -> float:
    e = np.where(terms.hit, terms.residual, _MISSED)[chosen]
    loss = e @ e if np.isinf(width) else width**2 * np.log1p((e / width) ** 2).sum()
    return float(loss + np.sum((theta / spread) ** 2))
