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

"""The node `stand_in_camera`: streams the simulated robot live, as the real one would.

Publishes image (or image/compressed), camera_info, odom and ground_truth/pose of a drive along a
figure of eight.
"""

from __future__ import annotations

import sys
import time

import cv2
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from nccs_pose.errors import NccsPoseError, OptionError
from nccs_pose.files.resources import resolve
from nccs_pose.files.yaml_files import load_map, load_rig
from nccs_pose.ros.camera_options import CameraOptions, SCENES
from nccs_pose.ros.command_line import read_command_line
from nccs_pose.ros.conversions import (
    camera_info_message,
    compressed_message,
    image_message,
    odometry_message,
    truth_message,
)
from nccs_pose.ros.interface import (
    Endpoint,
    STAND_IN_IMAGE,
    STAND_IN_IMAGE_COMPRESSED,
    STAND_IN_INFO,
    STAND_IN_ODOM,
    STAND_IN_TRUTH,
)
from nccs_pose.ros.lifecycle import in_words
from nccs_pose.ros.parameters import NodeParameters
from nccs_pose.ros.qos import overridable, profile
from nccs_pose.ros.start import initialise, leave, told_to_end
from nccs_pose.ros.transport import use_large_images
from nccs_pose.simulation.drive import (
    ImageSample,
    make_drive,
    OdometrySample,
    render_frame,
    WheelModel,
)
from nccs_pose.simulation.motion import figure_of_eight
from nccs_pose.simulation.scene import Scene
import numpy as np
import rclpy
from rclpy.node import Node
from rclpy.publisher import Publisher
from sensor_msgs.msg import CameraInfo, CompressedImage, Image


class StandInCamera(Node):
    """Renders and publishes, each sample at its stamp."""

    def __init__(self) -> None:
        super().__init__('stand_in_camera')
        (self._options,) = NodeParameters(self, (CameraOptions,)).options()
        o = self._options
        look = SCENES[o.scene]()
        self._scene = Scene(
            load_rig(resolve(o.rig_file)), load_map(resolve(o.map_file)), look.appearance,
            look.sensor)
        self._image = (
            self._advertise(CompressedImage, STAND_IN_IMAGE_COMPRESSED)
            if o.image_transport == 'compressed' else self._advertise(Image, STAND_IN_IMAGE))
        self._info = self._advertise(CameraInfo, STAND_IN_INFO)
        self._odometry = self._advertise(Odometry, STAND_IN_ODOM)
        self._truth = self._advertise(PoseStamped, STAND_IN_TRUTH)
        self.skipped = 0

    def _advertise(self, kind: type, endpoint: Endpoint) -> Publisher:
        try:
            return self.create_publisher(
                kind, endpoint.name, profile(endpoint), qos_overriding_options=overridable())
        except Exception as error:  # rclpy raises what the value led to
            raise OptionError(in_words(error)) from error

    def drive(self) -> None:
        """Drive once; a frame that cannot be rendered in time is left out."""
        o = self._options
        # The first picture takes longest: what it prepares is kept.
        trajectory = figure_of_eight(speed=o.speed)
        frames = max(1, round(o.duration * o.rate))
        render_frame(self._scene, make_drive(trajectory, 1, o.rate), 0, o.seed)
        drive = make_drive(
            trajectory, frames, o.rate, WheelModel(), rng=np.random.default_rng(o.seed))
        # The drive begins when it is ready, not when it was asked for.
        start_ns = self.get_clock().now().nanoseconds - int(drive.stamps_ns[0])
        samples = [(s.stamp_ns, 0, k) for k, s in enumerate(drive.odometry)]
        samples += [(stamp_ns, 1, k) for k, stamp_ns in enumerate(drive.stamps_ns)]
        for stamp_ns, is_image, k in sorted(samples):
            late = self._wait_until(start_ns + stamp_ns)
            if told_to_end():
                return
            if not is_image:
                self._publish_odometry(start_ns + stamp_ns, drive.odometry[k])
            elif late < 1.0 / o.rate:
                self._publish_image(
                    start_ns + stamp_ns, render_frame(self._scene, drive, k, o.seed))
            else:
                self.skipped += 1
                self.get_logger().warning(
                    f'{self.skipped} of {k + 1} frames left out: this machine renders slower '
                    f'than {o.rate:g} Hz', throttle_duration_sec=10.0)

    def _wait_until(self, stamp_ns: int) -> float:
        """Serve parameters and the like until a time; returns how late it is, seconds."""
        while not told_to_end():
            left = 1e-9 * (stamp_ns - self.get_clock().now().nanoseconds)
            if left <= 0.0:
                return -left
            started = time.monotonic()
            rclpy.spin_once(self, timeout_sec=min(left, 0.1))
            # Nothing to spin for is no reason to spin.
            time.sleep(max(0.0, min(left, 0.002) - (time.monotonic() - started)))
        return 0.0

    def _publish_odometry(self, stamp_ns: int, sample: OdometrySample) -> None:
        prefix = self._options.frame_prefix
        self._odometry.publish(odometry_message(
            stamp_ns, prefix + 'odom', prefix + 'base_link', sample.pose,
            sample.twist.forward, sample.twist.turn))

    def _publish_image(self, stamp_ns: int, sample: ImageSample) -> None:
        frame = self._options.frame_prefix + 'camera_optical'
        if self._options.image_transport == 'compressed':
            jpeg = cv2.imencode('.jpg', sample.image, [cv2.IMWRITE_JPEG_QUALITY, 95])[1]
            self._image.publish(compressed_message(stamp_ns, frame, jpeg.tobytes()))
        else:
            self._image.publish(image_message(stamp_ns, frame, sample.image))
        self._info.publish(camera_info_message(stamp_ns, frame, self._scene.rig.camera))
        self._truth.publish(truth_message(stamp_ns, 'map', sample.pose))


def main() -> int:
    """Entry point of `ros2 run nccs_pose stand_in_camera`."""
    read_command_line('stand_in_camera', 'Stream a simulated robot live.', CameraOptions)
    use_large_images()
    try:
        initialise()
        node = StandInCamera()
        node.drive()
    except NccsPoseError as error:
        print(f'stand_in_camera: {error}', file=sys.stderr)
        return 2
    finally:
        leave()
    return 0


if __name__ == '__main__':
    sys.exit(main())
