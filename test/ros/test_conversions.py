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

"""Messages to values and back, against definitions of ROS and against scipy's rotations."""

from __future__ import annotations

from dataclasses import replace
import math
import os
import subprocess
import sys

import pytest

pytest.importorskip('rclpy', reason='ROS 2 is not available: no rclpy')

from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import Pose, PoseWithCovarianceStamped
from hypothesis import given
from hypothesis import strategies as st
from nav_msgs.msg import Odometry
from nccs_pose.errors import FrameRefusedError, OptionError
from nccs_pose.estimation.estimate import Estimate, State
from nccs_pose.geometry.pose import Pose2
from nccs_pose.node_options import NodeOptions
from nccs_pose.ros import conversions as c
from nccs_pose.ros.camera_check import contradiction
from nccs_pose.ros.diagnostics import image_status, pose_status, Tally
from nccs_pose.simulation.scene import arena_rig
import numpy as np
from rclpy.serialization import deserialize_message, serialize_message
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CameraInfo, Image

finite = st.floats(-1e3, 1e3, allow_nan=False)
angles = st.floats(-math.pi + 1e-9, math.pi)


def over_the_wire(message):
    """The message as a subscriber gets it."""
    return deserialize_message(serialize_message(message), type(message))


@given(st.integers(-2**31 * 10**9, 2**31 * 10**9 - 1))
def test_stamps_keep_every_nanosecond(stamp_ns: int):
    stamp = over_the_wire(c.ns_to_stamp(stamp_ns))
    assert 0 <= stamp.nanosec < 10**9
    assert stamp.sec * 10**9 + stamp.nanosec == stamp_ns == c.stamp_to_ns(stamp)


@given(finite, finite, angles)
def test_pose_is_a_rotation_about_z(x: float, y: float, yaw: float):
    message = over_the_wire(c.planar_to_pose(Pose2(x, y, yaw)))
    q = message.orientation
    turned = Rotation.from_quat([q.x, q.y, q.z, q.w]).apply([1.0, 0.0, 0.0])
    np.testing.assert_allclose(turned, [math.cos(yaw), math.sin(yaw), 0.0], atol=1e-12)
    back = c.pose_to_planar(message, 'odom')
    np.testing.assert_allclose(back.inverse().apply([[x, y]]), 0.0, atol=1e-9)
    assert math.cos(back.yaw - yaw) > 1.0 - 1e-12


@given(angles, st.floats(-0.3, 0.3), st.floats(-0.3, 0.3))
def test_yaw_of_a_tilted_pose(yaw: float, pitch: float, roll: float):
    x, y, z, w = Rotation.from_euler('ZYX', [yaw, pitch, roll]).as_quat()
    message = Pose()
    message.orientation.x, message.orientation.y = float(x), float(y)
    message.orientation.z, message.orientation.w = float(z), float(w)
    assert math.cos(c.pose_to_planar(message, 'odom').yaw - yaw) == pytest.approx(1.0, abs=1e-9)


@given(angles, angles, st.floats(-math.pi, math.pi))
def test_a_robot_on_its_side_is_refused(yaw: float, axis: float, tilt: float):
    lean = Rotation.from_rotvec([tilt * math.cos(axis), tilt * math.sin(axis), 0.0])
    x, y, z, w = (Rotation.from_euler('z', yaw) * lean).as_quat()
    message = Pose()
    message.orientation.x, message.orientation.y = float(x), float(y)
    message.orientation.z, message.orientation.w = float(z), float(w)
    if abs(tilt) < math.radians(29.9):
        c.pose_to_planar(message, 'odom')
    elif abs(tilt) > math.radians(30.1):
        with pytest.raises(FrameRefusedError, match='odom: tilted by'):
            c.pose_to_planar(message, 'odom')


def test_covariance_lies_where_rep_103_says():
    covariance = np.array([[4.0, 0.5, 0.1], [0.5, 3.0, 0.2], [0.1, 0.2, 2.0]])
    message = over_the_wire(c.pose_message(7, 'map', Pose2(1.0, 2.0, 0.3), covariance))
    sent = list(message.pose.covariance)
    assert (sent[0], sent[7], sent[35]) == (4.0, 3.0, 2.0)
    assert sent[1] == sent[6] == 0.5
    assert sent[5] == sent[30] == 0.1
    assert sent[11] == sent[31] == 0.2
    # robot_localization and fuse invert it: positive definite, nothing huge, nothing zero.
    values = np.linalg.eigvalsh(np.reshape(sent, (6, 6)))
    assert 1e-7 < values[0] <= values[-1] < 1e2
    assert message.header.frame_id == 'map'
    np.testing.assert_allclose(c.planar_covariance(sent, 'x'), covariance)


@pytest.mark.parametrize('order', ['C', 'F'])
def test_image_survives_the_wire(order: str):
    image = np.asarray(
        np.random.default_rng(0).integers(0, 256, (7, 5, 3), dtype=np.uint8), order=order)
    message = over_the_wire(c.image_message(123, 'camera', image))
    assert (message.height, message.width, message.step, message.encoding) == (7, 5, 15, 'bgr8')
    np.testing.assert_array_equal(c.decode(message), image)


def test_decoding_an_unpadded_bgr_image_copies_nothing():
    message = over_the_wire(c.image_message(0, '', np.zeros((4, 6, 3), np.uint8)))
    view = c.decode(message)
    message.data[0] = 200
    assert view[0, 0, 0] == 200


def test_row_padding_is_honoured():
    image = np.random.default_rng(1).integers(0, 256, (4, 3, 3), dtype=np.uint8)
    padded = np.zeros((4, 16), np.uint8)
    padded[:, :9] = image.reshape(4, 9)
    message = Image(height=4, width=3, step=16, encoding='bgr8', data=padded.tobytes())
    np.testing.assert_array_equal(c.decode(over_the_wire(message)), image)


def refusal(function, *arguments) -> str:
    """The cause for which something is refused."""
    with pytest.raises(FrameRefusedError) as refused:
        function(*arguments)
    return refused.value.cause


def good_prior() -> PoseWithCovarianceStamped:
    """What RViz sends."""
    message = PoseWithCovarianceStamped()
    message.header.frame_id = 'map'
    message.pose.pose.orientation.w = 1.0
    message.pose.covariance[0] = message.pose.covariance[7] = 0.25
    message.pose.covariance[35] = 0.0685
    return message


def test_rviz_initial_pose_is_taken():
    pose, covariance = c.read_initial_pose(over_the_wire(good_prior()), 'map')
    assert (pose.x, pose.y, pose.yaw) == (0.0, 0.0, 0.0)
    np.testing.assert_allclose(covariance, np.diag([0.25, 0.25, 0.0685]))
    unknown = good_prior()
    unknown.pose.covariance = [0.0] * 36
    assert c.read_initial_pose(unknown, 'map')[1] is None


@pytest.mark.parametrize('value', [math.nan, math.inf, -math.inf])
def test_initial_pose_that_is_not_finite_is_refused(value: float):
    message = good_prior()
    message.pose.pose.position.y = value
    assert refusal(c.read_initial_pose, message, 'map') == 'initialpose_pose'
    message = good_prior()
    message.pose.covariance[14] = value
    assert refusal(c.read_initial_pose, message, 'map') == 'initialpose_covariance'


@pytest.mark.parametrize('value', [-1e9, 1e300])
def test_a_pose_beyond_the_earth_is_refused(value: float):
    message = good_prior()
    message.pose.pose.position.y = value
    assert refusal(c.read_initial_pose, message, 'map') == 'initialpose_pose'


def test_initial_pose_with_a_wrong_frame_rotation_or_covariance_is_refused():
    message = good_prior()
    for frame in ('odom', '/map', ''):
        message.header.frame_id = frame
        assert refusal(c.read_initial_pose, message, 'map') == 'initialpose_frame'
    message = good_prior()
    message.pose.pose.orientation.w = 0.0
    assert refusal(c.read_initial_pose, message, 'map') == 'initialpose_pose'
    message = good_prior()
    message.pose.covariance[1] = 0.2
    assert refusal(c.read_initial_pose, message, 'map') == 'initialpose_covariance'
    message.pose.covariance[1] = message.pose.covariance[6] = 0.3  # larger than both variances
    assert refusal(c.read_initial_pose, message, 'map') == 'initialpose_covariance'


def test_odometry_of_other_frames_is_refused():
    message = Odometry(child_frame_id='base_link')
    message.header.frame_id = 'odom'
    message.pose.pose.orientation.w = 1.0
    assert c.read_odometry(message, 'odom', 'base_link') == (0, Pose2())
    assert refusal(c.read_odometry, message, 'robot1/odom', 'base_link') == 'odom_frame'
    assert refusal(c.read_odometry, message, 'odom', 'base_footprint') == 'odom_frame'
    message.pose.pose.position.x = math.nan
    assert refusal(c.read_odometry, message, 'odom', 'base_link') == 'odom_pose'


def test_camera_info_of_the_rig_agrees():
    camera = arena_rig().camera
    info = over_the_wire(c.camera_info_message(5, 'camera', camera))
    assert list(info.k) == [750.0, 0.0, 641.0, 0.0, 750.0, 477.5, 0.0, 0.0, 1.0]
    assert contradiction(info, camera, 0.0) == ''
    assert contradiction(CameraInfo(width=1280, height=960), camera, 0.0) == ''  # uncalibrated


@pytest.mark.parametrize(('model', 'number'), [
    ('plumb_bob', 0), ('plumb_bob', 8), ('rational_polynomial', 14), ('equidistant', 4),
    ('Plumb Bob', 5), ('', 5)])
def test_zeros_are_no_distortion_whatever_the_model(model: str, number: int):
    camera = arena_rig().camera
    info = c.camera_info_message(5, 'camera', camera)
    info.distortion_model, info.d = model, [0.0] * number
    assert contradiction(info, camera, 0.0) == ''
    distorting = replace(camera, distortion=(-0.3, 0.1))
    text = contradiction(info, distorting, 0.02)
    assert 'says distortion none, the rig plumb_bob [-0.3, 0.1]: up to ' in text


@pytest.mark.parametrize(('model', 'number'), [('plumb_bob', 8), ('rational_polynomial', 14)])
def test_zeros_after_the_last_coefficient_do_not_matter(model: str, number: int):
    camera = replace(arena_rig().camera, distortion=(-0.3, 0.1))
    info = c.camera_info_message(5, 'camera', camera)
    info.distortion_model, info.d = model, [-0.3, 0.1] + [0.0] * (number - 2)
    assert contradiction(info, camera, 0.0) == ''


@pytest.mark.parametrize(('changes', 'words'), [
    ({'width': 640}, ('640 x 960', '1280 x 960')),
    ({'k': [900.0, 0.0, 641.0, 0.0, 750.0, 477.5, 0.0, 0.0, 1.0]}, ('fx = 900', '750')),
    ({'k': [750.0, 0.0, 641.0, 0.0, 750.0, 400.0, 0.0, 0.0, 1.0]}, ('cy = 400', '477.5')),
    ({'k': [math.nan] * 9}, ('nan', '750')),
    ({'binning_x': 2, 'binning_y': 2}, ('2 x 2',)),
    ({'d': [-0.3, 0.1, 0.0, 0.0, 0.0]}, ('plumb_bob [-0.3, 0.1]', 'the rig none', 'px apart')),
    ({'d': [1e300] * 5}, ('plumb_bob [1e+300, ', 'e+303 px apart')),
    ({'d': [math.nan] * 5}, ('nan',)),
    ({'d': [0.1] * 4, 'distortion_model': 'equidistant'}, ('equidistant',)),
])
def test_camera_info_of_another_camera_is_said_with_both_numbers(changes, words):
    camera = arena_rig().camera
    info = c.camera_info_message(5, 'camera', camera)
    for name, value in changes.items():
        setattr(info, name, value)
    text = contradiction(info, camera, 0.02)
    assert all(word in text for word in words), text


BUILD_EVERY_MESSAGE = """
import math
import numpy as np
from nccs_pose.estimation.estimate import Candidate, Estimate, State
from nccs_pose.geometry.pose import Pose2
from nccs_pose.ros import conversions as c, diagnostics as d, markers as m
from nccs_pose.simulation.scene import arena_map, arena_rig
from nccs_pose.vision.line_points import LinePoints
from rclpy.serialization import serialize_message
camera, pose, one = arena_rig().camera, Pose2(1, 2, 3), np.eye(3)
points = LinePoints(np.array([[640.0, 800.0], [300.0, 300.0]]), np.ones(2), np.array([0, 1]))
estimate = Estimate(5, State.TRACKING, 'well', pose, one, (Candidate(pose, 0.5),), points)
tally = d.Tally(received=np.int64(3))
for message in (
    c.image_message(1, 'c', np.zeros((2, 2, 3), np.uint8)), c.compressed_message(1, 'c', b'x'),
    c.pose_message(np.int64(1), 'map', pose, one), c.camera_info_message(1, 'c', camera),
    c.odometry_message(1, 'odom', 'base', pose, np.float32(1), 2), c.truth_message(1, 'm', pose),
    m.marker_array('map', estimate, arena_rig(), arena_map()),
    m.marker_array('map', Estimate(5, State.LOST, 'gone'), arena_rig(), arena_map()),
    d.diagnostic_array(c.ns_to_stamp(1), [
        d.pose_status('n', 'active', '', '', estimate, 0.1, 0.02),
        d.pose_status('n', 'active', '', '', None, 1, math.nan),
        d.pose_status('n', 'inactive', '', '', None, 1, math.nan),
        d.pose_status('n', 'active', 'x', '', None, 1, math.nan),
        d.image_status('n', '/image', 1, tally, '', 1, 1),
        d.time_status('n', estimate, 0.1, 0.2)]),
):
    assert serialize_message(message)
print('all built')
"""


@pytest.mark.parametrize('checks', ['0', '1'])
def test_every_field_has_the_right_python_type(checks: str):
    done = subprocess.run(
        [sys.executable, '-c', BUILD_EVERY_MESSAGE], capture_output=True, text=True, check=False,
        env={**os.environ, 'ROS_PYTHON_CHECK_FIELDS': checks})
    assert done.stdout.strip() == 'all built', done.stderr


def test_the_last_trouble_is_what_is_said() -> None:
    tally = Tally()
    for trouble, words in (
            (lambda: tally.refuse('image_size', 'too small'), 'too small'),
            (lambda: tally.fail('here', ValueError('no way')), 'here: ValueError: no way'),
            (lambda: tally.refuse('image_size', 'too large'), 'too large')):
        trouble()
        assert image_status('n', '/image', 1, tally, '', 1, 0).message == words


def test_a_pose_of_images_that_no_longer_come_is_no_good_news() -> None:
    estimate = Estimate(5, State.TRACKING, 'well', Pose2(1.0, 2.0, 3.0), np.eye(3))
    for silence, state, level in (
            ('', 'tracking', DiagnosticStatus.OK),
            ('nothing publishes /image', 'silent', DiagnosticStatus.WARN)):
        shown = pose_status('n', 'active', '', silence, estimate, 7.0, 0.25)
        values = {entry.key: entry.value for entry in shown.values}
        assert (shown.level, values['state']) == (level, state)
        assert values['odometry_lag_s'] == '0.25'
        assert silence in shown.message


def test_what_no_image_has_measured_is_no_number() -> None:
    coasting = Estimate(5, State.COASTING, 'carried on', Pose2(1.0, 2.0, 3.0), np.eye(3))
    shown = pose_status('n', 'active', '', '', coasting, 0.1, 0.02)
    values = {entry.key: entry.value for entry in shown.values}
    for key in ('residual_px', 'expected_px', 'explained', 'claimed', 'ambiguity'):
        assert values[key] == 'nan', key
    assert (values['lines_used'], values['points_used']) == ('0', '0')


def test_a_prefix_of_frames_has_no_leading_slash() -> None:
    assert NodeOptions(frame_prefix='robot/').odom == 'robot/odom'
    with pytest.raises(OptionError, match='frame_prefix'):
        NodeOptions(frame_prefix='/robot/')
