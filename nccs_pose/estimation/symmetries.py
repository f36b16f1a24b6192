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

"""The motions of a map that change nothing of what is seen."""

from __future__ import annotations

from nccs_pose.estimation.many_poses import SAME_YAW
from nccs_pose.estimation.whole_lines import whole_lines
from nccs_pose.geometry.lines import LineMap
from nccs_pose.geometry.pose import Pose2, wrap_angle
import numpy as np

# Tapes whose ends are this close look the same, metres.
_SAME_TAPE = 0.05


def map_symmetries(line_map: LineMap) -> tuple[Pose2, ...]:
    """Every motion S of the map that lays its tapes on tapes of the same length and colour.

    From S @ T_map_base the map looks as it does from T_map_base. The identity comes first; a map
    without symmetry has nothing else. Where tapes are drawn in pieces makes no difference.
    """
    line_map = whole_lines(line_map)
    ends = np.stack([line_map.starts[:, :2], line_map.ends[:, :2]], axis=1)
    colours = np.array([line.colour for line in line_map])
    alike = colours[:, None] == colours
    alike &= np.abs(line_map.lengths[:, None] - line_map.lengths) < _SAME_TAPE
    # Every such motion turns about the tapes' common centre of gravity.
    centre = line_map.lengths @ ends.mean(axis=1) / line_map.lengths.sum()
    x, y = centre.tolist()
    heading = np.arctan2(line_map.directions[:, 1], line_map.directions[:, 0])
    # The tape that may lie on the fewest others leaves the fewest turns to try.
    first = int(alike.sum(axis=1).argmin())
    turns = (heading[alike[first]] - heading[first])[:, None] + [0.0, np.pi]
    found = [Pose2(0.0, 0.0, 0.0)]
    for turn in np.sort(turns.ravel() % (2.0 * np.pi)):
        motion = Pose2(x, y, float(turn)) @ Pose2(-x, -y, 0.0)
        moved = motion.apply(ends.reshape(-1, 2)).reshape(ends.shape)
        off = np.minimum(
            *(np.linalg.norm(moved[:, None] - there, axis=3).max(axis=2)
              for there in (ends, ends[:, ::-1])))
        lands = (alike & (off < _SAME_TAPE)).any(axis=1).all()
        if lands and all(abs(wrap_angle(motion.yaw - other.yaw)) > SAME_YAW for other in found):
            found.append(motion)
    return tuple(found)
