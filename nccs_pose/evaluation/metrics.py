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
"""How good a trajectory is: errors against truth, and whether its covariance tells the truth."""

from __future__ import annotations

from dataclasses import dataclass

from nccs_pose.evaluation.trajectory import Trajectory
from nccs_pose.geometry.pose import Array, pose_differences, wrap_angle
import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2, norm

SIGMAS = (1, 2, 3)
"""The multiples of sigma that coverage is counted at."""
# A true covariance has its mean NEES in the band with this probability.
_CONFIDENCE = 0.95


@dataclass(frozen=True, eq=False)
class PoseErrors:
    """Estimated minus true pose, where both are known.

    :ivar index: rows (N,) of the estimated trajectory that have a truth.
    :ivar stamps_ns: their stamps (N,), nanoseconds.
    :ivar error: x, y (m, in the map's axes) and yaw (rad, wrapped), (N, 3).
    """

    index: NDArray[np.intp]
    stamps_ns: NDArray[np.int64]
    error: Array

    def __len__(self) -> int:
        return len(self.index)

    @property
    def translation(self) -> Array:
        """Distance between the estimated and the true position (N,), metres."""
        return np.hypot(self.error[:, 0], self.error[:, 1])

    @property
    def yaw(self) -> Array:
        """Absolute yaw error (N,), radians."""
        return np.abs(self.error[:, 2])


@dataclass(frozen=True)
class Statistic:
    """Median, root mean square and largest of absolute errors; NaN where there is none."""

    median: float
    rmse: float
    max: float

    @classmethod
    def of(cls, values: Array) -> Statistic:
        """Summarise absolute errors (N,)."""
        if len(values) == 0:
            return cls(float('nan'), float('nan'), float('nan'))
        return cls(
            float(np.median(values)), float(np.sqrt(np.mean(np.square(values)))),
            float(np.max(values)))


@dataclass(frozen=True)
class Summary:
    """A run in numbers.

    :ivar frames: images that were shown to the localiser (or poses, if that is not known).
    :ivar answered: of them, those that got a pose.
    :ivar evaluated: of these, those that have a true pose to compare with.
    :ivar translation: metres.
    :ivar yaw: radians.
    """

    frames: int
    answered: int
    evaluated: int
    translation: Statistic
    yaw: Statistic

    @property
    def unanswered(self) -> int:
        """Frames without a pose."""
        return self.frames - self.answered


@dataclass(frozen=True, eq=False)
class Consistency:
    """Whether errors are as large as their covariances say.

    :ivar count: poses compared.
    :ivar mean_nees: mean normalised squared error of (x, y, yaw); 3 if the covariance is true.
    :ivar band: where the mean lies with 95 % probability if it is, for independent errors.
    :ivar coverage: fraction of errors within 1, 2 and 3 sigma (rows) for x, y, yaw (columns).
    """

    count: int
    mean_nees: float
    band: tuple[float, float]
    coverage: Array

    @property
    def pooled(self) -> Array:
        """Coverage at 1, 2 and 3 sigma over x, y and yaw together (3,)."""
        return self.coverage.mean(axis=1)


def interpolate(
    trajectory: Trajectory, stamps_ns: NDArray[np.int64], *, max_gap: float = 0.2,
    tolerance: float = 1e-3,
) -> tuple[Array, NDArray[np.bool_]]:
    """Poses of a trajectory at other stamps: straight in x and y, the short way round in yaw.

    :param stamps_ns: (N,) nanoseconds.
    :param max_gap: seconds between neighbours that may be interpolated across.
    :param tolerance: seconds within which a sample is taken as it is where the gap is wider.
    :returns: poses (N, 3), zero where there is none, and which are known (N,).
    """
    ordered = trajectory.in_order()
    stamps = np.asarray(stamps_ns, dtype=np.int64)
    if len(ordered) == 0:
        return np.zeros((len(stamps), 3)), np.zeros(len(stamps), dtype=bool)
    after = np.searchsorted(ordered.stamps_ns, stamps)
    inside = (after > 0) & (after < len(ordered))
    high = np.clip(after, 0, len(ordered) - 1)
    low = np.clip(after - 1, 0, len(ordered) - 1)
    # Differences of whole nanoseconds are exact; the stamps themselves are not, as floats.
    gap = (ordered.stamps_ns[high] - ordered.stamps_ns[low]) * 1e-9
    since = (stamps - ordered.stamps_ns[low]) * 1e-9
    until = (ordered.stamps_ns[high] - stamps) * 1e-9
    share = np.where(inside, since / np.where(gap > 0.0, gap, 1.0), 0.0)
    start, end = ordered.poses[low], ordered.poses[high]
    poses = start + share[:, None] * pose_differences(end, start)
    nearest = np.where(np.abs(since)[:, None] < np.abs(until)[:, None], start, end)
    as_is = (until == 0.0) | ~(inside & (gap <= max_gap))
    poses = np.where(as_is[:, None], nearest, poses)
    known = ~as_is | (np.minimum(np.abs(since), np.abs(until)) <= tolerance)
    poses[:, 2] = wrap_angle(poses[:, 2])
    return np.where(known[:, None], poses, 0.0), known


def compare(
    estimated: Trajectory, truth: Trajectory, *, max_gap: float = 0.2, tolerance: float = 1e-3,
) -> PoseErrors:
    """Errors of a trajectory against truth, matched by stamp (see :func:`interpolate`)."""
    poses, known = interpolate(
        truth, estimated.stamps_ns, max_gap=max_gap, tolerance=tolerance)
    index = np.flatnonzero(known)
    return PoseErrors(
        index, estimated.stamps_ns[index],
        pose_differences(estimated.poses[index], poses[index]))


def summarise(errors: PoseErrors, *, frames: int, answered: int) -> Summary:
    """Put a run's errors into numbers."""
    return Summary(
        frames, answered, len(errors), Statistic.of(errors.translation), Statistic.of(errors.yaw))


def nees(error: Array, covariance: Array) -> Array:
    """Normalised estimation error squared (N,) of errors (N, 3) with covariances (N, 3, 3)."""
    solved = np.linalg.solve(covariance, error[:, :, None])[:, :, 0]
    return np.einsum('ni,ni->n', error, solved)


def consistency(error: Array, covariance: Array) -> Consistency:
    """Test covariances (N, 3, 3) against errors (N, 3): NEES with its chi-square band, coverage.

    See Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and Navigation, 5.4.
    """
    count = len(error)
    if count == 0:
        nothing = float('nan')
        return Consistency(0, nothing, (nothing, nothing), np.full((3, 3), nothing))
    tails = 0.5 * (1.0 - _CONFIDENCE)
    low, high = chi2.ppf([tails, 1.0 - tails], 3 * count) / count
    sigma = np.sqrt(np.einsum('nii->ni', covariance))
    coverage = np.array([np.mean(np.abs(error) <= k * sigma, axis=0) for k in SIGMAS])
    return Consistency(
        count, float(np.mean(nees(error, covariance))), (float(low), float(high)), coverage)


def expected_coverage() -> Array:
    """Coverage at 1, 2 and 3 sigma of a normal distribution (3,)."""
    return 2.0 * norm.cdf(SIGMAS) - 1.0
