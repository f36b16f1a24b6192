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
"""How far long work has come, on stderr: a line that moves on a terminal, a line now and then."""

from __future__ import annotations

import sys
import time
from types import TracebackType

_TERMINAL_PERIOD = 0.1
_PLAIN_PERIOD = 5.0


class Progress:
    """Counts steps; use it as a context manager.

    Work that is over within the first seconds prints nothing unless on a terminal.

    :param total: number of steps to come.
    :param what: what is counted, e.g. ``frames``.
    """

    def __init__(self, total: int, what: str) -> None:
        self._total, self._what = total, what
        self._stream = sys.stderr
        self._moves = self._stream.isatty()
        self._period = _TERMINAL_PERIOD if self._moves else _PLAIN_PERIOD
        self._start = self._last = time.monotonic()
        self._done = 0
        self._width = 0

    def __enter__(self) -> Progress:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if self._moves and self._width:
            print('\r' + ' ' * self._width + '\r', end='', file=self._stream, flush=True)

    def step(self, note: str = '') -> None:
        """Count one step; `note` is shown behind the count."""
        self._done += 1
        now = time.monotonic()
        if now - self._last < self._period:
            return
        self._last = now
        left = (now - self._start) / self._done * max(0, self._total - self._done)
        text = f'{self._done}/{self._total} {self._what}, {left:.0f} s to go'
        text += f'  {note}' if note else ''
        if self._moves:
            print('\r' + text.ljust(self._width), end='', file=self._stream, flush=True)
            self._width = max(self._width, len(text))
        else:
            print(text, file=self._stream, flush=True)
