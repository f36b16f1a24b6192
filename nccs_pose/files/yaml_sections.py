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
"""Strict YAML: every key asked for by name, every value checked, the rest refused.

Scalars are read by YAML 1.2's core rules, not PyYAML's YAML 1.1: `1e-3` is a number, `no` and
`on` are words, `1:30` is a word and not ninety. A key given twice is refused.
"""

from __future__ import annotations

from collections.abc import Sequence
from difflib import get_close_matches
import math
from pathlib import Path
import re
from typing import Any

from nccs_pose.errors import FileError
from nccs_pose.files.text_files import read_text
import numpy as np
import yaml

FARTHEST = 1e7
"""What no number of a file exceeds. In metres from the map's origin it is enough for any grid on
the earth, and too little for millimetres."""

_REQUIRED: Any = object()
_LARGEST = 2**23  # bytes; a map of a thousand lines has a hundredth of it


class _CoreLoader(yaml.SafeLoader):
    """SafeLoader with the scalars of YAML 1.2's core schema and no duplicated keys."""

    yaml_implicit_resolvers: dict = {}  # noqa: RUF012 (PyYAML's own class attribute)

    def construct_mapping(self, node: Any, deep: bool = False) -> dict:
        seen = set()
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=True)
            if not isinstance(key, str):
                raise yaml.constructor.ConstructorError(
                    None, None, f'the key {key!r} is not a word', key_node.start_mark
                )
            if key in seen:
                raise yaml.constructor.ConstructorError(
                    None, None, f'the key {key!r} is given twice', key_node.start_mark
                )
            seen.add(key)
        return super().construct_mapping(node, deep=deep)


def _resolve(tag: str, pattern: str, first: str) -> None:
    _CoreLoader.add_implicit_resolver(
        f'tag:yaml.org,2002:{tag}', re.compile(pattern), list(first)
    )


_resolve('null', r'^(?:~|null|Null|NULL|)$', '~nN')
_CoreLoader.yaml_implicit_resolvers.setdefault('', []).append(
    ('tag:yaml.org,2002:null', re.compile(r'^$'))
)
_resolve('bool', r'^(?:true|True|TRUE|false|False|FALSE)$', 'tTfF')
_resolve('int', r'^[-+]?(?:0|[1-9][0-9]*)$', '-+0123456789')
_resolve(
    'float',
    r'^(?:[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?'
    r'|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))$',
    '-+.0123456789',
)


def read_yaml(path: str | Path) -> Section:
    """Read a YAML file whose top is a mapping.

    :raises FileError: the file cannot be read, is no YAML, or its top is no mapping; names the
        file and line.
    """
    path = Path(path)
    text = read_text(path, _LARGEST)
    try:
        content = yaml.load(text, Loader=_CoreLoader)  # a SafeLoader
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = f', line {mark.line + 1}' if mark else ''
        raise FileError(f'{path}{line}: {error.problem or error.context}.') from error
    except (yaml.YAMLError, RecursionError, ValueError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise FileError(f'{path}: is no YAML: {reason}.') from error
    if not isinstance(content, dict):
        raise FileError(f'{path}: must hold keys and values, it holds {describe(content)}.')
    return Section(path, '', content)


def describe(value: Any) -> str:
    """Say what a value is, for a message: the value itself, shortened."""
    if value is None:
        return 'nothing'
    text = repr(value)
    return text if len(text) <= 60 else f'{text[:57]}...'


class Section:
    """One mapping of a YAML file: values are asked for by key, `done` refuses what is left.

    Every error is a FileError that names the file, the key's path, the value and what is accepted.
    """

    def __init__(self, source: Path, path: str, content: dict[str, Any]) -> None:
        self.source = source
        self.path = path
        self._content = content
        self._known: list[str] = []

    def key(self, key: str) -> str:
        """Return the path of `key` from the file's top, as messages name it."""
        return f'{self.path}.{key}' if self.path else key

    def error(self, key: str, reason: str) -> FileError:
        """Return (not raise) the error that says `reason` about `key`."""
        where = self.key(key) if key else self.path
        return FileError(f'{self.source}: {where}{" " if where else ""}{reason}.')

    def names(self) -> list[str]:
        return list(self._content)

    def content(self) -> dict[str, Any]:
        """All of it as plain values, unchecked."""
        return dict(self._content)

    def value(self, key: str, default: Any = _REQUIRED, accepted: str = 'a value') -> Any:
        self._known.append(key)
        if key in self._content:
            return self._content[key]
        if default is _REQUIRED:
            unread = [name for name in self._content if name not in self._known]
            close = get_close_matches(key, unread, n=1)
            raise self.error(
                key, f'is missing: it must be {accepted}'
                + (f' (is {self.key(close[0])} meant?)' if close else ''))
        return default

    def section(self, key: str) -> Section:
        value = self.value(key, accepted='a mapping of keys to values')
        if not isinstance(value, dict):
            raise self.error(key, f'must be a mapping of keys to values, not {describe(value)}')
        return Section(self.source, self.key(key), value)

    def sections(self, key: str) -> list[Section]:
        accepted = 'a list of mappings'
        value = self.value(key, accepted=accepted)
        if not isinstance(value, list):
            raise self.error(key, f'must be {accepted}, not {describe(value)}')
        for index, item in enumerate(value):
            if not isinstance(item, dict):
                raise self.error(f'{key}[{index}]', f'must be a mapping, not {describe(item)}')
        return [
            Section(self.source, self.key(f'{key}[{index}]'), item)
            for index, item in enumerate(value)
        ]

    def number(
        self, key: str, default: Any = _REQUIRED, unit: str = '', above: float | None = None,
        low: float | None = None,
    ) -> Any:
        accepted = 'a number'
        accepted += f' in {unit}' if unit else ''
        accepted += f' above {above:g}' if above is not None else ''
        accepted += f', at least {low:g}' if low is not None else ''
        value = self.value(key, default, accepted)
        if value is default and key not in self._content:
            return default
        number = self._finite(key, value, accepted)
        if (above is not None and number <= above) or (low is not None and number < low):
            raise self.error(key, f'must be {accepted}, not {describe(value)}')
        return number

    def count(self, key: str, most: int) -> int:
        accepted = f'a whole number from 1 to {most}'
        value = self.value(key, accepted=accepted)
        if not isinstance(value, int) or isinstance(value, bool) or not 1 <= value <= most:
            raise self.error(key, f'must be {accepted}, not {describe(value)}')
        return value

    def text(self, key: str, default: str, choices: Sequence[str] = ()) -> str:
        accepted = f'one of {", ".join(choices)}' if choices else 'a word'
        value = self.value(key, default, accepted)
        if not isinstance(value, str) or not value or (choices and value not in choices):
            quote = ' (put it in quotes)' if isinstance(value, (int, float)) else ''
            raise self.error(key, f'must be {accepted}, not {describe(value)}{quote}')
        return value

    def numbers(
        self, key: str, lengths: Sequence[int], default: Any = _REQUIRED, unit: str = ''
    ) -> np.ndarray:
        """Read a flat list of finite numbers, (n,) with n one of `lengths`."""
        counts = ' or '.join(str(length) for length in lengths)
        accepted = f'a list of {counts} numbers' + (f' in {unit}' if unit else '')
        value = self.value(key, default, accepted)
        if not isinstance(value, (list, tuple)):
            raise self.error(key, f'must be {accepted}, not {describe(value)}')
        if len(value) not in lengths:
            raise self.error(key, f'must be {accepted}, it has {len(value)}: {describe(value)}')
        items = [self._finite(f'{key}[{i}]', item, 'a number') for i, item in enumerate(value)]
        return np.array(items, dtype=float)

    def rotation(self, key: str) -> np.ndarray:
        """Read nine numbers, row by row, that are a rotation: (3, 3)."""
        matrix = self.numbers(key, (9,)).reshape(3, 3)
        error = float(np.abs(matrix @ matrix.T - np.eye(3)).max())
        if error > 1e-6:
            raise self.error(
                key,
                'must be a rotation matrix (rows of length one, at right angles, to 1e-6): '
                f'R times its transpose is off by {error:.2g}',
            )
        if np.linalg.det(matrix) < 0.0:
            raise self.error(
                key, 'must be a rotation matrix, this one mirrors: its determinant is -1, not +1'
            )
        return matrix

    def done(self) -> None:
        """Refuse the keys that nobody asked for."""
        for key in self._content:
            if key not in self._known:
                close = get_close_matches(key, self._known, n=1)
                hint = f'did you mean {close[0]!r}? ' if close else ''
                raise self.error(
                    key, f'is an unknown key: {hint}Known here: {", ".join(self._known)}'
                )

    def _finite(self, key: str, value: Any, accepted: str) -> float:
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise self.error(key, f'must be {accepted}, not {describe(value)}')
        try:
            number = float(value)
        except OverflowError:
            number = math.inf
        if not math.isfinite(number):
            raise self.error(key, f'must be {accepted}, finite, not {describe(value)}')
        if abs(number) > FARTHEST:
            raise self.error(
                key, f'must be {accepted} of at most {FARTHEST:g} in size, not {describe(value)}')
        return number
