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

"""A recorded robot, played over DDS: the player by itself, and the node against the truth."""

from __future__ import annotations

import os
import signal
import subprocess
import sys

import pytest

pytest.importorskip('rclpy', reason='ROS 2 is not available: no rclpy')

from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from harness import REPOSITORY
from nccs_pose.evaluation.metrics import compare, summarise
from nccs_pose.evaluation.trajectory import Trajectory
from nccs_pose.files.bags import BagReader
from nccs_pose.files.serialised_bag import SerialisedBag
from nccs_pose.ros.conversions import pose_to_planar, stamp_to_ns
import numpy as np
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo

BAG = 'bags/room'
IMAGE = '/camera/image_raw/compressed'


def test_bag_is_localised_over_dds(world, repository):
    user = world.user
    node = world.localiser(
        '--params-file', 'config/room.yaml', '-r', f'image/compressed:={IMAGE}',
        '-r', 'camera_info:=/camera/camera_info', use_sim_time=True)
    poses = user.listen(PoseWithCovarianceStamped, 'pose')
    user.meet(node)
    player = world.start('player', BAG, '--rate', '4', '--clock', '--wait-for', IMAGE)
    assert user.wait(lambda: not player.running(), 60.0)
    assert player.wait() == 0, player.output
    with BagReader(repository / BAG) as bag:
        truth, frames = bag.ground_truth(), bag.image_count()
    # Every frame is accounted for; a loaded machine may let some go.
    assert user.wait(lambda: user.frames() == frames), user.statuses['localiser: images']
    assert user.wait(lambda: len(poses) == user.count('frames_answered'))
    estimated = Trajectory(
        np.array([stamp_to_ns(p.header.stamp) for p in poses], dtype=np.int64),
        np.array([pose_to_planar(p.pose.pose, 'pose').as_array() for p in poses]))
    errors = compare(estimated, truth)
    good = (errors.translation < 0.05) & (errors.yaw < np.radians(1.0))
    received = user.count('frames_received')
    assert received >= frames // 3
    assert np.count_nonzero(good) >= 0.9 * received, summarise(
        errors, frames=received, answered=len(poses))
    # The clock is the bag's.
    assert abs(float(user.value('localiser: pose', 'age_s'))) < 5.0
    assert 'tf2_msgs/msg/TFMessage is not installed' in player.output or 'tf_static' in (
        player.output)
    assert node.stop() == 0, node.output


def test_player_keeps_bytes_order_and_timing(world, repository):
    user = world.user
    truths = user.listen(PoseStamped, '/ground_truth/pose')
    infos: list[tuple[int, bytes]] = []
    clocks = user.listen(Clock, '/clock')
    user.node.create_subscription(
        CameraInfo, '/camera/camera_info',
        lambda m, info: infos.append((info['source_timestamp'], m)), 100, raw=True)
    player = world.start(
        'player', BAG, '--rate', '4', '--start-offset', '20.2', '--clock', '--topics',
        '/camera/camera_info', '/ground_truth/pose', '--wait-for', '/camera/camera_info',
        '/ground_truth/pose')
    assert user.wait(lambda: not player.running()), player.output
    with SerialisedBag(repository / BAG) as bag:
        recorded = [
            (received, data) for topic, received, data in bag.messages(
                ['/camera/camera_info'], bag.start_ns + 20_200_000_000)]
        begin, end = bag.start_ns + 20_200_000_000, bag.end_ns
    # The middleware may pad a message at its end.
    assert user.wait(lambda: len(infos) == len(recorded))
    for (_, played), (_, data) in zip(infos, recorded):
        assert played[:len(data)] == data
        assert len(played) - len(data) < 4
    assert len(truths) > 200
    # Four times as fast, to within what a loaded machine does to the first and last message.
    lasted = 1e-9 * (infos[-1][0] - infos[0][0])
    original = 1e-9 * (recorded[-1][0] - recorded[0][0])
    assert original / 4.0 - 1.0 < lasted < original
    assert user.wait(lambda: stamp_to_ns(clocks[-1].clock) == end), clocks[-1]
    stamps = [stamp_to_ns(c.clock) for c in clocks]
    assert stamps == sorted(stamps)
    assert begin - 10**9 < stamps[0]


def test_player_loops_until_it_is_stopped(world):
    user = world.user
    clocks = user.listen(Clock, '/clock')
    player = world.start('player', BAG, '--loop', '--clock', '--start-offset', '29', '--rate', '3')

    def jumps() -> int:
        stamps = np.array([stamp_to_ns(c.clock) for c in clocks], dtype=np.int64)
        return int(np.count_nonzero(np.diff(stamps) < -10**9))

    assert user.wait(lambda: jumps() >= 2), player.output
    # Terminal and launch file send one each; and somebody may be impatient.
    assert player.stop(signal.SIGINT, times=8) == 0, player.output
    assert 'Traceback' not in player.output


@pytest.mark.parametrize('where', ['| true', '> /dev/full', '2>&1 >&- | cat'])
def test_player_needs_nobody_to_read_what_it_says(world, where):
    play = f'{sys.executable} -m nccs_pose.ros.player {BAG} --rate 100 --topics /odom'
    run = subprocess.run(
        ['bash', '-o', 'pipefail', '-c', f'{play} {where}'], capture_output=True, text=True,
        cwd=REPOSITORY, env={**os.environ, 'ROS_DOMAIN_ID': str(world.user.domain)})
    assert run.returncode == 0, run.stderr
    assert 'Traceback' not in run.stdout + run.stderr


@pytest.mark.parametrize(('arguments', 'words'), [
    (['no/such/bag'], 'no/such/bag: no such bag'),
    ([BAG, '--topics', '/nothing'], 'has no topic /nothing'),
    ([BAG, '--rate', '-1'], "'-1' is no number from 0.001 to 1000"),
    ([BAG, '--ros-args', '-r', 'bad'], 'cannot start: Failed to parse ROS arguments'),
    ([BAG, '--ros-args', '-r', '/odom:=/camera/camera_info'], 'cannot be published: '),
    ([BAG, '--loop', '--start-offset', '1e9'], 'leaves nothing to play, the bag lasts 30.5 s'),
    ([BAG, '--wait-for', '/tf_statics'], '/tf_statics'),
])
def test_player_says_what_it_cannot_play(world, arguments, words):
    player = world.start('player', *arguments)
    assert player.wait() == 2
    assert words in player.output
    assert 'Traceback' not in player.output


@pytest.mark.parametrize(('arguments', 'words'), [
    (['--rate', '0'], 'must be greater than 0'),
    (['--map', 'no/map.yaml'], 'no/map.yaml: cannot be read'),
    (['--output', '/proc/nowhere'], '/proc/nowhere/trajectory.png: cannot be written'),
])
def test_the_demo_says_what_it_cannot_do_before_it_drives(world, arguments, words):
    demo = world.start('demo', *arguments)
    assert demo.wait() == 2
    assert words in demo.output
    assert 'playing' not in demo.output
    assert 'Traceback' not in demo.output
