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


"""`nccs-pose stages`: what a frame costs, against one HSV threshold of the same image."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from nccs_pose.argument_types import image_width, whole
from nccs_pose.cli.progress import Progress
from nccs_pose.evaluation.stages import as_numbers, LEAST_FRAMES, measure_stages, stages_table
from nccs_pose.files.text_files import check_writable, write_text


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Describe the command line."""
    parser.add_argument(
        '--width', type=image_width(160), default=1280, metavar='PX',
        help='width of the images, 4:3 (default: %(default)s)')
    parser.add_argument(
        '--frames', type=whole(LEAST_FRAMES, 10**5), default=40, metavar='N',
        help='frames of the drive (default: %(default)s)')
    parser.add_argument('--output', type=Path, metavar='FILE', help='write every time as JSON')


def run(arguments: argparse.Namespace) -> int:
    """Print the table."""
    if arguments.output is not None:
        check_writable(arguments.output)
    with Progress(3 * arguments.frames - 2, 'frames') as progress:
        costs = measure_stages(arguments.width, arguments.frames, progress=progress.step)
    print(stages_table(costs))
    if arguments.output is not None:
        write_text(arguments.output, json.dumps(as_numbers(costs), indent=1) + '\n')
    return 0
