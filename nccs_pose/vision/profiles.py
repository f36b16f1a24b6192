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
import math
from typing import NamedTuple

from nccs_pose.geometry.pose import Array
from nccs_pose.vision.bands import Bands, runs
from nccs_pose.vision.colour import LineColour
from nccs_pose.vision.median import upper_median
from nccs_pose.vision.profile_products import (
    derivative_unit,
    products_by_shift,
    profile_products,
    read_pixels,
    Reading,
    SHARP,
)
import numpy as np
from numpy.typing import NDArray

# Beyond the edges a band shows this much floor: so many px, and so many times the blur.
_MARGIN_PX = 2.6
_MARGIN_BLURS = 2.0
# Grid points along the curve, per px: enough to miss hardly a pixel of a sharp image. A soft one
# has been interpolated (lens, colour filter, JPEG), and its pixels repeat each other.
_DENSITY = 2.0
_DENSITY_BLUR = 0.62
_LEAST_DENSITY = 0.45
# A rough look takes fewer, and a softer template, which is felt from further away (px).
_ROUGH_DENSITY = 0.5
ROUGH_BLUR = 0.6
# At most so many rows of a station are looked for.
_MOST_ALONG = 40
# Neighbouring stations of one tape differ in contrast by about this fraction (shade, texture).
_CONTRAST_SPREAD = 0.2
# Residuals this much above the usual are no chance any more.
_CHANCE = 2.5
# The blur is learned from bands that lie this well on their tapes, px; where it is above one
# pixel it is seen, but not learned, from such as lie this many blurs off.
_SHARP_PX = 0.3
# By this much, px rms, the template errs of an edge that runs along the pixels' grid and is
# blurred by their squares alone; so much more blur, px^2, makes it e times less. Both are computed
# from squares covered exactly.
_GRID_ERROR = 0.018
_GRID_BLUR = 0.035
# A line whose contrast is this many standard deviations above nothing is there.
FOUND = 6.0
# A line this much fainter than its colour's contrast, or a station than its line, is not.
FOUND_FRACTION = 0.35
# A line that shows less of the tapes' contrast than this is clutter; less is asked of one thinner
# than a pixel, in proportion to its width.
_FAINT = 0.4


@dataclass(frozen=True, eq=False)
class ProfileFit:
    """What N stations say.

    :ivar shift: delta (N,), px along ``across``.
    :ivar sigma: its standard deviation (N,), px.
    :ivar found: whether a tape is there at all (N,).
    """

    shift: Array
    sigma: Array
    found: NDArray[np.bool_]


def read_bands(
    image: NDArray[np.uint8], bands: Bands, colour: LineColour, *, rough: bool = False,
) -> Reading:
    """Read the pixels that :func:`fit_profiles` fits.

    :param image: (H, W, 3) BGR.
    :param colour: as expected; how blurred tapes are says how many pixels tell of them.
    :param rough: read some of the pixels only.
    """
    blur = _template_blur(colour, rough)
    margin = _MARGIN_PX + _MARGIN_BLURS * blur
    density = _ROUGH_DENSITY if rough else max(
        min(_DENSITY, _DENSITY_BLUR / blur), _LEAST_DENSITY)
    rows = max(min(round(density * float(bands.spacing.sum()) / len(bands)), _MOST_ALONG), 1)
    return read_pixels(image, bands, margin, rows)


def fit_profiles(
    reading: Reading, bands: Bands, colour: LineColour, *, rough: bool = False,
) -> tuple[ProfileFit, LineColour]:
    """Fit each station's profile, and learn how tapes look in this image.

    :param reading: of these bands.
    :param colour: what the tapes' contrast and blur are expected to be.
    :param rough: learn nothing, and take a softer template.
    """
    blur = _template_blur(colour, rough)
    pooled, rows, less = profile_products(
        reading.values.T, reading.place, bands.half_width, bands.across, blur, bands.members)
    system = _eliminated(pooled, bands.members * rows.shape[2])
    if not rough:
        floor = less + system.floor.sum(axis=1) / system.floor.shape[1]
        colour = colour.learn(system.height, system.power, system.left, floor)
    groups = _grouped(system, reading, bands, colour.discriminant)
    gain, colour = _gain(groups, system, colour, blur, rough)
    by_station = _by_station(groups, pooled, products_by_shift(rows), colour.discriminant)
    shift, sigma = gain * by_station
    if blur < SHARP:
        sigma = np.hypot(sigma, _grid_error(bands, blur))
    # Blur draws a bent edge towards the inside of the bend.
    shift -= 0.5 * colour.blur**2 * bands.bend
    return ProfileFit(shift, sigma, groups.found.repeat(bands.members)), colour


def fit_again(
    reading: Reading, bands: Bands, colour: LineColour, beside: Array, *, rough: bool = False,
) -> tuple[Array, NDArray[np.bool_], LineColour]:
    """Fit the profile of each group as a whole, from where a first fit has it.

    A profile is true to small shifts only; measured again from there, nothing is left to miss.

    :param reading: of these bands.
    :param colour: as the first fit has learned it.
    :param beside: how far beside the bands the tapes are expected (N,), px; less than the margin.
    :param rough: as in the first fit.
    :returns: shift of each group from the bands (G,), px; it is the mean of its stations', each
        weighed by its variance; whether a tape is there at all (G,); and the blur learned.
    """
    blur = _template_blur(colour, rough)
    place = reading.place - beside.astype(np.float32)[:, None]
    # What the tapes look like is known: the channels count no more one by one.
    pooled, rows, _ = profile_products(
        reading.along(colour.discriminant), place, bands.half_width, bands.across, blur,
        bands.members)
    system = _eliminated(pooled, bands.members * rows.shape[2])
    groups = _grouped(system, reading, bands, np.ones(1))
    gain, colour = _gain(groups, system, colour, blur, rough)
    expected = beside - 0.5 * colour.blur**2 * bands.bend
    shift = gain * groups.shared + expected.reshape(-1, bands.members).sum(axis=1) / bands.members
    return shift, groups.found, colour


def _template_blur(colour: LineColour, rough: bool) -> float:
    return max(colour.blur, ROUGH_BLUR) if rough else colour.blur


def _gain(
    groups: _Groups, system: _System, colour: LineColour, blur: float, rough: bool,
) -> tuple[float, LineColour]:
    """How many px a shift in units of D's comes to, and the colour with the blur learned.

    :param blur: of the template, px.
    """
    step = derivative_unit(blur)
    if rough:
        # A template softer than the edges by so much is felt from further away, and misses less.
        return step * math.sqrt(0.5 * (1.0 + (colour.blur / blur) ** 2)), colour
    softer, misfit = 0.0, step * upper_median(np.abs(groups.shared))
    # A template beside its tape would take the misfit for blur.
    if misfit < _SHARP_PX * max(1.0, blur):
        sharpened = colour.sharpen(groups.height, groups.softness, system.swept[3, 3], step)
        # The blur seen holds half the square of the shift over the template's.
        softer = sharpened.blur - blur - 0.5 * step**2 / blur * groups.beside
        # What lies no better is smeared by its noise. Edges as soft move a template as told
        # below, but one as soft as they would be noisier.
        if misfit < _SHARP_PX:
            colour = sharpened
    # An edge of blur b' moves a template of blur b by sqrt(2 b^2 / (b^2 + b'^2)) of its
    # shift, and leaves 1 less that of the template's derivative.
    return step / (1.0 - 0.5 * min(softer / blur, 1.0)), colour


def _grid_error(bands: Bands, blur: float) -> Array:
    """What the template of a sharp edge errs by, as the pixels' grid happens to lie (N,), px rms.

    Along the grid all pixels of a station show the edge from the same places; it averages out of
    one that passes from row to row.
    """
    passed = bands.spacing * np.abs(bands.across).min(axis=1)
    return _GRID_ERROR * math.exp((1.0 / 12.0 - blur**2) / _GRID_BLUR) * np.sinc(passed)


class _System(NamedTuple):
    """The normal equations of G groups after elimination: mean, contrast, floor's slope, shift.

    :ivar power: of T (G,).
    :ivar swept: of T, D, s, B and the C channels (columns) what mean and T leave of their products
        with each other (4 + C rows), then what they have of 1 and of T (6 + C, 4 + C, G).
    :ivar slope_power: of s in that (G,), and so of D, ``own_power``.
    :ivar left: covariance of the channels that no template explains (C, C, G).
    """

    power: Array
    swept: Array
    slope_power: Array
    own_power: Array
    left: Array

    @property
    def height(self) -> Array:
        """Contrast of each channel (C, G)."""
        return self.swept[-1, 4:]

    @property
    def floor(self) -> Array:
        """What each channel is beside the tape (C, G)."""
        return self.swept[-2, 4:]


def _eliminated(pooled: Array, size: int) -> _System:
    """Eliminate mean and T from the rest, and all four from the channels.

    :param pooled: products of T, D, s, B and the C channels with each other and with 1
        (4 + C, 5 + C, G).
    :param size: samples of each group.
    """
    columns, _, groups = pooled.shape
    total, swept = pooled[:, -1], np.empty((columns + 2, columns, groups))
    rest, means, both, shares = swept[:-2], swept[-2], swept[:-1], swept[-1]
    np.divide(total, size, out=means)
    np.multiply(means[:, None], total, out=rest)
    np.subtract(pooled[:, :-1], rest, out=rest)
    power = np.maximum(rest[0, 0], 1e-9)
    np.divide(rest[0], power, out=shares)
    both -= both[:, :1] * shares
    slope_power = np.maximum(rest[2, 2], 1e-9)
    own_power = np.maximum(rest[1, 1], 1e-9)
    crossed, slope, own = rest[1, 2], rest[2, 4:], rest[1, 4:]
    share = crossed / slope_power
    alone = own - share * slope
    alone_power = np.maximum(own_power - share * crossed, 1e-9)
    left = (rest[4:, 4:] - slope[:, None] * (slope / slope_power)
            - alone[:, None] * (alone / alone_power))
    return _System(power, swept, slope_power, own_power, left / (size - 4))


class _Groups(NamedTuple):
    """What G groups say along a colour's discriminant; shifts in units of D's.

    :ivar shared: shift of each (G,).
    :ivar found: whether a tape is there at all (G,).
    :ivar height: contrast of each, whatever its shift (G,).
    :ivar softness: its product with B, less T (G,).
    :ivar beside: mean square of the shifts, less that of their noise.
    :ivar base, tape, tilt: what its pixels are beside the tape, how much more on it, and how
        they slope across (G,).
    :ivar contrast: that its shift is of (G,).
    :ivar noise: variance of its shift, times the square of that (G,).
    """

    shared: Array
    found: NDArray[np.bool_]
    height: Array
    softness: Array
    beside: float
    base: Array
    tape: Array
    tilt: Array
    contrast: Array
    noise: Array


def _grouped(
    system: _System, reading: Reading, bands: Bands, weights: Array,
) -> _Groups:
    """Shifts of the groups by the channels' sum.

    :param weights: of the channels in it (C,).
    """
    count = reading.place.shape[1]
    half_width, spacing = bands.half_width[::bands.members], bands.spacing[::bands.members]
    # Where the grid is finer than the pixels, across or along, each is counted several times.
    repeats = np.maximum(reading.rows / spacing, 1.0) * np.maximum(
        0.5 * count / reading.rows / (half_width + reading.margin), 1.0)
    power, swept = system.power, system.swept
    crossed = swept[1, 2]
    seen = weights @ swept[:, 4:]
    own, slope = seen[1], seen[2]
    squares = (weights[:, None] * weights).ravel()
    variance = squares.dot(system.left.reshape(len(squares), -1))
    usual = max(upper_median(variance), 1e-12)
    # What crosses a station is as uncertain as it looks.
    variance = np.maximum(variance / _CHANCE, usual)
    # A slope of the floor costs a wide tape much of what it tells. How far the slopes of all
    # groups exceed their noise says how much of each is to be believed.
    excess = float((slope / (system.slope_power * variance)).dot(slope)) / len(slope) - 1.0
    belief = max(excess, 0.0) / (1.0 + max(excess, 0.0))
    believed = belief / system.slope_power
    share = believed * crossed
    shift_power = np.maximum(system.own_power - share * crossed, 1e-9)
    variance *= repeats
    moved = (own - share * slope) / shift_power
    beside = seen[-2:] - swept[-2:, 1] * moved
    a, told = beside[1], power / variance
    level, certain = _levels(bands.label[::bands.members], a, power, told, half_width)
    found = certain & (a + 1.0 / np.sqrt(told) > FOUND_FRACTION * level)
    # One group's contrast is noisy where the tape is thin; its neighbours know better.
    known = told * np.square(_CONTRAST_SPREAD * level)
    smooth = np.maximum((a * known + level) / (known + 1.0), 1e-9)
    tilt = believed * slope - share * moved
    base, tape = beside - swept[-2:, 2] * tilt
    # By what tells of the blur, and the contrasts that the shifts are of.
    total = swept[3, 3].dot(np.square(np.maximum(seen[-1], 0.0)))
    off = swept[3, 3].dot(np.square(moved) - variance / shift_power)
    return _Groups(
        moved / smooth, found, seen[-1], seen[3], max(float(off / max(total, 1e-9)), 0.0),
        base, tape, tilt, smooth, variance / shift_power)


def _by_station(groups: _Groups, pooled: Array, by_shift: Array, weights: Array) -> Array:
    """Shifts of N stations and their deviations (2, N), in units of D's.

    What each station's pixels say to D beside the floor and the contrast of its group; the
    weighted mean over the group is the group's own shift.

    :param pooled: products of T, D, s, B and the channels with each other and with 1 (7, 8, G).
    :param by_shift: the same of the stations with D (8, N).
    :param weights: the discriminant (3,).
    """
    members = by_shift.shape[1] // len(groups.base)
    base, tape, tilt, contrast, noise = np.array([
        groups.base, groups.tape, groups.tilt, groups.contrast, groups.noise * pooled[1, 1],
    ]).repeat(members, axis=1)
    said = (weights.dot(by_shift[4:7]) - tape * by_shift[0] - tilt * by_shift[2]
            - base * by_shift[7])
    own_power = np.maximum(by_shift[1], 1e-9)
    return np.array([said, np.sqrt(noise * own_power)]) / (own_power * contrast)


def _levels(
    label: NDArray[np.intp], a: Array, weight: Array, told: Array, half_width: Array,
) -> tuple[Array, NDArray[np.bool_]]:
    """Each group's expected contrast, its line's weighted median, and whether that is sure.

    :param label: line (G,), ascending.
    :param half_width: of the tape (G,), px.
    """
    first, count = runs(label)
    order = np.lexsort((a, label))
    total = weight.take(order).cumsum()
    half = total.take(first + count - 1) - 0.5 * np.add.reduceat(weight, first)
    level = a.take(order.take(total.searchsorted(half)))
    # Far stations are faint one by one, but a whole line of them is not.
    certain = (level * np.sqrt(np.add.reduceat(told, first)) > FOUND) & (
        level > _FAINT * np.minimum(1.0, 2.0 * np.add.reduceat(half_width, first) / count))
    return np.where(certain, level, 1e-9).repeat(count), certain.repeat(count)
