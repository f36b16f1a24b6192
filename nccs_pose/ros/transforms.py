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

"""The transform that the node broadcasts, by REP 105.

Contract: with `map_to_odom` somebody else broadcasts odom -> base_link; it is looked up at the
image's stamp and map -> odom is broadcast, so that map -> base_link is the estimate there. With
`map_to_base` nobody does, and map -> base_link is broadcast itself. While a needed transform is
missing nothing is broadcast.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any

from geometry_msgs.msg import TransformStamped
from nccs_pose.errors import FrameRefusedError, OptionError
from nccs_pose.geometry.pose import Pose2
from nccs_pose.node_options import NodeOptions
from nccs_pose.ros.conversions import ns_to_stamp, planar_to_pose, pose_to_planar, yaw_quaternion
from nccs_pose.ros.inputs import waiting
from rclpy.node import Node
from rclpy.time import Time

PATIENCE_NS = 1_000_000_000
"""How long an estimate waits for the odometry transform at its stamp."""
MOST_WAITING = 100


class TransformOutput:
    """Broadcasts what `tf_mode` says.

    :raises OptionError: if transforms are asked for and tf2_ros is not installed.
    """

    def __init__(
        self, node: Node, options: Callable[[], NodeOptions], refuse: Callable[[str, str], None],
    ) -> None:
        """Create the broadcaster, and the listener where one is needed.

        :param options: the present ones; the tolerance may change while the node runs.
        :param refuse: called with cause and words when a transform could not be made.
        """
        self._node = node
        self._options = options
        self._refuse = refuse
        self._pending: deque[tuple[int, Pose2]] = deque(maxlen=MOST_WAITING)
        self._buffer: Any = None
        self._listener: Any = None
        self._broadcaster: Any = None
        mode = options().tf_mode
        if mode == 'none':
            return
        try:
            import tf2_ros
        except ImportError as error:
            raise OptionError(
                f'tf_mode = {mode} needs tf2_ros, which is not installed '
                '(Ubuntu: apt install ros-jazzy-tf2-ros-py); tf_mode = none works without'
            ) from error
        self._broadcaster = tf2_ros.TransformBroadcaster(node)
        if mode == 'map_to_odom':
            self._buffer = tf2_ros.Buffer(node=node)
            self._listener = tf2_ros.TransformListener(self._buffer, node)
            self._not_yet = tf2_ros.TransformException

    def broadcast(self, stamp_ns: int, pose: Pose2) -> None:
        """Broadcast the transform of a new estimate T_map_base, now or when it can be made."""
        options = self._options()
        if options.tf_mode == 'map_to_base':
            self._send(stamp_ns, options.base, pose)
        elif options.tf_mode == 'map_to_odom':
            if stamp_ns < 0:
                self._refuse('tf_missing', f'no transform is of a time before zero: {stamp_ns} ns')
                return
            self._pending.append((stamp_ns, pose))
            self.retry(stamp_ns)

    def forget(self) -> None:
        """Forget what waits and what /tf said: the stamps begin anew.

        tf2 sorts transforms by their stamps and keeps those of the last ten seconds. What comes
        after a step back would lie among transforms of other places, or be refused for good.
        """
        self._pending.clear()
        if self._buffer is not None:
            # What has arrived and was not taken yet may be of the old time as well.
            for _ in waiting(self._listener.tf_sub, MOST_WAITING):
                pass
            # It leaves /tf_static alone, which would not be sent again: a StaticCache of tf2 does
            # nothing when it is told to clear its list.
            self._buffer.clear()

    def retry(self, now_ns: int) -> None:
        """Try again what waits, oldest first; give up what is older than the patience."""
        if not self._pending:
            return
        options = self._options()
        # The listener's callbacks wait behind the images, as everything else does.
        for message, _ in waiting(self._listener.tf_sub, MOST_WAITING):
            self._listener.callback(message)
        while self._pending:
            stamp_ns, pose = self._pending[0]
            try:
                found = self._buffer.lookup_transform(
                    options.odom, options.base, Time(nanoseconds=stamp_ns))
            except self._not_yet as error:
                if now_ns - stamp_ns <= PATIENCE_NS:
                    return
                self._refuse('tf_missing', f'no transform {options.odom} -> {options.base} at '
                             f'the image: {error}')
            else:
                self._pass_on(stamp_ns, pose, found)
            self._pending.popleft()

    def _pass_on(self, stamp_ns: int, pose: Pose2, found: TransformStamped) -> None:
        try:
            odom_base = planar_transform(found)
        except FrameRefusedError as error:
            self._refuse('tf_pose', str(error))
        else:
            self._send(stamp_ns, self._options().odom, pose @ odom_base.inverse())

    def close(self) -> None:
        """Take back what tf2_ros has made on the node, which may be configured again."""
        if self._listener is not None:
            self._listener.unregister()
            self._node.destroy_service(self._buffer.srv)
        if self._broadcaster is not None:
            self._node.destroy_publisher(self._broadcaster.pub_tf)

    def _send(self, stamp_ns: int, child: str, pose: Pose2) -> None:
        options, message = self._options(), TransformStamped()
        tolerance_ns = round(1e9 * options.transform_tolerance)
        message.header.stamp = ns_to_stamp(stamp_ns + tolerance_ns)
        message.header.frame_id = options.map_frame
        message.child_frame_id = child
        message.transform.translation.x = float(pose.x)
        message.transform.translation.y = float(pose.y)
        message.transform.rotation = yaw_quaternion(float(pose.yaw))
        self._broadcaster.sendTransform(message)


def planar_transform(message: TransformStamped) -> Pose2:
    """The planar part of a transform.

    :raises FrameRefusedError: if it holds a number that is not finite, or no rotation.
    """
    pose = planar_to_pose(Pose2())
    translation = message.transform.translation
    pose.position.x, pose.position.y = translation.x, translation.y
    pose.orientation = message.transform.rotation
    return pose_to_planar(pose, 'tf')
