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
"""`nccs-pose evaluate`: a trajectory against the true one."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
import sys

from nccs_pose.argument_types import seconds, whole
from nccs_pose.errors import FileError
from nccs_pose.evaluation.metrics import compare, summarise
from nccs_pose.evaluation.tables import as_numbers, summary_table
from nccs_pose.evaluation.trajectory import Trajectory
from nccs_pose.files.pictures import as_title, save_figure
from nccs_pose.files.resources import resolve
from nccs_pose.files.text_files import check_writable, write_text
from nccs_pose.files.trajectories import format_stamp, read_tum
from nccs_pose.files.yaml_files import load_map


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('estimated', type=Path, metavar='ESTIMATED.tum')
    parser.add_argument('truth', type=Path, metavar='TRUTH.tum')
    parser.add_argument(
        '--frames', type=whole(0), metavar='N',
        help='images that the trajectory was made from, to count those not answered '
             '(default: as many as there are poses)')
    parser.add_argument(
        '--max-gap', type=seconds, default=0.2, metavar='S',
        help='seconds between true poses that may be interpolated across (default %(default)s)')
    parser.add_argument(
        '--tolerance', type=seconds, default=0.001, metavar='S',
        help='seconds within which a true pose is taken as it is (default %(default)s)')
    parser.add_argument(
        '--output', type=Path, metavar='FILE',
        help='write the numbers: .json (metres, radians) or .md (the table)')
    parser.add_argument('--plots', type=Path, metavar='DIR', help='folder for pictures')
    parser.add_argument(
        '--map', type=resolve, help='map of the lines (YAML), to draw the trajectory among them')


def run(args: argparse.Namespace) -> int:
    estimated, truth = read_tum(args.estimated), read_tum(args.truth)
    if args.output and args.output.suffix not in ('.json', '.md'):
        raise FileError(f'{args.output}: the numbers are written as .json or .md.')
    lines = tuple(load_map(args.map)) if args.map else ()
    if args.plots:  # first: the folder that this makes may be what a file is to be
        check_writable(args.plots / 'trajectory.png')
    if args.output:
        check_writable(args.output, (args.estimated, args.truth, args.map))
    if args.frames is not None and args.frames < len(estimated):
        raise FileError(
            f'--frames {args.frames}: {args.estimated} has more poses, {len(estimated)}.')
    errors = compare(estimated, truth, max_gap=args.max_gap, tolerance=args.tolerance)
    frames = len(estimated) if args.frames is None else args.frames
    summary = summarise(errors, frames=frames, answered=len(estimated))
    print(summary_table(summary), end='')
    if args.output:
        text = summary_table(summary) if args.output.suffix == '.md' else (
            json.dumps(as_numbers(summary), indent=2) + '\n')
        write_text(args.output, text)
    if args.plots:
        from nccs_pose.evaluation.plots import (
            error_figure,
            histogram_figure,
            trajectory_figure,
        )

        name = as_title(args.estimated.name)
        figures = {
            'trajectory': trajectory_figure(estimated, truth, lines, name),
            'errors': error_figure(errors, title=name),
            'histogram': histogram_figure(errors, name)}
        for kind, figure in figures.items():
            save_figure(figure, args.plots / f'{kind}.png')
    if not len(errors):
        print(
            f'nccs-pose evaluate: {_why_nothing(estimated, truth, args)}', file=sys.stderr)
        return 1
    return 0


def _why_nothing(estimated: Trajectory, truth: Trajectory, args: argparse.Namespace) -> str:
    """Why no pose could be compared."""
    for path, trajectory in ((args.estimated, estimated), (args.truth, truth)):
        if not len(trajectory):
            return f'nothing to compare: {path} holds no pose.'
    spans = ' and '.join(
        f'{path} from {format_stamp(min(t.stamps_ns))} to {format_stamp(max(t.stamps_ns))} s'
        for path, t in ((args.estimated, estimated), (args.truth, truth)))
    return (
        f'nothing to compare: no pose has a true one within {args.tolerance:g} s, nor one on '
        f'either side no more than {args.max_gap:g} s apart; {spans}.')
