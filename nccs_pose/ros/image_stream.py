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

"""The image subscription: which image next, decoding, missing frames, silence."""

from __future__ import annotations

from collections.abc import Callable
import time
from typing import Any

from nccs_pose.errors import FrameRefusedError, NccsPoseError
from nccs_pose.ros.conversions import decode, stamp_to_ns
from nccs_pose.ros.diagnostics import Tally
from nccs_pose.ros.inputs import waiting
from nccs_pose.ros.interface import IMAGE, IMAGE_COMPRESSED
from nccs_pose.ros.qos import overridable, profile
import numpy as np
from numpy.typing import NDArray
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import qos_policy_name_from_kind
from sensor_msgs.msg import CompressedImage, Image

BACKLOG = 5
"""So many times in a row another image waited: that is no hiccup."""
OnFrame = Callable[[int, str, 'NDArray[np.uint8]'], None]


class ImageStream:
    """Subscribes images and hands on each that can be decoded.

    An image that waits is late. After a hiccup those that wait are caught up with; where one
    waits behind every image that is taken (BACKLOG), the machine is too slow, and the older of
    the two is let go. A depth that the user chose is taken at its word: all that it keeps are
    used.

    Missing images are counted by the publisher's sequence numbers; what of them the middleware
    reports as lost was lost on the way, the rest was let go because the node was busy.

    :ivar topic: full name of the topic.
    :ivar publishers: how many publish to us at present.
    :ivar decode_s: seconds for decoding the last image.
    :ivar arrived: monotonic time of the last image, seconds.
    """

    def __init__(
        self, node: Node, transport: str, tally: Tally, on_frame: OnFrame,
        on_publishers: Callable[[], None],
    ) -> None:
        """Subscribe.

        :param transport: raw or compressed.
        :param on_frame: called with stamp (ns), frame_id and image (H, W, 3) of each.
        :param on_publishers: called when a publisher came or went.
        """
        endpoint, kind = (
            (IMAGE, Image) if transport == 'raw' else (IMAGE_COMPRESSED, CompressedImage))
        self._node = node
        self._type = endpoint.type
        self._tally = tally
        self._on_frame = on_frame
        self._sequence: int | None = None
        self._behind = 0
        self._incompatible = ''
        self._on_publishers = on_publishers
        self.publishers = 0
        self._last_words = ''
        self.decode_s = 0.0
        self.arrived = time.monotonic()
        # rclpy's annotations know of one argument only.
        receive: Callable[..., None] = self._receive
        qos = profile(endpoint)
        self._subscription = node.create_subscription(
            kind, endpoint.name, receive, qos,
            event_callbacks=SubscriptionEventCallbacks(
                message_lost=self._lost, incompatible_qos=self._mismatched,
                matched=self._matched),
            qos_overriding_options=overridable())
        # By now the user's choice, if there is one, stands in the profile.
        self._waiting = 1 if qos.depth == endpoint.depth else 0
        self.topic = self._subscription.topic_name

    def close(self) -> None:
        """Unsubscribe."""
        self._node.destroy_subscription(self._subscription)

    def problem(self, patience: float) -> str:
        """Why no image has come for `patience` seconds; empty if one has."""
        silence = time.monotonic() - self.arrived
        if silence < patience:
            words = ''
        elif self._incompatible:
            words = self._incompatible
        elif not self.publishers:
            words = self._mistyped() or f'nothing publishes {self.topic}'
        else:
            words = f'{self.topic} has a publisher, but no image came for a while'
        if words and words != self._last_words:
            self._node.get_logger().warning(words)
        self._last_words = words
        return words

    def _mistyped(self) -> str:
        """What is published under the topic's name and is none of it; empty if nothing is."""
        others = {info.topic_type for info in self._node.get_publishers_info_by_topic(self.topic)}
        others.discard(self._type)
        if not others:
            return ''
        return (f'{self.topic} is published as {", ".join(sorted(others))}, but is subscribed as '
                f'{self._type}: remap the other of image and image/compressed, or set '
                'image_transport')

    def _receive(self, message: Image | CompressedImage, info: dict[str, Any]) -> None:
        taken = [(message, info), *waiting(self._subscription, self._waiting)]
        self._behind = self._behind + 1 if len(taken) > 1 else 0
        # What is let go leaves a gap in the sequence numbers, as what the middleware replaces.
        for each in taken if self._behind < BACKLOG else taken[-1:]:
            self._use(*each)

    def _use(self, message: Image | CompressedImage, info: dict[str, Any]) -> None:
        self.arrived = time.monotonic()
        self._incompatible = ''
        self._tally.received += 1
        self._count_missing(info.get('publication_sequence_number'))
        stamp_ns = stamp_to_ns(message.header.stamp)
        try:
            image = decode(message)
            self.decode_s = time.monotonic() - self.arrived
            self._on_frame(stamp_ns, message.header.frame_id, image)
        except FrameRefusedError as error:
            self._refuse(error.cause, error)
        except NccsPoseError as error:
            self._refuse('image_data', error)

    def _refuse(self, cause: str, error: Exception) -> None:
        self._tally.refuse(cause, str(error))
        self._node.get_logger().warning(
            f'image refused ({cause}): {error}', throttle_duration_sec=5.0)

    def _count_missing(self, sequence: int | None) -> None:
        before, self._sequence = self._sequence, sequence
        # Two publishers count apart; a restarted one starts over.
        if before is not None and sequence is not None and self.publishers < 2:
            self._tally.missing += max(0, sequence - before - 1)

    def _lost(self, event: Any) -> None:
        # What was sent before the first image arrived was never ours to lose.
        if self._sequence is not None:
            self._tally.lost += int(event.total_count_change)

    def _matched(self, event: Any) -> None:
        self.publishers = int(event.current_count)
        self._on_publishers()

    def _mismatched(self, event: Any) -> None:
        policy = qos_policy_name_from_kind(event.last_policy_kind)
        self._incompatible = (
            f'a publisher of {self.topic} offers another {policy} than is asked for: set '
            f'qos_overrides.{self.topic}.subscription.{policy.lower()}')
        self._node.get_logger().warning(self._incompatible)
