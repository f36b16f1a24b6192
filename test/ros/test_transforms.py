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

"""The TF contract, with a tf2_ros that remembers what it is given (the wheels have none)."""

from __future__ import annotations

import sys
import types

import pytest

pytest.importorskip('rclpy', reason='ROS 2 is not available: no rclpy')

from geometry_msgs.msg import TransformStamped
from nccs_pose.errors import OptionError
from nccs_pose.geometry.pose import Pose2
from nccs_pose.node_options import NodeOptions
from nccs_pose.ros.conversions import ns_to_stamp, yaw_quaternion
from nccs_pose.ros.transforms import TransformOutput
import numpy as np
from rclpy.time import Time
from scipy.spatial.transform import Rotation

STAMP = 1_700_000_000_123_456_789


class TransformError(Exception):
    """What a lookup raises."""


class Waiting:
    """A subscription with messages whose callback has not run yet."""

    msg_type, raw = None, False

    def __init__(self) -> None:
        self.messages: list[object] = []
        self.handle = self

    def __enter__(self) -> None:
        """As a handle is held."""

    def __exit__(self, *error: object) -> None:
        """And let go."""

    def take_message(self, kind: object, raw: bool) -> tuple[object, dict] | None:
        return (self.messages.pop(0), {}) if self.messages else None


class Tf2:
    """A transform tree of odom -> base_link, and what was broadcast."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.known: dict[tuple[str, str, int], TransformStamped] = {}
        self.sent: list[TransformStamped] = []
        self.gone: list[str] = []
        self.arrived = Waiting()
        module = types.ModuleType('tf2_ros')
        module.TransformException = TransformError
        module.Buffer = lambda node: types.SimpleNamespace(
            lookup_transform=self.lookup, clear=self.known.clear, srv='service tf2_frames')
        module.TransformListener = lambda buffer, node: types.SimpleNamespace(
            unregister=lambda: self.gone.append('listener'), tf_sub=self.arrived,
            callback=lambda item: self.add(*item))
        module.TransformBroadcaster = lambda node: types.SimpleNamespace(
            sendTransform=self.sent.append, pub_tf='publisher of /tf')
        monkeypatch.setitem(sys.modules, 'tf2_ros', module)

    def lookup(self, target: str, source: str, time: Time) -> TransformStamped:
        """Transform that maps coordinates in source to coordinates in target."""
        try:
            return self.known[target, source, time.nanoseconds]
        except KeyError as error:
            raise TransformError(f'no {target} <- {source}') from error

    def add(self, parent: str, child: str, stamp_ns: int, pose: Pose2) -> None:
        """Let somebody have broadcast parent -> child."""
        message = TransformStamped()
        message.transform.translation.x, message.transform.translation.y = pose.x, pose.y
        message.transform.rotation = yaw_quaternion(pose.yaw)
        self.known[parent, child, stamp_ns] = message


@pytest.fixture
def tf2(monkeypatch: pytest.MonkeyPatch) -> Tf2:
    return Tf2(monkeypatch)


def matrix(message: TransformStamped) -> np.ndarray:
    """Homogeneous matrix of a transform."""
    result, t, q = np.eye(4), message.transform.translation, message.transform.rotation
    result[:3, :3] = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
    result[:3, 3] = t.x, t.y, t.z
    return result


def planar_matrix(x: float, y: float, yaw: float) -> np.ndarray:
    result = np.eye(4)
    result[:3, :3] = Rotation.from_euler('z', yaw).as_matrix()
    result[:2, 3] = x, y
    return result


def output(**options: object) -> tuple[TransformOutput, list[str]]:
    refusals: list[str] = []
    return TransformOutput(
        None, lambda: NodeOptions(**options),
        lambda cause, words: refusals.append(cause)), refusals


def test_map_to_odom_makes_map_to_base_the_estimate(tf2: Tf2):
    out, _ = output(tf_mode='map_to_odom', frame_prefix='robot1/')
    tf2.add('robot1/odom', 'robot1/base_link', STAMP, Pose2(3.0, -1.0, 0.7))
    out.broadcast(STAMP, Pose2(0.2, 0.4, -2.9))
    (sent,) = tf2.sent
    assert (sent.header.frame_id, sent.child_frame_id) == ('map', 'robot1/odom')
    assert sent.header.stamp == ns_to_stamp(STAMP)
    np.testing.assert_allclose(
        matrix(sent) @ planar_matrix(3.0, -1.0, 0.7), planar_matrix(0.2, 0.4, -2.9), atol=1e-12)


def test_late_odometry_is_waited_for_and_missing_odometry_is_counted(tf2: Tf2):
    out, refusals = output(tf_mode='map_to_odom')
    out.broadcast(STAMP, Pose2(1.0, 2.0, 0.5))
    out.retry(STAMP + 50_000_000)
    assert tf2.sent == []
    tf2.add('odom', 'base_link', STAMP, Pose2(0.1, 0.0, 0.0))
    out.retry(STAMP + 60_000_000)
    assert len(tf2.sent) == 1
    out.broadcast(STAMP + 1, Pose2(1.0, 2.0, 0.5))
    out.retry(STAMP + 2_000_000_000)
    assert len(tf2.sent) == 1
    assert refusals == ['tf_missing']


def test_no_estimate_is_lost_while_the_odometry_lags_behind_the_camera(tf2: Tf2):
    out, refusals = output(tf_mode='map_to_odom')
    period = 33_000_000
    for k in range(10):  # odometry comes four images late
        out.broadcast(STAMP + k * period, Pose2(1.0 + k, 2.0, 0.5))
        if k >= 4:
            tf2.add('odom', 'base_link', STAMP + (k - 4) * period, Pose2())
            out.retry(STAMP + k * period)
    assert [m.header.stamp for m in tf2.sent] == [ns_to_stamp(STAMP + k * period)
                                                  for k in range(6)]
    assert [m.transform.translation.x for m in tf2.sent] == [1.0 + k for k in range(6)]
    assert refusals == []


def test_where_the_stamps_begin_anew_neither_estimates_nor_transforms_are_of_before(tf2: Tf2):
    out, refusals = output(tf_mode='map_to_odom')
    tf2.add('odom', 'base_link', STAMP, Pose2(5.0, 0.0, 0.0))
    out.broadcast(STAMP + 30, Pose2(9.0, 0.0, 0.0))
    tf2.arrived.messages = [
        ('odom', 'base_link', STAMP + k, Pose2(9.0, 0.0, 0.0)) for k in (9, 30)]
    out.forget()
    for stamp_ns in (STAMP, STAMP + 9):
        out.broadcast(stamp_ns, Pose2(1.0, 0.0, 0.0))
    assert tf2.sent == []
    # Those of the new time are used, and nothing older holds them up.
    for stamp_ns in (STAMP, STAMP + 9):
        tf2.add('odom', 'base_link', stamp_ns, Pose2(0.25, 0.0, 0.0))
    out.retry(STAMP + 9)
    assert [m.header.stamp for m in tf2.sent] == [ns_to_stamp(STAMP), ns_to_stamp(STAMP + 9)]
    assert [m.transform.translation.x for m in tf2.sent] == [0.75, 0.75]
    out.retry(STAMP + 10**10)
    assert refusals == []


def test_transforms_that_wait_behind_the_image_are_used_for_it(tf2: Tf2):
    out, _ = output(tf_mode='map_to_odom')
    tf2.arrived.messages = [('odom', 'base_link', STAMP, Pose2(3.0, 0.0, 0.0))]
    out.broadcast(STAMP, Pose2(1.0, 0.0, 0.0))
    (sent,) = tf2.sent
    assert sent.transform.translation.x == pytest.approx(-2.0)


def test_a_time_that_no_transform_can_have_holds_up_none_after_it(tf2: Tf2):
    out, refusals = output(tf_mode='map_to_odom')
    out.broadcast(-5, Pose2())
    assert refusals == ['tf_missing']
    tf2.add('odom', 'base_link', STAMP, Pose2())
    out.broadcast(STAMP, Pose2())
    assert len(tf2.sent) == 1


def test_odometry_that_is_no_rotation_is_not_passed_on(tf2: Tf2):
    out, refusals = output(tf_mode='map_to_odom')
    tf2.add('odom', 'base_link', STAMP, Pose2())
    tf2.known['odom', 'base_link', STAMP].transform.rotation.w = float('nan')
    out.broadcast(STAMP, Pose2())
    assert tf2.sent == []
    assert refusals == ['tf_pose']


def test_map_to_base_is_the_estimate_with_its_tolerance(tf2: Tf2):
    out, _ = output(tf_mode='map_to_base', transform_tolerance=0.25)
    out.broadcast(STAMP, Pose2(1.0, 2.0, 0.5))
    (sent,) = tf2.sent
    assert (sent.header.frame_id, sent.child_frame_id) == ('map', 'base_link')
    assert sent.header.stamp == ns_to_stamp(STAMP + 250_000_000)
    np.testing.assert_allclose(matrix(sent), planar_matrix(1.0, 2.0, 0.5), atol=1e-12)


def test_none_sends_nothing_and_needs_no_tf2(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, 'tf2_ros', None)
    out, _ = output(tf_mode='none')
    out.forget()
    out.broadcast(STAMP, Pose2())
    with pytest.raises(OptionError, match='apt install ros-jazzy-tf2-ros-py'):
        output(tf_mode='map_to_odom')


@pytest.mark.parametrize(('mode', 'made'), [
    ('none', []), ('map_to_base', ['publisher of /tf']),
    ('map_to_odom', ['listener', 'service tf2_frames', 'publisher of /tf'])])
def test_what_tf2_made_on_the_node_is_taken_back(tf2: Tf2, mode: str, made: list[str]):
    node = types.SimpleNamespace(
        destroy_service=tf2.gone.append, destroy_publisher=tf2.gone.append)
    TransformOutput(node, lambda: NodeOptions(tf_mode=mode), lambda *_: None).close()
    assert tf2.gone == made
