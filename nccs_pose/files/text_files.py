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
"""Files read whole and written whole; whatever is wrong with one is said in a sentence."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
import errno
import os
from pathlib import Path
import stat

from nccs_pose.errors import FileError

# Linux follows no more; links that lead round in a circle would never end.
_MOST_LINKS = 40
LARGEST = 2**28
"""Bytes of a file that is read whole: a day of poses, hundreds of megapixels."""


def read_bytes(path: str | Path, most: int = LARGEST) -> bytes:
    """Read a whole file.

    A pipe that nobody writes to would be waited for for ever, and a device may have no end.

    :param most: bytes that it may hold.
    :raises FileError: if it cannot be read, is no regular file or is too large; its cause is the
        OSError, if there was one.
    """
    path = Path(path)
    try:
        with open(path, 'rb', opener=_without_waiting) as file:
            if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
                raise FileError(f'{path}: cannot be read: it is a pipe or a device, no file.')
            content = file.read(most + 1)
    except OSError as error:
        raise FileError(f'{path}: cannot be read: {error.strerror or error}.') from error
    if len(content) > most:
        raise FileError(f'{path}: cannot be read: it has more than {most} bytes.')
    return content


def read_text(path: str | Path, most: int = LARGEST) -> str:
    """Read a whole file of UTF-8 text, with every kind of newline as one.

    :raises FileError: as `read_bytes`, and if it is no UTF-8.
    """
    try:
        text = read_bytes(path, most).decode('utf-8')
    except UnicodeDecodeError as error:
        raise FileError(f'{path}: cannot be read: it is not UTF-8 text.') from error
    return text.replace('\r\n', '\n').replace('\r', '\n')


def write_text(path: str | Path, text: str) -> None:
    """Write `text` (UTF-8, newlines as they are) as :func:`write_bytes` does.

    What UTF-8 cannot say, as of a file's name in another encoding, is written as an escape.

    :raises FileError: the file cannot be written; names it and the reason.
    """
    write_bytes(path, text.encode('utf-8', 'backslashreplace'))


def write_bytes(path: str | Path, content: bytes) -> None:
    """Write a whole file, replacing what was there in one step.

    A reader, or a run that is interrupted, never sees half of it. Missing folders are made. A link
    stays one: what it leads to is replaced.

    :raises FileError: the file cannot be written; names it and the reason.
    """
    path = Path(path)
    target = Path(os.path.realpath(path))
    temporary = _temporary(target)
    try:
        _make_folder(target)
        in_place = _is_no_file(path)
        with open(path if in_place else temporary, 'wb', opener=_without_waiting) as file:
            file.write(content)
        if not in_place:
            os.replace(temporary, target)
    except OSError as error:
        with suppress(OSError):
            temporary.unlink()
        raise FileError(f'{path}: cannot be written: {error.strerror or error}.') from error


def check_writable(path: str | Path, inputs: Iterable[Path | None] = ()) -> None:
    """Refuse a path that :func:`write_text` could not write, before long work and not after it.

    :param inputs: files that the work reads, if they are given: none of them is replaced.
    :raises FileError: if it is a folder or an input, or its own folder cannot be made or written.
    """
    path = Path(path)
    try:
        if path.is_dir():
            raise FileError(f'{path}: cannot be written: it is a folder.')
        if path.is_file() and any(
                each is not None and each.exists() and path.samefile(each) for each in inputs):
            raise FileError(f'{path}: cannot be written: it is read, and would be lost.')
        target = Path(os.path.realpath(path))
        _make_folder(target)
        if _is_no_file(path):
            if not os.access(path, os.W_OK):
                raise FileError(f'{path}: cannot be written: Permission denied.')
            return
        temporary = _temporary(target)
        temporary.touch()
        temporary.unlink()
    except OSError as error:
        raise FileError(f'{path}: cannot be written: {error.strerror or error}.') from error


def _without_waiting(path: str, flags: int) -> int:
    """Open a file; a pipe does not wait until somebody opens its other end."""
    descriptor = os.open(path, flags | os.O_NONBLOCK, 0o666)
    os.set_blocking(descriptor, True)
    return descriptor


def _is_no_file(path: Path) -> bool:
    """Whether a path leads to what is never to be replaced.

    That is a pipe or a device, or a file that a process has open, as /dev/stdout may lead to.
    """
    if path.exists() and not path.is_file():
        return True
    for _ in range(_MOST_LINKS):
        if not path.is_symlink():
            break
        path = path.parent / os.readlink(path)
        if path.parts[:2] == ('/', 'proc'):
            return True
    return False


def _make_folder(path: Path) -> None:
    """Make the folder of a file, if there is none.

    :raises OSError: if it cannot be made.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except FileExistsError as error:
        raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR)) from error


def _temporary(path: Path) -> Path:
    """Where a file is written before it takes its name, in the same folder."""
    return path.with_name(f'.{path.name}.{os.getpid()}.part')
