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

"""The images that `calibrate` and `check` look at: of a bag or a folder, as many as are needed."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from nccs_pose.errors import FileError, VisionError
from nccs_pose.files.bags import BagReader, BagTopics, StampedImage
from nccs_pose.files.image_folder import image_files, read_images
from nccs_pose.geometry.camera import PinholeCamera
from nccs_pose.vision.decode import Image


class DriveImages:
    """Images of a drive, evenly spread over it; iterable again and again.

    :param path: a bag or a folder of images.
    :param most: at most so many.
    :param topic: the images' topic, if the bag has several.
    :raises FileError: if there is no image.
    """

    def __init__(self, path: Path, most: int, topic: str | None = None) -> None:
        self._path, self._topics = path, BagTopics(topic)
        self._files = image_files(path)
        if not path.exists():
            raise FileError(f'{path}: no such bag or folder of images.')
        if self._files:
            self.total = len(self._files)
        else:
            with BagReader(path, self._topics) as bag:
                self.total = bag.image_count()
        if not self.total:
            raise FileError(f'{path}: holds no image.')
        self._stride = -(-self.total // most)

    def check_size(self, camera: PinholeCamera) -> None:
        """Refuse a rig for images of another size, before anything is computed.

        :raises FileError: naming both sizes.
        """
        for _, image in self():
            height, width = image.shape[:2]
            if (width, height) != (camera.width, camera.height):
                raise FileError(
                    f'{self._path}: its images have {width} x {height} pixels, the rig is for '
                    f'{camera.width} x {camera.height}.')
            return
        raise FileError(f'{self._path}: holds no readable image.')

    def __call__(self) -> Iterator[tuple[int, Image]]:
        """Stamps (ns) and BGR images in their order; what cannot be decoded is left out."""
        if self._files:
            yield from read_images(self._files[::self._stride])
            return
        with BagReader(self._path, self._topics) as bag:
            events = (e for e in bag.events(odometry=False) if isinstance(e, StampedImage))
            for number, event in enumerate(events):
                if number % self._stride:
                    continue
                try:
                    yield event.stamp_ns, event.decode()
                except VisionError:
                    continue
