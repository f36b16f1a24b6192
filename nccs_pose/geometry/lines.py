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

"""Known lines of the world and the map that they make."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property

from nccs_pose.errors import GeometryError
from nccs_pose.geometry.pose import Array, checked_vector, Pose2, RigidTransform
import numpy as np


@dataclass(frozen=True, eq=False)
class Line:
    """A straight line segment in space: l(lambda) = q + lambda d (the paper's eq. 2).

    :ivar start: first end point (3,), metres.
    :ivar end: other end point (3,), metres.
    :ivar width: width of the tape on the ground, metres; 0 for an ideal line.
    :ivar colour: its colour class in the image.
    :ivar name: for messages and diagnostics.
    :raises GeometryError: if the ends coincide or are not finite, if the width is negative,
        or if a line with a width is not horizontal.
    """

    start: Array
    end: Array
    width: float = 0.0
    colour: str = 'green'
    name: str = ''

    def __post_init__(self) -> None:
        for key in ('start', 'end'):
            point = checked_vector(f'line {self.name!r}: {key}', getattr(self, key))
            # What follows from the ends is kept.
            point.setflags(write=False)
            object.__setattr__(self, key, point)
        if self.length < 1e-6:
            raise GeometryError(
                f'line {self.name!r}: start and end coincide at {self.start.tolist()}')
        if not (np.isfinite(self.width) and self.width >= 0.0):
            raise GeometryError(f'line {self.name!r}: width {self.width} is not a length')
        if self.width > 0.0 and not self.is_horizontal:
            raise GeometryError(
                f'line {self.name!r}: only a horizontal line can have a width ({self.width} m)')

    @cached_property
    def length(self) -> float:
        """Length in metres."""
        return float(np.linalg.norm(self.end - self.start))

    @cached_property
    def direction(self) -> Array:
        """Unit direction d (3,) from start to end."""
        return (self.end - self.start) / self.length

    @cached_property
    def left(self) -> Array:
        """Horizontal vector (3,) to the left of the direction; unit if the line is horizontal."""
        return np.array([-self.direction[1], self.direction[0], 0.0])

    @cached_property
    def moment(self) -> Array:
        """Plücker moment mu = q x d (3,), metres."""
        return np.cross(self.start, self.direction)

    @cached_property
    def is_horizontal(self) -> bool:
        """Whether d_z = 0, so that the closed form for floor lines holds."""
        return abs(float(self.direction[2])) < 1e-9

    @cached_property
    def is_tape(self) -> bool:
        """Whether it is a tape on the floor: z = 0, and a width, so that an image shows it."""
        return self.width > 0.0 and self.is_horizontal and abs(float(self.start[2])) < 1e-6

    def edges(self) -> tuple[Line, Line]:
        """The right and the left edge of the tape, each a line of no width."""
        half = 0.5 * self.width * self.left
        return self._shifted(-half), self._shifted(half)

    def _shifted(self, offset: Array) -> Line:
        return replace(self, start=self.start + offset, end=self.end + offset, width=0.0)

    def transformed(self, transform: Pose2 | RigidTransform) -> Line:
        """The same line seen from another frame."""
        return replace(
            self, start=transform.apply(self.start), end=transform.apply(self.end),
            width=self.width if isinstance(transform, Pose2) else 0.0)


@dataclass(frozen=True, eq=False)
class LineMap:
    """The lines of the world, in the map frame.

    :ivar lines: at least one.
    :ivar frame: name of the frame.
    :raises GeometryError: if there is no line.
    """

    lines: tuple[Line, ...]
    frame: str = field(default='map')

    def __post_init__(self) -> None:
        object.__setattr__(self, 'lines', tuple(self.lines))
        if not self.lines:
            raise GeometryError('the map has no line')

    def __len__(self) -> int:
        return len(self.lines)

    def __iter__(self) -> Iterator[Line]:
        return iter(self.lines)

    def __getitem__(self, index: int) -> Line:
        return self.lines[index]

    @cached_property
    def starts(self) -> Array:
        """First end points (L, 3)."""
        return np.array([line.start for line in self.lines])

    @cached_property
    def ends(self) -> Array:
        """Other end points (L, 3)."""
        return np.array([line.end for line in self.lines])

    @cached_property
    def directions(self) -> Array:
        """Unit directions (L, 3)."""
        return np.array([line.direction for line in self.lines])

    @cached_property
    def lefts(self) -> Array:
        """Vectors to the left of the directions (L, 3)."""
        return np.array([line.left for line in self.lines])

    @cached_property
    def moments(self) -> Array:
        """Plücker moments (L, 3)."""
        return np.array([line.moment for line in self.lines])

    @cached_property
    def lengths(self) -> Array:
        """Lengths (L,)."""
        return np.array([line.length for line in self.lines])

    @cached_property
    def widths(self) -> Array:
        """Widths (L,)."""
        return np.array([line.width for line in self.lines])
