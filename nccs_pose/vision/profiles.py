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

The image is read at its own pixels, each with its exact place s across the curve: reading between
pixels would blur them and correlate their noise.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
import math

import cv2
from nccs_pose.geometry.pose import Array
from nccs_pose.vision.bands import Bands
from nccs_pose.vision.colour import LineColour
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

# Beyond the edges a band shows this much floor: so many px, and so many times the blur.
_MARGIN_PX = 2.6
_MARGIN_BLURS = 2.0
# Grid points along the curve, per px; dense enough that hardly a pixel is missed.
_DENSITY = 1.6
# A rough look takes fewer, and a softer template, which is felt from further away (px).
_ROUGH_DENSITY = 0.8
_ROUGH_BLUR = 0.6
# At most so many pixels of a station are looked for along and across.
_MOST_ALONG, _MOST_ACROSS = 32, 31
# Samples along the curve that one station of a search averages, as fractions of its spacing.
_ALONG_SEARCH = ((np.arange(4) + 0.5) / 4.0 - 0.5).astype(np.float32)
# Neighbouring stations of one tape differ in contrast by about this fraction (shade, texture).
_CONTRAST_SPREAD = 0.2
# Residuals this much above the usual are no chance any more.
_CHANCE = 2.5
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


def _read_pixels(
    image: NDArray[np.uint8], bands: Bands, margin: float, density: float,
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """The pixels nearest to a grid over each band: values (N, P, 3) and place across s (N, P), px.

    :param margin: beyond the edges, px.
    :param density: of the grid along the curve, per px.
    """
    # A point of the image is a complex number: (p - c) times the normal's conjugate has the place
    # across for its real part and the one along (backwards) for its imaginary part.
    centre = _as_complex(bands.centre)
    across = _as_complex(bands.across)
    bend = (0.5 * bands.bend).astype(np.float32)[:, None]
    half_band = (bands.half_width + margin).astype(np.float32)
    k = min(int(np.ceil(2.0 * float(half_band.max()))) + 1, _MOST_ACROSS)
    m = max(min(int(np.ceil(density * float(bands.spacing.mean()))), _MOST_ALONG), 2)
    t = bands.spacing.astype(np.float32)[:, None] * (
        (np.arange(m, dtype=np.float32) + 0.5) / m - 0.5)
    # The station's bit of curve is a parabola: c + t s + n k s^2 / 2.
    on_curve = centre[:, None] + (bend * t * t - 1j * t) * across[:, None]
    arm = (half_band[:, None] * np.linspace(-1.0, 1.0, k, dtype=np.float32)) * across[:, None]
    at = on_curve[:, :, None] + arm[:, None, :]
    pixels = np.rint(at.view(np.float32), out=at.view(np.float32)).reshape(-1, k, 2)
    values = cv2.remap(image, pixels, None, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
    n = len(bands)
    at = at.reshape(n, m * k)
    at -= centre[:, None]
    at *= across.conj()[:, None]
    return values.reshape(n, m * k, 3), at.real - bend * np.square(at.imag)


def _as_complex(points: Array) -> NDArray[np.complex64]:
    return np.ascontiguousarray(points, dtype=np.float32).view(np.complex64)[:, 0]


def _rise(x: NDArray[np.float32]) -> NDArray[np.float32]:
    """The normal distribution, less a half (good to 0.0003; ten times faster than exactly)."""
    cubic = np.square(x)
    cubic *= np.float32(0.0356774)
    cubic += np.float32(0.7978846)
    cubic *= x
    return np.multiply(np.tanh(cubic, out=cubic), np.float32(0.5), out=cubic)


def fit_profiles(
    image: NDArray[np.uint8], bands: Bands, colour: LineColour, *, rough: bool = False,
) -> tuple[ProfileFit, LineColour]:
    """Fit each station's profile, and learn how tapes look in this image.

    :param image: (H, W, 3) BGR.
    :param colour: what the tapes' contrast and blur are expected to be.
    :param rough: look at some of the pixels only, and learn nothing.
    """
    blur = np.float32(max(colour.blur, _ROUGH_BLUR) if rough else colour.blur)
    margin = _MARGIN_PX + _MARGIN_BLURS * float(blur)
    pixels, s = _read_pixels(image, bands, margin, _ROUGH_DENSITY if rough else _DENSITY)
    values = pixels.astype(np.float32)
    floor = values[:, 0].mean(axis=0)
    values -= floor
    wide = bands.half_width.astype(np.float32)[:, None]
    right, left = (s - wide) / blur, (s + wide) / blur
    steep_right, steep_left = (
        np.exp(np.float32(-0.5) * np.square(edge)) for edge in (right, left))
    templates = np.empty((len(s), 3, s.shape[1]), np.float32)
    np.subtract(_rise(left), _rise(right), out=templates[:, 0])
    np.subtract(steep_right, steep_left, out=templates[:, 1])
    templates[:, 1] *= np.float32(1.0 / np.sqrt(2.0 * np.pi)) / blur
    templates[:, 2] = s
    templates -= templates.mean(axis=2, keepdims=True)
    gram = (templates @ templates.transpose(0, 2, 1)).astype(float)
    matched = templates @ values
    power = np.maximum(gram[:, 0, 0], 1e-9)
    if not rough:
        outside = (np.abs(s) > wide + np.float32(2.0 * blur + 0.5)).astype(np.float32)
        colour = colour.learn(
            matched[:, 0] / power[:, None].astype(np.float32), power, values, outside, floor)
    weights = colour.discriminant.astype(np.float32)
    feature = values @ weights
    feature -= feature.mean(axis=1, keepdims=True)
    along = (matched @ weights).astype(float)
    square = np.einsum('nk,nk->n', feature, feature).astype(float)
    # Where the grid is finer than the pixels, each of them is counted several times.
    repeats = np.maximum(
        s.shape[1] / (bands.spacing * 2.0 * (bands.half_width + margin)), 1.0)
    fit = _shifts(bands.label, along, gram, square, s.shape[1], repeats)
    # A template beside its tape would take the misfit for blur.
    if not rough and float(np.median(np.abs(fit.shift))) < _SHARP_PX:
        soften = right * steep_right
        soften -= left * steep_left
        soften *= np.float32(1.0 / np.sqrt(2.0 * np.pi)) / blur
        colour = colour.sharpen(feature, along[:, 0] / power, templates[:, 0], power, soften)
    # An edge moves a template softer than itself by more than the template thinks.
    gain = math.sqrt(0.5 * (1.0 + (colour.blur / float(blur)) ** 2))
    return replace(fit, shift=gain * fit.shift, sigma=gain * fit.sigma), colour


def _shifts(
    label: NDArray[np.intp], matched: Array, gram: Array, square: Array, count: int,
    repeats: Array,
) -> ProfileFit:
    """Shifts and their noise by elimination: the tape's contrast, the floor's slope, the shift.

    :param matched: products (N, 3) of the feature with T, dT/d(delta) and s, their means taken
        out.
    :param gram: of these three with each other (N, 3, 3).
    :param square: of the feature with itself, its mean taken out (N,).
    :param count: of samples.
    :param repeats: how often each pixel is among them (N,).
    """
    power = np.maximum(gram[:, 0, 0], 1e-9)
    by_shift, by_slope = gram[:, 0, 1] / power, gram[:, 0, 2] / power
    height = matched[:, 0] / power
    slope_power = np.maximum(gram[:, 2, 2] - by_slope * gram[:, 0, 2], 1e-9)
    slope = matched[:, 2] - by_slope * matched[:, 0]
    crossed = gram[:, 1, 2] - by_shift * gram[:, 0, 2]
    own_power = np.maximum(gram[:, 1, 1] - by_shift * gram[:, 0, 1], 1e-9)
    own = matched[:, 1] - by_shift * matched[:, 0]
    share = crossed / slope_power
    shift_power = np.maximum(own_power - share * crossed, 1e-9)
    # What the four templates leave is noise, texture, and whatever crosses the station.
    left = (square - height * matched[:, 0] - slope * slope / slope_power
            - np.square(own - share * slope) / shift_power)
    variance = np.maximum(left / (count - 4), 1e-12)
    usual = float(np.median(variance))
    variance = np.maximum(variance / _CHANCE, usual)
    # A slope of the floor costs a wide tape much of what it tells. How far the slopes of all
    # stations exceed their noise says how much of each is to be believed.
    excess = max(float(np.mean(slope * slope / (slope_power * variance))) - 1.0, 0.0)
    share *= excess / (1.0 + excess)
    shift_power = np.maximum(own_power - share * crossed, 1e-9)
    variance *= repeats
    moved = (own - share * slope) / shift_power
    a = height - by_shift * moved
    told = power / variance
    level, certain = _levels(label, a, power, told)
    found = certain & (a + 1.0 / np.sqrt(told) > _FOUND_FRACTION * level)
    # One station's contrast is noisy where the tape is thin; its neighbours know better.
    prior = 1.0 / (_CONTRAST_SPREAD * level) ** 2
    smooth = np.maximum((a * told + level * prior) / (told + prior), 1e-9)
    return ProfileFit(
        moved / smooth, np.sqrt(variance / shift_power) / smooth, a / level, found)


def _levels(
    label: NDArray[np.intp], a: Array, weight: Array, told: Array,
) -> tuple[Array, NDArray[np.bool_]]:
    """Each station's expected contrast, its line's weighted median, and whether that is sure."""
    order = np.lexsort((a, label))
    lines, first = np.unique(label[order], return_index=True)
    total = np.cumsum(weight[order])
    begin = np.concatenate([[0.0], total[first[1:] - 1]])
    end = np.concatenate([total[first[1:] - 1], total[-1:]])
    level = a[order[np.minimum(
        np.searchsorted(total, 0.5 * (begin + end)), len(order) - 1)]]
    number = np.searchsorted(lines, label)
    # Far stations are faint one by one, but a whole line of them is not.
    certain = (level * np.sqrt(np.bincount(number, told)) > _FOUND) & (level > 0.1)
    return np.where(certain, level, 1e-9)[number], certain[number]


def search_profiles(
    image: NDArray[np.uint8], bands: Bands, colour: LineColour, reach: float,
) -> ProfileFit:
    """The best match of each station's profile anywhere within ``reach`` pixels across.

    For a prediction that is several pixels off; good to about a pixel.
    """
    half = float(np.percentile(bands.half_width, 75)) if len(bands) else 1.0
    kernel_half = int(np.ceil(half + 3.0))
    side = int(np.ceil(reach)) + kernel_half
    s = np.broadcast_to(
        np.arange(-side, side + 1.0, dtype=np.float32), (len(bands), 2 * side + 1))
    weights = colour.discriminant.astype(np.float32)
    feature = _sample(image, bands, s) @ weights
    k = np.arange(-kernel_half, kernel_half + 1.0)
    wide = bands.half_width[:, None]
    box = ndtr((k + wide) / colour.blur) - ndtr((k - wide) / colour.blur)
    box -= box.mean(axis=1, keepdims=True)
    power = np.maximum((box * box).sum(axis=1), 1e-9)
    box = (box / power[:, None]).astype(np.float32)
    windows = np.lib.stride_tricks.sliding_window_view(feature, len(k), axis=1)
    contrast = (windows @ box[:, :, None])[..., 0]
    # A tape goes on from station to station; a speck does not.
    pooled = cv2.blur(contrast, (1, 5)) if len(bands) > 5 else contrast
    best = pooled.argmax(axis=1)
    rows = np.arange(len(bands))
    height = contrast[rows, best]
    # From station to station the tape stays and the noise does not.
    noise = 1.4826 * float(np.median(np.abs(np.diff(contrast, axis=0)))) / np.sqrt(2.0)
    return ProfileFit(
        best - float(side - kernel_half), np.full(len(bands), 1.0), height.astype(float),
        height > max(_FOUND * noise, _FOUND_FRACTION))


def _sample(
    image: NDArray[np.uint8], bands: Bands, offsets: NDArray[np.float32],
) -> NDArray[np.float32]:
    """Image values (N, K, 3) at offsets (N, K) across each band, averaged along it."""
    n, k = offsets.shape
    across = _as_complex(bands.across)[:, None]
    t = bands.spacing.astype(np.float32) * _ALONG_SEARCH[:, None]
    on_curve = _as_complex(bands.centre) + (
        (0.5 * bands.bend).astype(np.float32) * t * t - 1j * t) * across[:, 0]
    at = (on_curve[..., None] + offsets * across).astype(np.complex64)
    values = cv2.remap(
        image, at.view(np.float32).reshape(len(t), n * k, 2), None, cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE)
    return cv2.reduce(values, 0, cv2.REDUCE_AVG, dtype=cv2.CV_32F).reshape(n, k, 3)
