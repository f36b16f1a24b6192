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

"""Poses that come from outside the images: the parameters', the user's, the last run's."""

from __future__ import annotations

import time
from typing import Any

from nccs_pose.errors import FileError
from nccs_pose.estimation.estimate import Estimate, State
from nccs_pose.estimation.localiser import Localiser
from nccs_pose.files.resources import expanded
from nccs_pose.files.saved_pose import map_hash, read_saved_pose, SavedPose, write_saved_pose
from nccs_pose.geometry.lines import LineMap
from nccs_pose.geometry.pose import Array, Pose2
from nccs_pose.node_options import NodeOptions
import numpy as np


class PoseKeeper:
    """Gives the localiser its priors, and keeps its last good pose in a file."""

    def __init__(self, options: NodeOptions, line_map: LineMap, logger: Any) -> None:
        self._options = options
        self._path = expanded(options.saved_pose_file)
        self._map_hash = map_hash(line_map)
        self._logger = logger
        self._good: SavedPose | None = None
        self._saved_at = time.monotonic()

    def offer(self, localiser: Localiser) -> None:
        """Give the pose of the parameters or else of the last run, as a hypothesis."""
        o = self._options
        if o.set_initial_pose:
            pose = Pose2(o.initial_pose_x, o.initial_pose_y, o.initial_pose_yaw)
            self.give(localiser, pose, None)
            return
        saved = self._read() if o.saved_pose_file else None
        if saved is not None:
            # The robot may have been pushed since: no surer than an initial pose without one.
            self.give(localiser, saved.pose, saved.covariance + self._default_covariance())

    def give(self, localiser: Localiser, pose: Pose2, covariance: Array | None) -> None:
        """Give a prior; without a covariance it takes that of the parameters."""
        if covariance is None:
            covariance = self._default_covariance()
        localiser.set_prior(pose, covariance)
        self._logger.info(
            f'prior: x {pose.x:.3f} m, y {pose.y:.3f} m, yaw {pose.yaw:.4f} rad')

    def remember(self, estimate: Estimate) -> None:
        """Note an estimate; only one that images support is worth keeping."""
        if (estimate.state is State.TRACKING and estimate.pose is not None
                and estimate.covariance is not None):
            self._good = SavedPose(
                estimate.stamp_ns, self._options.map_frame, self._map_hash, estimate.pose,
                estimate.covariance)

    def save_if_due(self) -> None:
        """Save once in every interval."""
        if time.monotonic() - self._saved_at >= self._options.saved_pose_interval:
            self.save()

    def save(self) -> None:
        """Write what was remembered since the last time."""
        self._saved_at = time.monotonic()
        good, self._good = self._good, None
        if not self._options.saved_pose_file or good is None:
            return
        try:
            write_saved_pose(self._path, good)
        except FileError as error:
            self._logger.warning(f'the pose was not saved: {error}')

    def _read(self) -> SavedPose | None:
        try:
            saved = read_saved_pose(self._path)
        except FileError as error:
            self._logger.warning(f'the saved pose is not used: {error}')
            return None
        if saved is not None and (
                saved.map_hash != self._map_hash or saved.frame != self._options.map_frame):
            self._logger.warning(
                f'the saved pose is not used: {self._path} is of another map')
            return None
        return saved

    def _default_covariance(self) -> Array:
        o = self._options
        return np.diag([o.initial_pose_sigma, o.initial_pose_sigma, o.initial_pose_sigma_yaw])**2
