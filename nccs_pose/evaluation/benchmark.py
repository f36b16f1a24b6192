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
"""Speed of the paper's estimator and of ours, in one process, interleaved.

Each repetition makes a new scene and times everything on it, one after the other, so that ratios
compare like with like on whatever machine runs them; the spread over the repetitions is part of
the result. Each thing is called once to warm up, then as often as a few milliseconds hold. Times
are the thread's own processor time: what else the machine does meanwhile is not counted.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
import math
import os
import platform
import time
from typing import Any

from nccs_pose.errors import OptionError
from nccs_pose.estimation.global_pose import best_pose, solve
from nccs_pose.estimation.image_refine import refine_in_image
from nccs_pose.estimation.paper import paper_estimate
from nccs_pose.estimation.refine import refine
from nccs_pose.estimation.residual import whitened_residual
from nccs_pose.evaluation.experiment_options import ExperimentOptions
from nccs_pose.evaluation.tables import table
from nccs_pose.evaluation.trials import Cell, DataSet, make_data_set
from nccs_pose.geometry.line_trace import trace_line
from nccs_pose.geometry.lines import Line
from nccs_pose.geometry.pose import Pose2
from nccs_pose.geometry.projection import reflect_points
from nccs_pose.geometry.reflection_curve import ReflectionCurve
from nccs_pose.geometry.rig import Rig
import numpy as np
import scipy
from scipy.optimize import least_squares

_MIRROR = 'spherical'  # the paper's robot has one
_SIGMA = 1.0  # px
_TIMED = 5e-3  # seconds of calls that one timing is the mean of
_BULK = 10_000  # points projected, and evaluated on the curve, at a time
CELLS = {
    '4 floor lines × 75': Cell(_MIRROR, 4.0, 4, 75, _SIGMA, on_floor=True, key=(50, 0)),
    '5 lines in space × 20': Cell(_MIRROR, 5.0, 5, 20, _SIGMA, key=(50, 1)),
}
PAPER = "the paper's estimator"
PAPER_FREE = "the paper's, without g2"
FULL = 'ours: closed form, refinement, covariance'
IMAGE = 'ours: the same and the refinement for coarse pixels'
CLOSED = 'ours: re-weighted closed form, covariance'
POSES = 'ours: re-weighted closed form, with twins, unseen directions, rays that point away'
WARM = 'ours: warm-started refinement, covariance'
BACK = 'back-projection with Jacobians'
PROJECTION = f'forward projection of {_BULK} points'
CURVE = f'gamma at {_BULK} points'
TRACE = 'a 4 m line traced into the image'


@dataclass(frozen=True, eq=False)
class Timing:
    """Seconds of one thing over the repetitions (R,)."""

    name: str
    seconds: np.ndarray

    def quartiles(self) -> tuple[float, float, float]:
        """Lower quartile, median and upper quartile, seconds."""
        low, middle, high = np.percentile(self.seconds, [25.0, 50.0, 75.0]).tolist()
        return low, middle, high


@dataclass(frozen=True, eq=False)
class Benchmark:
    """All timings by scene, and the outside checks.

    :ivar timings: by scene, then by name.
    :ivar least_squares_apart: largest difference (m, rad) to scipy's minimum of the same cost.
    :ivar poselib_apart: largest difference (m, rad) to PoseLib's pose, without noise; None
        without PoseLib.
    """

    timings: dict[str, dict[str, Timing]]
    least_squares_apart: float
    poselib_apart: float | None

    def ratio(self, scene: str, slow: str, fast: str) -> Timing:
        """How many times faster, repetition by repetition."""
        timings = self.timings[scene]
        return Timing(f'{slow} / {fast}', timings[slow].seconds / timings[fast].seconds)


def run_benchmark(
    repetitions: int, progress: Callable[[str], None] = lambda note: None,
) -> Benchmark:
    """Time everything, ``repetitions`` times.

    :param progress: called after each repetition on each of CELLS, with its name.
    :raises OptionError: for fewer than 3 repetitions.
    """
    if repetitions < 3:
        raise OptionError(f'repetitions = {repetitions}: a spread needs at least 3')
    options = ExperimentOptions()
    rig = options.rig(_MIRROR)
    timings, apart, poselib_apart = {}, 0.0, []
    for scene, cell in CELLS.items():
        measured: dict[str, list[float]] = {}
        for repetition in range(repetitions):
            rng = np.random.default_rng(np.random.SeedSequence(
                options.seed, spawn_key=(*cell.key, repetition)))
            data = make_data_set(rig, options, cell, rng)
            for name, work in _work(rig, data).items():
                measured.setdefault(name, []).append(_seconds(work))
            apart = max(apart, _least_squares_apart(rig, data))
            poselib_apart.append(_poselib_apart(rig, data))
            progress(scene)
        timings[scene] = {n: Timing(n, np.array(s)) for n, s in measured.items()}
    compared = [a for a in poselib_apart if a is not None]
    return Benchmark(timings, apart, max(compared) if compared else None)


def _seconds(work: Callable[[], Any]) -> float:
    """Seconds of one call."""
    start = time.thread_time()
    work()
    calls = max(1, round(_TIMED / max(time.thread_time() - start, 1e-6)))
    start = time.thread_time()
    for _ in range(calls):
        work()
    return (time.thread_time() - start) / calls


def _work(rig: Rig, data: DataSet) -> dict[str, Callable[[], Any]]:
    """What is timed: estimators from the rays (the paper's from the mirror points) on."""
    d, mu, label = data.directions, data.moments, data.label
    rays = rig.back_project(data.pixels)
    rng = np.random.default_rng(0)
    points = rng.normal(size=(_BULK, 3))
    y, z = rng.uniform(-0.02, 0.02, (2, _BULK))
    line = Line(np.array([-2.0, 1.0, 0.0]), np.array([2.0, 1.2, 0.0]))
    curve = ReflectionCurve.of_line(rig, line)

    def full() -> None:
        first = solve(rays, d, mu, label)[0].pose
        refine(rays, d[label], mu[label], first)

    def in_image() -> None:
        first = solve(rays, d, mu, label)[0].pose
        refine_in_image(rig, data.pixels, d[label], mu[label], first, rays=rays)

    return {
        PAPER: lambda: paper_estimate(rig, data.pixels, d[label], mu[label], data.start),
        FULL: full,
        IMAGE: in_image,
        CLOSED: lambda: best_pose(rays, d, mu, label),
        POSES: lambda: solve(rays, d, mu, label),
        PAPER_FREE: lambda: paper_estimate(
            rig, data.pixels, d[label], mu[label], data.start, use_g2=False),
        WARM: lambda: refine(rays, d[label], mu[label], data.start),
        BACK: lambda: rig.back_project(data.pixels),
        PROJECTION: lambda: reflect_points(rig.mirror, rig.cop, points),
        CURVE: lambda: curve.gamma(y, z),
        TRACE: lambda: trace_line(rig, line),
    }


def _difference(a: Pose2, b: Pose2) -> float:
    return float(np.abs(a.minus(b)).max())


def _least_squares_apart(rig: Rig, data: DataSet) -> float:
    """Our refinement without outlier rejection against scipy's least squares."""
    rays = rig.back_project(data.pixels)
    d, mu = data.directions[data.label], data.moments[data.label]
    first = solve(rays, data.directions, data.moments, data.label)[0].pose
    ours = refine(rays, d, mu, first, robust=False).pose
    theirs = least_squares(
        lambda v: whitened_residual(rays, d, mu, Pose2.from_array(v))[0], data.truth.as_array(),
        method='lm', xtol=1e-15, ftol=1e-15, gtol=1e-15)
    return _difference(ours, Pose2.from_array(theirs.x))


def _poselib_apart(rig: Rig, data: DataSet) -> float | None:
    """Our closed form without noise against PoseLib's upright generalised point-to-line solver."""
    try:
        import poselib
    except ImportError:
        return None
    rays = rig.back_project(data.clean)
    ours = solve(rays, data.directions, data.moments, data.label)[0].pose
    # a minimal sample: four pixels, one on each of four lines; PoseLib's vertical axis is y
    first = [int(np.flatnonzero(data.label == k)[0]) for k in range(4)]
    upright = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    r, w = rays.direction[first], rays.moment[first]
    d, mu = data.directions[data.label[first]], data.moments[data.label[first]]
    found = poselib.ugp4pl(
        np.cross(r, w) @ upright.T, r @ upright.T, np.cross(d, mu) @ upright.T, d @ upright.T)
    if not found:
        return None
    return min(_difference(ours, _from_poselib(pose, upright)) for pose in found)


def _from_poselib(pose: Any, upright: np.ndarray) -> Pose2:
    """T_map_base from PoseLib's map-to-base transform with its y axis upright."""
    rotation = upright.T @ pose.R @ upright
    position = -rotation.T @ (upright.T @ pose.t)
    return Pose2(
        float(position[0]), float(position[1]),
        math.atan2(float(rotation[0, 1]), float(rotation[0, 0])))


def report(benchmark: Benchmark) -> str:
    """The results as Markdown."""
    parts = [f'{_machine()}\n']
    for scene, timings in benchmark.timings.items():
        rows = [[scene, 'median (ms)', 'quartiles (ms)']]
        for timing in timings.values():
            low, middle, high = timing.quartiles()
            rows.append([
                timing.name, f'{1e3 * middle:.3f}', f'{1e3 * low:.3f} to {1e3 * high:.3f}'])
        parts.append(table(rows))
        rows = [[f'times faster than {PAPER}', 'median', 'quartiles']]
        for fast in (FULL, IMAGE, POSES, CLOSED, WARM, PAPER_FREE):
            low, middle, high = benchmark.ratio(scene, PAPER, fast).quartiles()
            rows.append([fast, f'{middle:.1f}', f'{low:.1f} to {high:.1f}'])
        parts.append(table(rows))
        projection = 1e6 * timings[PROJECTION].quartiles()[1] / _BULK
        parts.append(f'Forward projection: {projection:.2f} µs a point.\n')
    parts.append(
        'Outside checks: the refinement ends within '
        f'{benchmark.least_squares_apart:.1e} (m, rad) of scipy.optimize.least_squares; '
        + ('PoseLib is not installed.' if benchmark.poselib_apart is None else
           f'the closed form within {benchmark.poselib_apart:.1e} of PoseLib without noise.')
        + '\n')
    return '\n'.join(parts)


def _machine() -> str:
    return (
        f'Python {platform.python_version()}, numpy {np.__version__}, scipy {scipy.__version__}, '
        f'{platform.machine()}, {os.cpu_count()} cores')


def as_numbers(benchmark: Benchmark) -> dict[str, Any]:
    """All repetitions for JSON, so that anybody can make other statistics of them."""
    return {
        'machine': _machine(),
        'seconds': {
            scene: {name: timing.seconds.tolist() for name, timing in timings.items()}
            for scene, timings in benchmark.timings.items()},
        'least_squares_apart': benchmark.least_squares_apart,
        'poselib_apart': benchmark.poselib_apart}
