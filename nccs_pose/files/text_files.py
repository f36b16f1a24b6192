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
"""Text written whole or not at all."""

from __future__ import annotations

from contextlib import suppress
import os
from pathlib import Path

from nccs_pose.errors import FileError


def write_text(path: str | Path, text: str) -> None:
    """Write `text` (UTF-8, newlines as they are), replacing the file in one step.

    A reader, or a run that is interrupted, never sees half of it. Missing folders are made.

    :raises FileError: the file cannot be written; names it and the reason.
    """
    path = Path(path)
    temporary = path.with_name(f'.{path.name}.{os.getpid()}.part')
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.exists() and not path.is_file():  # a pipe, /dev/null: never to be replaced
            temporary = path
        with temporary.open('w', encoding='utf-8', newline='') as file:
            file.write(text)
        if temporary != path:
            os.replace(temporary, path)
    except OSError as error:
        if temporary != path:
            with suppress(OSError):
                temporary.unlink()
        raise FileError(f'{path}: cannot be written: {error.strerror or error}.') from error


def check_writable(path: str | Path) -> None:
    """Refuse a path that :func:`write_text` could not write, before long work and not after it.

    :raises FileError: if it is a folder, or its own folder cannot be made or written.
    """
    path = Path(path)
    if path.is_dir():
        raise FileError(f'{path}: cannot be written: it is a folder.')
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FileError(f'{path}: cannot be written: {error.strerror or error}.') from error
    if not os.access(path.parent, os.W_OK):
        raise FileError(f'{path}: cannot be written: its folder is read-only.')
