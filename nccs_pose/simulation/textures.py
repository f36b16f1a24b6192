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

"""Procedural surfaces: a tiled floor, walls with things on them, a ceiling with lamps."""

from __future__ import annotations

import functools

import cv2
from nccs_pose.simulation.scene import FloorTexture, Room
import numpy as np

# The floor's pattern repeats after this many tiles, each this many texels wide.
_TILES, _TEXELS = 4, 128
# Blurred copies of the pattern, each twice as coarse, so that far floor does not flicker.
_LEVELS = 6
_SLOPE = 1.2  # the amplitude of clouds falls with frequency to this power
_WALL_SCALE = 80.0  # texels per metre of wall and ceiling


def clouds(height: int, width: int, rng: np.random.Generator) -> np.ndarray:
    """Give a periodic random pattern (height, width), mean 0 and standard deviation 1."""
    frequency = np.hypot(np.fft.fftfreq(height)[:, None], np.fft.rfftfreq(width)[None, :])
    frequency[0, 0] = np.inf
    shape = frequency.shape
    spectrum = rng.standard_normal(shape) + 1j * rng.standard_normal(shape)
    pattern = np.fft.irfft2(spectrum * frequency**-_SLOPE, s=(height, width))
    return (pattern - pattern.mean()) / pattern.std()


@functools.lru_cache(maxsize=4)
def floor_pattern(texture: FloorTexture) -> np.ndarray:
    """Give the brightness of one period of the floor, at all levels side by side.

    :returns: (LEVELS (size + 1), size + 1) float32, mean 1; each level repeats its first row and
        column at its end, so that interpolation wraps.
    """
    rng = np.random.default_rng(texture.seed)
    size = _TILES * _TEXELS
    pattern = 1.0 + texture.contrast * clouds(size, size, rng)
    tiles = 1.0 + texture.tile_contrast * rng.standard_normal((_TILES, _TILES))
    pattern *= np.kron(tiles, np.ones((_TEXELS, _TEXELS)))
    joint = max(1, round(texture.joint / texture.tile * _TEXELS))
    for edge in range(0, size, _TEXELS):
        pattern[edge : edge + joint] *= 1.0 - texture.joint_depth
        pattern[:, edge : edge + joint] *= 1.0 - texture.joint_depth
    pattern = np.clip(pattern / pattern.mean(), 0.2, 1.8).astype(np.float32)
    levels = []
    for level in range(_LEVELS):
        blurred = _blur_periodic(pattern, 0.4 * 2.0**level)
        levels.append(np.pad(blurred, ((0, 1), (0, 1)), mode='wrap'))
    return np.concatenate(levels)


def _blur_periodic(pattern: np.ndarray, sigma: float) -> np.ndarray:
    pad = int(4.0 * sigma) + 1
    wrapped = np.pad(pattern, pad, mode='wrap')
    return cv2.GaussianBlur(wrapped, (0, 0), sigma)[pad:-pad, pad:-pad]


def floor_brightness(
    texture: FloorTexture, x: np.ndarray, y: np.ndarray, level: np.ndarray
) -> np.ndarray:
    """Give the floor's brightness at map points (N,), mean 1, blurred by their level (N,)."""
    pattern = floor_pattern(texture)
    size = _TILES * _TEXELS
    scale = np.float32(_TEXELS / texture.tile)
    u, v = x * scale, y * scale
    u -= np.floor(u / np.float32(size)) * np.float32(size)
    v -= np.floor(v / np.float32(size)) * np.float32(size)
    v += level * np.float32(size + 1)
    return _sample(pattern, u, v)


def floor_level(texture: FloorTexture, footprint: np.ndarray) -> np.ndarray:
    """Give the level (N,) float32 whose blur covers a pixel's footprint (N,), m."""
    texels = np.maximum(footprint * (_TEXELS / texture.tile), 1.0)
    return np.clip(np.rint(np.log2(texels)), 0, _LEVELS - 1).astype(np.float32)


def wall_colours(room: Room, along: np.ndarray, height: np.ndarray) -> np.ndarray:
    """Give the BGR colours (N, 3) of the walls, `along` m round the room and `height` m up."""
    return _sample(_walls(room), along * np.float32(_WALL_SCALE),
                   height * np.float32(_WALL_SCALE))


def ceiling_colours(room: Room, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Give the BGR colours (N, 3) of the ceiling at points of the map (N,)."""
    return _sample(_ceiling(room), (x - np.float32(room.x_min)) * np.float32(_WALL_SCALE),
                   (y - np.float32(room.y_min)) * np.float32(_WALL_SCALE))


@functools.lru_cache(maxsize=4)
def _walls(room: Room) -> np.ndarray:
    """Paint the four walls in a row, (height, perimeter, 3) float32, the floor at row 0."""
    rng = np.random.default_rng(room.seed)
    sides = [room.x_max - room.x_min, room.y_max - room.y_min] * 2
    rows = round(room.height * _WALL_SCALE)
    walls = []
    for side in sides:
        columns = round(side * _WALL_SCALE)
        paint = np.array([0.42, 0.48, 0.52]) * rng.uniform(0.75, 1.15, 3)
        wall = paint * (1.0 + 0.04 * clouds(rows, columns, rng)[:, :, None])
        for _ in range(round(1.2 * side)):
            _hang(wall, rng)
        wall[: round(0.09 * _WALL_SCALE)] = rng.uniform(0.1, 0.5) * np.ones(3)
        walls.append(wall)
    picture = cv2.GaussianBlur(np.concatenate(walls, axis=1).astype(np.float32), (3, 3), 0.7)
    return np.clip(picture, 0.0, None)


def _hang(wall: np.ndarray, rng: np.random.Generator) -> None:
    """Hang a picture, a green sign, a bright window or a cupboard on the wall."""
    rows, columns = wall.shape[:2]
    kind = rng.integers(4)
    width, height = rng.uniform(0.25, 0.9, 2) * _WALL_SCALE
    left = int(rng.uniform(0.0, max(columns - width, 1.0)))
    bottom = 0 if kind == 3 else int(rng.uniform(0.3, 0.6) * rows)
    colour = {
        0: rng.uniform(0.05, 0.8, 3),
        1: np.array([0.15, 0.5, 0.1]) * rng.uniform(0.6, 1.4),
        2: np.array([2.2, 2.1, 2.0]),
        3: np.array([0.2, 0.3, 0.42]) * rng.uniform(0.5, 1.3),
    }[int(kind)]
    wall[bottom : bottom + int(height), left : left + int(width)] = colour


@functools.lru_cache(maxsize=4)
def _ceiling(room: Room) -> np.ndarray:
    rows = round((room.y_max - room.y_min) * _WALL_SCALE)
    columns = round((room.x_max - room.x_min) * _WALL_SCALE)
    ceiling = np.full((rows, columns, 3), 0.55, dtype=np.float32)
    for x in (0.3, 0.7):
        left, top = int(x * columns), int(0.25 * rows)
        ceiling[top : top + rows // 2, left : left + int(0.2 * _WALL_SCALE)] = 4.0
    return ceiling


def _sample(image: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Interpolate an image linearly at (N,) positions, in texels; outside, the nearest counts.

    Not with cv2.remap: up to OpenCV 4 it rounds positions to 1/32 of a texel, which moved a tenth
    of an image's pixels by up to 20 grey levels. This costs a tenth of a rendered image's time.
    """
    rows, columns = image.shape[:2]
    u, v = np.clip(u, 0, columns - 1), np.clip(v, 0, rows - 1)
    left, top = np.minimum(u.astype(int), columns - 2), np.minimum(v.astype(int), rows - 2)
    right, down = u - left.astype(np.float32), v - top.astype(np.float32)
    if image.ndim == 3:
        right, down = right[:, None], down[:, None]
    texels = image.reshape(rows * columns, *image.shape[2:])
    first = top * columns + left

    def along(at: np.ndarray) -> np.ndarray:
        here = texels.take(at, axis=0)
        return here + right * (texels.take(at + 1, axis=0) - here)

    above = along(first)
    return above + down * (along(first + columns) - above)
