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

"""Which of the poses that explain an image is the right one, if that can be said."""

from __future__ import annotations

from collections.abc import Sequence

from nccs_pose.estimation.estimate import Candidate
from nccs_pose.estimation.gate import BETTER, Gate
from nccs_pose.estimation.hypotheses import confronted, Hypothesis
from nccs_pose.estimation.judge import Found, is_expected
from nccs_pose.estimation.ledger import Sifted
from nccs_pose.estimation.motion import Prediction
from nccs_pose.estimation.options import LocaliserOptions
from nccs_pose.estimation.verdict import lines_used

# Of the poses among which an image does not decide so many are laid on the next; on a map with
# many places alike its own search finds the others again.
_CARRIED = 8


def the_one_expected(
    sifted: Sifted, gate: Gate | None, prediction: Prediction | None, options: LocaliserOptions,
) -> Found | None:
    """The one pose that a prior or a prediction expects, if it is one of the best of all.

    :param sifted: what the search of the image left; some pose explains it.
    :param gate: about the prediction or, without one, a prior.
    """
    if gate is None:
        return None
    near = [f for f in sifted.held if (
        gate.contains(f.alignment.pose, f.alignment.covariance) if prediction is None
        else is_expected(f.alignment, prediction, options.innovation_gate))]
    if not near or _leaves_any(gate, sifted):
        return None
    best, ratio = near[0], options.ambiguity_ratio
    if best.score + BETTER < sifted.held[0].score or any(
            f.score >= ratio * best.score for f in near[1:]):
        return None
    return best


def may_show(gate: Gate, sifted: Sifted) -> bool:
    """Whether an image may show a pose inside a gate.

    :param sifted: what the search of it left.
    """
    return any(gate.contains(f.alignment.pose) for f in sifted.held) or _leaves_any(gate, sifted)


def _leaves_any(gate: Gate, sifted: Sifted) -> bool:
    """Whether there is a pose inside the gate that was not laid on the image."""
    return any(gate.contains(c.pose) for c in (*sifted.open, *sifted.rest)) or bool(
        gate.contains_each(sifted.others).any())


def left_open(
    hypotheses: Sequence[Hypothesis], sifted: Sifted,
) -> tuple[tuple[Hypothesis, ...], list[Candidate]]:
    """The poses among which an image has not decided, and the next one may.

    :param hypotheses: those that were open before it.
    :param sifted: what the search of it left; some pose explains it.
    :returns: those to be laid on the next image, and others that may be right as well.
    """
    held = sifted.held
    best, *others = confronted(hypotheses, [(f.alignment.pose, f.score) for f in held])
    # Scores of what is left open are of this image, as parts of its best; those of hypotheses are
    # means over several.
    before = best.mean / held[0].score
    most = _CARRIED - 1
    others = sorted(
        (*others, *(Hypothesis(c.pose, (before * c.score,)) for c in sifted.open[:most])),
        key=lambda h: -h.mean)
    carried_on = (best, *others[:most])
    if lines_used(held[0].alignment) < 3:
        carried_on += tuple(Hypothesis(c.pose, (c.score,)) for c in sifted.hidden)
    more = [h.candidate for h in others[most:]]
    more += [Candidate(c.pose, before * c.score) for c in (*sifted.open[most:], *sifted.rest)]
    if len(sifted.others):
        # They show no more than the least of what was looked at closely, for all that is known.
        least = min([*(h.mean for h in (best, *others)), *(c.score for c in more)])
        more += [Candidate(pose, least) for pose in sifted.others.listed()]
    return carried_on, more
