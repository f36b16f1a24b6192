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


"""`nccs-pose coverage`: is the covariance true? NEES and coverage by scenario."""

from __future__ import annotations

import argparse
from pathlib import Path

from nccs_pose.argument_types import whole
from nccs_pose.cli.progress import Progress
from nccs_pose.errors import OptionError
from nccs_pose.evaluation.coverage import coverage_table, run_scenario, Scenario, SCENARIOS
from nccs_pose.files.text_files import check_writable, write_text


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Describe the command line."""
    parser.add_argument(
        'names', nargs='*', metavar='SCENARIO',
        help='only those whose names contain one of these words; all if none is given')
    parser.add_argument('--list', action='store_true', help='name the scenarios and stop')
    parser.add_argument(
        '--trials', type=whole(2, 10**6), default=60, metavar='N',
        help='images of each scenario (default: %(default)s)')
    parser.add_argument(
        '--seed', type=whole(0), default=3, help='of poses and noise (default: %(default)s)')
    parser.add_argument('--output', type=Path, metavar='FILE', help='write the table there')


def run(arguments: argparse.Namespace) -> int:
    """Print the table; 1 if a covariance is too small to be true anywhere."""
    scenarios = _chosen(arguments.names)
    if arguments.list:
        print('\n'.join(scenario.name for scenario in scenarios))
        return 0
    if arguments.output is not None:
        check_writable(arguments.output)
    rows = []
    with Progress(len(scenarios) * arguments.trials, 'trials') as progress:
        for scenario in scenarios:
            rows.append(run_scenario(
                scenario, arguments.trials, seed=arguments.seed, progress=progress.step))
    text = coverage_table(rows)
    print(text)
    if arguments.output is not None:
        write_text(arguments.output, text)
    return 1 if any(row.verdict == 'too sure' for row in rows) else 0


def _chosen(words: list[str]) -> list[Scenario]:
    chosen = [s for s in SCENARIOS if not words or any(word in s.name for word in words)]
    if not chosen:
        raise OptionError(f'no scenario is called like {", ".join(words)}; see --list')
    return chosen
