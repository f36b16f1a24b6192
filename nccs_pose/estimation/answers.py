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

"""What the localiser answers to a frame, in numbers and words."""

from __future__ import annotations

from collections.abc import Sequence

from nccs_pose.estimation.estimate import Candidate, Doubted, Estimate, Quality, State
from nccs_pose.estimation.frame import Frame
from nccs_pose.estimation.hypotheses import ambiguity, Hypothesis
from nccs_pose.estimation.judge import Found
from nccs_pose.estimation.motion import Prediction
from nccs_pose.estimation.observability import Unobserved
from nccs_pose.estimation.options import LocaliserOptions
from nccs_pose.geometry.pose import Array


def tracking(
    frame: Frame, reason: str, held: Sequence[Found], taken: Found, covariance: Array,
    unobserved: Sequence[Unobserved],
) -> Estimate:
    """A pose.

    :param held: all poses that explain the image, best first.
    :param taken: the one of them that is given.
    :param covariance: of its (x, y, yaw) (3, 3).
    :param unobserved: directions of it that the lines in view do not fix.
    """
    frame.watch.lap('refine')
    ratio = held[1].score / held[0].score if len(held) > 1 else 0.0
    return Estimate(
        frame.stamp_ns, State.TRACKING, reason, taken.alignment.pose, covariance,
        tuple(Candidate(f.alignment.pose, f.score) for f in held), taken.alignment.points,
        _quality(taken, ratio, unobserved), frame.watch.times)


def undecided(
    frame: Frame, best: Found, hypotheses: Sequence[Hypothesis], more: Sequence[Candidate],
    options: LocaliserOptions, unknown: State,
) -> Estimate:
    """Which poses may be right; none of them is given.

    :param best: the pose that explains this image best.
    :param hypotheses: poses that are carried on to the next image, best first.
    :param more: others that may be right.
    :param unknown: the state where one pose is far better, but no second image has shown it yet.
    """
    poses = sorted((*(h.candidate for h in hypotheses), *more), key=lambda c: -c.score)
    ratio = ambiguity(hypotheses)
    if ratio > options.ambiguity_ratio:
        state, words = State.AMBIGUOUS, (
            f'{len(poses)} poses explain the image about equally well (the second scores '
            f'{ratio:.2f} of the first)')
    else:
        state = unknown
        words = 'the image shows another place than expected; the next one has to agree'
    return Estimate(
        frame.stamp_ns, state, words, candidates=tuple(poses), quality=_quality(best, ratio),
        times=frame.watch.times)


def coasting(
    frame: Frame, prediction: Prediction, seconds: float, missing: str, doubted: Doubted | None,
) -> Estimate:
    """The pose that the wheels lead to.

    :param seconds: since an image gave a pose.
    :param missing: why this one gives none, in words.
    :param doubted: a pose that was laid on it and is not believed.
    """
    return Estimate(
        frame.stamp_ns, State.COASTING, f'carried on by odometry for {seconds:.2f} s: {missing}',
        prediction.pose, prediction.carried, doubted=doubted, times=frame.watch.times)


def without_pose(
    frame: Frame, unknown: State, missing: str, hypotheses: Sequence[Hypothesis],
    doubted: Doubted | None,
) -> Estimate:
    """Why there is no pose.

    :param unknown: searching or lost.
    :param missing: why the image gives none, in words.
    :param hypotheses: poses that the images before left open.
    :param doubted: a pose that was laid on it and is not believed.
    """
    return Estimate(
        frame.stamp_ns, unknown, missing, candidates=tuple(h.candidate for h in hypotheses),
        doubted=doubted, times=frame.watch.times)


def _quality(found: Found, ratio: float, unobserved: Sequence[Unobserved] = ()) -> Quality:
    """The signals of health of a pose."""
    alignment = found.alignment
    return Quality(
        lines_used=len(alignment.lines), points_used=len(alignment.points),
        residual_px=alignment.residual_px, expected_px=alignment.expected_px,
        explained=alignment.explained, claimed=found.claimed, ambiguity=ratio,
        unobserved=tuple(u.words for u in unobserved))
