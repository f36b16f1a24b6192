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

"""Sub-pixel measurement of tapes by their profile across predicted bands.

Across a tape the image goes from floor to tape at one edge and back at the other; blurred by
the pixel and the lens, the profile is b + b1 s + a T(s - delta) with T the blurred box between
the two predicted edges. One fit serves tapes of ten pixels, whose edges are resolved, and of
half a pixel, of which only the coverage is seen. What is measured is the shift delta of both
edges from where the pose says; at the true pose it is zero for each, so that no middle of a
blob has to be believed.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
from nccs_pose.geometry.pose import Array
from nccs_pose.vision.bands import Bands
from nccs_pose.vision.colour import LineColour
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

# Samples along the curve that one station averages, as fractions of its spacing.
_ALONG = np.array([-0.375, -0.125, 0.125, 0.375])
# Beyond the edges the band shows this much floor, px: enough for the blur and for a slope.
_MARGIN = 4.5
# Half of the number of samples across; wider bands are sampled more coarsely.
_HALF_SAMPLES = 12
# Neighbouring stations of one tape differ in contrast by about this fraction (shade, texture).
_CONTRAST_SPREAD = 0.2
# The blur is learned from bands that lie this well on their tapes, px.
_SHARP_PX = 0.3
# A line whose contrast is this many standard deviations above nothing is there.
_FOUND = 6.0
# A line this much fainter than its colour's contrast, or a station than its line, is not.
_FOUND_FRACTION = 0.35


@dataclass(frozen=True, eq=False)
class ProfileFit:
    """What N stations say.

    :ivar shift: delta (N,), px along ``across``.
    :ivar sigma: its standard deviation (N,), px.
    :ivar contrast: height of the profile over that of its line (N,); 1 is as expected.
    :ivar found: whether a tape is there at all (N,).
    """

    shift: Array
    sigma: Array
    contrast: Array
    found: NDArray[np.bool_]


def sample(image: NDArray[np.uint8], bands: Bands, offsets: Array) -> Array:
    """Image values across each band, averaged along it.

    :param image: (H, W, 3) BGR.
    :param offsets: where to sample across each station (N, K), px.
    :returns: (N, K, 3) float32.
    """
    step = bands.spacing[:, None] * _ALONG
    # The station's bit of curve is a parabola: c + t s + n k s^2 / 2.
    on_curve = (bands.centre[:, None] + step[..., None] * bands.along[:, None]
                + (0.5 * bands.bend[:, None] * step**2)[..., None] * bands.across[:, None])
    at = on_curve[:, :, None] + offsets[:, None, :, None] * bands.across[:, None, None]
    at = at.astype(np.float32).reshape(len(bands), -1, 2)
    values = cv2.remap(image, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return values.reshape(len(bands), len(_ALONG), -1, 3).mean(axis=1, dtype=np.float32)


def fit_profiles(
    image: NDArray[np.uint8], bands: Bands, colour: LineColour,
) -> tuple[ProfileFit, LineColour]:
    """Fit each station's profile, and learn how tapes look in this image.

    The samples lie symmetrically about the middle of the edges, so the even unknowns (floor b,
    contrast a) and the odd ones (slope b1, shift a delta) separate.

    :param image: (H, W, 3) BGR.
    :param colour: what the tapes' contrast and blur are expected to be.
    """
    blur = colour.blur
    spread = np.maximum(1.0, (bands.half_width + _MARGIN) / _HALF_SAMPLES)
    s = spread[:, None] * np.arange(-_HALF_SAMPLES, _HALF_SAMPLES + 1)
    used = (np.abs(s) <= bands.half_width[:, None] + _MARGIN).astype(float)
    values = sample(image, bands, s).astype(float)
    left, right = (s + bands.half_width[:, None]) / blur, (s - bands.half_width[:, None]) / blur
    box = (ndtr(left) - ndtr(right)) * used
    at_left, at_right = (np.exp(-0.5 * edge**2) * used / (blur * np.sqrt(2 * np.pi))
                         for edge in (left, right))
    # d/d(delta) of T(s - delta), and dT/d(blur).
    slide = at_right - at_left
    soften = right * at_right - left * at_left
    count = used.sum(axis=1, keepdims=True)
    even = box - used * (box.sum(axis=1, keepdims=True) / count)
    ramp = s * used
    odd = slide - ramp * ((slide * ramp).sum(axis=1) / (ramp * ramp).sum(axis=1))[:, None]
    even_power = np.maximum((even * even).sum(axis=1), 1e-9)
    odd_power = np.maximum((odd * odd).sum(axis=1), 1e-9)
    height = np.einsum('nk,nkc->nc', even, values) / even_power[:, None]
    moved = np.einsum('nk,nkc->nc', odd, values) / odd_power[:, None]

    floor = np.einsum('nk,nkc->nc', used, values) / count
    slope = np.einsum('nk,nkc->nc', ramp, values) / (ramp * ramp).sum(axis=1)[:, None]
    residual = used[..., None] * (
        values - floor[:, None] - slope[:, None] * s[..., None]
        - height[:, None] * even[..., None] - moved[:, None] * odd[..., None])
    # What varies beside the tape (noise, texture, shade) is what its colour must stand out from.
    beside = used * (np.abs(s) > bands.half_width[:, None] + 2.0)
    mean = np.einsum('nk,nkc->nc', beside, values) / beside.sum(axis=1, keepdims=True)
    clutter = beside[..., None] * (values - mean[:, None])
    colour = colour.learn(height, even_power, clutter, beside)
    soften -= used * (soften.sum(axis=1, keepdims=True) / count)
    soften -= even * ((soften * even).sum(axis=1) / even_power)[:, None]
    fit = _shifts(bands, colour, height, moved, even_power, odd_power, residual, count)
    # A template beside its tape would take the misfit for blur.
    if float(np.median(np.abs(fit.shift))) < _SHARP_PX:
        colour = colour.sharpen(values, height, soften)
    return fit, colour


def _shifts(
    bands: Bands, colour: LineColour, height: Array, moved: Array, even_power: Array,
    odd_power: Array, residual: Array, count: Array,
) -> ProfileFit:
    """Shifts and their noise from the fitted heights, along the colour's discriminant."""
    weights = colour.discriminant
    a, a_delta = height @ weights, moved @ weights
    noise = np.einsum('nkc,c->nk', residual, weights)
    variance = (noise * noise).sum(axis=1) / np.maximum(count[:, 0] - 4.0, 1.0)
    usual = max(float(np.median(variance)), 1e-12)
    # A station crossed by something else (a joint, a shadow's edge) is as uncertain as it looks.
    variance = np.maximum(variance, usual)
    told = even_power / variance
    expected, found = np.full(len(a), 1e-9), np.zeros(len(a), dtype=bool)
    for k in np.unique(bands.label):
        on = bands.label == k
        level = _weighted_median(a[on], even_power[on])
        # Far stations are faint one by one, but a whole line of them is not.
        if level * np.sqrt(told[on].sum()) > _FOUND and level > 0.1:
            expected[on] = level
            found[on] = a[on] + 1.0 / np.sqrt(told[on]) > _FOUND_FRACTION * level
    # One station's contrast is noisy where the tape is thin; its neighbours know better.
    prior = 1.0 / (_CONTRAST_SPREAD * expected) ** 2
    smooth = np.maximum((a * told + expected * prior) / (told + prior), 1e-9)
    return ProfileFit(
        a_delta / smooth, np.sqrt(variance / odd_power) / smooth, a / expected, found)


def _weighted_median(values: Array, weights: Array) -> float:
    order = np.argsort(values)
    total = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(total, 0.5 * total[-1])])


def search_profiles(
    image: NDArray[np.uint8], bands: Bands, colour: LineColour, reach: float,
) -> ProfileFit:
    """The best match of each station's profile anywhere within ``reach`` pixels across.

    For a prediction that is several pixels off; good to about a pixel.
    """
    half = float(np.percentile(bands.half_width, 75)) if len(bands) else 1.0
    kernel_half = int(np.ceil(half + 3.0))
    side = int(np.ceil(reach)) + kernel_half
    s = np.broadcast_to(np.arange(-side, side + 1.0), (len(bands), 2 * side + 1))
    feature = sample(image, bands, s).astype(float) @ colour.discriminant
    k = np.arange(-kernel_half, kernel_half + 1.0)
    wide = bands.half_width[:, None]
    box = ndtr((k + wide) / colour.blur) - ndtr((k - wide) / colour.blur)
    box -= box.mean(axis=1, keepdims=True)
    power = np.maximum((box * box).sum(axis=1), 1e-9)
    windows = np.lib.stride_tricks.sliding_window_view(feature, len(k), axis=1)
    contrast = np.einsum('njk,nk->nj', windows, box) / power[:, None]
    # A tape goes on from station to station; a speck does not.
    pooled = cv2.blur(contrast, (1, 5)) if len(bands) > 5 else contrast
    best = pooled.argmax(axis=1)
    rows = np.arange(len(bands))
    height = contrast[rows, best]
    # From station to station the tape stays and the noise does not.
    noise = 1.4826 * float(np.median(np.abs(np.diff(contrast, axis=0)))) / np.sqrt(2.0)
    return ProfileFit(
        best - float(side - kernel_half), np.full(len(bands), 1.0), height,
        height > max(_FOUND * noise, _FOUND_FRACTION))
