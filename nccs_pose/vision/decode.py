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
"""Image messages to BGR arrays, without cv_bridge.

Takes the fields of sensor_msgs/Image and sensor_msgs/CompressedImage, not the messages, so that
the node and the bags share it. What a message gets wrong is said in one sentence.
"""

from __future__ import annotations

from typing import Any

import cv2
from nccs_pose.errors import VisionError
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]

_MOST_PIXELS = 64_000_000
"""A header may announce gigabytes; nothing that this camera could be is larger than this."""

_BAYER = {
    # OpenCV names a pattern by its second row, ROS by its first.
    'rggb': cv2.COLOR_BayerBG2BGR, 'bggr': cv2.COLOR_BayerRG2BGR,
    'gbrg': cv2.COLOR_BayerGR2BGR, 'grbg': cv2.COLOR_BayerGB2BGR,
}
_CONVERSIONS: dict[str, tuple[int, int | None]] = {
    # encoding: (bytes a pixel, OpenCV's conversion to BGR)
    'bgr8': (3, None),
    '8UC3': (3, None),
    'rgb8': (3, cv2.COLOR_RGB2BGR),
    'bgra8': (4, cv2.COLOR_BGRA2BGR),
    '8UC4': (4, cv2.COLOR_BGRA2BGR),
    'rgba8': (4, cv2.COLOR_RGBA2BGR),
    'mono8': (1, cv2.COLOR_GRAY2BGR),
    '8UC1': (1, cv2.COLOR_GRAY2BGR),
    **{f'bayer_{pattern}8': (1, code) for pattern, code in _BAYER.items()},
    'yuv422': (2, cv2.COLOR_YUV2BGR_UYVY),
    'uyvy': (2, cv2.COLOR_YUV2BGR_UYVY),
    'yuv422_yuy2': (2, cv2.COLOR_YUV2BGR_YUY2),
    'yuyv': (2, cv2.COLOR_YUV2BGR_YUY2),
}
_SIXTEEN_BIT = {
    'mono16': (1, slice(1)), 'bgr16': (3, slice(3)), 'rgb16': (3, slice(2, None, -1)),
    'bgra16': (4, slice(3)), 'rgba16': (4, slice(2, None, -1))}
"""Encoding: channels, and those of them that give blue, green, red."""
_BAYER_16 = {f'bayer_{pattern}16': code for pattern, code in _BAYER.items()}
_SEMI_PLANAR = {'nv12': cv2.COLOR_YUV2BGR_NV12, 'nv21': cv2.COLOR_YUV2BGR_NV21}

ENCODINGS = (*_CONVERSIONS, *_SIXTEEN_BIT, *_BAYER_16, *_SEMI_PLANAR)
"""Encodings of raw images that :func:`decode_image` reads."""


def decode_image(
    encoding: str, height: int, width: int, step: int, is_bigendian: int, data: Any,
) -> Image:
    """Decode a raw image to BGR.

    A bgr8 image without row padding is a view of `data`; everything else is copied once
    (16-bit Bayer patterns twice). Of 16-bit values the upper eight bits are kept.

    :param step: bytes a row, padding included.
    :param data: any buffer of bytes.
    :returns: (height, width, 3) uint8, perhaps not writeable.
    :raises VisionError: if the encoding is not known, or size, step and data do not fit.
    """
    semi_planar = encoding in _SEMI_PLANAR
    if semi_planar:
        bytes_a_pixel = 1
    elif encoding in _SIXTEEN_BIT:
        bytes_a_pixel = 2 * _SIXTEEN_BIT[encoding][0]
    elif encoding in _BAYER_16:
        bytes_a_pixel = 2
    elif encoding in _CONVERSIONS:
        bytes_a_pixel = _CONVERSIONS[encoding][0]
    else:
        raise VisionError(
            f'image encoding {encoding!r} is not known; known are {", ".join(ENCODINGS)}')
    if semi_planar or encoding.startswith(('yuv', 'uyvy', 'yuyv')):
        _check_even(encoding, width, height if semi_planar else 2)
    table_height = height * 3 // 2 if semi_planar else height
    rows = _rows(encoding, table_height, width * bytes_a_pixel, step, data)
    high = rows[:, (0 if is_bigendian else 1)::2]
    if encoding in _SIXTEEN_BIT:
        channels, order = _SIXTEEN_BIT[encoding]
        colours = high.reshape(height, width, channels)[:, :, order]
        return np.ascontiguousarray(np.broadcast_to(colours, (height, width, 3)))
    if encoding in _BAYER_16:
        return _convert(np.ascontiguousarray(high), _BAYER_16[encoding], encoding)
    if semi_planar:
        return _convert(rows, _SEMI_PLANAR[encoding], encoding)
    code = _CONVERSIONS[encoding][1]
    pixels = rows if bytes_a_pixel == 1 else rows.reshape(height, width, bytes_a_pixel)
    return np.ascontiguousarray(pixels) if code is None else _convert(pixels, code, encoding)


def decode_compressed(image_format: str, data: Any) -> Image:
    """Decode a JPEG or PNG image to BGR, eight bits a channel.

    :param image_format: CompressedImage's `format`, e.g. ``jpeg`` or
        ``bgr8; png compressed bgr8``; may be empty, as some drivers leave it.
    :returns: (height, width, 3) uint8.
    :raises VisionError: if the format is another, or the data is no whole image.
    """
    words = image_format.lower()
    if words and not ('jpeg' in words or 'jpg' in words or 'png' in words):
        raise VisionError(f'image format {image_format!r} is neither jpeg nor png')
    if 'compresseddepth' in words:
        raise VisionError(f'image format {image_format!r} is a depth image, which has no colour')
    buffer = np.frombuffer(data, np.uint8) if len(data) else np.zeros(0, np.uint8)
    content = buffer.tobytes()
    if content.startswith(b'\xff\xd8'):
        kind, (width, height) = 'jpeg', _jpeg_size(content)
    elif content.startswith(b'\x89PNG\r\n\x1a\n'):
        kind, (width, height) = 'png', _png_size(content)
    else:
        raise VisionError(
            f'compressed image of {len(content)} bytes ({image_format!r}) holds neither a jpeg '
            'nor a png')
    if not 0 < width * height <= _MOST_PIXELS:
        raise VisionError(f'{kind} image announces {width} x {height} pixels')
    try:
        image = cv2.imdecode(buffer, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error as error:
        raise VisionError(f'{kind} image cannot be decoded: {error.err}') from error
    if image is None or image.shape[:2] != (height, width):
        raise VisionError(f'{kind} image of {len(content)} bytes cannot be decoded')
    return np.asarray(image, np.uint8)


def _rows(encoding: str, height: int, row_bytes: int, step: int, data: Any) -> Image:
    """View `data` as (height, row_bytes), the rows' padding cut off."""
    if height < 1 or row_bytes < 1:
        raise VisionError(f'{encoding} image has no pixels: {height} rows of {row_bytes} bytes')
    if step < row_bytes:
        raise VisionError(
            f'{encoding} image: step {step} is less than the {row_bytes} bytes of a row')
    size = len(memoryview(data).cast('B')) if not isinstance(data, np.ndarray) else data.nbytes
    if size != step * height:
        raise VisionError(
            f'{encoding} image: data has {size} bytes, not {height} rows x step {step} = '
            f'{step * height}')
    return np.frombuffer(data, np.uint8).reshape(height, step)[:, :row_bytes]


def _convert(pixels: Image, code: int, encoding: str) -> Image:
    try:
        return np.asarray(cv2.cvtColor(pixels, code), np.uint8)
    except cv2.error as error:  # e.g. a Bayer image of one row
        height, width = pixels.shape[:2]
        raise VisionError(
            f'{encoding} image of {width} x {height} pixels cannot be converted: {error.err}'
        ) from error


def _check_even(encoding: str, width: int, height: int) -> None:
    if width % 2 or height % 2:
        raise VisionError(
            f'{encoding} image: its size must be even, since pixels share their colour, '
            f'but is {width} x {height}')


def _png_size(content: bytes) -> tuple[int, int]:
    if len(content) < 24 or content[12:16] != b'IHDR' or content.rfind(b'IEND') < 0:
        raise VisionError(f'png image of {len(content)} bytes is cut short')
    return int.from_bytes(content[16:20], 'big'), int.from_bytes(content[20:24], 'big')


def _jpeg_size(content: bytes) -> tuple[int, int]:
    """Width and height from the frame header; a JPEG without its end is refused.

    The decoder itself only warns of a missing end, and fills the rest with grey.
    """
    size = (0, 0)
    at = 2
    while at + 4 <= len(content) and content[at] == 0xFF:
        marker = content[at + 1]
        if marker == 0xFF:  # fill byte
            at += 1
            continue
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):  # a start of frame
            size = (int.from_bytes(content[at + 7:at + 9], 'big'),
                    int.from_bytes(content[at + 5:at + 7], 'big'))
        if marker == 0xDA:  # start of scan: no end-of-image code can occur in the scan itself
            if content.rfind(b'\xff\xd9') < at:
                break
            return size
        at += 2 + int.from_bytes(content[at + 2:at + 4], 'big')
    raise VisionError(f'jpeg image of {len(content)} bytes is cut short')
