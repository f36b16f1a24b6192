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
from nccs_pose.estimation.strip_pairs import BEYOND, FloorLines, poses_of_pairs
from nccs_pose.geometry.floor_table import FloorTable
from nccs_pose.geometry.lines import LineMap
from nccs_pose.geometry.pose import Array, Pose2, wrap_angle
import numpy as np
from numpy.typing import NDArray

# Strips that start hypotheses, and hypotheses that are looked at closely.
_SEEDS = 6
_CLOSE = 200
# Above this number every fourth sample tells which hypotheses are worth a closer look.
_MANY = 400
_COARSE = 4
_REFINED = 24
_ROUNDS = 2
# Samples on each strip and on each map line.
_SAMPLES = 12
# Fewer samples than this on lines refine no pose.
_LEAST_SAMPLES = 4
# Tapes whose ends are this close look the same, metres.
_SAME_TAPE = 0.05
# Poses this close are the same, metres and rad.
_SAME_PLACE = 0.25
_SAME_YAW = 0.15


@dataclass(frozen=True)
class FittedCandidate(Candidate):
    """A pose that explains strips.

    :ivar misfit: how far the strips lie off the lines that it lays them on, root mean square, px.
    """

    misfit: float


def global_candidates(
    segments: tuple[FloorSegment, ...], line_map: LineMap, table: FloorTable, most: int = 8,
) -> tuple[FittedCandidate, ...]:
    """Poses that explain the strips, best first; none where fewer than two strips cross.

    A candidate's score is the harmonic mean of two fractions: of the strips' pixels that lie on
    map lines, and of the map lines in view that strips lie on.
    """
    lines = FloorLines.of(line_map)
    poses = poses_of_pairs(segments[:_SEEDS], lines)
    if len(poses) == 0:
        return ()
    scorer = _Scorer(segments, lines, table)
    if len(poses) > _MANY:
        poses = poses[np.argsort(-scorer.claimed(poses, _COARSE), kind='stable')[:_MANY]]
    if len(poses) > _REFINED:
        poses = poses[np.argsort(-scorer.claimed(poses), kind='stable')[:_CLOSE]]
        poses = poses[np.argsort(-scorer.score(poses), kind='stable')[:_REFINED]]
    refined = scorer.refine(poses)
    claimed, misfit = scorer.fit(refined)
    return _distinct(refined, _harmonic(claimed, scorer.explained(refined)), misfit, most)


def score_pose(
    pose: Pose2, segments: tuple[FloorSegment, ...], line_map: LineMap, table: FloorTable,
) -> tuple[float, float]:
    """The score that :func:`global_candidates` would give a pose, and the strips' part in it.

    :returns: the score, 0 to 1, and the fraction of the strips' pixels that lie on map lines;
        both 0 where there are no strips.
    """
    if not segments:
        return 0.0, 0.0
    scorer = _Scorer(segments, FloorLines.of(line_map), table)
    at = pose.as_array()[None]
    claimed = scorer.claimed(at)
    return float(_harmonic(claimed, scorer.explained(at))[0]), float(claimed[0])


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


class _Scorer:
    """How well poses explain the strips of one image."""

    def __init__(
        self, segments: tuple[FloorSegment, ...], lines: FloorLines, table: FloorTable,
    ) -> None:
        self._lines = lines
        self._table = table
        # A strip of one colour lies on no line of another.
        self._foreign = np.array([
            np.repeat([s.colour != colour for s in segments], _SAMPLES)
            for colour in lines.colour])
        share = (np.arange(_SAMPLES) + 0.5) / _SAMPLES
        starts = np.array([s.start for s in segments])
        ends = np.array([s.end for s in segments])
        self._points = (starts[:, None] + share[:, None] * (ends - starts)[:, None]).reshape(-1, 2)
        self._weight = np.repeat([s.weight / _SAMPLES for s in segments], _SAMPLES)
        self._tolerance = np.repeat([0.06 + 1.5 * s.footprint for s in segments], _SAMPLES)
        self._pixels_per_metre = np.repeat(
            [s.pitch / max(s.footprint, 1e-9) for s in segments], _SAMPLES)
        length = np.hypot(*(ends - starts).T)
        self._spans = list(zip(
            starts.tolist(), ((ends - starts) / length[:, None]).tolist(), length.tolist(),
            [0.06 + 1.5 * s.footprint for s in segments]))
        self._map_points = (
            lines.start[:, None]
            + (share * lines.length[:, None])[..., None] * lines.direction[:, None]
        ).reshape(-1, 2)
        # Each sample's neighbours on its line.
        index = np.arange(_SAMPLES)
        self._before = np.maximum(index - 1, 0)
        self._after = np.minimum(index + 1, _SAMPLES - 1)
        self._between = self._after - self._before

    def _on_lines(
        self, poses: Array, step: int = 1,
    ) -> tuple[NDArray[np.bool_], NDArray[np.intp], Array]:
        """Whether each sample (H, P) lies on a map line, which one, and how far off it.

        :param step: look at one sample out of so many.
        """
        points = self._points[step // 2::step]
        c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
        x = c[:, None] * points[:, 0] - s[:, None] * points[:, 1] + poses[:, :1]
        y = s[:, None] * points[:, 0] + c[:, None] * points[:, 1] + poses[:, 1:2]
        lines = self._lines
        best = np.full(x.shape, np.inf)
        which = np.zeros(x.shape, dtype=np.intp)
        # One line at a time keeps the arrays small where maps are large.
        for k in range(len(lines.length)):
            across = lines.normal[k, 0] * x + lines.normal[k, 1] * y - lines.offset[k]
            along = (lines.direction[k, 0] * (x - lines.start[k, 0])
                     + lines.direction[k, 1] * (y - lines.start[k, 1]))
            outside = ((along < -BEYOND) | (along > lines.length[k] + BEYOND)
                       | self._foreign[k, step // 2::step])
            distance = np.where(outside, np.inf, np.abs(across))
            closer = distance < best
            best = np.where(closer, distance, best)
            which = np.where(closer, k, which)
        return best < self._tolerance[step // 2::step], which, best

    def claimed(self, poses: Array, step: int = 1) -> Array:
        """Fraction of the strips' pixels on map lines (H,), by one sample out of ``step``."""
        on, _, _ = self._on_lines(poses, step)
        weight = self._weight[step // 2::step]
        return on @ weight / weight.sum()

    def fit(self, poses: Array) -> tuple[Array, Array]:
        """Fraction of the strips' pixels on map lines (H,), and how far off these they are.

        :returns: the fraction, and the root mean square distance (H,), px; 0 if none is on any.
        """
        on, _, distance = self._on_lines(poses)
        square = np.square(np.where(on, distance, 0.0) * self._pixels_per_metre)
        total = on @ self._weight
        return total / self._weight.sum(), np.sqrt(square @ self._weight / np.maximum(total, 1e-9))

    def explained(self, poses: Array) -> Array:
        """Fraction of the map lines in view that strips lie on (H,)."""
        h, points = len(poses), self._map_points
        c, s = np.cos(poses[:, 2, None]), np.sin(poses[:, 2, None])
        dx, dy = points[:, 0] - poses[:, :1], points[:, 1] - poses[:, 1:2]
        x, y = c * dx + s * dy, c * dy - s * dx
        pixels = self._table.pixels(np.column_stack([x.ravel(), y.ravel()]))
        seen = self._table.sees_floor(pixels).reshape(h, -1)
        # A metre of tape far away fills fewer pixels: count it by its length in the image.
        image = pixels.reshape(h, -1, _SAMPLES, 2)
        step = image[:, :, self._after] - image[:, :, self._before]
        length = np.hypot(step[..., 0], step[..., 1]) / self._between
        weight = seen * np.minimum(length.reshape(h, -1), 60.0)
        covered = np.zeros(seen.shape, dtype=bool)
        for start, along, length_, tolerance in self._spans:
            off_x, off_y = x - start[0], y - start[1]
            reach = off_x * along[0] + off_y * along[1]
            across = off_y * along[0] - off_x * along[1]
            covered |= ((np.abs(across) < tolerance) & (reach > -BEYOND)
                        & (reach < length_ + BEYOND))
        return (weight * covered).sum(axis=1) / np.maximum(weight.sum(axis=1), 1e-9)

    def score(self, poses: Array) -> Array:
        """Harmonic mean of both fractions (H,)."""
        return _harmonic(self.claimed(poses), self.explained(poses))

    def refine(self, poses: Array) -> Array:
        """Lay the strips on their lines by least squares on the floor, from poses (H, 3)."""
        lines, inverse = self._lines, 1.0 / self._tolerance
        for _ in range(_ROUNDS):
            on, which, _ = self._on_lines(poses)
            c, s = np.cos(poses[:, 2, None]), np.sin(poses[:, 2, None])
            x = c * self._points[:, 0] - s * self._points[:, 1]
            y = s * self._points[:, 0] + c * self._points[:, 1]
            nx, ny = lines.normal[which, 0], lines.normal[which, 1]
            error = nx * (x + poses[:, :1]) + ny * (y + poses[:, 1:2]) - lines.offset[which]
            weight = on * inverse
            jacobian = np.stack([nx, ny, ny * x - nx * y], axis=2) * weight[..., None]
            normal_matrix = np.einsum('hpi,hpj->hij', jacobian, jacobian) + 1e-6 * np.eye(3)
            slope = np.einsum('hpi,hp->hi', jacobian, error * weight)
            step = np.linalg.solve(normal_matrix, slope[..., None])[..., 0]
            poses = np.where(on.sum(axis=1)[:, None] < _LEAST_SAMPLES, poses, poses - step)
        return poses


def _harmonic(a: Array, b: Array) -> Array:
    return 2.0 * a * b / np.maximum(a + b, 1e-9)


def _distinct(
    poses: Array, score: Array, misfit: Array, most: int,
) -> tuple[FittedCandidate, ...]:
    """The best of each group of poses that are the same."""
    found: list[FittedCandidate] = []
    for index in np.argsort(-score, kind='stable').tolist():
        pose = Pose2.from_array(poses[index])
        if all(not same_pose(pose, other.pose) for other in found):
            found.append(FittedCandidate(pose, float(score[index]), float(misfit[index])))
        if len(found) == most:
            break
    return tuple(found)


def same_pose(a: Pose2, b: Pose2) -> bool:
    """Whether two poses are close enough to converge to one."""
    return (math.hypot(a.x - b.x, a.y - b.y) < _SAME_PLACE
            and abs(math.remainder(a.yaw - b.yaw, 2.0 * math.pi)) < _SAME_YAW)
