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

"""The arguments of a launch file, read from its text: the launch package is not on PyPI."""

from __future__ import annotations

import ast
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class LaunchArgument:
    """What a DeclareLaunchArgument says; a path of substitutions has its names in brackets."""

    name: str
    default: str
    doc: str


def launch_arguments(file: Path) -> tuple[str, list[LaunchArgument]]:
    """What a launch file says of itself, and its arguments."""
    tree = ast.parse(file.read_text(encoding='utf-8'))
    calls = [
        node for node in ast.walk(tree)
        if isinstance(node, ast.Call) and ast.unparse(node.func) == 'DeclareLaunchArgument']
    return ast.get_docstring(tree) or '', [_argument(call) for call in calls]


def _argument(call: ast.Call) -> LaunchArgument:
    named = {keyword.arg: keyword.value for keyword in call.keywords}
    return LaunchArgument(
        _text(call.args[0]), _text(named['default_value']), _text(named['description']))


def _text(value: ast.expr) -> str:
    if isinstance(value, ast.Constant):
        return str(value.value)
    if isinstance(value, ast.Call):  # PathJoinSubstitution([share, 'config', 'robot.yaml'])
        return _text(value.args[0])
    if isinstance(value, ast.List):
        return '/'.join(_text(element) for element in value.elts)
    return f'<{ast.unparse(value)}>'
