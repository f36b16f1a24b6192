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
"""Figures and images as files, the same bytes for the same content."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import cv2
from nccs_pose.errors import FileError
from nccs_pose.files.text_files import write_bytes
from nccs_pose.vision.decode import Image

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def as_title(path: str | Path) -> str:
    """A path as a figure can show it: in UTF-8, and no dollar begins a formula."""
    return str(path).encode('utf-8', 'backslashreplace').decode().replace('$', r'\$')


def save_figure(figure: Figure, path: str | Path) -> None:
    """Write a figure as PNG.

    :raises FileError: if the file cannot be written.
    """
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, format='png', metadata={'Software': None})
    except OSError as error:
        raise FileError(f'{path}: cannot be written: {error.strerror or error}.') from error


def save_image(image: Image, path: str | Path) -> None:
    """Write a BGR image as PNG or JPEG, by the name's ending.

    :raises FileError: if the file cannot be written, or the ending is another.
    """
    path = Path(path)
    if path.suffix.lower() not in ('.png', '.jpg', '.jpeg'):
        raise FileError(f'{path}: images are written as .png or .jpg.')
    write_bytes(path, cv2.imencode(path.suffix, image)[1].tobytes())
