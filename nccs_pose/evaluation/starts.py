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
"""What one image alone says of where the robot is, map by map, and what the search costs.

Every trial is an image of a random pose in the middle half of what a map spans, searched from
nothing on the ordinary camera's image of a textured floor. A floor that looks the same from
several places is rightly ambiguous: then the true pose has to be among the candidates. Costs are
the thread's own processor time, and ratios to one full-frame HSV threshold of the same image.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
import dataclasses
from dataclasses import dataclass
import gc
import zlib

from nccs_pose.estimation.estimate import Estimate, State
from nccs_pose.estimation.localiser import Localiser
from nccs_pose.estimation.many_poses import same_pose
from nccs_pose.estimation.options import LocaliserOptions
from nccs_pose.evaluation.pose_error import PoseError
from nccs_pose.evaluation.stages import one_thread, timed
from nccs_pose.evaluation.tables import table
from nccs_pose.geometry.lines import LineMap
from nccs_pose.geometry.pose import Array, Pose2
from nccs_pose.simulation.large_maps import dashes, lattice, parking_bays, scattered
from nccs_pose.simulation.renderer import render
from nccs_pose.simulation.scene import arena_map, arena_scene, Colour, Scene
import numpy as np

# Of its difference to the floor, what is left of a faint tape's colour.
_FAINT = 0.5


@dataclass(frozen=True)
class Place:
    """One row of the table.

    :ivar name: in the table and on the command line.
    :ivar line_map: the tapes.
    :ivar contrast: of their colours to the floor, 1 for ordinary paint.
    :ivar options: of the localiser.
    """

    name: str
    line_map: LineMap
    contrast: float = 1.0
    options: LocaliserOptions = dataclasses.field(default_factory=LocaliserOptions)


PLACES = (
    Place('arena', arena_map()),
    Place('arena, faint tapes', arena_map(), _FAINT),
    Place('scattered', scattered(50, 5.0, (0.5, 3.0), seed=1)),
    Place('scattered, dense', scattered(50, 3.0, (0.3, 1.5), seed=2)),
    Place('parking bays', parking_bays()),
    Place('dashes', dashes()),
    Place('lattice', lattice()),
)


@dataclass(frozen=True, eq=False)
class Starts:
    """What became of a place's images.

    :ivar width: of the images, px.
    :ivar states: how many ended in which.
    :ivar wrong: poses given that are wrong.
    :ivar without: ambiguous ones with no candidate near the truth.
    :ivar cost: of each search, s (N,).
    :ivar threshold: of the threshold pass beside it, s (N,).
    """

    place: Place
    width: int
    states: Counter[State]
    wrong: int
    without: int
    cost: Array
    threshold: Array


def run_starts(
    place: Place, width: int, trials: int, *, seed: int = 7,
    progress: Callable[[str], None] = lambda text: None,
) -> Starts:
    """Search one image after the other, each as if the robot was just switched on.

    :param width: of the images, px; 4:3.
    """
    scene = _scene(place, width)
    localiser = Localiser(scene.rig, scene.line_map, place.options)
    states: Counter[State] = Counter()
    wrong = without = 0
    costs = []
    # As the node does: what is built lives on, and is not gone through at every collection.
    gc.collect()
    gc.freeze()
    try:
        with one_thread():
            for k in range(trials):
                rng = np.random.default_rng([seed, zlib.crc32(place.name.encode()), k])
                pose = _somewhere(place.line_map, rng)
                image = render(scene, pose, rng)
                localiser.reset()
                estimate, cost, threshold = timed(localiser, 0, image)
                states[estimate.state] += 1
                wrong += PoseError.of(estimate, pose).wrong
                without += _is_without(estimate, pose)
                costs.append((cost, threshold))
                progress(place.name)
    finally:
        gc.unfreeze()
    return Starts(place, width, states, wrong, without, *np.array(costs).T)


def _scene(place: Place, width: int) -> Scene:
    """The arena's camera and floor, without walls and things, and the place's tapes."""
    scene = arena_scene(width)
    look = scene.appearance
    paint = {
        name: _mixed(look.floor_colour, colour, place.contrast)
        for name, colour in look.line_colours.items()}
    look = dataclasses.replace(look, room=None, obstacles=(), line_colours=paint)
    return dataclasses.replace(scene, line_map=place.line_map, appearance=look)


def _mixed(floor: Colour, paint: Colour, share: float) -> Colour:
    b, g, r = ((1.0 - share) * np.array(floor) + share * np.array(paint)).tolist()
    return b, g, r


def _somewhere(line_map: LineMap, rng: np.random.Generator) -> Pose2:
    ends = np.concatenate((line_map.starts, line_map.ends))[:, :2]
    low, high = ends.min(axis=0), ends.max(axis=0)
    x, y = 0.5 * (low + high) + rng.uniform(-0.25, 0.25, 2) * (high - low)
    return Pose2(float(x), float(y), rng.uniform(-np.pi, np.pi))


def _is_without(estimate: Estimate, truth: Pose2) -> bool:
    return estimate.state is State.AMBIGUOUS and not any(
        same_pose(candidate.pose, truth) for candidate in estimate.candidates)


def starts_table(rows: list[Starts]) -> str:
    """All places as Markdown; costs as medians, 95 % and the largest."""
    cells = [['place', 'lines', 'px', 'images', 'one pose', 'wrong', 'several',
              'truth not among them', 'none', 'ms', '95 %', 'max', 'ratio']]
    for row in rows:
        one, several = row.states[State.TRACKING], row.states[State.AMBIGUOUS]
        trials = len(row.cost)
        counts = (one, row.wrong, several, row.without, trials - one - several)
        milliseconds = 1e3 * np.percentile(row.cost, [50.0, 95.0, 100.0])
        cells.append([
            row.place.name, str(len(row.place.line_map)), str(row.width), str(trials),
            *map(str, counts), *(f'{ms:.0f}' for ms in milliseconds),
            f'{np.median(row.cost / row.threshold):.1f}'])
    return table(cells)
