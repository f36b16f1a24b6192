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


"""What a frame costs, stage by stage, against one full-frame HSV threshold of the same image.

Frames of a drive through the arena, with wheels that err, are tracked, then searched as if the
robot were lost; before and after each, the same image is thresholded (cvtColor and inRange). Times
are the thread's own processor time with OpenCV held to one thread, so that what else the machine
does meanwhile is not counted; every ratio is of neighbours in time, and its quartiles are part of
the result.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields
import time
from typing import Any

import cv2
from nccs_pose.errors import OptionError
from nccs_pose.estimation.estimate import Estimate, StageTimes
from nccs_pose.estimation.localiser import Localiser
from nccs_pose.evaluation.tables import table
from nccs_pose.geometry.pose import Array, Pose2
from nccs_pose.simulation.drive import measure_odometry, WheelModel
from nccs_pose.simulation.motion import figure_of_eight
from nccs_pose.simulation.renderer import render
from nccs_pose.simulation.scene import arena_scene
from nccs_pose.vision.segment import hsv_mask
import numpy as np
from numpy.typing import NDArray

TRACKING = 'tracking'
SEARCHING = 'searching'
STAGES = tuple(field.name for field in fields(StageTimes))
LEAST_FRAMES = 4
_RATE = 10.0
_SEED = 4


@dataclass(frozen=True, eq=False)
class StageCosts:
    """Seconds of every frame, and of the threshold pass beside it.

    :ivar width: of the images, px.
    :ivar threshold: of the pass beside each frame, by mode (N,).
    :ivar total: of the frame, by mode (N,); the whole call.
    :ivar stages: of each frame's stages, in the shares that the localiser tells, by mode, in the
        order of STAGES (N, 5).
    :ivar answered: how many frames got a pose, by mode.
    :ivar start_up: from a loaded calibration to the first pose, seconds by the clock.
    """

    width: int
    threshold: dict[str, Array]
    total: dict[str, Array]
    stages: dict[str, Array]
    answered: dict[str, int]
    start_up: float

    def ratio(self, mode: str) -> Array:
        """Cost of each frame over that of the threshold pass (N,)."""
        return self.total[mode] / self.threshold[mode]


def threshold_pass(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """One full-frame HSV threshold: the unit of cost."""
    return hsv_mask(image, 'green')


@contextmanager
def one_thread() -> Iterator[None]:
    """Hold OpenCV to one thread, so that processor times can be compared."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(threads)


def measure_stages(
    width: int, frames: int, *,
    progress: Callable[[str], None] = lambda text: None,
) -> StageCosts:
    """Time tracking and searching on the same drive.

    :param width: of the images, px; 4:3.
    :param frames: of the drive; the first is the start-up and is not counted as tracking.
    :raises OptionError: for fewer than LEAST_FRAMES frames.
    """
    if frames < LEAST_FRAMES:
        raise OptionError(f'frames = {frames}: quartiles need at least {LEAST_FRAMES}')
    scene, track = arena_scene(width), figure_of_eight()
    rng = np.random.default_rng(_SEED)
    wheels = measure_odometry(
        track, frames / _RATE, WheelModel(rate=_RATE), np.random.default_rng([_SEED, 1]), 0)
    images = []
    for k in range(frames):
        images.append(render(scene, track.pose(k / _RATE), rng))
        progress('rendered')
    with one_thread():
        start = time.perf_counter()
        localiser = Localiser(scene.rig, scene.line_map)
        localiser.process(0, images[0])
        start_up = time.perf_counter() - start
        told = [sample.pose for sample in wheels]
        modes = {mode: _run(localiser, told, images, mode, progress)
                 for mode in (TRACKING, SEARCHING)}
    return StageCosts(
        width,
        {mode: np.array([frame.threshold for frame in run]) for mode, run in modes.items()},
        {mode: np.array([frame.total for frame in run]) for mode, run in modes.items()},
        {mode: np.array([frame.stages for frame in run]) for mode, run in modes.items()},
        {mode: sum(frame.answered for frame in run) for mode, run in modes.items()}, start_up)


@dataclass(frozen=True)
class _Frame:
    threshold: float
    total: float
    stages: list[float]
    answered: bool


def _run(
    localiser: Localiser, wheels: list[Pose2], images: list[NDArray[np.uint8]], mode: str,
    progress: Callable[[str], None],
) -> list[_Frame]:
    """Give all images but the first, which only starts tracking, and time them.

    :param wheels: the pose by odometry at each image.
    """
    localiser.reset()
    localiser.add_odometry(_stamp(-1), wheels[0])
    localiser.add_odometry(_stamp(0), wheels[0])
    localiser.process(0, images[0])
    run = []
    for k in range(1, len(images)):
        localiser.add_odometry(_stamp(k), wheels[k])
        if mode == SEARCHING:
            localiser.relocalise()
        run.append(_frame(localiser, k, images[k]))
        progress(mode)
    return run


def _stamp(k: int) -> int:
    return round(k / _RATE * 1e9)


def timed(
    localiser: Localiser, stamp_ns: int, image: NDArray[np.uint8],
) -> tuple[Estimate, float, float]:
    """Give an image to a localiser.

    :returns: its answer; the processor's time of it, s, and of the threshold pass as the mean of
        one before and one after it.
    """
    times = [time.thread_time()]
    threshold_pass(image)
    times.append(time.thread_time())
    estimate = localiser.process(stamp_ns, image)
    times.append(time.thread_time())
    threshold_pass(image)
    times.append(time.thread_time())
    before, frame, after = np.diff(times).tolist()
    return estimate, frame, 0.5 * (before + after)


def _frame(localiser: Localiser, k: int, image: NDArray[np.uint8]) -> _Frame:
    """One frame of the drive."""
    estimate, frame, threshold = timed(localiser, _stamp(k), image)
    # The localiser's stages are by the clock: what they share in is the processor's time.
    share = frame / max(estimate.times.total, 1e-9)
    return _Frame(
        threshold, frame,
        [share * getattr(estimate.times, stage) for stage in STAGES], estimate.pose is not None)


def stages_table(costs: StageCosts) -> str:
    """The costs as Markdown: ratios to the threshold pass, median and quartiles."""
    rows = [['', *(f'{mode}: ratio (quartiles)' for mode in costs.total),
             *(f'{mode}: ms' for mode in costs.total)]]
    rows.append(_row('whole frame', costs, costs.total))
    for number, stage in enumerate(STAGES):
        rows.append(_row(stage, costs, {m: v[:, number] for m, v in costs.stages.items()}))
    rows.append(_row('cvtColor + inRange', costs, costs.threshold))
    answers = ', '.join(
        f'{costs.answered[mode]} of {len(costs.total[mode])} {mode}' for mode in costs.total)
    return (f'{costs.width} x {costs.width * 3 // 4} px; answered {answers}; calibration to '
            f'first pose {costs.start_up:.2f} s.\n\n{table(rows)}')


def _row(name: str, costs: StageCosts, seconds: dict[str, Array]) -> list[str]:
    ratios, milliseconds = [], []
    for mode, values in seconds.items():
        low, middle, high = np.percentile(values / costs.threshold[mode], [25, 50, 75])
        ratios.append(f'{middle:.2f} ({low:.2f} to {high:.2f})')
        milliseconds.append(f'{1e3 * float(np.median(values)):.2f}')
    return [name, *ratios, *milliseconds]


def as_numbers(costs: StageCosts) -> dict[str, Any]:
    """Every single time for JSON, seconds."""
    return {
        'width': costs.width, 'start_up': costs.start_up, 'answered': costs.answered,
        'modes': {mode: {
            'frame': costs.total[mode].tolist(), 'threshold': costs.threshold[mode].tolist(),
            'stages': dict(zip(STAGES, costs.stages[mode].T.tolist()))} for mode in costs.total}}
