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

"""Passes over one image, against the pose that it was rendered from."""

from __future__ import annotations

from dataclasses import replace
import math

from nccs_pose.estimation.aligner import Aligner, SPACING
from nccs_pose.estimation.alignment import Pass
from nccs_pose.estimation.measuring import Measurer
from nccs_pose.estimation.options import LocaliserOptions
from nccs_pose.geometry.floor_table import FloorTable
from nccs_pose.geometry.lines import LineMap
from nccs_pose.geometry.pose import Pose2
from nccs_pose.simulation.renderer import render
from nccs_pose.simulation.scene import ideal_scene
import numpy as np
import pytest

POSE = Pose2(0.3, -0.2, 0.7)
OPTIONS = LocaliserOptions(height_sigma=0.0)


def _twice(
    x: float, y: float, degrees: float, colours: tuple[str, ...] = ('green',), *,
    rough: bool = False,
) -> tuple[tuple[Pass, Pass], tuple[float, float]]:
    """A pass from a start so far off, and what is measured again; how far each is off, px."""
    scene = ideal_scene(1280, noise=0.0)
    scene = replace(scene, line_map=LineMap(tuple(
        replace(line, colour=colours[k % len(colours)])
        for k, line in enumerate(scene.line_map))))
    image = render(scene, POSE, np.random.default_rng(5))
    table = FloorTable(scene.rig, OPTIONS.reach)
    aligner = Aligner(table, scene.line_map, OPTIONS)
    right = aligner.align(image, POSE, aligner.nominal_colours, reach=2.0)
    assert right is not None
    measurer = Measurer(table, scene.line_map, OPTIONS)
    off = POSE @ Pose2(x, y, math.radians(degrees))
    places = measurer.predictor.places(off, SPACING, OPTIONS.stations)
    look = measurer.look(
        image, places.every(4) if rough else places, off, np.zeros(3), right.colours, rough=rough)
    assert look is not None
    first = measurer.measure(look, None, right.colours)
    assert first is not None
    again = measurer.measure_again(look, first)
    # What the pose that is left to go moves the station by that it moves farthest.
    missed, left = (
        float(np.abs(each.refinement.pose.minus(POSE).dot(look.slide[:3])).max())
        for each in (first, again))
    return (first, again), (missed, left)


@pytest.mark.parametrize('colours', [('green',), ('green', 'red')])
@pytest.mark.parametrize(('x', 'y', 'degrees'), [(0.003, 0.001, -0.1), (0.004, 0.0, -0.15)])
def test_what_a_pass_from_further_away_misses_is_found_in_the_same_pixels(
        colours: tuple[str, ...], x: float, y: float, degrees: float) -> None:
    (first, again), (missed, left) = _twice(x, y, degrees, colours)
    assert 0.2 < first.moved < 0.5 and missed > 0.004
    assert left < 0.15 * missed
    # What was missed is no noise any more.
    assert again.refinement.covariance.trace() < 0.5 * first.refinement.covariance.trace()
    assert again.alignment.scale < 0.95 * first.alignment.scale


@pytest.mark.parametrize(('x', 'y', 'degrees'), [(0.003, 0.001, -0.1), (0.01, 0.0, 0.4)])
def test_so_is_what_a_rough_pass_misses(x: float, y: float, degrees: float) -> None:
    _, (missed, left) = _twice(x, y, degrees, rough=True)
    assert missed > 0.02 and left < 0.25 * missed
