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

"""The renderer against exact rays, areas and projections; the sensor against statistics."""

from __future__ import annotations

import dataclasses

from hypothesis import given
from hypothesis import strategies as st
from nccs_pose.errors import SimulationError
from nccs_pose.files.yaml_files import load_map, load_rig
from nccs_pose.geometry.lines import Line, LineMap
from nccs_pose.geometry.pose import Pose2
from nccs_pose.simulation.floor_view import floor_points, floor_view
from nccs_pose.simulation.motion import Twist
from nccs_pose.simulation.renderer import expected_image, render
from nccs_pose.simulation.scene import (
    Appearance,
    arena_map,
    arena_rig,
    arena_scene,
    FloorTexture,
    ideal_scene,
    Obstacle,
    RobotBody,
    Room,
    Scene,
)
from nccs_pose.simulation.sensors import compress, expose, irradiate, SensorModel
from nccs_pose.simulation.tape_coverage import half_plane_area, tape_coverage
from nccs_pose.simulation.textures import wall_colours
import numpy as np
import pytest

POSE = Pose2(0.3, -0.2, 0.7)
RED = (0.0, 0.0, 1.0)


def clip_to_half_plane(polygon: list[np.ndarray], gradient: np.ndarray, value: float) -> list:
    """Sutherland and Hodgman: the part of a polygon where value + gradient . p > 0."""
    kept = []
    for p, q in zip(polygon, polygon[1:] + polygon[:1]):
        at_p, at_q = value + gradient @ p, value + gradient @ q
        if at_p >= 0.0:
            kept.append(p)
        if at_p * at_q < 0.0:
            kept.append(p + at_p / (at_p - at_q) * (q - p))
    return kept


def area_and_centroid(polygon: np.ndarray) -> tuple[float, np.ndarray]:
    """Shoelace formulas for corners (N, 2), taken about the first for precision."""
    p = polygon - polygon[0]
    q = np.roll(p, -1, axis=0)
    cross = p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]
    area = 0.5 * cross.sum()
    return abs(area), polygon[0] + (cross @ (p + q)) / (6.0 * area)


def outline(rig, tape: Line, count: int = 400) -> np.ndarray:
    """The image of a tape's border, closed, pixels (N, 2); all of it must be visible."""
    left = 0.5 * tape.width * np.array([-tape.direction[1], tape.direction[0], 0.0])
    corners = [tape.start - left, tape.end - left, tape.end + left, tape.start + left]
    share = np.linspace(0.0, 1.0, count, endpoint=False)[:, None]
    sides = [a + share * (b - a) for a, b in zip(corners, corners[1:] + corners[:1])]
    pixels, visible = rig.project(np.concatenate(sides))
    assert visible.all()
    return pixels


def moments(view, tape: Line) -> tuple[float, np.ndarray, float]:
    """Sum and centroid of the rendered coverage, in pixels, and how well pixels can tell it.

    An edge pixel counts at its centre what lies at one of its sides: an error of about 0.1 px
    times its share, of either sign.
    """
    index, coverage = tape_coverage(view, tape)
    pixel = view.pixel[index]
    uv = np.stack([pixel % view.width, pixel // view.width], axis=1)
    total = coverage.sum()
    edges = np.count_nonzero((coverage > 0.0) & (coverage < 1.0))
    return total, coverage @ uv / total, 0.1 * np.sqrt(edges) / total


def bilinear(image: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """The grey levels (N, 3) at pixels (N, 2), nearest pixel."""
    u, v = np.rint(pixels).astype(int).T
    return image[v, u]


@given(st.floats(-1.5, 1.5), st.floats(-1.5, 1.5), st.floats(-1.5, 1.5))
def test_half_plane_area_is_that_of_the_clipped_square(value, across, down):
    square = [np.array(p) for p in ((-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5))]
    gradient = np.array([across, down])
    if np.abs(gradient).max() < 1e-6:
        return
    clipped = clip_to_half_plane(square, gradient, value)
    area = area_and_centroid(np.array(clipped))[0] if len(clipped) > 2 else 0.0
    computed = half_plane_area(np.array(value), np.array(across), np.array(down))
    assert computed == pytest.approx(area, abs=1e-6)


def test_floor_points_agree_with_back_projection_and_projection():
    rig = arena_rig()
    rng = np.random.default_rng(1)
    pixels = rng.uniform([0, 0], [1279, 959], (2000, 2))
    points, seen = floor_points(rig, pixels)
    expected, reaches = rig.back_project(pixels).floor_points()
    assert seen.sum() > 500
    assert not (seen & ~reaches).any()
    np.testing.assert_allclose(points[seen], expected[seen], atol=1e-9)
    close = seen & (np.linalg.norm(points, axis=1) < 6.0)
    back, visible = rig.project(np.c_[points[close], np.zeros(close.sum())])
    assert visible.all()
    np.testing.assert_allclose(back, pixels[close], atol=1e-6)


def test_coverage_of_edge_pixels_against_many_exact_rays():
    rig, rng, side = arena_rig(), np.random.default_rng(0), 96
    view, errors = floor_view(rig), []
    for line in arena_map():
        tape = line.transformed(POSE.inverse())
        left = np.array([-tape.direction[1], tape.direction[0]])
        index, coverage = tape_coverage(view, tape)
        chosen = rng.choice(np.flatnonzero((coverage > 0.0) & (coverage < 1.0)), 30, False)
        for pixel, share in zip(view.pixel[index[chosen]], coverage[chosen]):
            # One ray at a random place in each cell of a fine grid: no bias at any edge.
            u = (np.arange(side)[None, :] + rng.random((side, side))) / side - 0.5
            v = (np.arange(side)[:, None] + rng.random((side, side))) / side - 0.5
            around = np.stack([(pixel % 1280 + u).ravel(), (pixel // 1280 + v).ravel()], axis=1)
            offset = floor_points(rig, around)[0] - tape.start[:2]
            along, across = offset @ tape.direction[:2], np.abs(offset @ left)
            covered = (along > 0.0) & (along < tape.length) & (across < 0.5 * tape.width)
            errors.append(share - covered.mean())
    assert np.mean(np.abs(errors)) < 1e-3
    assert abs(np.mean(errors)) < 3e-4


@pytest.mark.parametrize('width', [1280, 640])
def test_a_tape_covers_the_area_inside_its_projected_border(width):
    rig = arena_rig().scaled(width / 1280)
    view = floor_view(rig)
    for line in arena_map():
        tape = line.transformed(POSE.inverse())
        area, centroid = area_and_centroid(outline(rig, tape))
        flux, middle, sigma = moments(view, tape)
        assert flux == pytest.approx(area, rel=1e-3)
        np.testing.assert_allclose(middle, centroid, atol=4.0 * sigma)


@given(st.floats(-1.8, 1.8), st.floats(-1.3, 1.3), st.floats(-3.1, 3.1), st.floats(0.02, 0.2))
def test_a_short_tape_lies_where_it_is_projected(x, y, angle, width):
    rig = arena_rig()
    along = 0.06 * np.array([np.cos(angle), np.sin(angle), 0.0])
    middle = np.array([x, y, 0.0])
    if np.hypot(x - 0.04, y + 0.01) < 0.4:  # the camera stands over what is near the mast
        return
    tape = Line(middle - along, middle + along, width)
    area, centroid = area_and_centroid(outline(rig, tape, 40))
    flux, rendered, sigma = moments(floor_view(rig), tape)
    assert flux == pytest.approx(area, rel=5e-3, abs=5e-3)
    np.testing.assert_allclose(rendered, centroid, atol=4.0 * sigma)


def test_half_the_resolution_is_the_mean_of_four_pixels():
    fine = expected_image(ideal_scene(1280), POSE)
    coarse = expected_image(ideal_scene(640), POSE)
    mean = fine.reshape(480, 2, 640, 2, 3).mean(axis=(1, 3))
    touched = np.abs(coarse - coarse[0, 0]).max(axis=2) > 0.0
    assert touched.sum() > 1000
    # Full contrast is 153 grey levels in red and blue.
    assert np.abs(coarse - mean)[touched].mean() < 0.15
    assert np.abs(coarse - mean)[~touched].max() < 0.5


def test_the_ideal_image_has_the_noise_that_was_asked_for():
    scene = ideal_scene(640, noise=0.05)
    image = render(scene, POSE, np.random.default_rng(0)).astype(float)
    clean = expected_image(scene, POSE)
    noise = (image - clean).reshape(-1, 3)
    count = len(noise)
    # Standard errors: sigma / sqrt(n) of the mean, sigma / sqrt(2 n) of the deviation; rounding
    # to whole grey levels adds 1/12.
    sigma = np.hypot(0.05 * 255.0, np.sqrt(1.0 / 12.0))
    assert np.abs(noise.mean(axis=0)).max() < 5.0 * sigma / np.sqrt(count)
    assert np.abs(noise.std(axis=0) - sigma).max() < 5.0 * sigma / np.sqrt(2.0 * count)
    assert np.abs(np.corrcoef(noise.T) - np.eye(3)).max() < 5.0 / np.sqrt(count)
    neighbours = np.corrcoef(noise[:-1, 0], noise[1:, 0])[0, 1]
    assert abs(neighbours) < 5.0 / np.sqrt(count)


def test_same_seed_same_picture_other_seed_other_picture():
    scene = arena_scene(320)
    first = render(scene, POSE, np.random.default_rng(3))
    again = render(scene, POSE, np.random.default_rng(3))
    other = render(scene, POSE, np.random.default_rng(4))
    assert first.shape == (240, 320, 3)
    assert first.dtype == np.uint8
    np.testing.assert_array_equal(first, again)
    assert (first != other).mean() > 0.1


def test_the_floor_pattern_stays_on_the_map_when_the_robot_moves():
    look = Appearance(texture=FloorTexture(contrast=0.15), floor_colour=(0.4, 0.4, 0.4))
    scene = Scene(arena_rig().scaled(0.5), arena_map(), look)
    rng = np.random.default_rng(0)
    points = np.c_[rng.uniform([-0.9, -0.7], [0.9, 0.7], (400, 2)), np.zeros(400)]
    levels = []
    for pose in (Pose2(1.2, 0.9, 0.4), Pose2(-1.2, -0.9, -2.0)):
        pixels, visible = scene.rig.project(pose.inverse().apply(points))
        assert visible.all()
        levels.append(bilinear(expected_image(scene, pose), pixels)[:, 0])
    assert np.corrcoef(levels)[0, 1] > 0.8
    assert levels[0].std() > 5.0


def test_textures_are_not_rounded_to_parts_of_a_texel() -> None:
    """As cv2.remap rounds them before OpenCV 5: images then depend on the version."""
    room = Room(-2.0, 2.0, -1.5, 1.5)
    along = np.linspace(3.0, 3.0 + 1.0 / 80.0, 129, dtype=np.float32)  # across one texel
    steps = np.diff(wall_colours(room, along, np.full(129, 1.0, np.float32))[:, 0])
    mean = steps.mean()
    assert abs(mean) > 1e-5
    np.testing.assert_allclose(steps, mean, atol=0.1 * abs(mean))


def test_walls_stand_where_they_are_projected():
    room = Room(-2.5, 2.5, -2.2, 2.2)
    look = Appearance(floor_colour=RED, room=room)
    scene = Scene(arena_rig().scaled(0.5), arena_map(), look)
    image = expected_image(scene, POSE)
    y = np.linspace(-1.9, 1.9, 30)
    before = np.c_[np.full(30, 2.35), y, np.zeros(30)]
    on_wall = np.c_[np.full(30, 2.5), y, np.full(30, 0.15)]
    red = np.array(RED) * 255.0
    for points, is_floor in ((before, True), (on_wall, False)):
        pixels, visible = scene.rig.project(POSE.inverse().apply(points))
        assert visible.all()
        same = np.abs(bilinear(image, pixels) - red).max(axis=1) < 1.0
        assert same.all() if is_floor else not same.any()


def test_an_obstacle_hides_the_tape_behind_it_and_stands_where_it_is_projected():
    colour = (0.9, 0.0, 0.9)
    person = Obstacle(1.1, 0.1, 0.12, 1.7, colour=colour)
    scene = ideal_scene(640, 0.0)
    clean = expected_image(scene, Pose2())
    look = dataclasses.replace(scene.appearance, obstacles=(person,))
    image = expected_image(dataclasses.replace(scene, appearance=look), Pose2())
    # Its surface, on the side of the robot, up to the height of the mirror and above.
    heights = np.linspace(0.1, 1.5, 15)
    surface = np.c_[np.full(15, 1.1 - 0.12), np.full(15, 0.1), heights]
    pixels, visible = scene.rig.project(surface)
    assert visible.all()
    seen = bilinear(image, pixels)
    np.testing.assert_allclose(seen[:, 1], 0.0, atol=1e-3)
    assert (seen[:, 0] > 0.5 * 0.9 * 255.0).all()
    # A tape point straight behind it is hidden, one half a metre beside that is not.
    tape = scene.line_map[1]
    behind, beside = (tape.start + share * (tape.end - tape.start) for share in (0.55, 0.32))
    mirror = scene.rig.T_base_mirror.translation
    sight = np.cross(behind - mirror, [1.1, 0.1, 0.0] - mirror)[2] / np.linalg.norm(behind)
    assert abs(sight) < 0.06
    pixels, visible = scene.rig.project(np.stack([behind, beside]))
    assert visible.all()
    green = bilinear(clean, pixels)
    assert (green[:, 0] < 180.0).all()
    hidden, free = bilinear(image, pixels)
    assert hidden[1] < 1.0
    np.testing.assert_array_equal(free, green[1])


def test_the_robot_sees_itself_in_the_same_pixels_everywhere():
    look = dataclasses.replace(arena_scene(320).appearance, body=RobotBody(colour=RED))
    scene = dataclasses.replace(arena_scene(320), appearance=look, sensor=SensorModel())
    first = expected_image(scene, POSE)
    second = expected_image(scene, Pose2(-0.8, 0.6, -2.0))
    deck = np.array([[-0.16, 0.02, 0.24], [-0.12, -0.14, 0.24], [0.15, -0.05, 0.24]])
    pixels, visible = scene.rig.project(deck)
    assert visible.all()
    np.testing.assert_allclose(bilinear(first, pixels), np.tile([0, 0, 255.0], (3, 1)), atol=1e-3)
    np.testing.assert_array_equal(bilinear(first, pixels), bilinear(second, pixels))
    assert (first != second).mean() > 0.2


def test_motion_blur_is_the_mean_over_the_shutter_time():
    sensor = SensorModel(exposure_time=0.2, exposure_steps=4)
    scene = dataclasses.replace(ideal_scene(320), sensor=sensor)
    sharp = dataclasses.replace(scene, sensor=SensorModel())
    # Forward v and turn w: a circle of radius v / w about (0, v / w).
    v, w = 0.5, 1.0
    mean = np.zeros((240, 320, 3))
    for t in (-0.075, -0.025, 0.025, 0.075):
        pose = Pose2(v / w * np.sin(w * t), v / w * (1.0 - np.cos(w * t)), w * t)
        mean += expected_image(sharp, pose) / 4.0
    blurred = expected_image(scene, Pose2(), Twist(v, w))
    np.testing.assert_allclose(blurred, mean, atol=1e-3)
    np.testing.assert_array_equal(
        expected_image(scene, Pose2(), None), expected_image(sharp, Pose2()))
    assert np.abs(blurred - expected_image(sharp, Pose2())).max() > 10.0


def test_sensor_gains_vignetting_and_point_spread():
    light = np.full((61, 81, 3), 0.2, np.float32)
    light[30, 40] = 10.0
    spread = irradiate(light.copy(), SensorModel(psf_sigma=1.5))
    assert spread[30, 40, 0] < 2.0
    np.testing.assert_allclose(spread.sum(), light.sum(), rtol=1e-4)
    gains = SensorModel(exposure=2.0, white_balance=(0.5, 1.0, 1.5))
    np.testing.assert_allclose(
        irradiate(light.copy(), gains)[0, 0], [0.2, 0.4, 0.6], rtol=1e-6)
    dimmed = irradiate(light.copy(), SensorModel(vignetting=0.3))
    assert dimmed[0, 0, 0] == pytest.approx(0.7 * 0.2, rel=1e-5)
    assert dimmed[30, 40, 0] == pytest.approx(10.0, rel=1e-5)


def test_shot_noise_grows_with_the_light():
    rng = np.random.default_rng(0)
    sensor = SensorModel(read_noise=0.01, shot_noise=0.03)
    for level in (0.1, 0.4, 0.7):
        image = expose(np.full((200, 200, 3), level, np.float32), sensor, rng)
        # Rounding to whole levels adds 1/12.
        expected = np.sqrt(255.0**2 * (0.01**2 + 0.03**2 * level) + 1.0 / 12.0)
        assert image.astype(float).std() == pytest.approx(expected, rel=0.02)


def test_response_is_a_power_law_and_compression_loses():
    ramp = np.repeat(np.linspace(0.0, 1.0, 256, dtype=np.float32)[None, :, None], 3, axis=2)
    image = expose(ramp.copy(), SensorModel(gamma=2.2), np.random.default_rng(0))
    np.testing.assert_array_equal(image[0, :, 1], np.rint(255 * ramp[0, :, 1] ** (1 / 2.2)))
    bright = expose(3.0 * ramp - 1.0, SensorModel(), np.random.default_rng(0))
    assert bright.min() == 0
    assert bright.max() == 255
    picture = render(arena_scene(320), POSE, np.random.default_rng(0)).astype(int)
    loss = [np.abs(compress(picture.astype(np.uint8), q) - picture).mean() for q in (95, 60, 20)]
    assert loss[0] < loss[1] < loss[2]


def test_what_cannot_be_rendered_is_refused_in_words():
    rig, tapes = arena_rig(), arena_map()
    with pytest.raises(SimulationError, match='floor tapes only'):
        Scene(rig, LineMap((Line(np.array([0, 0, 1.0]), np.array([1.0, 0, 1.0]), name='bar'),)))
    with pytest.raises(SimulationError, match=r"'loud'.*no paint of colour 'pink'"):
        Scene(rig, LineMap((*tapes, dataclasses.replace(tapes[0], colour='pink', name='loud'))))
    with pytest.raises(SimulationError, match='psf_sigma must be >= 0, is -1'):
        SensorModel(psf_sigma=-1)
    with pytest.raises(SimulationError, match='do not make a cylinder'):
        Obstacle(0.0, 0.0, 0.1, -1.0)


def test_the_preset_is_the_configuration(repository):
    rig, preset = load_rig(repository / 'config' / 'arena_rig.yaml'), arena_rig()
    assert (rig.mirror, rig.camera.K.tolist()) == (preset.mirror, preset.camera.K.tolist())
    assert (rig.camera.width, rig.camera.height) == (1280, 960)
    for name in ('cop', 'R_mirror_camera'):
        np.testing.assert_array_equal(getattr(rig, name), getattr(preset, name))
    for name in ('rotation', 'translation'):
        np.testing.assert_array_equal(
            getattr(rig.T_base_mirror, name), getattr(preset.T_base_mirror, name))
    tapes, expected = load_map(repository / 'config' / 'arena_map.yaml'), arena_map()
    for attribute in ('starts', 'ends', 'widths'):
        np.testing.assert_array_equal(getattr(tapes, attribute), getattr(expected, attribute))
    assert [t.name for t in tapes] == [t.name for t in expected]
    assert {t.colour for t in tapes} == {'green'}


def test_the_soccer_map_is_a_field_that_half_a_turn_leaves_alone(repository):
    field = load_map(repository / 'config' / 'soccer_map.yaml')
    ends = {frozenset([tuple(line.start[:2]), tuple(line.end[:2])]) for line in field}
    turned = {frozenset((-x, -y) for x, y in line) for line in ends}
    assert ends == turned
    assert len(ends) == len(field) == 17
    assert {line.colour for line in field} == {'white'}
