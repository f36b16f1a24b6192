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

"""Initialising ROS, with words instead of a traceback where it cannot be; and leaving it."""

from __future__ import annotations

from collections.abc import Sequence
import os
from pathlib import Path
import signal
import tempfile
from typing import NoReturn

from nccs_pose.errors import NccsPoseError
import rclpy

LOG_VARIABLES = ('ROS_LOG_DIR', 'ROS_HOME', 'HOME')
"""Any of these says where ROS logs to; without one it does not start."""


class StartError(NccsPoseError):
    """ROS arguments or an environment with which ROS does not start."""


def initialise(args: Sequence[str] | None = None) -> None:
    """Initialise rclpy; where nothing says where to log to, log to the temporary folder.

    A service manager starts programs without HOME.

    :param args: command line, None for the program's own.
    :raises StartError: e.g. for a parameter file that is not there.
    """
    if not any(os.environ.get(name) for name in LOG_VARIABLES):
        os.environ['ROS_LOG_DIR'] = str(Path(tempfile.gettempdir(), f'ros_log_{os.getuid()}'))
    try:
        rclpy.init(args=None if args is None else list(args))
    except RuntimeError as error:  # base of every RCLError
        raise StartError(f'cannot start: {" ".join(str(error).split())}') from error


def interrupt_once() -> None:
    """Let the first Ctrl-C raise KeyboardInterrupt, and none after it disturb the leaving.

    A program in a launch file gets one from the terminal and one from launch.
    """
    def interrupt(number: int, frame: object) -> NoReturn:
        undisturbed()
        raise KeyboardInterrupt

    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
        signal.signal(signal.SIGINT, interrupt)


def undisturbed() -> None:
    """Let SIGINT and SIGTERM do nothing from here on: what they ask for is being done."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: None)


def leave() -> None:
    """Shut rclpy down, undisturbed to the end of Python, which would bring back the defaults."""
    undisturbed()
    rclpy.try_shutdown()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
