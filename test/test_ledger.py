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

"""What is left of the poses that were laid on an image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

from nccs_pose.estimation.association import FittedCandidate
from nccs_pose.estimation.gate import Gate
from nccs_pose.estimation.judge import Found
from nccs_pose.estimation.ledger import Ledger
from nccs_pose.estimation.many_poses import Poses
from nccs_pose.estimation.sights import Sight
from nccs_pose.estimation.verdict import Objection
from nccs_pose.geometry.pose import Pose2
import numpy as np
import pytest

RATIO = 0.85
AWAY = Objection('it is not there')
HALF_TURN = Pose2(0.0, 0.0, np.pi)
HERE, THERE, NOWHERE = Pose2(1.0, 0.0, 0.0), Pose2(4.0, 2.0, 1.0), Pose2(-3.0, 2.0, 2.0)


def _alignment(pose: Pose2) -> Any:
    return SimpleNamespace(
        pose=pose, support=np.ones(2), whole=np.arange(2), explained=0.5, missing=())


def _found(pose: Pose2, score: float, by_strips: float = 0.8) -> Found:
    return Found(_alignment(pose), 1.0, score, by_strips)


def _candidate(
    pose: Pose2, score: float, claimed: float = 1.0, misfit: float = 0.0,
) -> FittedCandidate:
    return FittedCandidate(pose, score, claimed, misfit)


def _ledger(
    symmetries: tuple[Pose2, ...], gate: Gate | None, left: Sequence[FittedCandidate],
    others: Sequence[Pose2] = (),
) -> Ledger:
    return Ledger(symmetries, gate, RATIO, left, Poses.of(others))


def _gate(pose: Pose2) -> Gate:
    return Gate(pose, np.diag([0.1, 0.1, 0.1])**2, 3.0)


def _are(poses: Sequence[Pose2], expected: Sequence[Pose2]) -> bool:
    """Whether they are the expected ones in this order; a pose that was moved is rounded."""
    return len(poses) == len(expected) and all(
        np.allclose(pose.minus(other), 0.0, atol=1e-12) for pose, other in zip(poses, expected))


def test_a_pose_is_known_with_its_twins() -> None:
    ledger = _ledger((HALF_TURN,), None, ())
    assert not ledger.knows(HERE)
    ledger.refuse(AWAY, _found(HERE, 0.5))
    assert ledger.knows(HERE) and ledger.was_laid(HERE)
    assert ledger.knows(HALF_TURN @ HERE) and not ledger.was_laid(HALF_TURN @ HERE)
    ledger.settle_twins(THERE)
    assert ledger.knows(HALF_TURN @ THERE) and not ledger.knows(THERE)
    assert not ledger.knows(NOWHERE)


def test_twins_are_laid_on_the_image_where_the_robot_is_told_to_be() -> None:
    twin = HALF_TURN @ HERE
    assert _ledger((HALF_TURN,), None, ()).hold(_found(HERE, 0.9), None) == []
    ledger = _ledger((HALF_TURN,), _gate(twin), ())
    assert ledger.hold(_found(HERE, 0.9), None) == [twin]
    assert not ledger.knows(twin)
    assert ledger.closed().open == []


def test_what_holds_leaves_its_twins_open() -> None:
    for gate in (None, _gate(HERE)):
        ledger = _ledger((HALF_TURN,), gate, ())
        ledger.hold(_found(HERE, 0.9), None)
        twin, = ledger.closed().open
        assert twin.pose == HALF_TURN @ HERE
        assert twin.score == 0.9


def test_of_the_candidates_that_were_not_laid_the_equals_of_the_best_are_open() -> None:
    left = [_candidate(THERE, 0.7), _candidate(NOWHERE, 0.6), _candidate(HERE, 0.8)]
    ledger = _ledger((), None, left)
    assert ledger.closed().open == []
    ledger.hold(_found(HERE, 0.9, by_strips=0.8), None)
    ledger.leave(_candidate(HALF_TURN @ HERE, 0.95))
    opened = ledger.closed().open
    assert _are([c.pose for c in opened], [HALF_TURN @ HERE, THERE])
    assert opened[0].score == 0.9
    assert opened[1].score == pytest.approx(0.7 / 0.8 * 0.9)


def test_the_others_that_explain_the_strips_are_the_rest() -> None:
    away = [Pose2(8.0, float(k), 0.0) for k in range(4)]
    ledger = _ledger((), None, [
        _candidate(THERE, 0.6), _candidate(away[0], 0.6, claimed=0.9), _candidate(away[3], 0.7),
        _candidate(HERE @ Pose2(0.1, 0.1, 0.0), 0.6)], [HERE, NOWHERE])
    ledger.hold(_found(HERE, 0.8, by_strips=0.8), _candidate(HERE, 0.8, misfit=0.5))
    ledger.pass_over(_candidate(away[2], 0.6, misfit=1.5))
    sifted = ledger.closed()
    # One leaves strips unexplained, and one is the pose that holds.
    assert _are([c.pose for c in sifted.rest], [THERE, away[2]])
    assert [c.score for c in sifted.rest] == [0.6, 0.6]
    assert _are([c.pose for c in sifted.open], [away[3]])
    assert sifted.others.listed() == [NOWHERE]


def test_what_was_not_laid_lies_off_its_strips_as_the_best_does() -> None:
    moved = Pose2(0.04, -0.02, 0.01)
    ledger = _ledger((), None, [_candidate(THERE, 0.8), _candidate(NOWHERE, 0.5)])
    ledger.hold(_found(HERE @ moved, 0.9), _candidate(HERE, 0.8))
    # A worse one says nothing of it.
    ledger.hold(_found(HALF_TURN @ HERE, 0.4), _candidate(HALF_TURN @ HERE, 0.4))
    sifted = ledger.closed()
    told = [c.pose.as_array() for c in (*sifted.open, *sifted.rest)]
    np.testing.assert_allclose(
        told, [(THERE @ moved).as_array(), (NOWHERE @ moved).as_array()], atol=1e-12)


def test_a_pose_is_beaten_by_what_holds_unless_more_of_it_may_be_there() -> None:
    ledger = _ledger((), None, ())
    assert not ledger.beats(_candidate(THERE, 0.1))
    ledger.hold(_found(HERE, 0.8, by_strips=0.8), _candidate(HERE, 0.8, misfit=0.5))
    # 0.85 of 0.8, squared.
    assert ledger.beats(_candidate(THERE, 0.45)) and not ledger.beats(_candidate(THERE, 0.47))
    assert ledger.beats(_candidate(THERE, 0.7, misfit=1.0))
    assert not ledger.beats(_candidate(THERE, 0.7, misfit=0.5))
    plain = _ledger((), None, ())
    plain.hold(replace(_found(HERE, 0.8), alignment=SimpleNamespace(
        pose=HERE, support=np.ones(3), whole=np.arange(3), explained=1.0, missing=())), None)
    assert plain.beats(_candidate(THERE, 0.6, claimed=0.9))
    assert not plain.beats(_candidate(THERE, 0.6, claimed=0.97))


def test_a_doubtful_pose_is_open_only_beside_one_that_shows_no_more() -> None:
    # How well the lines lie, which is the rest of a score, says little where there are doubts.
    for shows, opens in ((0.7, True), (0.95, False)):
        ledger = _ledger((), None, ())
        ledger.doubt(AWAY, _found(THERE, 0.6, by_strips=0.6))
        ledger.hold(_found(HERE, 0.3, by_strips=shows), None)
        sifted = ledger.closed()
        assert [c.pose for c in sifted.open] == ([THERE] if opens else [])
        assert [c.pose for c in sifted.hidden] == ([] if opens else [THERE])


def test_a_pose_that_misses_lines_is_worth_no_more_than_one_that_misses_none() -> None:
    ledger = _ledger((), None, ())
    lacking = _found(THERE, 0.6)
    lacking.alignment.missing = (2,)
    ledger.hold(lacking, None)
    assert [f.score for f in ledger.closed().held] == [0.6]
    ledger.hold(_found(HERE, 0.2), None)
    held = ledger.closed().held
    assert [f.score for f in held] == [0.2, 0.2]
    assert held[0].alignment.pose == HERE
    ledger.hold(_found(NOWHERE, 0.7), None)
    assert [f.score for f in ledger.closed().held] == [0.7, 0.6, 0.2]


def test_the_best_is_first_and_tied_by_its_equals() -> None:
    ledger = _ledger((), None, ())
    assert not ledger.is_tied()
    ledger.hold(_found(HERE, 0.7), _candidate(HERE, 0.8, misfit=0.4))
    ledger.hold(_found(THERE, 0.9), _candidate(THERE, 0.8, misfit=0.2))
    assert ledger.best is not None and ledger.best.alignment.pose == THERE
    assert not ledger.is_tied()
    ledger.hold(_found(NOWHERE, 0.8), None)
    assert ledger.is_tied()
    assert [f.score for f in ledger.closed().held] == [0.9, 0.8, 0.7]


def test_what_something_hides_is_hidden_with_its_twins() -> None:
    ledger = _ledger((HALF_TURN,), None, ())
    ledger.hide(AWAY, _found(HERE, 0.5, by_strips=0.6))
    ledger.rule_out(_candidate(THERE, 0.4), AWAY)
    sifted = ledger.closed()
    assert [(c.pose, c.score) for c in sifted.hidden] == [
        (HERE, 0.6), (HALF_TURN @ HERE, 0.6), (THERE, 0.4)]
    assert len(sifted.refused) == 2 and sifted.held == []


def test_what_explains_all_on_thin_lines_and_more_than_what_holds_leaves_that_open() -> None:
    for best, lines, opens in ((0.5, 3, True), (0.7, 3, False), (0.5, 2, False)):
        ledger = _ledger((), None, ())
        ledger.hold(_found(HERE, best), None)
        ledger.hide(AWAY, replace(_found(THERE, 0.6), alignment=SimpleNamespace(
            pose=THERE, support=np.ones(lines), whole=np.arange(lines), explained=1.0,
            missing=())))
        assert [c.pose for c in ledger.closed().open] == ([THERE] if opens else [])


@pytest.mark.parametrize(('refused', 'left'), [(0.4, 1), (0.6, 1), (0.8, 0)])
def test_nothing_holds_where_the_image_shows_more_of_a_pose_that_it_speaks_against(
    refused: float, left: int,
) -> None:
    ledger = _ledger((), None, ())
    ledger.hold(_found(HERE, 0.9, by_strips=0.6), None)
    ledger.refuse(AWAY, _found(THERE, 0.1, by_strips=refused))
    assert len(ledger.closed().held) == left


@pytest.mark.parametrize(('shown', 'promising'), [
    (((0.9, 0.8), (0.9, 0.8)), True),
    (((0.6, 0.9), (0.4, 0.9)), True),
    (((0.6, 0.9), (0.55, 0.7)), False),
    (((0.6, 1.0), (0.55, 0.8)), True),
    (((0.6, 1.0), (0.55, 0.8), (0.5, 0.97)), False),
    (((0.3, 1.0),), False),
    ((), False)])
def test_a_look_is_promising_where_no_other_pose_rivals_the_best(
    shown: tuple[tuple[float, float], ...], promising: bool,
) -> None:
    candidates = tuple(_candidate(HERE, *of) for of in shown)
    sight = Sight(np.zeros((1, 1, 3), np.uint8), (), candidates, Poses.of(()), ())
    assert sight.is_promising == promising
