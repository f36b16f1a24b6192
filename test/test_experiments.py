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
"""The paper's experiments and the benchmark: data, determinism, what the estimators reach."""

from __future__ import annotations

import csv
from dataclasses import replace
import io
import json
import os
from pathlib import Path
import subprocess
import sys

from nccs_pose.cli import main
from nccs_pose.errors import OptionError, SimulationError
from nccs_pose.estimation.residual import side
from nccs_pose.evaluation import benchmark
from nccs_pose.evaluation.experiment_options import ExperimentOptions
from nccs_pose.evaluation.experiment_plots import box_figure
from nccs_pose.evaluation.experiment_summary import summarise_cell
from nccs_pose.evaluation.experiments import (
    cells_of,
    EXPERIMENTS,
    NAMES,
    run_experiment,
    steps_of,
)
from nccs_pose.evaluation.line_projection import project_lines
from nccs_pose.evaluation.trials import Answer, Cell, make_data_set, run_trial
from nccs_pose.geometry.reflection_curve import Branch
from nccs_pose.simulation.table_one import TABLE_ONE
import numpy as np
import pytest

QUICK = ExperimentOptions(quick=True)


def cell(mirror: str = 'spherical', **changes) -> Cell:
    return replace(Cell(mirror, 1.0, 5, 20, 1.0, key=(7,)), **changes)


def rows_of(text: str) -> list[dict]:
    return list(csv.DictReader(io.StringIO(text)))


@pytest.mark.parametrize('on_floor', [False, True])
@pytest.mark.parametrize('mirror', TABLE_ONE)
def test_a_data_set_is_what_it_says(mirror: str, on_floor: bool) -> None:
    options = ExperimentOptions(nearest=0.5, farthest=2.0)
    rig = options.rig(mirror)
    data = make_data_set(
        rig, options, cell(mirror, on_floor=on_floor), np.random.default_rng(1))
    rays = rig.back_project(data.clean)
    d, mu = data.directions[data.label], data.moments[data.label]
    assert np.abs(side(rays, d, mu, data.truth)).max() < 1e-9
    assert len(data.directions) == 5
    assert len(data.pixels) > 90
    assert np.linalg.norm(data.directions, axis=1) == pytest.approx(1.0)
    if on_floor:
        assert np.abs(data.directions[:, 2]).max() == 0.0
        assert np.abs(data.moments[:, :2]).max() < 1e-12  # in the plane z = 0
    noise = (data.pixels - data.clean).std()
    assert noise == pytest.approx(1.0, abs=0.2)
    start = data.start.as_array() - data.truth.as_array()
    assert 0.0 < np.hypot(*start[:2]) <= options.start_distance
    assert abs(start[2]) <= np.radians(options.start_angle_deg)


def test_world_noise_moves_the_rays_off_their_lines() -> None:
    options = ExperimentOptions()
    rig = options.rig('spherical')
    data = make_data_set(
        rig, options, cell(sigma_px=0.0, sigma_world=0.02, lines=20), np.random.default_rng(2))
    rays = rig.back_project(data.pixels)
    d, mu = data.directions[data.label], data.moments[data.label]
    s = side(rays, d, mu, data.truth)
    local = d @ data.truth.rotation
    apart = s / np.linalg.norm(np.cross(rays.direction, local), axis=1)
    assert apart.std() == pytest.approx(0.02, rel=0.15)


@pytest.mark.parametrize('mirror', TABLE_ONE)
def test_without_noise_ours_is_exact(mirror: str) -> None:
    for trial in range(3):
        ours, bound = run_trial(QUICK, cell(mirror, sigma_px=0.0), trial)
        assert ours.rotation_deg < 1e-6
        assert ours.translation < 1e-8
        assert ours.nees is None
        assert (bound.rotation_deg, bound.translation) == (0.0, 0.0)


@pytest.mark.parametrize('mirror', TABLE_ONE)
@pytest.mark.parametrize('noise', [{'sigma_px': 4.0}, {'sigma_px': 0.0, 'sigma_world': 0.03}])
def test_ours_is_near_the_bound(mirror: str, noise: dict) -> None:
    """A hundred trials know the ratio to about 6 %; the bound's own draws say how well."""
    at = cell(mirror, **noise)
    answers = [run_trial(QUICK, at, trial) for trial in range(100)]
    ours = summarise_cell(answers, 'ours', QUICK)
    bound = summarise_cell(answers, 'bound', QUICK)
    assert ours.failures == 0.0
    assert ours.ratio < 1.2
    assert bound.ratio == pytest.approx(1.0, abs=0.15)


def test_the_papers_estimator_is_worse_and_the_bound_is_best() -> None:
    options = ExperimentOptions()
    answers = [run_trial(options, cell(sigma_px=3.0), trial) for trial in range(12)]
    assert [a.estimator for a in answers[0]] == ['paper', 'paper without g2', 'ours', 'bound']
    ratio = {e: summarise_cell(answers, e, options).ratio for e in options.estimators}
    assert ratio['paper'] > 2.0 * ratio['ours']
    assert ratio['paper without g2'] > 2.0 * ratio['ours']


def test_a_trial_depends_on_its_numbers_only() -> None:
    first = run_trial(QUICK, cell(), 3)
    run_trial(QUICK, cell('parabolic'), 1)
    assert run_trial(QUICK, cell(), 3) == first
    assert run_trial(QUICK, cell(), 4) != first
    assert run_trial(replace(QUICK, seed=2), cell(), 3) != first
    assert run_trial(QUICK, cell(key=(8,)), 3) != first


def test_workers_do_not_change_a_byte(tmp_path: Path) -> None:
    """Of the whole command, with the paper's estimators, which rounding can lead astray."""
    free = {k: v for k, v in os.environ.items() if not k.endswith('_NUM_THREADS')}
    for workers in ('1', '2'):
        subprocess.run(
            [sys.executable, '-m', 'nccs_pose.cli', 'experiment', 'no-guess', '--trials', '2',
             '--workers', workers, '--output', str(tmp_path / workers)],
            check=True, capture_output=True, env=free)
    for ending in ('csv', 'md', 'png'):
        one, two = ((tmp_path / w / f'no-guess.{ending}').read_bytes() for w in ('1', '2'))
        assert one == two
    rows = rows_of((tmp_path / '1' / 'no-guess.csv').read_text(encoding='utf-8'))
    assert len(rows) == 3 * 2 * 2 * 4  # mirrors, levels, trials, estimators
    ours = [float(row['translation_m']) for row in rows if row['estimator'] == 'ours']
    assert max(ours) < 0.5


def test_backends_and_numbers_of_trials_do_not_change_a_trial() -> None:
    two = run_experiment('no-guess', 2, workers=2, backend='threading', options=QUICK)
    assert two.csv == run_experiment('no-guess', 2, options=QUICK).csv
    # fewer trials are the first of more
    fewer = rows_of(run_experiment('no-guess', 1, options=QUICK).csv)
    assert fewer == [row for row in rows_of(two.csv) if row['trial'] == '0']


def test_what_an_experiment_gives() -> None:
    said: list[str] = []
    options = ExperimentOptions(quick=True, lines=4, points=8)
    outcome = run_experiment('line-count', 1, options=options, progress=said.append)
    assert len(said) == steps_of('line-count', options) == 18
    for word in ('Hyperbolic', 'Parabolic', 'Spherical', '× bound', 'farthest', '4 × 8'):
        assert word in outcome.summary
    again = 'experiment line-count --trials 1 --lines 4 --points 8 --quick --output DIR'
    assert again in outcome.summary
    assert len(outcome.figure.axes) == 6  # rotation and translation, three mirrors
    rows = rows_of(outcome.csv)
    assert {row['lines'] for row in rows} == {'4', '6', '8', '10', '15', '20'}
    assert {row['sigma_world_m'] for row in rows} == {'0.05'}
    for row in rows:
        norm = np.hypot(float(row['error_x_m']), float(row['error_y_m']))
        assert float(row['translation_m']) == pytest.approx(norm, rel=1e-6)


def test_cells_are_the_papers() -> None:
    pixel, world, count = (
        cells_of(name, ExperimentOptions())
        for name in ('pixel-noise', 'world-noise', 'line-count'))
    assert {(c.lines, c.points) for c in pixel} == {(5, 20)}
    assert sorted({c.sigma_px for c in pixel}) == list(range(11))
    assert {(c.lines, c.points) for c in world} == {(10, 20)}
    assert max(c.sigma_world for c in world) == pytest.approx(0.10)
    assert {c.sigma_world for c in count} == {0.05}
    other = cells_of('pixel-noise', ExperimentOptions(lines=20, points=5))
    assert {(c.lines, c.points) for c in other} == {(20, 5)}
    keys = [c.key for name in EXPERIMENTS for c in cells_of(name, ExperimentOptions())]
    assert len(set(keys)) == len(keys)


def test_missing_estimates_count_as_failures() -> None:
    good, missing = Answer('ours', (0.001, 0.0, 0.0), 1.0), Answer('ours', None, None)
    bound = Answer('bound', (0.0, 0.0, 0.0), 0.1)
    s = summarise_cell([(good, bound), (missing, bound), (missing, bound)], 'ours', QUICK)
    assert s.failures == pytest.approx(2 / 3)
    assert s.translation == np.inf
    assert s.ratio == np.inf


@pytest.mark.parametrize('mirror', TABLE_ONE)
def test_projected_points_lie_on_the_drawn_curves(mirror: str) -> None:
    scenes = project_lines(ExperimentOptions(), mirror, 4)
    gamma, _, apart = np.array([row[-3:] for row in scenes.rows], dtype=float).T
    assert len(gamma) > 100
    assert gamma.max() < 1e-8
    assert apart.max() < 1e-9
    assert all(scenes.zeros[b] > 0 for b in Branch if b != Branch.OFF)
    for line in scenes.drawn:
        # the curve, drawn without any projected point, passes by all of them
        reach = np.linalg.norm(np.diff(line.curve, axis=0), axis=1)
        gaps = np.linalg.norm(
            line.mirror_points[:, None] - line.curve[None], axis=2).min(axis=1)
        assert np.median(gaps) < np.quantile(reach, 0.9)


def test_line_projection_draws_its_figure() -> None:
    outcome = run_experiment('line-projection', 1)
    assert 'spurious' in outcome.summary
    assert len(outcome.figure.axes) == 9
    assert rows_of(outcome.csv)[0]['mirror'] == 'hyperbolic'


def test_impossible_requests_are_refused_by_name() -> None:
    with pytest.raises(OptionError, match='nearest'):
        ExperimentOptions(nearest=3.0, farthest=2.0)
    with pytest.raises(OptionError, match='focal'):
        ExperimentOptions(focal=-1.0)
    with pytest.raises(OptionError, match='nonsense'):
        run_experiment('nonsense', 1)
    with pytest.raises(OptionError, match='trials'):
        run_experiment('pixel-noise', 0)
    with pytest.raises(OptionError, match='workers'):
        run_experiment('pixel-noise', 1, workers=0)
    with pytest.raises(OptionError, match="backend 'nonsense'"):
        run_experiment('pixel-noise', 1, backend='nonsense')
    with pytest.raises(SimulationError, match='farthest'):
        # no line of a centimetre has twenty points between 0.3 and 0.3001 m
        options = ExperimentOptions(farthest=0.3001, length=2.0)
        run_trial(options, cell(lines=2, points=20), 0)
    with pytest.raises(OptionError, match='repetitions'):
        benchmark.run_benchmark(2)


def test_the_experiment_command(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    folder = tmp_path / 'new' / 'folder'
    words = ['experiment', 'no-guess', '--trials', '1', '--workers', '1', '--quick']
    assert main([*words, '--output', str(folder), '--farthest', '2.5']) == 0
    assert 'no-guess.csv' in capsys.readouterr().out
    assert '--farthest 2.5' in (folder / 'no-guess.md').read_text(encoding='utf-8')
    assert (folder / 'no-guess.png').read_bytes().startswith(b'\x89PNG')
    assert len(rows_of((folder / 'no-guess.csv').read_text(encoding='utf-8'))) == 12
    assert set(NAMES) == {
        'line-projection', 'pixel-noise', 'world-noise', 'line-count', 'no-guess'}
    # a folder that cannot be: said before the work, not after it
    assert main([*words, '--output', str(folder / 'no-guess.csv')]) == 2
    assert 'cannot be written' in capsys.readouterr().err


def test_the_benchmark_command(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    output = tmp_path / 'out' / 'benchmark.json'
    assert main(['benchmark', '--repetitions', '3', '--output', str(output)]) == 0
    printed = capsys.readouterr().out
    assert 'times faster' in printed
    assert 'whole frame' in printed, "a frame's stages, as ratios to one threshold pass"
    results = json.loads(output.read_text(encoding='utf-8'))
    assert list(results['seconds']) == list(benchmark.CELLS)
    for timings in results['seconds'].values():
        assert all(len(seconds) == 3 and min(seconds) > 0.0 for seconds in timings.values())
    for mode, counted in (('tracking', 3), ('searching', 3)):
        times = results['stages']['modes'][mode]
        assert len(times['frame']) == len(times['threshold']) == counted
    # the outside checks: scipy ends at the same minimum, PoseLib agrees without noise
    assert results['least_squares_apart'] < 1e-6
    if results['poselib_apart'] is not None:
        assert results['poselib_apart'] < 1e-6


def test_boxes_below_the_axis_are_marked_on_it() -> None:
    """Without noise what is left is rounding, seven orders of magnitude below all else."""
    def trials(*sizes: float) -> list[tuple[Answer, ...]]:
        return [tuple(
            Answer(name, (size * part, 0.0, size * part), None)
            for name, size in zip(('paper', 'ours'), sizes)) for part in (1.0, 1.2, 1.5)]

    noisy = [(cell(level=k, sigma_px=k), trials(0.1, 0.01)) for k in (1.0, 2.0)]
    clean = (cell(level=0.0, sigma_px=0.0), trials(0.1, 1e-9))
    for results, marks in ((noisy, 0), ([clean, *noisy], 1)):
        figure = box_figure('errors', 'px', results)
        for axes in figure.axes:
            marked = [line for line in axes.lines if line.get_marker() == 'v']
            assert [round(line.get_xdata()[0], 1) for line in marked] == [-0.1] * marks
        legend = [text.get_text() for text in figure.legends[0].get_texts()]
        assert ('below the axis' in legend) == bool(marks)
