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

"""Entry points of the programs: a missing package is said in one sentence.

Nothing is imported here that may be missing. With `python -m` a module is run without this.
"""

from __future__ import annotations

import importlib
import sys

from nccs_pose.errors import NccsPoseError
from nccs_pose.missing_package import missing_package


def demo() -> int:
    """Run `ros2 run nccs_pose demo`."""
    return _run('demo', 'demo')


def localiser() -> int:
    """Run `ros2 run nccs_pose localiser`."""
    return _run('localiser', 'localiser')


def play() -> int:
    """Run `ros2 run nccs_pose play BAG`."""
    return _run('play', 'player')


def stand_in_camera() -> int:
    """Run `ros2 run nccs_pose stand_in_camera`."""
    return _run('stand_in_camera', 'stand_in_camera')


def stream_benchmark() -> int:
    """Run `ros2 run nccs_pose stream_benchmark`."""
    return _run('stream_benchmark', 'stream_benchmark')


def _run(program: str, module: str) -> int:
    try:
        code: int = importlib.import_module(f'nccs_pose.ros.{module}').main()
        return code
    except ModuleNotFoundError as error:
        words = missing_package(error)
    except NccsPoseError as error:  # so the readers of bags say it of rosbags
        words = str(error)
    print(f'{program}: {words}', file=sys.stderr)
    return 2
