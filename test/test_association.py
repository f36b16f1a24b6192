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

"""From strips on the floor to poses, and from blobs to strips."""

from __future__ import annotations

from dataclasses import replace
import itertools

from nccs_pose.estimation.association import Associator
from nccs_pose.estimation.floor_points import PixelFloor
from nccs_pose.estimation.floor_segments import floor_segments, FloorSegment
from nccs_pose.estimation.many_poses import Poses, same_pose
from nccs_pose.estimation.nearest_lines import NearestLines
from nccs_pose.estimation.options import LocaliserOptions
from nccs_pose.estimation.search import Searcher
from nccs_pose.estimation.strip_pairs import BEYOND, FloorLines
from nccs_pose.estimation.symmetries import map_symmetries
from nccs_pose.estimation.whole_lines import whole_lines
from nccs_pose.files.yaml_files import load_map
from nccs_pose.geometry.floor_scale import FloorScale
from nccs_pose.geometry.floor_table import as_points, FloorTable
from nccs_pose.geometry.lines import Line, LineMap
from nccs_pose.geometry.pose import Pose2, wrap_angle
from nccs_pose.simulation.large_maps import dashes, lattice
from nccs_pose.simulation.renderer import render
from nccs_pose.simulation.scene import arena_rig, arena_scene, ideal_scene, Obstacle
from nccs_pose.vision.segment import chromatic_mask, find_blobs
import numpy as np
import pytest

REACH = 5.0
RIG = arena_rig().scaled(0.5)
WIDTH = 0.05


@pytest.fixture(scope='module')
def table() -> FloorTable:
    return FloorTable(RIG, REACH)


def _line(start: tuple[float, float], end: tuple[float, float], colour: str = 'green') -> Line:
    return Line(np.array([*start, 0.0]), np.array([*end, 0.0]), width=WIDTH, colour=colour)


def _rectangle(length: float, width: float) -> LineMap:
    x, y = 0.5 * length, 0.5 * width
    corners = [(-x, -y), (x, -y), (x, y), (-x, y)]
    return LineMap(tuple(_line(a, b) for a, b in zip(corners, corners[1:] + corners[:1])))


def _strips(
    line_map: LineMap, pose: Pose2, rng: np.random.Generator, noise: float = 0.005,
) -> tuple[FloorSegment, ...]:
    """What an exact eye would lay on the floor of the map's lines, within reach (base_link)."""
    strips = []
    for line in line_map:
        share = np.linspace(0.0, 1.0, 200)
        points = pose.inverse().apply(
            line.start[:2] + share[:, None] * (line.end - line.start)[:2])
        pixels, visible = RIG.project(np.column_stack([points, np.zeros(200)]))
        foot = RIG.T_base_mirror.translation[:2]
        visible &= (np.linalg.norm(points - foot, axis=1) < REACH - 0.1)
        visible &= (pixels >= 0.0).all(axis=1)
        visible &= (pixels < [RIG.camera.width - 1, RIG.camera.height - 1]).all(axis=1)
        seen = np.flatnonzero(visible)
        if len(seen) < 2 or len(seen) != seen[-1] - seen[0] + 1:
            continue
        start, end = points[seen[0]], points[seen[-1]]
        if np.linalg.norm(end - start) < 0.3:
            continue
        start, end = start + noise * rng.standard_normal(2), end + noise * rng.standard_normal(2)
        along = (end - start) / np.linalg.norm(end - start)
        normal = np.array([-along[1], along[0]])
        length = float(np.linalg.norm(np.diff(pixels[seen], axis=0), axis=1).sum())
        far = float(np.median(np.linalg.norm(points[seen], axis=1)))
        strips.append(FloorSegment(
            normal, float(normal @ start), start, end, length, 0.004 * (1.0 + far**2),
            np.zeros((0, 2)), line.colour))
    return tuple(sorted(strips, key=lambda s: -s.weight))


def _random_map(rng: np.random.Generator, n: int) -> LineMap:
    """Lines of 0.8 to 4 m in all directions, spread so that some are always near."""
    half = 1.2 + 0.25 * n
    lines = []
    for _ in range(n):
        middle, angle = rng.uniform(-half, half, 2), rng.uniform(0.0, np.pi)
        along = 0.5 * rng.uniform(0.8, 4.0) * np.array([np.cos(angle), np.sin(angle)])
        lines.append(_line(tuple(middle - along), tuple(middle + along)))
    return LineMap(tuple(lines))


def _cross(strips: tuple[FloorSegment, ...]) -> bool:
    normals = np.array([s.normal for s in strips])
    sines = normals[:, 0, None] * normals[None, :, 1] - normals[:, 1, None] * normals[None, :, 0]
    return bool((np.abs(sines) > 0.2).any())


def _crosses() -> LineMap:
    """Forty-five crosses, all alike."""
    places = [(3.0 * i, 3.0 * j) for i in range(9) for j in range(5)]
    return LineMap(tuple(
        line for x, y in places
        for line in (_line((x - 1.1, y), (x + 0.7, y)), _line((x, y - 0.8), (x, y + 1.2)))))


def _near(a: Pose2, b: Pose2, metres: float = 0.06, radians: float = 0.04) -> bool:
    return (np.hypot(a.x - b.x, a.y - b.y) < metres
            and abs(float(wrap_angle(a.yaw - b.yaw))) < radians)


# ---------------------------------------------------------------- poses from strips


@pytest.mark.parametrize('n', [2, 3, 4, 6, 10, 20, 50])
def test_the_pose_is_among_the_candidates_on_any_map(n: int, table: FloorTable) -> None:
    rng = np.random.default_rng(100 + n)
    missed, tried, beaten = [], 0, 0
    while tried < 6:
        line_map = _random_map(rng, n)
        pose = Pose2(*rng.uniform(-0.8, 0.8, 2), rng.uniform(-np.pi, np.pi))
        strips = _strips(line_map, pose, rng)
        if len(strips) < 2 or not _cross(strips):
            continue
        tried += 1
        candidates = Associator(line_map, table).candidates(strips).fitted
        assert all(a.score >= b.score for a, b in itertools.pairwise(candidates))
        right = [c for c in candidates if _near(c.pose, pose)]
        if not right:
            missed.append((pose, len(strips)))
            continue
        # With three lines and their ends in view nothing else explains as much.
        beaten += len(strips) >= 4 and not _near(candidates[0].pose, pose)
    assert not missed
    assert beaten == 0


def test_every_pose_on_a_soccer_field_is_found(repository, table: FloorTable) -> None:
    field = load_map(repository / 'config' / 'soccer_map.yaml')
    symmetries = map_symmetries(field)
    assert len(symmetries) == 2
    rng = np.random.default_rng(8)
    tried = 0
    while tried < 12:
        pose = Pose2(rng.uniform(-9, 9), rng.uniform(-6, 6), rng.uniform(-np.pi, np.pi))
        strips = _strips(field, pose, rng)
        # Nearer the goals than the centre, where the boxes tell places apart.
        if len(strips) < 5 or not _cross(strips):
            continue
        tried += 1
        candidates = Associator(field, table).candidates(strips).fitted
        best = candidates[0].score
        equal = [c.pose for c in candidates if c.score > best - 0.05]
        assert any(_near(s @ pose, other) for s in symmetries for other in equal)
        explains, _ = Associator(field, table).score(pose, strips)
        assert explains > best - 0.05


@pytest.mark.parametrize(('length', 'width', 'count'), [(4.0, 4.0, 4), (4.0, 3.0, 2)])
def test_a_symmetric_map_gives_all_its_equal_poses(
        length: float, width: float, count: int, table: FloorTable) -> None:
    line_map = _rectangle(length, width)
    rng = np.random.default_rng(9)
    for _ in range(5):
        pose = Pose2(*rng.uniform(-0.9, 0.9, 2), rng.uniform(-np.pi, np.pi))
        strips = _strips(line_map, pose, rng, 0.002)
        candidates = Associator(line_map, table).candidates(strips).fitted
        best = candidates[0].score
        assert best > 0.9
        equal = [c.pose for c in candidates if c.score > 0.9 * best]
        turns = [Pose2(0.0, 0.0, 2.0 * np.pi * k / count) @ pose for k in range(count)]
        assert len(equal) == count
        assert all(any(_near(turn, other) for other in equal) for turn in turns)


def test_one_strip_and_parallel_strips_give_no_pose(table: FloorTable) -> None:
    line_map = LineMap((_line((-2, 1), (2, 1)), _line((-2, -1), (2, -1)), _line((2, -1), (2, 1))))
    rng = np.random.default_rng(10)
    strips = _strips(line_map, Pose2(0.3, 0.1, 0.4), rng)
    angles = np.array([np.arctan2(s.normal[1], s.normal[0]) for s in strips])
    parallel = tuple(
        s for s, a in zip(strips, angles) if abs(np.sin(a - angles[0])) < 0.1)
    assert len(parallel) == 2
    assert Associator(line_map, table).candidates(parallel).fitted == ()
    assert Associator(line_map, table).candidates(strips[:1]).fitted == ()
    assert Associator(line_map, table).candidates(()).fitted == ()
    assert Associator(line_map, table).score(Pose2(0.0, 0.0, 0.0), ()) == (0.0, 0.0)


def test_strips_that_are_no_lines_do_not_hide_the_pose(table: FloorTable) -> None:
    line_map = _random_map(np.random.default_rng(11), 6)
    rng = np.random.default_rng(12)
    pose = Pose2(0.2, -0.3, 1.0)
    strips = _strips(line_map, pose, rng)
    assert len(strips) >= 4
    false = []
    for _ in range(4):
        start, angle = rng.uniform(-2, 2, 2), rng.uniform(0, np.pi)
        along = np.array([np.cos(angle), np.sin(angle)])
        normal = np.array([-along[1], along[0]])
        false.append(FloorSegment(
            normal, float(normal @ start), start, start + 0.6 * along, 40.0, 0.01,
            np.zeros((0, 2))))
    mixed = tuple(sorted((*strips, *false), key=lambda s: -s.weight))
    candidates = Associator(line_map, table).candidates(mixed).fitted
    assert _near(candidates[0].pose, pose)
    assert candidates[0].score < Associator(line_map, table).candidates(strips).fitted[0].score


def test_colours_tell_equal_lines_apart(table: FloorTable) -> None:
    square = _rectangle(4.0, 4.0)
    coloured = LineMap((replace(square[0], colour='yellow'), *square[1:]))
    pose, rng = Pose2(0.4, -0.2, 2.0), np.random.default_rng(13)
    candidates = Associator(coloured, table).candidates(_strips(coloured, pose, rng, 0.002)).fitted
    assert _near(candidates[0].pose, pose)
    assert len(candidates) == 1 or candidates[1].score < 0.85 * candidates[0].score


def test_the_true_pose_scores_best_and_a_wrong_one_little(table: FloorTable) -> None:
    line_map = _random_map(np.random.default_rng(14), 6)
    pose = Pose2(0.1, 0.2, -0.7)
    strips = _strips(line_map, pose, np.random.default_rng(15))
    there, claimed = Associator(line_map, table).score(pose, strips)
    assert there > 0.9
    assert claimed == pytest.approx(1.0)
    for step in (Pose2(0.5, 0.0, 0.0), Pose2(0.0, -0.6, 0.0), Pose2(0.0, 0.0, 0.5)):
        score, part = Associator(line_map, table).score(pose @ step, strips)
        assert score < there - 0.3
        assert part < claimed


def test_all_of_many_equal_places_are_told(table: FloorTable) -> None:
    line_map = _crosses()
    pose = Pose2(12.3, 6.4, 0.7)
    strips = _strips(line_map, pose, np.random.default_rng(25))
    candidates = Associator(line_map, table).candidates(strips).fitted
    assert all(a.score >= b.score for a, b in itertools.pairwise(candidates))
    # Wherever all that is in view is there as well.
    inner = [Pose2(pose.x + 3.0 * i, pose.y + 3.0 * j, pose.yaw)
             for i in range(-3, 4) for j in range(-1, 2)]
    for place in inner:
        told = [c for c in candidates if _near(c.pose, place, 0.25, 0.1)]
        assert len(told) == 1 and told[0].score > 0.8 * candidates[0].score
    assert len(candidates) <= 300


def test_equal_places_are_told_alike_however_the_strips_lie(table: FloorTable) -> None:
    line_map = _crosses()
    pose = Pose2(11.0, 5.0, 2.0)
    strips = _strips(line_map, pose, np.random.default_rng(25), noise=0.06)
    candidates = Associator(line_map, table).candidates(strips).fitted
    places = [Pose2(pose.x + 3.0 * i, pose.y + 3.0 * j, pose.yaw)
              for i in range(-3, 4) for j in range(-1, 2)]
    told = np.array([
        min((c.pose.minus(place) for c in candidates), key=lambda off: float(off @ off))
        for place in places])
    assert (np.abs(told - np.median(told, axis=0)) < [0.01, 0.01, 0.005]).all()


def test_where_a_map_nearly_looks_like_itself_a_pose_is_one_that_another_may_be_taken_for(
    table: FloorTable,
) -> None:
    line_map = LineMap((
        _line((-1.75, -1.30), (1.45, -1.42)), _line((1.92, -1.05), (1.78, 1.10)),
        _line((1.20, 1.36), (-1.05, 1.22)), _line((-1.80, 0.95), (-1.93, -0.85))))
    # Most of south and of north, and two pieces of east, bent by blocks of JPEG by 29 and 9 deg.
    pose, strips = Pose2(0.325, -0.014, 2.116), []
    for weight, footprint, ends in (
            (692.0, 0.066, [[-1.5, 0.19], [-0.2, 2.25]]),
            (688.0, 0.056, [[0.71, -1.52], [1.72, 0.48]]),
            (148.0, 0.072, [[-1.04, -1.01], [-0.73, -1.49]]),
            (120.0, 0.092, [[-1.26, -1.0], [-0.26, -1.75]])):
        start, end = np.array(ends)
        along = (end - start) / np.linalg.norm(end - start)
        normal = np.array([-along[1], along[0]])
        strips.append(FloorSegment(
            normal, float(normal @ start), start, end, weight, footprint, np.zeros((0, 2)),
            pitch=2))
    # They lead half a turn away only.
    associator = Associator(line_map, table)
    best = associator.candidates(tuple(strips)).fitted[0].pose
    assert abs(wrap_angle(best.yaw - pose.yaw)) > 3.0
    off = np.abs([c.pose.minus(pose) for c in associator.taken_for(best, tuple(strips))])
    assert (off < [0.1, 0.1, 0.05]).all(axis=1).any()


def test_where_many_hundreds_of_places_are_equal_all_are_told(table: FloorTable) -> None:
    places = np.arange(21.0)
    line_map = LineMap((*(_line((0.0, y), (20.0, y)) for y in places),
                        *(_line((x, 0.0), (x, 20.0)) for x in places)))
    pose = Pose2(10.3, 9.6, 0.7)
    candidates, others = Associator(line_map, table).candidates(
        _strips(line_map, pose, np.random.default_rng(26)))
    assert len(candidates) <= 300
    told = [*(c.pose for c in candidates), *others.listed()]
    for i, j, turns in itertools.product(range(-4, 5), range(-4, 5), range(4)):
        turn = Pose2(10.0, 10.0, turns * np.pi / 2.0) @ Pose2(-10.0, -10.0, 0.0)
        place = Pose2(float(i), float(j), 0.0) @ turn @ pose
        assert any(_near(other, place, 0.25, 0.1) for other in told)


def test_what_thousands_of_poses_explain_is_what_each_does(table: FloorTable) -> None:
    rng = np.random.default_rng(3)
    lines = _random_map(rng, 12)
    strips = _strips(lines, Pose2(0.2, -0.1, 0.4), rng)
    scorer = Associator(lines, table)._scorer(strips)
    poses = Poses.of([Pose2(*rng.uniform(-2.0, 2.0, 3)) for _ in range(700)])
    alone = [float(scorer.claimed(poses[[k]])[0]) for k in range(700)]
    assert scorer.claimed(poses) == pytest.approx(np.array(alone), abs=1e-12)
    assert len(scorer.claimed(poses[[]])) == 0


def test_one_strip_across_many_heavier_ones_is_enough(table: FloorTable) -> None:
    spacing = np.cumsum([0.0, 0.3, 0.35, 0.25, 0.4, 0.3, 0.45, 0.3, 0.5])
    line_map = LineMap((
        *(_line((-1.5, -1.2 + y), (1.5, -1.2 + y)) for y in spacing.tolist()),
        _line((1.7, -0.4), (1.75, 0.1))))
    pose = Pose2(0.1, -0.2, 0.4)
    strips = _strips(line_map, pose, np.random.default_rng(26))
    assert not _cross(strips[:6]) and _cross(strips)
    assert _near(Associator(line_map, table).candidates(strips).fitted[0].pose, pose)


def test_a_short_coarse_strip_may_point_elsewhere(table: FloorTable) -> None:
    corners = [(-1.6, -1.2), (1.4, -1.5), (1.6, 1.1), (-1.5, 0.9)]
    line_map = LineMap(tuple(_line(a, b) for a, b in zip(corners, corners[1:] + corners[:1])))
    pose = Pose2(0.3, 0.1, -2.8)
    long, other, *_ = _strips(line_map, pose, np.random.default_rng(28), 0.002)

    def turned(angle: float, footprint: float) -> FloorSegment:
        """A metre of the second strip, seen askew by its pixels."""
        along = (other.end - other.start) / np.linalg.norm(other.end - other.start)
        middle, turn = 0.5 * (other.start + other.end), np.exp(1j * angle)
        c, s = turn.real, turn.imag
        along = np.array([c * along[0] - s * along[1], s * along[0] + c * along[1]])
        normal = np.array([-along[1], along[0]])
        return replace(
            other, normal=normal, offset=float(normal @ middle), start=middle - 0.5 * along,
            end=middle + 0.5 * along, footprint=footprint)

    def is_found(strip: FloorSegment) -> bool:
        candidates = Associator(line_map, table).candidates((long, strip)).fitted
        return any(_near(c.pose, pose, 0.2, 0.1) for c in candidates)

    assert abs(float(long.normal @ other.normal)) < 0.3
    for angle in (-0.17, 0.17):
        assert is_found(turned(angle, 0.065))
        # Of fine pixels it is another line.
        assert not is_found(turned(angle, 0.01))


def test_the_misfit_is_the_distance_of_the_strips_in_pixels(table: FloorTable) -> None:
    line_map = LineMap((
        _line((-2.0, 1.0), (1.0, 1.0)), _line((1.5, -2.0), (1.5, 0.5)),
        _line((-1.0, -1.3), (0.8, -1.2))))
    pose = Pose2(0.2, -0.1, 0.8)
    strips = _strips(line_map, pose, np.random.default_rng(16), noise=0.02)
    assert len(strips) == 3
    # Pixels of strips that are each two of the image wide.
    strips = tuple(replace(strip, pitch=2) for strip in strips)
    best = Associator(line_map, table).candidates(strips).fitted[0]
    square, weight = 0.0, 0.0
    for strip in strips:
        share = (np.arange(12) + 0.5)[:, None] / 12
        points = best.pose.apply(strip.start + share * (strip.end - strip.start))
        offset = min((
            np.abs((points - line.start[:2]) @ [-line.direction[1], line.direction[0]])
            for line in line_map), key=np.mean)
        square += strip.weight * np.mean((2.0 * offset / strip.footprint) ** 2)
        weight += strip.weight
    assert best.misfit > 0.1
    assert best.misfit == pytest.approx(np.sqrt(square / weight), rel=1e-6)
    exact = _strips(line_map, pose, np.random.default_rng(16), noise=0.0)
    assert Associator(line_map, table).candidates(exact).fitted[0].misfit < 1e-3


def test_the_nearest_line_is_that_of_an_exhaustive_search() -> None:
    rng = np.random.default_rng(17)
    line_map = LineMap(tuple(
        replace(line, colour=('green', 'red')[k % 3 == 0])
        for k, line in enumerate(_random_map(rng, 12))))
    lines = FloorLines(line_map)
    nearest = NearestLines(lines)
    points = rng.uniform(-7.0, 7.0, 4000) + 1j * rng.uniform(-7.0, 7.0, 4000)
    for colour in ('green', 'red'):
        which, across = nearest.at(points[None], np.repeat(nearest.layers((colour,)), len(points)))
        # How far the exhaustive search takes a line to go on, less or more than it does.
        distances = []
        for beyond in (0.15, 0.25):
            off = (points[:, None] - lines.start) * lines.direction.conj()
            beside = (off.real > -beyond) & (off.real < lines.length + beyond)
            beside &= np.array(lines.colour) == colour
            distances.append(np.where(beside, np.abs(off.imag), np.inf).min(axis=1))
        known = (distances[0] == distances[1]) & (distances[0] < 0.95)
        assert known.sum() > 250
        np.testing.assert_allclose(np.abs(across[0, known]), distances[0][known], atol=1e-12)
        assert (np.array(lines.colour)[which[0, known]] == colour).all()
        assert (np.abs(across[0, distances[1] > 1.1]) > 1e6).all()
        assert (which[0, distances[1] > 1.1] == len(line_map)).all()


def test_steps_on_the_floor_are_as_long_in_the_image_as_they_are_seen(table: FloorTable) -> None:
    rng = np.random.default_rng(18)
    radius, angle = rng.uniform(0.6, REACH - 0.1, 2000), rng.uniform(-np.pi, np.pi, 2000)
    scale = FloorScale(table)
    points = scale.foot + radius * np.exp(1j * angle)
    step = 0.02 * np.exp(1j * rng.uniform(-np.pi, np.pi, 2000))
    ends = [table.pixels(as_points(points + way * step)) for way in (-0.5, 0.5)]
    exact = np.linalg.norm(ends[1] - ends[0], axis=1)
    seen = table.sees_floor(0.5 * (ends[0] + ends[1]))
    told = scale.pixels(points, step)
    both = seen & (told > 0.0)
    # The cells at the border of what is seen may be in or out.
    assert np.count_nonzero(seen != (told > 0.0)) < 0.05 * len(points)
    assert np.median(np.abs(told[both] / exact[both] - 1.0)) < 0.05
    assert np.abs(told[both] / exact[both] - 1.0).max() < 0.3


# ---------------------------------------------------------------- symmetries of maps


def _looks_the_same(line_map: LineMap, motion: Pose2, tolerance: float) -> bool:
    """Brute force: points along every moved tape lie on tapes of the same colour."""
    for line in line_map:
        points = motion.apply(line.start[:2] + np.linspace(0, 1, 50)[:, None] * (
            line.end - line.start)[:2])
        distance = np.full(50, np.inf)
        for other in line_map:
            if other.colour != line.colour:
                continue
            along = np.clip((points - other.start[:2]) @ other.direction[:2], 0.0, other.length)
            foot = other.start[:2] + along[:, None] * other.direction[:2]
            distance = np.minimum(distance, np.linalg.norm(points - foot, axis=1))
        if distance.max() > tolerance:
            return False
    return True


@pytest.mark.parametrize(('line_map', 'count'), [
    (_rectangle(4.0, 4.0), 4), (_rectangle(4.0, 3.0), 2), (_rectangle(4.0, 3.9), 2),
    (LineMap((*_rectangle(4.0, 4.0), _line((0.0, 0.5), (1.0, 0.5)))), 1),
    (LineMap((_line((0, 0), (2, 0)), _line((0, 0), (0, 3)))), 1),
    (LineMap((_line((-1, 0), (1, 0)), _line((0, -1), (0, 1)))), 4),
    (LineMap((_line((-1, 0), (1, 0)), _line((0, -1), (0, 1), 'red'))), 2),
    (LineMap(tuple(_line((np.cos(a), np.sin(a)), (2 * np.cos(a), 2 * np.sin(a)))
                   for a in np.arange(6) * np.pi / 3)), 6)])
def test_symmetries_are_recognised_from_the_map(line_map: LineMap, count: int) -> None:
    away = Pose2(3.0, -7.0, 0.4)
    for moved in (line_map, LineMap(tuple(line.transformed(away) for line in line_map))):
        motions = map_symmetries(moved)
        assert len(motions) == count
        assert _near(motions[0], Pose2(0.0, 0.0, 0.0), 1e-9, 1e-9)
        assert all(_looks_the_same(moved, motion, 0.01) for motion in motions)
        # They are a group: one after the other is one of them again.
        for a in motions:
            for b in motions:
                assert any(_near(a @ b, c, 1e-6, 1e-6) for c in motions)


def test_random_maps_and_the_arena_have_no_symmetry() -> None:
    assert len(map_symmetries(ideal_scene().line_map)) == 1
    for seed in range(20):
        assert len(map_symmetries(_random_map(np.random.default_rng(seed), 5))) == 1


# ---------------------------------------------------------------- lines drawn in pieces


def test_a_map_without_pieces_is_left_as_it_is() -> None:
    # Side by side, at an angle, of another colour, apart, and in line at a crossing.
    others = LineMap((
        _line((0.0, 0.0), (2.0, 0.0)), _line((2.0, 0.03), (4.0, 0.03)),
        _line((-1.0, 0.03), (0.0, 0.0)), _line((-2.0, 0.0), (0.0, 0.0), 'red'),
        _line((2.2, 0.0), (3.0, 0.0)), _line((2.0, 0.0), (2.0, 1.0))))
    for line_map in (others, arena_scene(640).line_map, dashes(), lattice(), _rectangle(4.0, 3.0)):
        assert whole_lines(line_map) is line_map


@pytest.mark.parametrize('gap', [-0.1, 0.0, 0.05, 0.11])
@pytest.mark.parametrize('turn', [0.0, 2.1, -0.7])
def test_a_line_in_pieces_is_one_line(gap: float, turn: float) -> None:
    ends = [(0.0, 0.7), (0.7 + gap, 0.9 + gap), (4.0, 0.9 + 2.0 * gap)]
    pieces = [
        _line((0.0, 0.003), (0.7, 0.0)), _line(*((x, -0.002) for x in ends[1])),
        _line(*((x, 0.001) for x in ends[2])), _line((1.0, 0.0), (1.0, 2.0))]
    whole = whole_lines(LineMap(tuple(
        line.transformed(Pose2(1.0, 2.0, turn)) for line in pieces)))
    assert len(whole) == 2
    back = Pose2(1.0, 2.0, turn).inverse()
    corners = sorted(back.apply(end[:2]).round(9).tolist() for end in (
        whole[0].start, whole[0].end))
    assert corners == [[0.0, 0.003], [4.0, 0.001]]
    assert (whole[1].start == pieces[3].transformed(Pose2(1.0, 2.0, turn)).start).all()


def test_no_line_is_made_of_pieces_of_a_curve() -> None:
    angle = np.linspace(0.0, np.pi, 61)
    corners = 3.0 * np.column_stack([np.cos(angle), np.sin(angle)])
    curve = LineMap(tuple(_line(a, b) for a, b in zip(corners.tolist(), corners[1:].tolist())))
    whole = whole_lines(curve)
    # A chord of what is left is never farther from the arc than its pieces may be.
    assert whole.lengths.max() < 2.0 * np.sqrt(2.0 * 3.0 * 0.2 * WIDTH) + 1e-6
    assert len(whole) > 15


def _pieces(line_map: LineMap, *counts: int, gap: float = 0.0) -> LineMap:
    """A map with its lines cut in so many pieces each, in turn."""
    parts = []
    for line, n in zip(line_map, itertools.cycle(counts)):
        step, half = (line.end - line.start) / n, 0.5 * gap * line.direction
        parts.extend(replace(
            line, start=line.start + k * step + (k > 0) * half,
            end=line.start + (k + 1) * step - (k + 1 < n) * half) for k in range(n))
    return LineMap(tuple(parts))


def test_pieces_hide_no_symmetry() -> None:
    rectangle, square = _rectangle(4.0, 3.0), _rectangle(4.0, 4.0)
    assert len(map_symmetries(_pieces(rectangle, 2, 1, 1, 1))) == 2
    assert len(map_symmetries(_pieces(square, 3, 1, 2, 1, gap=0.05))) == 4
    # A gap that images show does.
    assert len(map_symmetries(_pieces(rectangle, 2, 1, 1, 1, gap=0.5))) == 1


@pytest.mark.parametrize('gap', [0.0, 0.05, 0.3, 0.6])
def test_strips_that_run_over_joints_and_gaps_give_the_pose(gap: float, table: FloorTable) -> None:
    box = _rectangle(3.8, 2.8)
    # Because one side is whole no strip is too long to be one line.
    line_map = _pieces(box, 1, 2, 2, 2, gap=gap)
    searcher = Searcher(table, line_map, LocaliserOptions())
    rng = np.random.default_rng(12)
    for _ in range(8):
        pose = Pose2(*rng.uniform(-0.7, 0.7, 2), rng.uniform(-np.pi, np.pi))
        fitted = searcher.candidates(_strips(box, pose, rng)).fitted
        assert any(_near(c.pose, pose) and c.score > 0.8 for c in fitted)


# ---------------------------------------------------------------- strips from blobs


def _segments(
    line_map: LineMap, pose: Pose2, table: FloorTable, patches: tuple[Line, ...] = (),
    obstacles: tuple[Obstacle, ...] = (), hide: slice | None = None,
) -> tuple[FloorSegment, ...]:
    """Strips in a rendered image."""
    scene = ideal_scene(640, noise=0.01)
    look = replace(scene.appearance, patches=patches, obstacles=obstacles)
    scene = replace(scene, line_map=line_map, appearance=look)
    image = render(scene, pose, np.random.default_rng(0))
    if hide is not None:
        image[:, hide] = 205
    mask = chromatic_mask(image, 'green', 4.5, 0.05, 31)
    v, u = np.indices(mask.shape).reshape(2, -1)
    return floor_segments(
        find_blobs(mask & table.region, 400),
        PixelFloor(np.column_stack([u, v]), 1, table), WIDTH, 'green',
        longest=max(line.length for line in line_map))


def _lies_on(strip: FloorSegment, line: Line, pose: Pose2) -> float:
    """Largest distance of the strip's ends from a line, metres."""
    ends = pose.apply(np.array([strip.start, strip.end])) - line.start[:2]
    return float(np.abs(
        line.direction[0] * ends[:, 1] - line.direction[1] * ends[:, 0]).max())


CROSS = LineMap((_line((-1.0, 0.9), (1.2, 1.1)), _line((0.2, 0.2), (0.1, 1.5))))
HERE = Pose2(0.1, 0.0, 0.2)


def test_one_blob_over_two_crossing_tapes_is_split(table: FloorTable) -> None:
    strips = _segments(CROSS, HERE, table)
    assert len(strips) == 2
    for line in CROSS:
        on = [s for s in strips if _lies_on(s, line, HERE) < 0.04]
        assert len(on) == 1
        assert np.linalg.norm(on[0].end - on[0].start) == pytest.approx(line.length, abs=0.12)


def test_which_part_of_the_colour_lies_on_lines_at_a_pose(table: FloorTable) -> None:
    """Against the pixels that each of two tapes has when it lies there alone."""
    def masks(line_map: LineMap) -> dict[str, np.ndarray]:
        image = render(replace(ideal_scene(640, noise=0.01), line_map=line_map), HERE,
                       np.random.default_rng(0))
        return both.masks(image)

    apart = LineMap((_line((-1.0, 0.9), (1.2, 1.1)), _line((0.4, -0.3), (0.1, -1.5))))
    both, one = (Searcher(table, m, LocaliserOptions()) for m in (apart, LineMap(apart[:1])))
    counts = [np.count_nonzero(masks(LineMap((line,)))['green']) for line in apart]
    seen = masks(apart)
    assert both.on_lines(HERE, seen) > 0.98
    assert one.on_lines(HERE, seen) == pytest.approx(counts[0] / sum(counts), abs=0.02)
    assert 0.3 < counts[0] / sum(counts) < 0.7
    assert both.on_lines(HERE @ Pose2(0.1, 0.1, 0.3), seen) < 0.2
    assert both.on_lines(HERE, {'green': np.zeros_like(seen['green'])}) == 1.0


def test_touching_tapes_are_split(table: FloorTable) -> None:
    corner = LineMap((_line((-1.0, 1.0), (1.0, 1.0)), _line((1.0, 1.0), (1.0, -0.8))))
    strips = _segments(corner, HERE, table)
    assert len(strips) == 2
    for line in corner:
        assert sum(_lies_on(s, line, HERE) < 0.05 for s in strips) == 1


def test_a_blob_over_a_whole_court_is_split_into_its_lines(table: FloorTable) -> None:
    """A rectangle is a single blob, and so is the line across its middle."""
    court = LineMap((*_rectangle(3.0, 2.2), _line((0.0, -1.1), (0.0, 1.1))))
    rng = np.random.default_rng(4)
    found, others = 0, 0
    for _ in range(10):
        pose = Pose2(*rng.uniform(-0.7, 0.7, 2), rng.uniform(-np.pi, np.pi))
        strips = _segments(court, pose, table)
        on = [sum(_lies_on(s, line, pose) < 0.12 for s in strips) for line in court]
        found += sum(n > 0 for n in on)
        others += len(strips) - sum(on)
    assert found >= 47
    assert others <= 5


@pytest.mark.parametrize('n', [4, 6])
def test_a_blob_over_tapes_that_all_cross_is_split_into_them(n: int, table: FloorTable) -> None:
    rng = np.random.default_rng(3)
    found, others = 0, 0
    for _ in range(6):
        angles = (np.arange(n) + rng.uniform(-0.25, 0.25, n)) * np.pi / n
        along = np.column_stack([np.cos(angles), np.sin(angles)])
        middle = np.array([0.0, 1.1]) + 0.2 * rng.uniform(-1.0, 1.0, (n, 2))
        tapes = LineMap(tuple(
            _line(tuple(m - 0.8 * d), tuple(m + 0.8 * d)) for m, d in zip(middle, along)))
        strips = _segments(tapes, HERE, table)
        on = [sum(_lies_on(s, line, HERE) < 0.08 for s in strips) for line in tapes]
        found += sum(k > 0 for k in on)
        others += len(strips) - sum(on)
    assert found >= 6 * n - 4
    assert others <= 1


def test_a_tape_cut_in_pieces_is_joined(table: FloorTable) -> None:
    whole = LineMap((_line((-1.2, 0.9), (1.2, 0.9)), _line((-1.2, -3.9), (1.2, -3.9))))
    pixels, _ = RIG.project(np.array([[*HERE.inverse().apply(np.array([0.0, 0.9])), 0.0]]))
    middle = int(pixels[0, 0])
    strips = _segments(whole, HERE, table, hide=slice(middle - 8, middle + 8))
    on = [s for s in strips if _lies_on(s, whole[0], HERE) < 0.04]
    assert len(on) == 1
    assert np.linalg.norm(on[0].end - on[0].start) == pytest.approx(2.4, abs=0.12)


def test_tapes_in_a_row_are_not_taken_for_one(table: FloorTable) -> None:
    row = LineMap(tuple(_line((x, 0.9), (x + 0.8, 0.9)) for x in (-1.4, -0.4, 0.6)))
    strips = _segments(row, HERE, table)
    assert len(strips) == 3
    ends = sorted(sorted(HERE.apply(np.array([s.start, s.end]))[:, 0]) for s in strips)
    np.testing.assert_allclose(ends, [[-1.4, -0.6], [-0.4, 0.4], [0.6, 1.4]], atol=0.06)


def _sheet(x: float, y: float, width: float, length: float, angle: float = 0.3) -> Line:
    along = 0.5 * length * np.array([np.cos(angle), np.sin(angle), 0.0])
    middle = np.array([x, y, 0.0])
    return Line(middle - along, middle + along, width=width, colour='green')


@pytest.mark.parametrize('sheet', [
    _sheet(0.8, 0.5, 0.4, 0.4), _sheet(-0.7, 0.9, 0.25, 0.5), _sheet(0.9, -0.9, 0.6, 0.8)])
def test_sheets_on_the_floor_are_no_lines(sheet: Line, table: FloorTable) -> None:
    assert _segments(CROSS, Pose2(30.0, 0.0, 0.0), table) == ()
    # The tapes are far away: all that is green in view is the sheet.
    at = Pose2(30.0, 0.0, 0.0)
    assert _segments(CROSS, at, table, patches=(sheet.transformed(at),)) == ()


@pytest.mark.parametrize(('x', 'y', 'radius', 'top'), [
    (1.0, 0.3, 0.2, 0.6), (-0.9, 0.8, 0.25, 0.9), (0.2, -1.4, 0.15, 0.5)])
def test_solids_are_no_lines(
        x: float, y: float, radius: float, top: float, table: FloorTable) -> None:
    at = Pose2(30.0, 0.0, 0.0)
    green = (0.20, 0.72, 0.20)
    bin_ = Obstacle(30.0 + x, y, radius, top, colour=green)
    assert _segments(CROSS, at, table, obstacles=(bin_,)) == ()


def test_tapes_are_found_among_sheets_and_solids(table: FloorTable) -> None:
    green = (0.20, 0.72, 0.20)
    strips = _segments(
        CROSS, HERE, table, patches=(_sheet(1.0, -0.6, 0.4, 0.5),),
        obstacles=(Obstacle(-1.2, -0.5, 0.2, 0.6, colour=green),))
    for line in CROSS:
        assert sum(_lies_on(s, line, HERE) < 0.05 for s in strips) == 1
    assert len(strips) == 2


def test_same_pose_is_close_in_place_and_heading() -> None:
    a = Pose2(1.0, 2.0, np.pi - 0.02)
    assert same_pose(a, Pose2(1.1, 2.1, -np.pi + 0.02))
    assert not same_pose(a, Pose2(1.0, 2.0, np.pi - 0.3))
    assert not same_pose(a, Pose2(1.3, 2.0, np.pi - 0.02))


def test_points_of_two_lines_are_as_far_apart_as_is_told() -> None:
    rng = np.random.default_rng(4)
    ends = rng.uniform(-3.0, 3.0, (12, 2, 2))
    lines = FloorLines(LineMap(tuple(_line(tuple(a), tuple(b)) for a, b in ends)))
    first, second, _ = lines.crossings
    near, far = lines.gaps
    share = np.linspace(0.0, 1.0, 200)
    at = lines.start[:, None] + lines.direction[:, None] * (
        share * (lines.length[:, None] + 2.0 * BEYOND) - BEYOND)
    apart = np.abs(at[first, :, None] - at[second, None])
    np.testing.assert_allclose(apart.max(axis=(1, 2)), far)
    nearest = apart.min(axis=(1, 2))
    assert (nearest > near - 1e-9).all() and (nearest < near + 0.05).all()
