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

"""`nccs-pose faults`: play every named fault through the localiser, offline."""

from __future__ import annotations

import argparse
from pathlib import Path

from nccs_pose.argument_types import image_width, whole
from nccs_pose.cli.progress import Progress
from nccs_pose.errors import OptionError
from nccs_pose.estimation.localiser import Localiser
from nccs_pose.evaluation.fault_table import combine, fault_csv, fault_table, run_fault
from nccs_pose.files.text_files import check_writable, write_text
from nccs_pose.simulation.fault_list import FAULTS
from nccs_pose.simulation.faults import Fault, rehearse

_LEAST_FRAMES = 18  # 8 before the fault, 8 of it and 2 after it


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Describe the command line."""
    parser.add_argument('names', nargs='*', metavar='FAULT', help='which; all if none is named')
    parser.add_argument('--list', action='store_true', help='name the faults and stop')
    parser.add_argument(
        '--width', type=image_width(160), default=640, metavar='PX',
        help='width of the images, 4:3 (default: %(default)s)')
    parser.add_argument(
        '--frames', type=whole(_LEAST_FRAMES, 10**5), default=24, metavar='N',
        help='images of a clean drive, at 10 Hz; the fault begins at the ninth '
             '(default: %(default)s)')
    parser.add_argument(
        '--drives', type=whole(1, 1000), default=2, metavar='N',
        help='on how many tracks each fault is played (default: %(default)s)')
    parser.add_argument(
        '--output', type=Path, metavar='DIR', help='write faults.md and faults.csv there')


def run(arguments: argparse.Namespace) -> int:
    """Print the table; 1 if any wrong pose was published as good."""
    faults = _chosen(arguments.names)
    if arguments.list:
        for fault in faults:
            print(f'{fault.name:20} {fault.description}')
        return 0
    if arguments.output is not None:
        check_writable(arguments.output / 'faults.md')
    rehearsals = [
        rehearse(arguments.width, arguments.frames, seed) for seed in range(arguments.drives)]
    rows = []
    with Progress(len(faults), 'faults') as progress:
        for fault in faults:
            rows.append(combine([run_fault(fault, each, Localiser) for each in rehearsals]))
            progress.step(fault.name)
    text = fault_table(rows)
    wrong = sum(row.wrong for row in rows)
    answered = sum(row.answered for row in rows)
    verdict = f'{wrong} of {answered} published poses wrong (beyond 5 sigma and 50 mm or 1 deg).'
    print(f'{text}\n{verdict}')
    if arguments.output is not None:
        write_text(arguments.output / 'faults.md', f'{text}\n{verdict}\n')
        write_text(arguments.output / 'faults.csv', fault_csv(rows))
    return 1 if wrong else 0


def _chosen(names: list[str]) -> list[Fault]:
    known = {fault.name: fault for fault in FAULTS}
    for name in names:
        if name not in known:
            raise OptionError(f'no fault is called {name!r}; there are {", ".join(known)}')
    return [known[name] for name in names] if names else list(FAULTS)
