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

"""Messages that nobody should send: each is refused by name, none stops the node."""

from __future__ import annotations

from collections import Counter
import math
import random

import pytest

pytest.importorskip('rclpy', reason='ROS 2 is not available: no rclpy')

from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from nccs_pose.geometry.camera import PinholeCamera
from nccs_pose.ros.conversions import (
    camera_info_message,
    compressed_message,
    image_message,
    ns_to_stamp,
)
from nccs_pose.simulation.scene import arena_rig
import numpy as np
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

ARENA = {'rig_file': 'config/arena_640_rig.yaml', 'map_file': 'config/arena_map.yaml'}
CAMERA = arena_rig().scaled(0.5).camera
RANDOM_MESSAGES = 10_000


def refused(user, cause: str) -> int:
    return user.count(f'refused.{cause}')


def hostile_images(good: Image) -> dict[str, Image]:
    """Images that differ from a good one in one thing."""
    def changed(**fields: object) -> Image:
        message = Image(
            header=good.header, height=good.height, width=good.width, step=good.step,
            encoding=good.encoding, data=good.data)
        for name, value in fields.items():
            setattr(message, name, value)
        return message

    data = good.data.tobytes()
    return {
        'empty message': Image(),
        'unknown encoding': changed(encoding='bgr7'),
        'no encoding': changed(encoding=''),
        'step too small': changed(step=good.width),
        'step too large': changed(step=good.step + 1),
        'truncated': changed(data=data[:-1]),
        'no data': changed(data=b''),
        'no rows': changed(height=0, data=b''),
        'gigantic': changed(height=2**32 - 1, width=2**32 - 1),
        'channels of another encoding': changed(encoding='bgra8'),
    }


def test_hostile_images_are_named_and_a_good_one_still_gives_a_pose(world, arena):
    node, user = world.localiser(**ARENA), world.user
    poses = user.listen(PoseWithCovarianceStamped, 'pose')
    images = user.publisher(Image, 'image')
    good = image_message(arena[0].stamp_ns, 'camera', arena[0].image)
    for number, (name, message) in enumerate(hostile_images(good).items(), start=1):
        images.publish(message)
        assert user.wait(lambda n=number: refused(user, 'image_data') == n), (name, node.output)
    images.publish(image_message(5, 'camera', np.zeros((100, 100, 3), np.uint8)))
    assert user.wait(lambda: refused(user, 'image_size') == 1), node.output
    assert poses == []
    # Frame after frame as a camera sends them: the node is as good as new.
    user.show(images, *(image_message(s.stamp_ns, 'camera', s.image) for s in arena))
    assert user.wait(lambda: poses and len(poses) == user.count('frames_answered')), node.output
    first = len(poses)
    images.publish(image_message(arena[-1].stamp_ns, 'camera', arena[-1].image))
    assert user.wait(lambda: refused(user, 'duplicate_stamp') == 1), node.output
    images.publish(image_message(arena[-2].stamp_ns, 'camera', arena[-2].image))
    assert user.wait(lambda: refused(user, 'out_of_order') == 1), node.output
    assert len(poses) == first
    assert user.count('errors') == 0
    assert node.running()


def test_hostile_compressed_images_are_named(world):
    node, user = world.localiser(image_transport='compressed', **ARENA), world.user
    images = user.publisher(CompressedImage, 'image/compressed')
    whole = world_jpeg()
    kinds = [CompressedImage(), compressed_message(1, 'c', b''), compressed_message(1, 'c', b'x'),
             compressed_message(1, 'c', whole[:len(whole) // 2]),
             CompressedImage(format='tiff', data=whole)]
    for number, message in enumerate(kinds, start=1):
        images.publish(message)
        assert user.wait(lambda n=number: refused(user, 'image_data') == n), node.output
    images.publish(compressed_message(1, 'c', whole))  # decodes, but is not of this camera
    assert user.wait(lambda: refused(user, 'image_size') == 1), node.output
    assert user.count('errors') == 0


def world_jpeg() -> bytes:
    import cv2

    noise = np.random.default_rng(0).integers(0, 256, (64, 64, 3), dtype=np.uint8)
    return cv2.imencode('.jpg', noise)[1].tobytes()


def test_other_hostile_messages_are_named(world, arena):
    node, user = world.localiser(**ARENA), world.user
    poses = user.listen(PoseWithCovarianceStamped, 'pose')
    images, info = user.publisher(Image, 'image'), user.publisher(CameraInfo, 'camera_info')
    prior = user.publisher(PoseWithCovarianceStamped, 'initialpose')
    odom = user.publisher(Odometry, 'odom')

    message = PoseWithCovarianceStamped()
    message.header.frame_id = 'map'
    message.pose.pose.position.x = math.nan
    assert user.insist(prior, message, lambda: refused(user, 'initialpose_pose')), node.output
    message.header.frame_id = 'mars'
    assert user.insist(prior, message, lambda: refused(user, 'initialpose_frame')), node.output
    message.header.frame_id, message.pose.pose.position.x = 'map', 0.0
    message.pose.covariance[0] = -1.0
    assert user.insist(
        prior, message, lambda: refused(user, 'initialpose_covariance')), node.output

    drifting = Odometry(child_frame_id='base_link')
    drifting.header.frame_id = 'odom'
    drifting.pose.pose.orientation.w = math.inf
    assert user.insist(odom, drifting, lambda: refused(user, 'odom_pose')), node.output
    drifting.child_frame_id = 'wheel'
    assert user.insist(odom, drifting, lambda: refused(user, 'odom_frame')), node.output
    leaping = Odometry(child_frame_id='base_link')
    leaping.header.frame_id, leaping.pose.pose.orientation.w = 'odom', 1.0
    for place in (0.0, 100.0):
        leaping.header.stamp.nanosec += 10_000_000
        leaping.pose.pose.position.x = place
        odom.publish(leaping)
    assert user.wait(lambda: refused(user, 'odom_jump')), node.output
    assert '100 m and 0 rad' in user.value('localiser: images', 'last_refusal')

    # Another camera: poses are withheld, both numbers said, until the right one speaks.
    other = PinholeCamera(640, 480, 500.0, 375.0, 320.25, 238.5)
    hostile = camera_info_message(1, 'camera', other)
    assert user.insist(info, hostile, lambda: refused(user, 'camera_info')), node.output
    reason = user.value('localiser: pose', 'reason')
    assert '500' in reason
    assert '375' in reason
    messages = [image_message(s.stamp_ns, 'camera', s.image) for s in arena]
    user.show(images, *messages[:3])
    assert user.count('frames_answered') == len(poses) == 0
    assert user.insist(info, camera_info_message(2, 'camera', CAMERA), lambda: user.value(
        'localiser: pose', 'reason') != reason), node.output
    user.show(images, *messages[3:])
    assert user.wait(lambda: poses), node.output
    assert user.count('errors') == 0


def random_message(rng: random.Random) -> tuple[str, object]:
    """A topic and a message, or bytes, that may mean anything."""
    def number() -> float:
        return rng.choice([0.0, 1.0, -1.0, math.nan, math.inf, 1e308, rng.uniform(-9, 9)])

    def name() -> str:
        return rng.choice(['map', 'odom', 'base_link', '', '/map', 'ü', 'x' * 300])

    topic = rng.choice(['image', 'camera_info', 'odom', 'initialpose'])
    if rng.random() < 0.4:
        return topic, b'\x00\x01\x00\x00' + rng.randbytes(rng.choice([0, 3, 40, 400, 4000]))
    stamp = ns_to_stamp(rng.choice([0, 1, -5, 2**62 % 10**18, rng.randrange(10**18)]))
    if topic == 'image':
        message = Image(
            encoding=rng.choice(['bgr8', 'rgb8', 'mono8', 'mono16', 'nv12', 'yuv422', 'x', '']),
            height=rng.choice([0, 1, 2, 480, 2**32 - 1]), width=rng.choice([0, 1, 2, 640, 2**31]),
            step=rng.choice([0, 1, 6, 1920, 2**32 - 1]), is_bigendian=rng.randrange(256),
            data=rng.randbytes(rng.choice([0, 1, 6, 12, 1920])))
    elif topic == 'camera_info':
        message = CameraInfo(
            height=rng.choice([0, 480, 7]), width=rng.choice([0, 640, 7]),
            k=[number() for _ in range(9)], d=[number() for _ in range(rng.randrange(9))],
            distortion_model=name(), binning_x=rng.randrange(3))
    elif topic == 'odom':
        message = Odometry(child_frame_id=name())
        fill_pose(message.pose, number)
    else:
        message = PoseWithCovarianceStamped()
        fill_pose(message.pose, number)
    message.header.stamp, message.header.frame_id = stamp, name()
    return topic, message


def fill_pose(pose, number) -> None:
    p, q = pose.pose.position, pose.pose.orientation
    p.x, p.y, p.z, q.x, q.y, q.z, q.w = (number() for _ in range(7))
    pose.covariance = [number() for _ in range(36)]


def test_ten_thousand_random_messages_are_each_counted_and_none_yields_a_pose(world, arena):
    kinds = {'image': Image, 'camera_info': CameraInfo, 'odom': Odometry,
             'initialpose': PoseWithCovarianceStamped}
    # Every message has to arrive for every one to be counted.
    policies = ('reliability:=reliable', f'depth:={RANDOM_MESSAGES}')
    reliable = [argument for topic in kinds for policy in policies
                for argument in ('-p', f'qos_overrides./{topic}.subscription.{policy}')]
    node, user = world.localiser(*reliable, **ARENA), world.user
    poses = user.listen(PoseWithCovarianceStamped, 'pose')
    publishers = {topic: user.publisher(kind, topic, depth=RANDOM_MESSAGES)
                  for topic, kind in kinds.items()}
    user.show(publishers['image'], Image())  # missing images are counted from the first one on
    rng, sent = random.Random(20), Counter(image=1)
    for number in range(1, RANDOM_MESSAGES):
        topic, message = random_message(rng)
        publishers[topic].publish(message)
        sent[topic] += 1
        if number % 100 == 0:
            user.spin(0.0)
    sent['image'] += 1
    publishers['image'].publish(Image())  # and up to the last one

    # Bytes that are no image never reach the node: they are missing in the sequence.
    def counted() -> bool:
        others = sum(sent.values()) - sent['image']
        return (user.frames() == sent['image']
                and user.count('refused') == others + user.count('frames_received'))

    assert user.wait(counted), (sent, user.statuses['localiser: images'])
    assert poses == []
    assert user.count('errors') == 0, user.value('localiser: images', 'last_error')
    causes = ('image_data', 'camera_info', 'odom_pose', 'odom_frame', 'initialpose_pose',
              'initialpose_frame', 'undecodable')
    assert all(refused(user, cause) > 20 for cause in causes), user.statuses['localiser: images']
    # And it still localises: the right camera, then a drive with stamps after all others.
    withheld = user.value('localiser: pose', 'reason')
    assert user.insist(publishers['camera_info'], camera_info_message(1, 'camera', CAMERA),
                       lambda: user.value('localiser: pose', 'reason') != withheld)
    user.show(publishers['image'], *(
        image_message(2 * 10**18 + s.stamp_ns, 'camera', s.image) for s in arena))
    assert user.wait(lambda: poses), node.output
    assert node.stop() == 0, node.output
