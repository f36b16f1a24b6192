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
"""`nccs-pose replay`: the localiser over a bag, without ROS."""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
import dataclasses
import json
from pathlib import Path
import sys
from typing import Any

from nccs_pose.argument_types import whole
from nccs_pose.cli.localiser_options import make_options, odometry_frames
from nccs_pose.cli.offline_run import (
    answered_poses,
    FrameRecord,
    record_line,
    repeatable_json,
    run_events,
)
from nccs_pose.cli.paper_localiser import PaperLocaliser
from nccs_pose.cli.progress import Progress
from nccs_pose.errors import FileError
from nccs_pose.estimation.estimate import Answering, StageTimes
from nccs_pose.estimation.localiser import Localiser
from nccs_pose.estimation.options import LocaliserOptions
from nccs_pose.evaluation.metrics import (
    compare,
    consistency,
    interpolate,
    PoseErrors,
    summarise,
)
from nccs_pose.evaluation.tables import as_numbers, consistency_table, summary_table
from nccs_pose.evaluation.trajectory import Trajectory
from nccs_pose.files.bag_events import BagEvent, StampedOdometry
from nccs_pose.files.bags import BagReader, BagTopics
from nccs_pose.files.pictures import as_title, save_figure, save_image
from nccs_pose.files.resources import resolve
from nccs_pose.files.text_files import check_writable, read_text, write_text
from nccs_pose.files.trajectories import write_tum
from nccs_pose.files.yaml_files import load_map, load_rig
from nccs_pose.geometry.camera import PinholeCamera
from nccs_pose.geometry.lines import LineMap
from nccs_pose.geometry.pose import Array, Pose2
from nccs_pose.geometry.rig import Rig
from nccs_pose.vision.decode import Image
import numpy as np

_METHODS: dict[str, Callable[[Rig, LineMap, LocaliserOptions], Answering]] = {
    'nccs': Localiser, 'paper': PaperLocaliser}
_ENDINGS = ('frames.jsonl', 'run.json', 'evaluation.json')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        'bag', type=resolve, help='rosbag2 folder (or a single .mcap or .db3 file)')
    parser.add_argument('--rig', type=resolve, required=True, help='calibration of the rig (YAML)')
    parser.add_argument('--map', type=resolve, required=True, help='map of the lines (YAML)')
    parser.add_argument(
        '--output', type=Path, required=True, metavar='POSES.tum',
        help='trajectory to write; beside it go POSES.frames.jsonl (every frame: state, reason, '
             'covariance), POSES.run.json (what the run used) and, if the bag has ground truth, '
             'POSES.evaluation.json')
    parser.add_argument('--plots', type=Path, metavar='DIR', help='folder for pictures')
    parser.add_argument(
        '--overlays', type=whole(0), default=6, metavar='N',
        help='images to draw detections and prediction on, with --plots (default %(default)s)')
    parser.add_argument(
        '--method', choices=sorted(_METHODS), default='nccs',
        help="nccs: this project's localiser (default); paper: the published chain, started and "
             'its blobs told apart by the project')
    parser.add_argument(
        '--params', type=resolve, metavar='FILE',
        help='ROS parameter file of the node, for the options of its localiser')
    parser.add_argument(
        '--option', action='append', default=[], metavar='NAME=VALUE',
        help='set an option of the localiser; may be given again')
    parser.add_argument(
        '--no-odometry', action='store_true', help='do not feed odometry, even if the bag has it')
    for kind in ('image', 'camera-info', 'odom', 'ground-truth'):
        parser.add_argument(
            f'--{kind}-topic', metavar='TOPIC', help=f'{kind} topic, if it is not found by itself')


def run(args: argparse.Namespace) -> int:
    rig, line_map = load_rig(args.rig), load_map(args.map)
    options = make_options(args.params, args.option)
    frames = odometry_frames(args.params)
    if args.plots:  # first: the folder that this makes may be what a file is to be
        check_writable(args.plots / 'trajectory.png')
    inputs = (args.bag, args.rig, args.map, args.params)
    check_writable(args.output, inputs)  # and has a name, beside which there are others
    for ending in _ENDINGS:
        check_writable(_beside(args.output, ending), inputs)
    topics = BagTopics(
        args.image_topic, args.camera_info_topic, args.odom_topic, args.ground_truth_topic)
    with BagReader(args.bag, topics) as bag:
        _check_camera(bag, rig, args.rig)
        truth = bag.ground_truth() if bag.topics.ground_truth else None
        total = bag.image_count()
        pictures = _Overlays(args, rig, line_map, truth, total)
        with Progress(total, 'frames') as progress:
            def on_frame(record: FrameRecord, image: Image | None) -> None:
                pictures.draw(record, image)
                progress.step(record.estimate.state.value if record.estimate else 'refused')

            events = _warning_of_frames(bag.events(odometry=not args.no_odometry), frames)
            records = run_events(
                _METHODS[args.method](rig, line_map, options), events, on_frame)
        used = dataclasses.asdict(bag.topics)
        if bag.left_out:
            print(
                f'nccs-pose replay: warning: {len(bag.left_out)} odometry messages were left out, '
                f'the first: {bag.left_out[0]}', file=sys.stderr)
    estimated, covariances = answered_poses(records)
    write_tum(estimated, args.output)
    write_text(_beside(args.output, 'frames.jsonl'), ''.join(map(record_line, records)))
    write_text(_beside(args.output, 'run.json'), _used(args, options, used))
    _print_states(records)
    if truth is not None:
        _evaluate(args, records, estimated, covariances, truth, line_map)
    elif args.plots:
        _draw_trajectory(args, estimated, None, line_map)
    return 0 if len(estimated) else 1


def _check_camera(bag: BagReader, rig: Rig, path: Path) -> None:
    """Hold the bag's CameraInfo against the rig; the rig counts, but a difference is said."""
    camera = rig.camera
    try:
        recorded = bag.camera()
    except FileError as error:
        print(f'nccs-pose replay: warning: {error}', file=sys.stderr)
        return
    if recorded is None:
        return
    if (recorded.width, recorded.height) != (camera.width, camera.height):
        raise FileError(
            f'{bag.path}: {bag.topics.camera_info} is of a {recorded.width} x {recorded.height} '
            f'camera, the rig {path} of a {camera.width} x {camera.height} one.')
    if not np.allclose(_intrinsics(recorded), _intrinsics(camera), atol=0.01):
        print(
            f'nccs-pose replay: warning: {bag.topics.camera_info} differs from the rig {path}, '
            f'which counts: fx fy cx cy are {_intrinsics(recorded)[:4]} in the bag and '
            f'{_intrinsics(camera)[:4]} in the rig.', file=sys.stderr)


def _warning_of_frames(
    events: Iterable[BagEvent], frames: tuple[str, str],
) -> Iterator[BagEvent]:
    """Hand on events; odometry that the node would refuse for its frames is used, but said."""
    strange: set[tuple[str, str]] = set()
    for event in events:
        if isinstance(event, StampedOdometry):
            own = (event.frame_id, event.child_frame_id)
            # As the node does, take a name that the driver left empty.
            refused = any(name not in ('', wanted) for name, wanted in zip(own, frames))
            if refused and own not in strange:
                strange.add(own)
                print(
                    f'nccs-pose replay: warning: odometry of {own[1]!r} in {own[0]!r} is used; '
                    f'the node takes that of {frames[1]!r} in {frames[0]!r} alone (odom_frame, '
                    'base_frame, frame_prefix).', file=sys.stderr)
        yield event


def _intrinsics(camera: PinholeCamera) -> list[float]:
    padded = [*camera.distortion, *[0.0] * (8 - len(camera.distortion))]
    return [camera.fx, camera.fy, camera.cx, camera.cy, *padded]


class _Overlays:
    """Draws some of the frames, evenly spread, as they come by."""

    def __init__(
        self, args: argparse.Namespace, rig: Rig, line_map: LineMap, truth: Trajectory | None,
        total: int,
    ) -> None:
        count = min(args.overlays, total) if args.plots else 0
        self._chosen = set(np.linspace(0, total - 1, count).round().astype(int).tolist())
        self._folder, self._rig, self._map, self._truth = args.plots, rig, line_map, truth

    def draw(self, record: FrameRecord, image: Image | None) -> None:
        if record.index not in self._chosen or record.estimate is None or image is None:
            return
        from nccs_pose.evaluation.overlay import draw_overlay

        true_pose = None
        if self._truth is not None:
            poses, known = interpolate(self._truth, np.array([record.stamp_ns]))
            true_pose = Pose2.from_array(poses[0]) if known[0] else None
        scale = 2 if image.shape[1] < 1200 else 1
        save_image(
            draw_overlay(image, self._rig, self._map, record.estimate, true_pose, scale),
            self._folder / f'overlay_{record.index:04d}.jpg')


def _evaluate(
    args: argparse.Namespace, records: list[FrameRecord], estimated: Trajectory,
    covariances: Array | None, truth: Trajectory, line_map: LineMap,
) -> None:
    errors = compare(estimated, truth)
    summary = summarise(errors, frames=len(records), answered=len(estimated))
    matched = None if covariances is None else covariances[errors.index]
    trust = None if matched is None else consistency(errors.error, matched)
    write_text(
        _beside(args.output, 'evaluation.json'),
        repeatable_json(as_numbers(summary, trust), indent=2) + '\n')
    print(summary_table(summary))
    if trust is not None and trust.count:
        print(consistency_table(trust))
    if args.plots:
        _draw_trajectory(args, estimated, truth, line_map)
        _draw_errors(args, errors, matched)


def _draw_trajectory(
    args: argparse.Namespace, estimated: Trajectory, truth: Trajectory | None, line_map: LineMap,
) -> None:
    from nccs_pose.evaluation.plots import trajectory_figure

    save_figure(
        trajectory_figure(estimated, truth, line_map, as_title(args.bag)),
        args.plots / 'trajectory.png')


def _draw_errors(
    args: argparse.Namespace, errors: PoseErrors, covariances: Array | None,
) -> None:
    from nccs_pose.evaluation.plots import error_figure, histogram_figure

    save_figure(error_figure(errors, covariances, as_title(args.bag)), args.plots / 'errors.png')
    save_figure(histogram_figure(errors, as_title(args.bag)), args.plots / 'histogram.png')


def _print_states(records: list[FrameRecord]) -> None:
    states = Counter(r.estimate.state.value if r.estimate else 'refused' for r in records)
    print(', '.join(f'{count} {state}' for state, count in states.most_common()))
    for refusal, count in Counter(r.refusal for r in records if r.refusal).most_common(5):
        print(f'refused {count} times: {refusal}')
    answered = [r for r in records if r.estimate is not None]
    if answered:
        stages = {
            field.name: 1e3 * float(np.median(
                [getattr(r.estimate.times, field.name) for r in answered if r.estimate]))
            for field in dataclasses.fields(StageTimes)}
        median = 1e3 * float(np.median([r.seconds for r in answered]))
        parts = ', '.join(f'{name} {value:.2f}' for name, value in stages.items())
        print(f'{median:.2f} ms a frame from decoded image to pose (median; {parts})')
    print()


def _used(args: argparse.Namespace, options: LocaliserOptions, topics: dict[str, Any]) -> str:
    """What the run used, the files' own text included."""
    return json.dumps({
        'command': 'replay', 'method': args.method, 'bag': str(args.bag), 'topics': topics,
        'odometry': not args.no_odometry, 'options': dataclasses.asdict(options),
        'rig': {'file': str(args.rig), 'text': read_text(args.rig)},
        'map': {'file': str(args.map), 'text': read_text(args.map)},
    }, indent=2) + '\n'


def _beside(output: Path, ending: str) -> Path:
    return output.with_name(f'{output.name.removesuffix(".tum")}.{ending}')
