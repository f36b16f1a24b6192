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

"""A pose made exact against one image: predict the bands, measure the profiles, refine."""

from __future__ import annotations

from dataclasses import dataclass, replace

from nccs_pose.errors import EstimationError
from nccs_pose.estimation.options import LocaliserOptions
from nccs_pose.estimation.prediction import predict_bands
from nccs_pose.estimation.refine import refine, Refinement
from nccs_pose.geometry.floor_table import FloorTable
from nccs_pose.geometry.lines import LineMap
from nccs_pose.geometry.pose import Array, Pose2, wrap_angle
from nccs_pose.vision.bands import Bands
from nccs_pose.vision.colour import LineColour
from nccs_pose.vision.line_points import LinePoints
from nccs_pose.vision.profiles import fit_profiles, ProfileFit, search_profiles
import numpy as np
from numpy.typing import NDArray

# A profile is linear in its shift for about so many pixels.
_LINEAR_PX = 2.0
_ITERATIONS = 8
# A measured shift is right to a fifth or better: the poses have settled when the last step was
# below one standard deviation of what was measured.
_SETTLED = 1.0
# What still steps at the end, by less than this (m and rad), is uncertain by that much more.
_LAST_STEP = 0.005
_LEAST_STATIONS = 12
# A line of so many stations, so wide in the image (px), of which less than this fraction is
# found, is missing.
_PLAIN_STATIONS = 15
_PLAIN_WIDTH = 1.0
_MISSING = 0.25
# Neighbours that may share one cause of error (a shade, a tile, a block of JPEG).
_BLOCK = 12


@dataclass(frozen=True, eq=False)
class Alignment:
    """A pose laid on an image.

    :ivar pose: T_map_base.
    :ivar covariance: of (x, y, yaw) (3, 3).
    :ivar refinement: the last solve.
    :ivar points: the pixels it rests on, labelled by map line.
    :ivar explained: fraction of the predicted line pixels that were found.
    :ivar lines: map lines that it rests on.
    :ivar missing: map lines that should be seen plainly and are not there.
    :ivar support: fraction of each map line's predicted stations that the pose rests on (L,);
        NaN where the line is not in view.
    :ivar misfit: root mean square by which whole stretches of lines lie off, beyond noise, px.
    :ivar colours: the colours as this image shows them.
    """

    pose: Pose2
    covariance: Array
    refinement: Refinement
    points: LinePoints
    explained: float
    lines: tuple[int, ...]
    missing: tuple[int, ...]
    support: Array
    misfit: float
    colours: tuple[LineColour, ...]


class Aligner:
    """Lays poses on images for one rig and map."""

    def __init__(self, table: FloorTable, line_map: LineMap, options: LocaliserOptions) -> None:
        self._table = table
        self._map = line_map
        self._options = options
        names = tuple(dict.fromkeys(line.colour for line in line_map))
        self._colour_of_line = np.array([names.index(line.colour) for line in line_map])
        self.nominal_colours = tuple(LineColour.nominal(name, options.blur) for name in names)

    def align(
        self,
        image: NDArray[np.uint8],
        start: Pose2,
        colours: tuple[LineColour, ...],
        *,
        reach: float = 0.0,
        prior: tuple[Pose2, Array] | None = None,
    ) -> Alignment | None:
        """Lay a pose on the image from a start near it.

        :param image: (H, W, 3) uint8 BGR.
        :param reach: search bands of this half width first, px; 0 where the start is within two
            pixels.
        :param prior: carries the directions that the lines in view do not fix.
        :returns: None where too little of what the start predicts is found, or where the poses do
            not settle.
        """
        pose = start
        if reach > 0.0:
            searched = self._search(image, start, colours, reach, prior)
            if searched is None:
                return None
            pose = searched
        result: Alignment | None = None
        for _ in range(_ITERATIONS):
            bands = self._bands(pose)
            if len(bands) < _LEAST_STATIONS:
                return None
            fit, colours = self._fit(image, bands, colours)
            result = self._solve(bands, fit, pose, prior, colours)
            if result is None:
                return None
            step = result.pose.as_array() - pose.as_array()
            step[2] = wrap_angle(step[2])
            settled = close(result.pose, pose, result.covariance, _SETTLED)
            pose = result.pose
            if settled:
                return result
        if result is None or np.abs(step).max() > _LAST_STEP:
            return None
        # Stations that come and go near their thresholds can keep it stepping to and fro.
        return replace(result, covariance=result.covariance + np.outer(step, step))

    def _bands(self, pose: Pose2) -> Bands:
        return predict_bands(self._table, self._map, pose, self._options.stations)

    def _fit(
        self, image: NDArray[np.uint8], bands: Bands, colours: tuple[LineColour, ...],
    ) -> tuple[ProfileFit, tuple[LineColour, ...]]:
        """Fit the bands of each colour with that colour."""
        if len(colours) == 1:
            fit, learned = fit_profiles(image, bands, colours[0])
            return fit, (learned,)
        n = len(bands)
        shift, sigma, contrast = np.zeros(n), np.ones(n), np.zeros(n)
        found = np.zeros(n, dtype=bool)
        learned_all = list(colours)
        for k, colour in enumerate(colours):
            own = self._colour_of_line[bands.label] == k
            if own.any():
                fit, learned_all[k] = fit_profiles(image, bands[own], colour)
                shift[own], sigma[own], contrast[own] = fit.shift, fit.sigma, fit.contrast
                found[own] = fit.found
        return ProfileFit(shift, sigma, contrast, found), tuple(learned_all)

    def _search(
        self, image: NDArray[np.uint8], start: Pose2, colours: tuple[LineColour, ...],
        reach: float, prior: tuple[Pose2, Array] | None,
    ) -> Pose2 | None:
        bands = self._bands(start)
        pixels, labels = [], []
        for k, colour in enumerate(colours):
            own = bands[self._colour_of_line[bands.label] == k]
            if len(own) < _LEAST_STATIONS:
                continue
            fit = search_profiles(image, own, colour, reach)
            moved = own.midline + fit.shift[:, None] * own.across
            pixels.append(moved[fit.found])
            labels.append(own.label[fit.found])
        if sum(len(label) for label in labels) < _LEAST_STATIONS:
            return None
        found = self._refined(
            np.concatenate(pixels), np.ones(sum(map(len, labels))), np.concatenate(labels),
            start, prior)
        return None if found is None else found[0].pose

    def _refined(
        self, pixels: Array, sigma: Array, label: NDArray[np.intp], start: Pose2,
        prior: tuple[Pose2, Array] | None,
    ) -> tuple[Refinement, NDArray[np.bool_]] | None:
        """Refine on pixels; returns the solve and which pixels it used, or None."""
        rays = self._table.rig.back_project(pixels)
        hit = rays.hit
        try:
            return refine(
                rays[hit], self._map.directions[label[hit]], self._map.moments[label[hit]],
                start, sigma=sigma[hit], prior=prior, noise_known=False,
                calibration_sigma=self._options.calibration_sigma,
                attitude_sigma=(self._options.height_sigma, self._options.tilt_sigma)), hit
        except EstimationError:
            return None

    def _solve(
        self, bands: Bands, fit: ProfileFit, start: Pose2,
        prior: tuple[Pose2, Array] | None, colours: tuple[LineColour, ...],
    ) -> Alignment | None:
        used = fit.found & (np.abs(fit.shift) < _LINEAR_PX + 2.0 * fit.sigma)
        if used.sum() < _LEAST_STATIONS:
            return None
        pixels = (bands.midline + fit.shift[:, None] * bands.across)[used]
        label = bands.label[used]
        solved = self._refined(pixels, fit.sigma[used], label, start, prior)
        if solved is None:
            return None
        refinement, hit = solved
        index = np.flatnonzero(used)[hit][refinement.inlier]
        # A tape half a pixel wide shows half the contrast, and is missed half as badly.
        worth = bands.spacing * np.minimum(1.0, bands.half_width)
        scale = float(np.sqrt(np.mean(refinement.residual[refinement.inlier] ** 2)))
        points = LinePoints(
            pixels[hit][refinement.inlier], scale * fit.sigma[index], bands.label[index])
        residual = refinement.residual[refinement.inlier]
        correlation, misfit = _common_errors(residual, points.sigma / scale, points.label)
        return Alignment(
            refinement.pose, correlation * refinement.covariance, refinement, points,
            float(worth[index].sum() / worth.sum()),
            tuple(int(k) for k in np.unique(points.label)), _missing(bands, index),
            _support(bands, index, len(self._map)), misfit, colours)


def _support(bands: Bands, found: NDArray[np.intp], lines: int) -> Array:
    """Fraction of each line's stations that were found (L,), NaN where it has none."""
    predicted = np.bincount(bands.label, minlength=lines)
    rests = np.bincount(bands.label[found], minlength=lines)
    return np.where(predicted > 0, rests / np.maximum(predicted, 1), np.nan)


def _missing(bands: Bands, found: NDArray[np.intp]) -> tuple[int, ...]:
    """Lines that should be seen plainly, of which next to nothing is among the found stations."""
    missing = []
    for k in np.unique(bands.label):
        own = bands.label == k
        plain = own.sum() >= _PLAIN_STATIONS and np.median(
            2.0 * bands.half_width[own]) >= _PLAIN_WIDTH
        if plain and own[found].sum() < _MISSING * own.sum():
            missing.append(int(k))
    return tuple(missing)


def _common_errors(
    residual: Array, sigma: Array, label: NDArray[np.intp],
) -> tuple[float, float]:
    """What the residuals of neighbours have in common.

    :param residual: whitened residuals (N,), along each line in order.
    :param sigma: their scale (N,), px.
    :param label: line (N,).
    :returns: the variance of sums over blocks of neighbours against that of independent ones (1
        for white noise, up to the block's size where whole stretches err together), and the root
        mean square of the blocks' means beyond noise, px.
    """
    blocks = [own[first:first + _BLOCK] for own in
              (np.flatnonzero(label == k) for k in np.unique(label))
              for first in range(0, len(own) - _BLOCK + 1, _BLOCK)]
    if not blocks:
        return 1.0, 0.0
    e = residual[np.array(blocks)]
    off = (e * sigma[np.array(blocks)]).mean(axis=1)
    noise = np.mean(np.square(sigma * residual)) / _BLOCK
    misfit = float(np.sqrt(max(0.0, np.mean(np.square(off)) - noise)))
    if len(blocks) < 6:
        return 1.0, misfit
    # The fit has taken three degrees of freedom out of the blocks.
    per_residual = np.mean(np.square(e.sum(axis=1))) / _BLOCK * len(blocks) / (len(blocks) - 3)
    return float(max(1.0, per_residual / max(np.mean(residual**2), 1e-12))), misfit


def close(a: Pose2, b: Pose2, covariance: Array, sigmas: float) -> bool:
    """Whether two poses agree within so many standard deviations of a covariance (3, 3)."""
    difference = a.as_array() - b.as_array()
    difference[2] = wrap_angle(difference[2])
    return float(difference @ np.linalg.solve(covariance, difference)) <= sigmas**2
