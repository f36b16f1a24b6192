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

"""The lines of a map as an image shows them: a line that is drawn in pieces is one.

Who draws a map may cut a line where another one meets it. The paint on the floor has no such
joints, nor has the strip that an image shows, which is longer than any of the pieces.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from nccs_pose.estimation.floor_segments import ROW_GAP
from nccs_pose.geometry.lines import Line, LineMap
from nccs_pose.geometry.pose import Array
import numpy as np
from numpy.typing import NDArray

# Pieces of a line lie no farther off it than this part of its width.
_ASIDE = 0.2


def whole_lines(line_map: LineMap, gap: float = ROW_GAP) -> LineMap:
    """A map with those of its lines joined that an image shows as one, however near they are.

    They have the same colour, are in line, and touch, overlap, or leave no gap that images show
    for certain. Wider gaps are kept, since they tell one place from another.

    :param gap: the widest one over which lines are joined, metres.
    :returns: the map itself where there are no such lines.
    """
    wholes = _wholes(line_map, gap)
    joined = [parts for k, parts in enumerate(wholes) if k == min(parts)]
    if len(joined) == len(line_map):
        return line_map
    return LineMap(
        tuple(_joined([line_map[k] for k in parts]) for parts in joined), line_map.frame)


def first_pieces(line_map: LineMap) -> NDArray[np.intp]:
    """The first of the lines of a map that an image shows as one with each (L,): its number."""
    return np.array([min(parts) for parts in _wholes(line_map, ROW_GAP)])


def _wholes(line_map: LineMap, gap: float) -> list[list[int]]:
    """The lines of a map that each makes one line with, itself among them."""
    near = _may_be_one(line_map, gap)
    wholes = [[k] for k in range(len(line_map))]
    for a, b in np.argwhere(np.triu(near, 1)).tolist():
        both = [*wholes[a], *wholes[b]]
        if wholes[a] is not wholes[b] and _are_in_line([line_map[k] for k in both]):
            for k in both:
                wholes[k] = both
    return wholes


def _may_be_one(line_map: LineMap, gap: float) -> NDArray[np.bool_]:
    """Which lines go on as which others, about in line with them (L, L)."""
    starts, directions = line_map.starts[:, None, :2], line_map.directions[:, None, :2]
    # Where the others' ends are as seen along each line (2, L, L).
    offset = np.stack([line_map.starts, line_map.ends])[:, None, :, :2] - starts
    along = (offset * directions).sum(axis=3)
    across = offset[..., 1] * directions[..., 0] - offset[..., 0] * directions[..., 1]
    reached = (along.min(axis=0) < line_map.lengths[:, None] + gap) & (
        along.max(axis=0) > -gap)
    # A short one does not tell where a long one has its ends.
    near = reached & (np.abs(across).max(axis=0) < 4.0 * _ASIDE * line_map.widths)
    colours = np.array([line.colour for line in line_map])
    return (near | near.T) & (colours[:, None] == colours)


def _ends(lines: Sequence[Line]) -> tuple[Array, Array, Array]:
    """The outermost ends of lines that are about in line, and all of them (2 L, 3)."""
    ends = np.array([end for line in lines for end in (line.start, line.end)])
    along = ends @ max(lines, key=lambda line: line.length).direction
    return ends[along.argmin()], ends[along.argmax()], ends


def _are_in_line(lines: Sequence[Line]) -> bool:
    """Whether all lines lie along the one between their outermost ends."""
    start, end, ends = _ends(lines)
    x, y, _ = (end - start) / np.linalg.norm(end - start)
    across = (ends - start) @ [-y, x, 0.0]
    return bool(np.abs(across).max() < _ASIDE * min(line.width for line in lines))


def _joined(lines: Sequence[Line]) -> Line:
    """The line between the outermost ends of some, as wide as any; of one, the very same."""
    if len(lines) == 1:
        return lines[0]
    start, end, _ = _ends(lines)
    return replace(lines[0], start=start, end=end, width=max(line.width for line in lines))
