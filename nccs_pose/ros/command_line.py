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

"""The command line of a node that has no arguments but ROS's own."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
import dataclasses
import sys
import textwrap

USAGE = '%(prog)s [-h] [--ros-args [-p NAME:=VALUE] [--params-file FILE] [-r TOPIC:=OTHER]]'


def read_command_line(
    program: str, about: str, *groups: type, argv: Sequence[str] | None = None,
) -> None:
    """Print usage and parameters when asked to, and refuse what only looks like an argument.

    Then the program ends, with exit code 0 or 2. ROS's arguments are left to ROS, which this does
    not need.

    :param groups: dataclasses of options: the node's parameters.
    :param argv: arguments, None for the program's own.
    """
    arguments = sys.argv[1:] if argv is None else argv
    parser = argparse.ArgumentParser(
        program, USAGE, about, _parameters(groups),
        formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.parse_args(without_ros(arguments))


def without_ros(arguments: Sequence[str]) -> list[str]:
    """Arguments without those from each `--ros-args` to `--`, or to the end."""
    own, is_ros = [], False
    for argument in arguments:
        if argument == '--ros-args':
            is_ros = True
        elif is_ros:
            is_ros = argument != '--'
        else:
            own.append(argument)
    return own


def _parameters(groups: Sequence[type]) -> str:
    rows = ['parameters:']
    for field in (field for group in groups for field in dataclasses.fields(group)):
        words = field.metadata
        unit = f' {words["unit"]}' if words['unit'] else ''
        rows.append(f'  {field.name} ({field.default!r}{unit})')
        rows += textwrap.wrap(
            words['doc'], 79, initial_indent=' ' * 6, subsequent_indent=' ' * 6)
    return '\n'.join(rows)
