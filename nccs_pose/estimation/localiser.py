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

"""The localiser: what one frame after the other says of where the robot is.

Each image is first laid on the pose expected of it. Where that fails, or where there is no pose
to expect, the whole image is searched for every pose that explains it; a single one is taken,
several are said to be ambiguous, none leaves the robot lost. What cannot be trusted is not given.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
import time
import zlib

from nccs_pose.errors import FrameRefusedError
from nccs_pose.estimation.alignment import Aligner, Alignment, close
from nccs_pose.estimation.association import same_pose
from nccs_pose.estimation.estimate import Candidate, Estimate, Quality, StageTimes, State
from nccs_pose.estimation.floor_segments import FloorSegment
from nccs_pose.estimation.motion import by_odometry, by_velocity, Odometry, Prediction
from nccs_pose.estimation.observability import unobserved_directions
from nccs_pose.estimation.options import LocaliserOptions
from nccs_pose.estimation.search import Searcher
from nccs_pose.estimation.verdict import contradiction, objection
from nccs_pose.geometry.floor_table import FloorTable
from nccs_pose.geometry.lines import LineMap
from nccs_pose.geometry.pose import Array, Pose2
from nccs_pose.geometry.rig import Rig
import numpy as np
from numpy.typing import NDArray

# Poses of a search that are laid on the image itself.
_TRIED = 3
# A search's poses lie within this of the truth in the image, px.
_SEARCH_BAND = 5.0
# Of a search's poses only those count that score this fraction of the best.
_WORTH_TRYING = 0.6
# A pose elsewhere must beat the tracked one by this much to unseat it.
_BETTER = 0.15
# A direction of the pose is open when its deviation exceeds this, metres and radians.
_OPEN = 0.5


@dataclass(frozen=True, eq=False)
class _Track:
    """The last pose that an image gave."""

    stamp_ns: int
    pose: Pose2
    covariance: Array
    odometry: Pose2 | None


@dataclass(frozen=True, eq=False)
class _Found:
    """A pose with what it explains of the image."""

    alignment: Alignment
    claimed: float
    score: float


class _Stopwatch:
    """Seconds by stage."""

    def __init__(self) -> None:
        self._last = time.perf_counter()
        self.times = StageTimes()

    def lap(self, stage: str) -> None:
        now = time.perf_counter()
        self.times = replace(self.times, **{stage: getattr(self.times, stage) + now - self._last})
        self._last = now


class Localiser:
    """Estimates T_map_base of one robot from its images, one at a time."""

    def __init__(
        self, rig: Rig, line_map: LineMap, options: LocaliserOptions = LocaliserOptions(),
    ) -> None:
        """Prepare the tables of a rig.

        :raises GeometryError: if the rig sees no floor.
        :raises VisionError: if the map names a colour that is none.
        """
        self._rig = rig
        self._map = line_map
        self._table = FloorTable(rig, options.reach)
        self._odometry = Odometry()
        self.update_options(options)
        self.reset()

    def update_options(self, options: LocaliserOptions) -> None:
        """Take over new options; the pose is kept.

        A new reach needs new tables and is taken over by a new localiser only.
        """
        self.options = options
        self._aligner = Aligner(self._table, self._map, options)
        self._searcher = Searcher(self._table, self._map, options)

    def reset(self) -> None:
        """Forget everything: poses, odometry, colours, stamps."""
        self._odometry.clear()
        self._last_stamp: int | None = None
        self._last_image = 0
        self.relocalise()

    def relocalise(self) -> None:
        """Forget the pose; the next image is searched as if the robot had just been switched on."""
        self._track: _Track | None = None
        self._before: _Track | None = None
        self._prior: tuple[Pose2, Array] | None = None
        self._ever_tracked = False
        self._frames_since_check = 0
        self._colours = self._aligner.nominal_colours
        # A pose that an image showed against the prediction, and the odometry then.
        self._rumour: tuple[Pose2, Pose2 | None] | None = None

    def set_prior(self, pose: Pose2, covariance: Array) -> None:
        """Give a hypothesis, as by hand or from the last run: it decides between equal poses.

        :param pose: T_map_base.
        :param covariance: of (x, y, yaw) (3, 3), positive definite.
        """
        self.relocalise()
        self._prior = (pose, np.array(covariance, dtype=float))

    def add_odometry(self, stamp_ns: int, pose: Pose2) -> None:
        """Take a sample of wheel odometry, T_odom_base."""
        self._odometry.add(stamp_ns, pose)

    def process(self, stamp_ns: int, image: NDArray[np.uint8]) -> Estimate:
        """Estimate the pose that an image was taken from.

        :param stamp_ns: the image's own stamp, nanoseconds.
        :param image: (H, W, 3) uint8 BGR, of the calibration's size.
        :raises FrameRefusedError: if the frame must not be used; the cause says why.
        """
        self._admit(stamp_ns, image)
        watch = _Stopwatch()
        prediction = self._predict(stamp_ns)
        watch.lap('predict')
        found: _Found | None = None
        if prediction is not None:
            found = self._follow(image, prediction, watch)
        if found is not None:
            return self._tracking(stamp_ns, found, (), 0.0, watch, 'the pose explains the image')
        return self._search(stamp_ns, image, prediction, watch)

    def _admit(self, stamp_ns: int, image: NDArray[np.uint8]) -> None:
        camera = self._rig.camera
        if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
            raise FrameRefusedError(
                'image_type', f'image of shape {image.shape} and type {image.dtype} is not '
                '(height, width, 3) uint8')
        if image.shape[:2] != (camera.height, camera.width):
            raise FrameRefusedError(
                'image_size', f'image is {image.shape[1]} x {image.shape[0]} pixels, the '
                f'calibration is for {camera.width} x {camera.height}')
        last = self._last_stamp
        if last is not None and stamp_ns < last:
            if last - stamp_ns <= self.options.clock_jump * 1e9:
                raise FrameRefusedError(
                    'out_of_order', f'stamp {stamp_ns} ns is {(last - stamp_ns) * 1e-9:.3f} s '
                    'before that of the last image')
            self.reset()
        if last == stamp_ns:
            raise FrameRefusedError('duplicate_stamp', f'stamp {stamp_ns} ns was there before')
        # Rows far apart tell a frozen camera from one that stands still in its own noise.
        content = zlib.crc32(np.ascontiguousarray(image[::16]))
        if content == self._last_image and self._moved_since(self._last_stamp, stamp_ns):
            raise FrameRefusedError(
                'frozen_image', 'the image has not changed by a bit although the robot has moved')
        self._last_image = content
        self._last_stamp = stamp_ns

    def _moved_since(self, before_ns: int | None, after_ns: int) -> bool:
        if before_ns is None:
            return False
        before, after = self._odometry.at(before_ns), self._odometry.at(after_ns)
        if before is None or after is None:
            return False
        step = before.inverse() @ after
        return bool(np.hypot(step.x, step.y) > 0.005 or abs(step.yaw) > 0.005)

    def _predict(self, stamp_ns: int) -> Prediction | None:
        track, before = self._track, self._before
        if track is None:
            return None
        now = self._odometry.at(stamp_ns)
        if track.odometry is not None and now is not None:
            return by_odometry(track.pose, track.covariance, track.odometry, now)
        if before is None:
            return None
        return by_velocity(
            before.pose, before.stamp_ns, track.pose, track.covariance, track.stamp_ns, stamp_ns)

    def _follow(
        self, image: NDArray[np.uint8], prediction: Prediction, watch: _Stopwatch,
    ) -> _Found | None:
        """Lay the predicted pose on the image; None where the whole image must be searched."""
        prior = (prediction.pose, prediction.covariance)
        for reach in (0.0, self.options.band):
            alignment = self._aligner.align(
                image, prediction.pose, self._colours, reach=reach, prior=prior)
            watch.lap('measure')
            if alignment is not None and self._expected(alignment, prediction) and not objection(
                    alignment, self.options, expected=True):
                break
        else:
            return None
        self._frames_since_check += 1
        due = self._frames_since_check >= self.options.check_every
        if not (due or alignment.missing or len(alignment.lines) == 1):
            return _Found(alignment, float('nan'), alignment.explained)
        self._frames_since_check = 0
        segments = self._searcher.segments(image)
        watch.lap('detect')
        if contradiction(alignment, segments, self._map):
            return None
        here = self._searcher.score(alignment.pose, segments)
        elsewhere = self._searcher.candidates(segments)
        watch.lap('associate')
        if elsewhere and elsewhere[0].score > here + _BETTER and not same_pose(
                elsewhere[0].pose, alignment.pose):
            return None
        return _Found(alignment, here, alignment.explained)

    def _expected(self, alignment: Alignment, prediction: Prediction | None) -> bool:
        """Whether a pose is where the prediction says, within the gate."""
        return prediction is not None and close(
            alignment.pose, prediction.pose, prediction.covariance + alignment.covariance,
            self.options.innovation_gate)

    def _search(
        self, stamp_ns: int, image: NDArray[np.uint8], prediction: Prediction | None,
        watch: _Stopwatch,
    ) -> Estimate:
        segments = self._searcher.segments(image)
        watch.lap('detect')
        candidates = self._searcher.candidates(segments)
        watch.lap('associate')
        found, objections = self._try_all(image, candidates, segments, prediction, watch)
        if not found:
            return self._without_pose(
                stamp_ns, prediction, _what_is_missing(segments, objections), watch)
        ambiguity = found[1].score / found[0].score if len(found) > 1 else 0.0
        poses = tuple(Candidate(f.alignment.pose, f.score) for f in found)
        if ambiguity <= self.options.ambiguity_ratio:
            if not self._confirmed(stamp_ns, found[0], prediction):
                # Neither place is to be believed now: the odometry carries nothing on either.
                return Estimate(
                    stamp_ns, State.LOST,
                    'the image shows another place than expected; the next one has to agree',
                    candidates=poses, times=watch.times)
            return self._tracking(
                stamp_ns, found[0], poses, ambiguity, watch, 'found by searching the whole image')
        chosen = self._decide(found, prediction)
        if chosen is not None:
            return self._tracking(
                stamp_ns, chosen, poses, ambiguity, watch,
                'several poses explain the image; the one expected was taken')
        self._track = self._before = None
        return Estimate(
            stamp_ns, State.AMBIGUOUS,
            f'{len(found)} poses explain the image about equally well '
            f'(the second scores {ambiguity:.2f} of the first)',
            candidates=poses,
            quality=Quality(explained=found[0].alignment.explained, claimed=found[0].claimed,
                            ambiguity=ambiguity),
            times=watch.times)

    def _try_all(
        self, image: NDArray[np.uint8], candidates: tuple[Candidate, ...],
        segments: tuple[FloorSegment, ...], prediction: Prediction | None, watch: _Stopwatch,
    ) -> tuple[list[_Found], list[str]]:
        """Lay the best candidates on the image itself.

        :returns: what holds there, best first, and why the others do not.
        """
        found: list[_Found] = []
        objections: list[str] = []
        for candidate in candidates[:_TRIED]:
            if candidate.score < _WORTH_TRYING * candidates[0].score:
                break
            alignment = self._aligner.align(
                image, candidate.pose, self._aligner.nominal_colours, reach=_SEARCH_BAND)
            watch.lap('measure')
            if alignment is None:
                continue
            words = objection(
                alignment, self.options, expected=self._expected(alignment, prediction))
            words = words or contradiction(alignment, segments, self._map)
            if words:
                objections.append(words)
                continue
            if unobserved_directions(
                    alignment.refinement.information, alignment.pose, limit=_OPEN):
                continue
            if any(same_pose(alignment.pose, f.alignment.pose) for f in found):
                continue
            score = self._searcher.score(alignment.pose, segments)
            found.append(_Found(alignment, score, np.sqrt(score * alignment.explained)))
        return sorted(found, key=lambda f: -f.score), objections

    def _confirmed(self, stamp_ns: int, found: _Found, prediction: Prediction | None) -> bool:
        """Whether a pose is expected, or two images in a row agree on it against the prediction.

        Who has been carried away is still there in the next image; a mistake seldom is.
        """
        pose = found.alignment.pose
        now = self._odometry.at(stamp_ns)
        before, self._rumour = self._rumour, (pose, now)
        if prediction is None or self._expected(found.alignment, prediction):
            return True
        if before is None:
            return False
        there, odometry = before
        if odometry is not None and now is not None:
            there = there @ (odometry.inverse() @ now)
        return same_pose(there, pose)

    def _decide(self, found: list[_Found], prediction: Prediction | None) -> _Found | None:
        """The one pose that a prior or the prediction expects, if it is one."""
        expected = self._prior
        if expected is None and prediction is not None:
            expected = (prediction.pose, prediction.covariance)
        if expected is None:
            return None
        near = [f for f in found if close(
            f.alignment.pose, expected[0], expected[1] + f.alignment.covariance, 4.0)]
        return near[0] if len(near) == 1 else None

    def _tracking(
        self, stamp_ns: int, found: _Found, candidates: tuple[Candidate, ...], ambiguity: float,
        watch: _Stopwatch, reason: str,
    ) -> Estimate:
        alignment = found.alignment
        refinement = alignment.refinement
        self._before = self._track
        self._track = _Track(
            stamp_ns, alignment.pose, alignment.covariance, self._odometry.at(stamp_ns))
        self._colours = alignment.colours
        self._prior = None
        self._rumour = None
        self._ever_tracked = True
        sigma = alignment.points.sigma
        unobserved = unobserved_directions(refinement.information, alignment.pose, limit=_OPEN)
        residual = refinement.residual[refinement.inlier]
        told = sigma / max(float(np.sqrt(np.mean(residual**2))), 1e-9)
        quality = Quality(
            lines_used=len(alignment.lines), points_used=len(alignment.points),
            residual_px=float(np.sqrt(np.mean((residual * told) ** 2))),
            expected_px=float(np.sqrt(np.mean(told**2))),
            explained=alignment.explained, claimed=found.claimed, ambiguity=ambiguity,
            unobserved=tuple(u.words for u in unobserved))
        watch.lap('refine')
        return Estimate(
            stamp_ns, State.TRACKING, reason, alignment.pose, alignment.covariance,
            candidates or (Candidate(alignment.pose, found.score),), alignment.points, quality,
            watch.times)

    def _without_pose(
        self, stamp_ns: int, prediction: Prediction | None, missing: str, watch: _Stopwatch,
    ) -> Estimate:
        """Coast on odometry where that still says something; else say what is missing."""
        track = self._track
        if track is not None and prediction is not None and prediction.by_odometry:
            age = (stamp_ns - track.stamp_ns) * 1e-9
            deviation = float(np.sqrt(np.linalg.eigvalsh(prediction.covariance[:2, :2])[-1]))
            if age <= self.options.coast_time and deviation <= self.options.coast_sigma:
                return Estimate(
                    stamp_ns, State.COASTING,
                    f'carried on by odometry for {age:.2f} s: {missing}', prediction.pose,
                    prediction.covariance, times=watch.times)
        state = State.LOST if self._ever_tracked else State.SEARCHING
        return Estimate(stamp_ns, state, missing, times=watch.times)


def _what_is_missing(segments: tuple[FloorSegment, ...], objections: list[str]) -> str:
    """Why an image gives no pose, in words."""
    if objections:
        return objections[0]
    if not segments:
        return 'no line-like strip in the image'
    if len(segments) == 1:
        return 'only one line-like strip in the image'
    angles = np.array([np.arctan2(s.normal[1], s.normal[0]) for s in segments])
    if (np.abs(np.sin(angles - angles[0])) < 0.12).all():
        return f'all {len(segments)} line-like strips in the image are parallel'
    return f'no pose explains the {len(segments)} line-like strips in the image'
