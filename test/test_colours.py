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

"""Maps of any colour, on any floor, in any light: found from nothing, and never elsewhere."""

from __future__ import annotations

import dataclasses
import math

from nccs_pose.estimation.estimate import Estimate
from nccs_pose.estimation.localiser import Localiser
from nccs_pose.geometry.lines import LineMap
from nccs_pose.geometry.pose import Pose2, wrap_angle
from nccs_pose.simulation.renderer import render
from nccs_pose.simulation.scene import arena_scene, Scene
import numpy as np
import pytest

FLOORS = {
    'grey': (0.30, 0.34, 0.36), 'wood': (0.16, 0.30, 0.44), 'green': (0.10, 0.30, 0.12),
    'dark': (0.07, 0.08, 0.09), 'blue': (0.34, 0.20, 0.10), 'light': (0.62, 0.65, 0.66)}
# Blue, green and red gains, and exposure in stops.
LIGHTS = {
    'neutral': ((0.94, 1.0, 1.05), 0.0), 'warm': ((0.7, 1.0, 1.3), 0.0),
    'cold': ((1.3, 1.0, 0.7), 0.0), 'dim': ((0.94, 1.0, 1.05), -2.0),
    'bright': ((0.94, 1.0, 1.05), 2.0)}
MIXED = ('white', 'red', 'blue', 'yellow')


def _scene(colours: tuple[str, ...], floor: str, light: str, width: int = 640) -> Scene:
    scene = arena_scene(width)
    balance, stops = LIGHTS[light]
    return dataclasses.replace(
        scene,
        line_map=LineMap(tuple(
            dataclasses.replace(line, colour=colour)
            for line, colour in zip(scene.line_map, colours))),
        appearance=dataclasses.replace(scene.appearance, floor_colour=FLOORS[floor]),
        sensor=dataclasses.replace(
            scene.sensor, exposure=0.8 * 2.0**stops, white_balance=balance))


def _pose(k: int, seed: int = 7) -> tuple[Pose2, np.random.Generator]:
    rng = np.random.default_rng([seed, k])
    return Pose2(*rng.uniform(-1.0, 1.0, 3) * (0.8, 0.5, np.pi)), rng


def _first(
    localiser: Localiser, scene: Scene, k: int, seed: int = 7,
) -> tuple[Estimate, Pose2]:
    """What is said of a first image, and where it was taken from."""
    pose, rng = _pose(k, seed)
    localiser.reset()
    return localiser.process(0, render(scene, pose, rng)), pose


def _is_right(found: Pose2, pose: Pose2) -> bool:
    return (math.hypot(found.x - pose.x, found.y - pose.y) < 0.05
            and abs(wrap_angle(found.yaw - pose.yaw)) < 0.02)


def _found(localiser: Localiser, scene: Scene, k: int) -> bool:
    """Whether a first image is answered; a wrong answer fails."""
    estimate, pose = _first(localiser, scene, k)
    assert estimate.pose is None or _is_right(estimate.pose, pose)
    return estimate.pose is not None


@pytest.mark.parametrize(('colours', 'floor'), [
    (('green',) * 4, 'grey'), (('white',) * 4, 'wood'), (('red',) * 4, 'green'),
    (('blue',) * 4, 'wood'), (('yellow',) * 4, 'dark'), (MIXED, 'green'), (MIXED, 'grey')])
def test_lines_of_any_colour_are_found_in_any_light(
        colours: tuple[str, ...], floor: str) -> None:
    found = []
    for light in LIGHTS:
        scene = _scene(colours, floor, light)
        localiser = Localiser(scene.rig, scene.line_map)
        found.extend(_found(localiser, scene, k) for k in (0, 1))
    assert sum(found) >= 7, 'of ten; some images do not show enough'


@pytest.mark.parametrize('light', ['neutral', 'warm'])
@pytest.mark.parametrize(('colours', 'floor'), [
    (('green',) * 4, 'green'), (('blue',) * 4, 'blue'), (MIXED, 'grey')])
def test_tapes_of_nearly_the_floors_colour_are_found_where_there_is_light(
        colours: tuple[str, ...], floor: str, light: str) -> None:
    scene = _scene(colours, floor, light)
    localiser = Localiser(scene.rig, scene.line_map)
    assert sum(_found(localiser, scene, k) for k in range(20)) >= 18


def test_a_coarse_image_is_not_taken_for_one_from_where_the_map_looks_nearly_the_same() -> None:
    # The arena looks much the same half a turn on, and these tapes are hardly brighter than noise.
    scene = _scene(('blue',) * 4, 'blue', 'neutral', width=320)
    localiser = Localiser(scene.rig, scene.line_map)
    answered = 0
    for k in (*range(10), 24, 85, 116):
        estimate, pose = _first(localiser, scene, k)
        if estimate.pose is not None and estimate.covariance is not None:
            answered += 1
            off = estimate.pose.minus(pose)
            assert off @ np.linalg.solve(estimate.covariance, off) < 5.0**2
    assert answered >= 1


def test_tapes_of_nearly_the_floors_colour_are_found_in_dim_light() -> None:
    found = []
    for colour in ('green', 'blue'):
        scene = _scene((colour,) * 4, colour, 'dim')
        localiser = Localiser(scene.rig, scene.line_map)
        found.extend(_found(localiser, scene, k) for k in range(20))
    assert sum(found) >= 30


@pytest.mark.parametrize(('colour', 'floor', 'k'), [('blue', 'blue', 52), ('white', 'light', 53)])
def test_little_that_is_seen_in_dim_light_gives_no_other_place(
        colour: str, floor: str, k: int) -> None:
    # Two strips lie on two lines at a wrong pose too; and of one of two broad lines half is seen.
    scene = _scene((colour,) * 4, floor, 'dim')
    localiser = Localiser(scene.rig, scene.line_map)
    estimate, pose = _first(localiser, scene, k, seed=57)
    assert estimate.pose is None or _is_right(estimate.pose, pose)


def test_an_image_so_small_that_one_tape_alone_is_wide_gives_no_other_place() -> None:
    # Turned by half the arena is almost itself, and tapes of half a pixel lie on what is near: of
    # these images the first and the last show no more than one.
    scene = _scene(('green',) * 4, 'grey', 'neutral', 320)
    localiser = Localiser(scene.rig, scene.line_map)
    assert sum(_found(localiser, scene, k) for k in (0, 1, 2, 13)) >= 2


@pytest.mark.parametrize('light', ['dim', 'bright', 'warm', 'cold'])
def test_light_that_changes_between_two_images_does_not_lose_the_lines(light: str) -> None:
    before, after = _scene(MIXED, 'green', 'neutral'), _scene(MIXED, 'green', light)
    pose, rng = _pose(0)
    localiser = Localiser(before.rig, before.line_map)
    for k in (-2, -1, 0):
        localiser.add_odometry(k * 100_000_000, pose)
    assert localiser.process(-100_000_000, render(before, pose, rng)).pose is not None
    estimate = localiser.process(0, render(after, pose, rng))
    assert estimate.pose is not None
    assert np.hypot(estimate.pose.x - pose.x, estimate.pose.y - pose.y) < 0.01
    assert abs(wrap_angle(estimate.pose.yaw - pose.yaw)) < 0.005
