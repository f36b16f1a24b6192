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
from nccs_pose.vision.bands import runs
import numpy as np
from numpy.typing import NDArray

# So many neighbours may share one cause of error (a block of JPEG, a tile); so may half a line (a
# shade along it, a row of tiles).
_BLOCK = 4
# An image shows few such sums, and the pose takes for its own what the longest have in common.
# What errs beyond the pixels' noise is a pattern, whose sums have about so much more variance than
# those of independent errors (found on simulated floors and JPEGs); that weighs like so many sums.
_PATTERN = 1.5
_WEIGHT = 5.0


def common_errors(
    residual: Array, sigma: Array, label: NDArray[np.intp],
) -> tuple[float, float]:
    """What the residuals of neighbours have in common.

    :param residual: residuals whitened by the pixels' noise (N,), along each line in order.
    :param sigma: their scale (N,), px.
    :param label: line (N,), ascending.
    :returns: the variance of sums over blocks of neighbours, or over halves of lines, against that
        of independent errors (1 for the pixels' noise alone); and the root mean square of the
        blocks' means beyond noise, px.
    """
    start, count = runs(label)
    variance = max(root_mean_square(residual) ** 2, 1e-12)
    # The fit has taken three degrees of freedom, here and from the sums.
    beyond = 1.0 - max(1, len(residual) - 3) / (len(residual) * variance)
    expected = 1.0 + _PATTERN * max(0.0, beyond)
    # Blocks go from each line's start; what is left at its end is in none.
    whole = count // _BLOCK
    blocks = int(whole.sum())
    begin = (start - _BLOCK * (np.cumsum(whole) - whole)).repeat(whole)
    member = (begin + _BLOCK * np.arange(blocks))[:, None] + np.arange(_BLOCK)
    e, in_px = residual[member], (residual * sigma)[member]
    # Beyond what independent errors of this size give the blocks' means.
    beyond_noise = _square(in_px.sum(axis=1)) - _square(in_px)
    misfit = math.sqrt(max(0.0, beyond_noise) / max(1, blocks)) / _BLOCK
    long = count > 1
    start, count = start[long], count[long]
    near, far = count // 2, count - count // 2
    total = np.zeros(len(residual) + 1)
    np.cumsum(residual, out=total[1:])
    middle = total[start + near]
    half = _square((middle - total[start]) / np.sqrt(near)) + _square(
        (total[start + count] - middle) / np.sqrt(far))
    return max(
        1.0, _in_common(_square(e.sum(axis=1)) / (_BLOCK * variance), blocks - 3, expected),
        _in_common(half / variance, 2 * len(start) - 3, expected)), misfit


def root_mean_square(values: Array) -> float:
    """Of N > 0 values (N,)."""
    return math.sqrt(_square(values) / len(values))


def _square(values: Array) -> float:
    """Sum of the squares of values of any shape."""
    return float(np.vdot(values, values))


def _in_common(squares: float, degrees: int, expected: float) -> float:
    """Variance of sums that have been seen in so many degrees of freedom, beside what is expected.

    :param squares: of all of them, over the variance that independent errors would give each.
    """
    if degrees < 1:
        return expected
    return (_WEIGHT * expected + squares) / (_WEIGHT + degrees)
