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
"""Image decoding against per-pixel definitions of the encodings and against OpenCV's encoders."""

from __future__ import annotations

import array

import cv2
from hypothesis import given
from hypothesis import strategies as st
from nccs_pose.errors import VisionError
from nccs_pose.vision.decode import decode_compressed, decode_image, ENCODINGS
import numpy as np
import pytest

rng = np.random.default_rng(8)
NOISE = rng.integers(0, 256, (6, 8, 3), dtype=np.uint8)  # BGR


def smooth(height: int = 48, width: int = 64) -> np.ndarray:
    """A BGR picture whose colours change slowly, so that subsampled colour is recovered."""
    v, u = np.mgrid[0:height, 0:width]
    return np.stack([2 * u + 40, 3 * v + 30, 250 - u - v], axis=-1).astype(np.uint8)


def pad(rows: np.ndarray, extra: int) -> tuple[int, bytes]:
    """Rows (H, ...) uint8 as padded message data: step and bytes."""
    flat = rows.reshape(len(rows), -1)
    padding = np.full((len(rows), extra), 0xAB, np.uint8)
    return flat.shape[1] + extra, np.hstack([flat, padding]).tobytes()


def decoded(encoding: str, rows: np.ndarray, shape: tuple[int, int], extra: int = 0,
            big: int = 0) -> np.ndarray:
    step, data = pad(rows, extra)
    return decode_image(encoding, shape[0], shape[1], step, big, data)


@pytest.mark.parametrize('extra', [0, 1, 7])
def test_plain_encodings_are_reordered_channels(extra: int) -> None:
    alpha = rng.integers(0, 256, (6, 8, 1), dtype=np.uint8)
    shape = (6, 8)
    cases = {
        'bgr8': NOISE, '8UC3': NOISE, 'rgb8': NOISE[:, :, ::-1],
        'bgra8': np.concatenate([NOISE, alpha], axis=2),
        '8UC4': np.concatenate([NOISE, alpha], axis=2),
        'rgba8': np.concatenate([NOISE[:, :, ::-1], alpha], axis=2),
    }
    for encoding, rows in cases.items():
        np.testing.assert_array_equal(decoded(encoding, rows, shape, extra), NOISE)
    for encoding in ('mono8', '8UC1'):
        image = decoded(encoding, NOISE[:, :, 0], shape, extra)
        np.testing.assert_array_equal(image, NOISE[:, :, [0, 0, 0]])


@pytest.mark.parametrize(('big', 'order'), [(0, '<u2'), (1, '>u2')])
@pytest.mark.parametrize('extra', [0, 6])
def test_sixteen_bits_keep_the_upper_eight(big: int, order: str, extra: int) -> None:
    values = (NOISE.astype(np.uint16) << 8) | rng.integers(0, 256, NOISE.shape).astype(np.uint16)
    for encoding, channels in (('bgr16', [0, 1, 2]), ('rgb16', [2, 1, 0])):
        rows = values[:, :, channels].astype(order, order='C').view(np.uint8)
        np.testing.assert_array_equal(decoded(encoding, rows, (6, 8), extra, big), NOISE)
    alpha = rng.integers(0, 65536, (6, 8, 1)).astype(np.uint16)
    for encoding, channels in (('bgra16', [0, 1, 2]), ('rgba16', [2, 1, 0])):
        rows = np.concatenate([values[:, :, channels], alpha], axis=2)
        rows = rows.astype(order, order='C').view(np.uint8)
        np.testing.assert_array_equal(decoded(encoding, rows, (6, 8), extra, big), NOISE)
    rows = values[:, :, 1].astype(order, order='C').view(np.uint8)
    np.testing.assert_array_equal(
        decoded('mono16', rows, (6, 8), extra, big), NOISE[:, :, [1, 1, 1]])


@pytest.mark.parametrize('pattern', ['rggb', 'bggr', 'gbrg', 'grbg'])
def test_bayer_patterns_give_each_colour_back(pattern: str) -> None:
    picture = smooth()
    mosaic = np.empty(picture.shape[:2], np.uint8)
    for index, colour in enumerate(pattern):
        v, u = divmod(index, 2)
        mosaic[v::2, u::2] = picture[v::2, u::2, 'bgr'.index(colour)]
    image = decoded(f'bayer_{pattern}8', mosaic, picture.shape[:2], extra=5)
    inner = np.s_[2:-2, 2:-2]
    assert np.abs(image[inner].astype(int) - picture[inner]).max() <= 4
    for big, order in ((0, '<u2'), (1, '>u2')):
        deep = (mosaic.astype(np.uint16) * 256 + 77).astype(order).view(np.uint8)
        np.testing.assert_array_equal(
            decoded(f'bayer_{pattern}16', deep, picture.shape[:2], 6, big), image)


def bt601(picture: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Y, U, V of a BGR picture by ITU-R BT.601, video range."""
    b, g, r = (picture[:, :, i] / 255.0 for i in range(3))
    y = 16 + 65.481 * r + 128.553 * g + 24.966 * b
    u = 128 - 37.797 * r - 74.203 * g + 112.0 * b
    v = 128 + 112.0 * r - 93.786 * g - 18.214 * b
    return tuple(np.round(x).astype(np.uint8) for x in (y, u, v))


def test_yuv_encodings_follow_bt601() -> None:
    picture = smooth()
    shape = picture.shape[:2]
    y, u, v = bt601(picture)
    packed = np.stack([y[:, 0::2], u[:, 0::2], y[:, 1::2], v[:, 0::2]], axis=-1)
    uyvy = packed[:, :, [1, 0, 3, 2]]
    planar_u, planar_v = u[0::2, 0::2], v[0::2, 0::2]
    nv12 = np.vstack([y, np.stack([planar_u, planar_v], -1).reshape(-1, shape[1])])
    nv21 = np.vstack([y, np.stack([planar_v, planar_u], -1).reshape(-1, shape[1])])
    cases = {'yuv422': uyvy, 'uyvy': uyvy, 'yuv422_yuy2': packed, 'yuyv': packed,
             'nv12': nv12, 'nv21': nv21}
    for encoding, rows in cases.items():
        image = decoded(encoding, rows, shape, extra=2)
        assert image.shape == picture.shape
        assert np.abs(image.astype(int) - picture).max() <= 8, encoding


def test_every_encoding_is_tested_here() -> None:
    assert set(ENCODINGS) == {
        'bgr8', '8UC3', 'rgb8', 'bgra8', '8UC4', 'rgba8', 'mono8', '8UC1', 'mono16', 'bgr16',
        'rgb16', 'bgra16', 'rgba16', 'bayer_rggb16', 'bayer_bggr16', 'bayer_gbrg16',
        'bayer_grbg16', 'bayer_rggb8', 'bayer_bggr8', 'bayer_gbrg8', 'bayer_grbg8', 'yuv422',
        'uyvy', 'yuv422_yuy2', 'yuyv', 'nv12', 'nv21'}


def test_bgr8_without_padding_is_a_view_of_any_buffer() -> None:
    for data in (NOISE.tobytes(), bytearray(NOISE.tobytes()), memoryview(NOISE.tobytes()),
                 array.array('B', NOISE.tobytes()), NOISE.ravel()):
        image = decode_image('bgr8', 6, 8, 24, 0, data)
        assert np.shares_memory(image, np.frombuffer(data, np.uint8))
        np.testing.assert_array_equal(image, NOISE)
    assert decoded('bgr8', NOISE, (6, 8), extra=3).flags.c_contiguous


@pytest.mark.parametrize(('arguments', 'words'), [
    (('bgr9', 6, 8, 24, 0, bytes(144)), ['bgr9', 'not known', 'bgr8']),
    (('32FC1', 6, 8, 32, 0, bytes(192)), ['32FC1', 'not known']),
    (('bgr8', 6, 8, 23, 0, bytes(138)), ['step 23', '24 bytes']),
    (('bgr8', 6, 8, 24, 0, bytes(143)), ['143', '144']),
    (('bgr8', 6, 8, 24, 0, bytes(145)), ['145', '144']),
    (('bgr8', 6, 8, 24, 0, b''), ['0 bytes', '144']),
    (('bgr8', 0, 8, 24, 0, b''), ['no pixels']),
    (('bgr8', 6, 0, 24, 0, bytes(144)), ['no pixels']),
    (('mono8', 2**31, 2**31, 2**31, 0, bytes(9)), ['9 bytes']),
    (('yuv422', 6, 7, 14, 0, bytes(84)), ['even', '7 x']),
    (('nv12', 5, 8, 8, 0, bytes(56)), ['even', '8 x 5']),
    (('bgr8', 6, 8, 0, 0, b''), ['step 0']),
])
def test_a_raw_image_that_does_not_fit_is_refused(arguments: tuple, words: list[str]) -> None:
    with pytest.raises(VisionError) as refused:
        decode_image(*arguments)
    for word in words:
        assert word in str(refused.value)


def encoded(extension: str, image: np.ndarray, *parameters: int) -> bytes:
    return cv2.imencode(extension, image, list(parameters))[1].tobytes()


@pytest.mark.parametrize('image_format', [
    'jpeg', 'jpg', 'bgr8; jpeg compressed bgr8', 'rgb8; jpeg compressed bgr8', ''])
def test_jpeg_is_decoded(image_format: str) -> None:
    picture = smooth()
    image = decode_compressed(image_format, encoded('.jpg', picture, cv2.IMWRITE_JPEG_QUALITY, 98))
    assert image.shape == picture.shape
    assert np.abs(image.astype(int) - picture).max() <= 6


def test_png_is_decoded_to_eight_bits_and_three_channels() -> None:
    picture = smooth()
    np.testing.assert_array_equal(decode_compressed('png', encoded('.png', picture)), picture)
    alpha = np.dstack([picture, np.full(picture.shape[:2], 7, np.uint8)])
    np.testing.assert_array_equal(decode_compressed('png', encoded('.png', alpha)), picture)
    grey = picture[:, :, 1]
    np.testing.assert_array_equal(
        decode_compressed('mono8; png compressed mono8', encoded('.png', grey)),
        picture[:, :, [1, 1, 1]])
    deep = picture.astype(np.uint16) * 257
    np.testing.assert_array_equal(decode_compressed('png', encoded('.png', deep)), picture)


def test_a_progressive_jpeg_with_padding_behind_it_is_decoded() -> None:
    data = encoded('.jpg', smooth(), cv2.IMWRITE_JPEG_PROGRESSIVE, 1) + bytes(100)
    assert decode_compressed('jpeg', data).shape == (48, 64, 3)


@pytest.mark.parametrize('extension', ['.jpg', '.png'])
@pytest.mark.parametrize('part', [0.0, 0.01, 0.3, 0.9, 0.99])
def test_a_truncated_image_is_refused_not_filled_with_grey(extension: str, part: float) -> None:
    data = encoded(extension, np.repeat(np.repeat(NOISE, 20, 0), 20, 1))
    with pytest.raises(VisionError, match='bytes'):
        decode_compressed('', data[:int(part * len(data))])


@pytest.mark.parametrize('image_format', ['h264', 'bgr8; theora', '16UC1; compressedDepth png'])
def test_other_formats_are_refused_by_name(image_format: str) -> None:
    with pytest.raises(VisionError) as refused:
        decode_compressed(image_format, encoded('.png', smooth()))
    assert repr(image_format) in str(refused.value)


def test_an_image_that_announces_gigabytes_is_refused() -> None:
    data = bytearray(encoded('.png', smooth()))
    data[16:24] = (60000).to_bytes(4, 'big') * 2
    with pytest.raises(VisionError, match='60000 x 60000'):
        decode_compressed('png', bytes(data))


@given(st.binary(max_size=300), st.sampled_from([b'', b'\xff\xd8', b'\x89PNG\r\n\x1a\n']))
def test_no_bytes_crash_the_decoder(data: bytes, magic: bytes) -> None:
    with pytest.raises(VisionError):
        decode_compressed('jpeg', magic + data)


@given(
    st.sampled_from(ENCODINGS), st.integers(0, 9), st.integers(0, 9), st.integers(0, 40),
    st.booleans())
def test_any_size_is_decoded_or_refused(
    encoding: str, height: int, width: int, step: int, truncated: bool,
) -> None:
    rows = height * 3 // 2 if encoding.startswith('nv') else height
    data = bytes(max(0, rows * step - truncated))
    try:
        image = decode_image(encoding, height, width, step, 0, data)
    except VisionError:
        return
    assert image.shape == (height, width, 3)
    assert image.dtype == np.uint8
