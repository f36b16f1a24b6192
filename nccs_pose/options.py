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

"""Options declared once: default, range, unit and words in the field's own metadata.

ROS parameters, validation and the reference page are all derived from these declarations.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

from nccs_pose.errors import OptionError


def option(
    default: Any,
    *,
    doc: str,
    unit: str = '',
    low: float | None = None,
    high: float | None = None,
    choices: tuple[str, ...] = (),
    live: bool = False,
) -> Any:
    """Declare a dataclass field as an option.

    :param doc: one sentence for the reference page and the ROS parameter descriptor.
    :param unit: unit of a number, e.g. ``m``, ``rad``, ``px``.
    :param low: smallest value allowed (inclusive).
    :param high: largest value allowed (inclusive).
    :param choices: the words allowed, for a string.
    :param live: may change while the node runs.
    """
    metadata = {
        'doc': doc, 'unit': unit, 'low': low, 'high': high, 'choices': choices, 'live': live,
    }
    return dataclasses.field(default=default, metadata=metadata)


def check_options(instance: Any) -> None:
    """Refuse a value outside its declaration; call it from ``__post_init__``.

    :raises OptionError: naming the option, its value and what is allowed.
    """
    for field in dataclasses.fields(instance):
        if 'doc' in field.metadata:
            check_value(field, getattr(instance, field.name))


def check_value(field: dataclasses.Field[Any], value: Any) -> None:
    """Check one value against its field's declaration.

    :raises OptionError: naming the option, its value and what is allowed.
    """
    expected = type(field.default)
    accepted = (int, float) if expected is float else (expected,)
    # bool is an int to Python, but 'true' is no number to a user.
    if not isinstance(value, accepted) or isinstance(value, bool) != (expected is bool):
        raise OptionError(
            f'{field.name} = {value!r}: expected {expected.__name__}, got {type(value).__name__}')
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        low, high = field.metadata['low'], field.metadata['high']
        # An int is finite, however long; a float may not hold it.
        if isinstance(value, float) and not math.isfinite(value):
            raise OptionError(f'{field.name} = {value!r}: must be finite')
        if (low is not None and value < low) or (high is not None and value > high):
            unit = f' {field.metadata["unit"]}' if field.metadata['unit'] else ''
            raise OptionError(
                f'{field.name} = {value!r}{unit}: must lie in '
                f'[{"-inf" if low is None else low}, {"inf" if high is None else high}]')
    choices = field.metadata['choices']
    if choices and value not in choices:
        raise OptionError(f'{field.name} = {value!r}: must be one of {", ".join(choices)}')
