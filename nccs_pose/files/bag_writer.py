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
"""Writing a rosbag2 (MCAP) that ROS 2 Jazzy plays, with the topics that the localiser reads."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

import cv2
from nccs_pose.errors import FileError
from nccs_pose.files.rosbags_import import (
    jazzy_typestore,
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
    StoragePlugin,
    Writer,
)
from nccs_pose.geometry.camera import PinholeCamera
from nccs_pose.geometry.pose import Pose2, RigidTransform
from nccs_pose.vision.decode import Image
import numpy as np
from scipy.spatial.transform import Rotation

IMAGE_TOPIC = '/camera/image_raw'
CAMERA_INFO_TOPIC = '/camera/camera_info'
ODOMETRY_TOPIC = '/odom'
GROUND_TRUTH_TOPIC = '/ground_truth/pose'
TF_STATIC_TOPIC = '/tf_static'

_FOREVER = QosTime(9223372036, 854775807)


def _qos(depth: int, durability: QosDurability) -> Qos:
    """Reliable, as ROS 2's recorder writes what a publisher offered."""
    return Qos(
        QosHistory.KEEP_LAST, depth, QosReliability.RELIABLE, durability, _FOREVER, _FOREVER,
        QosLiveliness.AUTOMATIC, _FOREVER, False)


class BagWriter:
    """A new bag; use it as a context manager. After an error the bag has no metadata.yaml.

    Every message is received at its stamp. They may come in any order.

    :param path: the folder to make; it must not exist.
    :raises FileError: if it exists or cannot be made, or a value cannot be written.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._types = jazzy_typestore()
        self._connections: dict[tuple[str, str], Any] = {}
        self._writer: Any = None

    def __enter__(self) -> BagWriter:
        try:
            if self.path.exists():
                raise FileError(f'{self.path}: exists already; bags are never overwritten.')
            writer = Writer(self.path, version=9, storage_plugin=StoragePlugin.MCAP)
            writer.open()
        except OSError as error:
            raise FileError(f'{self.path}: cannot be made: {error.strerror}.') from error
        writer.set_custom_data('written_by', 'nccs_pose')
        self._writer = writer
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._writer.__exit__(kind, error, traceback)

    def write_image(
        self, stamp_ns: int, image: Image, *, compression: str = '', quality: int = 95,
        topic: str = IMAGE_TOPIC,
    ) -> None:
        """Write a BGR image (H, W, 3) uint8, raw or compressed.

        :param compression: ``''`` (raw bgr8), ``jpeg`` or ``png``; both go to
            ``<topic>/compressed``.
        :param quality: of a JPEG, 0 to 100.
        """
        header = self._header(stamp_ns, 'camera_optical')
        if not compression:
            height, width = image.shape[:2]
            self._write(topic, 'sensor_msgs/msg/Image', stamp_ns, {
                'header': header, 'height': height, 'width': width, 'encoding': 'bgr8',
                'is_bigendian': 0, 'step': 3 * width,
                'data': np.ascontiguousarray(image, np.uint8).reshape(-1)})
            return
        if compression not in ('jpeg', 'png'):
            raise FileError(
                f'{self.path}: image compression {compression!r} is not one of jpeg, png.')
        parameters = [cv2.IMWRITE_JPEG_QUALITY, quality] if compression == 'jpeg' else []
        self._write(f'{topic}/compressed', 'sensor_msgs/msg/CompressedImage', stamp_ns, {
            'header': header, 'format': f'bgr8; {compression} compressed bgr8',
            'data': cv2.imencode(f'.{compression}', image, parameters)[1].reshape(-1)})

    def write_camera_info(self, stamp_ns: int, camera: PinholeCamera) -> None:
        """Write the calibration of a camera that is not rectified (R = I, P = [K 0])."""
        length = 5 if camera.distortion_model == 'plumb_bob' else 8
        distortion = np.zeros(length)
        distortion[:len(camera.distortion)] = camera.distortion
        region = self._make('sensor_msgs/msg/RegionOfInterest', {
            'x_offset': 0, 'y_offset': 0, 'height': 0, 'width': 0, 'do_rectify': False})
        self._write(CAMERA_INFO_TOPIC, 'sensor_msgs/msg/CameraInfo', stamp_ns, {
            'header': self._header(stamp_ns, 'camera_optical'), 'height': camera.height,
            'width': camera.width, 'distortion_model': camera.distortion_model, 'd': distortion,
            'k': camera.K.ravel(), 'r': np.eye(3).ravel(),
            'p': np.hstack([camera.K, np.zeros((3, 1))]).ravel(), 'binning_x': 0, 'binning_y': 0,
            'roi': region})

    def write_odometry(
        self, stamp_ns: int, pose: Pose2, *, twist: tuple[float, float] = (0.0, 0.0),
        frame_id: str = 'odom', child_frame_id: str = 'base_link',
    ) -> None:
        """Write a wheel odometry pose; its covariances are zero, which says that none is known.

        :param twist: forward speed in m/s and turning rate in rad/s.
        """
        speed = self._make('geometry_msgs/msg/Twist', {
            'linear': self._xyz('Vector3', twist[0], 0.0),
            'angular': self._xyz('Vector3', 0.0, 0.0, twist[1])})
        self._write(ODOMETRY_TOPIC, 'nav_msgs/msg/Odometry', stamp_ns, {
            'header': self._header(stamp_ns, frame_id), 'child_frame_id': child_frame_id,
            'pose': self._make('geometry_msgs/msg/PoseWithCovariance', {
                'pose': self._pose(pose), 'covariance': np.zeros(36)}),
            'twist': self._make('geometry_msgs/msg/TwistWithCovariance', {
                'twist': speed, 'covariance': np.zeros(36)})})

    def write_truth(self, stamp_ns: int, pose: Pose2) -> None:
        """Write a ground-truth pose of base_link in the map."""
        self._write(GROUND_TRUTH_TOPIC, 'geometry_msgs/msg/PoseStamped', stamp_ns, {
            'header': self._header(stamp_ns, 'map'), 'pose': self._pose(pose)})

    def write_tf_static(
        self, stamp_ns: int, transforms: Sequence[tuple[str, str, RigidTransform]],
    ) -> None:
        """Write fixed transforms: parent frame, child frame, T_parent_child."""
        messages = []
        for parent, child, transform in transforms:
            motion = self._make('geometry_msgs/msg/Transform', {
                'translation': self._xyz('Vector3', *transform.translation),
                'rotation': self._quaternion(Rotation.from_matrix(transform.rotation).as_quat())})
            messages.append(self._make('geometry_msgs/msg/TransformStamped', {
                'header': self._header(stamp_ns, parent), 'child_frame_id': child,
                'transform': motion}))
        self._write(TF_STATIC_TOPIC, 'tf2_msgs/msg/TFMessage', stamp_ns, {'transforms': messages})

    def _write(self, topic: str, kind: str, stamp_ns: int, values: dict[str, Any]) -> None:
        if (topic, kind) not in self._connections:
            latched = topic == TF_STATIC_TOPIC
            qos = _qos(1, QosDurability.TRANSIENT_LOCAL) if latched else _qos(
                10, QosDurability.VOLATILE)
            self._connections[topic, kind] = self._writer.add_connection(
                topic, kind, typestore=self._types, offered_qos_profiles=[qos])
        data = self._types.serialize_cdr(self._make(kind, values), kind)
        try:
            self._writer.write(self._connections[topic, kind], stamp_ns, data)
        except OSError as error:
            raise FileError(f'{self.path}: cannot be written: {error.strerror}.') from error

    def _make(self, kind: str, values: dict[str, Any]) -> Any:
        return self._types.types[kind](**values)

    def _header(self, stamp_ns: int, frame_id: str) -> Any:
        seconds, nanoseconds = divmod(int(stamp_ns), 10**9)
        if not 0 <= seconds < 2**31:
            raise FileError(f'{self.path}: the stamp {stamp_ns} ns cannot be written in ROS time.')
        stamp = self._make('builtin_interfaces/msg/Time', {'sec': seconds, 'nanosec': nanoseconds})
        return self._make('std_msgs/msg/Header', {'stamp': stamp, 'frame_id': frame_id})

    def _pose(self, pose: Pose2) -> Any:
        half = 0.5 * pose.yaw
        return self._make('geometry_msgs/msg/Pose', {
            'position': self._xyz('Point', pose.x, pose.y),
            'orientation': self._quaternion((0.0, 0.0, np.sin(half), np.cos(half)))})

    def _xyz(self, kind: str, x: float, y: float, z: float = 0.0) -> Any:
        return self._make(
            f'geometry_msgs/msg/{kind}', {'x': float(x), 'y': float(y), 'z': float(z)})

    def _quaternion(self, xyzw: Any) -> Any:
        return self._make(
            'geometry_msgs/msg/Quaternion',
            {key: float(value) for key, value in zip('xyzw', xyzw)})
