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

"""The pixels of bands, and the products of profile templates with them.

The image is read at its own pixels, each with its exact place s across the curve: reading between
pixels would blur them and correlate their noise.
"""

from __future__ import annotations

from functools import cache
import math
from typing import NamedTuple

import cv2
from nccs_pose.geometry.pose import Array
from nccs_pose.vision.bands import Bands
import numpy as np
from numpy.typing import NDArray

# At most so many pixels of a station are looked for across.
_MOST_ACROSS = 31
# So many blurs from an edge its blur is nothing. A processor is slow with numbers so small or
# so large that they lose digits, as farther out it would be.
_BLURRED = 9.0
# With less blur than this, px, an edge shows that what blurs it is a square and no bell.
SHARP = 0.5


class Reading(NamedTuple):
    """The pixels nearest to a grid of P points over each of N bands.

    :ivar values: BGR (P, N, 3).
    :ivar place: of the pixels across the curve (N, P), px.
    :ivar margin: of floor beyond the edges that the grid covers, px.
    :ivar rows: of the grid along each station's piece of curve.
    """

    values: NDArray[np.uint8]
    place: NDArray[np.float32]
    margin: float
    rows: int

    def along(self, weights: Array) -> NDArray[np.float32]:
        """What the channels come to together, by weights (3,): (1, N, P)."""
        return cv2.transpose(cv2.transform(self.values.astype(np.float32), weights[None]))[None]


def read_pixels(
    image: NDArray[np.uint8], bands: Bands, margin: float, rows: int,
) -> Reading:
    """Read the pixels nearest to a grid over each band.

    All stations are read at one place of the grid before the next: what they show lies apart, so
    that the processor fetches it for several at a time.

    :param image: (H, W, 3) uint8 BGR.
    :param bands: of N stations.
    :param margin: beyond the edges, px.
    :param rows: of the grid along each station's piece of curve.
    """
    # A point of the image is a complex number: (p - c) times the normal's conjugate has the place
    # across for its real part and the one along (backwards) for its imaginary part.
    across = bands.across.view(np.complex128)[:, 0]
    half_band = bands.half_width + margin
    k = min(math.ceil(2.0 * float(half_band.max())) + 1, _MOST_ACROSS)
    bend, length = 0.5 * bands.bend, bands.spacing * across
    # The station's bit of curve is a parabola: c + t s + n k s^2 / 2.
    terms = np.array([
        bands.centre.view(np.complex128)[:, 0], half_band * across, -1j * length,
        bend * bands.spacing * length, across.conj()], dtype=np.complex64)
    # Real factors act on real and imaginary parts alike.
    pixels = _grid(rows, k) @ terms[:4].view(np.float32)
    np.rint(pixels, out=pixels)
    values = cv2.remap(image, pixels.reshape(-1, len(bands), 2), None, cv2.INTER_NEAREST,
                       borderMode=cv2.BORDER_REPLICATE)
    at = pixels.view(np.complex64)
    at -= terms[0]
    at *= terms[4]
    s = np.square(at.imag)
    s *= bend.astype(np.float32)
    return Reading(values, cv2.transpose(np.subtract(at.real, s, out=s)), margin, rows)


@cache
def _grid(rows: int, count: int) -> NDArray[np.float32]:
    """1, places across from -1 to 1, along from -1/2 to 1/2, and their squares (P, 4).

    :param rows: of places along, in the middles of equal parts.
    :param count: of places across.
    """
    along, across = np.meshgrid(
        (np.arange(rows) + 0.5) / rows - 0.5, np.linspace(-1.0, 1.0, count), indexing='ij')
    return np.stack(
        [np.ones_like(along), across, along, np.square(along)], axis=-1,
    ).reshape(-1, 4).astype(np.float32)


def profile_products(
    channels: NDArray[np.uint8] | NDArray[np.float32], s: NDArray[np.float32], half_width: Array,
    across: Array, blur: float, members: int,
) -> tuple[Array, NDArray[np.float32], NDArray[np.float32]]:
    """What stations and groups say, in the products of templates and image with each other.

    With left and right the distances from the two edges over the blur, T = Phi(left) - Phi(right)
    is the profile, D = dT/d(delta) and B = dT/d(blur), both times sqrt(2 pi) blur: for shifts and
    changes of the blur in :func:`derivative_unit`; s counts in blurs.

    Phi is the normal distribution. Of the edges of a sharp image, which a pixel's square blurs
    more than the lens, it is corrected by Edgeworth's series: a unit square has as seen along a
    direction (a, b) a fourth cumulant of -(a^4 + b^4) / 120 px^4, and what lens and motion add
    has hardly any. Otherwise a tape along the pixels' grid would seem to lie up to 0.06 px off,
    to and fro as it passes from row to row.

    :param channels: of the pixels (C, N, P), three or what they come to together.
    :param s: place of the pixels across the curve (N, P), px.
    :param half_width: of the tape (N,), px.
    :param across: unit normal of the curve (N, 2).
    :param blur: standard deviation of the edges' blur, px.
    :param members: stations of each group, one after the other.
    :returns: products of T, D, s, B and the channels with each other and with 1, summed over each
        group (4 + C, 5 + C, G); all of them and 1 by stations (5 + C, N, P); and the colour (C,)
        that the channels are less, about that of the floor.
    """
    n, count = s.shape
    rows = np.empty((8, n, count), np.float32)
    # What is filled last lends its place before: the less memory, the more of it is at hand.
    edges, place, powers = rows[:2], rows[2], rows[4:8]
    rise, square = powers[:2], powers[2:]
    np.multiply(s, 1.0 / blur, out=place)
    wide = (half_width / blur).astype(np.float32)[:, None]
    np.add(place, wide, out=edges[0])
    np.subtract(place, wide, out=edges[1])
    edges.clip(-_BLURRED, _BLURRED, out=edges)
    np.square(edges, out=square)
    # The logistic function of a cubic is the normal distribution to 0.0003.
    np.multiply(square, -0.0713548, out=rise)
    rise -= 1.5957692
    rise *= edges
    square *= -0.5
    # By OpenCV, quicker than numpy's.
    cv2.exp(powers.reshape(1, -1), powers.reshape(1, -1))
    sharp = _edgeworth(edges, square, across, blur) if blur < SHARP else None
    edges *= square
    np.subtract(edges[1], edges[0], out=rows[3])
    rise += 1.0
    np.reciprocal(rise, out=rise)
    np.subtract(rise[0], rise[1], out=rows[0])
    np.subtract(square[1], square[0], out=rows[1])
    if sharp is not None:
        for row, more in zip((rows[0], rows[1], rows[3]), sharp):
            row += more
    # Numbers about zero keep their digits in sums of squares; the first pixel shows floor.
    less = channels[:, 0, 0].astype(np.float32)
    rows = rows[:5 + len(channels)]
    np.subtract(channels, less[:, None, None], out=rows[4:-1])
    rows[-1] = 1.0
    # The ones stay out of one factor: a matrix times its own transpose goes a slower way.
    grouped = rows.reshape(len(rows), -1, members * count)
    pooled = grouped[:-1].transpose(1, 0, 2) @ grouped.transpose(1, 2, 0)
    return pooled.transpose(1, 2, 0).astype(float, order='C'), rows, less


def products_by_shift(rows: NDArray[np.float32]) -> Array:
    """Products of all rows (R, N, P) with D of each station (R, N)."""
    by_shift = (rows.transpose(1, 0, 2) @ rows[1, :, :, None])[..., 0]
    return by_shift.T.astype(float, order='C')


def _edgeworth(
    edges: NDArray[np.float32], bell: NDArray[np.float32], across: Array, blur: float,
) -> NDArray[np.float32]:
    """What a pixel's square adds to T, D and B (3, N, P).

    With k for the fourth cumulant over 24 and Hermite's polynomials He, Phi has -k He3(x) of its
    bell more, the bell k He4(x) and x times the bell k He5(x).

    :param edges: distances x from both edges over the blur (2, N, P).
    :param bell: exp(-x^2 / 2) of them.
    """
    cumulant = np.square(np.square(across)).sum(axis=1) / (-120.0 * blur**4)
    square, added = np.square(edges), np.empty((3, *edges.shape[1:]), np.float32)
    three, six, ten, fifteen = np.array([3.0, 6.0, 10.0, 15.0], np.float32)
    # All in one place, which the processor has at hand: He3, He4 and He5.
    value = square - three
    value *= edges
    value *= bell
    np.subtract(value[0], value[1], out=added[0])
    added[0] *= np.float32(1.0 / math.sqrt(2.0 * math.pi))
    np.subtract(square, six, out=value)
    value *= square
    value += three
    value *= bell
    np.subtract(value[0], value[1], out=added[1])
    np.subtract(square, ten, out=value)
    value *= square
    value += fifteen
    value *= edges
    value *= bell
    np.subtract(value[0], value[1], out=added[2])
    added *= (cumulant / -24.0).astype(np.float32)[:, None]
    return added


def derivative_unit(blur: float) -> float:
    """What a unit of a template's derivative stands for, px."""
    return math.sqrt(2.0 * math.pi) * blur

