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

"""Errors that neighbours on a line share, which no number of them averages out."""

from __future__ import annotations

import math

from nccs_pose.geometry.pose import Array
from nccs_pose.vision.bands import in_whole_parts, runs
import numpy as np
from numpy.typing import NDArray

# What is alike among neighbours is so among whole lines too, by this power of e times the square
# of their correlations' sum; from few stations that is not known, and counts to a limit.
_REDDER = 2.5
_LIMIT = 0.7
# A claim from sums fewer than so many would be too uncertain for any correction.
_LEAST_FREEDOM = 5.0
# What a floor's texture makes alike reaches as far along a tape in a fine image as in a coarse
# one: about so many sums of neighbours, not more of shorter stretches.
_SUMS = 40
# So many neighbours may share one cause of misfit (a block of JPEG, a tile).
_BLOCK = 4


def common_variance(
    residual: Array, leverage: Array, label: NDArray[np.intp], first: NDArray[np.intp],
) -> float:
    """Variance per station of what the errors of many stations add up to in a fit.

    Neighbours err alike where a texture or a block of JPEG spans several, and against each other
    where the pixels' grid lies on the template in turns. The sums of whole groups of neighbours
    hold all of that, however far it reaches within them; see :func:`sums_of_neighbours`.

    Errors weigh what they do in the fit. A near tape tells most of a pose, and compared with the
    noise told it may err more than a far one (coarse JPEG, whose far tapes are all template) or
    less (a texture seen finely): the mean over all stations would be that of the far ones, which
    are many.

    What the fit takes out of the residuals is what they have in common: of a group's square as
    much as the group moves its own fit, its stations' leverage together. Sums few in number make
    the inverse of a covariance too large on average; F of them by F / (F - 2).

    Errors that are alike farther than a group reaches hide in the pose, which takes for its own
    what whole lines have in common. They go with such as show: floors with texture and coarse
    JPEG have both. With correlations c_k between stations k apart, on simulated images of all
    kinds, sums over lines had about exp(2.5 (c_1 + c_2)^2) times the variance of sums over groups.
    Where that scatters it makes the inverse too large as well: an exponent with a variance of s^2
    by exp(s^2 / 2).

    :param residual: of the stations (N,), whitened, along each line in order.
    :param leverage: how far each one's error moves its own fit (N,), from 0 to 1; 0 of one that
        has no part in it.
    :param label: line (N,), ascending.
    :param first: station of each sum (G,), ascending from 0; none is of two lines.
    :returns: 1 for independent errors as large as told.
    """
    weighed = np.empty((2, len(residual)))
    error = np.sqrt(leverage, out=weighed[0])
    error *= residual
    weighed[1] = leverage
    sums, shares = np.add.reduceat(weighed, first, axis=1)
    fitted, shared = max(float(shares.sum()), 1e-12), _square(shares)
    left = max(fitted - shared, 0.0)
    taken = float(leverage.dot(leverage)) / fitted
    variance = max(_square(error) / (fitted * max(1.0 - taken, 1e-12)), 1e-12)
    freedom = max(fitted * left / max(shared, 1e-24), _LEAST_FREEDOM)
    # One group more, of independent errors: what few groups say is not all.
    own = fitted / len(first)
    together = (_square(sums) + own * variance) / (left + own) * freedom / (freedom - 2.0)
    # Of three neighbours the first with the two others.
    along = (label[2:] == label[:-2]).astype(float)
    products = float((error[1:-1] + error[2:]).dot(error[:-2] * along))
    shown = products / max(float(leverage[:-2].dot(along)), 1e-12)
    alike = min(max((shown + 2.0 * taken * together) / variance, 0.0), _LIMIT)
    # Less what independent errors of so many stations show by chance.
    chance = 2.0 * taken / fitted
    square = max(alike**2 - chance, 0.0)
    # The correlations scatter by as much; at most, as if all up to the limit were equally likely.
    scatter = min(4.0 * square * chance, _LIMIT**4 / 12.0)
    return together * math.exp(_REDDER * square + 0.5 * _REDDER**2 * scatter)


def sums_of_neighbours(
    first: NDArray[np.intp], label: NDArray[np.intp],
) -> NDArray[np.intp]:
    """First stations of about _SUMS sums; of small groups, in a fine image, each is of several.

    :param first: station of each group (G,), ascending from 0; no group is of two lines.
    :param label: line of the stations (N,), ascending.
    """
    several = round(len(first) / _SUMS)
    if several < 2:
        return first
    begin, count = runs(label.take(first))
    within = np.arange(len(first)) - begin.repeat(count)
    return first[within % several == 0]


def common_misfit(offset: Array, label: NDArray[np.intp]) -> float:
    """Root mean square by which stretches of lines lie off beyond what their noise explains, px.

    :param offset: of stations or groups (N,), px, along each line in order.
    :param label: line (N,), ascending.
    """
    blocks = offset[in_whole_parts(label, _BLOCK)].reshape(-1, _BLOCK)
    # Beyond what independent errors of this size give the blocks' means.
    beyond_noise = _square(blocks.sum(axis=1)) - _square(blocks)
    return math.sqrt(max(0.0, beyond_noise) / max(1, len(blocks))) / _BLOCK


def root_mean_square(values: Array) -> float:
    """Of N > 0 values (N,)."""
    return math.sqrt(_square(values) / len(values))


def _square(values: Array) -> float:
    """Sum of the squares of values of any shape."""
    flat = values.ravel()
    return float(flat.dot(flat))
