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

"""What is in front of the simulated camera, as values.

A scene is a rig, the map of the tapes and the look of everything else. Colours are BGR
reflectances from 0 to 1, proportional to light; what the camera makes of them is the business of
`nccs_pose.simulation.sensors`.
"""

from __future__ import annotations

from collections.abc import Iterable
import dataclasses
import math
from typing import Any

from nccs_pose.errors import SimulationError
from nccs_pose.geometry.camera import PinholeCamera
from nccs_pose.geometry.lines import Line, LineMap
from nccs_pose.geometry.mirror import QuadricMirror
from nccs_pose.geometry.pose import RigidTransform
from nccs_pose.geometry.rig import Rig
from nccs_pose.simulation.sensors import SensorModel
import numpy as np

Colour = tuple[float, float, float]

LINE_COLOURS: dict[str, Colour] = {
    'green': (0.13, 0.47, 0.06),
    'white': (0.86, 0.87, 0.86),
    'yellow': (0.06, 0.68, 0.78),
    'blue': (0.60, 0.20, 0.05),
    'red': (0.06, 0.06, 0.62),
    'orange': (0.03, 0.30, 0.80),
    'black': (0.02, 0.02, 0.02),
}


@dataclasses.dataclass(frozen=True)
class FloorTexture:
    """The pattern of the floor, painted on the map: it moves with the world, not the robot.

    :ivar contrast, tile_contrast: standard deviation, relative to the floor's colour, of the
        cloudy pattern and of the brightness from tile to tile.
    :ivar tile: edge length of a tile, m.
    :ivar joint, joint_depth: width of the joints between tiles, m, and how much darker they are
        (0 to 1).
    :ivar seed: same seed, same floor.
    """

    contrast: float = 0.07
    tile_contrast: float = 0.06
    tile: float = 0.6
    joint: float = 0.006
    joint_depth: float = 0.35
    seed: int = 1


@dataclasses.dataclass(frozen=True)
class Room:
    """Four walls with pictures, windows and a skirting board, and a ceiling with lamps, m."""

    x_min: float
    x_max: float
    y_min: float
    y_max: float
    height: float = 2.6
    seed: int = 2


@dataclasses.dataclass(frozen=True)
class Obstacle:
    """A vertical cylinder, in the map frame: a person, a bin, a chair's leg.

    :ivar x, y, radius, bottom, top: axis, radius and heights over the floor, m.
    :ivar colour: BGR reflectance.
    """

    x: float
    y: float
    radius: float
    top: float
    colour: Colour = (0.25, 0.2, 0.3)
    bottom: float = 0.0

    def __post_init__(self) -> None:
        if not (self.radius > 0.0 and self.top > self.bottom):
            raise SimulationError(
                f'obstacle at ({self.x}, {self.y}): radius {self.radius} m and height from '
                f'{self.bottom} to {self.top} m do not make a cylinder'
            )


@dataclasses.dataclass(frozen=True)
class RobotBody:
    """What the mirror shows of its own robot: deck, mast and camera, in base_link, m."""

    length: float = 0.44
    width: float = 0.38
    height: float = 0.24
    colour: Colour = (0.10, 0.10, 0.11)
    mast_x: float = -0.19
    mast_y: float = 0.0
    mast_radius: float = 0.012
    mast_colour: Colour = (0.22, 0.22, 0.22)
    camera_radius: float = 0.012
    camera_colour: Colour = (0.03, 0.03, 0.03)


@dataclasses.dataclass(frozen=True)
class Appearance:
    """The look of the scene; the default is a plain floor under even light and nothing else.

    :ivar floor_colour, background, surround: BGR reflectance of the floor, of what is beyond it
        where there is no room, and of the pixels that do not see the mirror.
    :ivar line_colours: BGR reflectance by the colour name of a line of the map.
    :ivar texture, room, body: None leaves them away.
    :ivar light_gradient: relative change of the light per metre along x and y of the map.
    :ivar patches: floor rectangles that are not on the map, drawn over the tapes: paper, dirt.
    :ivar obstacles: things that stand on the floor or hang over it.
    """

    floor_colour: Colour = (0.80, 0.80, 0.80)
    background: Colour = (0.80, 0.80, 0.80)
    surround: Colour = (0.80, 0.80, 0.80)
    line_colours: dict[str, Colour] = dataclasses.field(
        default_factory=lambda: {**LINE_COLOURS, 'green': (0.20, 0.72, 0.20)}
    )
    texture: FloorTexture | None = None
    room: Room | None = None
    body: RobotBody | None = None
    light_gradient: tuple[float, float] = (0.0, 0.0)
    patches: tuple[Line, ...] = ()
    obstacles: tuple[Obstacle, ...] = ()


@dataclasses.dataclass(frozen=True)
class Scene:
    """All that `render` needs but the robot's pose and the random generator."""

    rig: Rig
    line_map: LineMap
    appearance: Appearance = dataclasses.field(default_factory=Appearance)
    sensor: SensorModel = dataclasses.field(default_factory=SensorModel)

    def __post_init__(self) -> None:
        for line in (*self.line_map, *self.appearance.patches):
            if abs(line.start[2]) > 1e-9 or abs(line.end[2]) > 1e-9:
                raise SimulationError(
                    f'line {line.name!r}: the renderer paints floor tapes only, its ends are at '
                    f'z = {line.start[2]} and {line.end[2]} m'
                )
            if line.colour not in self.appearance.line_colours:
                known = ', '.join(sorted(self.appearance.line_colours))
                raise SimulationError(
                    f'line {line.name!r}: no paint of colour {line.colour!r}; there is {known}'
                )

    def mounted(self, T_base_mirror: RigidTransform) -> Scene:
        """The same with the mirror mounted otherwise on the robot."""
        return dataclasses.replace(
            self, rig=dataclasses.replace(self.rig, T_base_mirror=T_base_mirror))

    def with_sensor(self, **changes: Any) -> Scene:
        """The same with some fields of the camera's sensor changed."""
        return dataclasses.replace(self, sensor=dataclasses.replace(self.sensor, **changes))

    def with_tapes(self, *names: str) -> Scene:
        """The same with the tapes of these names only."""
        kept = tuple(line for line in self.line_map if line.name in names)
        return dataclasses.replace(self, line_map=LineMap(kept))

    def with_things(
        self, obstacles: Iterable[Obstacle], patches: Iterable[Line] = (),
    ) -> Scene:
        """The same with more things that stand about and more patches on the floor."""
        look = self.appearance
        look = dataclasses.replace(
            look, obstacles=(*look.obstacles, *obstacles), patches=(*look.patches, *patches))
        return dataclasses.replace(self, appearance=look)

    def with_parallel_tapes(self) -> Scene:
        """The arena with its northern tape turned until it is exactly parallel to the southern."""
        south, east, north, west = self.line_map
        half = 0.5 * north.length * south.direction
        middle = 0.5 * (north.start + north.end)
        turned = dataclasses.replace(north, start=middle + half, end=middle - half)
        return dataclasses.replace(self, line_map=LineMap((south, east, turned, west)))


def arena_rig() -> Rig:
    """Give the rig of config/arena_rig.yaml: a 32 mm sphere over a Pioneer, camera off axis."""
    return Rig(
        mirror=QuadricMirror(A=1.0, B=0.0, C=0.001024, rim_radius=0.032),
        camera=PinholeCamera(width=1280, height=960, fx=750.0, fy=750.0, cx=641.0, cy=477.5),
        cop=np.array([0.0, -0.0175, 0.060]),
        # The optical axis meets the sphere's centre: tilted by the angle whose sine is 0.28.
        R_mirror_camera=np.array([[1.0, 0.0, 0.0], [0.0, -0.96, 0.28], [0.0, -0.28, -0.96]]),
        T_base_mirror=RigidTransform.from_rpy(
            np.array([3.1469, -0.0038, -0.7]), np.array([0.04, -0.01, 0.75])
        ),
    )


def arena_map() -> LineMap:
    """Give the map of config/arena_map.yaml: four tapes, no two poses look the same."""
    ends = {
        'south': ((-1.75, -1.30), (1.45, -1.42)),
        'east': ((1.92, -1.05), (1.78, 1.10)),
        'north': ((1.20, 1.36), (-1.05, 1.22)),
        'west': ((-1.80, 0.95), (-1.93, -0.85)),
    }
    return LineMap(
        tuple(
            Line(
                start=np.array([*start, 0.0]),
                end=np.array([*end, 0.0]),
                width=0.05,
                colour='green',
                name=name,
            )
            for name, (start, end) in ends.items()
        )
    )


def ideal_scene(width: int = 1280, noise: float = 0.05) -> Scene:
    """Give the arena with nothing but tapes, and grey-level noise alone.

    One grey, one green; every channel of every pixel has independent Gaussian noise of
    `noise` x 255 grey levels. Tape and floor differ by 0.85 x 255 over the three channels.
    """
    rig = arena_rig().scaled(width / 1280)
    return Scene(rig, arena_map(), Appearance(), SensorModel(read_noise=noise))


def arena_scene(width: int = 1280) -> Scene:
    """Give the arena in a room: texture, walls, robot, uneven light, an ordinary camera."""
    appearance = Appearance(
        floor_colour=(0.30, 0.34, 0.36),
        background=(0.5, 0.5, 0.5),
        surround=(0.05, 0.05, 0.05),
        line_colours=dict(LINE_COLOURS),
        texture=FloorTexture(),
        room=Room(-3.1, 3.4, -2.6, 2.5),
        body=RobotBody(),
        light_gradient=(0.06, -0.04),
        obstacles=(
            Obstacle(2.9, 1.9, 0.25, 0.75, colour=(0.08, 0.24, 0.40)),
            Obstacle(-2.6, -2.1, 0.18, 0.5, colour=(0.12, 0.42, 0.08)),
        ),
    )
    sensor = SensorModel(
        exposure=0.8,
        white_balance=(0.94, 1.0, 1.05),
        vignetting=0.25,
        psf_sigma=0.5 * math.sqrt(width / 1280),
        read_noise=0.004,
        shot_noise=0.018,
        gamma=2.2,
        jpeg_quality=90,
    )
    rig = arena_rig().scaled(width / 1280)
    return Scene(rig, arena_map(), appearance, sensor)
