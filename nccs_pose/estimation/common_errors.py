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

# So many neighbours may share one cause of error (a block of JPEG, a tile); chance alone makes
# them look so once in so many standard deviations.
_BLOCK = 4
_CHANCE = 1.5
# So may half a line (a shade along it, a row of tiles). There are few of those: this many that err
# by chance alone are thought of beside them, and less than this is chance.
_THOUGHT = 1.0
_LEAST_COMMON = 1.2


def common_errors(
    residual: Array, sigma: Array, label: NDArray[np.intp],
) -> tuple[float, float]:
    """What the residuals of neighbours have in common.

    :param residual: whitened residuals (N,), along each line in order.
    :param sigma: their scale (N,), px.
    :param label: line (N,), ascending.
    :returns: the variance of sums over blocks of neighbours, or over halves of lines, against that
        of independent ones (1 for white noise); and the root mean square of the blocks' means
        beyond noise, px.
    """
    edges = [0, *(np.flatnonzero(np.diff(label)) + 1).tolist(), len(label)]
    variance = max(float(np.mean(residual**2)), 1e-12)
    factor, misfit = 1.0, 0.0
    first = np.concatenate([
        np.arange(start, end - _BLOCK + 1, _BLOCK) for start, end in pairwise(edges)])
    # The fit has taken three degrees of freedom out of the blocks.
    degrees = len(first) - 3
    if len(first):
        e = residual[first[:, None] + np.arange(_BLOCK)]
        in_px = e * sigma[first[:, None] + np.arange(_BLOCK)]
        common = float(np.mean(np.square(in_px.mean(axis=1))))
        noise = float(np.mean(np.square(in_px))) / _BLOCK
        misfit = math.sqrt(max(0.0, common - noise))
        together = float(np.square(e.sum(axis=1)).sum()) / (_BLOCK * variance * max(degrees, 1))
        if degrees >= 3 and together > 1.0 + _CHANCE * math.sqrt(2.0 / degrees):
            factor = together
    halves = [part for start, end in pairwise(edges)
              for part in ((start, (start + end) // 2), ((start + end) // 2, end))]
    size = np.array([end - start for start, end in halves])
    degrees = len(halves) - 3
    if degrees >= 1 and size.min() >= 2:
        sums = np.add.reduceat(residual, [start for start, _ in halves])
        shared = float((np.square(sums) / size).sum()) / variance
        together = (_THOUGHT + shared) / (_THOUGHT + degrees)
        if together > _LEAST_COMMON:
            factor = max(factor, together)
    return factor, misfit
