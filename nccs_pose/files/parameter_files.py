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
"""ROS parameter files, read without ROS: the same file configures the node and a replay."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from nccs_pose.files.yaml_sections import read_yaml, Section

_NODE = 'localiser'
_PARAMETERS = 'ros__parameters'
_DEEPEST = 5  # namespaces in one another; a mapping of YAML may hold itself


def load_parameters(path: str | Path) -> dict[str, Any]:
    """Read the parameters that a file gives to the node `localiser`, whatever its namespace.

    Sections `<namespace>/localiser` and those for every node (`/**`) are taken, later ones over
    earlier ones; a namespace may also be a mapping around its nodes, as ROS reads it.

    :raises FileError: if the file has no such section, or is no parameter file.
    """
    top = read_yaml(path)
    found: dict[str, Any] | None = None
    others = []
    for around, key in _nodes(top, _DEEPEST):
        if key.rsplit('/', 1)[-1] in (_NODE, '*', '**'):
            section = around.section(key)
            found = {**(found or {}), **section.section(_PARAMETERS).content()}
            section.done()
        else:
            others.append(around.key(key))
    if found is None:
        raise top.error(
            _NODE, f'is missing: there are only parameters of {", ".join(others) or "nothing"}')
    return found


def _nodes(around: Section, deepest: int) -> Iterator[tuple[Section, str]]:
    """Each node of a file: the mapping that it stands in, and its key there."""
    for key, value in around.content().items():
        if _is_namespace(value, deepest):
            yield from _nodes(around.section(key), deepest - 1)
        else:
            yield around, key


def _is_namespace(value: Any, deepest: int) -> bool:
    """Whether it is no node, but nodes stand in it."""
    return isinstance(value, dict) and _PARAMETERS not in value and deepest > 0 and any(
        isinstance(inner, dict) and (_PARAMETERS in inner or _is_namespace(inner, deepest - 1))
        for inner in value.values())
