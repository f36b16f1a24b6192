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

"""Is the camera that publishes camera_info the one that the rig was calibrated with?"""

from __future__ import annotations

from dataclasses import replace

from nccs_pose.errors import GeometryError
from nccs_pose.geometry.camera import PinholeCamera
import numpy as np
from sensor_msgs.msg import CameraInfo


def contradiction(info: CameraInfo, camera: PinholeCamera, tolerance: float) -> str:
    """Say how camera_info contradicts the rig's camera, both numbers named; empty if not.

    A camera_info whose K is all zero is of an uncalibrated driver: only its size counts.

    :param tolerance: largest difference of K, as a fraction of the focal length.
    """
    if (info.width, info.height) != (camera.width, camera.height):
        return (f'camera_info says {info.width} x {info.height} pixels, the rig '
                f'{camera.width} x {camera.height}')
    if max(info.binning_x, info.binning_y) > 1:
        return (f'camera_info says binning {info.binning_x} x {info.binning_y}, the rig is '
                'calibrated for whole images')
    if (info.roi.width, info.roi.height) not in ((0, 0), (camera.width, camera.height)):
        return (f'camera_info says a region of {info.roi.width} x {info.roi.height}, the rig '
                f'{camera.width} x {camera.height}')
    theirs = np.asarray(info.k, dtype=float).reshape(3, 3)
    if not theirs.any():
        return ''
    for name, row, column in (('fx', 0, 0), ('fy', 1, 1), ('cx', 0, 2), ('cy', 1, 2)):
        their, our = float(theirs[row, column]), float(camera.K[row, column])
        # Not '>': a NaN contradicts too.
        if not abs(their - our) <= tolerance * camera.fx:
            return f'camera_info says {name} = {their:g} px, the rig {our:g} px'
    return _distortion(info, camera, tolerance)


def _distortion(info: CameraInfo, camera: PinholeCamera, tolerance: float) -> str:
    """Whether both distort alike, by where they put the pixels of the image.

    Zeros at the end say nothing, and nothing but zeros no distortion, whatever the model: drivers
    fill in as many as they like, and under names of their own.
    """
    theirs = tuple(np.trim_zeros(info.d, 'b'))
    model = info.distortion_model if theirs else ''
    try:
        other = replace(
            camera, distortion_model=model or camera.distortion_model, distortion=theirs)
    except GeometryError as error:
        return f'camera_info is none of a camera that the rig could have: {error}'
    u, v = np.meshgrid(np.linspace(0, camera.width - 1, 9), np.linspace(0, camera.height - 1, 9))
    pixels = np.column_stack([u.ravel(), v.ravel()])
    directions = camera.directions(pixels)
    pixels, directions = pixels[directions[:, 2] > 0.0], directions[directions[:, 2] > 0.0]
    apart = np.abs(other.project(directions)[0] - pixels).max(initial=0.0)
    if not apart <= tolerance * camera.fx + 1e-6:  # there and back is rounded
        return (f'camera_info says distortion {_coefficients(other)}, the rig '
                f'{_coefficients(camera)}: up to {apart:.3g} px apart')
    return ''


def _coefficients(camera: PinholeCamera) -> str:
    if not any(camera.distortion):
        return 'none'
    numbers = ', '.join(f'{k:g}' for k in camera.distortion)
    return f'{camera.distortion_model} [{numbers}]'
