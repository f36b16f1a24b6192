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

"""The inputs beside the images: camera_info, odom and initialpose, checked and handed on."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from nccs_pose.errors import FrameRefusedError
from nccs_pose.estimation.localiser import Localiser
from nccs_pose.geometry.camera import PinholeCamera
from nccs_pose.node_options import NodeOptions
from nccs_pose.ros.camera_check import contradiction
from nccs_pose.ros.conversions import read_initial_pose, read_odometry
from nccs_pose.ros.interface import CAMERA_INFO, Endpoint, INITIAL_POSE, ODOM
from nccs_pose.ros.pose_keeper import PoseKeeper
from nccs_pose.ros.qos import overridable, profile
from rclpy.node import Node
from rclpy.serialization import deserialize_message
from rclpy.subscription import Subscription
from sensor_msgs.msg import CameraInfo

Refuse = Callable[[str, str], None]


class Inputs:
    """Subscribes camera_info, odom and initialpose, and hands on what can be used.

    The messages are taken as bytes and decoded here: rclpy drops what it cannot decode without
    a word, here it is counted.

    :ivar camera_problem: how the last camera_info contradicts the rig; empty if it does not.
    """

    def __init__(
        self, node: Node, options: Callable[[], NodeOptions], camera: PinholeCamera,
        localiser: Localiser, keeper: PoseKeeper, refuse: Refuse,
        on_camera_problem: Callable[[], None],
    ) -> None:
        """Subscribe.

        :param options: the present ones.
        :param refuse: called with cause and words for each message that cannot be used.
        :param on_camera_problem: called when the camera's problem changed.
        """
        self.camera_problem = ''
        self._node = node
        self._options = options
        self._camera = camera
        self._localiser = localiser
        self._keeper = keeper
        self._refuse = refuse
        self._on_camera_problem = on_camera_problem
        self._subscriptions: list[Subscription] = []
        try:
            self._odometry = self._listen(ODOM, Odometry, self._on_odometry)
            self._listen(CAMERA_INFO, CameraInfo, self._on_camera_info)
            self._listen(INITIAL_POSE, PoseWithCovarianceStamped, self._on_initial_pose)
        except BaseException:
            self.close()  # nobody else knows of what has been made
            raise

    def close(self) -> None:
        """Unsubscribe."""
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
        self._subscriptions = []

    def use_waiting_odometry(self) -> None:
        """Hand on the odometry that has arrived and waits behind an image."""
        for data, _ in waiting(self._odometry, ODOM.depth):
            self._odometry.callback(data)

    def _listen(self, endpoint: Endpoint, kind: Any, use: Callable[[Any], None]) -> Subscription:
        def receive(data: bytes) -> None:
            try:
                message = deserialize_message(data, kind)
            except Exception:  # rclpy raises what its serialiser met
                self._refuse('undecodable', f'{endpoint.name}: {len(data)} bytes that are no '
                             f'{endpoint.type}')
                return
            try:
                use(message)
            except FrameRefusedError as error:
                self._refuse(error.cause, str(error))

        subscription = self._node.create_subscription(
            kind, endpoint.name, receive, profile(endpoint), raw=True,
            qos_overriding_options=overridable())
        self._subscriptions.append(subscription)
        return subscription

    def _on_odometry(self, message: Odometry) -> None:
        options = self._options()
        self._localiser.add_odometry(*read_odometry(message, options.odom, options.base))

    def _on_initial_pose(self, message: PoseWithCovarianceStamped) -> None:
        pose, covariance = read_initial_pose(message, self._options().map_frame)
        self._keeper.give(self._localiser, pose, covariance)

    def _on_camera_info(self, message: CameraInfo) -> None:
        options, words = self._options(), ''
        if options.camera_info_check != 'off':
            words = contradiction(message, self._camera, options.camera_info_tolerance)
        if words:
            self._refuse('camera_info', words)
        if words != self.camera_problem:
            self.camera_problem = words
            self._on_camera_problem()


def waiting(subscription: Subscription, most: int) -> Iterator[tuple[Any, dict[str, Any]]]:
    """Take the messages that have arrived and whose callback has not run yet, oldest first.

    Each with what the middleware says of it (times, sequence number).

    An executor takes one message of each subscription in a round. Behind a callback of 30 ms the
    messages of a fast topic would wait longer and longer, until the oldest are dropped.

    :param most: no more than so many.
    """
    for _ in range(most):
        with subscription.handle:
            taken = subscription.handle.take_message(subscription.msg_type, subscription.raw)
        if taken is None:
            return
        yield taken
