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

"""Lines fainter than the noise of any one pixel, drawn where they are known to be."""

from __future__ import annotations

import math

import cv2
from nccs_pose.vision.faint_lines import faint_line_mask
from nccs_pose.vision.segment import raised_mask
import numpy as np
import pytest

SIZE, GATE, WINDOW = 160, 4.5, 15
NOISE, CONTRAST = 10.0, 20.0
FLOOR = np.full((SIZE, SIZE), 255, np.uint8)
NEAR = np.ones((5, 5), np.uint8)


def _along(degrees: float, reach: float) -> np.ndarray:
    """Pixels (N, 2) of a line through the middle, so far to either side as a part of the size."""
    angle = math.radians(degrees)
    step = reach * SIZE * np.array([math.cos(angle), math.sin(angle)])
    return np.rint(0.5 * SIZE + np.linspace(-1.0, 1.0, 81)[:, None] * step).astype(int)


def _image(degrees: float, contrast: float) -> np.ndarray:
    """A line three pixels wide in noise."""
    first, *_, last = _along(degrees, 0.4).tolist()
    line = cv2.line(np.zeros((SIZE, SIZE)), first, last, contrast, 3)
    noise = np.random.default_rng(int(degrees)).normal(100.0, NOISE, line.shape)
    return np.clip(np.rint(line + noise), 0, 255).astype(np.uint8)


def _covered(mask: np.ndarray, degrees: float) -> float:
    """Fraction of the line beside which, two pixels at most, there is some of a mask."""
    u, v = _along(degrees, 0.35).T
    return float(np.mean(cv2.dilate(np.uint8(mask > 0), NEAR)[v, u]))


@pytest.mark.parametrize('degrees', range(0, 180, 20))
def test_a_line_that_few_of_its_pixels_show_is_found_along_its_run(degrees: int) -> None:
    image = _image(degrees, CONTRAST)
    mask = faint_line_mask(image, FLOOR, GATE, WINDOW)
    assert _covered(mask, degrees) > 0.85
    assert _covered(raised_mask(image, 100.0, GATE, 0.0, WINDOW), degrees) < 0.5
    u, v = _along(degrees, 0.4).T
    beside = np.ones(mask.shape, np.uint8)
    beside[v, u] = 0
    beside = cv2.erode(beside, np.ones((9, 9), np.uint8))
    assert np.count_nonzero(mask[beside > 0]) < 0.002 * mask.size


def test_noise_alone_shows_next_to_nothing_and_nothing_is_seen_beside_the_floor() -> None:
    mask = faint_line_mask(_image(0.0, 0.0), FLOOR, GATE, WINDOW)
    assert np.count_nonzero(mask) < 0.002 * mask.size
    upper = FLOOR.copy()
    upper[SIZE // 2:] = 0
    mask = faint_line_mask(_image(90.0, 50.0), upper, GATE, WINDOW)
    assert mask[:SIZE // 2].any()
    assert not mask[SIZE // 2:].any()
