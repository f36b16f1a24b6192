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

"""Pixels measured on lines: what vision hands to estimation."""

from __future__ import annotations

from dataclasses import dataclass
import math

from nccs_pose.errors import VisionError
from nccs_pose.geometry.pose import Array
import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class LinePoints:
    """N points on the images of lines.

    :ivar pixels: (N, 2), u right, v down, sub-pixel.
    :ivar sigma: standard deviation along the curve's normal (N,), px.
    :ivar label: which line (N,): its index in the map, or the blob before it has one; -1 none.
    :raises VisionError: if the lengths differ, or a value is not finite.
    """

    pixels: Array
    sigma: Array
    label: NDArray[np.intp]

    def __post_init__(self) -> None:
        n = len(self.pixels)
        if self.pixels.shape != (n, 2) or self.sigma.shape != (n,) or self.label.shape != (n,):
            raise VisionError(
                f'line points: shapes {self.pixels.shape}, {self.sigma.shape}, '
                f'{self.label.shape} do not belong together')
        # Sums of squares are finite where all values are, at half the cost of asking each.
        if not math.isfinite(np.vdot(self.pixels, self.pixels) + np.vdot(self.sigma, self.sigma)):
            raise VisionError('line points: pixels and sigma must be finite')

    @property
    def variance(self) -> float:
        """Mean square of :attr:`sigma`, px^2."""
        return float(self.sigma.dot(self.sigma)) / len(self)

    def __len__(self) -> int:
        return len(self.pixels)

    def __getitem__(self, index: NDArray[np.bool_] | NDArray[np.intp] | slice) -> LinePoints:
        return LinePoints(self.pixels[index], self.sigma[index], self.label[index])
