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

from nccs_pose.cli.option_settings import parse_settings
from nccs_pose.errors import FileError, OptionError
from nccs_pose.estimation.options import LocaliserOptions
from nccs_pose.files.parameter_files import load_parameters
from nccs_pose.node_options import NodeOptions
from nccs_pose.options import check_value

_FIELDS = {field.name: field for field in dataclasses.fields(LocaliserOptions)}
_FRAMES = ('odom_frame', 'base_frame', 'frame_prefix')


def make_options(parameter_file: Path | None, settings: Iterable[str]) -> LocaliserOptions:
    """Options of the localiser: its defaults, then a parameter file, then `--option`s.

    :param settings: ``NAME=VALUE``.
    :raises FileError: if the file has a parameter that is not known or not accepted.
    :raises OptionError: if a setting is not known or not accepted.
    """
    values = _from_file(parameter_file) if parameter_file is not None else {}
    return LocaliserOptions(**(values | parse_settings(settings, _FIELDS)))


def odometry_frames(parameter_file: Path | None) -> tuple[str, str]:
    """In which frame, and of which, the node takes odometry: its defaults, or as a file says.

    :raises FileError: if the file names no frames.
    """
    given = load_parameters(parameter_file) if parameter_file is not None else {}
    frames = {name: given[name] for name in _FRAMES if name in given}
    try:
        node = NodeOptions(**frames)
    except OptionError as error:
        raise FileError(f'{parameter_file}: {error}.') from error
    return node.odom, node.base


def _from_file(path: Path) -> dict[str, Any]:
    """The localiser's part of the node's parameters; what is the node's own is left to it."""
    own = {field.name for field in dataclasses.fields(NodeOptions)}
    values: dict[str, Any] = {}
    for name, value in load_parameters(path).items():
        if name in _FIELDS:
            try:
                check_value(_FIELDS[name], value)
            except OptionError as error:
                raise FileError(f'{path}: {error}.') from error
            # as ROS users write it: 1 where a float is meant
            is_float = isinstance(_FIELDS[name].default, float)
            values[name] = float(value) if is_float else value
        elif name not in own and not name.startswith(('use_sim_time', 'qos_overrides')):
            raise FileError(f'{path}: {name} is no parameter of the localiser.')
    return values
