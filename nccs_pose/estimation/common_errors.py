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

from itertools import pairwise
import math

from nccs_pose.geometry.pose import Array
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
    edges = [0, *(np.flatnonzero(np.diff(label)) + 1).tolist(), len(label)]
    variance = max(float(np.mean(residual**2)), 1e-12)
    # The fit has taken three degrees of freedom, here and from the sums.
    beyond = 1.0 - max(1, len(residual) - 3) / (len(residual) * variance)
    expected = 1.0 + _PATTERN * max(0.0, beyond)
    first = np.concatenate([
        np.arange(start, end - _BLOCK + 1, _BLOCK) for start, end in pairwise(edges)])
    blocks, misfit = 0.0, 0.0
    if len(first):
        e = residual[first[:, None] + np.arange(_BLOCK)]
        in_px = e * sigma[first[:, None] + np.arange(_BLOCK)]
        common = float(np.mean(np.square(in_px.mean(axis=1))))
        noise = float(np.mean(np.square(in_px))) / _BLOCK
        misfit = math.sqrt(max(0.0, common - noise))
        blocks = float(np.square(e.sum(axis=1)).sum()) / (_BLOCK * variance)
    halves = [part for start, end in pairwise(edges) if end > start + 1
              for part in ((start, (start + end) // 2), ((start + end) // 2, end))]
    total = np.concatenate([[0.0], np.cumsum(residual)])
    half = sum((total[end] - total[start]) ** 2 / (end - start) for start, end in halves)
    return max(
        1.0, _in_common(blocks, len(first) - 3, expected),
        _in_common(float(half) / variance, len(halves) - 3, expected)), misfit


def _in_common(squares: float, degrees: int, expected: float) -> float:
    """Variance of sums that have been seen in so many degrees of freedom, beside what is expected.

    :param squares: of all of them, over the variance that independent errors would give each.
    """
    if degrees < 1:
        return expected
    return (_WEIGHT * expected + squares) / (_WEIGHT + degrees)
