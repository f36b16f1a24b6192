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

"""Tapes searched across bands many pixels wide, where a prediction is far off."""

from __future__ import annotations

import cv2
from nccs_pose.geometry.pose import Array
from nccs_pose.vision.bands import Bands
from nccs_pose.vision.colour import LineColour
from nccs_pose.vision.median import noise_deviation
from nccs_pose.vision.profiles import FOUND, FOUND_FRACTION, ProfileFit
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

# A tape goes on over so many stations; a speck does not.
_TOGETHER = 5
# Samples along the curve that one station averages, as fractions of its spacing.
_ALONG = ((np.arange(4) + 0.5) / 4.0 - 0.5).astype(np.float32)


def search_profiles(
    image: NDArray[np.uint8], bands: Bands, colour: LineColour, reach: float,
) -> ProfileFit:
    """The best match of each station's profile anywhere within ``reach`` pixels across.

    For a prediction that is several pixels off; good to about a pixel.

    :param image: (H, W, 3) uint8 BGR.
    :param bands: of N stations.
    :returns: what was found of each (N,).
    """
    offsets, contrast, _ = contrast_across(image, bands, colour, reach)
    together = _TOGETHER if len(bands) > _TOGETHER else 1
    pooled = cv2.blur(contrast, (1, together))
    best = pooled.argmax(axis=1)
    rows = np.arange(len(bands))
    # From station to station the tape stays and the noise does not.
    noise = noise_deviation(contrast[1:] - contrast[:-1]) / np.sqrt(2.0 * together)
    return ProfileFit(
        offsets[best], np.full(len(bands), 1.0),
        pooled[rows, best] > max(FOUND * noise, FOUND_FRACTION))


def contrast_across(
    image: NDArray[np.uint8], bands: Bands, colour: LineColour, reach: float, step: float = 1.0,
) -> tuple[Array, NDArray[np.float32], Array]:
    """How much of a tape there is at every place across each band.

    :param reach: how far to either side, px.
    :param step: from one place to the next, px.
    :returns: the places (K,), px; the contrast of the template there (N, K), 1 where it is a
        tape's; and the template's energy (N,), which that contrast's certainty grows with.
    """
    upper = 3 * len(bands) // 4
    half = float(np.partition(bands.half_width, upper)[upper]) if len(bands) else 1.0
    kernel_half = int(np.ceil((half + 3.0) / step))
    places = int(np.ceil(reach / step))
    side = places + kernel_half
    weights = colour.discriminant.astype(np.float32)
    feature = _sample(
        image, bands, np.arange(-side, side + 1.0, dtype=np.float32) * np.float32(step)) @ weights
    k = np.arange(-kernel_half, kernel_half + 1.0) * step
    box = _blurred(k, bands, colour)
    box -= box.mean(axis=1, keepdims=True)
    power = np.maximum((box * box).sum(axis=1), 1e-9)
    box = (box / power[:, None]).astype(np.float32)
    windows = np.lib.stride_tricks.sliding_window_view(feature, len(k), axis=1)
    contrast = (windows @ box[:, :, None])[..., 0]
    return np.arange(-places, places + 1.0) * step, contrast, power


def overlap(bands: Bands, colour: LineColour, shift: Array) -> Array:
    """How much of a tape there seems to be in its place when it is so far beside it (N,).

    :param shift: how far (N,), px.
    """
    side = 3.0 * colour.blur + float((np.abs(shift) + bands.half_width).max())
    k = np.linspace(-side, side, 65)
    here = _blurred(k, bands, colour)
    here -= here.mean(axis=1, keepdims=True)
    there = _blurred(k - shift[:, None], bands, colour)
    return np.asarray((here * there).sum(axis=1) / np.maximum((here * here).sum(axis=1), 1e-9))


def _blurred(at: Array, bands: Bands, colour: LineColour) -> Array:
    """A tape's profile (N, K), 1 inside, at places (K,) or (N, K) across it, px."""
    wide = bands.half_width[:, None]
    return np.asarray(ndtr((at + wide) / colour.blur) - ndtr((at - wide) / colour.blur))


def _sample(
    image: NDArray[np.uint8], bands: Bands, offsets: NDArray[np.float32],
) -> NDArray[np.float32]:
    """Image values (N, K, 3) at offsets (K,) across each band, averaged along it."""
    n, k = len(bands), len(offsets)
    across = _as_complex(bands.across)[:, None]
    t = bands.spacing.astype(np.float32) * _ALONG[:, None]
    on_curve = _as_complex(bands.centre) + (
        (0.5 * bands.bend).astype(np.float32) * t * t - 1j * t) * across[:, 0]
    at = on_curve[..., None] + offsets * across
    values = cv2.remap(
        image, at.view(np.float32).reshape(len(t), n * k, 2), None, cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE)
    return cv2.reduce(values, 0, cv2.REDUCE_AVG, dtype=cv2.CV_32F).reshape(n, k, 3)


def _as_complex(points: Array) -> NDArray[np.complex64]:
    """Points (N, 2) of the image as complex numbers u + iv (N,)."""
    return np.ascontiguousarray(points, dtype=np.float32).view(np.complex64)[:, 0]
