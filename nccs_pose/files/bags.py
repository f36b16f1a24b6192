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
"""Bags of ROS 2 (and 1) read without ROS, by rosbags.

`BagReader` gives what the localiser needs, in the order in which it was recorded; `BagWriter`
(bag_writer.py) writes the same topics; serialised_bag.py hands out messages as they are.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any

from nccs_pose.errors import FileError, GeometryError
from nccs_pose.evaluation.trajectory import Trajectory
from nccs_pose.files.bag_events import BagEvent, StampedImage, StampedOdometry
from nccs_pose.files.bag_opening import in_words, open_bag
from nccs_pose.files.bag_topics import (
    BagTopics,
    find_topics,
    list_topics,
    POSE,
    TYPES,
)
from nccs_pose.files.bag_writer import BagWriter
from nccs_pose.files.trajectories import quaternion_yaw
from nccs_pose.geometry.camera import PinholeCamera
from nccs_pose.geometry.pose import Pose2
import numpy as np

__all__ = ['BagReader', 'BagTopics', 'BagWriter', 'StampedImage', 'StampedOdometry']


class BagReader:
    """A bag, open for reading; use it as a context manager.

    :param path: a rosbag2 folder (or a single .mcap, .db3 or ROS 1 .bag file).
    :param topics: names of topics; those not given are found by type and name.
    :ivar left_out: why, for each odometry message that `events` has left out.
    :raises FileError: if there is no bag, or it is cut short, or a topic is missing or ambiguous.
    """

    def __init__(self, path: str | Path, topics: BagTopics | None = None) -> None:
        self.path = Path(path)
        self._wanted = topics or BagTopics()
        self._stack = ExitStack()
        self._reader: Any = None
        self.topics = self._wanted
        self.left_out: list[str] = []

    def __enter__(self) -> BagReader:
        self._reader = open_bag(self.path, self._stack)
        try:
            self.topics = find_topics(self._wanted, self.topic_types(), str(self.path))
        except FileError:
            self._stack.close()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._stack.close()

    def topic_types(self) -> dict[str, str]:
        """Message type by topic, of the topics that have messages."""
        return {
            connection.topic: connection.msgtype
            for connection in self._reader.connections if connection.msgcount}

    def image_count(self) -> int:
        """How many images the bag holds."""
        topic = self._image_topic()
        return sum(c.msgcount for c in self._reader.connections if c.topic == topic)

    def camera(self) -> PinholeCamera | None:
        """The camera of the first CameraInfo; None if there is none, or it is not calibrated."""
        topic = self.topics.camera_info
        if topic is None:
            return None
        for _, _, message in self._messages([topic]):
            if not np.any(message.k):
                return None
            try:
                return PinholeCamera.from_K(
                    int(message.width), int(message.height), np.reshape(message.k, (3, 3)),
                    message.distortion_model or 'plumb_bob', message.d)
            except GeometryError as error:
                raise FileError(f'{self.path}: {topic}: {error}') from error
        return None

    def events(self, odometry: bool = True) -> Iterator[BagEvent]:
        """Images, and odometry if wanted and there, by time of reception.

        Odometry that is no pose is left out, as the node does.

        :raises FileError: if the bag has no image, or a message cannot be read.
        """
        names = [self._image_topic()]
        names += [self.topics.odom] if odometry and self.topics.odom else []
        for topic, kind, message in self._messages(names):
            if kind in TYPES['image']:
                yield StampedImage(_stamp(message), message)
                continue
            try:
                pose = self._pose(topic, kind, message)
            except FileError as error:
                self.left_out.append(str(error))
                continue
            yield StampedOdometry(
                _stamp(message), message.header.frame_id, message.child_frame_id, pose)

    def ground_truth(self) -> Trajectory:
        """All ground-truth poses by rising stamp.

        :raises FileError: if the bag has none, or one of them is no pose.
        """
        topic = self.topics.ground_truth
        if topic is None:
            raise FileError(
                f'{self.path}: has no ground-truth topic (a pose or odometry whose name says '
                f'so); it has {list_topics(self.topic_types())}.')
        return self._trajectory(topic)

    def odometry(self) -> Trajectory:
        """All odometry poses by rising stamp, in odometry's own frame; empty if there is none."""
        if self.topics.odom is None:
            return Trajectory(np.zeros(0, np.int64), np.zeros((0, 3)))
        return self._trajectory(self.topics.odom)

    def _trajectory(self, topic: str) -> Trajectory:
        rows = [
            (_stamp(message), self._pose(topic, kind, message))
            for _, kind, message in self._messages([topic])]
        return Trajectory(
            np.array([stamp for stamp, _ in rows], dtype=np.int64),
            np.array([pose.as_array() for _, pose in rows])).in_order()

    def _image_topic(self) -> str:
        if self.topics.image is None:
            raise FileError(
                f'{self.path}: has no images; it has {list_topics(self.topic_types())}.')
        return self.topics.image

    def _messages(self, topics: list[str]) -> Iterator[tuple[str, str, Any]]:
        """Topic, type and message, by time of reception."""
        connections = [c for c in self._reader.connections if c.topic in topics]
        iterator = self._reader.messages(connections=connections)
        while True:
            with in_words(self.path):
                item = next(iterator, None)
                if item is None:
                    return
                connection, received, data = item
            with in_words(self.path, f'message on {connection.topic} at {received} ns'):
                message = self._reader.deserialize(data, connection.msgtype)
            yield connection.topic, connection.msgtype, message

    def _pose(self, topic: str, kind: str, message: Any) -> Pose2:
        pose = message.pose if kind == POSE else message.pose.pose
        q, p = pose.orientation, pose.position
        norm = q.x * q.x + q.y * q.y + q.z * q.z + q.w * q.w
        try:
            if not 0.98 < norm < 1.02:
                raise GeometryError(f'quaternion ({q.x}, {q.y}, {q.z}, {q.w}) is no rotation')
            return Pose2(p.x, p.y, quaternion_yaw(q.x, q.y, q.z, q.w))
        except GeometryError as error:
            raise FileError(f'{self.path}: {topic} at {_stamp(message)} ns: {error}.') from error


def _stamp(message: Any) -> int:
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
