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

"""A bag as it is: serialised messages of every topic, for playing."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

from nccs_pose.errors import FileError
from nccs_pose.files.bag_opening import in_words, open_bag
from nccs_pose.files.rosbags_import import QosDurability


@dataclass(frozen=True)
class BagTopic:
    """A topic that a bag has messages on.

    :ivar type: ROS type.
    :ivar latched: recorded from a transient-local publisher.
    :ivar count: messages.
    """

    name: str
    type: str
    latched: bool
    count: int


class SerialisedBag:
    """A bag, open for reading; use it as a context manager.

    :ivar topics: those with messages.
    :ivar start_ns: time of the first message, nanoseconds.
    :ivar end_ns: time of the last one.
    :raises FileError: if there is no bag, or it cannot be read.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._stack = ExitStack()
        self._reader: Any = None
        self.topics: tuple[BagTopic, ...] = ()
        self.start_ns = self.end_ns = 0

    def __enter__(self) -> SerialisedBag:
        self._reader = open_bag(self.path, self._stack)
        self.topics = tuple(
            BagTopic(c.topic, c.msgtype, _latched(c), c.msgcount)
            for c in self._reader.connections if c.msgcount)
        if not self.topics:
            self._stack.close()
            raise FileError(f'{self.path}: has no messages.')
        # rosbags counts the end exclusive.
        self.start_ns, self.end_ns = self._reader.start_time, self._reader.end_time - 1
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._stack.close()

    def messages(
        self, topics: Sequence[str], start_ns: int,
    ) -> Iterator[tuple[str, int, bytes]]:
        """Topic, time of reception (ns) and CDR bytes, by time, from `start_ns` on.

        :raises FileError: if the bag turns out to be damaged.
        """
        connections = [c for c in self._reader.connections if c.topic in topics and c.msgcount]
        if not connections:
            return
        with in_words(self.path):
            for connection, received_ns, data in self._reader.messages(
                    connections=connections, start=start_ns):
                yield connection.topic, received_ns, bytes(data)


def _latched(connection: Any) -> bool:
    profiles = getattr(connection.ext, 'offered_qos_profiles', ())
    return any(profile.durability == QosDurability.TRANSIENT_LOCAL for profile in profiles)
