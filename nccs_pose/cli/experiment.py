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


"""`nccs-pose experiment`: repeat the paper's experiments."""

from __future__ import annotations

import argparse
import dataclasses
import os
from pathlib import Path

from nccs_pose.argument_types import whole
import nccs_pose.cli.one_thread  # noqa: F401 - before numpy
from nccs_pose.cli.progress import Progress
from nccs_pose.evaluation.experiment_options import ExperimentOptions
from nccs_pose.evaluation.experiments import NAMES, run_experiment, steps_of
from nccs_pose.files.pictures import save_figure
from nccs_pose.files.text_files import check_writable, write_text


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Describe the command line."""
    parser.add_argument('name', choices=NAMES, help='which experiment')
    parser.add_argument(
        '--trials', type=whole(1), default=100, help='trials per cell (paper: 1000)')
    parser.add_argument(
        '--output', type=Path, required=True,
        help='folder for the CSV of every trial, the figure and the summary')
    parser.add_argument(
        '--workers', type=whole(1), default=os.cpu_count() or 1, help='processes (all cores)')
    parser.add_argument(
        '--backend', default='loky', help="joblib's backend; one of a cluster's works too")
    for field in dataclasses.fields(ExperimentOptions):
        flag = '--' + field.name.replace('_', '-')
        unit = f' [{field.metadata["unit"]}]' if field.metadata['unit'] else ''
        text = f'{field.metadata["doc"]}{unit} (default {field.default})'
        if isinstance(field.default, bool):
            parser.add_argument(flag, action='store_true', help=text)
        else:
            parser.add_argument(flag, type=type(field.default), default=field.default, help=text)


def run(arguments: argparse.Namespace) -> int:
    """Run it, print the summary and write the three files."""
    options = ExperimentOptions(**{
        field.name: getattr(arguments, field.name)
        for field in dataclasses.fields(ExperimentOptions)})
    table, figure, page = (
        arguments.output / f'{arguments.name}.{ending}' for ending in ('csv', 'png', 'md'))
    check_writable(table)
    with Progress(steps_of(arguments.name, options), 'cells') as progress:
        outcome = run_experiment(
            arguments.name, arguments.trials, workers=arguments.workers,
            backend=arguments.backend, options=options, progress=progress.step)
    write_text(table, outcome.csv)
    write_text(page, outcome.summary)
    save_figure(outcome.figure, figure)
    print(outcome.summary)
    print(f'Written: {table}, {figure}, {page}')
    return 0
