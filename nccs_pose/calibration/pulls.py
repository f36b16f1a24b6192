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

"""How much frames pull at a rig, and how much of that is chance.

A frame's pull is the slope g (P,) of half its squared whitened residuals by the rig, its pose left
free, and its curvature I (P, P) is what it knows of the rig. With independent noise as it was told
the pulls of many frames at the true rig scatter as their curvatures say. Errors that the points of
a frame share (clutter beside a tape, the way in which its profile is measured) make them scatter
more.
"""

from __future__ import annotations

from dataclasses import dataclass

from nccs_pose.geometry.pose import Array
import numpy as np


@dataclass(frozen=True)
class PullStatistics:
    """What the pulls of K frames come to, in units in which noise as told makes every part 1.

    :ivar squared: |sum of the pulls|^2, over the parts that the frames know at all.
    :ivar freedom: how many parts those are.
    :ivar scatter: squared scatter of the single pulls over that of noise as told, 1 if it is as
        told, once the step that the sum asks for is taken.
    :ivar degrees: degrees of freedom of a chi-square that scatters as much, over their number,
        as ``scatter`` does by chance.
    """

    squared: float
    freedom: int
    scatter: float
    degrees: float


def pull_statistics(slopes: Array, curvatures: Array, spread: Array) -> PullStatistics:
    """Judge pulls (K, P) with curvatures (K, P, P).

    :param spread: standard deviations of the rough values (P,); parts of the rig of which the
        frames know less than these are left out.
    """
    values, vectors = np.linalg.eigh(curvatures.sum(axis=0) * np.outer(spread, spread))
    seen = values > 1.0
    freedom = int(seen.sum())
    if not freedom:
        return PullStatistics(0.0, 0, 1.0, 0.0)
    units = spread[:, None] * vectors[:, seen] / np.sqrt(values[seen])
    pulls = slopes @ units
    shares = np.einsum('pi,kpq,qj->kij', units, curvatures, units)
    total = pulls.sum(axis=0)
    left = pulls - shares @ total
    # A frame that alone fixes some part has that part of its pull taken away by the step.
    expected = max(freedom - float(np.sum(shares**2)), 1e-3 * freedom)
    # What is left of frames k and l covaries as delta_kl S_k - S_k S_l, S their shares; the sum of
    # the squares has twice the squared norm of all that for its variance.
    squares = shares @ shares
    together = squares.sum(axis=0)
    norm = float(np.sum(shares**2) - 2.0 * np.sum(squares * shares) + np.sum(together**2))
    return PullStatistics(
        float(total @ total), freedom, float(np.sum(left**2)) / expected,
        expected**2 / max(norm, 1e-12))
