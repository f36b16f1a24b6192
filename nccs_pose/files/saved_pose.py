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

"""The last good pose, kept from one run to the next.

The file names the map by a hash of its lines: a pose of another map is worth nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
import hashlib
import json
from pathlib import Path
import sys
from typing import Any

from nccs_pose.errors import FileError
from nccs_pose.files.text_files import read_text, write_text
from nccs_pose.geometry.lines import LineMap
from nccs_pose.geometry.pose import Array, Pose2
import numpy as np

_LARGEST = 2**20  # bytes


@dataclass(frozen=True, eq=False)
class SavedPose:
    """A pose to start from.

    :ivar stamp_ns: stamp of the image that it was estimated from.
    :ivar frame: frame of the map.
    :ivar map_hash: :func:`map_hash` of the map that it refers to.
    :ivar pose: T_map_base.
    :ivar covariance: of (x, y, yaw), (3, 3).
    """

    stamp_ns: int
    frame: str
    map_hash: str
    pose: Pose2
    covariance: Array


def map_hash(line_map: LineMap) -> str:
    """SHA-256 of the lines: end points, widths and colours, in their order."""
    digest = hashlib.sha256()
    for line in line_map:
        numbers = (*line.start, *line.end, line.width)
        digest.update(' '.join([*(float(v).hex() for v in numbers), line.colour]).encode())
    return digest.hexdigest()


def write_saved_pose(path: str | Path, saved: SavedPose) -> None:
    """Replace the file in one step.

    :raises FileError: if it cannot be written.
    """
    write_text(path, json.dumps({
        'stamp_ns': saved.stamp_ns,
        'frame': saved.frame,
        'map_sha256': saved.map_hash,
        'x_m': saved.pose.x, 'y_m': saved.pose.y, 'yaw_rad': saved.pose.yaw,
        'covariance_x_y_yaw': saved.covariance.tolist(),
    }, indent=1) + '\n')


def read_saved_pose(path: str | Path) -> SavedPose | None:
    """Read it back; None if there is no such file yet.

    :raises FileError: naming the file and what is wrong with it.
    """
    path = Path(path)
    try:
        text = read_text(path, _LARGEST)
    except FileError as error:
        if isinstance(error.__cause__, FileNotFoundError):
            return None
        raise
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise FileError(f'{path}: is no saved pose: {error}') from error
    if not isinstance(content, dict):
        raise FileError(f'{path}: is no saved pose')
    x, y, yaw = (_number(path, content, key) for key in ('x_m', 'y_m', 'yaw_rad'))
    return SavedPose(
        int(_number(path, content, 'stamp_ns')), str(content.get('frame', '')),
        str(content.get('map_sha256', '')), Pose2(x, y, yaw), _covariance(path, content))


def _number(path: Path, content: dict[str, Any], key: str) -> float | int:
    value = content.get(key)
    # JSON knows whole numbers that no float holds.
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not (
            abs(value) <= sys.float_info.max):
        raise FileError(f'{path}: {key} = {str(value)[:40]} is no finite number')
    return value


def _covariance(path: Path, content: dict[str, Any]) -> Array:
    key = 'covariance_x_y_yaw'
    try:
        covariance = np.array(content.get(key), dtype=float)
    except (TypeError, ValueError, OverflowError) as error:
        raise FileError(f'{path}: {key} is no 3 x 3 matrix') from error
    if covariance.shape != (3, 3) or not np.isfinite(covariance).all() or (
            not np.allclose(covariance, covariance.T) or np.linalg.eigvalsh(covariance)[0] <= 0.0):
        raise FileError(f'{path}: {key} is no covariance: {covariance.tolist()}')
    return covariance
