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

"""The node on live streams: stand-in camera, two robots at once, too many frames."""

from __future__ import annotations

import signal
import time

import pytest

pytest.importorskip('rclpy', reason='ROS 2 is not available: no rclpy')

from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from nccs_pose.ros.conversions import decode, image_message, stamp_to_ns
import numpy as np
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CameraInfo, Image
from std_srvs.srv import Trigger
from visualization_msgs.msg import MarkerArray

ARENA = {'rig_file': 'config/arena_640_rig.yaml', 'map_file': 'config/arena_map.yaml'}


def planar(pose) -> np.ndarray:
    """x, y and yaw of a geometry_msgs/Pose."""
    q = pose.orientation
    yaw = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_euler('ZYX')[0]
    return np.array([pose.position.x, pose.position.y, yaw])


def error(pose, truth: np.ndarray) -> tuple[float, float]:
    """Translation (m) and yaw (rad) error of a geometry_msgs/Pose."""
    dx, dy, dyaw = planar(pose) - truth
    return float(np.hypot(dx, dy)), abs(float(np.angle(np.exp(1j * dyaw))))


@pytest.mark.parametrize('transport', ['raw', 'compressed'])
def test_stand_in_camera_is_localised_live(world, transport):
    user = world.user
    node = world.localiser(image_transport=transport, **ARENA)
    camera = world.start(
        'stand_in_camera', '--ros-args', '-p', f'image_transport:={transport}', '-p', 'rate:=4.0',
        '-p', 'duration:=120.0')
    poses = user.listen(PoseWithCovarianceStamped, 'pose')
    truths = user.listen(PoseStamped, 'ground_truth/pose')
    infos = user.listen(CameraInfo, 'camera_info')
    debug = user.listen(Image, 'localiser/debug_image')
    markers = user.listen(MarkerArray, 'localiser/markers')

    def compared() -> list[PoseWithCovarianceStamped]:
        stamps = {stamp_to_ns(t.header.stamp) for t in truths}
        return [p for p in poses if stamp_to_ns(p.header.stamp) in stamps]

    # A loaded machine renders a frame a second.
    assert user.wait(lambda: len(compared()) >= 4 and debug and markers, 90.0), (
        node.output + camera.output)
    truth = {stamp_to_ns(t.header.stamp): planar(t.pose) for t in truths}
    for pose in compared():
        translation, yaw = error(pose.pose.pose, truth[stamp_to_ns(pose.header.stamp)])
        assert translation < 0.05
        assert yaw < np.radians(1.0)
        assert pose.header.frame_id == 'map'
        assert np.linalg.eigvalsh(pose.pose.covariance.reshape(6, 6))[0] > 0.0
    assert infos[0].header.frame_id == 'camera_optical'
    assert decode(debug[-1]).shape[1:] == (640, 3)
    assert debug[-1].height > 480  # words below the image
    assert {m.header.frame_id for m in markers[-1].markers} == {'map'}
    assert user.value('localiser: pose', 'state') == 'tracking'
    assert user.count('refused') == user.count('errors') == 0
    how, times = (signal.SIGTERM, 1) if transport == 'raw' else (signal.SIGINT, 8)
    assert camera.stop(how, times) == 0, camera.output
    assert node.stop(signal.SIGINT, times) == 0, node.output


def test_two_robots_in_one_domain_do_not_disturb_each_other(world, arena):
    user = world.user
    # Robot b is always half the drive ahead.
    robots, half = ('a', 'b'), len(arena) // 2
    for robot in robots:
        world.localiser('-r', f'__ns:=/{robot}', frame_prefix=f'{robot}/', **ARENA)
    poses = {r: user.listen(PoseWithCovarianceStamped, f'/{r}/pose') for r in robots}
    images = {r: user.publisher(Image, f'/{r}/image', f'{r}/localiser') for r in robots}
    truth: dict[str, dict[int, np.ndarray]] = {robot: {} for robot in robots}
    for k in range(half):
        for robot, sample in zip(robots, (arena[k], arena[half + k])):
            stamp_ns = arena[k].stamp_ns  # the same for both
            truth[robot][stamp_ns] = sample.pose.as_array()
            images[robot].publish(image_message(stamp_ns, f'{robot}/camera', sample.image))
        assert user.wait(lambda n=k + 1: all(user.frames(f'{r}/localiser') == n for r in robots))
    for robot in robots:
        node = f'{robot}/localiser'
        assert user.wait(lambda n=node: user.value(f'{n}: pose', 'state') == 'tracking')
        answered = user.count('frames_answered', node)
        assert answered >= half - 2
        assert user.wait(lambda r=robot, n=answered: len(poses[r]) == n)
        for pose in poses[robot]:
            translation, _ = error(pose.pose.pose, truth[robot][stamp_to_ns(pose.header.stamp)])
            assert translation < 0.05
        assert user.count('refused', node) == user.count('errors', node) == 0


def test_more_frames_than_it_can_use_are_let_go_and_the_newest_is_answered(world, arena):
    node, user = world.localiser(**ARENA), world.user
    poses = user.listen(PoseWithCovarianceStamped, 'pose')
    images = user.publisher(Image, 'image')
    first = arena[0]
    user.show(images, image_message(first.stamp_ns, 'camera', first.image))
    assert user.wait(lambda: poses), node.output
    # A burst as fast as DDS takes it. The robot stands still: whichever images are let go, the
    # last one shows no jump that another would have to confirm.
    sent = 81
    for k in range(1, sent):
        message = image_message(first.stamp_ns + 20_000_000 * k, 'camera', first.image)
        images.publish(message)
        time.sleep(0.001)
    last = stamp_to_ns(message.header.stamp)
    assert user.wait(lambda: stamp_to_ns(poses[-1].header.stamp) == last), node.output
    assert user.wait(lambda: user.frames() == sent), (sent, user.statuses['localiser: images'])
    assert user.count('frames_dropped_busy') > 0
    stamps = [stamp_to_ns(p.header.stamp) for p in poses]
    assert stamps == sorted(set(stamps))


def test_a_jump_of_the_stamps_and_relocalise_start_the_search_anew(world, arena):
    node, user = world.localiser(**ARENA), world.user
    poses = user.listen(PoseWithCovarianceStamped, 'pose')
    images = user.publisher(Image, 'image')
    # The bag is played twice; half a minute lies between.
    for lap in (30_000_000_000, 0):
        user.show(images, *(
            image_message(s.stamp_ns + lap, 'camera', s.image) for s in arena))
    assert user.wait(lambda: poses and stamp_to_ns(
        poses[-1].header.stamp) == arena[-1].stamp_ns), node.output
    second = {stamp_to_ns(p.header.stamp) for p in poses} & {s.stamp_ns for s in arena}
    assert len(second) >= len(arena) - 2
    assert user.wait(lambda: user.count('clock_resets') == 1), node.output
    assert node.output.count('jumped back by') == 1
    searched = 'searching the whole image'
    assert searched not in user.value('localiser: pose', 'reason')
    answer = user.call(Trigger, '/localiser/relocalise', Trigger.Request())
    assert answer.success, answer.message
    # What the last image said is no news of a robot that is looked for.
    assert user.wait(lambda: user.value('localiser: pose', 'state') == 'searching'), node.output
    assert user.value('localiser: pose', 'reason') == 'no image yet'
    images.publish(image_message(arena[-1].stamp_ns + 10**8, 'camera', arena[-1].image))
    assert user.wait(lambda: searched in user.value('localiser: pose', 'reason')), node.output
    assert user.value('localiser: calibration', 'condition') == 'unknown'
    assert user.count('refused') == user.count('errors') == 0


@pytest.mark.parametrize('arguments', [
    ('--seconds', 'nan'), ('--seconds', '-1'), ('--rate', '0'), ('--rate', 'inf')])
def test_the_benchmark_names_a_number_out_of_its_range(arguments, capsys):
    from nccs_pose.ros.stream_benchmark import main

    with pytest.raises(SystemExit) as stop:
        main(arguments)
    assert stop.value.code == 2
    assert f'argument {arguments[0]}: {arguments[1]!r} is no number from' in (
        capsys.readouterr().err)
