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
"""One trial of the paper's synthetic experiments: a data set, and four answers to it.

The data set follows the paper's section IV-A: random lines in space that the camera sees, a random
true pose, M points of each line projected through the mirror, Gaussian noise on the pixels or on
the points. The answers are the paper's estimator with and without g_2, from a start near the
truth, ours from no start at all, and a draw from the Cramér-Rao bound.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
import math

from nccs_pose.errors import EstimationError, SimulationError
from nccs_pose.estimation.bound import cramer_rao_bound
from nccs_pose.estimation.global_pose import solve
from nccs_pose.estimation.image_refine import refine_in_image
from nccs_pose.estimation.paper import paper_estimate
from nccs_pose.evaluation.experiment_options import ExperimentOptions
from nccs_pose.geometry.pose import Array, Pose2
from nccs_pose.geometry.rig import Rig
import numpy as np
from numpy.typing import NDArray

# Noise that the estimator is told of when there is none: any positive number would do.
_NO_NOISE_PX = 1e-3
_TRIES = 200
_REACH = 4.0  # m: the true position lies within this of the map's origin, in x and in y


@dataclass(frozen=True)
class Cell:
    """One box of a figure: the setting that its trials share.

    :ivar mirror: name in Table I.
    :ivar level: number on the figure's x-axis.
    :ivar lines: lines per trial.
    :ivar points: points per line.
    :ivar sigma_px: noise of the pixels, px.
    :ivar sigma_world: noise of the points in the world, metres.
    :ivar on_floor: lines on the ground instead of anywhere in space.
    :ivar blind: the paper's estimator starts anywhere.
    :ivar key: what the random numbers depend on, beside seed and trial.
    """

    mirror: str
    level: float
    lines: int
    points: int
    sigma_px: float = 0.0
    sigma_world: float = 0.0
    on_floor: bool = False
    blind: bool = False
    key: tuple[int, ...] = ()


@dataclass(frozen=True, eq=False)
class DataSet:
    """What one trial's estimators are given, and the truth.

    :ivar pixels: noisy pixels (M, 2).
    :ivar clean: the same pixels without noise (M, 2).
    :ivar directions: unit directions of the lines in the map (L, 3).
    :ivar moments: their moments (L, 3), metres.
    :ivar label: line of each pixel (M,).
    :ivar truth: T_map_base.
    :ivar start: first guess of the paper's estimator.
    """

    pixels: Array
    clean: Array
    directions: Array
    moments: Array
    label: NDArray[np.intp]
    truth: Pose2
    start: Pose2


@dataclass(frozen=True)
class Answer:
    """One estimator's answer to one trial.

    :ivar error: (x, y, yaw) estimated minus true; None where there is no estimate.
    :ivar nees: squared error in units of the bound; None without noise or estimate.
    """

    estimator: str
    error: tuple[float, float, float] | None
    nees: float | None

    @property
    def rotation_deg(self) -> float:
        """Absolute rotation error in degrees; infinite where there is no estimate."""
        return math.inf if self.error is None else math.degrees(abs(self.error[2]))

    @property
    def translation(self) -> float:
        """Norm of the translation error in metres; infinite where there is no estimate."""
        return math.inf if self.error is None else math.hypot(*self.error[:2])

    def failed(self, options: ExperimentOptions) -> bool:
        """Whether it is farther off than the limits of a failure, or not there."""
        return (
            self.rotation_deg > options.failure_angle_deg
            or self.translation > options.failure_distance)


@lru_cache(maxsize=16)
def _rig(options: ExperimentOptions, name: str) -> Rig:
    return options.rig(name)


def run_trial(options: ExperimentOptions, cell: Cell, trial: int) -> tuple[Answer, ...]:
    """All estimators on one data set, as `options.estimators` orders them.

    The numbers depend on the options, the cell and the trial only, not on what ran before.
    """
    rng = np.random.default_rng(
        np.random.SeedSequence(options.seed, spawn_key=(*cell.key, trial)))
    rig = _rig(options, cell.mirror)
    data = make_data_set(rig, options, cell, rng)
    d, mu = data.directions[data.label], data.moments[data.label]
    noisy = cell.sigma_px > 0.0 or cell.sigma_world > 0.0
    bound = None
    if noisy:
        bound = cramer_rao_bound(
            rig.back_project(data.clean), d, mu, data.truth,
            sigma=cell.sigma_px or _NO_NOISE_PX, sigma_world=cell.sigma_world)
    draw = np.zeros(3) if bound is None else np.linalg.cholesky(bound) @ rng.normal(size=3)
    ways: dict[str, Callable[[], Pose2 | None]] = {
        'paper': lambda: paper_estimate(
            rig, data.pixels, d, mu, data.start, normalised=options.normalised).pose,
        'paper without g2': lambda: paper_estimate(
            rig, data.pixels, d, mu, data.start, use_g2=False,
            normalised=options.normalised).pose,
        'ours': lambda: our_estimate(rig, data, cell),
        'bound': lambda: Pose2.from_array(data.truth.as_array() + draw),
    }
    return tuple(_answer(name, ways[name](), data.truth, bound) for name in options.estimators)


def our_estimate(rig: Rig, data: DataSet, cell: Cell) -> Pose2 | None:
    """Closed form without a start, then the robust refinement in the image."""
    rays = rig.back_project(data.pixels)
    sigma, world = cell.sigma_px or _NO_NOISE_PX, cell.sigma_world
    try:
        found = solve(
            rays, data.directions, data.moments, data.label, sigma=sigma, sigma_world=world)
        return refine_in_image(
            rig, data.pixels, data.directions[data.label], data.moments[data.label],
            found[0].pose, sigma=sigma, sigma_world=world).pose
    except EstimationError:
        return None


def _answer(name: str, pose: Pose2 | None, truth: Pose2, bound: Array | None) -> Answer:
    if pose is None:
        return Answer(name, None, None)
    error = pose.minus(truth)
    nees = None if bound is None else float(error @ np.linalg.solve(bound, error))
    x, y, yaw = error.tolist()
    return Answer(name, (x, y, yaw), nees)


def make_data_set(
    rig: Rig, options: ExperimentOptions, cell: Cell, rng: np.random.Generator,
) -> DataSet:
    """Random lines (the paper's eq. 23), a random pose, noisy pixels.

    :raises SimulationError: if the rig hardly sees any line of this range.
    """
    x, y = rng.uniform(-_REACH, _REACH, 2).tolist()
    truth = Pose2(x, y, rng.uniform(-math.pi, math.pi))
    # a uniform direction and distance, so that the start is anywhere in the disc
    angle, distance = rng.uniform(-math.pi, math.pi), math.sqrt(rng.uniform())
    reach, turn = (3.0, 180.0) if cell.blind else (options.start_distance, options.start_angle_deg)
    start = Pose2(
        truth.x + reach * distance * math.cos(angle), truth.y + reach * distance * math.sin(angle),
        truth.yaw + math.radians(turn) * rng.uniform(-1.0, 1.0))
    in_base, clean, directions = _random_lines(rig, options, cell, rng)
    label = np.repeat(np.arange(cell.lines), cell.points)
    d = directions @ truth.rotation.T
    mu = np.cross(truth.apply(in_base[::cell.points]), d)
    pixels, seen = clean, np.ones(len(clean), dtype=bool)
    if cell.sigma_world > 0.0:
        pixels, seen = rig.project(
            in_base + rng.normal(size=in_base.shape) * cell.sigma_world)
    pixels = pixels + rng.normal(size=pixels.shape) * cell.sigma_px
    # a noisy pixel beside the mirror, or a point that noise hides, is no measurement
    seen &= rig.mirror_points(pixels)[1]
    return DataSet(pixels[seen], clean[seen], d, mu, label[seen], truth, start)


def _random_lines(
    rig: Rig, options: ExperimentOptions, cell: Cell, rng: np.random.Generator,
) -> tuple[Array, Array, Array]:
    """Random lines of which the camera sees enough points.

    :returns: points (L K, 3), line by line, and their pixels (L K, 2); directions (L, 3). All in
        base_link.
    """
    points: list[Array] = []
    pixels: list[Array] = []
    directions: list[Array] = []
    count, tries = 4 * cell.points + 20, 0
    while len(directions) < cell.lines:
        if tries > _TRIES * cell.lines:
            raise SimulationError(
                f'mirror {cell.mirror!r} sees hardly any line with {cell.points} points between '
                f'nearest = {options.nearest} m and farthest = {options.farthest} m')
        # all at once, and a few more than are missing: projecting is cheap in bulk
        batch = 2 * (cell.lines - len(directions)) + 2
        tries += batch
        q, d = _lines(rig, options, cell.on_floor, batch, rng)
        along = options.length * rng.uniform(-0.5, 0.5, (batch, count, 1))
        places = q[:, None] + along * d[:, None]
        distance = np.linalg.norm(places - rig.T_base_mirror.translation, axis=2)
        near = (distance >= options.nearest) & (distance <= options.farthest)
        image, usable = np.zeros((batch, count, 2)), np.zeros((batch, count), dtype=bool)
        image[near], usable[near] = rig.project(places[near])
        for i in np.flatnonzero(usable.sum(axis=1) >= cell.points)[:cell.lines - len(points)]:
            chosen = np.flatnonzero(usable[i])[:cell.points]
            points.append(places[i, chosen])
            pixels.append(image[i, chosen])
            directions.append(d[i])
    return np.concatenate(points), np.concatenate(pixels), np.array(directions)


def _lines(
    rig: Rig, options: ExperimentOptions, on_floor: bool, count: int, rng: np.random.Generator,
) -> tuple[Array, Array]:
    """Points (N, 3) that lines go through, and unit directions (N, 3), in base_link."""
    mirror = rig.T_base_mirror.translation
    q, d = rng.normal(size=(2, count, 3))
    if on_floor:
        q[:, 2] = d[:, 2] = 0.0
    distance = rng.uniform(options.nearest, options.farthest, (count, 1))
    centre = np.array([mirror[0], mirror[1], 0.0]) if on_floor else mirror
    q = centre + q * distance / np.linalg.norm(q, axis=1, keepdims=True)
    return q, d / np.linalg.norm(d, axis=1, keepdims=True)
