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
"""Trajectories in the TUM format: `timestamp x y z qx qy qz qw`, one pose a line.

Stamps are read and written as whole nanoseconds; a float of seconds since 1970 would keep only
some hundred of them.
"""

from __future__ import annotations

from decimal import Decimal, InvalidOperation
import math
from pathlib import Path

from nccs_pose.errors import FileError
from nccs_pose.evaluation.trajectory import Trajectory
from nccs_pose.files.text_files import read_text, write_text
import numpy as np

HEADER = '# timestamp x y z qx qy qz qw\n'


def write_tum(trajectory: Trajectory, path: str | Path) -> None:
    """Write planar poses as a TUM trajectory (z = 0, rotation about z)."""
    write_text(path, HEADER + ''.join(
        tum_row(int(stamp), pose) for stamp, pose in zip(trajectory.stamps_ns, trajectory.poses)))


def tum_row(stamp_ns: int, pose: np.ndarray) -> str:
    """One line of a TUM trajectory for a pose (x, y, yaw)."""
    x, y, yaw = (float(value) for value in pose)
    return (
        f'{format_stamp(stamp_ns)} {x:.9f} {y:.9f} 0 0 0 '
        f'{math.sin(0.5 * yaw):.12f} {math.cos(0.5 * yaw):.12f}\n')


def format_stamp(stamp_ns: int) -> str:
    """Seconds with nine decimals, exactly."""
    sign = '-' if stamp_ns < 0 else ''
    seconds, nanoseconds = divmod(abs(stamp_ns), 10**9)
    return f'{sign}{seconds}.{nanoseconds:09d}'


def read_tum(path: str | Path) -> Trajectory:
    """Read a TUM trajectory; of each pose the planar part (x, y and the yaw) is kept.

    :raises FileError: naming the file, the line, and what is wrong with it.
    """
    path = Path(path)
    lines = read_text(path).splitlines()
    stamps, poses = [], []
    for number, line in enumerate(lines, start=1):
        text = line.split('#', 1)[0].replace(',', ' ')
        if text.strip():
            stamp, pose = _parse(text.split(), f'{path}, line {number}')
            stamps.append(stamp)
            poses.append(pose)
    return Trajectory(np.array(stamps, dtype=np.int64), np.array(poses).reshape(-1, 3))


def _parse(words: list[str], where: str) -> tuple[int, tuple[float, float, float]]:
    if len(words) != 8:
        raise FileError(
            f'{where}: must hold 8 numbers (timestamp x y z qx qy qz qw), it holds {len(words)}.')
    values = []
    for word in words[1:]:
        try:
            values.append(float(word))
        except ValueError as error:
            raise FileError(f'{where}: {word!r} is no number.') from error
    try:
        stamp = int((Decimal(words[0]) * 10**9).to_integral_value())
    except (InvalidOperation, ValueError, OverflowError) as error:
        raise FileError(f'{where}: the timestamp {words[0]!r} is no number.') from error
    x, y, _, qx, qy, qz, qw = values
    if not all(math.isfinite(value) for value in values) or abs(stamp) >= 2**63:
        raise FileError(f'{where}: every number must be finite: {" ".join(words)}.')
    if not 0.99 < qx * qx + qy * qy + qz * qz + qw * qw < 1.01:
        raise FileError(f'{where}: the quaternion {qx} {qy} {qz} {qw} is not of length one.')
    return stamp, (x, y, quaternion_yaw(qx, qy, qz, qw))


def quaternion_yaw(qx: float, qy: float, qz: float, qw: float) -> float:
    """Yaw in radians of a unit quaternion: the heading of its x axis in the plane."""
    return math.atan2(2.0 * (qw * qz + qx * qy), 1.0 - 2.0 * (qy * qy + qz * qz))
