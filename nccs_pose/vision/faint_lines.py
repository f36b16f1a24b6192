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

"""Lines too faint to show in any one of their pixels.

Over n pixels in a row noise averages to a root of n less, and the contrast of a line does not:
what runs straight through an image for some pixels is looked for in every direction.
"""

from __future__ import annotations

import math

import cv2
from nccs_pose.vision.median import noise_deviation, upper_median
from nccs_pose.vision.segment import Mask, smoothed
import numpy as np
from numpy.typing import NDArray

# Directions, and how far the image of a line is straight to either side of a pixel, px: of a
# circle of a hundred it leaves the tangent by a quarter of a pixel there.
_DIRECTIONS = 12
_HALF = 7
# The fainter side has this part of the mean of both, or the line ends here.
_GOES_ON = 0.33
# What is beside a line is looked at so far from its middle, as a part of the surroundings' width,
# which is a few times the tapes'; and no closer than this, px.
_ASIDE = 0.2
_LEAST_ASIDE = 2
# A pixel counts no more than so many deviations of the noise: a bright thing is no long line.
_MOST = 3.0
# Rounding alone makes so much noise in a pixel, and so much of it is left in a line, grey levels.
_ROUNDING = (1.0, 0.25)
# One pixel out of so many tells the noise, each way.
_SPARSE = 3


def faint_line_mask(feature: Mask, floor: Mask, gate: float, window: int) -> Mask:
    """Where the floor has more of a feature along some line than to both sides of it.

    :param feature: (H, W) uint8, high on tapes.
    :param floor: (H, W) uint8, not 0 where there is floor.
    :param gate: threshold in standard deviations of what such lines show in noise.
    :param window: width of the surroundings, px.
    """
    sample = floor[::_SPARSE, ::_SPARSE] > 0
    height = smoothed(feature).astype(np.float32)
    # A median follows the rim of a thing, beside which a mean would be of both.
    height -= cv2.medianBlur(feature, window | 1)
    most = _MOST * max(noise_deviation(height[::_SPARSE, ::_SPARSE][sample]), _ROUNDING[0])
    np.clip(height, -most, most, out=height)
    shown, going_on = _ridges(height, max(round(_ASIDE * window), _LEAST_ASIDE))
    usual = shown[::_SPARSE, ::_SPARSE][sample]
    middle = upper_median(usual)
    least = middle + max(gate * noise_deviation(usual - middle), _ROUNDING[1])
    return cv2.bitwise_and(cv2.compare(going_on, least, cv2.CMP_GT), floor)


def _ridges(
    height: NDArray[np.float32], aside: int,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """How much more each pixel's best line has than the higher one of those beside it (H, W).

    :param aside: how far beside it these are, px.
    :returns: of all lines, and of those alone that go on to both sides of the pixel.
    """
    wide = cv2.copyMakeBorder(
        height, *4 * (aside + _HALF,), borderType=cv2.BORDER_REPLICATE)
    best = np.full(height.shape, -np.inf, np.float32)
    going_on = best.copy()
    for (x, y), row in _ROWS:
        means = cv2.filter2D(wide, cv2.CV_32F, row, borderType=cv2.BORDER_REPLICATE)
        half, across = 0.5 * (_HALF + 1), aside / math.hypot(x, y)
        ahead, behind = (_moved(means, k * x, k * y, _HALF) for k in (half, -half))
        both = cv2.add(ahead, behind)
        here, one, other = (
            _moved(both, -k * y, k * x, aside) for k in (0.0, across, -across))
        ridge = cv2.subtract(here, cv2.max(one, other))
        cv2.max(best, ridge, dst=best)
        fainter = _moved(cv2.min(ahead, behind), 0.0, 0.0, aside)
        goes_on = cv2.compare(fainter, np.float32(0.5 * _GOES_ON) * here, cv2.CMP_GT)
        cv2.max(going_on, cv2.copyTo(ridge, goes_on), dst=going_on)
    return 0.5 * best, 0.5 * going_on


def _moved(image: NDArray[np.float32], x: float, y: float, margin: int) -> NDArray[np.float32]:
    """What lies so far from each pixel, px, without a margin all round, px."""
    rows, columns = image.shape
    top, left = margin + round(y), margin + round(x)
    return image[top:top + rows - 2 * margin, left:left + columns - 2 * margin]


def _row(angle: float) -> tuple[tuple[float, float], NDArray[np.float32]]:
    """A step from pixel to pixel, (x, y), and weights of the mean over some of them in a row."""
    x, y = math.cos(angle), math.sin(angle)
    step = np.array([x, y]) / max(abs(x), abs(y))
    places = np.rint((np.arange(_HALF) - _HALF // 2)[:, None] * step).astype(int)
    places -= places.min(axis=0)
    weights = np.zeros(places.max(axis=0)[::-1] + 1, np.float32)
    weights[places[:, 1], places[:, 0]] = 1.0 / _HALF
    return (float(step[0]), float(step[1])), weights


_ROWS = tuple(_row(angle) for angle in (np.arange(_DIRECTIONS) * math.pi / _DIRECTIONS).tolist())
