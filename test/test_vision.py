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

"""Tapes in images: masks, blobs, colours and sub-pixel profiles, against known pictures."""

from __future__ import annotations

from dataclasses import replace
from itertools import groupby

import cv2
from hypothesis import given
from hypothesis import strategies as st
from nccs_pose.errors import VisionError
from nccs_pose.estimation.prediction import BandPredictor
from nccs_pose.geometry.floor_table import FloorTable
from nccs_pose.geometry.pose import Pose2
from nccs_pose.simulation.renderer import render
from nccs_pose.simulation.scene import arena_scene, ideal_scene, Scene
from nccs_pose.vision.bands import Bands, runs
from nccs_pose.vision.colour import CONTRASTS, LineColour
from nccs_pose.vision.profile_search import search_profiles
from nccs_pose.vision.profiles import fit_again, fit_profiles, ProfileFit, read_bands
from nccs_pose.vision.segment import chromatic_mask, find_blobs, hsv_mask
import numpy as np
import pytest
from scipy.special import ndtr

BLUR = 0.7
FLOOR = np.array([150.0, 155.0, 160.0])
GREEN = np.array([40.0, 130.0, 30.0])
HEIGHT, WIDTH = 160, 420

# ---------------------------------------------------------------- a straight tape, analytically


def _tape(
    half_width: float, angle: float, noise: float = 0.0, seed: int = 0,
    tape: np.ndarray = GREEN, floor: np.ndarray = FLOOR, blur: float = BLUR,
) -> np.ndarray:
    """A straight tape through the middle at an angle, with blurred edges."""
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH].astype(float)
    d = _distance(np.stack([u, v], axis=-1), angle)
    share = ndtr((d + half_width) / blur) - ndtr((d - half_width) / blur)
    picture = floor + share[..., None] * (tape - floor)
    picture += noise * np.random.default_rng(seed).standard_normal(picture.shape)
    return np.clip(np.rint(picture), 0, 255).astype(np.uint8)


def _distance(pixels: np.ndarray, angle: float) -> np.ndarray:
    """Signed distance of pixels from the tape's midline along its normal."""
    middle = np.array([0.5 * WIDTH + 0.31, 0.5 * HEIGHT - 0.17])
    return (pixels - middle) @ np.array([-np.sin(angle), np.cos(angle)])


def _colour(name: str = 'green') -> LineColour:
    return LineColour.nominal(name, BLUR)


def _fitted(
    image: np.ndarray, bands: Bands, colour: LineColour,
) -> tuple[ProfileFit, LineColour]:
    return fit_profiles(read_bands(image, bands, colour), bands, colour)


def _straight_bands(
    half_width: float, angle: float, shift: float, spacing: float = 6.0,
) -> Bands:
    """Stations on a line ``shift`` px short of the tape's midline."""
    along, across = np.array([np.cos(angle), np.sin(angle)]), np.array(
        [-np.sin(angle), np.cos(angle)])
    middle = np.array([0.5 * WIDTH + 0.31, 0.5 * HEIGHT - 0.17])
    members = max(round(16.0 / spacing), 1)
    n = int(360 / spacing) // members * members
    s = (np.arange(n) - 0.5 * (n - 1)) * spacing
    centre = middle + s[:, None] * along - shift * across
    return Bands(
        centre, centre, np.tile(across, (n, 1)), np.zeros(n), np.full(n, half_width),
        np.full(n, spacing), np.zeros(n, dtype=np.intp), members)


@pytest.mark.parametrize('half_width', [0.3, 0.6, 1.2, 3.0, 6.0])
@pytest.mark.parametrize('angle', [0.06, 0.11, -0.3])
def test_a_shift_put_in_is_measured(half_width: float, angle: float) -> None:
    image, green = _tape(half_width, angle), _colour()
    for shift in (0.0, 0.15, -0.3):
        fit, _ = _fitted(image, _straight_bands(half_width, angle, shift), green)
        assert fit.found.all()
        # Rounding to grey levels leaves some hundredths of a pixel to each station.
        assert float(np.median(fit.shift)) == pytest.approx(shift, abs=0.01 + 0.1 * abs(shift))
        assert np.abs(fit.shift - shift).max() < 0.15


def test_no_template_is_computed_where_numbers_lose_their_digits(
        monkeypatch: pytest.MonkeyPatch) -> None:
    # There a processor takes dozens of times as long.
    exp, powers = cv2.exp, []

    def noted(power: np.ndarray, out: np.ndarray) -> np.ndarray:
        powers.append(np.abs(power).max())
        return exp(power, out)

    monkeypatch.setattr(cv2, 'exp', noted)
    sharp = replace(_colour(), blur=0.4)
    fit, _ = _fitted(_tape(8.0, 0.1), _straight_bands(8.0, 0.1, 0.2), sharp)
    assert float(np.median(fit.shift)) == pytest.approx(0.2, abs=0.05)
    assert max(powers) < 80.0


def test_a_tape_along_the_rows_is_biased_by_its_place_between_them_at_most_a_little() -> None:
    # All stations then read between the pixels in the same way, and do not average out.
    for half_width in (0.3, 0.6, 1.2, 3.0, 6.0):
        fit, _ = _fitted(
            _tape(half_width, 0.0), _straight_bands(half_width, 0.0, 0.0), _colour())
        assert np.abs(fit.shift).max() < 0.06


@pytest.mark.parametrize('half_width', [0.5, 0.6, 2.0, 3.5])
def test_a_sharp_tape_along_the_rows_is_measured_at_each_place_between_them(
        half_width: float) -> None:
    # What a pixel shows of it is the part of its square that is covered.
    rows, places = np.arange(HEIGHT), np.arange(0.0, 1.0, 0.05)
    errors, told = [], []
    for place in places:
        middle = 0.5 * HEIGHT - 0.17 + place
        low, high = np.maximum(rows - 0.5, middle - half_width), np.minimum(
            rows + 0.5, middle + half_width)
        share = np.repeat(np.maximum(high - low, 0.0)[:, None], WIDTH, axis=1)
        image = np.rint(FLOOR + share[..., None] * (GREEN - FLOOR)).astype(np.uint8)
        bands = _straight_bands(half_width, 0.0, -place)
        fit, _ = _fitted(image, bands, replace(_colour(), blur=12.0**-0.5))
        errors.append(float(np.median(fit.shift)))
        told.append(float(np.median(fit.sigma)))
    error = np.sqrt(np.mean(np.square(errors)))
    # Edges of a normal distribution of that blur would be off by 0.04.
    assert error < 0.025
    # No scatter of the stations shows it: all are off alike.
    assert 0.7 < np.sqrt(np.mean(np.square(told))) / error < 1.5


@pytest.mark.parametrize('angle', [0.05, 0.13, 0.7])
def test_of_a_sharp_image_no_part_of_a_shift_is_missed(angle: float) -> None:
    # Squares covered in part, by 24 x 24 points each.
    half_width, finer = 2.3, 24
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH].astype(float)
    place = (np.arange(finer) + 0.5) / finer - 0.5
    share = np.zeros((HEIGHT, WIDTH))
    for down in place:
        for right in place:
            seen = np.stack([u + right, v + down], axis=-1)
            share += np.abs(_distance(seen, angle)) < half_width
    image = np.rint(FLOOR + share[..., None] / finer**2 * (GREEN - FLOOR)).astype(np.uint8)
    colour = _colour()
    for _ in range(10):
        _, colour = _fitted(image, _straight_bands(half_width, angle, 0.0, 3.0), colour)
    assert _gain(image, half_width, angle, colour, 0.12) == pytest.approx(1.0, abs=0.012)


def _gain(
    image: np.ndarray, half_width: float, angle: float, colour: LineColour, shift: float,
) -> float:
    """What is measured of a shift to either side over the shift."""
    there, back = (
        float(np.average(fit.shift, weights=fit.sigma**-2)) for fit, _ in (
            _fitted(image, _straight_bands(half_width, angle, by, 3.0), colour)
            for by in (shift, -shift)))
    return (there - back) / (2.0 * shift)


@pytest.mark.parametrize('half_width', [1.0, 2.5])
@pytest.mark.parametrize('share', [0.2, 0.35])
def test_a_shift_is_not_taken_for_blur(half_width: float, share: float) -> None:
    # Taken for it, 0.35 blurs would be measured as 3 to 4 % more.
    image, colour = _tape(half_width, 0.13, 0.5), _colour()
    assert _gain(image, half_width, 0.13, colour, share * BLUR) == pytest.approx(1.0, abs=0.012)


@pytest.mark.parametrize('half_width', [0.4, 1.0, 4.0])
def test_measuring_again_at_the_measured_place_converges(half_width: float) -> None:
    image, green, angle = _tape(half_width, 0.2), _colour(), 0.2
    for start in (-0.9, 0.8):
        left = start
        for _ in range(5):
            fit, _ = _fitted(image, _straight_bands(half_width, angle, left), green)
            left -= float(np.median(fit.shift))
        assert abs(left) < 0.01


@pytest.mark.parametrize('half_width', [0.4, 1.0, 4.0])
@pytest.mark.parametrize(('noise', 'spacing'), [(4.0, 16.0), (12.0, 16.0), (4.0, 3.0)])
def test_sigma_is_the_scatter(half_width: float, noise: float, spacing: float) -> None:
    shifts, sigmas = [], []
    for seed in range(6):
        image = _tape(half_width, 0.1, noise, seed)
        fit, _ = _fitted(
            image, _straight_bands(half_width, 0.1, 0.0, spacing), _colour())
        shifts.append(fit.shift[fit.found])
        sigmas.append(fit.sigma[fit.found])
    shift, sigma = np.concatenate(shifts), np.concatenate(sigmas)
    scatter = 1.4826 * np.median(np.abs(shift - np.median(shift)))
    assert 0.7 < np.median(sigma) / scatter < 1.4
    assert abs(shift.mean()) < 4.0 * scatter / np.sqrt(len(shift)) + 0.01


@pytest.mark.parametrize('half_width', [0.6, 3.0])
def test_close_stations_say_together_what_distant_ones_do(half_width: float) -> None:
    image, green = _tape(half_width, 0.1, 6.0), _colour()
    coarse, _ = _fitted(image, _straight_bands(half_width, 0.1, 0.1, 16.0), green)
    fine, _ = _fitted(image, _straight_bands(half_width, 0.1, 0.1, 2.0), green)
    assert fine.found.all()
    assert coarse.found.all()
    weight = fine.sigma**-2.0
    information = coarse.sigma**-2.0
    together = float(weight @ fine.shift / weight.sum())
    apart = float(information @ coarse.shift / information.sum())
    # The same pixels but for a few at the ends: the difference is a part of their common noise.
    assert abs(together - apart) < 0.7 / np.sqrt(information.sum())
    assert weight.sum() == pytest.approx(information.sum(), rel=0.2)


def test_noise_twice_as_strong_doubles_sigma() -> None:
    medians = []
    for noise in (4.0, 8.0, 16.0):
        fit, _ = _fitted(
            _tape(2.0, 0.1, noise), _straight_bands(2.0, 0.1, 0.0), _colour())
        medians.append(float(np.median(fit.sigma)))
    assert medians[1] / medians[0] == pytest.approx(2.0, rel=0.25)
    assert medians[2] / medians[1] == pytest.approx(2.0, rel=0.25)


@pytest.mark.parametrize('half_width', [0.5, 2.5])
@pytest.mark.parametrize('blur', [0.4, 0.7, 1.4])
def test_a_shift_measured_again_from_where_it_leads_is_whole(
        blur: float, half_width: float) -> None:
    image, colour = _tape(half_width, 0.13, blur=blur), replace(_colour(), blur=blur)
    for _ in range(6):
        _, colour = _fitted(image, _straight_bands(half_width, 0.13, 0.0), colour)
    missed, left = [], []
    for share in (0.6, 0.9):
        shift = share * blur
        bands = _straight_bands(half_width, 0.13, shift)
        reading = read_bands(image, bands, colour)
        first, learned = fit_profiles(reading, bands, colour)
        mean = float(np.average(first.shift, weights=first.sigma**-2.0))
        again, found, _ = fit_again(reading, bands, learned, np.full(len(bands), mean))
        assert found.all()
        missed.append(mean / shift - 1.0)
        left.append(float(again.mean()) / shift - 1.0)
    assert np.abs(missed).max() > 0.01
    assert np.abs(left).max() < 0.005


@pytest.mark.parametrize('blur', [1.5, 2.5])
@pytest.mark.parametrize('half_width', [0.7, 3.0])
@pytest.mark.parametrize('inwards', [1.0, -1.0])
def test_a_blurred_bend_is_measured_where_it_is(
        blur: float, half_width: float, inwards: float) -> None:
    radius, middle, finer = 55.0, np.array([0.5 * WIDTH + 0.31, 0.5 * HEIGHT - 0.17]), 4
    v, u = (np.mgrid[0:HEIGHT * finer, 0:WIDTH * finer] + 0.5) / finer - 0.5
    ring = np.abs(np.hypot(u - middle[0], v - middle[1]) - radius) < half_width
    share = ring.reshape(HEIGHT, finer, WIDTH, finer).mean(axis=(1, 3))
    share = cv2.GaussianBlur(share, (0, 0), blur)
    image = np.rint(FLOOR + share[..., None] * (GREEN - FLOOR)).astype(np.uint8)
    n = 168
    angle = 2.0 * np.pi * np.arange(n) / n
    outwards = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    centre = middle + radius * outwards
    bands = Bands(
        centre, centre, -inwards * outwards, np.full(n, inwards / radius), np.full(n, half_width),
        np.full(n, 2.0 * np.pi * radius / n), np.zeros(n, dtype=np.intp), 8)
    colour = _colour()
    for _ in range(6):
        fit, colour = _fitted(image, bands, colour)
    assert fit.found.all()
    # Uncorrected it would be half the squared blur over the radius, inwards.
    assert abs(fit.shift.mean()) < 0.15 * 0.5 * blur**2 / radius


@pytest.mark.parametrize('half_width', [1.5, 4.0])
@pytest.mark.parametrize('shift', [0.42, -0.5])
def test_edges_softer_than_their_template_are_not_learned_but_reckoned_with(
        half_width: float, shift: float) -> None:
    # A template that lies a third of a pixel beside its tape, or more, learns nothing.
    image, known = _tape(half_width, 0.13, blur=2.4), LineColour.nominal('green', 1.9)
    fit, learned = _fitted(image, _straight_bands(half_width, 0.13, shift), known)
    assert learned.blur == known.blur
    # By itself it takes a shift for a tenth to a sixth too little, and its noise as well.
    assert float(np.median(fit.shift)) == pytest.approx(shift, rel=0.07)


@pytest.mark.parametrize('blur', [0.5, 1.0, 1.8])
@pytest.mark.parametrize('half_width', [1.5, 4.0])
def test_the_blur_of_the_edges_is_learned(blur: float, half_width: float) -> None:
    image, colour = _tape(half_width, 0.13, 2.0, blur=blur), _colour()
    for _ in range(8):
        _, colour = _fitted(image, _straight_bands(half_width, 0.13, 0.0), colour)
    # Reading between pixels blurs as well: by a quarter of a square pixel at most.
    assert blur - 0.1 < colour.blur < np.sqrt(blur**2 + 0.25) + 0.1


def test_nothing_is_found_where_there_is_no_tape() -> None:
    green, found = _colour(), 0
    for seed in range(8):
        empty = _tape(1.0, 0.1, 8.0, seed, tape=FLOOR)
        fit, learned = _fitted(empty, _straight_bands(1.0, 0.1, 0.0), green)
        found += int(fit.found.sum())
        np.testing.assert_array_equal(learned.contrast, green.contrast)
    assert found == 0


def test_a_tape_of_another_colour_is_not_found() -> None:
    image = _tape(2.0, 0.1, 3.0, tape=np.array([30.0, 30.0, 150.0]))
    fit, _ = _fitted(
        image, _straight_bands(2.0, 0.1, 0.0), _colour())
    assert not fit.found.any()


def test_a_covered_part_of_a_tape_is_not_found() -> None:
    image = _tape(2.0, 0.0, 2.0)
    image[:, 150:250] = FLOOR.astype(np.uint8)
    bands = _straight_bands(2.0, 0.0, 0.0)
    fit, _ = _fitted(image, bands, _colour())
    u = bands.centre[:, 0]
    assert not fit.found[(u > 156) & (u < 243)].any()
    assert fit.found[(u < 144) | (u > 256)].all()


@pytest.mark.parametrize('offset', [-9.0, -4.0, 3.0, 8.5])
@pytest.mark.parametrize('half_width', [0.5, 2.5])
def test_a_search_finds_a_tape_pixels_away(offset: float, half_width: float) -> None:
    image = _tape(half_width, 0.1, 4.0)
    bands = _straight_bands(half_width, 0.1, offset)
    fit = search_profiles(image, bands, _colour(), reach=12.0)
    assert fit.found.mean() > 0.9
    # Whole pixels are searched.
    assert np.abs(fit.shift[fit.found] - offset).max() <= 1.01


def test_a_search_of_noise_finds_next_to_nothing() -> None:
    green, found, stations = _colour(), 0, 0
    for seed in range(6):
        empty = _tape(1.0, 0.1, 6.0, seed, tape=FLOOR)
        fit = search_profiles(empty, _straight_bands(1.0, 0.1, 0.0), green, reach=12.0)
        found, stations = found + int(fit.found.sum()), stations + len(fit.found)
    assert found < 0.02 * stations


# ---------------------------------------------------------------- tapes in rendered images

POSE = Pose2(0.3, -0.2, 0.6)


def _predict(table: FloorTable, scene: Scene, pose: Pose2) -> tuple[Bands, np.ndarray]:
    predictor = BandPredictor(table, scene.line_map)
    return predictor.bands(predictor.places(pose, 8.0, 75), pose)


def _beside(scene: Scene, bands: Bands, shift: np.ndarray, pose: Pose2) -> np.ndarray:
    """How far the measured pixels lie from their tapes' midlines, px (N,).

    By exact back-projection onto the floor, at the true pose.
    """
    def signed(pixels: np.ndarray) -> np.ndarray:
        rays = scene.rig.back_project(pixels)
        points, reaches = rays.floor_points()
        assert reaches.all()
        lines = scene.line_map
        direction = lines.directions[bands.label, :2]
        offset = pose.apply(points) - lines.starts[bands.label, :2]
        return direction[:, 0] * offset[:, 1] - direction[:, 1] * offset[:, 0]

    at = bands.midline + shift[:, None] * bands.across
    metres_per_px = (signed(at + 0.5 * bands.across) - signed(at - 0.5 * bands.across))
    return signed(at) / metres_per_px


@pytest.mark.parametrize('moved', [(0.0, 0.0, 0.0), (0.004, -0.003, 0.002)])
def test_rendered_tapes_are_measured_where_they_are(moved: tuple[float, float, float]) -> None:
    scene = ideal_scene(640, noise=0.0)
    image = render(scene, POSE, np.random.default_rng(0))
    table = FloorTable(scene.rig, 5.0)
    bands, _ = _predict(table, scene, Pose2.from_array(POSE.as_array() + moved))
    fit, _ = _fitted(image, bands, _colour())
    assert fit.found.mean() > 0.95
    error = _beside(scene, bands, fit.shift, POSE)[fit.found]
    before = _beside(scene, bands, np.zeros(len(bands)), POSE)[fit.found]
    # Without noise, reading between the pixels leaves some hundredths to each station.
    assert np.sqrt(np.mean(error**2)) < 0.06 + 0.1 * np.sqrt(np.mean(before**2))
    for k in range(len(scene.line_map)):
        on = bands.label[fit.found] == k
        assert abs(float(np.median(error[on]))) < 0.02 + 0.1 * float(
            np.median(np.abs(before[on])))


def test_bands_lie_on_the_exact_images_of_their_tapes() -> None:
    scene = ideal_scene(640)
    table = FloorTable(scene.rig, 5.0)
    bands, _ = _predict(table, scene, POSE)
    assert set(bands.label.tolist()) == {0, 1, 2, 3}
    assert np.abs(_beside(scene, bands, np.zeros(len(bands)), POSE)).max() < 0.01
    # The ends of the cuts lie on the tape's edges, half its width from the midline.
    rays = scene.rig.back_project(np.concatenate([
        bands.centre + side * bands.half_width[:, None] * bands.across for side in (1.0, -1.0)]))
    points, _ = rays.floor_points()
    label = np.concatenate([bands.label, bands.label])
    direction = scene.line_map.directions[label, :2]
    offset = POSE.apply(points) - scene.line_map.starts[label, :2]
    across = direction[:, 0] * offset[:, 1] - direction[:, 1] * offset[:, 0]
    n = len(bands)
    np.testing.assert_allclose(across[:n], 0.025, atol=3e-4)
    np.testing.assert_allclose(across[n:], -0.025, atol=3e-4)
    np.testing.assert_allclose(np.linalg.norm(bands.across, axis=1), 1.0, atol=1e-9)


# ---------------------------------------------------------------- colours


def test_a_discriminant_gives_the_tape_one_and_ignores_the_floor() -> None:
    for name in CONTRASTS:
        colour = _colour(name)
        assert colour.discriminant @ colour.contrast == pytest.approx(1.0)
    shade = np.array([0.9, 1.0, 1.1])
    coloured = replace(
        _colour(), clutter=400.0 * np.outer(shade, shade) + 0.1 * np.eye(3))
    assert abs(coloured.discriminant @ shade) < 1e-3


def test_an_unknown_colour_is_refused_by_name() -> None:
    with pytest.raises(VisionError, match='mauve'):
        LineColour.nominal('mauve', BLUR)


def _stations(contrast: np.ndarray, n: int = 60) -> tuple[np.ndarray, ...]:
    """Heights, power, clutter and floor, as if n stations had shown a contrast."""
    rng = np.random.default_rng(6)
    shade = rng.standard_normal((n, 8, 1)) * np.array([3.0, 4.0, 5.0])
    beside = shade + 0.5 * rng.standard_normal((n, 8, 3))
    clutter = np.einsum('nki,nkj->ijn', beside, beside) / 8.0
    return (contrast + rng.standard_normal((n, 3))).T, np.ones(n), clutter, FLOOR


def test_the_contrast_and_the_floors_variation_are_learned() -> None:
    green = _colour()
    dim = np.array([-20.0, 8.0, -18.0])
    learned = green.learn(*_stations(dim))
    np.testing.assert_allclose(learned.contrast, dim, atol=1.0)
    shade = np.array([3.0, 4.0, 5.0])
    np.testing.assert_allclose(
        learned.clutter, np.outer(shade, shade) + 0.35 * np.eye(3), rtol=0.2, atol=0.3)


@pytest.mark.parametrize('contrast', [
    (0.0, 0.0, 0.0), (40.0, -80.0, 40.0), (-40.0, -40.0, 80.0), (30.0, 30.0, 30.0)])
def test_what_is_not_the_colour_teaches_nothing(contrast: tuple[float, float, float]) -> None:
    green = _colour()
    assert green.learn(*_stations(np.array(contrast))) is green


def test_a_handful_of_stations_teaches_nothing() -> None:
    green = _colour()
    assert green.learn(*_stations(np.array([-20.0, 40.0, -20.0]), 5)) is green


@given(st.integers(0, 2**32 - 1))
def test_no_lesson_makes_a_colour_useless(seed: int) -> None:
    rng = np.random.default_rng(seed)
    scale = 10.0 ** rng.uniform(-3, 2)
    colour = _colour()
    for _ in range(3):
        beside = scale * rng.standard_normal((30, 5, 3))
        colour = colour.learn(
            scale * rng.standard_normal((3, 30)), rng.random(30),
            np.einsum('nki,nkj->ijn', beside, beside) / 5.0, 200.0 * rng.random(3))
        assert np.isfinite(colour.discriminant).all()
        assert colour.discriminant @ colour.contrast == pytest.approx(1.0)


# ---------------------------------------------------------------- masks and blobs


def _recall(mask: np.ndarray, half_width: float, angle: float) -> tuple[float, float]:
    """Part of the tape's length that the mask covers, and part of the mask off the tape."""
    n = 360
    s = np.arange(n) - 0.5 * n
    along = np.array([np.cos(angle), np.sin(angle)])
    middle = np.array([0.5 * WIDTH + 0.31, 0.5 * HEIGHT - 0.17])
    at = np.rint(middle + s[:, None] * along).astype(int)
    thick = cv2.dilate(mask, np.ones((3, 3), np.uint8))
    v, u = np.nonzero(mask)
    away = np.abs(_distance(np.stack([u, v], axis=1).astype(float), angle)) > half_width + 2.5
    return float((thick[at[:, 1], at[:, 0]] > 0).mean()), float(away.mean()) if len(u) else 0.0


def _mask(image: np.ndarray, colour: str = 'green') -> np.ndarray:
    return chromatic_mask(image, colour, 4.5, 0.05, 31)


def test_the_floor_beside_a_dark_thing_is_not_white_and_a_tape_there_is() -> None:
    image = np.full((240, 320, 3), 150, np.uint8)
    cv2.circle(image, (100, 120), 40, (20, 20, 20), -1)
    cv2.line(image, (60, 200), (260, 180), (200, 200, 200), 5)
    image = cv2.add(image, np.random.default_rng(0).integers(0, 4, image.shape, dtype=np.uint8))
    mask = _mask(image, 'white')
    tape = np.zeros(mask.shape, np.uint8)
    cv2.line(tape, (60, 200), (260, 180), 255, 5)
    assert np.count_nonzero(mask[tape > 0]) > 0.9 * np.count_nonzero(tape)
    assert np.count_nonzero(mask[cv2.dilate(tape, np.ones((3, 3), np.uint8)) == 0]) == 0


@pytest.mark.parametrize('angle', [0.0, 0.1, -0.35])
@pytest.mark.parametrize('half_width', [0.4, 0.5, 1.0])
def test_tapes_a_pixel_wide_survive(half_width: float, angle: float) -> None:
    image = _tape(half_width, angle, 3.0)
    mask = _mask(image)
    inside = np.zeros(mask.shape, np.uint8)
    inside.flat[find_blobs(mask, mask.size).place] = 255
    covered, _ = _recall(inside, half_width, angle)
    assert covered > 0.95
    # What is left of it is a few long pieces, not dust.
    blobs = find_blobs(mask, 60)
    sizes = np.bincount(blobs.label, blobs.weight)
    assert sizes[:3].sum() > 0.9 * sizes.sum()


@pytest.mark.parametrize('gain', [0.25, 1.0, 1.5])
@pytest.mark.parametrize('cast', [(1.0, 1.0, 1.0), (0.8, 1.0, 1.2), (1.2, 1.0, 0.75)])
def test_exposure_and_white_balance_do_not_matter(
        gain: float, cast: tuple[float, float, float]) -> None:
    balance = gain * np.array(cast)
    image = _tape(2.0, 0.1, 2.0, tape=balance * GREEN, floor=balance * FLOOR)
    covered, off = _recall(_mask(image), 2.0, 0.1)
    assert covered > 0.98
    assert off < 0.02


@pytest.mark.parametrize(('colour', 'tape', 'floor'), [
    ('white', (210, 215, 210), (60, 110, 55)), ('white', (200, 200, 200), (120, 120, 120)),
    ('black', (25, 25, 25), (150, 155, 150)), ('yellow', (40, 170, 190), (150, 150, 150)),
    ('blue', (170, 70, 40), (150, 150, 150)), ('red', (40, 40, 170), (150, 150, 150)),
    ('magenta', (170, 60, 170), (150, 150, 150)), ('cyan', (170, 170, 50), (150, 150, 150))])
def test_every_colour_of_a_map_is_seen(
        colour: str, tape: tuple[int, ...], floor: tuple[int, ...]) -> None:
    image = _tape(2.0, 0.1, 3.0, tape=np.array(tape, float), floor=np.array(floor, float))
    covered, off = _recall(_mask(image, colour), 2.0, 0.1)
    assert covered > 0.98
    assert off < 0.02
    fit, _ = _fitted(
        image, _straight_bands(2.0, 0.1, 0.2), _colour(colour))
    assert fit.found.mean() > 0.95
    assert float(np.median(fit.shift)) == pytest.approx(0.2, abs=0.03)


def test_noise_alone_makes_next_to_no_mask() -> None:
    mask = _mask(_tape(1.0, 0.1, 10.0, tape=FLOOR))
    assert (mask > 0).mean() < 1e-3


@pytest.mark.parametrize('value', [0, 128, 255])
def test_an_even_image_makes_no_mask(value: int) -> None:
    even = np.full((120, 160, 3), value, np.uint8)
    for colour in CONTRASTS:
        assert not _mask(even, colour).any()


def test_the_papers_threshold_sees_green_and_refuses_colours_without_hue() -> None:
    image = _tape(3.0, 0.1)
    covered, off = _recall(hsv_mask(image, 'green'), 3.0, 0.1)
    assert covered > 0.98
    assert off < 0.02
    with pytest.raises(VisionError, match='white'):
        hsv_mask(image, 'white')


def test_blobs_are_the_connected_regions() -> None:
    mask = np.zeros((100, 200), np.uint8)
    mask[10:12, 20:120] = 255
    mask[50:60, 30:40] = 255
    mask[80, 100:103] = 255
    blobs = find_blobs(mask, 60)
    assert len(np.unique(blobs.label)) == 2, 'three pixels are noise'
    first = blobs.pixels[blobs.label == 0]
    assert (first[:, 1] >= 10).all() and (first[:, 1] < 12).all()
    assert blobs.weight[blobs.label == 0].sum() == pytest.approx(200, abs=4)
    assert blobs.weight[blobs.label == 1].sum() == pytest.approx(100, abs=2)
    # The pixels taken of a blob are spread over all of it.
    assert first[:, 0].min() <= 22 and first[:, 0].max() >= 117


def test_an_empty_mask_has_no_blobs() -> None:
    blobs = find_blobs(np.zeros((60, 80), np.uint8), 60)
    assert blobs.pixels.shape == (0, 2)
    assert len(blobs.label) == len(blobs.weight) == 0


@given(seed=st.integers(0, 2**32 - 1), share=st.sampled_from([0.01, 0.1, 0.4, 0.9]))
def test_any_mask_makes_blobs_of_its_own_pixels(seed: int, share: float) -> None:
    mask = ((np.random.default_rng(seed).random((90, 110)) < share) * 255).astype(np.uint8)
    blobs = find_blobs(mask, 30)
    u, v = blobs.pixels.astype(int).T
    closed = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    assert (closed[v, u] > 0).all()
    assert (np.diff(blobs.label) >= 0).all()
    sizes = np.bincount(blobs.label, blobs.weight)
    assert blobs.weight.sum() <= (closed > 0).sum() + len(sizes) * sizes.max(initial=0) / 30


def test_tapes_of_a_furnished_room_are_in_the_mask() -> None:
    scene = arena_scene(640)
    image = render(scene, POSE, np.random.default_rng(1))
    table = FloorTable(scene.rig, 3.0)
    mask = _mask(image)
    bands, _ = _predict(table, scene, POSE)
    wide = bands[bands.half_width > 0.4]
    assert len(wide) > 60
    u, v = np.rint(wide.centre).astype(int).T
    assert (cv2.dilate(mask, np.ones((3, 3), np.uint8))[v, u] > 0).mean() > 0.9


@given(st.lists(st.integers(0, 3), min_size=1, max_size=40))
def test_runs_are_those_that_itertools_finds(numbers: list[int]) -> None:
    first, count = runs(np.array(numbers))
    expected = [(number, len(list(members))) for number, members in groupby(numbers)]
    assert [(numbers[at], n) for at, n in zip(first.tolist(), count.tolist())] == expected
    assert (first == np.cumsum(count) - count).all()
