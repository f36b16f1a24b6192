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

"""Many poses at once, and which of them are one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import math

from nccs_pose.geometry.floor_table import Complex
from nccs_pose.geometry.pose import Array, Pose2
import numpy as np
from numpy.typing import NDArray

# Poses this close are the same, metres and rad.
_SAME_PLACE = 0.25
SAME_YAW = 0.15


@dataclass(frozen=True, eq=False)
class Poses:
    """H poses T_map_base: rotations, unit complex numbers (H,), and places x + iy (H,), metres."""

    rotation: Complex
    place: Complex

    @classmethod
    def of(cls, poses: Sequence[Pose2]) -> Poses:
        """From each of them."""
        x, y, yaw = np.array([(pose.x, pose.y, pose.yaw) for pose in poses]).reshape(-1, 3).T
        return cls(np.exp(1j * yaw), x + 1j * y)

    def __len__(self) -> int:
        return len(self.place)

    def __getitem__(
        self, index: NDArray[np.intp] | NDArray[np.bool_] | list[int] | slice,
    ) -> Poses:
        return Poses(self.rotation[index], self.place[index])

    def __matmul__(self, step: Pose2) -> Poses:
        """Compose each with the same step, as of :class:`.Pose2`."""
        return Poses(
            self.rotation * complex(math.cos(step.yaw), math.sin(step.yaw)),
            self.place + self.rotation * complex(step.x, step.y))

    def listed(self) -> list[Pose2]:
        """Each of them."""
        place, yaw = self.place, np.angle(self.rotation)
        return list(map(Pose2, place.real.tolist(), place.imag.tolist(), yaw.tolist()))


def same_pose(a: Pose2, b: Pose2, apart: tuple[float, float] = (0.0, 0.0)) -> bool:
    """Whether two poses are close enough to converge to one.

    :param apart: by which one may have moved from the other besides, metres and rad.
    """
    return (math.hypot(a.x - b.x, a.y - b.y) < _SAME_PLACE + apart[0]
            and abs(math.remainder(a.yaw - b.yaw, 2.0 * math.pi)) < SAME_YAW + apart[1])


def unlike(poses: Poses, known: Poses) -> NDArray[np.bool_]:
    """Which of poses are the same as none that is known (H,)."""
    near = np.abs(poses.place[:, None] - known.place) < _SAME_PLACE
    near &= (poses.rotation[:, None] * known.rotation.conj()).real > math.cos(SAME_YAW)
    return np.logical_not(near.any(axis=1))


def one_of_each(poses: Poses, order: NDArray[np.intp]) -> NDArray[np.intp]:
    """Of poses in an order (H,) the first in each cell of places and headings."""
    cells = np.rint(np.stack([
        poses.place.real / _SAME_PLACE, poses.place.imag / _SAME_PLACE,
        np.angle(poses.rotation) / SAME_YAW])[:, order]).astype(np.int64)
    # Cells in a row: a map has far fewer than this a side.
    _, first = np.unique(cells[0] + (cells[1] << 20) + (cells[2] << 40), return_index=True)
    return order[np.sort(first)]


def distinct(poses: Poses, score: Array) -> list[int]:
    """The best of each group of poses that are the same, best first.

    :param poses: (H,).
    :param score: of each (H,).
    :returns: indices into them.
    """
    order = np.argsort(-score, kind='stable')
    # Products of narrow matrices are far cheaper than differences of all with all.
    at = np.stack([part[order].view(np.float64).reshape(-1, 2).astype(np.float32)
                   for part in (poses.place - poses.place.mean(), poses.rotation)])
    product = at @ at.transpose(0, 2, 1)
    square = product[0].diagonal()
    same = square[:, None] + square - 2.0 * product[0] < _SAME_PLACE**2
    same &= product[1] > math.cos(SAME_YAW)
    left = np.ones(len(order), dtype=bool)
    # Most are like no other.
    for k in (same.sum(axis=1) > 1).nonzero()[0].tolist():
        if left[k]:
            left[k + 1:] &= ~same[k, k + 1:]
    return order[left].tolist()
