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


"""Whether the covariance is true, scenario by scenario, on rendered images with their truth.

Every trial is a fresh image of a random pose on a floor of its own, searched from nothing, so that
errors are independent and the bands of chi-square hold. What the localiser is told to know only
so well, the height of its mirror and where asked the slope of the floor, is drawn as uncertain
as it is told. Where the lines in view do not fix a pose, the trial is two images: one that does,
and then, an odometry step later, the one in question; the step is as far from what the wheels
tell as the localiser expects.

Every scenario draws poses and noise of its own: were they shared, twenty rows would be outside
their bands by the same chance, and all answers together would tell no more than one row.
"""

from __future__ import annotations

from collections.abc import Callable
import dataclasses
from dataclasses import dataclass
import math
from typing import Any
import zlib

from nccs_pose.estimation.estimate import Estimate
from nccs_pose.estimation.localiser import Localiser
from nccs_pose.estimation.motion import by_odometry
from nccs_pose.estimation.odometry import Wheels
from nccs_pose.estimation.options import LocaliserOptions
from nccs_pose.evaluation.metrics import Consistency, consistency, expected_coverage, Statistic
from nccs_pose.evaluation.tables import table
from nccs_pose.geometry.pose import Array, Pose2, RigidTransform
from nccs_pose.simulation.renderer import render
from nccs_pose.simulation.scene import arena_scene, ideal_scene, Obstacle, Scene
import numpy as np

_SPREAD = (0.9, 0.6)
_FRAME_NS = 100_000_000
# The step of the robot between two images, as its wheels tell it, m, m and rad.
_MOTION = (0.05, 0.0, 0.03)
_PEOPLE = 3
# So many trials share a height and a slope: the renderer's tables of a mounting take longer than
# an image.
_SHARED = 20


@dataclass(frozen=True)
class Scenario:
    """One row of the table.

    :ivar name: in the table and on the command line.
    :ivar scene: what is there.
    :ivar seen: names of the lines that the second image shows; None for all, in a single image.
    :ivar people: how many stand about at random, close to the robot.
    :ivar tilt: standard deviation of the floor's slope, by roll and by pitch, rad.
    """

    name: str
    scene: Callable[[], Scene]
    seen: tuple[str, ...] | None = None
    people: int = 0
    tilt: float = 0.0

    @property
    def options(self) -> LocaliserOptions:
        """What the localiser is told."""
        return LocaliserOptions(tilt_sigma=self.tilt)


@dataclass(frozen=True, eq=False)
class Covered:
    """What became of a scenario.

    :ivar trials: how many there were.
    :ivar error: x, y (m) and yaw (rad) of those with a pose (N, 3).
    :ivar covariance: of each (N, 3, 3).
    """

    scenario: Scenario
    trials: int
    error: Array
    covariance: Array

    @property
    def consistency(self) -> Consistency:
        """NEES and coverage."""
        return consistency(self.error, self.covariance)

    @property
    def verdict(self) -> str:
        """In a word: the NEES against its 95 % band."""
        return _verdict(self.consistency)


def _ideal(width: int, noise: float, **sensor: Any) -> Callable[[], Scene]:
    return lambda: ideal_scene(width, noise).with_sensor(**sensor)


def _arena(width: int, **sensor: Any) -> Callable[[], Scene]:
    return lambda: arena_scene(width).with_sensor(**sensor)


def _parallel() -> Scene:
    return ideal_scene(640, 0.02).with_parallel_tapes()


SCENARIOS = (
    Scenario('ideal 1280, 1 % noise', _ideal(1280, 0.01)),
    Scenario('ideal 1280, 5 % noise', _ideal(1280, 0.05)),
    Scenario('ideal 640, 1 % noise', _ideal(640, 0.01)),
    Scenario('ideal 640, 2 % noise', _ideal(640, 0.02)),
    Scenario('ideal 640, 5 % noise', _ideal(640, 0.05)),
    Scenario('ideal 640, 10 % noise', _ideal(640, 0.10)),
    Scenario('blur of 1 px', _ideal(640, 0.02, psf_sigma=1.0)),
    Scenario('blur of 2 px', _ideal(640, 0.02, psf_sigma=2.0)),
    Scenario('JPEG 90', _ideal(640, 0.02, jpeg_quality=90)),
    Scenario('JPEG 50', _ideal(640, 0.02, jpeg_quality=50)),
    Scenario('JPEG 20', _ideal(640, 0.02, jpeg_quality=20)),
    Scenario('people in the way', _ideal(640, 0.02), people=_PEOPLE),
    Scenario('floor uneven by 0.3 deg', _ideal(640, 0.02), tilt=math.radians(0.3)),
    Scenario('floor uneven by 0.6 deg', _ideal(640, 0.02), tilt=math.radians(0.6)),
    Scenario('textured arena 1280', _arena(1280)),
    Scenario('textured arena 640', _arena(640)),
    Scenario('textured arena 640, JPEG 30', _arena(640, jpeg_quality=30)),
    Scenario('textured arena 640, people', _arena(640), people=_PEOPLE),
    Scenario('one line', _ideal(640, 0.02), seen=('south',)),
    Scenario('two parallel lines', _parallel, seen=('south', 'north')),
)


def run_scenario(
    scenario: Scenario, trials: int, *, seed: int,
    progress: Callable[[str], None] = lambda text: None,
) -> Covered:
    """Play a scenario's trials to one localiser that forgets everything between them."""
    scene = scenario.scene()
    localiser = Localiser(scene.rig, scene.line_map, scenario.options)
    errors, covariances = [], []
    for k in range(trials):
        pose, estimate = play_trial(localiser, scenario, scene, k, seed=seed)
        progress(scenario.name)
        if estimate.pose is None or estimate.covariance is None:
            continue
        errors.append(estimate.pose.minus(pose))
        covariances.append(estimate.covariance)
    return Covered(
        scenario, trials, np.reshape(errors, (-1, 3)), np.reshape(covariances, (-1, 3, 3)))


def play_trial(
    localiser: Localiser, scenario: Scenario, scene: Scene, k: int, *, seed: int,
) -> tuple[Pose2, Estimate]:
    """The true pose and the estimate of a scenario's k-th trial.

    :param scene: the scenario's, made once; the localiser is that of its rig and map.
    """
    own = (seed, zlib.crc32(scenario.name.encode()))
    rng = np.random.default_rng([*own, k])
    pose = Pose2(*rng.uniform(-1.0, 1.0, 3) * (*_SPREAD, np.pi))
    standing = _standing(
        scene, scenario.options, np.random.default_rng([*own, k // _SHARED, 1]))
    localiser.reset()
    if scenario.seen is not None:
        return _second_image(localiser, standing, scenario.seen, pose, rng)
    peopled = _peopled(_fresh_floor(standing, k), scenario.people, pose, rng)
    return pose, localiser.process(0, render(peopled, pose, rng))


def _standing(scene: Scene, options: LocaliserOptions, rng: np.random.Generator) -> Scene:
    """The same robot, as high and as level as the localiser expects it to stand."""
    z, roll, pitch = rng.standard_normal(3) * (
        options.height_sigma, options.tilt_sigma, options.tilt_sigma)
    off_plane = RigidTransform.from_rpy((roll, pitch, 0.0), (0.0, 0.0, z))
    return scene.mounted(off_plane @ scene.rig.T_base_mirror)


def _fresh_floor(scene: Scene, seed: int) -> Scene:
    """The same room with another pattern on its floor: one beside a tape errs alike every time."""
    texture = scene.appearance.texture
    if texture is None:
        return scene
    look = dataclasses.replace(
        scene.appearance, texture=dataclasses.replace(texture, seed=seed))
    return dataclasses.replace(scene, appearance=look)


def _peopled(scene: Scene, count: int, pose: Pose2, rng: np.random.Generator) -> Scene:
    people = []
    for _ in range(count):
        angle, distance = rng.uniform(-np.pi, np.pi), rng.uniform(0.6, 1.2)
        people.append(Obstacle(
            pose.x + distance * math.cos(angle), pose.y + distance * math.sin(angle), 0.2, 1.7))
    return scene.with_things(people)


def _second_image(
    localiser: Localiser, scene: Scene, seen: tuple[str, ...], pose: Pose2,
    rng: np.random.Generator,
) -> tuple[Pose2, Estimate]:
    """The true pose and the estimate of an image that follows one with all lines."""
    told = pose @ Pose2(*_MOTION)
    # What is expected goes by the step that wheels tell, so it is the true one that is drawn: if
    # they erred from a true step, those that tell too little would be thought too exact.
    expected = by_odometry(pose, np.zeros((3, 3)), Wheels(pose), Wheels(told))
    there = Pose2.from_array(rng.multivariate_normal(told.as_array(), expected.carried))
    localiser.add_odometry(-_FRAME_NS, pose)
    localiser.add_odometry(0, pose)
    localiser.process(0, render(scene, pose, rng))
    localiser.add_odometry(_FRAME_NS, told)
    image = render(scene.with_tapes(*seen), there, rng)
    return there, localiser.process(_FRAME_NS, image)


def coverage_table(rows: list[Covered]) -> str:
    """All scenarios as Markdown, then all their answers together.

    Coverage is that of x, y and yaw, each by its own sigma.
    """
    one, two, three = expected_coverage()
    cells = [['scenario', 'answered', 'NEES (3)', '95 % band', f'1 sigma ({one:.3f})',
              f'2 sigma ({two:.3f})', f'3 sigma ({three:.3f})', 'RMS mm', 'RMS mdeg',
              'covariance']]
    for row in rows:
        translation = Statistic.of(np.hypot(row.error[:, 0], row.error[:, 1])).rmse
        yaw = Statistic.of(np.abs(row.error[:, 2])).rmse
        cells.append([
            row.scenario.name, *_cells(row.consistency, row.trials), f'{1e3 * translation:.3f}',
            f'{1e3 * math.degrees(yaw):.2f}', row.verdict])
    together = consistency(
        np.concatenate([row.error for row in rows]),
        np.concatenate([row.covariance for row in rows]))
    cells.append([
        'all', *_cells(together, sum(row.trials for row in rows)), '', '', _verdict(together)])
    return table(cells)


def _cells(found: Consistency, trials: int) -> list[str]:
    """What a row says of its covariances."""
    low, high = found.band
    return [
        f'{found.count} of {trials}', f'{found.mean_nees:.2f}', f'{low:.2f} to {high:.2f}',
        *(f'{value:.3f}' for value in found.pooled)]


def _verdict(found: Consistency) -> str:
    if found.count == 0:
        return 'no pose'
    if found.mean_nees > found.band[1]:
        return 'too sure'
    return 'too careful' if found.mean_nees < found.band[0] else 'true'
