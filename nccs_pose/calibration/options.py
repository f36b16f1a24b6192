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

"""What is calibrated, how well the rough rig is known, and how much is asked of the data."""

from __future__ import annotations

from dataclasses import dataclass

from nccs_pose.options import check_options, option


@dataclass(frozen=True)
class CalibrationOptions:
    """Options of a calibration; the rough_* ones are standard deviations of the rough rig.

    :raises OptionError: naming an option outside its range.
    """

    height: bool = option(True, doc='Free the mounting height of the mirror.')
    tilt: bool = option(True, doc='Free the roll and pitch of the mirror against the robot.')
    mirror: bool = option(False, doc="Free the mirror's shape, as far as it keeps its kind.")
    principal_point: bool = option(False, doc="Free the camera's principal point.")
    focal_length: bool = option(False, doc="Free the camera's focal length (one factor).")
    tape_width: bool = option(False, doc='Free the width of all tapes together.')

    rough_cop: float = option(
        3e-3, unit='m', low=1e-6, high=0.1, doc='Of the centre of projection.')
    rough_cop_sideways: float = option(
        2e-5, unit='m', low=1e-7, high=0.1,
        doc='Of the centre of projection out of the plane x = 0 of the mirror frame. Small: the '
        "mount's yaw is held, and with it base_link's heading; as large as rough_cop: the "
        "camera's heading is.")
    rough_camera_tilt: float = option(
        0.035, unit='rad', low=1e-6, high=0.5, doc='Of the camera against the mirror.')
    rough_height: float = option(0.02, unit='m', low=1e-6, high=1.0, doc='Of the height.')
    rough_tilt: float = option(
        8.7e-3, unit='rad', low=1e-6, high=0.5,
        doc='Of the mirror against the robot. On a sphere that tilt is held: a turn about the '
        'centre shows in no line.')
    rough_mirror: float = option(
        0.02, low=1e-6, high=0.5, doc="Of the mirror's shape, relative to its size.")
    rough_principal_point: float = option(
        5.0, unit='px', low=1e-3, high=200.0, doc='Of the principal point.')
    rough_focal_length: float = option(
        0.01, low=1e-6, high=0.5, doc='Of the focal length, relative.')
    rough_tape_width: float = option(2e-3, unit='m', low=1e-6, high=0.1, doc='Of the tapes.')
    rough_line: float = option(
        0.02, unit='m', low=1e-6, high=1.0, doc='Of the ends of a line that is freed by name.')

    points_per_edge: int = option(
        75, low=3, high=10000, doc='Most points of one edge of one line in one frame.')
    max_frames: int = option(40, low=3, high=100000, doc='Most frames that enter the fit.')
    min_frames: int = option(5, low=2, high=1000, doc='Fewest frames to calibrate from.')
    held_out: int = option(
        5, low=2, high=1000, doc='Every so many-th frame judges the fit instead of entering it.')
    pose_error: float = option(
        5e-3, unit='m', low=1e-6, high=1.0,
        doc='Largest pose error that the remaining uncertainty may mean.')

    def __post_init__(self) -> None:
        check_options(self)
