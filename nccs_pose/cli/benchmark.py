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


"""`nccs-pose benchmark`: what the estimators and a frame's stages cost, measured in one run."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from nccs_pose.argument_types import whole
from nccs_pose.cli.progress import Progress
from nccs_pose.evaluation import stages
from nccs_pose.evaluation.benchmark import as_numbers, CELLS, report, run_benchmark
from nccs_pose.files.text_files import check_writable, write_text

_WIDTH = 1280  # px, of the images whose stages are timed


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Describe the command line."""
    parser.add_argument(
        '--repetitions', type=whole(3, 10**6), default=50, help='scenes timed (default 50)')
    parser.add_argument('--output', type=Path, help='JSON file for every single timing')


def run(arguments: argparse.Namespace) -> int:
    """Print the tables, and write the numbers behind them."""
    if arguments.output is not None:
        check_writable(arguments.output)
    with Progress(len(CELLS) * arguments.repetitions, 'scenes') as progress:
        benchmark = run_benchmark(arguments.repetitions, progress.step)
    print(report(benchmark))
    frames = max(arguments.repetitions, stages.LEAST_FRAMES)
    with Progress(3 * frames - 2, 'frames') as progress:
        costs = stages.measure_stages(_WIDTH, frames, progress=progress.step)
    print(stages.stages_table(costs))
    if arguments.output is not None:
        write_text(arguments.output, json.dumps(
            {**as_numbers(benchmark), 'stages': stages.as_numbers(costs)}, indent=1) + '\n')
        print(f'Written: {arguments.output}')
    return 0
