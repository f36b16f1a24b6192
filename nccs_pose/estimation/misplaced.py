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

"""Whether a line is seen beside the place where a pose says that it should be.

An occluded line is nowhere. One that lies a few pixels beside its place says that the map, the
rig or the pose is wrong, and the pixels cannot tell which.
"""

from __future__ import annotations

from dataclasses import dataclass

from nccs_pose.estimation.alignment import Alignment
from nccs_pose.geometry.floor_table import FloorTable
from nccs_pose.geometry.lines import LineMap
from nccs_pose.geometry.pose import Array
from nccs_pose.vision.bands import Bands
from nccs_pose.vision.colour import LineColour
from nccs_pose.vision.profile_search import search_profiles
from nccs_pose.vision.profiles import fit_profiles
import numpy as np
from numpy.typing import NDArray

# So many stations, and this part of all of a line's, have to agree on another place.
_LEAST_STATIONS = 10
_LEAST_SHARE = 0.5
# They agree within this, px.
_AGREE = 1.0
# Beside its place a line is when it is off by this, px, and by so many standard deviations; and by
# more than what surrounds a tape shifts it, the more the thinner it is: this over its width, px^2.
_BESIDE = 0.5
_EVIDENT = 5.0
_DISTURBED = 0.28
# It is in its place when it is off by less than this for certain, px.
_IN_PLACE = 0.5
# What shows less or more contrast than this, as fractions of the tapes', is no tape.
_CONTRAST = (0.35, 2.0)
# What lies this near another line, metres beyond its footprint, is that line.
_ON_ANOTHER = 0.05


@dataclass(frozen=True)
class Placement:
    """Where a line is seen.

    :ivar beside: how far beside its predicted place, px; None where it is not seen there.
    :ivar confirmed: whether it is certainly seen in its place.
    """

    beside: float | None = None
    confirmed: bool = False


def placement(
    image: NDArray[np.uint8], line: int, bands: Bands, moved: Array, colour: LineColour,
    reach: float, alignment: Alignment, line_map: LineMap, table: FloorTable,
) -> Placement:
    """Where a line is seen.

    :param line: its index in the map.
    :param bands: its stations, as the pose predicts them on a flat floor.
    :param moved: where height, roll and pitch move them (N,), px across.
    :param reach: how far beside its place it is looked for, px.
    """
    if len(bands) < _LEAST_STATIONS:
        return Placement()
    fit, _ = fit_profiles(image, bands, colour)
    if fit.found.sum() >= max(_LEAST_STATIONS, _LEAST_SHARE * len(bands)):
        mean, deviation = _mean_shift((fit.shift - moved)[fit.found], fit.sigma[fit.found])
        off = abs(mean)
        width = 2.0 * float(np.median(bands.half_width))
        if off <= max(_BESIDE, _DISTURBED / width, _EVIDENT * deviation):
            return Placement(confirmed=off + 2.0 * deviation < _IN_PLACE)
        shift, agree = np.full(len(bands), mean), fit.found
    else:
        shift, agree = _farther(image, bands, moved, colour, reach)
    if not agree.any() or _on_another(
            line, bands, shift + moved, agree, alignment, line_map, table):
        return Placement()
    return Placement(beside=float(np.mean(np.abs(shift[agree]))))


def _mean_shift(shift: Array, sigma: Array) -> tuple[float, float]:
    """Mean of shifts (N,) and its standard deviation, no less than they scatter."""
    weight = 1.0 / sigma**2
    mean = float(weight @ shift / weight.sum())
    spread = float(weight @ (shift - mean) ** 2) / len(shift)
    return mean, float(np.sqrt(max(1.0, spread) / weight.sum()))


def _farther(
    image: NDArray[np.uint8], bands: Bands, moved: Array, colour: LineColour, reach: float,
) -> tuple[Array, NDArray[np.bool_]]:
    """Shifts (N,) found anywhere in the band, and the stations that agree on one."""
    fit = search_profiles(image, bands, colour, reach)
    shift = fit.shift - moved
    fits = fit.found & (fit.contrast > _CONTRAST[0]) & (fit.contrast < _CONTRAST[1])
    along = np.linspace(-1.0, 1.0, len(bands))
    found = np.flatnonzero(fits)
    best = np.zeros(len(bands), dtype=bool)
    least = max(_LEAST_STATIONS, _LEAST_SHARE * len(bands))
    if len(found) < least:
        return shift, best
    # Straight beside its place, turned or not: the pair of stations that most others follow.
    first, last = np.triu_indices(len(found), 1)
    first, last = found[first], found[last]
    apart = np.flatnonzero(along[last] - along[first] > 0.5)[::7]
    for i, j in zip(first[apart], last[apart]):
        slope = (shift[j] - shift[i]) / (along[j] - along[i])
        follows = fits & (np.abs(shift - shift[i] - slope * (along - along[i])) <= _AGREE)
        if follows.sum() > best.sum():
            best = follows
    if best.sum() < least or np.mean(np.abs(shift[best])) < _AGREE:
        best = np.zeros(len(bands), dtype=bool)
    return shift, best


def _on_another(
    k: int, bands: Bands, shift: Array, agree: NDArray[np.bool_], alignment: Alignment,
    line_map: LineMap, table: FloorTable,
) -> bool:
    """Whether what is seen lies on another line of the map."""
    floor, jacobian = table.floor((bands.midline + shift[:, None] * bands.across)[agree])
    footprint = np.sqrt(np.einsum('pij,pij->p', jacobian, jacobian))
    at = alignment.pose.apply(floor)
    for other, line in enumerate(line_map):
        if other == k or line.colour != line_map[k].colour:
            continue
        direction = line.direction[:2]
        offset = at - line.start[:2]
        along = offset @ direction
        across = np.abs(offset @ np.array([-direction[1], direction[0]]))
        on = (across < _ON_ANOTHER + footprint) & (along > 0.0) & (along < line.length)
        if on.mean() > 0.5:
            return True
    return False
