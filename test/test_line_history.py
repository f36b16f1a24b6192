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

"""What images say of the map's lines, one after the other."""

from __future__ import annotations

from nccs_pose.estimation.aligner import Aligner
from nccs_pose.estimation.alignment import Alignment
from nccs_pose.estimation.line_history import LineHistory
from nccs_pose.estimation.options import LocaliserOptions
from nccs_pose.geometry.floor_table import FloorTable
from nccs_pose.geometry.lines import LineMap
from nccs_pose.geometry.pose import Pose2
from nccs_pose.simulation.renderer import render
from nccs_pose.simulation.scene import arena_scene
import numpy as np
import pytest

SCENE = arena_scene(640)
MIDDLE, EAST = Pose2(0.1, 0.0, 0.4), Pose2(1.1, 0.0, -1.6)


def _laid(pose: Pose2, line_map: LineMap = SCENE.line_map) -> Alignment:
    """A pose laid on the image taken from it, on a map that may not be the world's."""
    options = LocaliserOptions()
    aligner = Aligner(FloorTable(SCENE.rig, options.reach), line_map, options)
    image = render(SCENE, pose, np.random.default_rng(3))
    alignment = aligner.align(image, pose, aligner.nominal_colours, reach=2.0)
    assert alignment is not None
    return alignment


def test_four_lines_in_their_places_at_once_are_proven() -> None:
    history = LineHistory().after(_laid(MIDDLE), searched=True)
    assert history.proven == history.shown == {0, 1, 2, 3}
    # From the arena's eastern end the western line is too thin to say anything new.
    far = _laid(EAST)
    assert 0.0 < far.width[3] < 0.5
    assert history.unasked(far) == {3}
    assert LineHistory().unasked(far) == frozenset()


@pytest.mark.parametrize('line', range(4))
def test_none_is_proven_while_one_is_elsewhere(line: int) -> None:
    tape = SCENE.line_map[line]
    aside = 0.1 * np.array([-tape.direction[1], tape.direction[0], 0.0])
    lines = list(SCENE.line_map)
    lines[line] = type(tape)(tape.start + aside, tape.end + aside, tape.width, tape.colour)
    history = LineHistory().after(_laid(MIDDLE, LineMap(tuple(lines))), searched=True)
    assert history.proven == frozenset()


def test_three_lines_prove_nothing_and_a_doubt_lasts_until_a_line_is_shown() -> None:
    far, near = _laid(EAST), _laid(MIDDLE)
    history = LineHistory().after(far, searched=True)
    assert history.proven == frozenset()
    assert history.shown == {0, 1, 2}
    assert history.contradicts(3) and not history.contradicts(0)
    doubting = history.doubting(0)
    assert doubting.contradicts(0)
    assert doubting.after(near, searched=False).doubted == frozenset()
