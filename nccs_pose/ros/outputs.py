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

"""What leaves the node for one estimate."""

from __future__ import annotations

from collections.abc import Callable

from geometry_msgs.msg import PoseWithCovarianceStamped
from nccs_pose.estimation.estimate import Estimate
from nccs_pose.estimation.options import LocaliserOptions
from nccs_pose.geometry.lines import LineMap
from nccs_pose.geometry.rig import Rig
from nccs_pose.node_options import NodeOptions
from nccs_pose.ros.conversions import image_message, pose_message
from nccs_pose.ros.debug_image import draw_debug_image
from nccs_pose.ros.interface import DEBUG_IMAGE, Endpoint, MARKERS, POSE
from nccs_pose.ros.markers import marker_array
from nccs_pose.ros.qos import overridable, profile
from nccs_pose.ros.transforms import TransformOutput
import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.publisher import Publisher
from sensor_msgs.msg import Image
from visualization_msgs.msg import MarkerArray


class Outputs:
    """Publishers of pose, transform, debug image and markers.

    :raises OptionError: if a transform is asked for and cannot be made.
    """

    def __init__(
        self, node: Node, options: Callable[[], NodeOptions], rig: Rig, line_map: LineMap,
        refuse: Callable[[str, str], None],
    ) -> None:
        """Create them.

        :param options: the present ones.
        :param refuse: called with cause and words when a transform could not be made.
        """
        self._node = node
        self._frame = options().map_frame
        self._rig = rig
        self._map = line_map
        self.transforms = TransformOutput(node, options, refuse)
        self._publishers: list[Publisher] = []
        try:
            self._pose = self._advertise(PoseWithCovarianceStamped, POSE)
            self._debug = self._advertise(Image, DEBUG_IMAGE)
            self._markers = self._advertise(MarkerArray, MARKERS)
        except BaseException:
            self.close()  # nobody else knows of what has been made
            raise

    def _advertise(self, kind: type, endpoint: Endpoint) -> Publisher:
        publisher = self._node.create_publisher(
            kind, endpoint.name, profile(endpoint), qos_overriding_options=overridable())
        self._publishers.append(publisher)
        return publisher

    def publish(self, estimate: Estimate) -> bool:
        """Publish the pose and the transform of an estimate.

        :returns: whether it has a pose.
        """
        if estimate.pose is None or estimate.covariance is None:
            return False
        self._pose.publish(pose_message(
            estimate.stamp_ns, self._frame, estimate.pose, estimate.covariance))
        self.transforms.broadcast(estimate.stamp_ns, estimate.pose)
        return True

    def draw(
        self, estimate: Estimate, frame_id: str, image: NDArray[np.uint8],
        estimator: LocaliserOptions,
    ) -> None:
        """Publish what is to be looked at; what nobody subscribes is not computed.

        :param frame_id: of the image.
        :param estimator: the options that the estimate was made with.
        """
        if self._debug.get_subscription_count():
            drawn = draw_debug_image(image, self._rig, self._map, estimate, estimator)
            self._debug.publish(image_message(estimate.stamp_ns, frame_id, drawn))
        if self._markers.get_subscription_count():
            self._markers.publish(marker_array(self._frame, estimate, self._rig, self._map))

    def others(self) -> str:
        """Who else publishes the pose, in words; empty if nobody does."""
        topic = self._pose.topic_name
        number = self._node.count_publishers(topic) - 1
        if number <= 0:
            return ''
        return (f'{topic} has {number} other publisher{"s" if number > 1 else ""}: its '
                'subscribers get the poses of all that are active. Is the node started twice?')

    def close(self) -> None:
        """Destroy the publishers."""
        self.transforms.close()
        for publisher in self._publishers:
            self._node.destroy_publisher(publisher)
