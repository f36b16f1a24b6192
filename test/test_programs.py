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

"""The programs where something that they need is not installed."""

from __future__ import annotations

import importlib.util
from pathlib import Path
import subprocess
import sys

import pytest

REPO = Path(__file__).resolve().parents[1]


def said_without(package: str, program: str, *arguments: str) -> str:
    """What a program says that ends for want of a package."""
    code = (f'import sys; sys.modules[{package!r}] = None; from nccs_pose.ros.programs import '
            f'{program}; sys.exit({program}())')
    run = subprocess.run([sys.executable, '-c', code, *arguments], cwd=REPO, capture_output=True,
                         text=True)
    assert run.returncode == 2
    assert run.stderr.count('\n') == 1, run.stderr
    assert run.stderr.startswith(f'{program}: ')
    return run.stderr


@pytest.mark.parametrize(('program', 'arguments'), [
    ('demo', ('--help',)), ('localiser', ()), ('play', ('--help',)), ('stand_in_camera', ()),
    ('stream_benchmark', ('--help',))])
def test_a_program_without_ros_says_so(program: str, arguments: tuple[str, ...]) -> None:
    assert 'it belongs to ROS 2 Jazzy' in said_without('rclpy', program, *arguments)


@pytest.mark.skipif(importlib.util.find_spec('rclpy') is None, reason='no rclpy')
@pytest.mark.parametrize(('package', 'programs', 'words'), [
    ('rosbags', ('demo', 'play'), 'pip install "rosbags'),
    ('cv2', ('localiser', 'stand_in_camera', 'stream_benchmark'),
     "needs the Python package cv2: pip install 'nccs_pose[pip]' brings it."),
])
def test_a_program_without_a_package_names_it(
        package: str, programs: tuple[str, ...], words: str) -> None:
    for program in programs:
        assert words in said_without(package, program)
