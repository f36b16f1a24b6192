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

"""Whether a pose that was laid on an image may be believed."""

from __future__ import annotations

from nccs_pose.estimation.alignment import Alignment
from nccs_pose.estimation.floor_segments import FloorSegment
from nccs_pose.estimation.options import LocaliserOptions
from nccs_pose.geometry.lines import Line, LineMap
from nccs_pose.geometry.pose import Pose2
import numpy as np

# A strip this near a missing line (m) and this parallel to it (rad) is that line, moved.
_NEAR = 0.6
_PARALLEL = 0.12
# A strip closer than this to a map line lies on it, metres beyond its own footprint.
_ON = 0.06


def objection(
    alignment: Alignment, options: LocaliserOptions, *, expected: bool,
) -> str:
    """Why a pose is not to be believed, in words; empty if it is.

    :param expected: whether a prediction agrees with it. Two lines fix a pose without any
        redundancy, so what should be seen besides them has to be there, or to be expected.
    """
    if alignment.explained < options.least_explained:
        return f'only {100.0 * alignment.explained:.0f} % of the predicted line pixels are there'
    if alignment.misfit > options.largest_misfit:
        return (f'whole lines lie {alignment.misfit:.1f} px off: the rig or the map does not '
                'fit the image')
    if len(alignment.lines) < 3 and alignment.missing and not expected:
        return (f'it rests on {len(alignment.lines)} lines and {len(alignment.missing)} more '
                'should be in view')
    return ''


def contradiction(
    alignment: Alignment, segments: tuple[FloorSegment, ...], line_map: LineMap,
) -> str:
    """Whether a missing line is seen somewhere else, in words; empty if not.

    An occluded line is nowhere. A line beside its place says that the map, the rig or the pose
    is wrong, and the pixels cannot tell which.
    """
    for k in alignment.missing:
        for strip in segments:
            if _lies_on_map(strip, alignment.pose, line_map):
                continue
            offset = _beside(strip, alignment.pose, line_map[k])
            if offset is not None:
                name = line_map[k].name or f'number {k}'
                return f'line {name} is seen {offset:.2f} m beside its place in the map'
    return ''


def _beside(strip: FloorSegment, pose: Pose2, line: Line) -> float | None:
    """How far off a line a parallel strip lies, metres; None where it is something else."""
    ends = pose.apply(np.array([strip.start, strip.end]))
    along = ends[1] - ends[0]
    direction = line.direction[:2]
    sine = abs(along[0] * direction[1] - along[1] * direction[0]) / np.linalg.norm(along)
    if sine > np.sin(_PARALLEL) or strip.colour != line.colour:
        return None
    offset = ends - line.start[:2]
    across = float(np.mean(offset @ np.array([-direction[1], direction[0]])))
    middle = float(np.mean(offset @ direction))
    inside = -_NEAR < middle < line.length + _NEAR
    return abs(across) if inside and abs(across) < _NEAR else None


def _lies_on_map(strip: FloorSegment, pose: Pose2, line_map: LineMap) -> bool:
    """Whether a strip is explained by some line of the map."""
    ends = pose.apply(np.array([strip.start, strip.end]))
    for line in line_map:
        direction = line.direction[:2]
        offset = ends - line.start[:2]
        across = np.abs(offset @ np.array([-direction[1], direction[0]]))
        along = offset @ direction
        if (across.max() < _ON + 1.5 * strip.footprint and along.max() > 0.0
                and along.min() < line.length):
            return True
    return False
