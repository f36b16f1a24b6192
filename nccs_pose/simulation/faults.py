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

"""Faults as values, and the drive that they spoil.

A rehearsal is a clean drive. A fault changes something of it for a while (what the camera sees,
its pixels, its stamps, where the robot is) or for good (what the localiser believes, the rig);
`play` gives what the localiser would be told.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
import dataclasses

from nccs_pose.errors import SimulationError
from nccs_pose.geometry.lines import LineMap
from nccs_pose.geometry.pose import Pose2
from nccs_pose.simulation.drive import (
    Drive,
    ImageSample,
    make_drive,
    render_frame,
    Sample,
    WheelModel,
)
from nccs_pose.simulation.motion import figure_of_eight, Loop, random_loop
from nccs_pose.simulation.scene import arena_scene, Scene
import numpy as np

FRAME_RATE = 10.0
CLEAN_FRAMES = 8
FAULTY_FRAMES = 8


@dataclasses.dataclass(frozen=True)
class Event:
    """One thing that the localiser is told.

    :ivar sample: image or odometry.
    :ivar faulty: whether it is an image taken while the fault lasted.
    :ivar after: whether it is an image taken when the fault was over.
    """

    sample: Sample
    faulty: bool = False
    after: bool = False

    @property
    def is_image(self) -> bool:
        return isinstance(self.sample, ImageSample)


@dataclasses.dataclass(frozen=True)
class Fault:
    """What goes wrong; whatever is None stays as it was rehearsed.

    :ivar name: in the table and on the command line.
    :ivar description: one line.
    :ivar faulty_frames: how long it lasts; 0 for what happens between two frames.
    :ivar lasting: it never ends.
    :ivar world: the true scene of the whole drive, from the rehearsed one.
    :ivar drive: the true drive, from the rehearsal.
    :ivar scene: what the camera sees of the world during the fault; is also given the pose of
        the robot in the middle of the fault.
    :ivar pixels: the image that arrives during the fault, from the one that was taken.
    :ivar events: what arrives, from what was sent, each told with whether the fault has begun.
    :ivar belief: the map that the localiser is given, from the world's.
    """

    name: str
    description: str
    faulty_frames: int = FAULTY_FRAMES
    lasting: bool = False
    world: Callable[[Scene], Scene] | None = None
    drive: Callable[[Rehearsal], Drive] | None = None
    scene: Callable[[Scene, Pose2], Scene] | None = None
    pixels: Callable[[np.ndarray, np.random.Generator], np.ndarray] | None = None
    events: Callable[[Iterator[tuple[bool, Event]]], Iterator[Event]] | None = None
    belief: Callable[[LineMap], LineMap] | None = None


@dataclasses.dataclass(frozen=True, eq=False)
class Rehearsal:
    """A clean drive and the frame at which things begin to go wrong.

    :ivar scene: the arena.
    :ivar drive: through it.
    :ivar start: number of the first frame that a fault may touch.
    :ivar seed: of the track and of all noise.
    """

    scene: Scene
    drive: Drive
    start: int = CLEAN_FRAMES
    seed: int = 0
    _images: dict[int, np.ndarray] = dataclasses.field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        if not 0 < self.start < len(self.drive):
            raise SimulationError(
                f'a fault cannot begin at frame {self.start} of a drive of {len(self.drive)}')

    def image(self, frame: int) -> np.ndarray:
        """Give the clean picture of a frame; all faults share it."""
        if frame not in self._images:
            image = render_frame(self.scene, self.drive, frame, self.seed).image
            image.setflags(write=False)
            self._images[frame] = image
        return self._images[frame]


def track(seed: int) -> Loop:
    """Give the track of a rehearsal: a figure of eight for seed 0, else a loop of its own."""
    if seed == 0:
        return figure_of_eight(phase=-0.5 * np.pi)
    return random_loop(np.random.default_rng(seed))


def rehearse(width: int, frames: int, seed: int = 0) -> Rehearsal:
    """Drive through the arena: clean frames, then room for the fault and for recovery."""
    rng = np.random.default_rng([seed, 1])
    drive = make_drive(track(seed), frames, FRAME_RATE, WheelModel(), rng)
    return Rehearsal(arena_scene(width), drive, seed=seed)


@dataclasses.dataclass(frozen=True, eq=False)
class Play:
    """A rehearsal with its fault: what the localiser is given, and is told as time goes by.

    :ivar scene: the world as it is without what lasts only for a while.
    :ivar line_map: what the localiser believes.
    :ivar drive: what the robot truly does.
    :ivar faulty: numbers of the frames that the fault touches.
    """

    fault: Fault
    rehearsal: Rehearsal
    scene: Scene
    line_map: LineMap
    drive: Drive
    faulty: range

    def events(self) -> Iterator[Event]:
        """Give all events in the order of their arrival, each rendered in its turn."""
        marked = self._sent()
        if self.fault.events is None:
            return (event for _, event in marked)
        return self.fault.events(marked)

    def _sent(self) -> Iterator[tuple[bool, Event]]:
        begun = False
        for is_image, k in self.drive.order():
            begun = begun or (is_image and k >= self.rehearsal.start)
            if is_image:
                image = ImageSample(self.drive.stamps_ns[k], self._image(k), self.drive.poses[k])
                yield begun, Event(image, k in self.faulty, k >= self.faulty.stop)
            else:
                yield begun, Event(self.drive.odometry[k])

    def _image(self, frame: int) -> np.ndarray:
        faulty, rehearsal = frame in self.faulty, self.rehearsal
        if faulty and self.fault.scene is not None:
            middle = self.drive.poses[(self.faulty[0] + self.faulty[-1]) // 2]
            scene = self.fault.scene(self.scene, middle)
            image = render_frame(scene, self.drive, frame, rehearsal.seed).image
        elif self.scene is rehearsal.scene and self._as_rehearsed(frame):
            image = rehearsal.image(frame)
        else:
            image = render_frame(self.scene, self.drive, frame, rehearsal.seed).image
        if faulty and self.fault.pixels is not None:
            image = self.fault.pixels(image, np.random.default_rng([rehearsal.seed, frame, 1]))
        return image

    def _as_rehearsed(self, frame: int) -> bool:
        rehearsed = self.rehearsal.drive
        return frame < len(rehearsed) and self.drive.poses[frame] == rehearsed.poses[frame]


def prepare(fault: Fault, rehearsal: Rehearsal) -> Play:
    """Spoil a rehearsal."""
    scene, drive, start = rehearsal.scene, rehearsal.drive, rehearsal.start
    if fault.world is not None:
        scene = fault.world(scene)
    if fault.drive is not None:
        drive = fault.drive(rehearsal)
    line_map = scene.line_map if fault.belief is None else fault.belief(scene.line_map)
    stop = len(drive) if fault.lasting else min(start + fault.faulty_frames, len(drive))
    return Play(fault, rehearsal, scene, line_map, drive, range(start, stop))
