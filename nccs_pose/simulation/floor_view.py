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

"""What the pixels of a rig see, computed once: rays, floor points and their sub-pixel neighbours.

A robot on a flat floor moves the world under its mirror, not the mirror over its pixels: which
point of the floor a pixel sees is the same in base_link for ever.
"""

from __future__ import annotations

from collections import OrderedDict
import dataclasses

from nccs_pose.errors import SimulationError
from nccs_pose.geometry.rig import Rig
import numpy as np

# Floor farther away than this is drawn as the horizon, m.
REACH = 30.0
# Where in a pixel its four sub-pixel rays pass, row by row.
SUB_PIXELS = np.array([[-0.25, -0.25], [0.25, -0.25], [-0.25, 0.25], [0.25, 0.25]])
_BLOCK = 16
_CHUNK = 1 << 16


@dataclasses.dataclass(frozen=True, eq=False)
class FloorView:
    """Every pixel that sees the mirror, those that see the floor first, in blocks of the image.

    Positions are in base_link, m; float32 rounds them by 0.2 micrometres at 3 m, the same in
    every frame.

    :ivar width: of the image, px.
    :ivar height: of the image, px.
    :ivar pixel: index v width + u (N,) int.
    :ivar origin: the mirror point (3, N) float32.
    :ivar direction: of the reflected ray, unit (3, N) float32.
    :ivar floor: the floor point of the first F pixels' centres (F, 2) float32.
    :ivar sub: the floor points of their four sub-pixel rays (F, 4, 2) float32, in the order of
        SUB_PIXELS.
    :ivar footprint: radius on the floor that covers the pixel (F,) float32, m.
    :ivar block_start: first of the floor pixels of each block, and F at the end (K + 1,) int.
    :ivar block_centre: middle of the block's floor points (K, 2).
    :ivar block_radius: radius that covers the block's pixels (K,), m.
    """

    width: int
    height: int
    pixel: np.ndarray
    origin: np.ndarray
    direction: np.ndarray
    floor: np.ndarray
    sub: np.ndarray
    footprint: np.ndarray
    block_start: np.ndarray
    block_centre: np.ndarray
    block_radius: np.ndarray


def reflected_rays(rig: Rig, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Give mirror points (N, 3) and unit reflected directions (N, 3) in base_link, and hits (N,).

    Without the derivatives of `Rig.back_project`.
    """
    points, hit = rig.mirror_points(pixels)
    reflected = rig.mirror.reflected(points - rig.cop, points)
    return rig.T_base_mirror.apply(points), rig.T_base_mirror.rotate(reflected), hit


def floor_points(rig: Rig, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Give where pixels (N, 2) see the floor of base_link (N, 2), and whether they do (N,)."""
    origin, direction, hit = reflected_rays(rig, pixels)
    return _to_floor(origin, direction, hit)


def _to_floor(
    origin: np.ndarray, direction: np.ndarray, hit: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    falls = hit & (direction[:, 2] < -1e-6)
    range_ = origin[:, 2] / np.where(falls, -direction[:, 2], 1.0)
    points = origin[:, :2] + range_[:, None] * direction[:, :2]
    reached = falls & (np.einsum('ni,ni->n', points, points) < REACH**2)
    return np.where(reached[:, None], points, 0.0), reached


_VIEWS: OrderedDict[bytes, FloorView] = OrderedDict()


def floor_view(rig: Rig) -> FloorView:
    """Give the rig's view, computed on first use and kept for the last few rigs."""
    key = _fingerprint(rig)
    view = _VIEWS.get(key)
    if view is None:
        view = _VIEWS[key] = _compute(rig)
        while len(_VIEWS) > 4:
            _VIEWS.popitem(last=False)
    _VIEWS.move_to_end(key)
    return view


def _fingerprint(rig: Rig) -> bytes:
    arrays = (rig.cop, rig.R_mirror_camera, rig.T_base_mirror.rotation,
              rig.T_base_mirror.translation)
    return repr((rig.mirror, rig.camera)).encode() + b''.join(a.tobytes() for a in arrays)


def _compute(rig: Rig) -> FloorView:
    width, height = rig.camera.width, rig.camera.height
    pixel = _block_order(width, height)
    rays = [_trace(rig, pixel[i : i + _CHUNK]) for i in range(0, len(pixel), _CHUNK)]
    origin, direction, floor, sub, hit, on_floor = (np.concatenate(a) for a in zip(*rays))
    if not on_floor.any():
        raise SimulationError('no pixel of the rig sees the floor: is its mirror above it?')
    sky = hit & ~on_floor
    floor, sub = floor[on_floor], sub[on_floor]
    # A corner of the pixel is twice as far from its centre as the sub-pixel ray next to it.
    corner = np.linalg.norm(sub - floor[:, None], axis=2).max(axis=1)
    footprint = (2.3 * corner).astype(np.float32)
    block = _block_number(pixel[on_floor], width)
    start = np.flatnonzero(np.r_[True, block[1:] != block[:-1]])
    count = np.diff(np.r_[start, len(block)])
    centre = np.add.reduceat(floor, start, axis=0) / count[:, None]
    reach = np.linalg.norm(floor - np.repeat(centre, count, axis=0), axis=1) + footprint
    both = np.r_[np.flatnonzero(on_floor), np.flatnonzero(sky)]
    return FloorView(
        width, height, pixel[both], origin[both].T.astype(np.float32, order='C'),
        direction[both].T.astype(np.float32, order='C'), floor.astype(np.float32),
        sub.astype(np.float32),
        footprint, np.r_[start, len(block)], centre, np.maximum.reduceat(reach, start))


def _block_order(width: int, height: int) -> np.ndarray:
    pixel = np.arange(width * height)
    return pixel[np.argsort(_block_number(pixel, width), kind='stable')]


def _block_number(pixel: np.ndarray, width: int) -> np.ndarray:
    columns = -(-width // _BLOCK)
    return (pixel // width // _BLOCK) * columns + (pixel % width) // _BLOCK


def _trace(rig: Rig, pixel: np.ndarray) -> tuple[np.ndarray, ...]:
    """Trace the centres and, where these see the floor, the four sub-pixel rays."""
    width = rig.camera.width
    centres = np.stack([pixel % width, pixel // width], axis=1).astype(float)
    origin, direction, hit = reflected_rays(rig, centres)
    floor, on_floor = _to_floor(origin, direction, hit)
    sub = np.zeros((len(pixel), 4, 2))
    index = np.flatnonzero(on_floor)
    around = (centres[index][:, None] + SUB_PIXELS).reshape(-1, 2)
    points, reached = floor_points(rig, around)
    sub[index] = points.reshape(-1, 4, 2)
    on_floor[index] = reached.reshape(-1, 4).all(axis=1)
    return origin, direction, floor, sub, hit, on_floor
