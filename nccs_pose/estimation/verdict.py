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

"""What its measurements, and the strips of its image, say against a pose that was laid there."""

from __future__ import annotations

from dataclasses import dataclass

from nccs_pose.estimation.alignment import Alignment
from nccs_pose.estimation.floor_segments import FloorSegment
from nccs_pose.estimation.options import LocaliserOptions
from nccs_pose.geometry.lines import Line, LineMap
from nccs_pose.geometry.pose import Array, Pose2
import numpy as np
from numpy.typing import NDArray

# A pose rests on a line when it does on this part of the line's stations.
_RESTS = 0.25
# Strips this parallel (rad) count as parallel; one so parallel to a missing line and this near
# (m) is that line, moved.
_PARALLEL = 0.12
_NEAR = 0.6
# A whole line lies off its place when its mean is this many standard deviations from zero; and by
# more than what surrounds a tape shifts it, the more the thinner it is: this over its width, px^2.
_EVIDENT = 7.0
DISTURBED = 0.28
# Residuals of so many times the image's noise, and of more px than the second number, say that the
# lines are other ones than thought, or not seen by this rig: of two lines, of three, and of more.
# More than three are believed where a prediction agrees, unless they lie better elsewhere.
_UNLIKE_NOISE = ((5.0, 0.0), (3.0, 0.3), (3.0, 0.4))


@dataclass(frozen=True)
class Objection:
    """Why a pose is not to be believed.

    :ivar words: the reason.
    :ivar line: the map line that is seen beside its place in this image, by its index; None where
        none is for certain: what lies near a line's place may be another thing.
    :ivar hidden: whether the pose may still be right, if something hides what should be seen.
    :ivar by_strips: whether it is strips that speak against the pose: another look at the image
        may show others.
    """

    words: str
    line: int | None = None
    hidden: bool = False
    by_strips: bool = False


def lines_used(alignment: Alignment) -> int:
    """How many lines a pose rests on; one that the map draws in pieces is one."""
    # A line out of view has no support: NaN is not as large as anything.
    return len({
        whole for whole, part in zip(alignment.whole.tolist(), alignment.support.tolist())
        if part >= _RESTS})


def objection(
    alignment: Alignment, line_map: LineMap, options: LocaliserOptions, *, expected: bool,
) -> Objection | None:
    """What the pose's own lines say against it; None if nothing.

    :param expected: whether a prediction agrees with it. Two lines fix a pose without any
        redundancy, so what should be seen besides them has to be there, or to be expected.
    """
    if alignment.explained < options.least_explained:
        return Objection(
            f'only {100.0 * alignment.explained:.0f} % of the predicted line pixels are there')
    most = options.largest_misfit
    # Neither a stretch nor a line lies farther off than one of its groups, but for a hundredth or
    # two where noise differs within a group.
    if np.abs(alignment.offset).max() > most:
        if alignment.misfit > most:
            return Objection(
                f'whole lines lie {alignment.misfit:.1f} px off: the rig or the map does not fit '
                'the image')
        off = _line_off(alignment, len(line_map), most)
        if off is not None:
            k, offset = off
            return Objection(
                f'{line_name(line_map, k)} lies {offset:.1f} px off: the rig or the map does not '
                'fit the image', line=k)
    used = lines_used(alignment)
    if is_suspect(alignment) and (used < 4 or not expected):
        size = alignment.residual_px
        return Objection(
            f'the {used} lines that it rests on lie {size:.1f} px off, where the noise of the '
            f'image makes {size / alignment.scale:.2f} px')
    if misses_lines(alignment) and not expected:
        return Objection(
            f'it rests on {used} lines and {len(alignment.missing)} more should be in view',
            hidden=True)
    return None


def misses_lines(alignment: Alignment) -> bool:
    """Whether a pose rests on two lines, and there is more to see that is not there."""
    return bool(alignment.missing) and lines_used(alignment) < 3


def is_weak(alignment: Alignment) -> bool:
    """Whether a pose rests on so little, or fits so badly, that it has to be where expected."""
    return lines_used(alignment) < 3 or _is_unlike_noise(alignment, 3)


def is_suspect(alignment: Alignment) -> bool:
    """Whether a pose fits so badly that its lines may be other ones."""
    return _is_unlike_noise(alignment, lines_used(alignment))


def _is_unlike_noise(alignment: Alignment, lines: int) -> bool:
    """Whether the residuals of a pose on so many lines are larger than noise makes them."""
    times, least = _UNLIKE_NOISE[min(max(lines, 2), 4) - 2]
    return alignment.scale > times and alignment.residual_px > least


def _line_off(alignment: Alignment, lines: int, most: float) -> tuple[int, float] | None:
    """The line that as a whole lies farthest off, evidently and by more than so many px.

    :returns: its index in the map and how far it lies off, px.
    """
    # Hardly ever does one lie off so far that its scatter has to be known.
    size = np.abs(_line_means(alignment, lines)[0])
    if size.max() <= most:
        return None
    _, deviation = line_offsets(alignment, lines)
    least = np.maximum(most, _EVIDENT * deviation)
    size[size <= np.fmax(least, DISTURBED / alignment.width)] = 0.0
    k = int(size.argmax())
    return (k, float(size[k])) if size[k] > 0.0 else None


def _line_means(alignment: Alignment, lines: int) -> tuple[Array, Array]:
    """Mean offset of each whole line (L,), px, 0 where unused, and its weight."""
    label, residual, noise = alignment.points.label, alignment.residual, alignment.noise
    # Offsets are the residuals times the noise, and weigh by one over its square.
    total = np.maximum(np.bincount(label, 1.0 / np.square(noise), lines), 1e-12)
    return np.bincount(label, residual / noise, lines) / total, total


def line_offsets(alignment: Alignment, lines: int) -> tuple[Array, Array]:
    """Mean offset of each whole line (L,) and its standard deviation, px; 0 where unused.

    The deviation comes from the line's own scatter: a line that lies off as a whole must not
    pass for noise.
    """
    label, residual = alignment.points.label, alignment.residual
    mean, total = _line_means(alignment, lines)
    scatter = np.bincount(label, np.square(residual), lines) - total * np.square(mean)
    count = np.maximum(np.bincount(label, minlength=lines) - 1, 1)
    return mean, np.sqrt(np.maximum(scatter / count, 1.0) / total)


def line_name(line_map: LineMap, k: int) -> str:
    """A line of the map in words."""
    return f'line {line_map[k].name or f"number {k}"}'


def contradiction(
    alignment: Alignment, segments: tuple[FloorSegment, ...], line_map: LineMap,
) -> Objection | None:
    """Whether a missing line is seen somewhere else; None if not.

    An occluded line is nowhere. A line beside its place says that the map, the rig or the pose
    is wrong, and the pixels cannot tell which.
    """
    if not alignment.missing or not segments:
        return None
    known = _lie_on_map(segments, alignment.pose, line_map).tolist()
    foreign = [strip for strip, lies in zip(segments, known) if not lies]
    for k in alignment.missing:
        for strip in foreign:
            offset = _beside(strip, alignment.pose, line_map[k])
            if offset is not None:
                return Objection(
                    f'{line_name(line_map, k)} is seen {offset:.2f} m beside its place in the map',
                    by_strips=True)
    return None


def _beside(strip: FloorSegment, pose: Pose2, line: Line) -> float | None:
    """How far off a line a parallel strip lies, metres; None where it is something else."""
    ends = pose.apply(np.array([strip.start, strip.end]))
    along = ends[1] - ends[0]
    direction = line.direction[:2]
    sine = abs(along[0] * direction[1] - along[1] * direction[0]) / np.linalg.norm(along)
    if sine > np.sin(_PARALLEL) or strip.colour != line.colour:
        return None
    offset = ends - line.start[:2]
    across = float(np.mean(offset @ line.left[:2]))
    middle = float(np.mean(offset @ direction))
    inside = -_NEAR < middle < line.length + _NEAR
    return abs(across) if inside and abs(across) < _NEAR else None


def _lie_on_map(
    segments: tuple[FloorSegment, ...], pose: Pose2, line_map: LineMap,
) -> NDArray[np.bool_]:
    """Whether each strip is explained by some line of the map (S,)."""
    ends = pose.apply(np.array([(strip.start, strip.end) for strip in segments]))
    offset = ends[:, :, None] - line_map.starts[:, :2]
    x, y = line_map.directions[:, :2].T
    along = offset[..., 0] * x + offset[..., 1] * y
    across = np.abs(offset[..., 1] * x - offset[..., 0] * y).max(axis=1)
    near = np.array([strip.tolerance for strip in segments])
    on = (across < near[:, None]) & (along.max(axis=1) > 0.0) & (
        along.min(axis=1) < line_map.lengths)
    return np.asarray(on.any(axis=1))


def what_is_missing(segments: tuple[FloorSegment, ...]) -> str:
    """Why strips give no pose, in words."""
    if not segments:
        return 'no line-like strip in the image'
    if len(segments) == 1:
        return 'only one line-like strip in the image'
    angles = np.array([np.arctan2(s.normal[1], s.normal[0]) for s in segments])
    if (np.abs(np.sin(angles - angles[0])) < _PARALLEL).all():
        return f'all {len(segments)} line-like strips in the image are parallel'
    return f'no pose explains the {len(segments)} line-like strips in the image'
