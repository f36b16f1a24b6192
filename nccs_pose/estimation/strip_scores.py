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

"""How well poses explain the strips of an image."""

from __future__ import annotations

from dataclasses import dataclass

from nccs_pose.estimation.floor_segments import FloorSegment
from nccs_pose.estimation.many_poses import Poses
from nccs_pose.estimation.nearest_lines import NearestLines
from nccs_pose.estimation.strip_pairs import BEYOND, FloorLines, StripLines
from nccs_pose.geometry.floor_scale import FloorScale
from nccs_pose.geometry.floor_table import Complex
from nccs_pose.geometry.pose import Array
from nccs_pose.geometry.small_matrices import solve_each_definite
import numpy as np
from numpy.typing import NDArray

# Samples on each strip and on what is near of each map line.
_SAMPLES = 12
# No sample of a line counts for more than this, px of the image.
_LONGEST_SAMPLE = 60.0
# Fewer samples than this on lines refine no pose.
_LEAST_SAMPLES = 4
# Of more than so many lines only those that lie differently to the robot are looked at: those
# that begin, end and point within so much of each other look the same, metres and rad.
_MANY = 2000
_SAME_PLACE = 0.01
_SAME_ANGLE = 0.005
# Thousands of poses are looked at so many at a time, which the processor has at hand.
_AT_ONCE = 256
# What keeps a direction that no sample fixes where it is.
_DAMPING = 1e-6 * np.eye(3)


@dataclass(frozen=True, eq=False)
class SeenMap:
    """A map, and how the rig sees its floor."""

    lines: FloorLines
    nearest: NearestLines
    scale: FloorScale


class StripScorer:
    """How well poses explain the strips of one image."""

    def __init__(self, segments: tuple[FloorSegment, ...], seen: SeenMap) -> None:
        self.segments = segments
        self.strips = strips = StripLines(segments)
        self._lines, self._nearest, self._scale = seen.lines, seen.nearest, seen.scale
        footprint, weight, pitch = np.array(
            [(s.footprint, s.weight, s.pitch) for s in segments]).T
        share = (np.arange(_SAMPLES) + 0.5) / _SAMPLES
        self._share = share
        self._points = (strips.start[:, None] + (
            strips.length * strips.direction)[:, None] * share).ravel()
        self._weight = np.repeat(weight / weight.sum() / _SAMPLES, _SAMPLES)
        tolerance = np.array([s.tolerance for s in segments])
        self._tolerance = np.repeat(tolerance, _SAMPLES)
        self._pixels_per_metre = np.repeat(pitch / np.maximum(footprint, 1e-9), _SAMPLES)
        self._layer = np.repeat(seen.nearest.layers(strips.colour), _SAMPLES)
        # Where a point x, y, 1 is along each strip and across it, within 1 if it lies in it.
        frames = np.stack([strips.direction / (0.5 * strips.length + BEYOND),
                           1j * strips.direction / tolerance])
        self._frames = np.stack([
            frames.real, frames.imag, -(frames * strips.middle.conj()).real],
            axis=2).reshape(-1, 3).astype(np.float32)

    def _on_lines(
        self, poses: Poses, step: int = 1,
    ) -> tuple[NDArray[np.bool_], NDArray[np.intp], Array]:
        """Whether each sample (H, P) lies on a map line, which one, and how far off it.

        :param step: look at one sample out of so many.
        """
        some = slice(step // 2, None, step)
        points = poses.rotation[:, None] * self._points[some] + poses.place[:, None]
        which, across = self._nearest.at(points, self._layer[some])
        return np.abs(across) < self._tolerance[some], which, across

    def claimed(self, poses: Poses, step: int = 1) -> Array:
        """Fraction of the strips' pixels on map lines (H,), by one sample out of ``step``."""
        on = np.concatenate([
            self._on_lines(poses[k:k + _AT_ONCE], step)[0]
            for k in range(0, max(len(poses), 1), _AT_ONCE)])
        weight = self._weight[step // 2::step]
        return on @ (weight / weight.sum())

    def explained(self, poses: Poses, step: int = 1) -> Array:
        """Fraction of the map lines in view that strips lie on (H,).

        :param step: look at one sample of each line out of so many.
        """
        lines, share = self._lines, self._share[step // 2::step]
        # Of each line only what is within reach.
        foot = poses.place + poses.rotation * self._scale.foot
        seen = (foot[:, None] - lines.start) * lines.direction.conj()
        half = np.sqrt(np.maximum(self._scale.reach**2 - np.square(seen.imag), 0.0))
        first = np.maximum(seen.real - half, 0.0)
        length = np.minimum(seen.real + half, lines.length) - first
        pose, line = np.nonzero(length > 0.0)
        first, length = first[pose, line], length[pose, line]
        to_base = poses.rotation[pose].conj()
        along = lines.direction[line] * to_base
        begin = (lines.start[line] - poses.place[pose]) * to_base + first * along
        if len(begin) > _MANY:
            # On a map that repeats itself many poses see lines in the very same places.
            ones, kind = _one_of_each(begin, length, along)
            total, covered = (part[kind] for part in self._seen(
                begin[ones], length[ones], along[ones], share))
        else:
            total, covered = self._seen(begin, length, along, share)
        count = len(poses)
        return np.bincount(pose, covered, count) / np.maximum(
            np.bincount(pose, total, count), 1e-9)

    def _seen(
        self, begin: Complex, length: Array, along: Complex, share: Array,
    ) -> tuple[Array, Array]:
        """How much of the image lines fill, and how much of that strips lie on (K,), px.

        :param begin: where they begin in base_link, x + iy (K,), metres.
        :param along: their directions, unit (K,).
        :param share: which parts of their lengths are looked at.
        """
        points = begin[:, None] + (length * along)[:, None] * share
        # A metre of tape far away fills fewer pixels: count it by its length in the image.
        weight = np.minimum(
            self._scale.pixels(points, (length / _SAMPLES * along)[:, None]), _LONGEST_SAMPLE)
        at = np.ones((3, *points.shape), np.float32)
        at[0], at[1] = points.real, points.imag
        off = self._frames @ at.reshape(3, -1)
        inside = np.abs(off, out=off) < 1.0
        on = (inside[:len(inside) // 2] & inside[len(inside) // 2:]).any(axis=0)
        return weight.sum(axis=1), (weight * on.reshape(weight.shape)).sum(axis=1)

    def refined(
        self, poses: Poses, rounds: int, step: int = 1,
    ) -> tuple[Poses, Array, Array]:
        """Lay the strips on their lines by least squares on the floor, from poses (H,).

        :param rounds: how often.
        :param step: look at one sample out of so many.
        :returns: the poses, the fraction of the strips' pixels on map lines (H,), and the root
            mean square distance of these (H,), px; 0 if none is on any. Of a last step that is
            small enough both are as it says that they will be.
        """
        some = slice(step // 2, None, step)
        tolerance, points, share = self._tolerance[some], self._points[some], self._weight[some]
        inverse, share = 1.0 / tolerance, share / share.sum()
        rows = np.empty((len(poses), 4, len(inverse)))
        for _ in range(rounds):
            on, which, across = self._on_lines(poses, step)
            weight = on * inverse
            normal = self._nearest.normal.take(which) * weight
            turned = poses.rotation[:, None] * points
            # Derivatives of the distances by x, y and yaw, and the distances.
            rows[:, 0], rows[:, 1] = normal.real, normal.imag
            rows[:, 2] = (normal * turned.conj()).imag
            np.multiply(across, weight, out=rows[:, 3])
            products = rows @ rows.transpose(0, 2, 1)
            change = solve_each_definite(products[:, :3, :3] + _DAMPING, products[:, :3, 3])
            change[on.sum(axis=1) < _LEAST_SAMPLES] = 0.0
            poses = Poses(poses.rotation * np.exp(-1j * change[:, 2]),
                          poses.place - change[:, 0] - 1j * change[:, 1])
        across -= (change[:, None] @ rows[:, :3])[:, 0] * tolerance
        on &= np.abs(across) < tolerance
        square = np.square(np.where(on, across, 0.0) * self._pixels_per_metre[some])
        total = on @ share
        return poses, total, np.sqrt(square @ share / np.maximum(total, 1e-9))


def _one_of_each(
    begin: Complex, length: Array, along: Complex,
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Of lines (K,) those that lie differently to the robot, and which of them each is like."""
    cells = np.rint(np.stack([
        begin.real / _SAME_PLACE, begin.imag / _SAME_PLACE, length / _SAME_PLACE,
        np.angle(along) / _SAME_ANGLE])).astype(np.int64)
    # No line that is near enough to be seen is many thousand cells long or away.
    number = cells[0] + (cells[1] << 16) + (cells[2] << 32) + (cells[3] << 48)
    order = number.argsort()
    number = number[order]
    differs = np.ones(len(order), dtype=bool)
    differs[1:] = number[1:] != number[:-1]
    kind = np.empty(len(order), np.intp)
    kind[order] = np.cumsum(differs) - 1
    return order[differs], kind
