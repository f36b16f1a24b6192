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
"""`nccs-pose render`: a simulated drive as a bag, with its rig and map beside it."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

from nccs_pose.argument_types import image_width, number, whole
from nccs_pose.cli.progress import Progress
from nccs_pose.errors import FileError
from nccs_pose.files.bags import BagWriter
from nccs_pose.files.resources import resolve
from nccs_pose.files.text_files import check_writable
from nccs_pose.files.yaml_files import load_map, load_rig, save_map, save_rig
from nccs_pose.geometry.pose import RigidTransform
from nccs_pose.geometry.rig import Rig
from nccs_pose.simulation.drive import ImageSample, make_drive, stream, WheelModel
from nccs_pose.simulation.motion import figure_of_eight, random_loop, Trajectory
from nccs_pose.simulation.scene import arena_scene, ideal_scene, Scene
import numpy as np

_SCENES: dict[str, Callable[[int], Scene]] = {'arena': arena_scene, 'ideal': ideal_scene}
_START_NS = 1_700_000_000 * 10**9


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        'output', type=Path,
        help='bag to make (a folder); OUTPUT_rig.yaml and OUTPUT_map.yaml are written beside it')
    parser.add_argument(
        '--scene', choices=sorted(_SCENES), default='arena',
        help='arena: a room with floor texture, robot, light and an ordinary camera; ideal: '
             'tapes and grey-level noise alone (default %(default)s)')
    parser.add_argument(
        '--width', type=image_width(64), default=1280, metavar='PX',
        help='width of the images, 4:3 (default %(default)s)')
    parser.add_argument('--rig', type=resolve, help="another rig than the scene's (YAML)")
    parser.add_argument('--map', type=resolve, help="another map than the scene's (YAML)")
    parser.add_argument(
        '--frames', type=whole(1, 10**6), default=50, help='images (default %(default)s)')
    parser.add_argument(
        '--rate', type=number(0.01, 1000.0, 'Hz'), default=10.0, metavar='HZ',
        help='of images (default %(default)s)')
    parser.add_argument(
        '--track', choices=('eight', 'random'), default='eight',
        help='figure of eight, or a smooth random loop (default %(default)s)')
    parser.add_argument(
        '--speed', type=number(0.001, 100.0, 'm/s'), default=0.35, metavar='M/S',
        help='(default %(default)s)')
    parser.add_argument(
        '--compression', choices=('none', 'jpeg', 'png'), default='jpeg',
        help='of the images in the bag (default %(default)s)')
    parser.add_argument(
        '--quality', type=whole(0, 100), default=92, help='of JPEG (default %(default)s)')
    parser.add_argument(
        '--seed', type=whole(0), default=0, help='of all noise; same seed, same bag')


def run(args: argparse.Namespace) -> int:
    scene = _scene(args)
    rng = np.random.default_rng(args.seed)
    track: Trajectory = (
        random_loop(rng, speed=args.speed) if args.track == 'random'
        else figure_of_eight(speed=args.speed))
    drive = make_drive(track, args.frames, args.rate, WheelModel(), rng, _START_NS)
    rig_file, map_file = (_new_file(args.output, kind) for kind in ('rig', 'map'))
    with BagWriter(args.output) as bag, Progress(args.frames, 'frames') as progress:
        bag.write_tf_static(_START_NS, _mounting(scene.rig))
        for sample in stream(scene, drive, args.seed):
            if isinstance(sample, ImageSample):
                bag.write_image(
                    sample.stamp_ns, sample.image, quality=args.quality,
                    compression='' if args.compression == 'none' else args.compression)
                bag.write_camera_info(sample.stamp_ns, scene.rig.camera)
                bag.write_truth(sample.stamp_ns, sample.pose)
                progress.step()
            else:
                bag.write_odometry(
                    sample.stamp_ns, sample.pose, twist=(sample.twist.forward, sample.twist.turn))
    save_rig(scene.rig, rig_file, f'The rig that {args.output.name} was rendered with.')
    save_map(scene.line_map, map_file, f'The map that {args.output.name} was rendered with.')
    print(f'{args.output}: {args.frames} frames; replay it with')
    print(f'nccs-pose replay {args.output} --rig {rig_file} --map {map_file} --output poses.tum')
    return 0


def _new_file(output: Path, kind: str) -> Path:
    """Where the rig or the map goes, which may be somebody's own.

    :raises FileError: if it is there already or cannot be written.
    """
    path = output.parent / f'{output.name}_{kind}.yaml'
    check_writable(path)
    if path.exists():
        raise FileError(f'{path}: exists already; rigs and maps are never overwritten.')
    return path


def _scene(args: argparse.Namespace) -> Scene:
    scene = _SCENES[args.scene](args.width)
    rig = load_rig(args.rig) if args.rig else scene.rig
    line_map = load_map(args.map) if args.map else scene.line_map
    return Scene(rig, line_map, scene.appearance, scene.sensor)


def _mounting(rig: Rig) -> list[tuple[str, str, RigidTransform]]:
    return [
        ('base_link', 'mirror', rig.T_base_mirror),
        ('mirror', 'camera_optical', RigidTransform(rig.R_mirror_camera, rig.cop))]
