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
"""The paper's synthetic experiments, and the questions that it leaves: cells, runs, tables.

A run gives the CSV of every trial, a figure and a Markdown summary. Trials are spread over
processes by joblib; a trial's random numbers come from its seed, cell and number, so the CSV is
the same, byte by byte, whatever the number of workers.
"""

from __future__ import annotations

from collections.abc import Callable
import csv
from dataclasses import dataclass
import io

from joblib import delayed, Parallel
from matplotlib.figure import Figure
from nccs_pose.errors import OptionError
from nccs_pose.evaluation.experiment_options import ExperimentOptions
from nccs_pose.evaluation.experiment_plots import box_figure, projection_figure
from nccs_pose.evaluation.experiment_summary import Results, summary_text
from nccs_pose.evaluation.line_projection import project_lines, projection_summary
from nccs_pose.evaluation.trials import Answer, Cell, run_trial
from nccs_pose.simulation.table_one import TABLE_ONE

LINE_PROJECTION = 'line-projection'
_PIXEL_LEVELS = tuple(range(11))  # px
_WORLD_LEVELS = tuple(range(11))  # cm
_LINE_LEVELS = (4, 6, 8, 10, 15, 20)
_BLIND_POINTS = {4: 75, 5: 20}  # a line; four lines on the floor, five in space
_BLIND_ON_FLOOR = 4


@dataclass(frozen=True)
class Experiment:
    """One figure of the paper, or a question of our own.

    :ivar title: of the figure and the summary.
    :ivar axis: label of the figure's x-axis.
    :ivar lines: lines per trial, where the options do not say; 0: the level is their number.
    :ivar points: points per line, where the options do not say; 0: it goes with the level.
    :ivar levels: places on the x-axis.
    :ivar noise: (sigma_px, sigma_world in metres) of a level.
    :ivar blind: the paper's estimator starts anywhere.
    """

    title: str
    axis: str
    lines: int
    points: int
    levels: tuple[int, ...]
    noise: Callable[[int], tuple[float, float]]
    blind: bool = False


EXPERIMENTS = {
    'pixel-noise': Experiment(
        'Noise on the pixels (the figure with noisy image pixels)', 'σ of the pixels (px)', 5, 20,
        _PIXEL_LEVELS, lambda level: (float(level), 0.0)),
    'world-noise': Experiment(
        'Noise on the world points (the figure with noisy world points)',
        'σ of the points (cm)', 10, 20, _WORLD_LEVELS, lambda level: (0.0, 0.01 * level)),
    'line-count': Experiment(
        'Number of lines, at 5 cm of noise on the world points', 'lines', 0, 20, _LINE_LEVELS,
        lambda level: (0.0, 0.05)),
    'no-guess': Experiment(
        'No initial guess, at 1 px: 4 floor lines × 75 points, 5 lines in space × 20',
        'lines', 0, 0, tuple(_BLIND_POINTS), lambda level: (1.0, 0.0), blind=True),
}
NAMES = (LINE_PROJECTION, *EXPERIMENTS)


def cells_of(name: str, options: ExperimentOptions) -> tuple[Cell, ...]:
    """The boxes of an experiment's figure, mirror by mirror, level by level."""
    experiment, cells = EXPERIMENTS[name], []
    for m, mirror in enumerate(TABLE_ONE):
        for level in experiment.levels:
            lines = (options.lines or experiment.lines) if experiment.lines else level
            points = options.points or experiment.points or _BLIND_POINTS[level]
            sigma_px, sigma_world = experiment.noise(level)
            cells.append(Cell(
                mirror, float(level), lines, points, sigma_px, sigma_world,
                on_floor=experiment.blind and level == _BLIND_ON_FLOOR, blind=experiment.blind,
                key=(list(EXPERIMENTS).index(name), m, level)))
    return tuple(cells)


@dataclass(frozen=True, eq=False)
class Outcome:
    """What a run gives.

    :ivar csv: every trial, a line each.
    :ivar summary: medians, ratios to the bound and failures, as Markdown.
    :ivar figure: as in the paper.
    """

    csv: str
    summary: str
    figure: Figure


def run_experiment(
    name: str,
    trials: int,
    *,
    workers: int = 1,
    backend: str = 'loky',
    options: ExperimentOptions | None = None,
    progress: Callable[[str], None] = lambda note: None,
) -> Outcome:
    """Run one experiment.

    :param name: one of NAMES.
    :param trials: trials per cell; for line-projection, scenes per mirror.
    :param workers: processes.
    :param backend: of joblib: loky on one machine, or one that a cluster registers (dask, ray).
    :param progress: called after each of :func:`steps_of` steps, with what it was.
    :raises OptionError: for an unknown name or backend, or a number of trials or workers below 1.
    """
    options = options or ExperimentOptions()
    if name not in NAMES:
        raise OptionError(f'experiment {name!r}: must be one of {", ".join(NAMES)}')
    for key, value in (('trials', trials), ('workers', workers)):
        if value < 1:
            raise OptionError(f'{key} = {value}: must be at least 1')
    if name == LINE_PROJECTION:
        scenes = []
        for mirror in TABLE_ONE:
            scenes.append(project_lines(options, mirror, trials))
            progress(mirror)
        text = _csv(scenes[0].header, [row for s in scenes for row in s.rows])
        return Outcome(
            text, projection_summary(scenes, trials, options), projection_figure(scenes))
    results = _run_cells(cells_of(name, options), trials, workers, backend, options, progress)
    rows = [
        row for cell, answers in results for i, trial in enumerate(answers)
        for row in _rows(name, options, cell, i, trial)]
    experiment = EXPERIMENTS[name]
    return Outcome(
        _csv(_HEADER, rows), summary_text(name, experiment.title, trials, options, results),
        box_figure(experiment.title, experiment.axis, results))


def steps_of(name: str, options: ExperimentOptions) -> int:
    """How many times a run calls ``progress``."""
    return len(TABLE_ONE) if name == LINE_PROJECTION else len(cells_of(name, options))


def _run_cells(
    cells: tuple[Cell, ...], trials: int, workers: int, backend: str, options: ExperimentOptions,
    progress: Callable[[str], None],
) -> Results:
    results: Results = []
    try:
        parallel = Parallel(n_jobs=workers, backend=backend)
    except ValueError as error:
        raise OptionError(f'backend {backend!r}: {error}') from error
    with parallel as pool:
        for cell in cells:
            answers = pool(delayed(run_trial)(options, cell, trial) for trial in range(trials))
            results.append((cell, list(answers)))
            progress(f'{cell.mirror}, {cell.level:g}')
    return results


_HEADER = (
    'experiment', 'mirror', 'level', 'lines', 'points', 'sigma_px', 'sigma_world_m', 'trial',
    'estimator', 'error_x_m', 'error_y_m', 'error_yaw_rad', 'rotation_deg', 'translation_m',
    'nees', 'failed')


def _rows(
    name: str, options: ExperimentOptions, cell: Cell, trial: int, answers: tuple[Answer, ...],
) -> list[tuple[object, ...]]:
    rows = []
    for answer in answers:
        error = ('', '', '') if answer.error is None else tuple(f'{v:.9g}' for v in answer.error)
        absent = answer.error is None
        rows.append((
            name, cell.mirror, f'{cell.level:g}', cell.lines, cell.points, f'{cell.sigma_px:g}',
            f'{cell.sigma_world:g}', trial, answer.estimator, *error,
            '' if absent else f'{answer.rotation_deg:.9g}',
            '' if absent else f'{answer.translation:.9g}',
            '' if answer.nees is None else f'{answer.nees:.9g}',
            int(answer.failed(options))))
    return rows


def _csv(header: tuple[str, ...], rows: list[tuple[object, ...]]) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator='\n')
    writer.writerow(header)
    writer.writerows(rows)
    return text.getvalue()
