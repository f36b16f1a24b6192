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

"""From light to grey levels: optics, exposure, noise, response and compression of the camera."""

from __future__ import annotations

import dataclasses
import functools
import math

import cv2
from nccs_pose.errors import SimulationError
import numpy as np

_STRIP = 16  # rows


@dataclasses.dataclass(frozen=True)
class SensorModel:
    """A camera behind its lens; the default hands the light on as it is.

    :ivar exposure: gain: reflectance 1 under full light times this is full scale.
    :ivar white_balance: gains of blue, green, red.
    :ivar vignetting: relative loss of light in the corners.
    :ivar psf_sigma: standard deviation of the Gaussian point spread, px.
    :ivar read_noise, shot_noise: standard deviation of the noise in the dark, and of the shot
        noise at full scale, as fractions of full scale, before the response; independent by
        pixel and channel.
    :ivar gamma: the response is light^(1/gamma); 1 is linear: read_noise x 255 is grey levels.
    :ivar jpeg_quality: 1 to 100, or 0 for no compression.
    :ivar exposure_time, exposure_steps: shutter time in s, and how many poses are averaged over
        it when the robot moves.
    """

    exposure: float = 1.0
    white_balance: tuple[float, float, float] = (1.0, 1.0, 1.0)
    vignetting: float = 0.0
    psf_sigma: float = 0.0
    read_noise: float = 0.0
    shot_noise: float = 0.0
    gamma: float = 1.0
    jpeg_quality: int = 0
    exposure_time: float = 0.0
    exposure_steps: int = 3

    def __post_init__(self) -> None:
        for name in ('exposure', 'gamma'):
            if not getattr(self, name) > 0.0:
                raise SimulationError(f'sensor {name} must be > 0, is {getattr(self, name)}')
        for name in ('psf_sigma', 'read_noise', 'shot_noise', 'exposure_time'):
            if not getattr(self, name) >= 0.0:
                raise SimulationError(f'sensor {name} must be >= 0, is {getattr(self, name)}')
        if not 0 <= self.jpeg_quality <= 100:
            raise SimulationError(f'sensor jpeg_quality is 0 to 100, not {self.jpeg_quality}')
        if self.exposure_steps < 1:
            raise SimulationError(f'sensor exposure_steps is {self.exposure_steps}, below 1')


def irradiate(radiance: np.ndarray, sensor: SensorModel) -> np.ndarray:
    """Give what falls on the pixels: point spread, vignetting, gains; full scale is 1.

    :param radiance: (H, W, 3) float32, overwritten.
    :param sensor: the camera.
    """
    if sensor.psf_sigma > 0.0:
        size = 2 * math.ceil(3.0 * sensor.psf_sigma) + 1
        radiance = cv2.GaussianBlur(radiance, (size, size), sensor.psf_sigma)
    gains = np.array(sensor.white_balance, dtype=np.float32) * np.float32(sensor.exposure)
    if not np.all(gains == 1.0):
        radiance *= gains
    if sensor.vignetting > 0.0:
        height, width = radiance.shape[:2]
        radiance *= _vignette(height, width, sensor.vignetting)[:, :, None]
    return radiance


@functools.lru_cache(maxsize=4)
def _vignette(height: int, width: int, loss: float) -> np.ndarray:
    """Relative light by pixel, (H, W) float32: quadratic in the radius, 1 - loss in a corner."""
    u = np.arange(width) - (width - 1) / 2.0
    v = np.arange(height) - (height - 1) / 2.0
    radius2 = (u[None, :] ** 2 + v[:, None] ** 2) / (u[-1] ** 2 + v[-1] ** 2)
    gain = (1.0 - loss * radius2).astype(np.float32)
    gain.setflags(write=False)
    return gain


def respond(irradiance: np.ndarray, sensor: SensorModel) -> np.ndarray:
    """Give the noise-free grey levels, (H, W, 3) float32, neither rounded nor clipped above."""
    if sensor.gamma == 1.0:
        return irradiance * np.float32(255.0)
    return np.float32(255.0) * np.maximum(irradiance, 0.0) ** np.float32(1.0 / sensor.gamma)


def expose(irradiance: np.ndarray, sensor: SensorModel, rng: np.random.Generator) -> np.ndarray:
    """Give the image that the camera delivers: noise, response, eight bits, compression.

    :param irradiance: (H, W, 3) float32, full scale 1; overwritten.
    :param sensor: the camera.
    :param rng: source of all noise.
    :returns: (H, W, 3) uint8, BGR.
    """
    image = np.empty(irradiance.shape, np.uint8)
    # In strips that the processor's cache holds.
    for top in range(0, len(irradiance), _STRIP):
        strip = irradiance[top : top + _STRIP]
        _add_noise(strip, sensor, rng)
        image[top : top + _STRIP] = _quantise(strip, sensor.gamma)
    return compress(image, sensor.jpeg_quality) if sensor.jpeg_quality else image


def _add_noise(irradiance: np.ndarray, sensor: SensorModel, rng: np.random.Generator) -> None:
    if sensor.read_noise == 0.0 and sensor.shot_noise == 0.0:
        return
    noise = rng.standard_normal(irradiance.shape, dtype=np.float32)
    if sensor.shot_noise > 0.0:
        variance = np.maximum(irradiance, 0.0)
        variance *= np.float32(sensor.shot_noise**2)
        variance += np.float32(sensor.read_noise**2)
        noise *= np.sqrt(variance, out=variance)
    else:
        noise *= np.float32(sensor.read_noise)
    irradiance += noise


def compress(image: np.ndarray, quality: int) -> np.ndarray:
    """Give the (H, W, 3) uint8 image after JPEG of the quality (1 to 100) and back."""
    _, data = cv2.imencode('.jpg', image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR))


def _quantise(irradiance: np.ndarray, gamma: float) -> np.ndarray:
    flat = irradiance.reshape(irradiance.shape[0], -1)
    if gamma == 1.0:
        grey = _saturated(flat, 255.0, cv2.CV_8U)
    else:
        # The table's steps are far below one grey level but in the darkest few.
        grey = _response_table(gamma)[_saturated(flat, 65535.0, cv2.CV_16U)]
    return grey.reshape(irradiance.shape)


def _saturated(values: np.ndarray, scale: float, kind: int) -> np.ndarray:
    """Scale, round to the nearest and keep within the kind of integer."""
    return np.asarray(cv2.addWeighted(values, scale, values, 0.0, 0.0, dtype=kind))


@functools.lru_cache(maxsize=4)
def _response_table(gamma: float) -> np.ndarray:
    light = np.arange(65536) / 65535.0
    return np.rint(255.0 * light ** (1.0 / gamma)).astype(np.uint8)
