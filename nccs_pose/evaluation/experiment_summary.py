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
"""What an experiment's trials say, as a Markdown page."""

from __future__ import annotations

import dataclasses
import math

from nccs_pose.evaluation.experiment_options import ExperimentOptions
from nccs_pose.evaluation.tables import table
from nccs_pose.evaluation.trials import Answer, Cell
import numpy as np

Results = list[tuple[Cell, list[tuple[Answer, ...]]]]
"""Each cell of an experiment with its trials, each of them one answer an estimator."""
# Median of chi-square with 3 degrees of freedom: the NEES of an estimator at the bound.
_MEDIAN_CHI2_3 = 2.366


@dataclasses.dataclass(frozen=True)
class CellSummary:
    """One estimator in one cell.

    :ivar rotation_deg: median absolute rotation error, degrees.
    :ivar translation: median norm of the translation error, metres.
    :ivar ratio: sqrt(median NEES / 2.366), 1 at the Cramér-Rao bound; None without noise.
    :ivar failures: share of trials beyond the failure limits, or without an estimate.
    """

    rotation_deg: float
    translation: float
    ratio: float | None
    failures: float


def summarise_cell(
    answers: list[tuple[Answer, ...]], estimator: str, options: ExperimentOptions,
) -> CellSummary:
    """Medians, ratio to the bound and failures; a missing estimate counts as the worst."""
    index = options.estimators.index(estimator)
    mine = [trial[index] for trial in answers]
    noisy = any(answer.nees is not None for trial in answers for answer in trial)
    nees = [math.inf if a.nees is None else a.nees for a in mine]
    return CellSummary(
        float(np.median([a.rotation_deg for a in mine])),
        float(np.median([a.translation for a in mine])),
        math.sqrt(float(np.median(nees)) / _MEDIAN_CHI2_3) if noisy else None,
        float(np.mean([a.failed(options) for a in mine])))


def command(name: str, trials: int, options: ExperimentOptions) -> str:
    """The command that gives the same numbers again."""
    words = [f'nccs-pose experiment {name} --trials {trials}']
    for field in dataclasses.fields(options):
        value, flag = getattr(options, field.name), '--' + field.name.replace('_', '-')
        if value != field.default:
            words.append(flag if isinstance(value, bool) else f'{flag} {value}')
    return ' '.join([*words, '--output DIR'])


def summary_text(
    name: str, title: str, trials: int, options: ExperimentOptions, results: Results,
) -> str:
    """The whole page: what was run, and one table for each mirror."""
    parts = [
        f'# {title}\n',
        f'`{command(name, trials, options)}`: {trials} trials a cell. Medians of the absolute '
        'rotation error and of the norm of the translation error; "× bound" is √(median NEES / '
        '2.366), 1 for an estimator at the Cramér–Rao bound; failures are errors beyond '
        f'{options.failure_angle_deg:g}° or {options.failure_distance:g} m. "bound" is a draw '
        'from the bound itself, which shows the chance in the other numbers.\n']
    for mirror in dict.fromkeys(cell.mirror for cell, _ in results):
        parts.append(f'## {mirror.capitalize()} mirror\n')
        rows = [['level', 'lines × points', 'estimator', 'rotation (°)', 'translation (mm)',
                 '× bound', 'failures']]
        for cell, answers in results:
            if cell.mirror == mirror:
                rows += [_row(cell, answers, e, options) for e in options.estimators]
        parts.append(table(rows))
    parts.append('## Assumptions\n')
    parts.append(options_table(options))
    return '\n'.join(parts)


def _row(
    cell: Cell, answers: list[tuple[Answer, ...]], estimator: str, options: ExperimentOptions,
) -> list[str]:
    s = summarise_cell(answers, estimator, options)
    ratio = '' if s.ratio is None else f'{s.ratio:.2f}'
    return [
        f'{cell.level:g}', f'{cell.lines} × {cell.points}', estimator, f'{s.rotation_deg:.3f}',
        f'{1e3 * s.translation:.1f}', ratio, f'{100 * s.failures:.1f} %']


def options_table(options: ExperimentOptions) -> str:
    """The assumptions of a run, with their values."""
    rows = [['option', 'value', 'unit', 'meaning']]
    for field in dataclasses.fields(options):
        rows.append([
            field.name, f'{getattr(options, field.name)}', field.metadata['unit'],
            field.metadata['doc']])
    return table(rows)
