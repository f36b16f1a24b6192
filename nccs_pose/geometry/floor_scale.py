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

"""How long things on the floor are in the image, tabulated by their place."""

from __future__ import annotations

from nccs_pose.geometry.floor_table import as_complex, as_points, Complex, FloorTable
from nccs_pose.geometry.pose import Array
import numpy as np

# Cells from the mirror's foot to the end of the table.
_CELLS = 50


class FloorScale:
    """Lengths in the image of short lines on the floor, from a square grid of cells.

    Good to what the scale changes within a cell: for counting, not for measuring.

    :ivar foot: of the mirror on the floor, x + iy in base_link, metres.
    :ivar reach: how far from there the table goes, metres.
    """

    def __init__(self, table: FloorTable) -> None:
        self.foot = complex(*table.foot.tolist())
        self.reach = table.reach
        self._scale = _CELLS / table.reach
        self._side = side = 2 * _CELLS + 1
        self._origin = self.foot - (1.0 + 1.0j) * 0.5 * side / self._scale
        edges = np.arange(side + 1) / self._scale
        corners = table.pixels(as_points((self._origin + edges + 1j * edges[:, None]).ravel()))
        rows = as_complex(corners).reshape(side + 1, side + 1)
        # Means over both sides of each cell.
        by_x, by_y = (
            (0.5 * self._scale) * (step[1:] + step[:-1]) for step in (
                rows[:, 1:] - rows[:, :-1], rows.T[:, 1:] - rows.T[:, :-1]))
        by_x, by_y = by_x.ravel(), by_y.T.ravel()
        middle = 0.25 * (rows[1:, 1:] + rows[1:, :-1] + rows[:-1, 1:] + rows[:-1, :-1])
        seen = table.sees_floor(as_points(middle.ravel()))
        # The square of a length is a quadratic form of the step.
        self._form = seen[:, None] * np.column_stack([
            np.abs(by_x)**2, 2.0 * (by_x * by_y.conj()).real, np.abs(by_y)**2])

    def pixels(self, points: Complex, step: Complex) -> Array:
        """Length in the image of steps from points (...), px; 0 where the floor is not seen.

        :param points: x + iy in base_link, metres; within reach.
        :param step: likewise; to be broadcast.
        """
        scaled = (points - self._origin) * self._scale
        cell = scaled.real.astype(np.intp) + self._side * scaled.imag.astype(np.intp)
        form = self._form.take(cell, axis=0)
        x, y = step.real, step.imag
        square = x * x * form[..., 0] + x * y * form[..., 1] + y * y * form[..., 2]
        return np.sqrt(np.maximum(square, 0.0))
