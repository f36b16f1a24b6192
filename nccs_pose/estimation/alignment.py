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

"""A pose laid on an image: what one pass of measurements along its lines comes to."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from nccs_pose.estimation.common_errors import common_misfit, root_mean_square
from nccs_pose.estimation.observability import unobserved_directions
from nccs_pose.estimation.refine import Refinement
from nccs_pose.estimation.shift_solve import WeighedShifts
from nccs_pose.geometry.pose import Array, Pose2
from nccs_pose.geometry.small_matrices import solve_symmetric
from nccs_pose.vision.bands import Bands, runs
from nccs_pose.vision.colour import LineColour
from nccs_pose.vision.line_points import LinePoints
from nccs_pose.vision.profiles import ProfileFit
import numpy as np
from numpy.typing import NDArray

# A line of so many pixels of curve, so wide in the image (px), of which less than this fraction
# is found, is missing.
_PLAIN_LENGTH = 60.0
_PLAIN_WIDTH = 1.0
_MISSING = 0.25
# Lines that lie on an image with so small a mean square, px^2, show by themselves where they are.
_SHARP = 0.25
# A direction of the pose is open when its deviation exceeds this, metres and radians.
OPEN = 0.5


@dataclass(frozen=True, eq=False)
class Alignment:
    """A pose laid on an image.

    :ivar pose: T_map_base.
    :ivar covariance: of (x, y, yaw) (3, 3).
    :ivar refinement: the last solve.
    :ivar points: the pixels it rests on, labelled by map line.
    :ivar residual: of the points, whitened (N,).
    :ivar scale: root mean square residual, as a multiple of the noise.
    :ivar noise: of the image, by which they are whitened (N,), px.
    :ivar explained: fraction of the predicted line pixels that were found.
    :ivar lines: map lines that it rests on.
    :ivar missing: map lines that should be seen plainly and are not there.
    :ivar support: fraction of each map line's predicted stations that the pose rests on (L,);
        NaN where the line is not in view.
    :ivar whole: of each line of the map the first of those that look like one line with it (L,).
    :ivar offset: by which each group of neighbours lies off its line (G,), px.
    :ivar offset_label: line of each group (G,).
    :ivar colours: the colours as this image shows them.
    :ivar bands: all stations that were looked at.
    """

    pose: Pose2
    covariance: Array
    refinement: Refinement
    points: LinePoints
    residual: Array
    scale: float
    noise: Array
    explained: float
    lines: tuple[int, ...]
    missing: tuple[int, ...]
    support: Array
    whole: NDArray[np.intp]
    offset: Array
    offset_label: NDArray[np.intp]
    colours: tuple[LineColour, ...]
    bands: Bands

    @cached_property
    def misfit(self) -> float:
        """Root mean square by which whole stretches of lines lie off, beyond noise, px."""
        return common_misfit(self.offset, self.offset_label)

    @cached_property
    def width(self) -> Array:
        """Mean width of each map line's stations in the image (L,), px; NaN out of view."""
        label, lines = self.bands.label, len(self.support)
        seen = np.bincount(label, minlength=lines)
        return 2.0 * np.bincount(label, self.bands.half_width, lines) / np.where(
            seen > 0, seen, np.nan)

    @property
    def is_sharp(self) -> bool:
        """Whether lines lie so well on the image that it shows by itself where they are."""
        return self.points.variance < _SHARP

    @cached_property
    def residual_px(self) -> float:
        """Root mean square residual, px."""
        return root_mean_square(self.residual * self.noise)

    @cached_property
    def expected_px(self) -> float:
        """What the noise makes of it, px."""
        return root_mean_square(self.noise)


@dataclass(frozen=True, eq=False)
class Pass:
    """One pass: what the stations say, which of them are used, and the pose that follows.

    :ivar weighed: what the stations say, by the weights that they have.
    :ivar moved: how far the solve moves the station that it moves farthest, px.
    :ivar leant: how far height, roll and pitch alone move each (N,), px.
    :ivar whole: as of :class:`Alignment`.
    """

    weighed: WeighedShifts
    refinement: Refinement
    bands: Bands
    fit: ProfileFit
    used: NDArray[np.intp]
    moved: float
    leant: Array
    colours: tuple[LineColour, ...]
    whole: NDArray[np.intp]

    @cached_property
    def alignment(self) -> Alignment:
        """What it comes to if it is the last."""
        return _alignment_of(self)

    @property
    def length(self) -> float:
        """Of curve that the stations stand for where the tape was felt, px."""
        return float(self.bands.spacing.take(self.used).sum())


def _alignment_of(measured: Pass) -> Alignment:
    """What a last pass comes to."""
    bands, fit, refinement = measured.bands, measured.fit, measured.refinement
    lines = len(measured.whole)
    inlier, = refinement.inlier.nonzero()
    index = measured.used.take(inlier)
    # A tape half a pixel wide shows half the contrast, and is missed half as badly.
    share, spacing = np.minimum(1.0, bands.half_width), bands.spacing
    explained = spacing.take(index).dot(share.take(index)) / spacing.dot(share)
    residual = refinement.residual.take(inlier)
    sigma, label = fit.sigma.take(index), bands.label.take(index)
    scale = root_mean_square(residual)
    pixels = (bands.midline + fit.shift[:, None] * bands.across).take(index, axis=0)
    first, members = runs(index // bands.members)
    # Residuals of whole groups, times what noise the group has together.
    offset = np.add.reduceat(residual, first) / np.sqrt(
        members * np.add.reduceat(1.0 / np.square(sigma), first))
    seen, there = np.bincount(bands.label, minlength=lines), np.bincount(label, minlength=lines)
    return Alignment(
        refinement.pose, refinement.covariance, refinement,
        LinePoints(pixels, scale * sigma, label), residual, scale, sigma,
        float(explained), tuple(there.nonzero()[0].tolist()), _missing(bands, index, label),
        there / np.where(seen > 0, seen, np.nan), measured.whole, offset, label.take(first),
        measured.colours, bands)


def _missing(
    bands: Bands, found: NDArray[np.intp], label: NDArray[np.intp],
) -> tuple[int, ...]:
    """Lines that should be seen plainly, of which next to nothing is among the found stations.

    :param label: of these.
    """
    plain = bands.spacing * (bands.half_width >= 0.5 * _PLAIN_WIDTH)
    seen = np.bincount(bands.label, plain)
    there = np.bincount(label, plain.take(found), minlength=len(seen))
    return tuple(((seen >= _PLAIN_LENGTH) & (there < _MISSING * seen)).nonzero()[0].tolist())


def leaves_open(refinement: Refinement) -> bool:
    """Whether what a pose rests on leaves a direction of it open."""
    return bool(unobserved_directions(refinement.information, refinement.pose, limit=OPEN))


def close(a: Pose2, b: Pose2, covariance: Array, sigmas: float) -> bool:
    """Whether two poses agree within so many standard deviations of a covariance (3, 3)."""
    difference = a.minus(b)
    return float(difference.dot(solve_symmetric(covariance, difference))) <= sigmas**2
