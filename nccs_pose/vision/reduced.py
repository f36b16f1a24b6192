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

"""The part of the image that shows the floor, several times smaller.

What noise and coarse JPEG colour spread over neighbouring pixels is one pixel of a smaller image,
and a thin tape stands out of what is left of the noise as well as before, at a fraction of the
cost.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
from nccs_pose.geometry.pose import Array
from nccs_pose.vision.segment import find_blobs, Mask, Segmentation
import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class ReducedView:
    """Means of pitch x pitch pixels, over the rows and columns that show floor.

    :ivar rows: of the image; a multiple of the pitch.
    :ivar columns: likewise.
    :ivar region: (h, w) uint8, 255 where all that a pixel is a mean of shows floor.
    :ivar pitch: a power of two.
    """

    rows: slice
    columns: slice
    region: Mask
    pitch: int

    @classmethod
    def of(cls, region: Mask, pitch: int) -> ReducedView:
        """View a region (H, W) of an image, 255 inside; it must not be empty."""
        rows, columns = (
            _span(np.flatnonzero(region.max(axis)), size, pitch)
            for axis, size in zip((1, 0), region.shape))
        reduced = _reduced(region[rows, columns], pitch)
        return cls(rows, columns, cv2.compare(reduced, 255, cv2.CMP_EQ), pitch)

    def read(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The view (h, w, 3) of an image (H, W, 3)."""
        return _reduced(image[self.rows, self.columns], self.pitch)

    def blobs(self, mask: Mask, pixels_per_blob: int) -> Segmentation:
        """Blobs of a mask (h, w) of the view where it shows floor, in pixels of the image."""
        return find_blobs(
            cv2.bitwise_and(mask, self.region), pixels_per_blob, pitch=self.pitch,
            origin=(self.columns.start, self.rows.start))

    def inside(self, mask: Mask) -> NDArray[np.intp]:
        """Which pixels of the view (P,), row by row, a mask (h, w) has where it shows floor."""
        return np.flatnonzero(cv2.bitwise_and(mask, self.region))

    @property
    def pixels(self) -> Array:
        """The middles of the view's pixels, row by row (h * w, 2), in the image."""
        row, column = np.indices(self.region.shape).reshape(2, -1)
        return self.pitch * np.column_stack([column, row]) + (
            self._origin + 0.5 * (self.pitch - 1))

    def places(self, pixels: Array) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Rows and columns (N,) of the view that hold pixels (N, 2) of the image, or are next."""
        last = np.array(self.region.shape[::-1]) - 1
        at = np.clip((pixels - self._origin) / self.pitch, 0.0, last).astype(np.intp)
        return at[:, 1], at[:, 0]

    @property
    def _origin(self) -> Array:
        return np.array([self.columns.start, self.rows.start], dtype=float)


def _span(inside: NDArray[np.intp], size: int, pitch: int) -> slice:
    """From the first to the last of places of an axis, in whole steps of the pitch."""
    first = int(inside[0]) // pitch * pitch
    steps = min(-(-(int(inside[-1]) + 1 - first) // pitch), (size - first) // pitch)
    return slice(first, first + steps * pitch)


def _reduced(image: NDArray[np.uint8], pitch: int) -> NDArray[np.uint8]:
    # Halving twice is faster than quartering.
    while pitch > 1:
        image = cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        pitch //= 2
    return np.ascontiguousarray(image)
