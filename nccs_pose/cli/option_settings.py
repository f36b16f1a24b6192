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
"""`--option NAME=VALUE`: read by a dataclass of options, and explained from it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
import dataclasses
import textwrap
from typing import Any

from nccs_pose.errors import OptionError
from nccs_pose.options import check_value

Fields = Mapping[str, 'dataclasses.Field[Any]']
"""Options by name, declared by `nccs_pose.options.option`."""


def parse_settings(settings: Iterable[str], fields: Fields) -> dict[str, Any]:
    """Values by name, later ones over earlier ones.

    :param settings: ``NAME=VALUE``.
    :raises OptionError: if an option is not known or its value is not accepted.
    """
    values: dict[str, Any] = {}
    for setting in settings:
        name, equals, text = setting.partition('=')
        if not equals:
            raise OptionError(f'--option {setting}: must be NAME=VALUE.')
        if name not in fields:
            raise OptionError(
                f'--option {setting}: there is no option {name!r}; there are '
                f'{", ".join(fields)}.')
        try:
            values[name] = _parse(text, type(fields[name].default))
            check_value(fields[name], values[name])
        except OptionError as error:
            raise OptionError(f'--option {setting}: {error}.') from error
    return values


def explain(fields: Fields) -> str:
    """Each option, a number, with its default, unit and range, and what it is."""
    lines = []
    for name, field in fields.items():
        words = field.metadata
        unit = f' {words["unit"]}' if words['unit'] else ''
        allowed = f'{words["low"]:g} to {words["high"]:g}'
        lines.append(f'  {name}={field.default:g}{unit}  ({allowed})')
        lines += textwrap.wrap(words['doc'], 78, initial_indent=' ' * 6,
                               subsequent_indent=' ' * 6)
    return '\n'.join(lines)


def _parse(text: str, kind: type) -> Any:
    if kind is bool:
        if text.lower() not in ('true', 'false'):
            raise OptionError('must be true or false')
        return text.lower() == 'true'
    try:
        return kind(text)
    except ValueError as error:
        raise OptionError(f'{text!r} is no {kind.__name__}') from error
