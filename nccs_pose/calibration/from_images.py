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

"""From images to a calibration: the localiser measures, and measures again under a better rig."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
import math

from nccs_pose.calibration.blob_labels import label_blobs
from nccs_pose.calibration.observations import (
    evenly,
    FrameObservation,
    LEAST_LINES,
    observed,
)
from nccs_pose.calibration.options import CalibrationOptions
from nccs_pose.calibration.parameters import RigParameters
from nccs_pose.calibration.procedure import calibrate, Calibration, converge
from nccs_pose.errors import CalibrationError, FrameRefusedError
from nccs_pose.estimation.estimate import Estimate
from nccs_pose.estimation.localiser import Localiser
from nccs_pose.estimation.options import LocaliserOptions
from nccs_pose.geometry.lines import LineMap
from nccs_pose.geometry.pose import Array
from nccs_pose.geometry.rig import Rig
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Images = Callable[[], Iterable[tuple[int, Image]]]

_PASSES = 4
_LEAST_FRAMES = 2  # images that a better rig may be estimated from, to follow more under it
_TRIED_IMAGES = 30  # images that are tried by themselves, and that a rig is tried on
# A rough rig fits a single image better if that image may have a height and a tilt of its own.
_ROUGHLY = LocaliserOptions(height_sigma=0.01, tilt_sigma=0.005)
# In the end height and tilt are what is to be found; no frame may have its own.
_STRICTLY = LocaliserOptions(height_sigma=0.0)


@dataclass(frozen=True, eq=False)
class Measured:
    """What the localiser made of a drive under one rig.

    :ivar frames: those that it tracked, or could lay a pose on at all.
    :ivar poses: theirs, T_map_base (F, 3).
    :ivar seen: how many images there were.
    :ivar reasons: why the others gave nothing, with counts.
    """

    frames: list[FrameObservation]
    poses: Array
    seen: int
    reasons: Counter[str]

    @property
    def usable(self) -> int:
        """How many frames show enough lines to calibrate from."""
        return sum(len(frame.lines) >= LEAST_LINES for frame in self.frames)


def measure(
    rig: Rig, line_map: LineMap, images: Iterable[tuple[int, Image]],
    options: LocaliserOptions = _STRICTLY, *, doubted: bool = False,
    look: Callable[[Estimate], None] = lambda estimate: None,
) -> Measured:
    """Run the localiser over images and keep what it measured on the lines.

    The localiser measures the middle of the tapes, with the curve's bias taken out.

    :param doubted: keep poses that it doubts as well, if they rest on three lines.
    :param look: shown every answer of the localiser, poses that it doubts included.
    """
    localiser = Localiser(rig, line_map, options)
    frames: list[FrameObservation] = []
    poses: list[Array] = []
    reasons: Counter[str] = Counter()
    seen = 0
    for stamp_ns, image in images:
        seen += 1
        try:
            estimate = localiser.process(stamp_ns, image)
        except FrameRefusedError as error:
            reasons[error.cause] += 1
            continue
        look(estimate)
        found = observed(estimate, doubted=doubted)
        if found is None:
            reasons[estimate.reason] += 1
            continue
        frames.append(found[0])
        poses.append(found[1].as_array())
    return Measured(frames, np.array(poses).reshape(-1, 3), seen, reasons)


def calibrate_images(
    rig: Rig, line_map: LineMap, images: Images, options: CalibrationOptions | None = None,
    free_lines: Sequence[str] = (), on_pass: Callable[[str], None] = lambda words: None,
) -> Calibration:
    """Refine a rough rig from the images of a drive.

    Under the rough rig the localiser follows some frames, or lays poses on them that it doubts,
    and from these a better rig is estimated, under which it follows more. Where that leads
    nowhere, it is begun with single images, and with the blobs of the lines' colour.

    :param images: gives (stamp in ns, BGR image) anew at each call.
    :param on_pass: told in words how far it is.
    :raises CalibrationError: with a sentence that says what is missing.
    """
    options = options or CalibrationOptions()
    parameters = RigParameters(rig, line_map, options, free_lines)
    refused: CalibrationError | None = None
    for begun in _beginnings(parameters, images, options, on_pass):
        try:
            measured = _follow(parameters, begun, images, options, on_pass)
            result = calibrate(
                rig, line_map, measured.frames, options, free_lines, measured.poses)
            # The noise was measured with what the last rig left in the residuals; now it is clean.
            measured = measure(result.model.rig, result.model.line_map, images())
            if measured.usable == 0:
                raise CalibrationError(_what_is_missing(measured))
            return calibrate(rig, line_map, measured.frames, options, free_lines, measured.poses)
        except CalibrationError as error:
            refused = refused or error
    assert refused is not None  # there is always the rough rig to begin with
    raise refused


def _beginnings(
    parameters: RigParameters, images: Images, options: CalibrationOptions,
    on_pass: Callable[[str], None],
) -> Iterator[Measured]:
    """What can be followed under rigs to begin with, each asked for when those before fail."""
    rough = parameters.rough
    measured = _measure_roughly(rough.rig, rough.line_map, images)
    found = f'of {measured.seen} images followed roughly'
    on_pass(f'{len(measured.frames)} {found} under the rough rig')
    yield measured
    single = _from_single_images(parameters, measured, images, options)
    if single is not None:
        measured = _measure_roughly(single, rough.line_map, images)
        on_pass(f'{len(measured.frames)} {found} after a first guess from one of them')
        yield measured
    blobs = _from_blobs(parameters, images, options)
    if blobs is not None:
        measured = _measure_roughly(blobs, rough.line_map, images)
        on_pass(f'{len(measured.frames)} {found} after a first guess from the blobs of the lines')
        yield measured


def _follow(
    parameters: RigParameters, measured: Measured, images: Images, options: CalibrationOptions,
    on_pass: Callable[[str], None],
) -> Measured:
    """Refine the rig and follow more images under it, in turn, until they become no more.

    :raises CalibrationError: if nothing explains what was measured, or too little was.
    """
    line_map, before = parameters.rough.line_map, 0
    for _ in range(_PASSES):
        if measured.usable < _LEAST_FRAMES:
            raise CalibrationError(_what_is_missing(measured))
        better = _refined(parameters, measured.frames, measured.poses, options)
        measured = measure(better, line_map, images())
        on_pass(f'{len(measured.frames)} of {measured.seen} images followed under a refined rig')
        if measured.usable < options.min_frames:
            measured = _measure_roughly(better, line_map, images)
        if len(measured.frames) <= before:
            break
        before = len(measured.frames)
    if measured.usable < min(options.min_frames, measured.seen):
        raise CalibrationError(_what_is_missing(measured))
    return measured


def _refined(
    parameters: RigParameters, frames: Sequence[FrameObservation], poses: Array,
    options: CalibrationOptions,
) -> Rig:
    """The rig that explains frames with known poses (F, 3) at all.

    :raises CalibrationError: if none does.
    """
    return parameters.model(converge(parameters, frames, poses, options), with_rim=True).rig


def _measure_roughly(rig: Rig, line_map: LineMap, images: Images) -> Measured:
    return measure(rig, line_map, images(), _ROUGHLY, doubted=True)


def _what_is_missing(measured: Measured) -> str:
    if measured.seen == 0:
        return 'there is no image to calibrate from'
    if not measured.reasons:
        return (f'too few images to calibrate from: {measured.seen}, of which {measured.usable} '
                f'show {LEAST_LINES} lines or more')
    reason, count = measured.reasons.most_common(1)[0]
    return (f'the lines could not be followed in {measured.seen} images (in {count}: {reason}); '
            'the map, the kind of mirror or the colour of the lines is wrong, or the rough rig is '
            'too far off')


def _from_single_images(
    parameters: RigParameters, measured: Measured, images: Images, options: CalibrationOptions,
) -> Rig | None:
    """The rig that one of the images asks for under which most others can be followed.

    A rough rig shows image after image from the same wrong place, where three lines fit. They are
    many and agree with each other; one from the right place agrees with the rest of the drive.
    """
    if not measured.frames:
        return None
    best, most = None, _LEAST_FRAMES - 1
    # Read once: every rig is tried on them.
    some = list(islice(images(), 0, None, math.ceil(measured.seen / _TRIED_IMAGES)))
    for k in evenly(len(measured.frames), _TRIED_IMAGES):
        try:
            better = _refined(
                parameters, measured.frames[k:k + 1], measured.poses[k:k + 1], options)
        except CalibrationError:
            continue
        count = len(_measure_roughly(better, parameters.rough.line_map, lambda: some).frames)
        if count > most:
            best, most = better, count
    return best


def _from_blobs(
    parameters: RigParameters, images: Images, options: CalibrationOptions,
) -> Rig | None:
    """A better rig from what has the lines' colour, each blob one line; None if there is none."""
    rough = parameters.rough
    frames, poses = label_blobs(rough.rig, rough.line_map, images())
    if len(frames) < 3:
        return None
    try:
        return _refined(parameters, frames, poses, options)
    except CalibrationError:
        return None
