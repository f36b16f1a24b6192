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
from typing import NamedTuple

from nccs_pose.estimation.estimate import Candidate
from nccs_pose.estimation.floor_points import footprints, half_strip
from nccs_pose.estimation.floor_segments import FloorSegment
from nccs_pose.estimation.gate import Gate
from nccs_pose.estimation.many_poses import distinct, one_of_each, Poses, unlike
from nccs_pose.estimation.nearest_lines import NearestLines
from nccs_pose.estimation.strip_pairs import FloorLines, poses_of_pairs
from nccs_pose.estimation.strip_scores import SeenMap, StripScorer
from nccs_pose.estimation.symmetries import map_symmetries
from nccs_pose.geometry.floor_scale import FloorScale
from nccs_pose.geometry.floor_table import as_points, Complex, FloorTable
from nccs_pose.geometry.lines import LineMap
from nccs_pose.geometry.pose import Array, Pose2
import numpy as np
from numpy.typing import NDArray

# Pairs of strips that start hypotheses; of these so many are looked at closely, by every third
# sample of the strips, and so many are refined. No more than these are candidates.
_PAIRS = 15
_CLOSE = 300
_COARSE = 3
_REFINED = 24
# In a coarse image strips lie off their lines as if its pixels were so large on the floor, metres;
# a map of which this part lies on itself as well as that looks much the same from two places.
_ASKEW = 0.15
_MUCH = 0.85
# A pose that explains this part of the strips leaves none unexplained.
ALL_STRIPS = 0.95
_NONE = Poses.of(())


@dataclass(frozen=True)
class FittedCandidate(Candidate):
    """A pose that explains strips.

    :ivar claimed: fraction of the strips' pixels that lie on map lines.
    :ivar misfit: how far the strips lie off the lines that it lays them on, root mean square, px;
        0 where it is not known.
    """

    claimed: float
    misfit: float = 0.0


class Candidates(NamedTuple):
    """Poses that explain strips.

    :ivar fitted: those that were looked at closely, best first.
    :ivar others: that leave no strip unexplained, but were not looked at any closer: a map may
        have many hundreds of places alike.
    """

    fitted: tuple[FittedCandidate, ...]
    others: Poses


class Associator:
    """Finds and scores poses by the strips of an image, on one rig and map.

    A pose's score is the harmonic mean of two fractions: of the strips' pixels that lie on map
    lines, and of the map lines in view that strips lie on.
    """

    def __init__(
        self, line_map: LineMap, table: FloorTable, joined: LineMap | None = None,
    ) -> None:
        """Prepare.

        :param joined: the map with those of its lines joined that a strip may run along together;
            itself if None.
        """
        lines = FloorLines(line_map)
        self._joined = lines if joined is None or joined is line_map else FloorLines(joined)
        self._seen = SeenMap(lines, NearestLines(lines), FloorScale(table))
        self._likenesses = _likenesses(line_map, self._seen)
        self._last: StripScorer | None = None

    def candidates(
        self, segments: tuple[FloorSegment, ...], gate: Gate | None = None,
    ) -> Candidates:
        """Poses that explain strips; none where fewer than two strips cross.

        The best few are laid on the strips by least squares; where a map has many places alike
        the others follow as they were guessed, with what they score there.

        :param gate: where the robot is by something else; poses inside are not left out for others
            that explain as much.
        """
        if len(segments) < 2:
            return Candidates((), _NONE)
        scorer = self._scorer(segments)
        poses = poses_of_pairs(scorer.strips, self._joined, _PAIRS)
        if not len(poses):
            return Candidates((), _NONE)
        guessed: list[FittedCandidate] = []
        others = _NONE
        if len(poses) > _REFINED:
            poses, guessed, others = _promising(scorer, poses, gate)
            poses, claimed, misfit = scorer.refined(poses, 1)
        else:
            poses, claimed, misfit = scorer.refined(poses, 2)
        refined = _fitted(scorer, poses, claimed, misfit)
        return Candidates(tuple(sorted((*refined, *guessed), key=lambda c: -c.score)), others)

    def taken_for(
        self, pose: Pose2, segments: tuple[FloorSegment, ...],
    ) -> list[FittedCandidate]:
        """What a pose may be taken for in a coarse image.

        From there the map looks nearly the same, if there are such places: as the map has them,
        and as the strips then lie, since of a coarse image neither is near enough for certain.
        """
        if not (self._likenesses and segments):
            return []
        scorer = self._scorer(segments)
        places = Poses.of([likeness @ pose for likeness in self._likenesses])
        return [*_fitted(scorer, places, scorer.claimed(places), np.zeros(len(places))),
                *_fitted(scorer, *scorer.refined(places, 2))]

    def score(self, pose: Pose2, segments: tuple[FloorSegment, ...]) -> tuple[float, float]:
        """The score that a pose would have among the candidates, and the strips' part in it.

        :returns: the score, 0 to 1, and the fraction of the strips' pixels that lie on map lines;
            both 0 where there are no strips.
        """
        if not segments:
            return 0.0, 0.0
        scorer = self._scorer(segments)
        at = Poses(np.array([complex(math.cos(pose.yaw), math.sin(pose.yaw))]),
                   np.array([complex(pose.x, pose.y)]))
        claimed = scorer.claimed(at)
        return float(_harmonic(claimed, scorer.explained(at))[0]), float(claimed[0])

    def on_lines(
        self, pose: Pose2, floor: Complex, spread: Array, width: float, colour: str,
    ) -> NDArray[np.bool_]:
        """Which of some pixels a pose has on map lines of a colour (P,).

        :param floor: behind them, x + iy (P,), metres in base_link.
        :param spread: xx, xy and yy of J J^T (P, 3), J the point's derivative by the pixel.
        :param width: of the tapes, metres.
        """
        turn, nearest = complex(math.cos(pose.yaw), math.sin(pose.yaw)), self._seen.nearest
        which, across = nearest.at(
            turn * floor + complex(pose.x, pose.y), nearest.layers((colour,)))
        normals = as_points(nearest.normal.take(which) * turn.conjugate())
        return np.abs(across) < half_strip(width, footprints(spread, normals))

    def _scorer(self, segments: tuple[FloorSegment, ...]) -> StripScorer:
        """Of the strips, which are most often those that were last asked about."""
        if self._last is None or self._last.segments is not segments:
            self._last = StripScorer(segments, self._seen)
        return self._last


def _likenesses(line_map: LineMap, seen: SeenMap) -> tuple[Pose2, ...]:
    """Motions of a map that lay its lines near to its lines, but for its symmetries.

    None where there are many: no pair of strips tells one from another then, and all are among
    the candidates anyway.
    """
    tapes = tuple(FloorSegment(
        line.left[:2], 0.0, line.start[:2], line.end[:2],
        line.length, _ASKEW, np.zeros((0, 2)), line.colour) for line in line_map)
    scorer = StripScorer(tuple(sorted(tapes, key=lambda tape: -tape.weight)), seen)
    poses = poses_of_pairs(scorer.strips, seen.lines, _PAIRS)
    if not 0 < len(poses) <= _CLOSE:
        return ()
    poses, claimed, _ = scorer.refined(poses, 4)
    poses = poses[[k for k in distinct(poses, claimed) if claimed[k] > _MUCH]]
    return tuple(poses[unlike(poses, Poses.of(map_symmetries(line_map)))].listed())


def _promising(
    scorer: StripScorer, poses: Poses, gate: Gate | None,
) -> tuple[Poses, list[FittedCandidate], Poses]:
    """Of many poses those that are worth refining, and others that show as much.

    :returns: those, others that were looked at, and others that leave no strip unexplained.
    """
    claimed = scorer.claimed(poses, _COARSE)
    there = np.zeros(len(claimed), dtype=bool) if gate is None else (
        gate.contains_each(poses))
    best = np.lexsort([-claimed, ~there])
    if len(best) > _CLOSE:
        best = one_of_each(poses, best)
    further = best[_CLOSE:]
    others = poses[further[claimed[further] > ALL_STRIPS]]
    best = best[:_CLOSE]
    # Two strips may lie askew, and so does the pose that they give: all others set it right.
    poses, claimed, misfit = scorer.refined(poses[best], 2, _COARSE)
    there = there[best]
    score = _harmonic(claimed, scorer.explained(poses, _COARSE))
    found = sorted(distinct(poses, score), key=lambda k: not there[k])
    return poses[found[:_REFINED]], _listed(
        poses, score, claimed, misfit, found[_REFINED:]), others


def _fitted(
    scorer: StripScorer, poses: Poses, claimed: Array, misfit: Array,
) -> list[FittedCandidate]:
    """Poses and what is known of them, as of :meth:`.StripScorer.refined`; one of each."""
    score = _harmonic(claimed, scorer.explained(poses))
    return _listed(poses, score, claimed, misfit, distinct(poses, score))


def _listed(
    poses: Poses, score: Array, claimed: Array, misfit: Array, which: list[int],
) -> list[FittedCandidate]:
    """Some of H poses, each with what is known of it (H,)."""
    return [FittedCandidate(*of) for of in zip(
        poses[which].listed(), *(part[which].tolist() for part in (score, claimed, misfit)))]


def _harmonic(a: Array, b: Array) -> Array:
    return 2.0 * a * b / np.maximum(a + b, 1e-9)
