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

"""`nccs-pose calibrate`: a rough rig refined from the lines that a drive shows."""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path
import sys

from nccs_pose.argument_types import whole
from nccs_pose.calibration.from_images import calibrate_images
from nccs_pose.calibration.options import CalibrationOptions
from nccs_pose.calibration.outline import find_outline
from nccs_pose.calibration.procedure import Calibration
from nccs_pose.calibration.rim import rig_from_outline
from nccs_pose.cli.drive_images import DriveImages
from nccs_pose.cli.option_settings import explain, parse_settings
from nccs_pose.files.pictures import save_figure
from nccs_pose.files.resources import resolve
from nccs_pose.files.text_files import check_writable, write_text
from nccs_pose.files.yaml_files import load_map, load_rig, save_map, save_rig
from nccs_pose.geometry.rig import Rig

_FREE = {
    'mirror': 'mirror', 'principal-point': 'principal_point', 'focal-length': 'focal_length',
    'tape-width': 'tape_width'}
_NUMBERS = {
    field.name: field for field in dataclasses.fields(CalibrationOptions)
    if not isinstance(field.default, bool)}
_OUTLINE_IMAGES = 10


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('bag', type=resolve, help='rosbag2 of a drive, or a folder of images')
    parser.add_argument('--rig', type=resolve, required=True, metavar='ROUGH.yaml',
                        help='the rig as far as it is known')
    parser.add_argument('--map', type=resolve, required=True, help='map of the lines (YAML)')
    parser.add_argument(
        '--output', type=Path, required=True, metavar='RIG.yaml',
        help='refined rig to write; beside it goes RIG.report.md with its pictures')
    parser.add_argument(
        '--free', action='append', default=[], choices=sorted(_FREE),
        help='free this too (always: camera against mirror, height, tilt); may be given again')
    parser.add_argument(
        '--hold', action='append', default=[], choices=('height', 'tilt'),
        help='hold this at its rough value; may be given again')
    parser.add_argument(
        '--free-line', action='append', default=[], metavar='NAME',
        help="free this map line's place; writes RIG.map.yaml; may be given again")
    parser.add_argument(
        '--from-rim', action='store_true',
        help="first guess of the camera's place from the mirror's outline (needs rim_radius)")
    parser.add_argument(
        '--option', action='append', default=[], metavar='NAME=VALUE',
        help='set an option of the calibration, see below; may be given again')
    parser.add_argument('--images', type=whole(1), default=150, metavar='N',
                        help='look at this many images at most (default %(default)s)')
    parser.add_argument('--image-topic', metavar='TOPIC', help='if the bag has several')
    parser.epilog = (
        'options of the calibration (rough_*: standard deviation of what the rough rig says):\n'
        f'{explain(_NUMBERS)}\n\n{parser.epilog}')


def run(args: argparse.Namespace) -> int:
    rig, line_map = load_rig(args.rig), load_map(args.map)
    options = _options(args)
    inputs = (args.bag, args.rig, args.map)
    check_writable(args.output, inputs)  # and has a name, beside which there are others
    for ending in ('.map.yaml', '.report.md', '.residuals_image.png'):
        check_writable(args.output.with_suffix(ending), inputs)
    images = DriveImages(args.bag, args.images, args.image_topic)
    images.check_size(rig.camera)
    if args.from_rim:
        rig = _from_rim(rig, images, options)
    result = calibrate_images(
        rig, line_map, images, options, args.free_line,
        on_pass=lambda words: print(words, file=sys.stderr, flush=True))
    _write(args, result)
    print(result.verdict)
    return 0 if result.good else 1


def _options(args: argparse.Namespace) -> CalibrationOptions:
    """Options from the defaults, --free, --hold and --option.

    :raises OptionError: naming what is not one.
    """
    return CalibrationOptions(
        **{_FREE[name]: True for name in args.free}, **dict.fromkeys(args.hold, False),
        **parse_settings(args.option, _NUMBERS))


def _from_rim(rig: Rig, images: DriveImages, options: CalibrationOptions) -> Rig:
    some = []
    for _, image in images():
        some.append(image)
        if len(some) == _OUTLINE_IMAGES:
            break
    return rig_from_outline(rig, find_outline(rig, some, options), options)


def _write(args: argparse.Namespace, result: Calibration) -> None:
    from nccs_pose.evaluation.calibration_report import report_figures, report_text

    output: Path = args.output
    comment = f'calibrated by nccs-pose from {args.bag.name}: {result.verdict}'
    save_rig(result.model.rig, output, comment)
    if args.free_line or 'tape-width' in args.free:
        save_map(result.model.line_map, output.with_suffix('.map.yaml'), comment)
    names = []
    for name, figure in report_figures(result).items():
        path = output.with_suffix(f'.{name}.png')
        save_figure(figure, path)
        names.append(path.name)
    write_text(output.with_suffix('.report.md'), report_text(result, tuple(names)))
