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

"""Which images are looked at at all: of the right shape, newer than the last, and alive."""

from __future__ import annotations

from nccs_pose.errors import FrameRefusedError
from nccs_pose.estimation.odometry import Odometry
from nccs_pose.geometry.camera import PinholeCamera
import numpy as np
from numpy.typing import NDArray

# A robot that has moved further than this, metres and rad, cannot see the very same image.
_MOVED = 0.005
# So many rows, spread evenly, tell a frozen camera from one that stands still in its own noise.
_ROWS = 10


class Admission:
    """Remembers the last image that was used."""

    def __init__(self, camera: PinholeCamera, odometry: Odometry, clock_jump: float) -> None:
        """Begin without any image.

        :param clock_jump: a stamp that goes back further than this is a new start, s.
        """
        self._camera = camera
        self._odometry = odometry
        self._clock_jump = clock_jump
        self.forget()

    def forget(self) -> None:
        """Take the next image whatever its stamp."""
        self._last_stamp: int | None = None
        self._last_content = b''
        # Stamp of the first image with this content, and whether the robot has moved since.
        self._same_since = 0
        self._frozen = False

    def admit(self, stamp_ns: int, image: NDArray[np.uint8]) -> bool:
        """Let an image in; False where its clock starts anew and all history is void.

        :param stamp_ns: the image's own stamp, nanoseconds.
        :param image: (H, W, 3) uint8 BGR.
        :raises FrameRefusedError: if the image must not be used; the cause says why.
        """
        camera, last = self._camera, self._last_stamp
        if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
            raise FrameRefusedError(
                'image_type', f'image of shape {image.shape} and type {image.dtype} is not '
                '(height, width, 3) uint8')
        if image.shape[:2] != (camera.height, camera.width):
            raise FrameRefusedError(
                'image_size', f'image is {image.shape[1]} x {image.shape[0]} pixels, the '
                f'calibration is for {camera.width} x {camera.height}')
        continues = last is None or stamp_ns >= last
        if last is not None and not continues and last - stamp_ns <= self._clock_jump * 1e9:
            raise FrameRefusedError(
                'out_of_order', f'stamp {stamp_ns} ns is {(last - stamp_ns) * 1e-9:.3f} s '
                'before that of the last image')
        if last == stamp_ns:
            raise FrameRefusedError('duplicate_stamp', f'stamp {stamp_ns} ns was there before')
        apart = max(len(image) // _ROWS, 1)
        content = image[apart // 2::apart].tobytes()
        same = continues and content == self._last_content
        self._frozen = same and (self._frozen or self._moved_since(self._same_since, stamp_ns))
        if self._frozen:
            raise FrameRefusedError(
                'frozen_image', 'the image has not changed by a bit although the robot has moved')
        if not same or self._odometry.at(self._same_since) is None:
            self._same_since = stamp_ns
        self._last_content = content
        self._last_stamp = stamp_ns
        return continues

    def _moved_since(self, before_ns: int, after_ns: int) -> bool:
        before, after = self._odometry.at(before_ns), self._odometry.at(after_ns)
        if before is None or after is None:
            return False
        step = before.pose.inverse() @ after.pose
        return bool(np.hypot(step.x, step.y) > _MOVED or abs(step.yaw) > _MOVED)
