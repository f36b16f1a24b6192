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

"""`make demo`: the node localises the robot of a bag, over DDS, and is held against the truth.

The node runs in a process of its own; this one plays the bag in real time and subscribes the
pose and the debug image, as a user would.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, field
import os
from pathlib import Path
import struct
import subprocess
import sys
import threading
import time

from geometry_msgs.msg import PoseWithCovarianceStamped
from nccs_pose.argument_types import positive
from nccs_pose.errors import FileError, NccsPoseError
from nccs_pose.evaluation.metrics import compare, summarise
from nccs_pose.evaluation.plots import error_figure, trajectory_figure
from nccs_pose.evaluation.tables import summary_table, table
from nccs_pose.evaluation.trajectory import Trajectory
from nccs_pose.files.bags import BagReader
from nccs_pose.files.pictures import save_figure, save_image
from nccs_pose.files.resources import resolve, share_directory
from nccs_pose.files.serialised_bag import SerialisedBag
from nccs_pose.files.text_files import check_writable
from nccs_pose.files.yaml_files import load_map
from nccs_pose.geometry.lines import LineMap
from nccs_pose.geometry.pose import Pose2
from nccs_pose.ros.conversions import decode, PLANAR, pose_to_planar, stamp_to_ns
from nccs_pose.ros.player import Playback, Player, wait_for_subscribers
from nccs_pose.ros.start import initialise, leave, told_to_end
from nccs_pose.ros.transport import stay_alone, use_large_images
import numpy as np
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import Image

PICTURES = 6
START_UP = 30.0
"""Seconds that the localiser may take to start."""
GRACE = 3.0
"""Seconds that the last answer may take."""


@dataclass
class Record:
    """What was sent and what came back.

    :ivar sent: wall time (s) of each image's publication, by its stamp (ns).
    :ivar received: wall time of each pose, by its stamp.
    :ivar poses: and the poses.
    :ivar covariances: of (x, y, yaw).
    """

    sent: dict[int, float] = field(default_factory=dict)
    received: dict[int, float] = field(default_factory=dict)
    poses: dict[int, Pose2] = field(default_factory=dict)
    covariances: dict[int, np.ndarray] = field(default_factory=dict)

    def note_sent(self, data: bytes) -> None:
        """Note an image about to be published; its stamp is the first thing in its bytes."""
        sec, nanosec = struct.unpack_from('<iI', data, 4)
        self.sent[sec * 1_000_000_000 + nanosec] = time.monotonic()

    def note_pose(self, message: PoseWithCovarianceStamped) -> None:
        """Note an answer."""
        now = time.monotonic()
        stamp_ns = stamp_to_ns(message.header.stamp)
        self.received[stamp_ns] = now
        self.poses[stamp_ns] = pose_to_planar(message.pose.pose, 'pose')
        full = np.asarray(message.pose.covariance).reshape(6, 6)
        self.covariances[stamp_ns] = full[np.ix_(PLANAR, PLANAR)]

    def trajectory(self) -> Trajectory:
        """The answers by stamp."""
        stamps = sorted(self.poses)
        return Trajectory(
            np.array(stamps, dtype=np.int64),
            np.array([self.poses[s].as_array() for s in stamps]).reshape(-1, 3))

    def latencies(self) -> np.ndarray:
        """Seconds from publishing an image to receiving its pose (N,)."""
        return np.array([
            self.received[s] - self.sent[s] for s in sorted(self.received) if s in self.sent])


class DemoUser(Node):
    """Subscribes what a user would."""

    def __init__(self, record: Record, picture_folder: Path, picture_stamps: list[int]) -> None:
        super().__init__('demo')
        self._record = record
        self._folder = picture_folder
        self._wanted = list(picture_stamps)
        self.pictures: list[Path] = []
        self.create_subscription(PoseWithCovarianceStamped, 'pose', record.note_pose, 100)
        self.create_subscription(
            Image, 'localiser/debug_image', self._on_debug_image, QoSProfile(depth=1))

    def _on_debug_image(self, message: Image) -> None:
        stamp_ns = stamp_to_ns(message.header.stamp)
        if self._wanted and stamp_ns >= self._wanted[0]:
            self._wanted = [s for s in self._wanted if s > stamp_ns]
            path = self._folder / f'overlay_{len(self.pictures)}.png'
            save_image(decode(message), path)
            self.pictures.append(path)


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point of `ros2 run nccs_pose demo`."""
    parser = argparse.ArgumentParser(
        prog='demo', description='A robot localises itself over ROS 2 topics from a bag.')
    parser.add_argument('--bag', default='bags/room', help='bag to play (default bags/room)')
    parser.add_argument('--params', default='config/room.yaml', help="the localiser's parameters")
    parser.add_argument('--map', default='config/room_map.yaml', help='map, for the plot')
    parser.add_argument('--rate', type=positive, default=1.0, help='speed factor (default 1)')
    parser.add_argument('--output', default='out', type=Path, help='folder for the pictures')
    options = parser.parse_args(argv)
    use_large_images()
    stay_alone()
    _say(f'on ROS_DOMAIN_ID {os.environ["ROS_DOMAIN_ID"]}, where you can watch')
    try:
        initialise([])
        return _demo(options)
    except NccsPoseError as error:
        print(f'demo: {error}', file=sys.stderr)
        return 2
    finally:
        leave()


def _demo(options: argparse.Namespace) -> int:
    # Before the drive, not after it.
    line_map = load_map(resolve(options.map))
    check_writable(options.output / 'trajectory.png')
    bag_path = resolve(options.bag)
    with BagReader(bag_path) as reader:
        truth, topics = reader.ground_truth(), reader.topics
    image = topics.image
    if image is None:
        raise FileError(f'{bag_path}: has no images.')
    record = Record()
    with SerialisedBag(bag_path) as bag:
        pictures = np.linspace(bag.start_ns, bag.end_ns, PICTURES + 2)[1:-1].astype(int).tolist()
        user = DemoUser(record, options.output, pictures)
        played = (image, topics.camera_info, topics.odom)
        player = Player(user, bag, Playback(
            rate=options.rate, topics=tuple(topic for topic in played if topic)))
        localiser = _start_localiser(options.params, image, topics.camera_info, topics.odom)
        executor = SingleThreadedExecutor()
        executor.add_node(user)
        spinning = threading.Thread(target=executor.spin, daemon=True)
        spinning.start()
        try:
            _say(f'localiser started; waiting until it listens to {image}')
            if _listens(localiser, player, image):
                _play(player, bag, image, record, options.rate)
            elif not told_to_end():
                _say('the localiser does not listen: what it printed above says why')
                return 1
        finally:
            _stop(localiser)
            # Before ROS itself, which would leave the callback that is due for Python to warn of.
            executor.shutdown(5.0)
            spinning.join(5.0)
    if told_to_end():
        print('\ndemo: stopped')
        return 130
    return _conclude(record, truth, line_map, options.output, user.pictures)


def _start_localiser(
    params: str, image: str, camera_info: str | None, odom: str | None,
) -> subprocess.Popen[bytes]:
    remappings = [f'image:={image.removesuffix("/compressed")}']
    remappings.append(f'image/compressed:={image}')
    remappings += [f'{name}:={topic}' for name, topic in (
        ('camera_info', camera_info), ('odom', odom)) if topic]
    command = [sys.executable, '-m', 'nccs_pose.ros.localiser', '--ros-args',
               '--params-file', str(resolve(params))]
    for remapping in remappings:
        command += ['-r', remapping]
    return subprocess.Popen(command, cwd=share_directory())


def _listens(process: subprocess.Popen[bytes], player: Player, topic: str) -> bool:
    end = time.monotonic() + START_UP
    while process.poll() is None and time.monotonic() < end and not told_to_end():
        if wait_for_subscribers(player, [topic], 0.5):
            return True
    return False


def _stop(process: subprocess.Popen[bytes]) -> None:
    process.terminate()
    try:
        process.wait(10.0)
    except subprocess.TimeoutExpired:
        process.kill()


def _play(player: Player, bag: SerialisedBag, image: str, record: Record, rate: float) -> None:
    total = next(topic.count for topic in bag.topics if topic.name == image)
    seconds = 1e-9 * (bag.end_ns - bag.start_ns) / rate
    _say(f'playing {total} images in {seconds:.0f} s')
    progress = Progress(total, record)

    def on_sent(topic: str, data: bytes) -> None:
        if topic == image:
            record.note_sent(data)
        progress.show()

    player.play(on_sent)
    end = time.monotonic() + GRACE
    while (time.monotonic() < end and len(record.poses) < len(record.sent)
           and not told_to_end()):
        time.sleep(0.05)
    progress.show(last=True)


class Progress:
    """One line that moves on a terminal, a line now and then elsewhere."""

    def __init__(self, total: int, record: Record) -> None:
        self._total = total
        self._record = record
        self._terminal = sys.stdout.isatty()
        self._period = 0.2 if self._terminal else 5.0
        self._next = 0.0

    def show(self, last: bool = False) -> None:
        """Print where things stand, if it is time to."""
        now = time.monotonic()
        if now < self._next and not last:
            return
        self._next = now + self._period
        sent, received = len(self._record.sent), len(self._record.poses)
        bar = '#' * (30 * sent // self._total)
        text = f'  [{bar:<30}] {sent}/{self._total} images sent, {received} poses received'
        if self._terminal:
            print(f'\r{text}', end='\n' if last else '', flush=True)
        else:
            print(text, flush=True)


def _conclude(
    record: Record, truth: Trajectory, line_map: LineMap, output: Path, pictures: list[Path],
) -> int:
    estimated = record.trajectory()
    errors = compare(estimated, truth)
    summary = summarise(errors, frames=len(record.sent), answered=len(estimated))
    print(f'\nframes sent {len(record.sent)}, poses received {len(estimated)}\n')
    print(summary_table(summary))
    latency = 1e3 * record.latencies()
    if len(latency):
        print(table([
            ['latency, image to pose', 'median', '95 %', 'max'],
            ['ms', *(f'{v:.1f}' for v in (*np.percentile(latency, (50, 95)), latency.max()))]]))
        covariance = np.array([record.covariances[s] for s in errors.stamps_ns.tolist()])
        for figure, name in (
            (trajectory_figure(estimated, truth, line_map, 'Estimated over ROS 2 and true'),
             'trajectory.png'),
            (error_figure(errors, covariance, 'Errors against the truth'), 'errors.png'),
        ):
            save_figure(figure, output / name)
            pictures = [*pictures, output / name]
    print('pictures: ' + ', '.join(str(path) for path in pictures))
    # A demonstration that shows nothing has failed.
    return 0 if len(estimated) else 1


def _say(text: str) -> None:
    print(f'demo: {text}', flush=True)


if __name__ == '__main__':
    sys.exit(main())
