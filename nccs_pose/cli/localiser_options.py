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
"""The localiser's options from the command line and from the node's parameter file."""

from __future__ import annotations

from collections.abc import Iterable
import dataclasses
from pathlib import Path
from typing import Any

from nccs_pose.errors import FileError, OptionError
from nccs_pose.estimation.options import LocaliserOptions
from nccs_pose.files.parameter_files import load_parameters
from nccs_pose.ros.node_options import NodeOptions

_FIELDS = {field.name: field for field in dataclasses.fields(LocaliserOptions)}


def make_options(parameter_file: Path | None, settings: Iterable[str]) -> LocaliserOptions:
    """Options of the localiser: its defaults, then a parameter file, then `--option`s.

    :param settings: ``NAME=VALUE``.
    :raises FileError: if an option is not known or its value is not accepted.
    """
    values: dict[str, Any] = {}
    if parameter_file is not None:
        values |= _from_file(parameter_file)
    for setting in settings:
        name, _, text = setting.partition('=')
        if name not in _FIELDS:
            raise FileError(
                f'--option {setting}: there is no option {name!r}; there are '
                f'{", ".join(_FIELDS)}.')
        values[name] = _parse(setting, text, _FIELDS[name].default)
    try:
        return LocaliserOptions(**values)
    except OptionError as error:
        source = f'{parameter_file}: ' if parameter_file is not None else ''
        raise FileError(f'{source}{error}.') from error


def _from_file(path: Path) -> dict[str, Any]:
    """The localiser's part of the node's parameters; what is the node's own is left to it."""
    own = {field.name for field in dataclasses.fields(NodeOptions)}
    values = {}
    for name, value in load_parameters(path, 'localiser').items():
        if name in _FIELDS:
            # as ROS users write it: 1 where a float is meant
            is_float = isinstance(_FIELDS[name].default, float)
            values[name] = float(value) if is_float and type(value) is int else value
        elif name not in own and not name.startswith(('use_sim_time', 'qos_overrides')):
            raise FileError(f'{path}: {name} is no parameter of the localiser.')
    return values


def _parse(setting: str, text: str, default: Any) -> Any:
    kind = type(default)
    if kind is bool:
        if text.lower() not in ('true', 'false'):
            raise FileError(f'--option {setting}: must be true or false.')
        return text.lower() == 'true'
    try:
        return kind(text)
    except ValueError as error:
        raise FileError(f'--option {setting}: must be a {kind.__name__}.') from error
