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

"""The node's names: every topic and service, with its type, quality of service and meaning.

The node creates its endpoints from these values and the reference page prints them.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Endpoint:
    """A topic or service, by its relative name.

    :ivar type: ROS type, e.g. ``sensor_msgs/msg/Image``.
    :ivar reliable: reliable (True) or best effort (False) by default; topics only.
    :ivar depth: messages kept (KEEP_LAST).
    :ivar doc: one sentence.
    """

    name: str
    type: str
    doc: str
    reliable: bool = True
    depth: int = 10


# An image that waits is late: no more are kept than a hiccup is caught up with (ImageStream).
IMAGE = Endpoint(
    'image', 'sensor_msgs/msg/Image', 'Images, when image_transport is raw.', False, 2)
IMAGE_COMPRESSED = Endpoint(
    'image/compressed', 'sensor_msgs/msg/CompressedImage',
    'JPEG or PNG images, when image_transport is compressed.', False, 2)
CAMERA_INFO = Endpoint(
    'camera_info', 'sensor_msgs/msg/CameraInfo',
    'Only compared with the rig: a contradiction is an error that says both numbers.', False, 1)
ODOM = Endpoint(
    'odom', 'nav_msgs/msg/Odometry',
    'Wheel odometry (optional): predicts the pose between images.', False, 100)
INITIAL_POSE = Endpoint(
    'initialpose', 'geometry_msgs/msg/PoseWithCovarianceStamped',
    "RViz's 2D Pose Estimate, in the map frame; a covariance of zeros takes initial_pose_sigma. "
    'It holds from the next image on and is carried on by odometry until an image decides; '
    'without odometry for a second at most, and ever less surely.',
    True, 5)
INPUTS = (IMAGE, IMAGE_COMPRESSED, CAMERA_INFO, ODOM, INITIAL_POSE)

POSE = Endpoint(
    'pose', 'geometry_msgs/msg/PoseWithCovarianceStamped',
    "base_link in the map frame at the image's stamp, only when it can be trusted.")
DIAGNOSTICS = Endpoint(
    '/diagnostics', 'diagnostic_msgs/msg/DiagnosticArray',
    'State, reason, quality, counts and times; every diagnostics_period and at every change of '
    'the state.')
DEBUG_IMAGE = Endpoint(
    '~/debug_image', 'sensor_msgs/msg/Image',
    'The image, with what was detected and what was predicted: cyan are the pixels that count as '
    'line-coloured, dots the pixels that the pose rests on (one colour a line), thin curves the '
    'edges of the lines as the pose predicts them. Below it stand the state and the numbers, so '
    'that it is higher than the image. Drawn only while somebody subscribes.', True, 1)
MARKERS = Endpoint(
    '~/markers', 'visualization_msgs/msg/MarkerArray',
    'Map lines, observed points and pose ellipse for RViz; only while somebody subscribes.',
    True, 1)
OUTPUTS = (POSE, DIAGNOSTICS, DEBUG_IMAGE, MARKERS)

RELOCALISE = Endpoint(
    '~/relocalise', 'std_srvs/srv/Trigger', 'Forget the pose and search everywhere.')
SET_PAUSED = Endpoint(
    '~/set_paused', 'std_srvs/srv/SetBool', 'Stop (true) or resume (false) using images.')
SERVICES = (RELOCALISE, SET_PAUSED)

STAND_IN_IMAGE = Endpoint(
    'image', 'sensor_msgs/msg/Image', 'Rendered images, when image_transport is raw.', True, 2)
STAND_IN_IMAGE_COMPRESSED = Endpoint(
    'image/compressed', 'sensor_msgs/msg/CompressedImage',
    'Rendered images as JPEG, when image_transport is compressed.', True, 2)
STAND_IN_INFO = Endpoint(
    'camera_info', 'sensor_msgs/msg/CameraInfo', "The rig's camera, with every image.", True, 2)
STAND_IN_ODOM = Endpoint(
    'odom', 'nav_msgs/msg/Odometry', 'Odometry of wheels that are a little wrong.', True, 100)
STAND_IN_TRUTH = Endpoint(
    'ground_truth/pose', 'geometry_msgs/msg/PoseStamped',
    "The true pose in the map frame, at every image's stamp.", True, 100)
STAND_IN_OUTPUTS = (
    STAND_IN_IMAGE, STAND_IN_IMAGE_COMPRESSED, STAND_IN_INFO, STAND_IN_ODOM, STAND_IN_TRUTH)
"""What the stand-in camera publishes; reliable, so that every subscriber hears it."""

TF_MODES = (
    ('`none`', 'anything', 'nothing'),
    ('`map_to_odom`', 'odom -> base_link',
     "map -> odom, so that map -> base_link at the image's stamp is the estimate"),
    ('`map_to_base`', 'nothing above base_link', 'map -> base_link'),
)
"""tf_mode, and who broadcasts what."""

CAUSES = (
    ('`image_data`', 'an image of unknown encoding, whose step, size and data do not fit, or '
     'that cannot be decoded'),
    ('`image_size`, `image_type`', "an image not of the rig's size; no 8-bit colour image"),
    ('`duplicate_stamp`, `out_of_order`',
     'an image with the stamp of the last one, or an earlier one (less than `clock_jump`)'),
    ('`frozen_image`', 'an image that has not changed by a bit although the robot has moved'),
    ('`camera_info`', 'a camera_info that contradicts the rig'),
    ('`undecodable`', 'bytes that are no message of the topic (of images the middleware hands on '
     'none: they count as frames_dropped_busy)'),
    ('`odom_frame`, `odom_pose`', 'odometry of other frames; with a number that is not finite or '
     'beyond 1e8 m, no rotation, or one that tilts by more than 30 deg'),
    ('`odom_jump`', 'odometry that leaps further than wheels roll (10 m/s, 20 rad/s), or back in '
     'time by more than `clock_jump`: it begins anew, and carries no pose across'),
    ('`initialpose_frame`, `initialpose_pose`, `initialpose_covariance`',
     'an initial pose in another frame; of which the same holds as of odometry; whose covariance '
     'is none'),
    ('`tf_missing`, `tf_pose`', 'an estimate whose odometry transform did not come within 1 s; a '
     'transform of which the same holds'),
)
"""Words by which refused messages are counted."""
