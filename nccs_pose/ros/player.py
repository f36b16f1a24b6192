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

"""Plays a bag's topics without rosbag2: recorded timing, serialised messages passed through."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass
import importlib
import sys
import time

from nccs_pose.argument_types import number, seconds
from nccs_pose.errors import FileError, NccsPoseError
from nccs_pose.files.resources import resolve
from nccs_pose.files.serialised_bag import BagTopic, SerialisedBag
from nccs_pose.ros.conversions import ns_to_stamp
from nccs_pose.ros.start import initialise, leave, StartError, told_to_end
from nccs_pose.ros.transport import use_large_images
import rclpy
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.utilities import remove_ros_args
from rosgraph_msgs.msg import Clock

CLOCK_PERIOD = 0.01
"""Seconds between two /clock messages."""

SETTLE = 0.5

TAKEN_TIMEOUT = 2.0
"""Seconds to wait at the end for who listens reliably; one of them may hang."""

OnSent = Callable[[str, bytes], None]


@dataclass(frozen=True)
class Playback:
    """How to play.

    :ivar rate: speed factor.
    :ivar loop: begin again at the end, until stopped.
    :ivar start_offset: seconds of the bag to leave out.
    :ivar clock: publish /clock.
    :ivar topics: only these; empty for all.
    """

    rate: float = 1.0
    loop: bool = False
    start_offset: float = 0.0
    clock: bool = False
    topics: tuple[str, ...] = ()


class Player:
    """Publishes the topics of an open bag on a node.

    :ivar sent: messages published, by topic.
    :ivar skipped: topics that cannot be published here, with the reason.
    """

    def __init__(self, node: Node, bag: SerialisedBag, playback: Playback) -> None:
        """Create the publishers.

        :raises FileError: if a topic asked for is not in the bag, or nothing can be played.
        :raises StartError: if ROS refuses a topic, e.g. as remapped to one of another type.
        """
        self._node = node
        self._bag = bag
        self._playback = playback
        self.sent: dict[str, int] = {}
        self.skipped: dict[str, str] = {}
        self._publishers: dict[str, Publisher] = {}
        names = {topic.name for topic in bag.topics}
        missing = [name for name in playback.topics if name not in names]
        if missing:
            raise FileError(
                f'{bag.path}: has no topic {", ".join(missing)}; '
                f'it has {", ".join(sorted(names))}')
        for topic in bag.topics:
            if not playback.topics or topic.name in playback.topics:
                self._advertise(topic)
        if not self._publishers:
            raise FileError(f'{bag.path}: no topic of it can be played')
        if next(bag.messages(tuple(self._publishers), self._first_ns), None) is None:
            raise FileError(
                f'{bag.path}: --start-offset {playback.start_offset:g}: leaves nothing to play, '
                f'the bag lasts {1e-9 * (bag.end_ns - bag.start_ns):.1f} s')
        self._clock = node.create_publisher(Clock, '/clock', 10) if playback.clock else None

    def _advertise(self, topic: BagTopic) -> None:
        try:
            package, _, name = topic.type.split('/')
            kind = getattr(importlib.import_module(f'{package}.msg'), name)
        except (ImportError, AttributeError, ValueError):
            self.skipped[topic.name] = f'{topic.type} is not installed'
            self._node.get_logger().warning(
                f'{topic.name} is skipped: its type {topic.type} is not installed')
            return
        profile = QoSProfile(depth=100 if topic.latched else 10)
        if topic.latched:
            profile.durability = DurabilityPolicy.TRANSIENT_LOCAL
        try:
            publisher = self._node.create_publisher(kind, topic.name, profile)
        except RuntimeError as error:  # base of every RCLError
            raise StartError(
                f'{topic.name} cannot be published: {" ".join(str(error).split())}') from error
        self._publishers[topic.name] = publisher
        self.sent[topic.name] = 0

    @property
    def _first_ns(self) -> int:
        """Where in the bag it begins, nanoseconds."""
        return self._bag.start_ns + round(1e9 * self._playback.start_offset)

    def subscribers(self, topic: str) -> int:
        """How many subscribe a topic."""
        return self._publishers[topic].get_subscription_count()

    def play(self, on_sent: OnSent | None = None) -> None:
        """Play to the end; returns early when told to end.

        :param on_sent: called with topic and message right before each is published.
        """
        while True:
            self._play_once(on_sent)
            if told_to_end() or not self._playback.loop:
                break
        self._wait_until_taken()

    def _play_once(self, on_sent: OnSent | None) -> None:
        bag_start = self._first_ns
        wall_start = time.monotonic()
        for topic, received_ns, data in self._bag.messages(tuple(self._publishers), bag_start):
            due = wall_start + 1e-9 * (received_ns - bag_start) / self._playback.rate
            self._wait_until(due, received_ns)
            if told_to_end():
                return
            if on_sent is not None:
                on_sent(topic, data)
            self._publishers[topic].publish(data)
            self.sent[topic] += 1

    def _wait_until_taken(self) -> None:
        """Wait for who listens reliably: what they have not got is lost when we leave."""
        end = time.monotonic() + TAKEN_TIMEOUT
        publishers = [*self._publishers.values(), *([self._clock] if self._clock else [])]
        while not told_to_end() and time.monotonic() < end:
            if all(publisher.wait_for_all_acked(Duration()) for publisher in publishers):
                return
            time.sleep(CLOCK_PERIOD)

    def _wait_until(self, due: float, received_ns: int) -> None:
        """Sleep; /clock goes on meanwhile."""
        while not told_to_end():
            left = due - time.monotonic()
            if self._clock is not None:
                bag_time = received_ns - round(1e9 * max(left, 0.0) * self._playback.rate)
                self._clock.publish(Clock(clock=ns_to_stamp(bag_time)))
            if left <= 0.0:
                return
            time.sleep(min(left, CLOCK_PERIOD if self._clock is not None else 0.1))


def wait_for_subscribers(player: Player, topics: Sequence[str], timeout: float) -> bool:
    """Wait until each topic has a subscriber; false if time runs out or we are told to end."""
    end = time.monotonic() + timeout
    while not told_to_end() and time.monotonic() < end:
        if all(player.subscribers(topic) for topic in topics):
            # We know of them; they may not know of us yet, and lose what is best effort.
            time.sleep(SETTLE if topics else 0.0)
            return True
        time.sleep(0.02)
    return False


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point of `ros2 run nccs_pose play BAG`."""
    arguments = sys.argv[1:] if argv is None else list(argv)
    try:
        words = remove_ros_args(['play', *arguments])[1:]
    except RuntimeError as error:  # base of every RCLError
        print(f'play: cannot start: {" ".join(str(error).split())}', file=sys.stderr)
        return 2
    options = _parser().parse_args(words)
    playback = Playback(
        options.rate, options.loop, options.start_offset, options.clock,
        tuple(options.topics or ()))
    use_large_images()
    try:
        initialise(arguments)
        with SerialisedBag(options.bag) as bag:
            node = rclpy.create_node('play')
            player = Player(node, bag, playback)
            for topic in options.wait_for or ():
                if topic not in player.sent:
                    raise FileError(f'{options.bag}: --wait-for {topic}: is not played')
            waited = wait_for_subscribers(player, options.wait_for or (), options.wait_timeout)
            if not (waited or told_to_end()):
                print(f'play: nobody subscribes {", ".join(options.wait_for)}; playing anyway',
                      file=sys.stderr)
            player.play()
            # Logged, not printed: nobody may be left to read it.
            node.get_logger().info(
                'played ' + ', '.join(f'{n} x {t}' for t, n in sorted(player.sent.items())))
    except NccsPoseError as error:
        print(f'play: {error}', file=sys.stderr)
        return 2
    finally:
        leave()
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog='play', description='Publish the topics of a rosbag2 with their recorded timing. '
        'Topics are remapped as of any node: --ros-args -r /camera/image_raw:=/image.')
    parser.add_argument('bag', type=resolve, help='folder of the bag')
    parser.add_argument('--rate', type=number(0.001, 1000.0), default=1.0,
                        help='speed factor (default 1)')
    parser.add_argument('--loop', action='store_true', help='begin again at the end')
    parser.add_argument('--start-offset', type=seconds, default=0.0, metavar='S',
                        help='seconds of the bag to leave out')
    parser.add_argument('--clock', action='store_true', help='publish /clock, for use_sim_time')
    parser.add_argument('--topics', nargs='+', metavar='TOPIC', help='only these topics')
    parser.add_argument('--wait-for', nargs='+', metavar='TOPIC',
                        help='start when these topics have a subscriber')
    parser.add_argument('--wait-timeout', type=seconds, default=20.0, metavar='S',
                        help='how long to wait for them (default 20)')
    return parser


if __name__ == '__main__':
    sys.exit(main())
