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

"""Does the node keep up with its camera? Images at 30 Hz from another process, for a minute.

Prints, for raw and for JPEG images: how many arrived, the latency from an image's publication to
its pose, the node's share of a core, its memory early and at the end, what decoding and
estimation took of it, and how loaded the machine was.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
import itertools
import os
from pathlib import Path
import platform
import subprocess
import sys
import time

import cv2
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from nccs_pose.argument_types import number
from nccs_pose.errors import NccsPoseError
from nccs_pose.evaluation.tables import table
from nccs_pose.files.resources import resolve, share_directory
from nccs_pose.files.yaml_files import load_map, load_rig
from nccs_pose.ros.conversions import compressed_message, image_message, stamp_to_ns
from nccs_pose.ros.start import initialise, StartError, told_to_end
from nccs_pose.ros.transport import stay_alone, use_large_images
from nccs_pose.simulation.drive import make_drive, render_frame
from nccs_pose.simulation.motion import figure_of_eight
from nccs_pose.simulation.scene import arena_scene, Scene
import numpy as np
import rclpy
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import CompressedImage, Image

RIG = 'config/arena_rig.yaml'
MAP = 'config/arena_map.yaml'
DISTINCT_FRAMES = 30
"""Rendered beforehand and played to and fro, so that the robot never jumps."""


WARM_UP = 1.0
"""Seconds of images before the count begins: the first image is searched as a whole."""
PATIENCE = 30.0
"""Seconds until the node must have been heard."""
COUNTS = ('frames_received', 'frames_dropped_busy', 'frames_lost_by_middleware')


@dataclass(frozen=True)
class Result:
    """One stream's numbers.

    :ivar sent: images.
    :ivar counts: COUNTS of the node, of these images.
    :ivar latency: seconds from publication to pose (N,).
    :ivar cpu: of one core.
    :ivar memory_mb: resident, after a fifth of the run and at its end.
    :ivar stages_ms: medians of decoding and of estimating, of the images that were reported.
    :ivar load: the machine's load average at the end, of one minute.
    """

    sent: int
    counts: tuple[int, ...]
    latency: np.ndarray
    cpu: float
    memory_mb: tuple[float, float]
    stages_ms: tuple[float, float]
    load: float


class Listener(Node):
    """Publishes the stream, subscribes the answers."""

    def __init__(self, compressed: bool) -> None:
        super().__init__('stream_benchmark')
        self.compressed = compressed
        kind, name = (CompressedImage, 'image/compressed') if compressed else (Image, 'image')
        self.images = self.create_publisher(kind, name, QoSProfile(depth=2))
        self.sent: dict[int, float] = {}
        self.latency: list[float] = []
        self.stages: list[tuple[float, float]] = []
        self.values: dict[str, str] = {}
        self.create_subscription(
            PoseWithCovarianceStamped, 'pose', self._on_pose, QoSProfile(depth=100))
        self.create_subscription(DiagnosticArray, '/diagnostics', self._on_diagnostics, 10)

    def send(self, frame: np.ndarray | bytes, late: float) -> None:
        """Publish one prepared image, stamped when it was due `late` seconds ago.

        A camera exposes in time, however late its driver comes to publish: stamped later, the
        image would show a robot that moved by fits and starts.
        """
        stamp_ns = self.get_clock().now().nanoseconds - round(1e9 * late)
        message = (compressed_message(stamp_ns, 'camera_optical', frame)
                   if isinstance(frame, bytes)
                   else image_message(stamp_ns, 'camera_optical', frame))
        self.sent[stamp_ns] = time.monotonic()
        self.images.publish(message)

    def forget(self) -> None:
        """Begin to count anew."""
        self.sent, self.latency, self.stages = {}, [], []

    def counts(self) -> tuple[int, ...]:
        """COUNTS as last reported."""
        return tuple(int(self.values.get(name, '0')) for name in COUNTS)

    def _on_pose(self, message: PoseWithCovarianceStamped) -> None:
        sent = self.sent.get(stamp_to_ns(message.header.stamp))
        if sent is not None:
            self.latency.append(time.monotonic() - sent)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            values = {pair.key: pair.value for pair in status.values}
            if status.name == 'localiser: images':
                self.values = values
            elif status.name == 'localiser: time' and 'total_ms' in values:
                self.stages.append((float(values['decode_ms']), float(values['total_ms'])))


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point of `ros2 run nccs_pose stream_benchmark`."""
    parser = argparse.ArgumentParser(prog='stream_benchmark', description=__doc__)
    parser.add_argument('--seconds', type=number(1.0, 86400.0, 's'), default=60.0,
                        help='length (default 60)')
    parser.add_argument('--rate', type=number(0.1, 1000.0, 'Hz'), default=30.0,
                        help='images a second (default 30)')
    parser.add_argument('--formats', nargs='+', choices=('raw', 'jpeg'), default=['raw', 'jpeg'])
    options = parser.parse_args(argv)
    use_large_images()
    stay_alone()
    print(f'{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}; '
          f'rendering {DISTINCT_FRAMES} frames', flush=True)
    rows = [['1280 x 960', 'sent', 'received', 'dropped busy', 'lost', 'poses', 'p50 (ms)',
             'p99 (ms)', 'decode (ms)', 'estimate (ms)', 'CPU (% of a core)', 'memory (MB)',
             'load']]
    whole = True
    try:
        frames = _frames()
        for name in options.formats:
            result = _run(name == 'jpeg', frames, options.seconds, options.rate)
            whole = whole and result.counts[0] == result.sent
            rows.append(_row(name, result))
    except KeyboardInterrupt:
        return 130
    except NccsPoseError as error:
        print(f'stream_benchmark: {error}', file=sys.stderr)
        return 2
    print(table(rows))
    return 0 if whole else 1


def _frames() -> list[np.ndarray]:
    look = arena_scene()
    scene = Scene(
        load_rig(resolve(RIG)), load_map(resolve(MAP)), look.appearance, look.sensor)
    drive = make_drive(figure_of_eight(), DISTINCT_FRAMES, rate=30.0)
    return [render_frame(scene, drive, k).image for k in range(DISTINCT_FRAMES)]


def _run(compressed: bool, frames: list[np.ndarray], seconds: float, rate: float) -> Result:
    prepared: list[np.ndarray] | list[bytes] = frames
    if compressed:
        prepared = [cv2.imencode('.jpg', frame, [cv2.IMWRITE_JPEG_QUALITY, 90])[1].tobytes()
                    for frame in frames]
    initialise([])
    process = _start_localiser(compressed)
    try:
        node = Listener(compressed)
        end = time.monotonic() + PATIENCE
        # Both sides must know of each other: what is sent before is lost.
        while not node.images.get_subscription_count() or node.values.get('publishers') != '1':
            if process.poll() is not None or time.monotonic() > end:
                raise StartError('the localiser does not listen')
            _spin_once(node, 0.1)
        return _measure(node, prepared, process.pid, seconds, rate)
    finally:
        process.terminate()
        process.wait(15.0)
        rclpy.try_shutdown()


def _start_localiser(compressed: bool) -> subprocess.Popen[bytes]:
    parameters = {'rig_file': RIG, 'map_file': MAP,
                  'image_transport': 'compressed' if compressed else 'raw'}
    command = [sys.executable, '-m', 'nccs_pose.ros.localiser', '--ros-args']
    for name, value in parameters.items():
        command += ['-p', f'{name}:={value}']
    return subprocess.Popen(command, cwd=share_directory())


def _measure(
    node: Listener, frames: Sequence[np.ndarray | bytes], pid: int, seconds: float, rate: float,
) -> Result:
    # To and fro: 0 1 2 ... n-1 ... 2 1, again and again.
    order = itertools.cycle([*range(len(frames)), *range(len(frames) - 2, 0, -1)])
    stream = (frames[k] for k in order)
    _play(node, stream, range(round(WARM_UP * rate)), time.monotonic(), rate)
    before = _settle(node, (0,) * len(COUNTS), len(node.sent))
    node.forget()
    count = round(seconds * rate)
    start, cpu = time.monotonic(), _cpu_seconds(pid)
    _play(node, stream, range(count // 5), start, rate)
    early = _memory_mb(pid)
    _play(node, stream, range(count // 5, count), start, rate)
    share = (_cpu_seconds(pid) - cpu) / (time.monotonic() - start)
    late, load = _memory_mb(pid), os.getloadavg()[0]
    after = _settle(node, before, count)
    decode, total = np.median(node.stages, axis=0) if node.stages else (np.nan, np.nan)
    node.destroy_node()
    return Result(
        count, tuple(b - a for a, b in zip(before, after)), np.array(node.latency), share,
        (early, late), (float(decode), float(total)), load)


def _play(
    node: Listener, stream: Iterator[np.ndarray | bytes], numbers: range, start: float,
    rate: float,
) -> None:
    """Send images, each by its number in a schedule that began at `start`."""
    for k in numbers:
        while (left := start + k / rate - time.monotonic()) > 0.0:
            _spin_once(node, left)
        node.send(next(stream), -left)


def _spin_once(node: Listener, timeout: float) -> None:
    rclpy.spin_once(node, timeout_sec=timeout)
    if told_to_end():
        raise KeyboardInterrupt


def _settle(node: Listener, before: tuple[int, ...], count: int) -> tuple[int, ...]:
    """The node's counts once it has accounted for `count` images more, or gives no more news."""
    end = time.monotonic() + 5.0
    while time.monotonic() < end and sum(node.counts()) < sum(before) + count:
        _spin_once(node, 0.1)
    return node.counts()


def _row(name: str, result: Result) -> list[str]:
    p50, p99 = (1e3 * np.percentile(result.latency, (50, 99)) if len(result.latency)
                else (float('nan'), float('nan')))
    return [name, str(result.sent), *(str(n) for n in result.counts),
            str(len(result.latency)), f'{p50:.1f}', f'{p99:.1f}',
            *(f'{ms:.1f}' for ms in result.stages_ms), f'{100.0 * result.cpu:.0f}',
            f'{result.memory_mb[0]:.0f} -> {result.memory_mb[1]:.0f}', f'{result.load:.1f}']


def _cpu_seconds(pid: int) -> float:
    fields = Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf('SC_CLK_TCK')


def _memory_mb(pid: int) -> float:
    pages = int(Path(f'/proc/{pid}/statm').read_text().split()[1])
    return pages * os.sysconf('SC_PAGE_SIZE') / 1e6


if __name__ == '__main__':
    sys.exit(main())
