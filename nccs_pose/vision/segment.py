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

"""From an image to blobs that can be lines: colour threshold, morphology, contours."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
from nccs_pose.errors import VisionError
from nccs_pose.geometry.pose import Array
from nccs_pose.vision.colour import CONTRASTS
from nccs_pose.vision.median import noise_deviation, upper_median
import numpy as np
from numpy.typing import NDArray

Mask = NDArray[np.uint8]

# Hue, saturation, value ranges of OpenCV for the classes that have a hue; the paper's way.
_HSV_RANGES: dict[str, tuple[tuple[int, int, int], tuple[int, int, int]]] = {
    'green': ((40, 50, 40), (90, 255, 255)),
    'yellow': ((20, 80, 60), (35, 255, 255)),
    'blue': ((95, 80, 40), (130, 255, 255)),
    'magenta': ((140, 60, 40), (170, 255, 255)),
    'cyan': ((80, 60, 40), (100, 255, 255)),
}
# A pixel that rises by less than this over its surroundings, grey levels, may be rounding.
_LEAST_RISE = 2.0
# A pixel of a tape has this part of the highest contrast so near.
_PART_OF_PEAK = 0.45
_NEAR_PEAK = np.ones((5, 5), np.uint8)
# No tape is so wide that a square of this part of its surroundings' width, and of so many pixels,
# fits in it.
_SQUARE = 0.4
_LEAST_SQUARE = 7
# Blobs with a shorter outline are noise, px; one of a smaller image may be so short.
_SMALLEST = 8
_SMALLEST_REDUCED = 5
# More blobs than this are clutter; the longest are kept (a byte numbers them).
_MOST = 150


@dataclass(frozen=True, eq=False)
class Segmentation:
    """What in an image has the colour of a line.

    :ivar pixels: pixels (P, 2) of the blobs, u and v, at most a fixed number of each blob.
    :ivar place: of each in the mask, row by row (P,).
    :ivar label: blob of each (P,).
    :ivar weight: how many pixels of its blob each stands for (P,).
    :ivar pitch: side of what was one pixel when the blobs were found, px.
    """

    pixels: Array
    place: NDArray[np.intp]
    label: NDArray[np.intp]
    weight: Array
    pitch: int


def chromatic_mask(
    image: NDArray[np.uint8], colour: str, gate: float, least: float, window: int,
) -> Mask:
    """Where the image has more of a colour than its surroundings.

    The colour's contrast is a difference of channels (for white, their sum), so brightness and
    a cast that changes slowly over the image cancel; the threshold rises with the noise.

    :param image: (H, W, 3) uint8 BGR.
    :param gate: threshold in standard deviations of the image's noise.
    :param least: smallest contrast that counts, as a fraction of the image's brightness.
    :param window: width of the surroundings, px.
    """
    return raised_mask(contrast_of(image, colour), brightness(image), gate, least, window)


def brightness(image: NDArray[np.uint8]) -> float:
    """How bright an image (H, W, 3) uint8 BGR is, grey levels."""
    return upper_median(image[::8, ::8, 1])


def raised_mask(
    feature: Mask, bright: float, gate: float, least: float, window: int,
) -> Mask:
    """Where a feature stands out of its surroundings; see :func:`chromatic_mask`.

    :param feature: (H, W) uint8, high on tapes.
    :param bright: brightness of the image, grey levels.
    """
    feature = smoothed(feature)
    # Beside a dark thing the floor stands out of the mean of both, but to one side only: a square
    # fits in there. It does in a solid as well, which has to stay one.
    usual = upper_median(feature[::8, ::8])
    side = max(_LEAST_SQUARE, round(_SQUARE * window)) | 1
    opened = cv2.morphologyEx(feature, cv2.MORPH_OPEN, np.ones((side, side), np.uint8))
    around = cv2.max(cv2.blur(feature, (window, window)), cv2.min(opened, usual))
    # Of numbers shorter than 32 bits numpy finds the median in twice the time.
    some = feature[::4, ::4].astype(np.int32) - around[::4, ::4]
    noise = noise_deviation(some - int(upper_median(some)))
    threshold = max(_LEAST_RISE, gate * noise, least * bright)
    raised = cv2.subtract(feature, around)
    mask = cv2.threshold(raised, threshold, 255.0, cv2.THRESH_BINARY)[1]
    # Over its surroundings a solid would be high at its rim alone, over the floor it is as a
    # whole.
    height = cv2.subtract(feature, usual)
    peak = cv2.convertScaleAbs(
        cv2.dilate(height, _NEAR_PEAK), alpha=_PART_OF_PEAK)
    return cv2.bitwise_and(mask, cv2.compare(height, peak, cv2.CMP_GE))


def smoothed(feature: Mask) -> Mask:
    """A feature with less of the noise of single pixels; a tape a pixel wide stays."""
    return np.asarray(cv2.GaussianBlur(feature, (3, 3), 0.8))


def contrast_of(image: NDArray[np.uint8], colour: str) -> Mask:
    """A colour's contrast in each pixel, 128 (or the brightness, for white) where there is none.

    The mean of the channels that rise less that of those that fall, in whole grey levels.

    :param image: (H, W, 3) uint8 BGR.
    :returns: (H, W) uint8.
    """
    channels = cv2.split(image)
    rising, falling = ([channel for channel, sign in zip(channels, CONTRASTS[colour])
                        if sign * way > 0.0] for way in (1.0, -1.0))
    if not falling:
        return _mean(rising)
    if not rising:
        return cv2.bitwise_not(_mean(falling))
    return cv2.addWeighted(_mean(rising), 1.0, _mean(falling), -1.0, 128.0)


def _mean(channels: list[Mask]) -> Mask:
    mean = channels[0]
    for count, channel in enumerate(channels[1:], start=2):
        mean = cv2.addWeighted(mean, 1.0 - 1.0 / count, channel, 1.0 / count, 0.0)
    return mean


def hsv_mask(image: NDArray[np.uint8], colour: str) -> Mask:
    """Where hue, saturation and value lie in the colour's fixed ranges: the paper's threshold.

    :param image: (H, W, 3) uint8 BGR.
    :returns: (H, W) uint8, 255 where they do.
    :raises VisionError: if the colour has no hue.
    """
    if colour not in _HSV_RANGES:
        raise VisionError(
            f'colour {colour!r} has no hue range; use the chromaticity threshold for it')
    low, high = _HSV_RANGES[colour]
    return cv2.inRange(cv2.cvtColor(image, cv2.COLOR_BGR2HSV), low, high)


def find_blobs(
    mask: Mask, pixels_per_blob: int, *, pitch: int = 1, origin: tuple[int, int] = (0, 0),
) -> Segmentation:
    """Close small gaps and collect what lies within the contours of a mask.

    Tapes may be a pixel wide, so nothing is ever eroded.

    :param mask: (H, W) uint8, 255 inside.
    :param pitch: the mask is of an image so many times smaller; pixels and weights are given in
        those of the image itself.
    :param origin: column and row of the image where the mask begins.
    """
    closed = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    contours, _ = cv2.findContours(closed, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    smallest = _SMALLEST if pitch == 1 else _SMALLEST_REDUCED
    kept = sorted((c for c in contours if len(c) >= smallest), key=len, reverse=True)[:_MOST]
    # Filling the few contours that matter is far cheaper than labelling every pixel.
    filled = np.zeros_like(closed)
    for number, contour in enumerate(kept, start=1):
        cv2.drawContours(filled, [contour], -1, number, cv2.FILLED)
    cv2.bitwise_and(filled, closed, dst=filled)
    place = np.flatnonzero(filled != 0)
    number_of = filled.ravel()[place]
    # Of bytes the stable order costs one pass.
    order = np.argsort(number_of, kind='stable')
    blob = number_of[order].astype(np.intp) - 1
    size = np.bincount(blob, minlength=len(kept))
    stride = np.maximum(1, size // pixels_per_blob)
    first = np.cumsum(size) - size
    chosen = np.flatnonzero((np.arange(len(blob)) - first[blob]) % stride[blob] == 0)
    place, label = place[order[chosen]], blob[chosen]
    row, column = np.divmod(place, mask.shape[1])
    middle, pixels = 0.5 * (pitch - 1), np.empty((len(place), 2))
    pixels[:, 0] = pitch * column + (origin[0] + middle)
    pixels[:, 1] = pitch * row + (origin[1] + middle)
    return Segmentation(
        pixels, place, label, stride[label] * float(pitch * pitch), pitch)
