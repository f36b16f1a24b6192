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

"""The first guess of the camera's place from the mirror's outline."""

from __future__ import annotations

from dataclasses import replace

import cv2
from nccs_pose.calibration.outline import find_outline
from nccs_pose.calibration.rim import circle_poses, outline_points, rig_from_outline
from nccs_pose.errors import CalibrationError
from nccs_pose.evaluation.calibration_study import disturbed
from nccs_pose.geometry.pose import rotation_exp
from nccs_pose.simulation.scene import arena_rig
from nccs_pose.simulation.table_one import TABLE_ONE
import numpy as np
import pytest

RIGS = {'arena': arena_rig(), **TABLE_ONE}


def rimmed(name, radius):
    return replace(RIGS[name], mirror=replace(RIGS[name].mirror, rim_radius=radius))


def test_one_of_two_circles_is_the_one_that_was_seen():
    rng = np.random.default_rng(0)
    for _ in range(20):
        axis = rotation_exp([*rng.uniform(-0.6, 0.6, 2), 0.0]) @ [0.0, 0.0, -1.0]
        centre = np.array([*rng.uniform(-0.01, 0.01, 2), rng.uniform(0.05, 0.1)])
        across = np.linalg.svd(axis[None])[2][1:]
        angle = np.linspace(0.0, 6.0, 50)[:, None]
        points = centre + 0.012 * (np.cos(angle) * across[0] + np.sin(angle) * across[1])
        pair = circle_poses(points / np.linalg.norm(points, axis=1, keepdims=True), 0.012)
        error = min(np.abs(c.centre - centre).max() + np.abs(c.axis - axis).max() for c in pair)
        assert error < 1e-8


@pytest.mark.parametrize('name', ['hyperbolic', 'parabolic'])
def test_the_rim_gives_the_camera_back(name):
    rig = rimmed(name, 0.005)
    rough = disturbed(rig, np.random.default_rng(1), cop=3e-3, tilt=np.deg2rad(2.0))
    found = rig_from_outline(rough, outline_points(rig))
    np.testing.assert_allclose(found.cop, rig.cop, atol=1e-7)
    np.testing.assert_allclose(found.R_mirror_camera, rig.R_mirror_camera, atol=1e-6)


def test_the_outline_of_a_sphere_gives_its_place_before_the_camera():
    rig = rimmed('arena', 0.032)
    rough = disturbed(rig, np.random.default_rng(1), cop=3e-3, tilt=np.deg2rad(2.0))
    found = rig_from_outline(rough, outline_points(rig))
    # The turn about the centre is nearly the rough rig's; the centre, seen from the camera, is
    # the true one.
    np.testing.assert_allclose(
        found.R_mirror_camera.T @ found.cop, rig.R_mirror_camera.T @ rig.cop, atol=1e-9)
    with pytest.raises(CalibrationError, match='no rim_radius'):
        rig_from_outline(RIGS['parabolic'], outline_points(rig))


def test_an_outline_of_something_else_is_refused():
    for name, radius in (('arena', 0.032), ('parabolic', 0.005)):
        rig = rimmed(name, radius)
        outline = outline_points(rig)
        middle = outline.mean(axis=0)
        with pytest.raises(CalibrationError, match=r"puts the mirror .* not the mirror's outline"):
            rig_from_outline(rig, middle + 0.7 * (outline - middle))


def rim_disc(rig, pixels):
    """How far from the rim, in rim radii, a pixel's straight ray meets the rim's plane (N,)."""
    rays = rig.camera.directions(pixels) @ rig.R_mirror_camera.T
    at = rig.cop + ((rig.mirror.z_min - rig.cop[2]) / rays[:, 2])[:, None] * rays
    return np.hypot(at[:, 0], at[:, 1]) / rig.mirror.rim_radius


def pictured(rig, rng, finer=5):
    """The mirror as a bright disc, with the green tape that it shows and the sensor's noise."""
    shape = rig.camera.height, rig.camera.width
    pixels = np.stack(np.meshgrid(*(np.arange(n) for n in shape[::-1])), axis=2).reshape(-1, 2)
    distance = rim_disc(rig, pixels.astype(float))
    share = (distance < 1.0).astype(float)
    border = np.flatnonzero(np.abs(distance - 1.0) < 0.1)
    within = (np.arange(finer) - 0.5 * (finer - 1)) / finer
    share[border] = np.mean([
        rim_disc(rig, pixels[border] + [du, dv]) < 1.0 for du in within for dv in within], axis=0)
    image = 60.0 + share.reshape(*shape, 1) * (np.array([150.0, 160.0, 150.0]) - 60.0)
    cv2.line(image, (500, 300), (700, 420), (20, 200, 30), 6)
    return np.clip(image + rng.normal(0.0, 6.0, image.shape), 0, 255).astype(np.uint8)


def placement(rig, true):
    """Place and turn of a rig's camera against the true one's (6,): mm and degrees."""
    turn = rig.R_mirror_camera @ true.R_mirror_camera.T
    skew = 0.5 * np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0],
                           turn[1, 0] - turn[0, 1]])
    return np.concatenate([1e3 * (rig.cop - true.cop), np.rad2deg(skew)])


def test_the_outline_of_a_rim_is_measured_without_bias_and_places_the_camera_as_well_as_it_can():
    rig = rimmed('parabolic', 0.005)
    rng = np.random.default_rng(1)
    image = pictured(rig, rng)
    ideal = outline_points(rig)
    # What outlines scattered like the measured one make of the camera's place.
    scatter = 0.0
    for seed in range(4):
        rough = disturbed(rig, np.random.default_rng(seed), cop=3e-3, tilt=np.deg2rad(2.0))
        points = find_outline(rough, [image])
        out = points - points.mean(axis=0)
        unit = out / np.linalg.norm(out, axis=1, keepdims=True)
        slope = (rim_disc(rig, points + 0.01 * unit) - rim_disc(rig, points - 0.01 * unit)) / 0.02
        distance = (rim_disc(rig, points) - 1.0) / slope  # px along the ray from the middle
        assert len(points) > 200
        assert abs(distance.mean()) < 4.0 * distance.std() / np.sqrt(len(points))
        assert distance.std() < 0.25
        scatter = max(scatter, distance.std())
        errors = np.abs(placement(rig_from_outline(rough, points), rig))
        drawn = [placement(rig_from_outline(rough, ideal + scatter * rng.normal(
            size=ideal.shape)), rig) for _ in range(60)]
        assert (errors <= 4.0 * np.std(drawn, axis=0)).all()
        # 0.1 px on the outline is 0.01 mm and 0.02 degrees.
        assert errors[:3].max() < 0.05
        assert errors[3:].max() < 0.1


def test_an_image_without_a_mirror_has_no_outline():
    with pytest.raises(CalibrationError, match='outline was not found'):
        find_outline(rimmed('parabolic', 0.005), [np.full((800, 1200, 3), 90, np.uint8)])
