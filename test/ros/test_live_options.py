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

"""What is changed while the node runs, by what the node sends from then on."""

from __future__ import annotations

import sys
import types
from typing import Any

import pytest

pytest.importorskip('rclpy', reason='ROS 2 is not available: no rclpy')

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from harness import RELIABLE, REPOSITORY
from nav_msgs.msg import Odometry
from nccs_pose.files.yaml_files import load_rig
from nccs_pose.ros.conversions import (
    camera_info_message,
    image_message,
    odometry_message,
    stamp_to_ns,
)
import numpy as np
from rclpy.duration import Duration
from sensor_msgs.msg import CameraInfo, Image

INFO_RELIABLE = {'qos_overrides./camera_info.subscription.reliability': 'reliable'}


@pytest.fixture
def transforms(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """What a tf2_ros, which the wheels lack, is given to broadcast."""
    sent: list[Any] = []
    module = types.ModuleType('tf2_ros')
    monkeypatch.setattr(module, 'TransformBroadcaster', lambda node: types.SimpleNamespace(
        sendTransform=sent.append, pub_tf=None), raising=False)
    monkeypatch.setitem(sys.modules, 'tf2_ros', module)
    return sent


def images_of(samples: Any) -> list[Image]:
    return [image_message(s.stamp_ns, 'camera', s.image) for s in samples]


@pytest.mark.parametrize('pair', [{'tf_mode': 'map_to_base'}], indirect=True)
def test_the_tolerance_of_transforms(transforms: list[Any], pair: Any, arena: Any):
    images = pair.publisher(Image, 'image', 1)
    for number, (message, tolerance) in enumerate(zip(images_of(arena), (0.0, 0.5, 0.25))):
        pair.set(transform_tolerance=tolerance)
        images.publish(message)
        pair.wait(lambda n=number: len(transforms) > n)
        ahead_ns = stamp_to_ns(transforms[-1].header.stamp) - arena[number].stamp_ns
        assert ahead_ns == round(1e9 * tolerance)


@pytest.mark.parametrize('pair', [INFO_RELIABLE], indirect=True)
def test_what_a_camera_info_must_agree_in(pair: Any, arena: Any):
    poses = pair.listen(PoseWithCovarianceStamped, 'pose')
    images = pair.publisher(Image, 'image', 1)
    infos = pair.publisher(CameraInfo, 'camera_info', 1)
    camera = load_rig(REPOSITORY / RELIABLE['rig_file']).camera
    info = camera_info_message(1, 'camera', camera)
    info.k[0] += 0.1 * camera.fx
    messages = iter(images_of(arena))

    def answered() -> bool:
        """Whether another image is answered, and it said so."""
        received, given = pair.node._tally.received, len(poses)
        images.publish(next(messages))
        pair.wait(lambda: pair.node._tally.received > received)
        expected = pair.node._tally.answered
        pair.wait(lambda: len(poses) == expected)
        return len(poses) > given

    def inform() -> None:
        refused = pair.node._tally.refused['camera_info']
        infos.publish(info)
        pair.wait(lambda: pair.node._tally.refused['camera_info'] > refused)

    inform()
    assert not answered()
    pair.set(camera_info_check='warn')
    assert answered()
    pair.set(camera_info_check='refuse')
    assert not answered()
    pair.set(camera_info_tolerance=0.2)
    infos.publish(info)
    pair.wait(lambda: not pair.node._inputs.camera_problem)
    assert answered()


@pytest.mark.parametrize('pair', [
    {'silence_warning': 3600.0, 'diagnostics_period': 0.05}], indirect=True)
def test_how_long_silence_is_borne(pair: Any):
    reports = pair.listen(DiagnosticArray, '/diagnostics')

    def said() -> bool:
        return any('nothing publishes' in s.message for r in reports for s in r.status)

    pair.wait(lambda: len(reports) > 15)
    assert not said()
    pair.set(silence_warning=0.5)
    pair.wait(said)


def test_how_long_the_estimator_coasts(pair: Any, arena: Any):
    images = pair.publisher(Image, 'image', 1)
    wheels = pair.publisher(Odometry, 'odom', 1)
    dark = [image_message(s.stamp_ns, 'camera', np.full_like(s.image, k))
            for k, s in enumerate(arena)]
    for number, message in enumerate([*images_of(arena[:2]), *dark[2:4]]):
        if number == 3:
            pair.set(coast_time=0.0)
        wheels.publish(odometry_message(
            arena[number].stamp_ns, 'odom', 'base_link', arena[number].pose, 0.0, 0.0))
        assert wheels.wait_for_all_acked(Duration(seconds=30))
        images.publish(message)
        pair.wait(lambda n=number: pair.node._tally.received > n)
    assert pair.node._tally.answered == 3
