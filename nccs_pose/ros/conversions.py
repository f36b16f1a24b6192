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

"""Messages to the core's values and back.

rclpy does not check what is written into a message: a field of another type or shape is sent as
garbage. Every number below is therefore made a plain Python one of the field's own type.
"""

from __future__ import annotations

import array
from collections.abc import Sequence
import math
from typing import Any

from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, Pose, PoseStamped, PoseWithCovarianceStamped, Quaternion
from nav_msgs.msg import Odometry
from nccs_pose.errors import FrameRefusedError
from nccs_pose.geometry.camera import PinholeCamera
from nccs_pose.geometry.pose import Array, Pose2
from nccs_pose.vision.decode import decode_compressed, decode_image
import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

IMMOVABLE_VARIANCE = 1e-6
"""Variance of z, roll and pitch, which a planar robot cannot change: m^2, rad^2."""
FARTHEST = 1e8
"""Metres: further from its origin no frame of the earth is, and sums of squares overflow."""
MOST_TILTED = math.radians(30.0)
"""No ramp is steeper; where z points down, as in some frames of the sea, a yaw turns backwards."""
PLANAR = (0, 1, 5)
"""Rows of x, y and yaw in a 6 x 6 covariance (x, y, z, roll, pitch, yaw)."""


def stamp_to_ns(stamp: Time) -> int:
    """Nanoseconds of a stamp."""
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def ns_to_stamp(stamp_ns: int) -> Time:
    """A stamp from nanoseconds."""
    sec, nanosec = divmod(int(stamp_ns), 1_000_000_000)
    return Time(sec=sec, nanosec=nanosec)


def decode(message: Image | CompressedImage) -> NDArray[np.uint8]:
    """Image (H, W, 3) in BGR; a bgr8 image is a view of the message's own buffer.

    :raises VisionError: naming what does not fit.
    """
    if isinstance(message, CompressedImage):
        return decode_compressed(message.format, message.data)
    return decode_image(
        message.encoding, message.height, message.width, message.step, message.is_bigendian,
        message.data)


def image_message(stamp_ns: int, frame_id: str, image: NDArray[np.uint8]) -> Image:
    """A bgr8 message from (H, W, 3) uint8, with one copy of the pixels."""
    height, width = image.shape[:2]
    message = Image(
        height=int(height), width=int(width), encoding='bgr8', is_bigendian=0,
        step=3 * int(width))
    message.header.stamp = ns_to_stamp(stamp_ns)
    message.header.frame_id = frame_id
    # array.array is the one type that rclpy takes without looking at every byte.
    pixels = array.array('B')
    pixels.frombytes(np.ascontiguousarray(image).data.cast('B'))
    message.data = pixels
    return message


def pose_to_planar(pose: Pose, what: str) -> Pose2:
    """The planar part of a pose.

    :raises FrameRefusedError: cause `<what>_pose`, if a number is not finite or beyond the earth,
        the quaternion is none, or z does not point up.
    """
    p, q = pose.position, pose.orientation
    values = (p.x, p.y, p.z, q.x, q.y, q.z, q.w)
    if not all(math.isfinite(v) for v in values):
        raise FrameRefusedError(
            f'{what}_pose', f'{what}: position ({p.x}, {p.y}, {p.z}), orientation '
            f'({q.x}, {q.y}, {q.z}, {q.w}): every number must be finite')
    if max(abs(p.x), abs(p.y)) > FARTHEST:
        raise FrameRefusedError(
            f'{what}_pose', f'{what}: position ({p.x:.3g}, {p.y:.3g}) is further than '
            f'{FARTHEST:g} m from the origin')
    norm = math.sqrt(q.x * q.x + q.y * q.y + q.z * q.z + q.w * q.w)
    if not 0.99 < norm < 1.01:
        raise FrameRefusedError(
            f'{what}_pose', f'{what}: the quaternion ({q.x}, {q.y}, {q.z}, {q.w}) has length '
            f'{norm:.3g}, not 1')
    tilt = 2.0 * math.atan2(math.hypot(q.x, q.y), math.hypot(q.z, q.w))
    if tilt > MOST_TILTED:
        raise FrameRefusedError(
            f'{what}_pose', f'{what}: tilted by {math.degrees(tilt):.0f} deg, more than '
            f'{math.degrees(MOST_TILTED):.0f}: the robot stands on the floor')
    yaw = math.atan2(2.0 * (q.w * q.z + q.x * q.y), norm * norm - 2.0 * (q.y * q.y + q.z * q.z))
    return Pose2(p.x, p.y, yaw)


def yaw_quaternion(yaw: float) -> Quaternion:
    """Rotation about z."""
    return Quaternion(x=0.0, y=0.0, z=math.sin(0.5 * yaw), w=math.cos(0.5 * yaw))


def planar_to_pose(pose: Pose2) -> Pose:
    """A pose on the ground."""
    return Pose(
        position=Point(x=float(pose.x), y=float(pose.y), z=0.0),
        orientation=yaw_quaternion(float(pose.yaw)))


def pose_message(
    stamp_ns: int, frame: str, pose: Pose2, covariance: Array,
) -> PoseWithCovarianceStamped:
    """The node's answer, stamped with the image's stamp.

    :param covariance: of (x, y, yaw), (3, 3).
    """
    message = PoseWithCovarianceStamped()
    message.header.stamp = ns_to_stamp(stamp_ns)
    message.header.frame_id = frame
    message.pose.pose = planar_to_pose(pose)
    full = np.diag(np.full(6, IMMOVABLE_VARIANCE))
    full[np.ix_(PLANAR, PLANAR)] = covariance
    message.pose.covariance = full.ravel().tolist()
    return message


def planar_covariance(values: Sequence[float], what: str) -> Array | None:
    """Covariance of (x, y, yaw), (3, 3), from a message's 36 numbers; None if all are zero.

    :raises FrameRefusedError: cause `<what>_covariance`, if it is no covariance.
    """
    full = np.asarray(values, dtype=float).reshape(6, 6)
    part = full[np.ix_(PLANAR, PLANAR)]
    if not np.isfinite(full).all():
        problem = 'a number is not finite'
    elif not part.any():
        return None
    elif not np.allclose(part, part.T, rtol=1e-6, atol=1e-12):
        problem = 'it is not symmetric'
    elif np.linalg.eigvalsh(part)[0] <= 0.0:
        problem = 'it is not positive definite'
    else:
        return part
    raise FrameRefusedError(
        f'{what}_covariance', f'{what}: covariance of x, y, yaw {part.tolist()}: {problem}')


def check_frame(what: str, field: str, name: str, expected: str) -> None:
    """Refuse a message in another frame; an empty name passes, as drivers leave it.

    :raises FrameRefusedError: cause `<what>_frame`, saying both names.
    """
    if name and name != expected:
        raise FrameRefusedError(
            f'{what}_frame', f'{what}: {field} is {name!r}, expected {expected!r}')


def read_odometry(message: Odometry, odom: str, base: str) -> tuple[int, Pose2]:
    """Stamp (ns) and T_odom_base of an odometry message.

    :raises FrameRefusedError: `odom_frame` or `odom_pose`.
    """
    check_frame('odom', 'frame_id', message.header.frame_id, odom)
    check_frame('odom', 'child_frame_id', message.child_frame_id, base)
    return stamp_to_ns(message.header.stamp), pose_to_planar(message.pose.pose, 'odom')


def read_initial_pose(
    message: PoseWithCovarianceStamped, map_frame: str,
) -> tuple[Pose2, Array | None]:
    """Pose and covariance (None: not given) of an initialpose message.

    :raises FrameRefusedError: `initialpose_frame`, `initialpose_pose`, `initialpose_covariance`.
    """
    if not message.header.frame_id:
        raise FrameRefusedError(
            'initialpose_frame', f'initialpose: no frame_id; it must be {map_frame!r}')
    check_frame('initialpose', 'frame_id', message.header.frame_id, map_frame)
    pose = pose_to_planar(message.pose.pose, 'initialpose')
    return pose, planar_covariance(message.pose.covariance, 'initialpose')


def odometry_message(
    stamp_ns: int, odom: str, base: str, pose: Pose2, forward: float, turn: float,
) -> Odometry:
    """Wheel odometry: pose in its own frame, speed (m/s) and turning rate (rad/s)."""
    message = Odometry(child_frame_id=base)
    message.header.stamp = ns_to_stamp(stamp_ns)
    message.header.frame_id = odom
    message.pose.pose = planar_to_pose(pose)
    message.twist.twist.linear.x = float(forward)
    message.twist.twist.angular.z = float(turn)
    return message


def camera_info_message(stamp_ns: int, frame_id: str, camera: PinholeCamera) -> CameraInfo:
    """The calibration of a camera whose images are not rectified."""
    message = CameraInfo(
        width=int(camera.width), height=int(camera.height),
        distortion_model=camera.distortion_model, d=numbers(camera.distortion or np.zeros(5)),
        k=numbers(camera.K), r=numbers(np.eye(3)),
        p=numbers(np.column_stack([camera.K, np.zeros(3)])))
    message.header.stamp = ns_to_stamp(stamp_ns)
    message.header.frame_id = frame_id
    return message


def truth_message(stamp_ns: int, frame: str, pose: Pose2) -> PoseStamped:
    """A true pose."""
    message = PoseStamped(pose=planar_to_pose(pose))
    message.header.stamp = ns_to_stamp(stamp_ns)
    message.header.frame_id = frame
    return message


def compressed_message(stamp_ns: int, frame_id: str, jpeg: bytes) -> CompressedImage:
    """A JPEG of a colour image."""
    message = CompressedImage(format='bgr8; jpeg compressed bgr8')
    message.header.stamp = ns_to_stamp(stamp_ns)
    message.header.frame_id = frame_id
    message.data = array.array('B', jpeg)
    return message


def numbers(values: Any) -> list[float]:
    """Plain Python floats of any sequence or array, for a message's float64[]."""
    return [float(v) for v in np.asarray(values, dtype=float).ravel()]
