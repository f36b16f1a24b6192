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
"""First poses, counted map by map."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from nccs_pose.cli import main
from nccs_pose.estimation.aligner import Aligner
from nccs_pose.estimation.estimate import Candidate, Estimate, State
from nccs_pose.estimation.localiser import Localiser
from nccs_pose.estimation.many_poses import same_pose
from nccs_pose.estimation.options import LocaliserOptions
from nccs_pose.estimation.symmetries import map_symmetries
from nccs_pose.estimation.verdict import lines_used
from nccs_pose.evaluation.starts import Place, PLACES, run_starts, starts_table
from nccs_pose.geometry.floor_table import FloorTable
from nccs_pose.geometry.lines import Line, LineMap
from nccs_pose.geometry.pose import Pose2, RigidTransform
from nccs_pose.simulation.renderer import render
from nccs_pose.simulation.scene import arena_map, arena_scene, ideal_scene, Scene
import numpy as np
import pytest

FAR = Pose2(30.0, 0.0, 0.0)


def test_maps_are_as_large_and_as_alike_as_they_say() -> None:
    by_name = {place.name: place.line_map for place in PLACES}
    assert {len(line_map) for name, line_map in by_name.items() if 'arena' not in name} == {50}
    turns = {name: len(map_symmetries(line_map)) for name, line_map in by_name.items()}
    # The identity; half a turn; quarter turns.
    assert turns == {
        'arena': 1, 'arena, faint tapes': 1, 'scattered': 1, 'scattered, dense': 1,
        'parking bays': 2, 'dashes': 2, 'lattice': 4}


def test_in_the_arena_every_image_gives_the_pose() -> None:
    starts = run_starts(PLACES[0], 640, 4)
    assert starts.states == {State.TRACKING: 4}
    assert (starts.wrong, starts.without) == (0, 0)
    assert len(starts.cost) == len(starts.threshold) == 4
    assert min(starts.cost.min(), starts.threshold.min()) > 0.0


def _in_pieces(line_map: LineMap, count: int, gap: float) -> LineMap:
    """A map with each of its lines cut in so many pieces, with gaps of so many metres."""
    parts = []
    for line in line_map:
        step, half = (line.end - line.start) / count, 0.5 * gap * line.direction
        parts.extend(replace(
            line, start=line.start + k * step + (k > 0) * half,
            end=line.start + (k + 1) * step - (k + 1 < count) * half) for k in range(count))
    return LineMap(tuple(parts))


def _box(*more: tuple[tuple[float, float], tuple[float, float]]) -> LineMap:
    """A rectangle of tapes that looks the same after half a turn, and other tapes."""
    corners = [(-2.0, -1.4), (2.0, -1.4), (2.0, 1.4), (-2.0, 1.4)]
    return _tapes(*zip(corners, corners[1:] + corners[:1]), *more)


def _tapes(*ends: tuple[tuple[float, float], tuple[float, float]]) -> LineMap:
    return LineMap(tuple(
        Line(np.array([*a, 0.0]), np.array([*b, 0.0]), width=0.05) for a, b in ends))


def _plain(width: int, line_map: LineMap) -> Scene:
    """Lines on a textured floor, in even light and with nothing around."""
    scene = arena_scene(width)
    return replace(scene, line_map=line_map, appearance=replace(
        scene.appearance, room=None, obstacles=(), light_gradient=(0.0, 0.0)))


MARKED = _box(((0.8, -1.4), (0.8, 1.4)))


def _first_estimates(
    line_map: LineMap, count: int, width: int = 640,
) -> list[tuple[Pose2, Estimate]]:
    """Poses on a map, and what a first image from each says, so many px wide."""
    scene = replace(ideal_scene(width, noise=0.02), line_map=line_map)
    localiser, rng = Localiser(scene.rig, line_map), np.random.default_rng(3)
    found = []
    for _ in range(count):
        pose = Pose2(*rng.uniform(-1.0, 1.0, 2) * (1.0, 0.7), rng.uniform(-np.pi, np.pi))
        localiser.reset()
        found.append((pose, localiser.process(0, render(scene, pose, rng))))
    return found


@pytest.mark.parametrize(('count', 'gap'), [(1, 0.0), (2, 0.0), (3, 0.0), (2, 0.05), (3, 0.05)])
@pytest.mark.parametrize('line_map', [arena_map(), MARKED], ids=['arena', 'marked'])
def test_a_map_drawn_in_pieces_gives_the_pose_like_a_whole_one(
    line_map: LineMap, count: int, gap: float,
) -> None:
    estimates = _first_estimates(_in_pieces(line_map, count, gap), 8)
    tracked = [(pose, e.pose) for pose, e in estimates if e.pose is not None]
    assert len(tracked) >= 7
    assert all(np.hypot(a.x - b.x, a.y - b.y) < 0.02 for a, b in tracked)
    assert all(e.pose is not None or e.state is State.AMBIGUOUS for _, e in estimates)


@pytest.mark.parametrize(('count', 'gap'), [(1, 0.0), (2, 0.0), (3, 0.0), (2, 0.05), (2, 0.3)])
def test_a_symmetric_map_drawn_in_pieces_gives_both_poses(count: int, gap: float) -> None:
    # A side that is cut otherwise than the one across from it is still the same paint.
    box = _in_pieces(_box(), count, gap)
    for pose, estimate in _first_estimates(
            LineMap((*_in_pieces(LineMap(box[:1]), 3, 0.0), *box[1:])), 8):
        assert estimate.state is State.AMBIGUOUS
        assert len(estimate.candidates) == 2
        for twin in (pose, Pose2(0.0, 0.0, np.pi) @ pose):
            assert any(same_pose(c.pose, twin) for c in estimate.candidates)


ZIGZAG = _tapes(
    ((-1.6, -1.2), (-1.0, -0.2)), ((-1.0, -0.2), (-0.4, -1.2)), ((-0.4, -1.2), (0.2, -0.2)),
    ((0.2, -0.2), (0.8, -1.2)), ((0.8, -1.2), (1.4, -0.2)), ((-1.5, 1.2), (1.2, 1.3)))
JOINTS = _tapes(
    ((-2.0, -1.4), (2.0, -1.4)), ((-2.0, -1.4), (-2.0, 1.4)), ((0.6, -1.4), (0.6, 1.0)),
    ((-2.0, 0.4), (1.6, 0.4)), ((1.6, -0.5), (1.6, 1.4)))
CORNERS = ((-1.9, -1.2), (0.2, -1.6), (1.9, -0.7), (1.5, 1.2), (-0.4, 1.5), (-1.7, 0.8))
HEXAGON = _tapes(*zip(CORNERS, CORNERS[1:] + CORNERS[:1]))


@pytest.mark.parametrize(('line_map', 'pose', 'leans', 'seed'), [
    (ZIGZAG, Pose2(0.14455, -0.59423, 2.38542), (-0.006438, -0.002748), (0, 5)),
    (JOINTS, Pose2(-0.57877, 0.48093, 2.09913), (-0.004842, -0.005055), (1, 29)),
    (HEXAGON, Pose2(0.68751, 0.42294, -1.40195), (-0.006601, 0.002331), (1, 12))])
def test_a_leaning_robot_is_not_taken_for_one_elsewhere(
    line_map: LineMap, pose: Pose2, leans: tuple[float, float], seed: tuple[int, int],
) -> None:
    """The image speaks against the right pose, but shows more of it than of any other."""
    scene = _plain(640, line_map)
    mounted, lean = scene.rig.T_base_mirror, RigidTransform.from_rpy(
        np.array([*leans, 0.0]), np.zeros(3))
    leaning = replace(scene, rig=replace(scene.rig, T_base_mirror=lean @ mounted))
    image = render(leaning, pose, np.random.default_rng(seed))
    estimate = Localiser(scene.rig, line_map).process(0, image)
    assert estimate.pose is None
    # Where leaning is reckoned with, the right pose holds.
    told = Localiser(scene.rig, line_map, LocaliserOptions(tilt_sigma=0.01)).process(0, image)
    assert any(same_pose(c.pose, pose) for c in told.candidates)


def test_a_corner_of_a_small_image_is_not_taken_for_another() -> None:
    """Two of its lines lie as well half a turn round, and strips show as much of both."""
    scene, pose = _plain(320, arena_map()), Pose2(0.61199, 0.77756, 1.69380)
    image = render(scene, pose, np.random.default_rng([0, 36, 1]))
    estimate = Localiser(scene.rig, scene.line_map).process(0, image)
    assert estimate.pose is None or same_pose(estimate.pose, pose)


def test_pieces_of_a_line_are_not_two_lines_wide_enough() -> None:
    drawn = arena_map(), _in_pieces(arena_map(), 2, 0.0)
    whole, cut = ([e.state for _, e in _first_estimates(m, 12, 320)] for m in drawn)
    assert State.SEARCHING in whole
    assert cut == whole


@pytest.mark.parametrize('gap', [0.0, 0.05])
def test_a_line_in_pieces_is_one_line_to_rest_on(gap: float) -> None:
    line_map = _in_pieces(MARKED, 3, gap)
    scene = replace(ideal_scene(640, noise=0.02), line_map=line_map)
    pose = Pose2(0.1, -0.2, 0.7)
    aligner = Aligner(FloorTable(scene.rig, 5.0), line_map, LocaliserOptions())
    alignment = aligner.align(
        render(scene, pose, np.random.default_rng(1)), pose, aligner.nominal_colours)
    assert alignment is not None
    assert len(alignment.lines) > 10
    assert lines_used(alignment) == 5


def test_among_many_lines_every_image_gives_the_pose() -> None:
    # At the first look at the last of them strips speak against the pose, at the next no more.
    dense = next(place for place in PLACES if place.name == 'scattered, dense')
    starts = run_starts(dense, 1280, 14)
    assert starts.states == {State.TRACKING: 14}
    assert starts.wrong == 0


@pytest.mark.parametrize(('answer', 'wrong', 'without'), [
    (Estimate(0, State.TRACKING, '', FAR, np.diag((1e-4, 1e-4, 1e-4))), 3, 0),
    (Estimate(0, State.TRACKING, '', FAR, np.diag((1e6, 1e6, 1e6))), 0, 0),
    (Estimate(0, State.AMBIGUOUS, '', candidates=(Candidate(FAR, 1.0),)), 0, 3),
    (Estimate(0, State.SEARCHING, ''), 0, 0)])
def test_what_is_wrong_is_counted(
    answer: Estimate, wrong: int, without: int, monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(Localiser, 'process', lambda *_: answer)
    starts = run_starts(Place('arena', arena_map()), 160, 3)
    assert (starts.wrong, starts.without) == (wrong, without)
    assert starts.states == {answer.state: 3}
    row = [cell.strip() for cell in starts_table([starts]).splitlines()[-1].split('|')[1:-1]]
    counts = (answer.state is State.TRACKING, answer.state is State.AMBIGUOUS)
    assert row[:9] == ['arena', '4', '160', '3', *(
        str(n) for n in (3 * counts[0], wrong, 3 * counts[1], without, 3 - 3 * sum(counts)))]


def test_the_true_pose_is_looked_for_among_several(monkeypatch: pytest.MonkeyPatch) -> None:
    true: list[Pose2] = []
    reset = Pose2(0.0, 0.0, 0.0)

    def render(scene: Any, pose: Pose2, rng: np.random.Generator) -> np.ndarray:
        true.append(pose)
        return np.zeros((120, 160, 3), np.uint8)

    def process(*_: Any) -> Estimate:
        near = true[-1] @ replace(reset, x=0.1)
        return Estimate(0, State.AMBIGUOUS, '', candidates=(
            Candidate(FAR, 1.0), Candidate(near, 0.9)))

    monkeypatch.setattr('nccs_pose.evaluation.starts.render', render)
    monkeypatch.setattr(Localiser, 'process', process)
    starts = run_starts(Place('arena', arena_map()), 160, 5)
    assert starts.without == 0
    assert starts.states == {State.AMBIGUOUS: 5}
    # All within the middle half of what the map spans.
    x, y = np.array([(pose.x, pose.y) for pose in true]).T
    assert np.abs(x).max() < 1.0 and np.abs(y).max() < 0.8 and np.ptp(x) > 0.1


def test_the_command(
    repository: Path, tmp_path: Path, capsys: pytest.CaptureFixture,
) -> None:
    output = tmp_path / 'starts.md'
    words = ['starts', '--trials', '1', '--widths', '320', '--output', str(output)]
    assert main([*words, '--map', str(repository / 'config' / 'soccer_map.yaml'),
                 '--option', 'reach=9.0']) == 0
    printed = capsys.readouterr().out
    assert 'soccer_map |    17 | 320' in printed
    assert output.read_text(encoding='utf-8') in printed
    assert main(['starts', '--list']) == 0
    assert capsys.readouterr().out.split('\n')[:2] == ['arena', 'arena, faint tapes']
    for wrong, said in (
            (['nowhere'], 'no place is called like nowhere'), (['--widths', '642'], '642'),
            (['--option', 'reach=9.0'], '--map'),
            (['arena', '--map', 'config/soccer_map.yaml'], 'give one of both')):
        assert main(['starts', *wrong]) == 2
        assert said in capsys.readouterr().err


def test_a_wrong_pose_is_the_commands_result(monkeypatch: pytest.MonkeyPatch) -> None:
    answer = Estimate(0, State.TRACKING, '', FAR, np.diag((1e-4, 1e-4, 1e-4)))
    monkeypatch.setattr(Localiser, 'process', lambda *_: answer)
    assert main(['starts', 'faint', '--trials', '1', '--widths', '160']) == 1


def _given_on_the_lattice(
    seed: int, sigma: tuple[float, float, float],
) -> tuple[Pose2, list[Estimate]]:
    """A pose, and the answers to three images of it after it was told about."""
    place = next(place for place in PLACES if place.name == 'lattice')
    scene = arena_scene(1280)
    look = replace(scene.appearance, room=None, obstacles=())
    scene = replace(scene, line_map=place.line_map, appearance=look)
    localiser = Localiser(scene.rig, scene.line_map, place.options)
    rng = np.random.default_rng(seed)
    pose = Pose2(*(rng.uniform(-0.25, 0.25, 2) * 11.0), rng.uniform(-np.pi, np.pi))
    for k in range(-5, 16):
        localiser.add_odometry(k * 20_000_000, Pose2(0.0, 0.0, 0.0))
    given = pose @ Pose2(*(rng.normal(size=3) * [0.05, 0.05, 0.02]))
    localiser.set_prior(given, np.diag(sigma)**2)
    return pose, [
        localiser.process(k * 100_000_000, render(scene, pose, rng)) for k in range(3)]


@pytest.mark.parametrize('seed', [5, 9])
def test_a_vague_pose_decides_for_no_place_while_others_near_it_were_passed_over(
        seed: int) -> None:
    """On the lattice, given as by RViz: 0.5 m and 15 degrees allow several cells."""
    pose, answers = _given_on_the_lattice(seed, (0.5, 0.5, 0.262))
    for answer in answers:
        places = [answer.pose] if answer.pose is not None else [
            candidate.pose for candidate in answer.candidates]
        # One place is right or not given; of several one is.
        assert sum(same_pose(place, pose) for place in places) == 1


@pytest.mark.parametrize('seed', [3, 6, 27])
def test_a_pose_that_allows_one_place_only_decides_for_it(seed: int) -> None:
    """On the lattice too, where some of many hundreds of others explain the image a bit better."""
    pose, answers = _given_on_the_lattice(seed, (0.05, 0.05, 0.02))
    for answer in answers[1:]:
        assert answer.pose is not None
        assert same_pose(answer.pose, pose)
