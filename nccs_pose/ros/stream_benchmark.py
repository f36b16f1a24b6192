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
its pose, the node's share of a CPU and its memory at the start and the end.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
import os
from pathlib import Path
import platform
import subprocess
import sys
import time

import cv2
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from nccs_pose.evaluation.tables import table
from nccs_pose.files.yaml_files import load_map, load_rig
from nccs_pose.ros.conversions import compressed_message, image_message, stamp_to_ns
from nccs_pose.ros.resources import resolve, share_directory
from nccs_pose.ros.transport import use_large_images
from nccs_pose.simulation.drive import make_drive, render_frame
from nccs_pose.simulation.motion import figure_of_eight
from nccs_pose.simulation.scene import arena_scene, Scene
import numpy as np
import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data, QoSProfile
from sensor_msgs.msg import CompressedImage, Image

RIG = 'config/arena_rig.yaml'
MAP = 'config/arena_map.yaml'
DISTINCT_FRAMES = 30
"""Rendered beforehand and played to and fro, so that the robot never jumps."""


@dataclass(frozen=True)
class Result:
    """One stream's numbers.

    :ivar sent: images.
    :ivar received: of them, those that reached the node's callback.
    :ivar latency: seconds from publication to pose (N,).
    :ivar cpu: of one core.
    :ivar memory_mb: resident, after a fifth of the run and at its end.
    """

    sent: int
    received: int
    busy: int
    lost: int
    latency: np.ndarray
    cpu: float
    memory_mb: tuple[float, float]


class Listener(Node):
    """Publishes the stream, subscribes the answers."""

    def __init__(self, compressed: bool) -> None:
        super().__init__('stream_benchmark')
        self.compressed = compressed
        kind, name = (CompressedImage, 'image/compressed') if compressed else (Image, 'image')
        self.images = self.create_publisher(kind, name, QoSProfile(depth=2))
        self.sent: dict[int, float] = {}
        self.latency: list[float] = []
        self.counts: dict[str, str] = {}
        self.create_subscription(
            PoseWithCovarianceStamped, 'pose', self._on_pose, qos_profile_sensor_data)
        self.create_subscription(DiagnosticArray, '/diagnostics', self._on_diagnostics, 10)

    def send(self, frame: np.ndarray | bytes) -> None:
        """Publish one prepared image, stamped now."""
        stamp_ns = self.get_clock().now().nanoseconds
        message = (compressed_message(stamp_ns, 'camera_optical', frame)
                   if isinstance(frame, bytes)
                   else image_message(stamp_ns, 'camera_optical', frame))
        self.sent[stamp_ns] = time.monotonic()
        self.images.publish(message)

    def _on_pose(self, message: PoseWithCovarianceStamped) -> None:
        sent = self.sent.get(stamp_to_ns(message.header.stamp))
        if sent is not None:
            self.latency.append(time.monotonic() - sent)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name == 'localiser: images':
                self.counts = {pair.key: pair.value for pair in status.values}


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point of `ros2 run nccs_pose stream_benchmark`."""
    parser = argparse.ArgumentParser(prog='stream_benchmark', description=__doc__)
    parser.add_argument('--seconds', type=float, default=60.0, help='length (default 60)')
    parser.add_argument('--rate', type=float, default=30.0, help='images a second (default 30)')
    parser.add_argument('--formats', nargs='+', choices=('raw', 'jpeg'), default=['raw', 'jpeg'])
    options = parser.parse_args(argv)
    use_large_images()
    # Alone on its domain: another robot's images would be counted too.
    os.environ.setdefault('ROS_DOMAIN_ID', str(1 + os.getpid() % 99))
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    print(f'{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}; '
          f'rendering {DISTINCT_FRAMES} frames', flush=True)
    frames = _frames()
    rows = [['1280 x 960', 'sent', 'received', 'dropped busy', 'lost', 'poses', 'p50 (ms)',
             'p99 (ms)', 'CPU (% of a core)', 'memory (MB)']]
    whole = True
    try:
        for name in options.formats:
            result = _run(name == 'jpeg', frames, options.seconds, options.rate)
            whole = whole and result.received == result.sent
            rows.append(_row(name, result))
    except (KeyboardInterrupt, ExternalShutdownException):
        return 130
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
    rclpy.init(args=[])
    process = _start_localiser(compressed)
    try:
        node = Listener(compressed)
        while not node.images.get_subscription_count():
            if process.poll() is not None:
                raise RuntimeError('the localiser ended before it listened')
            rclpy.spin_once(node, timeout_sec=0.1)
        return _stream(node, prepared, process.pid, seconds, rate)
    finally:
        process.terminate()
        process.wait(15.0)
        rclpy.try_shutdown()


def _start_localiser(compressed: bool) -> subprocess.Popen[bytes]:
    parameters = {'rig_file': RIG, 'map_file': MAP,
                  'image_transport': 'compressed' if compressed else 'raw'}
    command = [sys.executable, '-m', 'nccs_pose.ros.localiser_node', '--ros-args']
    for name, value in parameters.items():
        command += ['-p', f'{name}:={value}']
    return subprocess.Popen(command, cwd=share_directory())


def _stream(
    node: Listener, frames: Sequence[np.ndarray | bytes], pid: int, seconds: float, rate: float,
) -> Result:
    count = round(seconds * rate)
    # To and fro: 0 1 2 ... n-1 ... 2 1, again and again.
    order = [*range(len(frames)), *range(len(frames) - 2, 0, -1)]
    start, cpu = time.monotonic(), _cpu_seconds(pid)
    early = 0.0
    for k in range(count):
        while (left := start + k / rate - time.monotonic()) > 0.0:
            rclpy.spin_once(node, timeout_sec=left)
        node.send(frames[order[k % len(order)]])
        if k == count // 5:
            early = _memory_mb(pid)
    elapsed = time.monotonic() - start
    share, late = (_cpu_seconds(pid) - cpu) / elapsed, _memory_mb(pid)
    end = time.monotonic() + 3.0  # the last answers, and one more report
    while time.monotonic() < end:
        rclpy.spin_once(node, timeout_sec=0.1)
    counts = {key: int(node.counts.get(key, '0')) for key in (
        'frames_received', 'frames_dropped_busy', 'frames_lost_by_middleware')}
    node.destroy_node()
    return Result(
        count, *counts.values(), np.array(node.latency), share, (early, late))


def _row(name: str, result: Result) -> list[str]:
    p50, p99 = (1e3 * np.percentile(result.latency, (50, 99)) if len(result.latency)
                else (float('nan'), float('nan')))
    return [name, str(result.sent), str(result.received), str(result.busy), str(result.lost),
            str(len(result.latency)), f'{p50:.1f}', f'{p99:.1f}', f'{100.0 * result.cpu:.0f}',
            f'{result.memory_mb[0]:.0f} -> {result.memory_mb[1]:.0f}']


def _cpu_seconds(pid: int) -> float:
    fields = Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf('SC_CLK_TCK')


def _memory_mb(pid: int) -> float:
    pages = int(Path(f'/proc/{pid}/statm').read_text().split()[1])
    return pages * os.sysconf('SC_PAGE_SIZE') / 1e6


if __name__ == '__main__':
    sys.exit(main())
