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

"""ROS parameters from the option declarations: declared, validated, updated live.

One dataclass field is one parameter; its metadata is the descriptor. A value that does not fit
is remembered with the reason and fails the configuration, it never ends the process.
"""

from __future__ import annotations

from collections.abc import Callable
import dataclasses
import difflib
from typing import Any

from nccs_pose.errors import OptionError
from nccs_pose.options import check_value
from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.node import Node
from rclpy.parameter import Parameter

_OPEN = 1e300
"""Bound of a range that is open on this side."""


def descriptor(field: dataclasses.Field[Any]) -> ParameterDescriptor:
    """What `ros2 param describe` says of one option."""
    words = field.metadata
    unit = f' [{words["unit"]}]' if words['unit'] else ''
    result = ParameterDescriptor(
        name=field.name, description=words['doc'] + unit, read_only=not words['live'])
    if words['choices']:
        result.additional_constraints = 'one of: ' + ', '.join(words['choices'])
    low, high = words['low'], words['high']
    if low is not None or high is not None:
        if isinstance(field.default, int):
            result.integer_range = [IntegerRange(
                from_value=-2**63 if low is None else int(low),
                to_value=2**63 - 1 if high is None else int(high), step=0)]
        else:
            result.floating_point_range = [FloatingPointRange(
                from_value=-_OPEN if low is None else float(low),
                to_value=_OPEN if high is None else float(high), step=0.0)]
    return result


class NodeParameters:
    """A node's parameters as option values; `refused` says what did not fit.

    :ivar refused: reason by parameter name; not empty means that nothing can be configured.
    """

    def __init__(
        self, node: Node, groups: tuple[type, ...], apply: Callable[..., None] | None = None,
    ) -> None:
        """Declare everything.

        :param groups: dataclasses of options; their field names must not repeat.
        :param apply: called with one value of each group after a live change.
        """
        self._node = node
        self._groups = groups
        self._apply = apply
        self._fields = {
            field.name: field for group in groups for field in dataclasses.fields(group)}
        self.refused: dict[str, str] = {}
        self._overrides = dict(getattr(node, '_parameter_overrides', {}))
        for field in self._fields.values():
            self._declare(field)
        self._warn_of_unknown()
        node.add_pre_set_parameters_callback(self._integers_to_floats)
        node.add_on_set_parameters_callback(self._validate)
        node.add_post_set_parameters_callback(self._changed)

    def options(self) -> tuple[Any, ...]:
        """The present values, one of each group.

        :raises OptionError: naming a parameter and what is wrong with it.
        """
        if self.refused:
            raise OptionError('; '.join(self.refused.values()))
        return self._build({})

    def warn_of_unused(self) -> None:
        """Name every override of a quality of service that no topic has taken."""
        for name in self._overrides:
            if name.startswith('qos_overrides.') and not self._node.has_parameter(name):
                self._node.get_logger().warning(
                    f'parameter {name} has no effect: a topic is named in full, as it is remapped '
                    'to; reliability, depth and history can be set')

    def _declare(self, field: dataclasses.Field[Any]) -> None:
        value = field.default
        # As anything first: rclpy itself would die of a wrong type, an int for a float included.
        given = self._node.declare_parameter(
            field.name, value, ParameterDescriptor(dynamic_typing=True)).value
        self._node.undeclare_parameter(field.name)
        try:
            given = _as_declared(field, given)
            check_value(field, given)
            value = given
        except OptionError as error:
            self.refused[field.name] = str(error)
        self._node.declare_parameter(field.name, value, descriptor(field), ignore_override=True)

    def _build(self, changes: dict[str, Any]) -> tuple[Any, ...]:
        return tuple(
            group(**{
                field.name: changes.get(field.name, self._node.get_parameter(field.name).value)
                for field in dataclasses.fields(group)})
            for group in self._groups)

    def _integers_to_floats(self, parameters: list[Parameter]) -> list[Parameter]:
        """`ros2 param set ... 1` is meant for a float as well."""
        return [
            Parameter(p.name, value=float(p.value))
            if p.type_ == Parameter.Type.INTEGER and p.name in self._fields
            and isinstance(self._fields[p.name].default, float) else p
            for p in parameters]

    def _validate(self, parameters: list[Parameter]) -> SetParametersResult:
        try:
            changes = {p.name: p.value for p in parameters if p.name in self._fields}
            for name, value in changes.items():
                check_value(self._fields[name], value)
            # Others, as rclpy's own for a topic, are not to be refused for what is wrong here.
            if changes:
                self._build(changes)
        except OptionError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _changed(self, parameters: list[Parameter]) -> None:
        names = [p.name for p in parameters if p.name in self._fields]
        for name in names:
            self.refused.pop(name, None)
        if self._apply is not None and names and not self.refused:
            self._apply(*self._build({}))

    def _warn_of_unknown(self) -> None:
        for name in self._overrides:
            if not self._node.has_parameter(name) and not name.startswith('qos_overrides.'):
                near = difflib.get_close_matches(name, self._fields, n=1)
                hint = f'; did you mean {near[0]}?' if near else ''
                self._node.get_logger().warning(
                    f'parameter {name} is unknown and has no effect{hint}')


def _as_declared(field: dataclasses.Field[Any], value: Any) -> Any:
    """An int where a float is declared becomes one; everything else stays."""
    if isinstance(field.default, float) and type(value) is int:
        return float(value)
    return value
