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

"""What waits while the node is busy: odometry behind an image, images behind each other."""

from __future__ import annotations

import re
from typing import Any

import pytest

pytest.importorskip('rclpy', reason='ROS 2 is not available: no rclpy')

from harness import REPOSITORY
from nav_msgs.msg import Odometry
from nccs_pose.errors import GeometryError
from nccs_pose.geometry.pose import Pose2
from nccs_pose.ros.conversions import image_message, odometry_message
from nccs_pose.ros.interface import CAUSES
import numpy as np
from rclpy.duration import Duration
from rclpy.serialization import serialize_message
from sensor_msgs.msg import Image

SAMPLES = 60


def black(number: int) -> Image:
    return image_message(number * 10_000_000, 'camera', np.zeros((480, 640, 3), np.uint8))


def deliver(publisher: Any, *messages: Any) -> None:
    """Publish; when this returns they lie in the middleware."""
    for message in messages:
        publisher.publish(message)
    assert publisher.wait_for_all_acked(Duration(seconds=30))


def test_odometry_that_arrived_before_an_image_is_used_before_it(pair, monkeypatch):
    seen: list[int] = []
    before_image: list[int] = []
    localiser = pair.node._parts.localiser
    process = localiser.process
    monkeypatch.setattr(localiser, 'add_odometry', lambda stamp, pose: seen.append(stamp))
    monkeypatch.setattr(localiser, 'process', lambda stamp, image: (
        before_image.append(len(seen)), process(stamp, image))[1])
    odom = pair.publisher(Odometry, 'odom', SAMPLES)
    images = pair.publisher(Image, 'image', 1)
    # All of it lies in the middleware before the executor looks again.
    deliver(odom, *(odometry_message(
        1 + k * 10_000_000, 'odom', 'base_link', Pose2(0.01 * k, 0.0, 0.0), 1.0, 0.0)
        for k in range(SAMPLES)))
    deliver(images, black(SAMPLES))
    pair.wait(lambda: before_image)
    assert before_image == [SAMPLES]
    assert seen == [1 + k * 10_000_000 for k in range(SAMPLES)]


def test_every_cause_of_a_refusal_is_in_the_reference():
    said = {cause for names, _ in CAUSES for cause in re.findall('`([a-z_]+)`', names)}
    literal = re.compile(r"(?:FrameRefusedError|refuse)\(\s*(f?)'([^']+)'")
    of_a_topic = re.compile(r'\{what\}_(\w+)')
    found = [match.groups() for path in (REPOSITORY / 'nccs_pose').rglob('*.py')
             for match in literal.finditer(path.read_text())]
    assert len(found) > 12
    for is_format, cause in found:
        if is_format:
            kind = of_a_topic.fullmatch(cause)
            assert kind, cause
            assert f'initialpose_{kind[1]}' in said
        else:
            assert cause in said


def test_an_error_that_is_nobodys_fault_outside_is_no_refusal(pair, monkeypatch):
    def fail(*_: object) -> None:
        raise GeometryError('a mistake of our own')

    monkeypatch.setattr(pair.node._parts.localiser, 'add_odometry', fail)
    odometry = odometry_message(1, 'odom', 'base_link', Pose2(), 0.0, 0.0)
    with pytest.raises(GeometryError):
        pair.node._inputs._odometry.callback(serialize_message(odometry))
    assert not pair.node._tally.refused


def test_a_hiccup_is_caught_up_with_and_a_backlog_is_not(pair, monkeypatch):
    used: list[int] = []
    localiser = pair.node._parts.localiser
    process = localiser.process
    images = pair.publisher(Image, 'image', 2)
    monkeypatch.setattr(localiser, 'process', lambda stamp, image: (
        used.append(stamp // 10_000_000), process(stamp, image))[1])
    deliver(images, black(1), black(2))
    pair.wait(lambda: len(used) == 2)
    deliver(images, black(3))
    pair.wait(lambda: len(used) == 3)
    tally = pair.node._tally
    assert (used, tally.received, tally.let_go) == ([1, 2, 3], 3, 0)

    # Now two images come in the time that one takes.
    def slow(stamp: int, image: Any) -> Any:
        used.append(stamp // 10_000_000)
        if sent[-1] < 23:
            sent.extend((sent[-1] + 1, sent[-1] + 2))
            deliver(images, *map(black, sent[-2:]))
        return process(stamp, image)

    sent = [4, 5]
    monkeypatch.setattr(localiser, 'process', slow)
    deliver(images, *map(black, sent))
    pair.wait(lambda: used[-1] == 23)
    # While 4 and 5 are used, 8 and 9 replace 6 and 7 in the middleware, and so on; when one
    # waits for the fifth time in a row, the older of the two is let go.
    assert used[3:] == [4, 5, 8, 9, 12, 13, 16, 17, 21, 23]
    assert (tally.received, tally.let_go) == (13, 10)


@pytest.mark.parametrize(
    'pair', [{'qos_overrides./image.subscription.depth': 5}], indirect=True)
def test_a_depth_of_the_users_choice_is_taken_at_its_word(pair, monkeypatch):
    used: list[int] = []
    process = pair.node._parts.localiser.process
    images = pair.publisher(Image, 'image', 5)
    monkeypatch.setattr(pair.node._parts.localiser, 'process', lambda stamp, image: (
        used.append(stamp // 10_000_000), process(stamp, image))[1])
    deliver(images, *map(black, range(1, 6)))
    pair.wait(lambda: len(used) == 5)
    assert (used, pair.node._tally.let_go) == ([1, 2, 3, 4, 5], 0)
