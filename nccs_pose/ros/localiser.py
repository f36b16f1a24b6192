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

"""Entry point of `ros2 run nccs_pose localiser`.

Light on purpose: SIGINT, SIGTERM and SIGHUP end the program with exit code 0 from here on, also
during the second that the imports of the node take.
"""

from __future__ import annotations

import os
import sys
from typing import Any, NoReturn

from nccs_pose.ros.end_signals import handle_end_signals


def main() -> int:
    """Run the node until it is told to stop."""
    handle_end_signals(_leave)
    from nccs_pose.estimation.options import LocaliserOptions
    from nccs_pose.node_options import NodeOptions
    from nccs_pose.ros.command_line import read_command_line

    read_command_line(
        'localiser', 'Localise a robot from images of floor lines in a curved mirror.',
        NodeOptions, LocaliserOptions)
    from nccs_pose.ros.localiser_node import make_node
    from nccs_pose.ros.spinning import run

    return run(make_node)


def _leave(number: int, frame: Any) -> NoReturn:
    """Nothing is to be cleaned up yet, and some imports make an ImportError of an exception."""
    os._exit(0)


if __name__ == '__main__':
    sys.exit(main())
