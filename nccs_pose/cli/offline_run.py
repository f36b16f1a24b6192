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
"""The localiser over recorded events: one record for every image, whatever became of it."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
import json
import math
import time
from typing import Any

from nccs_pose.errors import FrameRefusedError, NccsPoseError, VisionError
from nccs_pose.estimation.estimate import Answering, Estimate, Quality
from nccs_pose.evaluation.trajectory import Trajectory
from nccs_pose.files.bag_events import BagEvent, StampedImage, StampedOdometry
from nccs_pose.geometry.pose import Array
from nccs_pose.vision.decode import Image
import numpy as np


@dataclass(frozen=True, eq=False)
class FrameRecord:
    """What became of one image.

    :ivar index: its number in the bag, from 0.
    :ivar stamp_ns: the image's stamp, nanoseconds.
    :ivar estimate: the answer; None if the image was refused.
    :ivar refusal: why it was, in words; empty if it was not.
    :ivar seconds: from decoded image to estimate.
    """

    index: int
    stamp_ns: int
    estimate: Estimate | None
    refusal: str
    seconds: float

    @property
    def answered(self) -> bool:
        """Whether it got a pose."""
        return self.estimate is not None and self.estimate.pose is not None


OnFrame = Callable[[FrameRecord, Image | None], None]


def run_events(
    localiser: Answering, events: Iterable[BagEvent], on_frame: OnFrame,
) -> list[FrameRecord]:
    """Feed images and odometry in their order.

    :param on_frame: called after every image with its record and, if it was readable, the image.
    """
    records: list[FrameRecord] = []
    for event in events:
        if isinstance(event, StampedOdometry):
            try:
                localiser.add_odometry(event.stamp_ns, event.pose)
            except FrameRefusedError:
                continue  # odometry began anew
        else:
            record, image = _run_image(localiser, event, len(records))
            records.append(record)
            on_frame(record, image)
    return records


def answered_poses(records: list[FrameRecord]) -> tuple[Trajectory, Array | None]:
    """Poses of the answered frames, and their covariances (N, 3, 3); None if they have none."""
    answers = [r.estimate for r in records if r.answered and r.estimate is not None]
    trajectory = Trajectory(
        np.array([estimate.stamp_ns for estimate in answers], dtype=np.int64),
        np.array([e.pose.as_array() for e in answers if e.pose is not None]))
    if any(estimate.covariance is None for estimate in answers):
        return trajectory, None
    covariances = np.array([estimate.covariance for estimate in answers], dtype=float)
    return trajectory, covariances.reshape(-1, 3, 3)


def record_line(record: FrameRecord) -> str:
    """One record as a line of JSON; no times, so that the same run gives the same bytes."""
    content: dict[str, Any] = {'index': record.index, 'stamp_ns': record.stamp_ns}
    estimate = record.estimate
    if estimate is None:
        content |= {'state': 'refused', 'reason': record.refusal}
    else:
        content |= {'state': estimate.state.value, 'reason': estimate.reason}
        if estimate.pose is not None:
            content |= {
                'pose_x_y_yaw': estimate.pose.as_array().tolist(),
                'covariance': _rows(estimate.covariance)}
        content |= {
            'quality': _quality(estimate.quality),
            'candidates': [
                {'pose_x_y_yaw': candidate.pose.as_array().tolist(), 'score': candidate.score}
                for candidate in estimate.candidates]}
    return repeatable_json(content) + '\n'


def repeatable_json(content: Any, indent: int | None = None) -> str:
    """Write what was calculated, to ten digits.

    The last bits of a double are not the same in every run: with numpy 1.26 now and then a
    covariance is 8e-16 of itself off in a second run over the same images.
    """
    return json.dumps(_to_ten_digits(content), indent=indent)


def _to_ten_digits(content: Any) -> Any:
    if isinstance(content, float):
        return float(f'{content:.10g}')
    if isinstance(content, dict):
        return {key: _to_ten_digits(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [_to_ten_digits(value) for value in content]
    return content


def _run_image(
    localiser: Answering, event: StampedImage, index: int,
) -> tuple[FrameRecord, Image | None]:
    try:
        image = event.decode()
    except VisionError as error:
        return FrameRecord(index, event.stamp_ns, None, f'image: {error}', 0.0), None
    start = time.perf_counter()
    try:
        estimate, refusal = localiser.process(event.stamp_ns, image), ''
    except NccsPoseError as error:
        cause = f'{error.cause}: ' if isinstance(error, FrameRefusedError) else ''
        estimate, refusal = None, f'{cause}{error}'
    seconds = time.perf_counter() - start
    return FrameRecord(index, event.stamp_ns, estimate, refusal, seconds), image


def _quality(quality: Quality) -> dict[str, Any]:
    def clean(value: Any) -> Any:
        return None if isinstance(value, float) and not math.isfinite(value) else value

    return {key: clean(value) for key, value in vars(quality).items()}


def _rows(matrix: Array | None) -> list[list[float]] | None:
    return None if matrix is None else matrix.tolist()
