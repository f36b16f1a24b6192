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


"""`nccs-pose precision`: errors against the image's own bound and the paper's sampling."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from nccs_pose.argument_types import image_width, number, whole
from nccs_pose.cli.progress import Progress
from nccs_pose.evaluation.precision import as_numbers, precision_table, run_precision
from nccs_pose.files.text_files import check_writable, write_text


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Describe the command line."""
    parser.add_argument(
        '--widths', type=image_width(160), nargs='+', default=[1280, 640], metavar='PX',
        help='widths of the images, 4:3 (default: 1280 640)')
    parser.add_argument(
        '--poses', type=whole(2, 10**6), default=40, metavar='N',
        help='one image is taken at each of N random poses (default: %(default)s)')
    parser.add_argument(
        '--noise', type=number(1e-4, 1.0), default=0.05, metavar='SHARE',
        help='noise of every channel over full scale (default: %(default)s)')
    parser.add_argument(
        '--seed', type=whole(0), default=1, help='of poses and noise (default: %(default)s)')
    parser.add_argument(
        '--output', type=Path, metavar='DIR',
        help='write precision.md and precision.json there')


def run(arguments: argparse.Namespace) -> int:
    """Print one table a size."""
    if arguments.output is not None:
        check_writable(arguments.output / 'precision.md')
    results = []
    with Progress(len(arguments.widths) * arguments.poses, 'images') as progress:
        for width in arguments.widths:
            results.append(run_precision(
                width, arguments.poses, noise=arguments.noise, seed=arguments.seed,
                progress=progress.step))
    text = '\n'.join(precision_table(result) for result in results)
    print(text)
    if arguments.output is not None:
        write_text(arguments.output / 'precision.md', text)
        write_text(
            arguments.output / 'precision.json',
            json.dumps([as_numbers(result) for result in results], indent=1) + '\n')
    return 0
