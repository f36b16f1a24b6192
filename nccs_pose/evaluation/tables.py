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
"""Metrics in words: tables for people (plain text that is also Markdown), numbers for programs."""

from __future__ import annotations

import math
from typing import Any

from nccs_pose.evaluation.metrics import Consistency, expected_coverage, SIGMAS, Summary


def summary_table(summary: Summary) -> str:
    """A run's errors as a table: translation in mm, yaw in degrees."""
    rows = [['', 'median', 'RMSE', 'max']]
    for name, statistic, factor, digits in (
        ('translation (mm)', summary.translation, 1e3, 2),
        ('yaw (deg)', summary.yaw, math.degrees(1.0), 4),
    ):
        rows.append([name, *(
            f'{factor * value:.{digits}f}'
            for value in (statistic.median, statistic.rmse, statistic.max))])
    head = (
        f'{summary.answered} of {summary.frames} frames answered, {summary.unanswered} not; '
        f'{summary.evaluated} compared with the truth.')
    return f'{head}\n\n{table(rows)}'


def consistency_table(consistency: Consistency) -> str:
    """Whether the covariance is true, as a table."""
    rows = [['within', 'x', 'y', 'yaw', 'all', 'expected']]
    for k, row, pooled, expected in zip(
        SIGMAS, consistency.coverage, consistency.pooled, expected_coverage(),
    ):
        rows.append([f'{k} sigma', *(f'{value:.3f}' for value in (*row, pooled, expected))])
    low, high = consistency.band
    return (
        f'NEES {consistency.mean_nees:.2f} over {consistency.count} poses; 3 expected, 95 % band '
        f'{low:.2f} to {high:.2f}.\n\n{table(rows)}')


def table(rows: list[list[str]]) -> str:
    """Rows of text, the first the header, as an aligned Markdown table."""
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    lines = []
    for row in rows:
        cells = [row[0].ljust(widths[0])]
        cells += [cell.rjust(width) for cell, width in zip(row[1:], widths[1:])]
        lines.append(f'| {" | ".join(cells)} |')
    rule = [':' + '-' * (widths[0] + 1)] + ['-' * (width + 1) + ':' for width in widths[1:]]
    return '\n'.join([lines[0], f'|{"|".join(rule)}|', *lines[1:]]) + '\n'


def as_numbers(summary: Summary, consistency: Consistency | None = None) -> dict[str, Any]:
    """The same for JSON, in metres and radians; None where there is no value."""
    def clean(value: float) -> float | None:
        return value if math.isfinite(value) else None

    numbers: dict[str, Any] = {
        'frames': summary.frames, 'answered': summary.answered, 'evaluated': summary.evaluated}
    for name, statistic in (('translation_m', summary.translation), ('yaw_rad', summary.yaw)):
        numbers[name] = {key: clean(getattr(statistic, key)) for key in ('median', 'rmse', 'max')}
    if consistency is not None and consistency.count:
        numbers['nees'] = {
            'mean': clean(consistency.mean_nees), 'band_95': list(consistency.band)}
        numbers['coverage'] = {
            f'{k}_sigma': dict(zip(('x', 'y', 'yaw'), row.tolist()))
            for k, row in zip(SIGMAS, consistency.coverage)}
    return numbers
