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

"""Opening a rosbag2, and saying in a sentence what is wrong with it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, ExitStack
from pathlib import Path
from typing import Any

from nccs_pose.errors import FileError
from nccs_pose.files.image_folder import image_files
from nccs_pose.files.rosbags_import import AnyReader, jazzy_typestore

_STORAGES = ('.mcap', '.db3')


def open_bag(path: Path, stack: ExitStack) -> Any:
    """A reader of rosbags, open until the stack is closed.

    :raises FileError: if there is no bag, or it cannot be read.
    """
    with in_words(path):
        if not path.exists():
            raise FileError(f'{path}: no such bag.')
        if not (path.is_dir() or path.is_file()):  # a pipe is waited for for ever
            raise FileError(f'{path}: is no bag: it is a pipe or a device.')
        if path.is_dir() and not (path / 'metadata.yaml').exists():
            raise FileError(f'{path}: {_without_metadata(path)}.')
        return stack.enter_context(AnyReader([path], default_typestore=jazzy_typestore()))


def _without_metadata(folder: Path) -> str:
    """What a folder is that has no metadata.yaml, and what can be done with it."""
    if image_files(folder):
        return ('is a folder of images, no bag: nothing says when they were taken '
                '(`nccs-pose calibrate` and `nccs-pose check` take such a folder)')
    files = sorted(p.name for p in folder.iterdir() if p.suffix in _STORAGES)
    if files:
        return (f'its recording was cut off: it has no metadata.yaml (`ros2 bag reindex` makes '
                f'one; {files[0]} can be given by itself if it is whole)')
    return 'is no bag: it has no metadata.yaml'


@contextmanager
def in_words(path: Path, what: str = 'the bag') -> Iterator[None]:
    """Say in one sentence what rosbags trips over.

    On a damaged file it raises whatever its parser met: its own errors, but also struct.error,
    AssertionError, TypeError, UnicodeDecodeError, MemoryError; none may reach the user.
    """
    try:
        yield
    except (FileError, GeneratorExit):
        raise
    except OSError as error:
        raise FileError(
            f'{error.filename or path}: cannot be read: {error.strerror or error}.') from error
    except Exception as error:
        reason = ' '.join(str(error).split()) or type(error).__name__
        raise FileError(
            f'{path}: {what} cannot be read, it may be cut short or damaged: '
            f'{reason.rstrip(".")}.') from error
