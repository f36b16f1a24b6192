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

"""Which line of a map is nearest to a place, looked up instead of computed."""

from __future__ import annotations

import math

from nccs_pose.estimation.strip_pairs import BEYOND, FloorLines
from nccs_pose.geometry.floor_table import Complex
from nccs_pose.geometry.pose import Array
import numpy as np
from numpy.typing import NDArray

# Side of a cell, metres, unless a map needs more cells than this.
_CELL = 0.05
_MOST_CELLS = 4e6
# Further from all lines than this nothing is near, metres.
_NEAR = 1.0
# So far off is no line, metres: beyond all tolerance, but a number to reckon with.
_NOWHERE = 1e9


class NearestLines:
    """The floor of a map in square cells, each with the lines that are nearest to its middle.

    Each colour has a layer of its own; a strip of one colour lies on no line of another.

    :ivar normal: of the lines, unit complex numbers x + iy (L + 1,); 0 for no line, which is the
        last.
    """

    def __init__(self, lines: FloorLines) -> None:
        self.normal = np.append(1j * lines.direction, 0.0)
        self._to_line = self.normal.conj()
        self._offset = np.append((lines.start * self._to_line[:-1]).real, _NOWHERE)
        self._colours = tuple(dict.fromkeys(lines.colour))
        ends = np.stack([lines.start, lines.start + lines.length * lines.direction])
        low = complex(ends.real.min(), ends.imag.min()) - (1.0 + 1.0j) * _NEAR
        high = complex(ends.real.max(), ends.imag.max()) + (1.0 + 1.0j) * _NEAR
        size = high - low
        cell = max(_CELL, math.sqrt(size.real * size.imag / _MOST_CELLS))
        # Round it all there is a frame of cells near to no line.
        self._origin, self._scale = low - cell * (1.0 + 1.0j), 1.0 / cell
        shape = (math.ceil(size.imag / cell) + 2, math.ceil(size.real / cell) + 2)
        self._last = (shape[1] - 1.0, shape[0] - 1.0)
        self._columns, self._cells = shape[1], shape[0] * shape[1]
        # Of each cell the nearest line, and the next if that may be nearer to some of its points.
        nearest = np.full((2, len(self._colours), *shape), len(lines.length), np.int16)
        distance = np.full(nearest.shape, _NEAR)
        for k, colour in enumerate(lines.colour):
            corner = (ends[:, k] - self._origin) * self._scale
            reach = _NEAR * self._scale
            rows, columns = (
                slice(max(1, int(part.min() - reach)), min(int(part.max() + reach) + 2, most - 1))
                for part, most in zip((corner.imag, corner.real), shape))
            part = np.s_[:, self._colours.index(colour), rows, columns]
            x, y = (np.arange(side.start, side.stop) + 0.5 for side in (columns, rows))
            off = (self._origin + (x + 1j * y[:, None]) * cell - lines.start[k]
                   ) * lines.direction[k].conj()
            half = 0.5 * lines.length[k]
            across = np.where(np.abs(off.real - half) < half + BEYOND, np.abs(off.imag), np.inf)
            first, second = distance[part] > across
            for values, value in ((distance[part], across), (nearest[part], k)):
                values[1] = np.where(first, values[0], np.where(second, value, values[1]))
                values[0] = np.where(first, value, values[0])
        nearest[1][distance[1] > distance[0] + math.sqrt(2.0) * cell] = len(lines.length)
        self._nearest = nearest.reshape(2, -1)

    def layers(self, colours: tuple[str, ...]) -> NDArray[np.intp]:
        """The layer of each of P colours (P,), for :meth:`at`.

        :raises ValueError: for a colour that no line has.
        """
        return np.array([self._cells * self._colours.index(colour) for colour in colours])

    def at(self, points: Complex, layer: NDArray[np.intp]) -> tuple[NDArray[np.intp], Array]:
        """The line nearest to each point, and how far to its left that lies, metres; both (H, P).

        Without a line near it has the number of lines and lies farther off than any is.

        :param points: P points in each of H poses, x + iy in the map (H, P), metres.
        :param layer: of each point (P,).
        """
        place = (points - self._origin) * self._scale
        column, row = (
            np.minimum(np.maximum(part, 0.0), last).astype(np.intp)
            for part, last in zip((place.real, place.imag), self._last))
        index = row * self._columns
        index += column
        index += layer
        which = self._nearest.take(index, axis=1)
        across = (points * self._to_line.take(which)).real
        across -= self._offset.take(which)
        far = np.abs(across)
        closer = far[1] < far[0]
        return np.where(closer, which[1], which[0]), np.where(closer, across[1], across[0])
