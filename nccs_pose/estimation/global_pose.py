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

"""All poses that labelled rays allow, found without an initial guess.

First every local minimum of the unweighted sum of squares of S, in closed form; then at each of
them S is weighted by its own variance and the problem solved again, which reaches the
Cramér-Rao bound. Poses that the pixels cannot tell from the best are returned with it. What is
found is meant to be refined in pixels, robustly, by :func:`nccs_pose.estimation.refine.refine`.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

from nccs_pose.errors import EstimationError
from nccs_pose.estimation.general_lines import all_minima, are_horizontal
from nccs_pose.estimation.global_minimum import global_minimum
from nccs_pose.estimation.labelled_rays import LabelledRays
from nccs_pose.estimation.local_minimum import minimum_near
from nccs_pose.estimation.observability import Unobserved, unobserved_directions
from nccs_pose.estimation.pose_monomials import gram, monomials, monomials_jacobian
from nccs_pose.geometry.pose import Array, Pose2
from nccs_pose.geometry.rig import Rays
from nccs_pose.geometry.small_matrices import inverse, inverse_3x3, solve_if_definite
import numpy as np
from numpy.typing import ArrayLike

# Poses whose chi-square exceeds the best one's by no more than this are its equals (4 sigma).
_EQUALLY_GOOD = 16.0
# Weights can bring a minimum down, but not so many times.
_HOPELESS = 100.0
# Poses closer than this many standard deviations are one.
_SAME_POSE = 1.0
# A pose is virtual when so many more rays than for another meet their lines behind the mirror.
_VIRTUAL = 0.1
# Weights are taken again from a pose that has turned further than this (rad), so many times.
_CLOSE_START = 0.1
_REWEIGHTINGS = 4


@dataclass(frozen=True, eq=False)
class Solution:
    """One pose that the rays allow.

    :ivar pose: T_map_base. Along an unobserved direction it is one of many.
    :ivar chi2: sum of squared whitened residuals.
    :ivar information: of (x, y, yaw) at the pose (3, 3), with the noise as told.
    :ivar covariance: its inverse; None with an unobserved direction.
    :ivar unobserved: directions that are not fixed, worst first, or that a central camera in the
        place of this one would not fix: what the little distance between the rays tells of them
        changes so fast along the way that the information at one pose is no measure of it.
    """

    pose: Pose2
    chi2: float
    information: Array
    covariance: Array | None
    unobserved: tuple[Unobserved, ...]


def solve(
    rays: Rays,
    directions: ArrayLike,
    moments: ArrayLike,
    label: ArrayLike,
    *,
    sigma: ArrayLike = 1.0,
    sigma_world: float = 0.0,
) -> tuple[Solution, ...]:
    """All poses that N labelled rays allow, best first; more than one when they are equals.

    :param rays: in base_link (N,); those that missed the mirror are left out.
    :param directions: directions of the map's lines (L, 3), of any length but zero.
    :param moments: their moments q x d (L, 3), with the same d.
    :param label: index of the line that each ray should meet (N,); negative ones are left out.
    :param sigma: standard deviation of the pixels along the curve's normal, px, (N,) or one.
    :param sigma_world: standard deviation of the lines' own position across themselves, metres.
    :raises EstimationError: without lines, with fewer than three pixels, for a value that is
        not finite, a direction of length zero, a sigma that is not positive or a label that is
        no line's, or when every pose that fits has its lines behind the mirror.
    """
    data = LabelledRays(rays, directions, moments, label, sigma, sigma_world)
    return tuple(_solution(data, entry) for entry in _poses(data))


def best_pose(
    rays: Rays,
    directions: ArrayLike,
    moments: ArrayLike,
    label: ArrayLike,
    *,
    sigma: ArrayLike = 1.0,
    sigma_world: float = 0.0,
) -> tuple[Pose2, Array]:
    """The best pose and its covariance (3, 3), for lines that are known to fix one.

    The closed form, weighted by the variances at its pose and solved once more: the first of
    :func:`solve`, whose parameters it has, but without a look for others that are as good, and
    to the digits of the Gram matrix (within 0.02 standard deviations, of 1200 trials).

    :raises EstimationError: as :func:`solve` does, and where the rays leave a direction of the
        pose open.
    """
    data = LabelledRays(rays, directions, moments, label, sigma, sigma_world)
    first = global_minimum(gram(data.rows, 1.0 / data.sigma2), data.directions).pose
    weighted = gram(data.rows, 1.0 / data.variance(first))
    pose = minimum_near(weighted, data.directions, first).pose
    slopes = monomials_jacobian(pose).T
    information = slopes @ weighted @ slopes.T
    if data.in_front(pose) < 1.0 - _VIRTUAL:
        # Another pose may have more lines in front.
        best = _poses(data)[0]
        pose, information = best.pose, best.information
    covariance = inverse_3x3(information)
    if covariance is None:
        raise EstimationError('the rays leave a direction of the pose open: no covariance')
    x, y = data.origin.tolist()
    return Pose2(pose.x + x, pose.y + y, pose.yaw), covariance


@dataclass(frozen=True, eq=False)
class _Found:
    """A pose about the data's own origin."""

    pose: Pose2
    chi2: float
    information: Array
    in_front: float


def _poses(data: LabelledRays) -> list[_Found]:
    """All poses that are equally good, best first."""
    found: list[_Found] = []
    for start in all_minima(gram(data.rows, 1.0 / data.sigma2), data.directions):
        if found and _chi2(data, start.pose) > _HOPELESS * _limit(found, len(data)):
            continue
        solution = _weighted(data, start.pose)
        if not any(_same(solution, other) for other in found):
            found.append(solution)
    return _equally_good(found, len(data))


def _equally_good(found: list[_Found], n_rays: int) -> list[_Found]:
    """The poses with their lines in front that the pixels cannot tell from the best of them."""
    most = max(entry.in_front for entry in found)
    if most < 0.5:
        raise EstimationError(
            f'every pose that fits has its lines behind the mirror or in it, for '
            f'{100.0 * (1.0 - most):.0f} % of the rays: the mounting or the labels are wrong, or '
            'the lines too few')
    found = [entry for entry in found if entry.in_front >= most - _VIRTUAL]
    limit = _limit(found, n_rays)
    return sorted((entry for entry in found if entry.chi2 <= limit), key=lambda e: e.chi2)


def _limit(found: list[_Found], n_rays: int) -> float:
    """Chi-square of a pose that is just as good as the best one found.

    With more noise than told, differences of chi-square mean less in proportion.
    """
    best = min(entry.chi2 for entry in found)
    return best + _EQUALLY_GOOD * max(1.0, best / max(1, n_rays - 3))


def _chi2(data: LabelledRays, pose: Pose2) -> float:
    s = monomials(pose) @ data.rows
    return float((s * s / data.variance(pose)).sum())


def _weighted(data: LabelledRays, pose: Pose2) -> _Found:
    """The pose that a minimum of the unweighted sum becomes with S weighted by its variance.

    Once is enough for the best minimum. Another may have been far off, and so its weights.
    """
    for _ in range(_REWEIGHTINGS):
        weights = 1.0 / data.variance(pose)
        before = pose
        pose = minimum_near(gram(data.rows, weights), data.directions, pose).pose
        if abs(math.remainder(pose.yaw - before.yaw, 2.0 * math.pi)) < _CLOSE_START:
            break
    return _polished(data, weights, pose)


def _polished(data: LabelledRays, weights: Array, pose: Pose2) -> _Found:
    """One Gauss-Newton step on the rows, which the Gram matrix knows to half their digits."""
    jacobian = monomials_jacobian(pose).T @ data.rows
    weighted = jacobian * weights
    information = weighted @ jacobian.T
    slope = weighted @ (monomials(pose) @ data.rows)
    step = solve_if_definite(information, slope)
    if step is None:
        values, vectors = np.linalg.eigh(information)
        # Where the rays say nothing the pose stays.
        heard = values > 1e-12 * values[-1]
        step = vectors[:, heard] @ ((vectors.T @ slope)[heard] / values[heard])
    pose = Pose2.from_array(pose.as_array() - step)
    s = monomials(pose) @ data.rows
    return _Found(pose, float(weights @ (s * s)), information, data.in_front(pose))


def _same(a: _Found, b: _Found) -> bool:
    """Whether two poses are one up to the noise, as far as the better of them tells."""
    better = a if a.chi2 < b.chi2 else b
    step = a.pose.minus(b.pose)
    return bool(step @ better.information @ step < _SAME_POSE**2) and abs(step[2]) < 0.5 * math.pi


def _solution(data: LabelledRays, found: _Found) -> Solution:
    x, y = (found.pose.x + data.origin[0], found.pose.y + data.origin[1])
    pose = Pose2(x, y, found.pose.yaw)
    unobserved = unobserved_directions(found.information, pose)
    # At a known height a central camera sees what ours does.
    if not are_horizontal(data.directions):
        central = unobserved_directions(data.central_information(found.pose), pose)
        unobserved = max(unobserved, central, key=len)
    covariance = None if unobserved else inverse(found.information)
    return Solution(pose, found.chi2, found.information, covariance, unobserved)
