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
several are carried on as hypotheses until the images decide, none leaves the robot lost. What
cannot be trusted is not given.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import chain

from nccs_pose.errors import EstimationError, FrameRefusedError, GeometryError
from nccs_pose.estimation.admission import Admission
from nccs_pose.estimation.aligner import Aligner
from nccs_pose.estimation.alignment import OPEN
from nccs_pose.estimation.case import Case
from nccs_pose.estimation.decision import left_open, may_show, the_one_expected
from nccs_pose.estimation.estimate import (
    Candidate,
    Doubted,
    Estimate,
    Quality,
    State,
)
from nccs_pose.estimation.floor_segments import FloorSegment
from nccs_pose.estimation.following import Follower
from nccs_pose.estimation.given_pose import GivenPose
from nccs_pose.estimation.hypotheses import ambiguity, LEAST_IMAGES, OpenPoses
from nccs_pose.estimation.judge import Found, Judge
from nccs_pose.estimation.ledger import Refused, Sifted
from nccs_pose.estimation.line_history import LineHistory
from nccs_pose.estimation.many_poses import same_pose
from nccs_pose.estimation.motion import carried_on, PAST, Prediction, Track
from nccs_pose.estimation.observability import Unobserved, unobserved_directions
from nccs_pose.estimation.odometry import Odometry, Wheels
from nccs_pose.estimation.options import LocaliserOptions
from nccs_pose.estimation.rivals import Rivals
from nccs_pose.estimation.search import Searcher
from nccs_pose.estimation.sifting import Sifter
from nccs_pose.estimation.sights import Sight, sights
from nccs_pose.estimation.stopwatch import Stopwatch
from nccs_pose.estimation.symmetries import map_symmetries
from nccs_pose.estimation.told import Told
from nccs_pose.estimation.verdict import what_is_missing
from nccs_pose.geometry.floor_table import FloorTable
from nccs_pose.geometry.lines import LineMap
from nccs_pose.geometry.pose import Array, Pose2
from nccs_pose.geometry.rig import Rig
from nccs_pose.vision.colour import LineColour
import numpy as np
from numpy.typing import NDArray

_DEFAULTS = LocaliserOptions()
# Odometry carries a pose on only while it explains this part of what looks like a line, if that is
# more than so many pixels for each of the image's width.
_CLAIMED = 0.5
_FOREIGN = 0.25
# What is expected is forgotten when images have shown other places for so long, ns.
_REFUTED_NS = 500_000_000
# A pose given by hand or from the last run decides among those within so many deviations.
_PRIOR_GATE = 4.0


class Localiser:
    """Estimates T_map_base of one robot from its images, one at a time."""

    def __init__(
        self, rig: Rig, line_map: LineMap, options: LocaliserOptions = _DEFAULTS,
    ) -> None:
        """Prepare the tables of a rig.

        :raises GeometryError: if the rig sees no floor, or a line is no tape on it.
        :raises VisionError: if the map names a colour that is none.
        """
        for k, line in enumerate(line_map):
            if not line.is_tape:
                raise GeometryError(
                    f'line {line.name or k} from {line.start.tolist()} to {line.end.tolist()}, '
                    f'width {line.width:g} m, is no tape on the floor: images show only those '
                    'with z = 0 and a width')
        self._map = line_map
        self._options = options
        self._colours: tuple[LineColour, ...] = ()
        self._table = FloorTable(rig, options.reach)
        self._symmetries = map_symmetries(line_map)[1:]
        self._odometry = Odometry(options.clock_jump)
        self._admission = Admission(rig.camera, self._odometry, options.clock_jump)
        self.update_options(options)
        self.reset()

    @property
    def options(self) -> LocaliserOptions:
        """What it goes by; changed by :meth:`update_options`."""
        return self._options

    def update_options(self, options: LocaliserOptions) -> None:
        """Take over new options; the pose is kept.

        A new reach needs new tables and is taken over by a new localiser only.
        """
        if options.blur != self._options.blur:
            self._colours = tuple(
                replace(colour, blur=options.blur) for colour in self._colours)
        self._options = options
        aligner = Aligner(self._table, self._map, options)
        self._nominal_colours = aligner.nominal_colours
        self._searcher = Searcher(self._table, self._map, options)
        self._judge = Judge(
            self._searcher, aligner.predictor, self._table, self._map, options)
        self._follower = Follower(aligner, self._searcher, self._judge, self._map, options)
        rivals = Rivals(aligner, self._searcher, self._judge, self._symmetries, options)
        self._sifter = Sifter(aligner, self._judge, rivals, self._symmetries, options)

    def reset(self) -> None:
        """Forget everything: poses, odometry, colours, stamps."""
        self._odometry.clear()
        self._admission.forget()
        self._colours = self._nominal_colours
        self.relocalise()

    def relocalise(self) -> None:
        """Forget the pose; the next image is searched as if the robot was just switched on.

        How blurred the images are is remembered: the lens stays the same.
        """
        self._track: Track | None = None
        self._past: tuple[Track, ...] = ()
        self._given: GivenPose | None = None
        self._ever_tracked = False
        # Whether an image has shown another place than expected since the last pose.
        self._shaken = False
        # Images in a row that were searched and showed no pose.
        self._in_vain = 0
        self._colours = self._fresh_colours()
        # What the wheels say at the image in hand.
        self._now: Wheels | None = None
        # Poses among which no image has decided yet.
        self._open = OpenPoses()
        # Since when images have shown nothing where it was expected.
        self._refuted_ns: int | None = None
        self._history = LineHistory()

    def _fresh_colours(self) -> tuple[LineColour, ...]:
        """The colours before any image of this place, as blurred as the last image was."""
        return tuple(
            replace(colour, blur=known.blur)
            for colour, known in zip(self._nominal_colours, self._colours))

    def set_prior(self, pose: Pose2, covariance: Array) -> None:
        """Give a hypothesis, as by hand or from the last run: it decides between equal poses.

        :param pose: T_map_base.
        :param covariance: of (x, y, yaw) (3, 3), positive definite.
        :raises EstimationError: if the covariance is none; everything stays as it was.
        """
        given = np.array(covariance, dtype=float)
        if given.shape != (3, 3) or not np.isfinite(given).all() or (
                np.linalg.eigvalsh(0.5 * (given + given.T))[0] <= 0.0):
            raise EstimationError(
                f'{given.tolist()} is no covariance of (x, y, yaw): 3 x 3, positive definite')
        self.relocalise()
        self._given = GivenPose(pose, given)

    def add_odometry(self, stamp_ns: int, pose: Pose2) -> None:
        """Take a sample of wheel odometry, T_odom_base.

        :raises FrameRefusedError: `odom_jump`, as of :meth:`.Odometry.add`; no step leads across.
        """
        try:
            self._odometry.add(stamp_ns, pose)
        except FrameRefusedError:
            self._open = replace(self._open, odometry=None)
            if self._given is not None:
                self._given.forget_odometry()
            if self._track is not None:
                self._track = replace(self._track, odometry=None)
            raise

    @property
    def last_odometry_ns(self) -> int | None:
        """The stamp of the last sample of odometry; None without any."""
        return self._odometry.last_ns

    def process(self, stamp_ns: int, image: NDArray[np.uint8]) -> Estimate:
        """Estimate the pose that an image was taken from.

        :param stamp_ns: the image's own stamp, nanoseconds.
        :param image: (H, W, 3) uint8 BGR, of the calibration's size.
        :raises FrameRefusedError: if the frame must not be used; the cause says why.
        """
        if not self._admission.admit(stamp_ns, image):
            given = self._given if self._given is not None and self._given.is_new else None
            self._odometry.clear()
            self.relocalise()
            # Said since the last image, it is of the time that begins.
            self._given = given
        watch = Stopwatch()
        self._now = self._odometry.at(stamp_ns)
        prediction = None if self._track is None else carried_on(
            self._past, self._track, self._now, stamp_ns)
        watch.lap('predict')
        if prediction is None:
            return self._search(stamp_ns, image, None, Refused(), watch)
        followed = self._follower.follow(image, prediction, self._colours, self._history, watch)
        if isinstance(followed, Found):
            return self._tracking(
                stamp_ns, followed, prediction, watch, 'the pose explains the image')
        return self._search(stamp_ns, image, prediction, followed, watch)

    def _search(
        self, stamp_ns: int, image: NDArray[np.uint8], prediction: Prediction | None,
        refused: Refused, watch: Stopwatch,
    ) -> Estimate:
        """Look for every pose that explains the image, and take the one that is left, if any."""
        hypotheses = self._open.at(stamp_ns, self._now)
        given = None if self._given is None else self._given.expected(stamp_ns, self._now)
        told = self._told(given, prediction)
        looks: dict[Sight, Sifted] = {}
        for sight in sights(
                image, self._searcher, self._fresh_colours(), self._in_vain, told, watch.lap):
            segments = sight.segments
            # Another try of the same would come to the same.
            if sight not in looks:
                looks[sight] = self._sifter.sift(
                    Case(sight, self._history, prediction, told, looks), hypotheses)
            sifted = looks[sight]
            watch.lap('measure')
            # What was tried early is no place to be alone in.
            if sifted.held and (
                    sight.is_promising or len(sifted.held) + len(sifted.open) > 1):
                break
        held = sifted.held
        self._in_vain = 0 if held else self._in_vain + 1
        if refused.alignment is not None:
            # No jump to where less is explained than at the pose that was refused.
            here = self._judge.measured(refused.alignment, segments).score
            held = [f for f in held if f.score > here or same_pose(
                f.alignment.pose, refused.alignment.pose)]
        if not held:
            trusted = None if given is None else self._trusted(image, given, segments, watch)
            if trusted is not None:
                return self._tracking(
                    stamp_ns, trusted, given, watch,
                    'the image agrees with the pose that was given')
            if refused.objection is None:
                refused = next(chain.from_iterable(s.refused for s in looks.values()), refused)
            return self._without_pose(stamp_ns, prediction, segments, refused, watch)
        chosen = the_one_expected(held, sifted, told, prediction, self._options)
        if chosen is not None:
            words = 'found by searching the whole image'
            if len(held) > 1:
                words = 'several poses explain the image; the one expected was taken'
            return self._tracking(stamp_ns, chosen, None, watch, words, held)
        first = prediction is None and not self._open
        hypotheses, more = left_open(hypotheses, held, sifted)
        self._open = OpenPoses(hypotheses, stamp_ns, self._now)
        best = hypotheses[0]
        if ambiguity(hypotheses) <= self._options.ambiguity_ratio and (
                first or len(best.scores) >= LEAST_IMAGES):
            found = next(f for f in held if f.alignment.pose == best.pose)
            return self._tracking(
                stamp_ns, found, None, watch, 'found by searching the whole image', held)
        if told is not None and not may_show(told, held, sifted):
            # Carried on for long, what was expected would agree with one of them by chance.
            if self._refuted_ns is None:
                self._refuted_ns = stamp_ns
            elif stamp_ns - self._refuted_ns >= _REFUTED_NS:
                self._track, self._past, self._given = None, (), None
        return self._undecided(stamp_ns, held, more, watch)

    def _trusted(
        self, image: NDArray[np.uint8], given: Prediction, segments: tuple[FloorSegment, ...],
        watch: Stopwatch,
    ) -> Found | None:
        """The pose that was given, where too little is in view to find it without."""
        followed = self._follower.follow(image, given, self._colours, self._history, watch)
        if not isinstance(followed, Found):
            return None
        _, claimed = self._searcher.score(followed.alignment.pose, segments)
        return replace(followed, claimed=claimed) if claimed >= _CLAIMED else None

    def _told(self, given: Prediction | None, prediction: Prediction | None) -> Told | None:
        """Where a pose that was given or the prediction says that the robot is."""
        if given is not None:
            return Told(given.pose, given.carried, _PRIOR_GATE)
        if prediction is not None:
            return Told(prediction.pose, prediction.covariance, self._options.innovation_gate)
        return None

    def _tracking(
        self, stamp_ns: int, found: Found, prior: Prediction | None, watch: Stopwatch,
        reason: str, held: list[Found] | None = None,
    ) -> Estimate:
        """Take a pose over.

        :param prior: the prediction that was weighed in with it, if one was.
        :param held: all poses that explain the image, best first, if it was searched.
        """
        alignment, covariance = found.alignment, found.alignment.covariance
        if prior is not None:
            covariance = prior.without_floor(covariance, alignment.refinement.covariance)
        unobserved = unobserved_directions(
            alignment.refinement.information, alignment.pose, limit=OPEN)
        seen_ns, seen_way = stamp_ns, None if self._now is None else self._now.way
        # Whoever is told of it shares it with the track.
        covariance.setflags(write=False)
        last = self._track
        if unobserved and last is not None:
            seen_ns, seen_way = last.seen_ns, last.seen_way
        # No velocity leads across a jump, nor to where an image sets right what those before it
        # had left open.
        set_right = last is not None and last.seen_ns < last.stamp_ns and not unobserved
        self._past = () if self._open or last is None or set_right else (
            *self._past, last)[-PAST:]
        self._track = Track(
            stamp_ns, alignment.pose, covariance, self._now, seen_ns, seen_way)
        self._colours = alignment.colours
        self._given = None
        self._refuted_ns = None
        self._shaken = False
        if held is not None:
            self._follower.begin()
        self._open = OpenPoses()
        self._history = self._history.after(alignment, searched=prior is None)
        self._ever_tracked = True
        ranked = held or [found]
        quality = _quality(
            found, ranked[1].score / ranked[0].score if len(ranked) > 1 else 0.0, unobserved)
        watch.lap('refine')
        return Estimate(
            stamp_ns, State.TRACKING, reason, alignment.pose, covariance,
            tuple(Candidate(f.alignment.pose, f.score) for f in ranked), alignment.points,
            quality, watch.times)

    def _undecided(
        self, stamp_ns: int, held: list[Found], more: list[Candidate], watch: Stopwatch,
    ) -> Estimate:
        """Say which poses may be right, and give none of them.

        :param more: that are not carried on.
        """
        hypotheses = self._open.hypotheses
        poses = tuple(sorted(
            (*(Candidate(h.pose, h.mean) for h in hypotheses), *more), key=lambda c: -c.score))
        ratio = ambiguity(hypotheses)
        quality = _quality(held[0], ratio)
        if ratio > self._options.ambiguity_ratio:
            state, words = State.AMBIGUOUS, (
                f'{len(poses)} poses explain the image about equally well (the second scores '
                f'{ratio:.2f} of the first)')
        else:
            state = State.LOST if self._ever_tracked else State.SEARCHING
            words = 'the image shows another place than expected; the next one has to agree'
        return Estimate(
            stamp_ns, state, words, candidates=poses, quality=quality, times=watch.times)

    def _without_pose(
        self, stamp_ns: int, prediction: Prediction | None, segments: tuple[FloorSegment, ...],
        refused: Refused, watch: Stopwatch,
    ) -> Estimate:
        """Coast on odometry where that still says something; else say what is missing."""
        against, doubted, track = refused.objection, None, self._track
        missing = against.words if against is not None else what_is_missing(segments)
        contradicted = False
        if against is not None and against.line is not None:
            contradicted = self._history.contradicts(against.line)
            self._history = self._history.doubting(against.line)
        if refused.alignment is not None:
            doubted = Doubted(refused.alignment.pose, refused.alignment.points)
        if prediction is not None:
            self._shaken |= (
                contradicted or bool(self._open) or self._shows_another(prediction, segments))
        if track is not None and prediction is not None and (
                prediction.by_odometry and not self._shaken):
            age = (stamp_ns - track.stamp_ns) * 1e-9
            covariance = prediction.covariance
            variance = max(float(np.linalg.eigvalsh(covariance[:2, :2])[-1]), covariance[2, 2])
            if age <= self._options.coast_time and variance <= self._options.coast_sigma ** 2:
                return Estimate(
                    stamp_ns, State.COASTING,
                    f'carried on by odometry for {age:.2f} s: {missing}', prediction.pose,
                    prediction.carried, doubted=doubted, times=watch.times)
        state = State.LOST if self._ever_tracked else State.SEARCHING
        hypotheses = self._open.at(stamp_ns, self._now)
        return Estimate(
            stamp_ns, state, missing, times=watch.times, doubted=doubted,
            candidates=tuple(Candidate(h.pose, h.mean) for h in hypotheses))

    def _shows_another(
        self, prediction: Prediction, segments: tuple[FloorSegment, ...],
    ) -> bool:
        """Whether an image shows another place than expected."""
        if self._open:
            return True
        _, claimed = self._searcher.score(prediction.pose, segments)
        foreign = (1.0 - claimed) * sum(strip.weight for strip in segments)
        return claimed < _CLAIMED and foreign > _FOREIGN * self._table.rig.camera.width


def _quality(found: Found, ambiguity: float, unobserved: Sequence[Unobserved] = ()) -> Quality:
    """The signals of health of a pose."""
    alignment = found.alignment
    return Quality(
        lines_used=len(alignment.lines), points_used=len(alignment.points),
        residual_px=alignment.residual_px, expected_px=alignment.expected_px,
        explained=alignment.explained, claimed=found.claimed, ambiguity=ambiguity,
        unobserved=tuple(u.words for u in unobserved))
