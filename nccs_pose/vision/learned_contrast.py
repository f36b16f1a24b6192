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

"""The colour difference that tells a tape best in one image, learned from a tape found in it.

A class of colour says little of an image: a green tape on a light floor is above all darker. What
the chromaticity has found of the tapes shows it, and then the rest is found by it, even where
compression has left no colour of a thin tape.
"""

from __future__ import annotations

import cv2
from nccs_pose.vision.colour import LineColour
from nccs_pose.vision.median import upper_median
from nccs_pose.vision.segment import Mask
import numpy as np
from numpy.typing import NDArray

# One pixel out of so many tells how the floor varies, without those this near a tape and without
# the most extreme of the others, which are things and not floor.
_SPARSE = 3
_NEAR = np.ones((9, 9), np.uint8)
_ORDINARY = 0.9
# Rounding and compression, grey levels^2.
_ROUNDING = 4.0


def learned_colour(
    colour: LineColour, image: NDArray[np.uint8],
    tape: tuple[NDArray[np.intp], NDArray[np.intp]], floor: Mask, window: int,
) -> LineColour:
    """What a colour is in an image; the colour as it was where that cannot be told.

    :param image: (H, W, 3) uint8 BGR.
    :param tape: rows and columns (N,) of pixels on tapes of the colour.
    :param floor: (H, W), not 0 where there is floor.
    :param window: width of the surroundings, px.
    """
    values = image.astype(np.float32)
    values -= cv2.blur(values, (window, window))
    on_tape = np.zeros(floor.shape, np.uint8)
    on_tape[tape] = 255
    beside = cv2.bitwise_and(floor, cv2.bitwise_not(cv2.dilate(on_tape, _NEAR)))
    sparse = beside[::_SPARSE, ::_SPARSE] > 0
    clutter = values[::_SPARSE, ::_SPARSE][sparse].astype(float)
    if len(clutter) == 0:
        return colour
    size = np.square(clutter).sum(axis=1)
    last = int(_ORDINARY * (len(size) - 1))
    clutter = clutter[size <= np.partition(size, last)[last]]
    # Of numbers shorter than 32 bits numpy finds the median in twice the time.
    usual = image[::_SPARSE, ::_SPARSE][sparse].astype(np.int32)
    return colour.taught(
        values[tape].mean(axis=0).astype(float),
        clutter.T @ clutter / len(clutter) + _ROUNDING * np.eye(3),
        np.array([upper_median(channel) for channel in usual.T]))


def feature_of(image: NDArray[np.uint8], colour: LineColour) -> Mask:
    """How much each pixel is like tape (H, W) uint8, 128 where the floor is as usual."""
    usual = np.median(image[::8, ::8].reshape(-1, 3), axis=0)
    weights = colour.discriminant
    weights = 2.0 * weights / float(np.abs(weights).sum())
    return np.asarray(cv2.transform(
        image, np.append(weights, 128.0 - weights @ usual)[None].astype(np.float32)))
