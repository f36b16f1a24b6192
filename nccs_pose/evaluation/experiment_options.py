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
"""What the paper's experiments leave open, as options with their defaults."""

from __future__ import annotations

from dataclasses import dataclass

from nccs_pose.errors import OptionError
from nccs_pose.geometry.camera import PinholeCamera
from nccs_pose.geometry.mirror import QuadricMirror
from nccs_pose.geometry.rig import Rig
from nccs_pose.options import check_options, option
from nccs_pose.simulation.table_one import TABLE_ONE, table_one_rig

ESTIMATORS = ('paper', 'paper without g2', 'ours', 'bound')


@dataclass(frozen=True)
class ExperimentOptions:
    """Assumptions of the experiments; each is a flag of the command."""

    seed: int = option(1, doc='Seed; the same seed gives the same numbers.', low=0)
    lines: int = option(
        0, doc="Lines per trial; 0: the experiment's own (pixel-noise 5, world-noise 10).", low=0,
        high=1000)
    points: int = option(
        0, doc="Points per line; 0: the experiment's own (20).", low=0, high=10000)
    unit: float = option(
        1e-3, doc="Unit of Table I's mirrors; the paper gives none.", unit='m', low=1e-6,
        high=1.0)
    focal: float = option(
        750.0, doc='Focal length; the paper gives no camera matrix.', unit='px', low=10.0,
        high=1e5)
    width: int = option(1200, doc='Image width.', unit='px', low=10, high=100000)
    height: int = option(800, doc='Image height.', unit='px', low=10, high=100000)
    nearest: float = option(
        0.3, doc='Nearest point of a line, from the mirror.', unit='m', low=0.05, high=100.0)
    farthest: float = option(
        3.0, doc='Farthest point of a line, from the mirror.', unit='m', low=0.05, high=100.0)
    length: float = option(
        3.0, doc='Length of the lines that the points are taken from.', unit='m', low=0.01,
        high=1000.0)
    start_angle_deg: float = option(
        10.0, doc="The paper's estimator starts within this of the true yaw.", unit='deg',
        low=0.0, high=180.0)
    start_distance: float = option(
        0.2, doc="The paper's estimator starts within this of the true position.", unit='m',
        low=0.0, high=100.0)
    quick: bool = option(
        False, doc="Leave the paper's two estimators out, which take most of the time.")
    normalised: bool = option(
        False, doc='Normalise gamma_r point by point, which the paper does not.')
    failure_angle_deg: float = option(
        5.0, doc='A larger rotation error counts as a failure.', unit='deg', low=0.0, high=180.0)
    failure_distance: float = option(
        0.5, doc='A larger translation error counts as a failure.', unit='m', low=0.0,
        high=100.0)

    def __post_init__(self) -> None:
        check_options(self)
        if self.nearest >= self.farthest:
            raise OptionError(
                f'nearest = {self.nearest} m must be less than farthest = {self.farthest} m')

    @property
    def estimators(self) -> tuple[str, ...]:
        """What answers each trial, in this order."""
        return ESTIMATORS[2:] if self.quick else ESTIMATORS

    def rig(self, name: str) -> Rig:
        """One of Table I's rigs with this unit and camera."""
        mirror, cop = TABLE_ONE[name].mirror, TABLE_ONE[name].cop
        scale = self.unit / 1e-3
        camera = PinholeCamera(
            self.width, self.height, self.focal, self.focal,
            0.5 * (self.width - 1), 0.5 * (self.height - 1))
        scaled = QuadricMirror(mirror.A, mirror.B * scale, mirror.C * scale**2)
        return table_one_rig(scaled, cop * scale, camera)
