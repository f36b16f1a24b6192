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

"""An executor loop that no message and no callback can end.

rclpy lets an exception of any callback out of `spin`, which ends the node, and a message that
cannot be taken leaves its callback group locked for ever. Here both are reported and the loop
goes on; SIGINT, SIGTERM and SIGHUP end it in order, with exit code 0.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
import sys
import traceback
from typing import Any

from nccs_pose.ros.start import initialise, leave, StartError, told_to_end
from rclpy.exceptions import ParameterException
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

STOP_PERIOD = 0.1
"""Seconds until an idle node notices that it was told to end."""

Report = Callable[[str, BaseException], None]


class GuardedExecutor(SingleThreadedExecutor):
    """A single-threaded executor that reports what a message or callback raised."""

    def __init__(self, report: Report) -> None:
        super().__init__()
        self._report = report

    def _guarded(self, take: Callable[[Any], Any], entity: Any) -> Any:
        try:
            return take(entity)
        except Exception as error:
            self._report('taking a message', error)
            return None

    # Raised here, an exception would leave the entity's callback group busy for good.
    def _take_subscription(self, sub: Any) -> Any:
        return self._guarded(super()._take_subscription, sub)

    def _take_client(self, client: Any) -> Any:
        return self._guarded(super()._take_client, client)

    def _take_service(self, srv: Any) -> Any:
        return self._guarded(super()._take_service, srv)

    def _take_waitable(self, waitable: Any) -> Any:
        return self._guarded(super()._take_waitable, waitable)

    def spin(self) -> None:
        """Run callbacks until the program is told to end."""
        while not told_to_end():
            try:
                self.spin_once(timeout_sec=STOP_PERIOD)
            except Exception as error:
                self._report(_culprit(error), error)


def _culprit(error: BaseException) -> str:
    """Name of the project's function in which the exception was raised, or of the last one."""
    frames = traceback.extract_tb(error.__traceback__)
    ours = [frame for frame in frames if 'nccs_pose' in Path(frame.filename).parts]
    frame = (ours or list(frames))[-1]
    return f'{Path(frame.filename).stem}.{frame.name}'


def run(make_node: Callable[[], Node], args: list[str] | None = None) -> int:
    """Initialise ROS, spin one node until it is told to stop, and clean up.

    The node may have `report(name, exception)`, called for what its callbacks raise, and
    `close()`, called before it is destroyed.

    :returns: exit code: 0 after a signal that ends it, 2 if the ROS arguments cannot be read or
        used.
    """
    node: Node | None = None
    executor: GuardedExecutor | None = None
    try:
        initialise(args)
        node = make_node()
        executor = GuardedExecutor(getattr(node, 'report', None) or _log(node))
        executor.add_node(node)
        executor.spin()
    except StartError as error:
        print(error, file=sys.stderr)
        return 2
    except ParameterException as error:  # of use_sim_time and others that rclpy itself declares
        print(f'cannot start: {error}', file=sys.stderr)
        return 2
    finally:
        if executor is not None:
            # What it waits with, left to the end of Python, would be destroyed after ROS itself.
            executor.shutdown()
        if node is not None:
            getattr(node, 'close', lambda: None)()
            node.destroy_node()
        leave()
    return 0


def _log(node: Node) -> Report:
    def report(name: str, error: BaseException) -> None:
        node.get_logger().error(f'{name}: {type(error).__name__}: {error}')

    return report
