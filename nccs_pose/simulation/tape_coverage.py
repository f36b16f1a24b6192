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

"""How much of each pixel a floor tape covers.

A pixel is cut into 2 x 2 cells. In the middle of each, the tape's coordinates (along it and
across it) are those of an exactly back-projected ray; across the cell they are taken as linear,
with the gradient from the neighbouring cells, and the area on the inner side of an edge has a
closed form; cells at the tape's corners are cut finer. Against 256 x 256 exact rays in each edge
pixel of the arena the mean error is 0.0004 of a pixel at 1280 x 960 and 0.0009 at 640 x 480, the
bias below 0.0001, the worst 0.006.
"""

from __future__ import annotations

from nccs_pose.geometry.lines import Line
from nccs_pose.simulation.floor_view import FloorView
import numpy as np

# Offsets in a cell of the middles of its parts, (2, parts).
_FINE_SIDE = 8
_FINE = (np.indices((_FINE_SIDE, _FINE_SIDE)).reshape(2, -1) + 0.5) / _FINE_SIDE - 0.5


def half_plane_area(value: np.ndarray, across: np.ndarray, down: np.ndarray) -> np.ndarray:
    """Give the fraction of a cell where a linear function is positive.

    :param value: of the function in the cell's middle, any shape.
    :param across: its change over the cell's width.
    :param down: its change over the cell's height.
    :returns: 0 to 1, in the same shape.
    """
    p = np.maximum(np.abs(across), np.abs(down))
    q = np.minimum(np.abs(across), np.abs(down))
    p = np.maximum(p, 1e-12)
    # The four ramps cancel when q vanishes; a millionth of p keeps ten digits.
    q = np.maximum(q, 1e-6 * p)
    outer, inner = 0.5 * (p + q), 0.5 * (p - q)

    def ramp(shift: np.ndarray) -> np.ndarray:
        return np.square(np.maximum(value + shift, 0.0))

    area = (ramp(outer) - ramp(inner) - ramp(-inner) + ramp(-outer)) / (2.0 * p * q)
    return np.clip(area, 0.0, 1.0)


def tape_coverage(view: FloorView, tape: Line) -> tuple[np.ndarray, np.ndarray]:
    """Give the floor pixels that a tape touches, and how much of each it covers.

    :param view: of the rig.
    :param tape: on the floor, in base_link, with its width.
    :returns: positions among the view's floor pixels (K,) int and coverage (K,) float64.
    """
    start, along = tape.start[:2], tape.direction[:2]
    left = tape.left[:2]
    half, length = 0.5 * tape.width, tape.length
    index = _near_blocks(view, start, along, length, half)
    if not len(index):
        return index, np.empty(0)
    offset = view.floor[index] - start.astype(np.float32)
    reach = view.footprint[index]
    u, v = offset @ along.astype(np.float32), np.abs(offset @ left.astype(np.float32))
    near = (v < half + reach) & (u > -reach) & (u < length + reach)
    index, u, v, reach = index[near], u[near], v[near], reach[near]
    edge = ~((v < half - reach) & (u > reach) & (u < length - reach))
    coverage = np.ones(len(index))
    sub = view.sub[index[edge]].astype(float) - start
    coverage[edge] = _edge_coverage(sub @ along, sub @ left, length, half)
    return index, coverage


def _edge_coverage(u: np.ndarray, v: np.ndarray, length: float, half: float) -> np.ndarray:
    """Mean over the four cells from the tape's coordinates in their middles, (K, 4) each."""
    steps = np.stack([*_steps(u), *_steps(v)])
    on_length = _strip_area(u, steps[0], steps[1], 0.0, length)
    across = _strip_area(v, steps[2], steps[3], -half, half)
    coverage = on_length * across
    # Where an end and a side cut the same cell, the product holds only for cells much smaller.
    mixed = (on_length < 1.0) & (coverage > 0.0) & (across < 1.0)
    if mixed.any():
        steps = steps[:, mixed, None]
        du, eu, dv, ev = steps
        fine_u = u[mixed, None] + du * _FINE[0] + eu * _FINE[1]
        fine_v = v[mixed, None] + dv * _FINE[0] + ev * _FINE[1]
        du, eu, dv, ev = steps / _FINE_SIDE
        fine = (_strip_area(fine_u, du, eu, 0.0, length)
                * _strip_area(fine_v, dv, ev, -half, half))
        coverage[mixed] = fine.mean(axis=1)
    return coverage.mean(axis=1)


def _strip_area(
    value: np.ndarray, across: np.ndarray, down: np.ndarray, low: float, high: float
) -> np.ndarray:
    """Fraction of a cell where a linear function is between two values."""
    return half_plane_area(value - low, across, down) - half_plane_area(value - high, across, down)


def _steps(value: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Change over a cell's width and height, from the cells (K, 4) beside it and below it."""
    across = np.repeat(value[:, 1::2] - value[:, 0::2], 2, axis=1)
    down = np.tile(value[:, 2:] - value[:, :2], (1, 2))
    return across, down


def _near_blocks(
    view: FloorView, start: np.ndarray, along: np.ndarray, length: float, half: float
) -> np.ndarray:
    """Positions of all floor pixels in blocks that the tape may touch."""
    offset = view.block_centre - start
    u = np.clip(offset @ along, 0.0, length)
    distance = np.linalg.norm(offset - u[:, None] * along, axis=1)
    blocks = np.flatnonzero(distance < view.block_radius + 1.5 * half)
    first, last = view.block_start[blocks], view.block_start[blocks + 1]
    count = last - first
    if not len(blocks):
        return np.empty(0, dtype=int)
    return np.repeat(first - np.r_[0, np.cumsum(count)[:-1]], count) + np.arange(count.sum())
