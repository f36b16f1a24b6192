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
"""`nccs-pose starts`: what one image alone tells, map by map, and what the search costs."""

from __future__ import annotations

import argparse
from pathlib import Path

from nccs_pose.argument_types import image_width, whole
from nccs_pose.cli.localiser_options import make_options
from nccs_pose.cli.progress import Progress
from nccs_pose.errors import OptionError
from nccs_pose.evaluation.starts import Place, PLACES, run_starts, starts_table
from nccs_pose.files.resources import resolve
from nccs_pose.files.text_files import check_writable, write_text
from nccs_pose.files.yaml_files import load_map


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Describe the command line."""
    parser.add_argument(
        'names', nargs='*', metavar='PLACE',
        help='only those whose names contain one of these words; all if none is given')
    parser.add_argument('--list', action='store_true', help='name the places and stop')
    parser.add_argument('--map', type=resolve, metavar='FILE', help='this map instead')
    parser.add_argument(
        '--option', action='append', default=[], metavar='NAME=VALUE',
        help='of the localiser, for --map (reach=9.0)')
    parser.add_argument(
        '--widths', type=image_width(160), nargs='+', default=[640, 1280], metavar='PX',
        help='of the images, 4:3 (default: 640 1280)')
    parser.add_argument(
        '--trials', type=whole(1, 10**6), default=24, metavar='N',
        help='images of each place and width (default: %(default)s)')
    parser.add_argument(
        '--seed', type=whole(0), default=7, help='of poses and noise (default: %(default)s)')
    parser.add_argument('--output', type=Path, metavar='FILE', help='write the table there')


def run(arguments: argparse.Namespace) -> int:
    """Print the table; 1 if any pose was wrong."""
    places = _chosen(arguments)
    if arguments.list:
        print('\n'.join(place.name for place in places))
        return 0
    if arguments.output is not None:
        check_writable(arguments.output, (arguments.map,))
    rows = []
    work = len(places) * len(arguments.widths) * arguments.trials
    with Progress(work, 'images') as progress:
        for place in places:
            for width in arguments.widths:
                rows.append(run_starts(
                    place, width, arguments.trials, seed=arguments.seed, progress=progress.step))
    text = starts_table(rows)
    print(text)
    if arguments.output is not None:
        write_text(arguments.output, text)
    return 1 if any(row.wrong for row in rows) else 0


def _chosen(arguments: argparse.Namespace) -> list[Place]:
    if arguments.option and arguments.map is None:
        raise OptionError('--option is for a map of your own: give it by --map')
    if arguments.map is not None and arguments.names:
        raise OptionError(
            f'--map {arguments.map} and the names {", ".join(arguments.names)}: give one of both')
    if arguments.map is not None:
        options = make_options(None, arguments.option)
        return [Place(arguments.map.stem, load_map(arguments.map), options=options)]
    words = arguments.names
    chosen = [p for p in PLACES if not words or any(word in p.name for word in words)]
    if not chosen:
        raise OptionError(f'no place is called like {", ".join(words)}; see --list')
    return chosen
