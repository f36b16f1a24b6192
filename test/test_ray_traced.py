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

"""The localiser on images of a path tracer that shares nothing with the project."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from calibration_reader import read_calibration
import cv2
from nccs_pose.estimation.estimate import Estimate, State
from nccs_pose.estimation.localiser import Localiser
from nccs_pose.estimation.options import LocaliserOptions
from nccs_pose.evaluation.trajectory import Trajectory
from nccs_pose.files.bags import BagReader, StampedImage
from nccs_pose.files.trajectories import read_tum
from nccs_pose.geometry.pose import Pose2, wrap_angle
import numpy as np
import pytest

Image = np.ndarray


def _pictures(sequence: Path, truth: Trajectory, step: int) -> Iterator[tuple[int, Image]]:
    """Stamped images of a sequence, from its lossless frames or else from its bag."""
    if (sequence / 'frames').is_dir():
        for k in range(0, len(truth), step):
            picture = cv2.imread(str(sequence / 'frames' / f'{k:04d}.png'))
            assert picture is not None
            yield int(truth.stamps_ns[k]), picture
        return
    with BagReader(sequence / 'bag') as bag:
        images = (e for e in bag.events(odometry=False) if isinstance(e, StampedImage))
        for k, event in enumerate(images):
            if k % step == 0:
                yield event.stamp_ns, event.decode()


# Lines projected by the project agree with the path tracer's bands to about so much, px.
AGREEMENT = 0.02


def _replay(sequence: Path, odometry: bool, step: int = 1) -> list[tuple[Estimate, np.ndarray]]:
    """Each estimate with its error (x, y, yaw); images and odometry in order of their stamps."""
    rig, line_map = read_calibration(sequence)
    truth = read_tum(sequence / 'groundtruth.tum').in_order()
    wheels = read_tum(sequence / 'odometry.tum').in_order()
    options = LocaliserOptions(calibration_sigma=AGREEMENT)
    localiser, told, result = Localiser(rig, line_map, options), 0, []
    for stamp, picture in _pictures(sequence, truth, step):
        while odometry and told < len(wheels) and wheels.stamps_ns[told] <= stamp:
            localiser.add_odometry(
                int(wheels.stamps_ns[told]), Pose2.from_array(wheels.poses[told]))
            told += 1
        estimate = localiser.process(stamp, picture)
        row = int(np.argmin(np.abs(truth.stamps_ns - stamp)))
        assert abs(int(truth.stamps_ns[row]) - stamp) < 1_000_000
        error = np.full(3, np.nan)
        if estimate.pose is not None:
            error = estimate.pose.as_array() - truth.poses[row]
            error[2] = wrap_angle(error[2])
        result.append((estimate, error))
    return result


def _rmse(rows: list[tuple[Estimate, np.ndarray]]) -> tuple[float, float]:
    """Translation in mm, yaw in degrees."""
    errors = np.array([error for _, error in rows])
    return (
        1e3 * float(np.sqrt((errors[:, :2] ** 2).sum(axis=1).mean())),
        float(np.degrees(np.sqrt((errors[:, 2] ** 2).mean()))))


def _check_all_tracked(rows: list[tuple[Estimate, np.ndarray]], frames: int) -> None:
    assert len(rows) == frames
    silent = [
        (k, e.state.value, e.reason) for k, (e, _) in enumerate(rows)
        if e.state is not State.TRACKING or e.pose is None]
    assert not silent
    for estimate, error in rows:
        covariance = estimate.covariance
        assert covariance is not None
        np.linalg.cholesky(covariance)
        assert np.sqrt(covariance[0, 0] + covariance[1, 1]) < 0.05
        assert np.hypot(error[0], error[1]) < 0.05
        assert abs(np.degrees(error[2])) < 1.0


@pytest.mark.parametrize(
    ('name', 'odometry', 'step', 'frames'),
    [('dev_clean', False, 1, 40), ('dev_clean', True, 4, 10), ('dev_parabolic', False, 1, 20)])
def test_geometry_alone_to_a_third_of_a_millimetre(
        ray_traced: Path, name: str, odometry: bool, step: int, frames: int) -> None:
    rows = _replay(ray_traced / name, odometry, step)
    _check_all_tracked(rows, frames)
    translation_mm, yaw_deg = _rmse(rows)
    assert translation_mm < 0.3
    assert yaw_deg < 0.005
    for estimate, error in rows:
        # Three degrees of freedom: this is exceeded once in a thousand.
        assert error @ np.linalg.solve(estimate.covariance, error) < 16.3


@pytest.mark.parametrize(('odometry', 'step', 'frames'), [(True, 1, 60), (False, 1, 60)])
def test_a_furnished_room_is_answered_in_every_frame(
        ray_traced: Path, odometry: bool, step: int, frames: int) -> None:
    rows = _replay(ray_traced / 'dev_room', odometry, step)
    _check_all_tracked(rows, frames)
    translation_mm, yaw_deg = _rmse(rows)
    assert translation_mm < 5.0
    assert yaw_deg < 0.1


def test_every_frame_of_a_room_is_found_by_itself(ray_traced: Path) -> None:
    """From each of some frames as the first: no history helps."""
    rig, line_map = read_calibration(ray_traced / 'dev_room')
    truth = read_tum(ray_traced / 'dev_room' / 'groundtruth.tum').in_order()
    localiser, answered, wrong = Localiser(rig, line_map), 0, []
    for k, (stamp, picture) in enumerate(_pictures(ray_traced / 'dev_room', truth, 6)):
        localiser.reset()
        estimate = localiser.process(stamp, picture)
        if estimate.pose is None:
            continue
        answered += 1
        error = estimate.pose.inverse() @ Pose2.from_array(truth.poses[6 * k])
        if np.hypot(error.x, error.y) > 0.05 or abs(np.degrees(error.yaw)) > 1.0:
            wrong.append(6 * k)
    assert not wrong
    assert answered >= 9
