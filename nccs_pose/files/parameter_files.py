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

from pathlib import Path
from typing import Any

from nccs_pose.files.yaml_sections import read_yaml

_NODE = 'localiser'


def load_parameters(path: str | Path) -> dict[str, Any]:
    """Read the parameters that a file gives to the node `localiser`, whatever its namespace.

    Sections `<namespace>/localiser` and those for every node (`/**`) are taken, later ones over
    earlier ones.

    :raises FileError: if the file has no such section, or is no parameter file.
    """
    top = read_yaml(path)
    found: dict[str, Any] | None = None
    for key in top.names():
        if key.rsplit('/', 1)[-1] in (_NODE, '*', '**'):
            section = top.section(key)
            found = {**(found or {}), **section.section('ros__parameters').content()}
            section.done()
    if found is None:
        others = ', '.join(top.names()) or 'nothing'
        raise top.error(_NODE, f'is missing: there are only parameters of {others}')
    return found
