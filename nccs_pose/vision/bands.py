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

"""Where in the image to look for tapes: narrow bands along predicted curves."""

from __future__ import annotations

from dataclasses import dataclass

from nccs_pose.geometry.pose import Array
import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Bands:
    """N stations along the predicted images of tapes.

    :ivar centre: middle between the tape's two predicted edges (N, 2), px.
    :ivar midline: predicted image of the tape's midline (N, 2), px; it is not the middle.
    :ivar across: unit normal of the curve (N, 2), towards the tape's left edge.
    :ivar bend: curvature of the curve towards ``across`` (N,), 1/px.
    :ivar half_width: half of the tape's width along ``across`` (N,), px.
    :ivar spacing: length of curve that the station stands for (N,), px.
    :ivar label: index of the line in the map (N,).
    :ivar members: how many neighbours on a line, one after the other, make a group, which shares
        all that is not shift: floor, contrast, noise. Every line has whole groups.
    """

    centre: Array
    midline: Array
    across: Array
    bend: Array
    half_width: Array
    spacing: Array
    label: NDArray[np.intp]
    members: int

    def __len__(self) -> int:
        return len(self.label)

    def __getitem__(self, index: NDArray[np.bool_]) -> Bands:
        """Some of them, whole lines or groups."""
        at = index.nonzero()[0]
        return Bands(
            self.centre.take(at, axis=0), self.midline.take(at, axis=0),
            self.across.take(at, axis=0), self.bend.take(at), self.half_width.take(at),
            self.spacing.take(at), self.label.take(at), self.members)


def runs(number: NDArray[np.intp]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """The first member and the length of every run of equal numbers (R,), among N > 0."""
    edge = np.empty(len(number) + 1, dtype=bool)
    edge[0] = edge[-1] = True
    np.not_equal(number[1:], number[:-1], out=edge[1:-1])
    at = edge.nonzero()[0]
    return at[:-1], at[1:] - at[:-1]


def in_whole_parts(number: NDArray[np.intp], size: int) -> NDArray[np.bool_]:
    """Which of N > 0 are in parts of so many equal numbers (N,), from the start of each run on."""
    first, count = runs(number)
    end = first + count - count % size
    return np.asarray(np.arange(len(number)) < end.repeat(count))
