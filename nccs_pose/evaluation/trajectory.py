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
"""A planar trajectory: poses with their stamps."""

from __future__ import annotations

from dataclasses import dataclass

from nccs_pose.geometry.pose import Array
import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses of `base_link` by time.

    :ivar stamps_ns: stamps (N,) int64 in nanoseconds, in any order.
    :ivar poses: x, y (m) and yaw (rad), (N, 3).
    :raises ValueError: if the shapes do not fit.
    """

    stamps_ns: NDArray[np.int64]
    poses: Array

    def __post_init__(self) -> None:
        stamps = np.asarray(self.stamps_ns, dtype=np.int64).reshape(-1)
        poses = np.asarray(self.poses, dtype=float).reshape(-1, 3)
        if len(stamps) != len(poses):
            raise ValueError(f'{len(stamps)} stamps but {len(poses)} poses')
        object.__setattr__(self, 'stamps_ns', stamps)
        object.__setattr__(self, 'poses', poses)

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def in_order(self) -> Trajectory:
        """The same poses by rising stamp, one (the first) for each stamp."""
        stamps, index = np.unique(self.stamps_ns, return_index=True)
        return Trajectory(stamps, self.poses[index])
