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

"""Where a pose says that the tapes of the map are seen."""

from __future__ import annotations

from nccs_pose.geometry.floor_table import FloorTable
from nccs_pose.geometry.lines import LineMap
from nccs_pose.geometry.pose import Array, Pose2
from nccs_pose.vision.bands import Bands
import numpy as np
from numpy.typing import NDArray

# Coarse samples of each line, between which its image's length is interpolated.
_COARSE = 40
# Stations closer than this share pixels and tell nothing new, px.
_CLOSEST = 4.0
# A tape's end is no edge: keep this much away from it, px.
_END = 3.0


def predict_bands(
    table: FloorTable, line_map: LineMap, pose: Pose2, stations: int,
) -> Bands:
    """Stations evenly spaced in the image along each visible floor tape.

    :param pose: T_map_base.
    :param stations: at most so many a line.
    """
    spots = [_place(table, line_map, k, pose, stations) for k in range(len(line_map))]
    label = np.concatenate(
        [np.full(len(spot), k, dtype=np.intp) for k, spot in enumerate(spots)])
    at = np.concatenate(spots)
    return _bands(table, line_map, pose, at[:, 0], at[:, 1], label)


def _place(
    table: FloorTable, line_map: LineMap, k: int, pose: Pose2, stations: int,
) -> Array:
    """Positions along line k (n, 2): distance from its start in metres, and spacing in px."""
    line = line_map[k]
    if not (line.width > 0.0 and abs(line.start[2]) < 1e-6):
        return np.zeros((0, 2))
    distance = np.linspace(0.0, line.length, _COARSE)
    points = line.start[:2] + distance[:, None] * line.direction[:2]
    pixels = table.pixels(pose.inverse().apply(points))
    step = np.linalg.norm(np.diff(pixels, axis=0), axis=1)
    visible = table.sees_floor(pixels)
    step = np.where(visible[1:] & visible[:-1], step, 0.0)
    arc = np.concatenate([[0.0], np.cumsum(step)])
    length = arc[-1] - 2.0 * _END
    if length < _CLOSEST:
        return np.zeros((0, 2))
    n = int(min(stations, np.ceil(length / _CLOSEST)))
    where = _END + (np.arange(n) + 0.5) * (length / n)
    # arc is flat where the line is hidden; a tiny slope keeps it invertible.
    rising = arc + 1e-9 * np.arange(_COARSE)
    return np.column_stack([np.interp(where, rising, distance), np.full(n, length / n)])


def _bands(
    table: FloorTable, line_map: LineMap, pose: Pose2, distance: Array, spacing: Array,
    label: NDArray[np.intp],
) -> Bands:
    rotation = pose.rotation[:2, :2]
    direction = line_map.directions[label, :2] @ rotation
    left = np.column_stack([-direction[:, 1], direction[:, 0]])
    start = pose.inverse().apply(line_map.starts[:, :2])[label]
    middle = start + distance[:, None] * direction
    width = line_map.widths[label]
    # Image motion per metre along the line and across it, from points a little apart.
    small = 0.02
    n = len(label)
    pixels = table.pixels(np.concatenate([
        middle, middle + small * direction, middle - small * direction,
        middle + small * left, middle - small * left]))
    midline = pixels[:n]
    ahead = (pixels[n:2 * n] - pixels[2 * n:3 * n]) / (2.0 * small)
    aside = (pixels[3 * n:4 * n] - pixels[4 * n:]) / (2.0 * small)
    turn = (pixels[n:2 * n] + pixels[2 * n:3 * n] - 2.0 * midline) / small**2
    # The cut across the tape whose image is normal to the curve leans along the line.
    speed2 = np.maximum(np.einsum('ni,ni->n', ahead, ahead), 1e-9)
    lean = -np.einsum('ni,ni->n', aside, ahead) / speed2
    cut = 0.5 * width[:, None] * (left + lean[:, None] * direction)
    edges = table.pixels(np.concatenate([middle + cut, middle - cut]))
    across = edges[:n] - edges[n:]
    half_width = 0.5 * np.linalg.norm(across, axis=1)
    across /= np.maximum(2.0 * half_width, 1e-12)[:, None]
    along = np.column_stack([across[:, 1], -across[:, 0]])
    bend = np.einsum('ni,ni->n', turn, across) / speed2
    # Near its ends the leaning cut would leave the tape.
    reach = 0.5 * width * np.abs(lean)
    whole = (distance > reach) & (distance < line_map.lengths[label] - reach)
    centre = 0.5 * (edges[:n] + edges[n:])
    keep = whole & table.sees_floor(centre) & (half_width > 1e-3)
    return Bands(centre, midline, across, along, bend, half_width, spacing, label)[keep]
