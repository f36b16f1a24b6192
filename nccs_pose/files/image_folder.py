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

"""A folder of images as a drive: sorted by name, stamped by their number."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
from nccs_pose.errors import FileError, VisionError
from nccs_pose.files.text_files import read_bytes
from nccs_pose.vision.decode import decode_compressed, Image
import numpy as np
from numpy.typing import NDArray

SUFFIXES = ('.png', '.jpg', '.jpeg', '.bmp', '.tif', '.tiff')
_PERIOD_NS = 100_000_000  # between images that carry no time


def image_files(folder: str | Path) -> list[Path]:
    """The images of a folder, sorted by name; empty if it holds none, or is a bag or no folder.

    :raises FileError: if it cannot be read.
    """
    folder = Path(folder)
    try:
        # A bag stays one with the pictures that somebody made of it.
        if not folder.is_dir() or (folder / 'metadata.yaml').exists():
            return []
        return sorted(p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES)
    except OSError as error:
        raise FileError(f'{folder}: cannot be read: {error.strerror or error}.') from error


def read_images(files: list[Path]) -> Iterator[tuple[int, Image]]:
    """Stamps, in nanoseconds, and BGR images (H, W, 3).

    :raises FileError: naming a file that is no image.
    """
    for number, path in enumerate(files):
        data = np.frombuffer(read_bytes(path), dtype=np.uint8)
        try:
            image = _decode(data)
        except (VisionError, cv2.error) as error:
            words = ' '.join(str(error).split())
            raise FileError(f'{path}: is no readable image: {words}.') from error
        yield number * _PERIOD_NS, image


def _decode(data: NDArray[np.uint8]) -> Image:
    """As in a bag: whole, and as the pixels lie, however the camera was turned."""
    if data[:2].tobytes() in (b'\xff\xd8', b'\x89P'):
        return decode_compressed('', data)
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    image = cv2.imdecode(data, flags) if len(data) else None
    if image is None:
        raise VisionError('its content is none that OpenCV reads')
    return np.asarray(image, np.uint8)
