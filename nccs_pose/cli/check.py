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

"""`nccs-pose check`: is a calibration still good?"""

from __future__ import annotations

import argparse

from nccs_pose.argument_types import number, whole
from nccs_pose.calibration.from_images import measure
from nccs_pose.calibration.judgement import judge, Judgement, robust_deviation
from nccs_pose.calibration.monitor import CalibrationMonitor, Condition, MonitorOptions, Verdict
from nccs_pose.calibration.parameters import RigModel
from nccs_pose.cli.drive_images import DriveImages
from nccs_pose.errors import CalibrationError
from nccs_pose.files.resources import resolve
from nccs_pose.files.yaml_files import load_map, load_rig
from nccs_pose.geometry.lines import LineMap
import numpy as np

_FEWEST = 10  # frames; fewer say nothing of a rig


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('bag', type=resolve, help='rosbag2 of a drive, or a folder of images')
    parser.add_argument('--rig', type=resolve, required=True, help='the rig to check (YAML)')
    parser.add_argument('--map', type=resolve, required=True, help='map of the lines (YAML)')
    parser.add_argument(
        '--pose-error', type=number(0.01, 1000.0, 'mm'), default=5.0, metavar='MM',
        help='pose error that matters, mm (default %(default)s)')
    parser.add_argument('--images', type=whole(1), default=150, metavar='N',
                        help='look at this many images at most (default %(default)s)')
    parser.add_argument('--image-topic', metavar='TOPIC', help='if the bag has several')


def run(args: argparse.Namespace) -> int:
    rig, line_map = load_rig(args.rig), load_map(args.map)
    options = MonitorOptions(
        least_frames=_FEWEST, memory=100000, pose_error=1e-3 * args.pose_error)
    images = DriveImages(args.bag, args.images, args.image_topic)
    images.check_size(rig.camera)
    monitor = CalibrationMonitor(rig, line_map, options)
    # Under a rig that is off, poses are doubted, and tell most of all what is wrong.
    measured = measure(rig, line_map, images(), look=monitor.add)
    verdict = monitor.verdict()
    if not measured.frames and verdict.condition is Condition.UNKNOWN:
        reason = measured.reasons.most_common(1)[0][0] if measured.reasons else 'no image'
        raise CalibrationError(
            f'in none of {measured.seen} images the lines could be followed ({reason}): wrong '
            'rig, wrong map, or wrong colour')
    print(f'images followed: {len(measured.frames)} of {measured.seen}')
    for reason, count in measured.reasons.most_common(3):
        print(f'  {count} not: {reason}')
    if measured.frames:
        model = RigModel(rig, line_map)
        _print_structure(judge(model, model, measured.frames, measured.poses), line_map)
    print(f'structure against noise: {verdict.statistic:.0f} (noise alone stays below '
          f'{verdict.limit:.0f}){_worth(verdict, options)}')
    print(verdict.words)
    return 0 if verdict.condition is Condition.GOOD else 1


def _worth(verdict: Verdict, options: MonitorOptions) -> str:
    """What structure that is no noise means for a calibration that is good all the same."""
    if verdict.condition is not Condition.GOOD or verdict.statistic <= verdict.limit:
        return ''
    return (f': worth {1e3 * verdict.pose_error:.1f} mm in the poses, less than the '
            f'{1e3 * options.pose_error:g} mm that matter (--pose-error)')


def _print_structure(judged: Judgement, line_map: LineMap) -> None:
    """Residuals by line: the mean is structure, the deviation is noise."""
    residual = judged.residual_after
    print(f'residuals: {robust_deviation(residual):.3f} px, by line:')
    for index, line in enumerate(line_map):
        own = residual[(judged.line == index) & np.isfinite(residual)]
        if len(own):
            print(f'  {line.name or index}: mean {own.mean():+.3f} px, deviation '
                  f'{own.std():.3f} px, {len(own)} points')
