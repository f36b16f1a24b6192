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

"""Which strip of floor is which line of the map, and so where the robot is, from one image.

Every pair of strips laid on every pair of map lines with the same angle between them fixes a
pose but for a half turn; extents and all other strips decide. What comes out is every pose that
explains the image, best first.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

from nccs_pose.estimation.estimate import Candidate
from nccs_pose.estimation.floor_segments import FloorSegment
from nccs_pose.estimation.nearest_lines import NearestLines
from nccs_pose.estimation.strip_pairs import BEYOND, FloorLines, poses_of_pairs, StripLines
from nccs_pose.estimation.told import Told
from nccs_pose.geometry.floor_scale import FloorScale
from nccs_pose.geometry.floor_table import Complex, FloorTable
from nccs_pose.geometry.lines import LineMap
from nccs_pose.geometry.pose import Array, Pose2, wrap_angle
from nccs_pose.geometry.small_matrices import definite_solutions
import numpy as np
from numpy.typing import NDArray

# Pairs of strips that start hypotheses; of these so many are looked at closely, by every third
# sample of the strips, and so many are refined. No more than these are told.
_PAIRS = 15
_CLOSE = 300
_COARSE = 3
_REFINED = 24
_ROUNDS = 2
# Samples on each strip and on what is near of each map line.
_SAMPLES = 12
# No sample of a line counts for more than this, px of the image.
_LONGEST_SAMPLE = 60.0
# Fewer samples than this on lines refine no pose.
_LEAST_SAMPLES = 4
# What keeps a direction that no sample fixes where it is.
_DAMPING = 1e-6 * np.eye(3)
# Tapes whose ends are this close look the same, metres.
_SAME_TAPE = 0.05
# Poses this close are the same, metres and rad.
_SAME_PLACE = 0.25
_SAME_YAW = 0.15


@dataclass(frozen=True)
class FittedCandidate(Candidate):
    """A pose that explains strips.

    :ivar claimed: fraction of the strips' pixels that lie on map lines.
    :ivar misfit: how far the strips lie off the lines that it lays them on, root mean square, px;
        0 where it is not known.
    """

    claimed: float
    misfit: float = 0.0


class Associator:
    """Finds and scores poses by the strips of an image, on one rig and map.

    A pose's score is the harmonic mean of two fractions: of the strips' pixels that lie on map
    lines, and of the map lines in view that strips lie on.
    """

    def __init__(self, line_map: LineMap, table: FloorTable) -> None:
        lines = FloorLines(line_map)
        self._place = _Place(lines, NearestLines(lines), FloorScale(table))
        self._last: _Scorer | None = None

    def candidates(
        self, segments: tuple[FloorSegment, ...], told: Told | None = None,
    ) -> tuple[FittedCandidate, ...]:
        """Poses that explain strips, best first; none where fewer than two strips cross.

        The best few are laid on the strips by least squares; where a map has many places alike
        the others follow as they were guessed, with what they score there.

        :param told: where the robot is by something else; poses there are not left out for others
            that explain as much.
        """
        if len(segments) < 2:
            return ()
        scorer = self._scorer(segments)
        poses = _Poses(*poses_of_pairs(scorer.strips, self._place.lines, _PAIRS))
        if len(poses.place) == 0:
            return ()
        guessed: list[FittedCandidate] = []
        if len(poses.place) > _REFINED:
            claimed = scorer.claimed(poses, _COARSE)
            there = np.zeros(len(claimed), dtype=bool) if told is None else (
                told.holds_guesses(poses.place, poses.rotation))
            best = np.lexsort([-claimed, ~there])
            if len(best) > _CLOSE:
                best = _one_of_each(poses, best)[:_CLOSE]
            poses, claimed, there = poses[best], claimed[best], there[best]
            score = _harmonic(claimed, scorer.explained(poses, _COARSE))
            found = sorted(_distinct(poses, score), key=lambda k: not there[k])
            guessed = [FittedCandidate(poses.pose(k), float(score[k]), float(claimed[k]))
                       for k in found[_REFINED:]]
            poses = poses[found[:_REFINED]]
        poses, claimed, misfit = scorer.refined(poses)
        score = _harmonic(claimed, scorer.explained(poses))
        refined = [
            FittedCandidate(poses.pose(k), float(score[k]), float(claimed[k]), float(misfit[k]))
            for k in _distinct(poses, score)]
        return tuple(sorted((*refined, *guessed), key=lambda c: -c.score))

    def score(self, pose: Pose2, segments: tuple[FloorSegment, ...]) -> tuple[float, float]:
        """The score that a pose would have among the candidates, and the strips' part in it.

        :returns: the score, 0 to 1, and the fraction of the strips' pixels that lie on map lines;
            both 0 where there are no strips.
        """
        if not segments:
            return 0.0, 0.0
        scorer = self._scorer(segments)
        at = _Poses(np.array([complex(math.cos(pose.yaw), math.sin(pose.yaw))]),
                    np.array([complex(pose.x, pose.y)]))
        claimed = scorer.claimed(at)
        return float(_harmonic(claimed, scorer.explained(at))[0]), float(claimed[0])

    def _scorer(self, segments: tuple[FloorSegment, ...]) -> _Scorer:
        """Of the strips, which are most often those that were last asked about."""
        if self._last is None or self._last.segments is not segments:
            self._last = _Scorer(segments, self._place)
        return self._last


def map_symmetries(line_map: LineMap) -> tuple[Pose2, ...]:
    """Every motion S of the map that lays its tapes on tapes of the same length and colour.

    From S @ T_map_base the map looks as it does from T_map_base. The identity comes first; a map
    without symmetry has nothing else.
    """
    ends = np.stack([line_map.starts[:, :2], line_map.ends[:, :2]], axis=1)
    colours = np.array([line.colour for line in line_map])
    alike = colours[:, None] == colours
    alike &= np.abs(line_map.lengths[:, None] - line_map.lengths) < _SAME_TAPE
    # Every such motion turns about the tapes' common centre of gravity.
    centre = line_map.lengths @ ends.mean(axis=1) / line_map.lengths.sum()
    x, y = centre.tolist()
    heading = np.arctan2(line_map.directions[:, 1], line_map.directions[:, 0])
    # The tape that may lie on the fewest others leaves the fewest turns to try.
    first = int(alike.sum(axis=1).argmin())
    turns = (heading[alike[first]] - heading[first])[:, None] + [0.0, np.pi]
    found = [Pose2(0.0, 0.0, 0.0)]
    for turn in np.sort(turns.ravel() % (2.0 * np.pi)):
        motion = Pose2(x, y, float(turn)) @ Pose2(-x, -y, 0.0)
        moved = motion.apply(ends.reshape(-1, 2)).reshape(ends.shape)
        off = np.minimum(
            *(np.linalg.norm(moved[:, None] - there, axis=3).max(axis=2)
              for there in (ends, ends[:, ::-1])))
        lands = (alike & (off < _SAME_TAPE)).any(axis=1).all()
        if lands and all(abs(wrap_angle(motion.yaw - other.yaw)) > _SAME_YAW for other in found):
            found.append(motion)
    return tuple(found)


@dataclass(frozen=True, eq=False)
class _Place:
    """A map, and how the rig sees its floor."""

    lines: FloorLines
    nearest: NearestLines
    scale: FloorScale


@dataclass(frozen=True, eq=False)
class _Poses:
    """H poses T_map_base: rotations, unit complex numbers (H,), and places x + iy (H,), metres."""

    rotation: Complex
    place: Complex

    def __getitem__(self, index: NDArray[np.intp] | list[int]) -> _Poses:
        return _Poses(self.rotation[index], self.place[index])

    def pose(self, index: int) -> Pose2:
        """One of them."""
        place, rotation = complex(self.place[index]), complex(self.rotation[index])
        return Pose2(place.real, place.imag, math.atan2(rotation.imag, rotation.real))


class _Scorer:
    """How well poses explain the strips of one image."""

    def __init__(self, segments: tuple[FloorSegment, ...], place: _Place) -> None:
        self.segments = segments
        self.strips = strips = StripLines(segments)
        self._lines, self._nearest, self._scale = place.lines, place.nearest, place.scale
        footprint, weight, pitch = np.array(
            [(s.footprint, s.weight, s.pitch) for s in segments]).T
        share = (np.arange(_SAMPLES) + 0.5) / _SAMPLES
        self._share = share
        self._points = (strips.start[:, None] + (
            strips.length * strips.direction)[:, None] * share).ravel()
        self._weight = np.repeat(weight / weight.sum() / _SAMPLES, _SAMPLES)
        tolerance = 0.06 + 1.5 * footprint
        self._tolerance = np.repeat(tolerance, _SAMPLES)
        self._pixels_per_metre = np.repeat(pitch / np.maximum(footprint, 1e-9), _SAMPLES)
        self._layer = np.repeat(place.nearest.layers(strips.colour), _SAMPLES)
        # Where a point x, y, 1 is along each strip and across it, within 1 if it lies in it.
        frames = np.stack([strips.direction / (0.5 * strips.length + BEYOND),
                           1j * strips.direction / tolerance])
        self._frames = np.stack([
            frames.real, frames.imag, -(frames * strips.middle.conj()).real],
            axis=2).reshape(-1, 3).astype(np.float32)

    def _on_lines(
        self, poses: _Poses, step: int = 1,
    ) -> tuple[NDArray[np.bool_], NDArray[np.intp], Array]:
        """Whether each sample (H, P) lies on a map line, which one, and how far off it.

        :param step: look at one sample out of so many.
        """
        some = slice(step // 2, None, step)
        points = poses.rotation[:, None] * self._points[some] + poses.place[:, None]
        which, across = self._nearest.at(points, self._layer[some])
        return np.abs(across) < self._tolerance[some], which, across

    def claimed(self, poses: _Poses, step: int = 1) -> Array:
        """Fraction of the strips' pixels on map lines (H,), by one sample out of ``step``."""
        on, _, _ = self._on_lines(poses, step)
        weight = self._weight[step // 2::step]
        return on @ (weight / weight.sum())

    def explained(self, poses: _Poses, step: int = 1) -> Array:
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
        points = begin[:, None] + (length * along)[:, None] * share
        # A metre of tape far away fills fewer pixels: count it by its length in the image.
        weight = np.minimum(
            self._scale.pixels(points, (length / _SAMPLES * along)[:, None]), _LONGEST_SAMPLE)
        at = np.ones((3, *points.shape), np.float32)
        at[0], at[1] = points.real, points.imag
        off = self._frames @ at.reshape(3, -1)
        inside = np.abs(off, out=off) < 1.0
        on = (inside[:len(inside) // 2] & inside[len(inside) // 2:]).any(axis=0)
        covered = weight * on.reshape(weight.shape)
        count = len(poses.place)
        total = np.bincount(pose, weight.sum(axis=1), count)
        return np.bincount(pose, covered.sum(axis=1), count) / np.maximum(total, 1e-9)

    def refined(self, poses: _Poses) -> tuple[_Poses, Array, Array]:
        """Lay the strips on their lines by least squares on the floor, from poses (H,).

        :returns: the poses, the fraction of the strips' pixels on map lines (H,), and the root
            mean square distance of these (H,), px; 0 if none is on any. Of a last step that is
            small enough both are as it says that they will be.
        """
        inverse = 1.0 / self._tolerance
        count = len(poses.place)
        rows = np.empty((count, 4, len(inverse)))
        for _ in range(_ROUNDS):
            on, which, across = self._on_lines(poses)
            weight = on * inverse
            normal = self._nearest.normal.take(which) * weight
            turned = poses.rotation[:, None] * self._points
            # Derivatives of the distances by x, y and yaw, and the distances.
            rows[:, 0], rows[:, 1] = normal.real, normal.imag
            rows[:, 2] = (normal * turned.conj()).imag
            np.multiply(across, weight, out=rows[:, 3])
            products = rows @ rows.transpose(0, 2, 1)
            step = definite_solutions(products[:, :3, :3] + _DAMPING, products[:, :3, 3])
            step[on.sum(axis=1) < _LEAST_SAMPLES] = 0.0
            poses = _Poses(poses.rotation * np.exp(-1j * step[:, 2]),
                           poses.place - step[:, 0] - 1j * step[:, 1])
        across -= (step[:, None] @ rows[:, :3])[:, 0] * self._tolerance
        on &= np.abs(across) < self._tolerance
        square = np.square(np.where(on, across, 0.0) * self._pixels_per_metre)
        total = on @ self._weight
        return poses, total, np.sqrt(square @ self._weight / np.maximum(total, 1e-9))


def _harmonic(a: Array, b: Array) -> Array:
    return 2.0 * a * b / np.maximum(a + b, 1e-9)


def _one_of_each(poses: _Poses, order: NDArray[np.intp]) -> NDArray[np.intp]:
    """Of poses in an order (H,) the first in each cell of places and headings."""
    cells = np.rint(np.stack([
        poses.place.real / _SAME_PLACE, poses.place.imag / _SAME_PLACE,
        np.angle(poses.rotation) / _SAME_YAW])[:, order]).astype(np.int64)
    # Cells in a row: a map has far fewer than this a side.
    _, first = np.unique(cells[0] + (cells[1] << 20) + (cells[2] << 40), return_index=True)
    return order[np.sort(first)]


def _distinct(poses: _Poses, score: Array) -> list[int]:
    """The best of each group of poses that are the same, best first."""
    order = np.argsort(-score, kind='stable')
    place, rotation = poses.place[order], poses.rotation[order]
    same = np.abs(place - place[:, None]) < _SAME_PLACE
    same &= (rotation * rotation[:, None].conj()).real > math.cos(_SAME_YAW)
    found: list[int] = []
    left = np.ones(len(order), dtype=bool)
    while left.any():
        first = int(left.argmax())
        found.append(int(order[first]))
        left &= ~same[first]
    return found


def same_pose(a: Pose2, b: Pose2) -> bool:
    """Whether two poses are close enough to converge to one."""
    return (math.hypot(a.x - b.x, a.y - b.y) < _SAME_PLACE
            and abs(math.remainder(a.yaw - b.yaw, 2.0 * math.pi)) < _SAME_YAW)
