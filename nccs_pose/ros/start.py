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

"""Initialising ROS, with words instead of a traceback where it cannot be; and leaving it.

SIGINT, SIGTERM and SIGHUP are noted, and a program ends where it looks whether it was told to.
rclpy's own handlers are not installed: they shut ROS down from another thread, while the main
thread may be in the middle of making, using or destroying what is taken away.
"""

from __future__ import annotations

from collections.abc import Sequence
import os
from pathlib import Path
import signal
import tempfile

from nccs_pose.errors import NccsPoseError
from nccs_pose.ros.end_signals import handle_end_signals
import rclpy
from rclpy.signals import SignalHandlerOptions

LOG_VARIABLES = ('ROS_LOG_DIR', 'ROS_HOME', 'HOME')
"""Any of these says where ROS logs to; without one it does not start."""


class StartError(NccsPoseError):
    """ROS arguments or an environment with which ROS does not start."""


def initialise(args: Sequence[str] | None = None) -> None:
    """Initialise rclpy; from here on the signals that end it are noted, see `told_to_end`.

    Where nothing says where to log to, as for a service manager's programs without HOME, it is
    logged to the temporary folder.

    :param args: command line, None for the program's own.
    :raises StartError: e.g. for a parameter file that is not there.
    """
    handle_end_signals(_note)
    if not any(os.environ.get(name) for name in LOG_VARIABLES):
        os.environ['ROS_LOG_DIR'] = str(Path(tempfile.gettempdir(), f'ros_log_{os.getuid()}'))
    try:
        rclpy.init(args=None if args is None else list(args),
                   signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as error:  # base of every RCLError
        raise StartError(f'cannot start: {" ".join(str(error).split())}') from error


def told_to_end() -> bool:
    """Whether a signal that ends it came since ROS was initialised.

    However often: in a launch file one Ctrl-C comes from the terminal and one from launch.
    """
    return bool(_noted)


def leave() -> None:
    """Shut rclpy down; no signal disturbs the end of Python, which brings back the defaults."""
    handle_end_signals(signal.SIG_IGN)
    rclpy.try_shutdown()


_noted: list[int] = []


def _note(number: int, frame: object) -> None:
    _noted.append(number)
