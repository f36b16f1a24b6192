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

"""What arrives beside the images: nothing waits behind them."""

from __future__ import annotations

import os

import pytest

pytest.importorskip('rclpy', reason='ROS 2 is not available: no rclpy')

from nav_msgs.msg import Odometry
from nccs_pose.geometry.pose import Pose2
from nccs_pose.ros.conversions import image_message, odometry_message
from nccs_pose.ros.localiser_node import LocaliserNode
import numpy as np
import rclpy
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from sensor_msgs.msg import Image

SAMPLES = 60
PARAMETERS = {
    'rig_file': 'config/arena_640_rig.yaml', 'map_file': 'config/arena_map.yaml',
    'qos_overrides./odom.subscription.reliability': 'reliable',
    'qos_overrides./image.subscription.reliability': 'reliable'}


def test_odometry_that_arrived_before_an_image_is_used_before_it(tmp_path, monkeypatch):
    monkeypatch.setenv('ROS_LOG_DIR', str(tmp_path))
    context = Context()
    rclpy.init(context=context, domain_id=1 + os.getpid() % 99)
    executor = SingleThreadedExecutor(context=context)
    try:
        node = LocaliserNode(context=context, use_global_arguments=False, parameter_overrides=[
            Parameter(name, value=value) for name, value in PARAMETERS.items()])
        executor.add_node(node)
        node.autostart()
        seen: list[int] = []
        before_image: list[int] = []
        localiser = node._localiser
        process = localiser.process
        monkeypatch.setattr(localiser, 'add_odometry', lambda stamp, pose: seen.append(stamp))
        monkeypatch.setattr(localiser, 'process', lambda stamp, image: (
            before_image.append(len(seen)), process(stamp, image))[1])
        user = rclpy.create_node('user', context=context, use_global_arguments=False)
        odom = user.create_publisher(Odometry, 'odom', QoSProfile(depth=SAMPLES))
        images = user.create_publisher(Image, 'image', QoSProfile(depth=1))
        for _ in range(1000):
            if odom.get_subscription_count() and images.get_subscription_count():
                break
            executor.spin_once(timeout_sec=0.02)
        # All of it lies in the middleware before the executor looks again.
        for k in range(SAMPLES):
            odom.publish(odometry_message(
                1 + k * 10_000_000, 'odom', 'base_link', Pose2(0.01 * k, 0.0, 0.0), 1.0, 0.0))
        images.publish(image_message(
            SAMPLES * 10_000_000, 'camera', np.zeros((480, 640, 3), np.uint8)))
        assert odom.wait_for_all_acked(Duration(seconds=30))
        assert images.wait_for_all_acked(Duration(seconds=30))
        for _ in range(1000):
            if before_image:
                break
            executor.spin_once(timeout_sec=0.02)
        assert before_image == [SAMPLES]
        assert seen == [1 + k * 10_000_000 for k in range(SAMPLES)]
        node.close()
    finally:
        executor.shutdown()
        rclpy.shutdown(context=context)
