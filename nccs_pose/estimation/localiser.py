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

from nccs_pose.errors import FrameRefusedError, GeometryError
from nccs_pose.estimation import answers
from nccs_pose.estimation.admission import Admission
from nccs_pose.estimation.aligner import Aligner
from nccs_pose.estimation.alignment import Alignment, OPEN
from nccs_pose.estimation.case import Case
from nccs_pose.estimation.coasting import may_coast, shows_another_place, shows_this_place
from nccs_pose.estimation.course import Course
from nccs_pose.estimation.decision import left_open, may_show, the_one_expected
from nccs_pose.estimation.estimate import Doubted, Estimate, State
from nccs_pose.estimation.following import Follower
from nccs_pose.estimation.frame import Frame
from nccs_pose.estimation.gate import Gate
from nccs_pose.estimation.given_pose import GivenPose
from nccs_pose.estimation.hypotheses import ambiguity, Hypothesis, LEAST_IMAGES, OpenPoses
from nccs_pose.estimation.judge import Found, Judge
from nccs_pose.estimation.ledger import Refused, Sifted
from nccs_pose.estimation.line_history import LineHistory
from nccs_pose.estimation.many_poses import same_pose
from nccs_pose.estimation.misplaced import LineFinder
from nccs_pose.estimation.motion import Prediction
from nccs_pose.estimation.observability import unobserved_directions
from nccs_pose.estimation.odometry import Odometry
from nccs_pose.estimation.options import LocaliserOptions
from nccs_pose.estimation.rivals import Rivals
from nccs_pose.estimation.search import Searcher
from nccs_pose.estimation.sifting import Sifter
from nccs_pose.estimation.sights import Sight, sights
from nccs_pose.estimation.stopwatch import Stopwatch
from nccs_pose.estimation.symmetries import map_symmetries
from nccs_pose.estimation.verdict import what_is_missing
from nccs_pose.geometry.floor_table import FloorTable
from nccs_pose.geometry.lines import LineMap
from nccs_pose.geometry.pose import Array, Pose2
from nccs_pose.geometry.rig import Rig
from nccs_pose.vision.colour import LineColour
import numpy as np
from numpy.typing import NDArray

_DEFAULTS = LocaliserOptions()
# What was expected is forgotten when images have shown other places for so long, ns.
_REFUTED_NS = 500_000_000
# A pose given by hand or from the last run decides among those within so many deviations.
_PRIOR_GATE = 4.0
# Where too little is in view to find a pose, one that was given is believed if it explains this
# part of the strips.
_LEAST_CLAIMED = 0.5
_FOUND = 'found by searching the whole image'


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
        finder = LineFinder(aligner.predictor, self._table, self._map, options)
        self._judge = Judge(self._searcher, finder, self._map, options)
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
        self._course = Course()
        self._given: GivenPose | None = None
        self._ever_tracked = False
        # How many images in a row have yet to agree with what is expected before the last pose is
        # coasted on again: one since it has shown another place.
        self._have_to_agree = 0
        # Images in a row that were searched and showed no pose.
        self._in_vain = 0
        self._colours = self._fresh_colours()
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
        given = GivenPose(pose, covariance)
        self.relocalise()
        self._given = given

    def add_odometry(self, stamp_ns: int, pose: Pose2) -> None:
        """Take a sample of wheel odometry, T_odom_base.

        :raises FrameRefusedError: `odom_jump`, as of :meth:`.Odometry.add`; no step leads across.
        """
        try:
            self._odometry.add(stamp_ns, pose)
        except FrameRefusedError:
            self._open = replace(self._open, wheels=None)
            if self._given is not None:
                self._given.forget_odometry()
            self._course = self._course.without_odometry()
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
            # One that was given since the last image belongs to the time that begins.
            self._given = given
        watch = Stopwatch()
        wheels = self._odometry.at(stamp_ns)
        prediction = self._course.at(stamp_ns, wheels, doubted=self._have_to_agree > 0)
        frame = Frame(stamp_ns, image, wheels, prediction, watch)
        watch.lap('predict')
        if prediction is None:
            return self._search(frame, Refused())
        followed = self._follower.follow(frame, prediction, self._colours, self._history)
        if isinstance(followed, Found):
            return self._tracking(
                frame, followed, 'the pose explains the image', prior=prediction)
        return self._search(frame, followed)

    def _search(self, frame: Frame, refused: Refused) -> Estimate:
        """Look for every pose that explains the image, and take the one that is left, if any.

        :param refused: what came of following the robot to the image.
        """
        is_first = frame.prediction is None and not self._open
        if refused.misled:
            frame = replace(frame, prediction=None)
        given = None if self._given is None else self._given.carried_on(
            frame.stamp_ns, frame.wheels)
        gate = self._gate_of(given or frame.prediction)
        hypotheses = self._open.at(frame.stamp_ns, frame.wheels)
        looks, last = self._looks(frame, gate, hypotheses)
        sifted = looks[last]
        self._in_vain = 0 if sifted.held else self._in_vain + 1
        if refused.alignment is not None:
            # No jump to where less is explained than at the pose that was refused.
            here = self._judge.measured(refused.alignment, last.segments).score
            sifted = replace(sifted, held=[f for f in sifted.held if f.score > here or same_pose(
                f.alignment.pose, refused.alignment.pose)])
        if not sifted.held:
            trusted = None if given is None else self._trusted(frame, given, last)
            if trusted is not None:
                return self._tracking(
                    frame, trusted, 'the image agrees with the pose that was given', prior=given)
            if refused.objection is None:
                refused = next(chain.from_iterable(s.refused for s in looks.values()), refused)
            return self._without_pose(frame, last, refused)
        chosen = the_one_expected(sifted, gate, frame.prediction, self._options)
        if chosen is not None:
            words = _FOUND if len(sifted.held) == 1 else (
                'several poses explain the image; the one expected was taken')
            return self._tracking(frame, chosen, words, held=sifted.held)
        return self._decided(frame, sifted, gate, hypotheses, is_first)

    def _decided(
        self, frame: Frame, sifted: Sifted, gate: Gate | None, before: Sequence[Hypothesis],
        is_first: bool,
    ) -> Estimate:
        """Decide between poses by all images since they were first seen, or leave them open.

        :param sifted: what the search of this image left; some pose explains it.
        :param before: those that the images before left open, where they are by now.
        :param is_first: whether nothing was expected of the image; else two have to agree.
        """
        held = sifted.held
        hypotheses, more = left_open(before, sifted)
        self._open = OpenPoses(hypotheses, frame.stamp_ns, frame.wheels)
        best = hypotheses[0]
        if ambiguity(hypotheses) <= self._options.ambiguity_ratio and (
                is_first or len(best.scores) >= LEAST_IMAGES):
            found = next(f for f in held if f.alignment.pose == best.pose)
            return self._tracking(frame, found, _FOUND, held=held)
        if gate is not None and not may_show(gate, sifted):
            # Carried on for long, what was expected would agree with one of them by chance.
            if self._refuted_ns is None:
                self._refuted_ns = frame.stamp_ns
            elif frame.stamp_ns - self._refuted_ns >= _REFUTED_NS:
                self._course, self._given = Course(), None
        return answers.undecided(frame, held[0], hypotheses, more, self._options, self._unknown)

    def _looks(
        self, frame: Frame, gate: Gate | None, hypotheses: tuple[Hypothesis, ...],
    ) -> tuple[dict[Sight, Sifted], Sight]:
        """Look at an image in one way after the other, until one shows a pose.

        :returns: what came of each sight, in order, and the one to go by.
        """
        looks: dict[Sight, Sifted] = {}
        for sight in sights(
                frame, self._searcher, self._fresh_colours(), gate, in_vain=self._in_vain):
            # One that comes again would come to the same.
            if sight not in looks:
                looks[sight] = self._sifter.sift(
                    Case(sight, self._history, frame.prediction, gate, looks), hypotheses)
            sifted = looks[sight]
            frame.watch.lap('measure')
            # On a sight that came early, though it promises little, one pose alone proves nothing.
            if sifted.held and (
                    sight.is_promising or len(sifted.held) + len(sifted.open) > 1):
                break
        return looks, sight

    def _gate_of(self, expected: Prediction | None) -> Gate | None:
        """The gate about a pose that was given, or about the prediction."""
        if expected is None:
            return None
        if expected.is_given:
            return Gate(expected.pose, expected.carried, _PRIOR_GATE)
        return Gate(expected.pose, expected.covariance, self._options.innovation_gate)

    def _trusted(self, frame: Frame, given: Prediction, sight: Sight) -> Found | None:
        """The pose that was given, where too little is in view to find it without."""
        followed = self._follower.follow(frame, given, self._colours, self._history)
        if not isinstance(followed, Found):
            return None
        _, claimed = self._searcher.score(followed.alignment.pose, sight.segments)
        return replace(followed, claimed=claimed) if claimed >= _LEAST_CLAIMED else None

    def _tracking(
        self, frame: Frame, found: Found, reason: str, *, prior: Prediction | None = None,
        held: Sequence[Found] = (),
    ) -> Estimate:
        """Take a pose over.

        :param prior: the prediction that was weighed in with it; None if it was searched.
        :param held: if it was searched, all poses that explain the image, best first.
        """
        alignment, covariance = found.alignment, found.alignment.covariance
        if prior is not None:
            covariance = prior.without_inflation(covariance, alignment.refinement.covariance)
        # Whoever is told of it shares it with the track.
        covariance.setflags(write=False)
        unobserved = unobserved_directions(
            alignment.refinement.information, alignment.pose, limit=OPEN)
        self._course = self._course.after(
            frame.stamp_ns, alignment.pose, covariance, frame.wheels,
            is_fixed=not unobserved, is_jump=bool(self._open))
        self._colours = alignment.colours
        self._history = self._history.after(alignment, searched=prior is None)
        if prior is None:
            self._follower.begin()
        self._open, self._given, self._refuted_ns = OpenPoses(), None, None
        self._have_to_agree, self._ever_tracked = 0, True
        return answers.tracking(frame, reason, held or [found], found, covariance, unobserved)

    def _without_pose(self, frame: Frame, sight: Sight, refused: Refused) -> Estimate:
        """Coast on odometry where that still says something; else say what is missing."""
        against, prediction = refused.objection, frame.prediction
        contradicted = False
        if against is not None and against.line is not None:
            contradicted = self._history.contradicts(against.line)
            self._history = self._history.doubting(against.line)
        missing = what_is_missing(sight.segments) if against is None else against.words
        doubted = None if refused.alignment is None else Doubted(
            refused.alignment.pose, refused.alignment.points)
        if prediction is not None:
            self._weigh(sight, prediction, refused.alignment, contradicted=contradicted)
            seconds = self._course.seconds_to(frame.stamp_ns)
            if not self._have_to_agree and may_coast(prediction, seconds, self._options):
                return answers.coasting(frame, prediction, seconds, missing, doubted)
        return answers.without_pose(
            frame, self._unknown, missing, self._open.at(frame.stamp_ns, frame.wheels), doubted)

    def _weigh(
        self, sight: Sight, prediction: Prediction, refused: Alignment | None, *,
        contradicted: bool,
    ) -> None:
        """Note whether an image that gives no pose speaks for the expected place or against it.

        :param refused: the pose that was laid on it and refused; None if none lies there.
        :param contradicted: whether a line speaks against the poses before as well.
        """
        if contradicted or self._open or shows_another_place(sight, prediction, self._searcher):
            self._have_to_agree = LEAST_IMAGES
        elif self._have_to_agree:
            agrees = not self._history.doubted and shows_this_place(
                sight, prediction, refused, self._searcher, self._options)
            self._have_to_agree = self._have_to_agree - 1 if agrees else LEAST_IMAGES

    @property
    def _unknown(self) -> State:
        """The state without any pose."""
        return State.LOST if self._ever_tracked else State.SEARCHING
