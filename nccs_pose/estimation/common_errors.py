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
from nccs_pose.vision.bands import in_whole_parts
import numpy as np
from numpy.typing import NDArray

# Stations farther apart than this many share little; their products would only add noise.
_LAGS = 2
# What the estimate's own uncertainty weighs: one unknown more makes the mean of its inverse right
# where errors are independent.
_UNCERTAIN = 1
# From few stations the correlation is not known; the claim is widened or narrowed no further.
_LIMIT = 1.2
# So many neighbours may share one cause of misfit (a block of JPEG, a tile).
_BLOCK = 4


def common_variance(residual: Array, leverage: Array, label: NDArray[np.intp]) -> float:
    """Variance per station of what the errors of many stations add up to in a fit.

    Neighbours err alike where a texture or a block of JPEG spans several, and against each other
    where the pixels' grid lies on the template in turns. With correlations c_k between stations k
    apart, the variance of long sums is 1 + 2 (c_1 + c_2 + ...) times that of independent errors.
    Few of them can be told from noise; exp(2 (c_1 + c_2)) is the same for small ones and stays
    positive. For large ones it is more: where neighbours have much in common (floors with texture,
    coarse JPEG), whole lines have too, which the pose takes for its own so that no residual shows
    it. On simulated images of all kinds squared errors of poses were what it says, to a seventh.

    Errors weigh what they do in the fit. A near tape tells most of a pose, and compared with the
    noise told it may err more than a far one (coarse JPEG, whose far tapes are all template) or
    less (a texture seen finely): the mean over all stations would be that of the far ones, which
    are many.

    What the fit takes out of the residuals is what they have in common: the stations' leverage,
    times this variance, from each square and each product. A little more stands for the
    uncertainty of the estimate, which makes the inverse of a covariance too large on average.

    :param residual: of the stations (N,), whitened, along each line in order.
    :param leverage: how far each one's error moves its own fit (N,), from 0 to 1.
    :param label: line (N,), ascending.
    :returns: 1 for independent errors as large as told; from exp(-2.4) to exp(2.4) times what
        independent errors of their size would come to.
    """
    fitted = max(float(leverage.sum()), 1e-12)
    taken = float(leverage.dot(leverage)) / fitted
    weighed = residual * np.sqrt(leverage)
    variance = max(_square(weighed) / (fitted * max(1.0 - taken, 1e-12)), 1e-12)
    shown = 0.0
    for lag in range(1, _LAGS + 1):
        along = (label[lag:] == label[:-lag]).astype(float)
        products = float((weighed[lag:] * weighed[:-lag]).dot(along))
        shown += products / max(float(leverage[lag:].dot(along)), 1e-12) / variance
    taken *= _LAGS * (1.0 + _UNCERTAIN / fitted)
    correlation = shown
    for _ in range(2):
        correlation = min(shown + taken * math.exp(2.0 * correlation), _LIMIT)
    return variance * math.exp(2.0 * max(correlation, -_LIMIT))


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
