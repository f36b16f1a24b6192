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

"""A robot in trouble, and what its node says: each robot is a node of its own in one world."""

from __future__ import annotations

from dataclasses import replace
import itertools
from pathlib import Path
import re
from typing import Any

import pytest

pytest.importorskip('rclpy', reason='ROS 2 is not available: no rclpy')

from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseWithCovarianceStamped
from harness import Process, REPOSITORY
from nav_msgs.msg import Odometry
from nccs_pose.files.bag_writer import BagWriter
from nccs_pose.files.saved_pose import read_saved_pose
from nccs_pose.files.yaml_files import load_map, load_rig, save_map, save_rig
from nccs_pose.geometry.lines import LineMap
from nccs_pose.geometry.pose import Pose2
from nccs_pose.ros.conversions import (
    image_message,
    odometry_message,
    pose_message,
    pose_to_planar,
    stamp_to_ns,
)
from nccs_pose.simulation.drive import make_drive, render_frame
from nccs_pose.simulation.motion import figure_of_eight
from nccs_pose.simulation.scene import ideal_scene, Scene
import numpy as np
from sensor_msgs.msg import Image

RIG, MAP = 'config/arena_640_rig.yaml', 'config/arena_map.yaml'
STEP_NS = 500_000_000
AWAY = np.array([10.0, 0.0, 0.0])
"""Where the second of two equal rooms is."""


class Robot:
    """One of several robots: its node's name, its camera and wheels, what its node answers."""

    def __init__(self, user: Any, name: str, process: Process, file: Path) -> None:
        self.user, self.node, self.process, self.file = user, f'{name}/localiser', process, file
        user.meet(process, self.node)
        self.poses = user.listen(PoseWithCovarianceStamped, f'/{name}/pose')
        self.images = user.publisher(Image, f'/{name}/image', self.node)
        self.wheels = user.publisher(Odometry, f'/{name}/odom', self.node)
        self._stamps = itertools.count(10**12, STEP_NS)

    def see(self, image: np.ndarray, wheels: Pose2 | None = None) -> int:
        """Show it an image, after where its wheels say that it is; the stamp."""
        stamp_ns = next(self._stamps)
        if wheels is not None:
            self.wheels.publish(odometry_message(
                stamp_ns, 'odom', 'base_link', wheels, 0.0, 0.0))
        self.user.show(
            self.images, image_message(stamp_ns, 'camera', image), node=self.node)
        return stamp_ns

    def answer(self, stamp_ns: int) -> np.ndarray | None:
        """The pose that it gave for an image; None if it gave none."""
        given = self.user.count('frames_answered', self.node)
        assert self.user.wait(lambda: len(self.poses) >= given)
        for pose in self.poses:
            if stamp_to_ns(pose.header.stamp) == stamp_ns:
                return pose_to_planar(pose.pose.pose, 'pose').as_array()
        return None

    def value(self, key: str) -> str:
        return self.user.value(f'{self.node}: pose', key)

    def count(self, key: str) -> int:
        return self.user.count(key, self.node)


@pytest.fixture(scope='module')
def drive() -> Any:
    """Frames of a drive through the arena, 0.17 m apart."""
    look = ideal_scene(640, noise=0.01)
    scene = Scene(load_rig(REPOSITORY / RIG), load_map(REPOSITORY / MAP), look.appearance,
                  look.sensor)
    drive = make_drive(figure_of_eight(), 18, rate=1e9 / STEP_NS)
    return [render_frame(scene, drive, k) for k in range(len(drive))]


@pytest.fixture(scope='module')
def robots(shared_world: Any) -> dict[str, Robot]:
    """Three robots: one that is carried, one that knows two equal rooms, one that was knocked."""
    folder, user = shared_world.folder, shared_world.user
    lines = tuple(load_map(REPOSITORY / MAP))
    rooms = folder / 'rooms.yaml'
    save_map(LineMap((*lines, *(
        replace(line, start=line.start + AWAY, end=line.end + AWAY, name=f'other {line.name}')
        for line in lines))), rooms)
    saved = folder / 'kept' / 'pose.json'
    knocked, rig = folder / 'knocked.yaml', load_rig(REPOSITORY / RIG)
    save_rig(replace(rig, cop=rig.cop - np.array([0.0, 2e-4, 0.0])), knocked)
    arena = {'rig_file': RIG, 'map_file': MAP}
    parameters = {
        'carried': {**arena, 'saved_pose_file': saved,
                    'saved_pose_interval': 0.2},
        'rooms': {**arena, 'map_file': rooms},
        'knocked': {**arena, 'rig_file': knocked}}
    nodes = {name: shared_world.localiser('-r', f'__ns:=/{name}', **values)
             for name, values in parameters.items()}
    return {name: Robot(user, name, node, saved) for name, node in nodes.items()}


def assert_right(answer: np.ndarray | None, truth: Pose2) -> None:
    assert answer is not None
    dx, dy, dyaw = answer - truth.as_array()
    assert np.hypot(dx, dy) < 0.02
    assert abs(np.angle(np.exp(1j * dyaw))) < np.radians(0.5)


def test_a_robot_that_was_carried_away_is_found_at_the_second_image(robots, drive):
    robot = robots['carried']
    for sample in drive[:4]:
        assert_right(robot.answer(robot.see(sample.image)), sample.pose)
    assert robot.answer(robot.see(drive[14].image)) is None
    assert 'the image shows another place' in robot.value('reason')
    assert_right(robot.answer(robot.see(drive[15].image)), drive[15].pose)
    assert robot.value('state') == 'tracking'


def test_an_image_that_says_nothing_is_bridged_by_the_wheels_and_not_for_long(robots, drive):
    robot, truth = robots['carried'], [sample.pose for sample in drive]
    for k in range(2, 5):  # carried back, and believed at the second image
        robot.see(drive[k].image, truth[k])
    assert robot.value('state') == 'tracking'
    variance = robot.poses[-1].pose.covariance[0]
    black = np.zeros_like(drive[0].image)
    assert_right(robot.answer(robot.see(black, truth[5])), truth[5])
    assert robot.value('state') == 'coasting'
    assert robot.poses[-1].pose.covariance[0] > variance
    # The same black again is no image of a robot that moves.
    assert robot.answer(robot.see(black, truth[6])) is None
    assert robot.count('refused.frozen_image') == 1
    for k in range(7, 14):
        last = robot.see(np.full_like(black, k), truth[k])
    assert robot.answer(last) is None
    assert robot.value('state') == 'lost'
    assert 'no line-like strip' in robot.value('reason')


def test_the_pose_is_saved_while_driving_and_the_file_is_always_whole(robots, drive):
    robot, path = robots['carried'], robots['carried'].file
    stamps = [robot.see(sample.image) for sample in drive[:3]]
    assert robot.user.wait(lambda: path.exists() and read_saved_pose(path).stamp_ns in stamps)
    with path.open() as before:
        text = before.read()
        stamps += [robot.see(sample.image) for sample in drive[3:6]]
        assert robot.user.wait(lambda: read_saved_pose(path).stamp_ns == stamps[-1])
        # Replaced, not written over: whoever has opened the file still reads what it was.
        before.seek(0)
        assert before.read() == text
    # The message holds a quaternion: its rounding is all that they may differ by.
    np.testing.assert_allclose(
        read_saved_pose(path).pose.as_array(), robot.answer(stamps[-1]), rtol=0.0, atol=1e-15)
    assert [file.name for file in path.parent.iterdir()] == [path.name]


def test_two_equal_rooms_are_said_and_an_initial_pose_decides(robots, drive):
    robot, user, pose = robots['rooms'], robots['rooms'].user, drive[0].pose
    assert robot.answer(robot.see(drive[0].image)) is None
    assert robot.value('state') == 'ambiguous'
    assert '2 poses explain the image' in robot.value('reason')
    said = [tuple(map(float, pair)) for pair in re.findall(
        r'\((\S+) m, (\S+) m', robot.value('candidates'))]
    here = (pose.x, pose.y), (pose.x + AWAY[0], pose.y)
    np.testing.assert_allclose(sorted(said), here, atol=0.02)
    # One of them is told, roughly.
    other = Pose2(pose.x + AWAY[0] + 0.3, pose.y - 0.2, pose.yaw + 0.1)
    prior = user.publisher(PoseWithCovarianceStamped, '/rooms/initialpose', robot.node)
    prior.publish(pose_message(1, 'map', other, np.diag([0.25, 0.25, 0.07])))
    assert user.wait(lambda: 'prior: ' in robot.process.output)
    truth = Pose2(drive[1].pose.x + AWAY[0], drive[1].pose.y, drive[1].pose.yaw)
    assert_right(robot.answer(robot.see(drive[1].image)), truth)


def test_a_rig_that_is_not_as_told_is_suspected_and_gives_no_wrong_pose(robots, drive):
    robot = robots['knocked']
    for sample in drive:
        answer = robot.answer(robot.see(sample.image))
        if answer is not None:
            assert_right(answer, sample.pose)
    status = robot.user.statuses['knocked/localiser: calibration']
    assert status.level == DiagnosticStatus.WARN
    assert 'the mirror moved by about 0.2' in status.message


def test_images_that_the_middleware_loses_are_counted_and_the_cure_is_named(robots, shared_world):
    robot, folder = robots['carried'], shared_world.folder
    plain = folder / 'profiles.xml'
    plain.write_text('<profiles xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles"/>')
    with BagWriter(folder / 'bag') as bag:
        for k in range(6):
            bag.write_image(10**12 + k * 10**8, np.zeros((960, 1280, 3), np.uint8),
                            topic='/carried/image')
    # A camera of four times the pixels comes instead, and Fast DDS as it is by default.
    robot.user.node.destroy_publisher(robot.images)
    camera = shared_world.start(
        'player', str(folder / 'bag'), '--loop', '--wait-for', '/carried/image',
        FASTRTPS_DEFAULT_PROFILES_FILE=str(plain))
    assert robot.user.wait(lambda: [s for s in robot.user.history if (
        'fastdds_large_images.xml' in s.message and s.level == DiagnosticStatus.WARN)]), (
            camera.output)
    assert robot.count('frames_lost_by_middleware') > 0
