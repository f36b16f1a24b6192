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

"""What a localiser makes of every fault, counted."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
import math

from nccs_pose.errors import FrameRefusedError
from nccs_pose.estimation.estimate import Answering
from nccs_pose.evaluation.pose_error import PoseError
from nccs_pose.evaluation.tables import table
from nccs_pose.geometry.lines import LineMap
from nccs_pose.geometry.rig import Rig
from nccs_pose.simulation.drive import ImageSample
from nccs_pose.simulation.faults import Fault, prepare, Rehearsal


@dataclass(frozen=True)
class FaultRow:
    """One fault, played once, or several times together.

    :ivar fault: which.
    :ivar frames: images that arrived.
    :ivar answered: answered with a pose.
    :ivar wrong: of these, off by more than 5 sigma and by more than 50 mm or 1 degree.
    :ivar refused: images that the localiser would not use.
    :ivar recovered: how many images after the fault the first right pose came (1: at once);
        None if it never came or the fault never ended.
    :ivar worst_distance: largest translation error of all answers, m; NaN without any.
    :ivar worst_angle: largest yaw error, rad.
    """

    fault: Fault
    frames: int
    answered: int
    wrong: int
    refused: int
    recovered: int | None
    worst_distance: float
    worst_angle: float

    @property
    def lost(self) -> int:
        """Images that were looked at and gave no pose."""
        return self.frames - self.answered - self.refused


@dataclass(frozen=True)
class _Answer:
    """What became of an image; `error` is None where the localiser would not use it."""

    after: bool
    error: PoseError | None

    @property
    def right(self) -> bool:
        return self.error is not None and self.error.right


def run_fault(
    fault: Fault, rehearsal: Rehearsal, localiser: Callable[[Rig, LineMap], Answering],
) -> FaultRow:
    """Play a fault to a fresh localiser and count what it makes of it.

    :param fault: which.
    :param rehearsal: the drive that it spoils.
    :param localiser: makes one from a rig and a map.
    """
    play = prepare(fault, rehearsal)
    answering = localiser(play.scene.rig, play.line_map)
    answers = []
    for event in play.events():
        sample = event.sample
        if isinstance(sample, ImageSample):
            answers.append(_answer(answering, sample, event.after))
        else:
            with suppress(FrameRefusedError):  # after a jump of the clock
                answering.add_odometry(sample.stamp_ns, sample.pose)
    return _count(fault, answers)


def _answer(localiser: Answering, sample: ImageSample, after: bool) -> _Answer:
    try:
        estimate = localiser.process(sample.stamp_ns, sample.image)
    except FrameRefusedError:
        return _Answer(after, None)
    return _Answer(after, PoseError.of(estimate, sample.pose))


def _count(fault: Fault, answers: Sequence[_Answer]) -> FaultRow:
    looked_at = [answer.error for answer in answers if answer.error is not None]
    given = [error for error in looked_at if error.given]
    after = [answer.right for answer in answers if answer.after]
    return FaultRow(
        fault,
        frames=len(answers),
        answered=len(given),
        wrong=sum(error.wrong for error in given),
        refused=len(answers) - len(looked_at),
        recovered=after.index(True) + 1 if any(after) else None,
        worst_distance=max((error.distance for error in given), default=math.nan),
        worst_angle=max((error.angle for error in given), default=math.nan),
    )


def combine(rows: Sequence[FaultRow]) -> FaultRow:
    """Add up one fault's rows of several drives; recovery and errors are the worst of all."""
    recoveries = [row.recovered for row in rows if row.recovered is not None]
    distances = [row.worst_distance for row in rows if row.answered]
    angles = [row.worst_angle for row in rows if row.answered]
    return FaultRow(
        rows[0].fault,
        frames=sum(row.frames for row in rows),
        answered=sum(row.answered for row in rows),
        wrong=sum(row.wrong for row in rows),
        refused=sum(row.refused for row in rows),
        recovered=max(recoveries) if len(recoveries) == len(rows) else None,
        worst_distance=max(distances, default=math.nan),
        worst_angle=max(angles, default=math.nan),
    )


HEADER = ('fault', 'frames', 'answered', 'wrong', 'lost', 'refused', 'recovered after',
          'worst mm', 'worst deg', 'what happens')


def row_cells(row: FaultRow) -> list[str]:
    """Give a row's text, in the order of the header."""
    if row.fault.lasting:
        recovered = '-'
    else:
        recovered = 'never' if row.recovered is None else str(row.recovered)
    worst = ('-', '-') if not row.answered else (
        f'{1e3 * row.worst_distance:.1f}', f'{math.degrees(row.worst_angle):.2f}')
    counts = (row.frames, row.answered, row.wrong, row.lost, row.refused)
    return [row.fault.name, *map(str, counts), recovered, *worst, row.fault.description]


def fault_table(rows: Sequence[FaultRow]) -> str:
    """Give the rows as a Markdown table."""
    return table([list(HEADER), *(row_cells(row) for row in rows)])


def fault_csv(rows: Sequence[FaultRow]) -> str:
    """Give the rows as comma-separated values with a header, lengths in m, angles in rad."""
    lines = ['fault,frames,answered,wrong,lost,refused,recovered_after,worst_m,worst_rad']
    for row in rows:
        recovered = '' if row.recovered is None else row.recovered
        lines.append(
            f'{row.fault.name},{row.frames},{row.answered},{row.wrong},{row.lost},{row.refused},'
            f'{recovered},{row.worst_distance:.6f},{row.worst_angle:.6f}')
    return '\n'.join(lines) + '\n'
