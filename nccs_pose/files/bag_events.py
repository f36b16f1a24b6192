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
"""What comes out of a bag: stamped values in the project's own terms."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from nccs_pose.geometry.pose import Pose2
from nccs_pose.vision.decode import decode_compressed, decode_image, Image


@dataclass(frozen=True)
class StampedImage:
    """A camera image, not yet decoded.

    :ivar stamp_ns: the header's stamp, nanoseconds.
    :ivar message: sensor_msgs/Image or CompressedImage, as rosbags reads it.
    """

    stamp_ns: int
    message: Any = field(repr=False, compare=False)

    def decode(self) -> Image:
        """Decode to BGR (H, W, 3) uint8.

        :raises VisionError: if the message holds no readable image.
        """
        message = self.message
        if hasattr(message, 'format'):
            return decode_compressed(message.format, message.data)
        return decode_image(
            message.encoding, message.height, message.width, message.step, message.is_bigendian,
            message.data)


@dataclass(frozen=True)
class StampedOdometry:
    """A wheel odometry pose: `child_frame_id` in `frame_id`.

    :ivar stamp_ns: the header's stamp, nanoseconds.
    """

    stamp_ns: int
    frame_id: str
    child_frame_id: str
    pose: Pose2


BagEvent = StampedImage | StampedOdometry
