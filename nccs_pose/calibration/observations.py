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

"""What frames show of the map's lines, one by one and stacked for one adjustment."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise

from nccs_pose.errors import CalibrationError
from nccs_pose.estimation.estimate import Estimate, State
from nccs_pose.geometry.lines import LineMap
from nccs_pose.geometry.pose import Array, Pose2
from nccs_pose.vision.line_points import LinePoints
import numpy as np
from numpy.typing import NDArray

LEAST_LINES = 2
"""A frame that shows fewer lines fixes no pose."""
# A doubted pose rests on so many: any two have a second one, half a turn about where they meet.
_LEAST_DOUBTED = 3


@dataclass(frozen=True, eq=False)
class FrameObservation:
    """What one image shows of the map's lines.

    :ivar stamp_ns: the image's stamp, nanoseconds.
    :ivar points: N measured points; their labels are indices of map lines.
    :ivar side: which part of the tape each point is on (N,): -1 its right edge seen from start
        to end, 0 its middle, +1 its left edge.
    :raises CalibrationError: if the lengths differ, or a point has no line.
    """

    stamp_ns: int
    points: LinePoints
    side: NDArray[np.int8]

    def __post_init__(self) -> None:
        side = np.asarray(self.side, dtype=np.int8)
        object.__setattr__(self, 'side', side)
        if side.shape != (len(self.points),):
            raise CalibrationError(
                f'frame {self.stamp_ns}: {len(self.points)} points and {side.shape} sides do '
                'not belong together')
        if len(self.points) and self.points.label.min() < 0:
            raise CalibrationError(f'frame {self.stamp_ns}: a point has no line (label -1)')

    @classmethod
    def of_middles(cls, stamp_ns: int, points: LinePoints) -> FrameObservation:
        """From points on the middle of the tapes."""
        return cls(stamp_ns, points, np.zeros(len(points), dtype=np.int8))

    @property
    def lines(self) -> NDArray[np.intp]:
        """Indices of the lines that are seen."""
        return np.unique(self.points.label)

    def thinned(self, most: int) -> FrameObservation:
        """The same with at most so many points of each edge of each line, evenly spread."""
        keep = np.zeros(len(self.points), dtype=bool)
        edge = 3 * self.points.label + self.side
        for value in np.unique(edge):
            rows = np.flatnonzero(edge == value)
            keep[rows[evenly(len(rows), most)]] = True
        return FrameObservation(self.stamp_ns, self.points[keep], self.side[keep])


def evenly(count: int, most: int) -> NDArray[np.intp]:
    """The numbers of at most so many of a count of things, evenly spread from first to last."""
    return np.linspace(0, count - 1, min(count, most)).round().astype(np.intp)


def observed(estimate: Estimate, *, doubted: bool) -> tuple[FrameObservation, Pose2] | None:
    """What an answer of the localiser says of the lines, and the pose by which it says so.

    :param doubted: take a pose that it doubts as well, if that rests on three lines.
    :returns: None where there is no such pose, or no line.
    """
    pose, points, least = estimate.pose, estimate.points, 1
    if estimate.state is not State.TRACKING:
        if not doubted or estimate.doubted is None:
            return None
        pose, points, least = estimate.doubted.pose, estimate.doubted.points, _LEAST_DOUBTED
    if pose is None or points is None:
        return None
    frame = FrameObservation.of_middles(estimate.stamp_ns, points[points.label >= 0])
    return (frame, pose) if len(frame.lines) >= least else None


@dataclass(frozen=True, eq=False)
class Observations:
    """The points of F frames one after the other, N in all.

    :ivar pixels: (N, 2).
    :ivar sigma: standard deviation along the curve's normal (N,), px.
    :ivar line: index of the map line (N,).
    :ivar side: -1, 0 or +1 (N,), see :class:`FrameObservation`.
    :ivar frame: index of the frame (N,), ascending.
    :ivar stamps_ns: the frames' stamps, F of them.
    """

    pixels: Array
    sigma: Array
    line: NDArray[np.intp]
    side: NDArray[np.int8]
    frame: NDArray[np.intp]
    stamps_ns: tuple[int, ...]

    @classmethod
    def stack(cls, frames: Iterable[FrameObservation], line_map: LineMap) -> Observations:
        """Put frames together.

        :raises CalibrationError: without a frame, or if a label is no line of the map.
        """
        frames = tuple(frames)
        if not frames:
            raise CalibrationError('there is no frame to calibrate from')
        for frame in frames:
            if len(frame.points) and frame.points.label.max() >= len(line_map):
                raise CalibrationError(
                    f'frame {frame.stamp_ns}: label {frame.points.label.max()} is no line of a '
                    f'map of {len(line_map)}')
        return cls(
            np.concatenate([frame.points.pixels for frame in frames]).astype(float),
            np.concatenate([frame.points.sigma for frame in frames]).astype(float),
            np.concatenate([frame.points.label for frame in frames]).astype(np.intp),
            np.concatenate([frame.side for frame in frames]),
            np.repeat(np.arange(len(frames)), [len(frame.points) for frame in frames]),
            tuple(frame.stamp_ns for frame in frames))

    def __len__(self) -> int:
        return len(self.sigma)

    @property
    def frames(self) -> int:
        """How many frames."""
        return len(self.stamps_ns)

    def slices(self) -> list[slice]:
        """The rows of each frame."""
        ends = np.searchsorted(self.frame, np.arange(self.frames + 1))
        return [slice(int(a), int(b)) for a, b in pairwise(ends)]

    def chosen(self, frames: Sequence[int] | NDArray[np.intp]) -> Observations:
        """The observations of some frames, in that order."""
        parts = self.slices()
        rows = np.concatenate([np.arange(parts[f].start, parts[f].stop) for f in frames])
        counts = [parts[f].stop - parts[f].start for f in frames]
        return Observations(
            self.pixels[rows], self.sigma[rows], self.line[rows], self.side[rows],
            np.repeat(np.arange(len(frames)), counts), tuple(self.stamps_ns[f] for f in frames))
