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

"""Residuals of line measurements, and their derivatives by the rig and the poses.

The residual of a measured pixel u is its distance in the image from its line's curve: with the
foot f of the perpendicular, e = (S(f) + dS/du (u - f)) / |dS/du|, derivatives at f. At u they
would follow the noise, and what is weakly seen would be off by several standard deviations. Until
the curve is known, f = u. The weight 1 / |dS/du| is held while e is differentiated: it is no
measurement, and its own slope would draw the rig to where everything looks small.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from nccs_pose.calibration.observations import Observations
from nccs_pose.calibration.parameters import RigParameters
from nccs_pose.calibration.sensitivity import IncidentRays, Sensitivity, side_sensitivity
from nccs_pose.errors import CalibrationError
from nccs_pose.geometry.pose import Array
import numpy as np
from numpy.typing import NDArray

_NEAR = 10.0  # px, how far from its curve a pixel may be to have a foot there


@dataclass(frozen=True, eq=False)
class Linearisation:
    """Whitened residuals and their derivatives at one rig and its poses.

    :ivar residual: e (N,), no unit; with sigma = 1 px it is pixels.
    :ivar hit: which points count (N,).
    :ivar by_pose: (N, 3).
    :ivar by_rig: (N, P).
    """

    residual: Array
    hit: NDArray[np.bool_]
    by_pose: Array
    by_rig: Array


class Problem:
    """Observations, free parameters, and what does not change between steps."""

    def __init__(
        self, parameters: RigParameters, observations: Observations, *, check: bool = True,
    ) -> None:
        if check and len(observations) < 3 * observations.frames + len(parameters):
            raise CalibrationError(
                f'{len(observations)} points in {observations.frames} frames cannot fix '
                f'{len(parameters)} numbers of the rig and a pose for each frame')
        self.parameters = parameters
        self.observations = observations
        self.slices = observations.slices()
        self._stand_at(observations.pixels)

    def _stand_at(self, pixels: Array) -> None:
        """Take pixels (N, 2) for the feet of the perpendiculars."""
        self._feet = replace(self.observations, pixels=pixels)
        # With a camera that stays as it is, pixels look along the same rays at every step.
        camera_moves = {'cx', 'focal'} & self.parameters.index.keys()
        self._incident = None if camera_moves else IncidentRays.of(
            self.parameters.rough.rig.camera, pixels)

    def drop_feet(self, theta: Array, poses: Array) -> None:
        """Put the feet of the perpendiculars onto the curves at theta (P,) and poses (F, 3)."""
        for _ in range(2):
            s = self._sensitivity(theta, poses)
            normal = s.pixel / s.slope[:, None]
            distance = self._distance(s)
            # From beyond some pixels a step does not lead to the curve, or not to the near one.
            near = s.hit & (np.abs(distance) < _NEAR)
            self._stand_at(
                self.observations.pixels - np.where(near, distance, 0.0)[:, None] * normal)

    def _sensitivity(self, theta: Array, poses: Array) -> Sensitivity:
        model = self.parameters.model(theta)
        return side_sensitivity(model.rig, model.line_map, poses, self._feet, self._incident)

    def _distance(self, s: Sensitivity) -> Array:
        """Distance of the measured pixels from their curves (N,), px; 0 where nothing is hit."""
        off = self.observations.pixels - self._feet.pixels
        return s.hit * (s.side + np.einsum('ni,ni->n', s.pixel, off)) / s.slope

    def linearise(self, theta: Array, poses: Array) -> Linearisation:
        """Residuals and derivatives at theta (P,) and poses (F, 3).

        :raises GeometryError: if there can be no such rig.
        """
        obs = self.observations
        s = self._sensitivity(theta, poses)
        scale = s.hit / (s.slope * obs.sigma)
        columns = self.parameters.columns(
            theta, s, self.parameters.model(theta), self._feet.pixels, obs.line)
        return Linearisation(
            self._distance(s) / obs.sigma, s.hit, s.pose * scale[:, None],
            columns * scale[:, None])
