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

"""Everything that must not fool the localiser, by name."""

from __future__ import annotations

from collections.abc import Callable, Iterator
import dataclasses
import functools
import math

import cv2
from nccs_pose.geometry.lines import Line, LineMap
from nccs_pose.geometry.pose import Pose2, RigidTransform
from nccs_pose.simulation.drive import Drive, ImageSample, make_drive, WheelModel
from nccs_pose.simulation.faults import Event, Fault, Rehearsal, track
from nccs_pose.simulation.scene import Obstacle, Scene
from nccs_pose.simulation.sensors import compress
import numpy as np

_GREEN = (0.12, 0.45, 0.08)


def _level(value: int) -> Callable[[np.ndarray, np.random.Generator], np.ndarray]:
    return lambda image, _: np.full_like(image, value)


def _jpeg(quality: int) -> Callable[[np.ndarray, np.random.Generator], np.ndarray]:
    return lambda image, _: compress(image, quality)


def _noisy(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    noise = 25.5 * rng.standard_normal(image.shape, dtype=np.float32)
    return np.clip(np.rint(image + noise), 0, 255).astype(np.uint8)


def _defocused(image: np.ndarray, _: np.random.Generator) -> np.ndarray:
    return cv2.GaussianBlur(image, (0, 0), image.shape[1] / 640.0 * 2.0)


def _sensor(**gains: float) -> Callable[[Scene, Pose2], Scene]:
    """Multiply the exposure and the white balance (blue, green, red)."""

    def change(scene: Scene, _: Pose2) -> Scene:
        sensor = scene.sensor
        blue, green, red = sensor.white_balance
        balance = (blue * gains.get('blue', 1.0), green * gains.get('green', 1.0),
                   red * gains.get('red', 1.0))
        return scene.with_sensor(
            exposure=sensor.exposure * gains.get('exposure', 1.0), white_balance=balance)

    return change


def _shaken(scene: Scene, _: Pose2) -> Scene:
    return scene.with_sensor(exposure_time=0.08, exposure_steps=5)


def _littered(scene: Scene, _: Pose2) -> Scene:
    """Lay green paper and a green strip on the floor and stand green boxes about."""

    def paper(x: float, y: float, dx: float, dy: float, width: float) -> Line:
        middle, half = np.array([x, y, 0.0]), 0.5 * np.array([dx, dy, 0.0])
        return Line(middle - half, middle + half, width, 'green', 'paper')

    patches = (paper(0.4, 0.9, 0.3, 0.1, 0.21), paper(-0.9, -0.8, 0.1, 0.3, 0.3),
               paper(1.2, -0.5, 0.2, 0.2, 0.1), paper(-1.2, 0.9, 0.7, 0.5, 0.04))
    boxes = [Obstacle(2.3, -0.6, 0.15, 0.3, _GREEN), Obstacle(-0.4, 1.8, 0.12, 0.5, _GREEN),
             Obstacle(0.6, -2.0, 0.2, 0.25, _GREEN)]
    return scene.with_things(boxes, patches)


def _crowded(lines: int, scene: Scene, pose: Pose2) -> Scene:
    """Stand people between the robot and the first lines of the map, so that these are hidden."""
    people, robot = [], pose.as_array()[:2]
    for line in list(scene.line_map)[:lines]:
        # Shoulder to shoulder, two thirds of the way to the line and a bit beyond its ends.
        ends = robot + 0.65 * (np.stack([line.start, line.end])[:, :2] - robot)
        for share in np.linspace(-0.05, 1.05, 2 + int(np.linalg.norm(ends[1] - ends[0]) / 0.3)):
            x, y = ends[0] + share * (ends[1] - ends[0])
            people.append(Obstacle(float(x), float(y), 0.2, 1.7, (0.25, 0.15, 0.2)))
    return scene.with_things(people)


def _only(*names: str) -> Callable[[Scene, Pose2], Scene]:
    return lambda scene, _: scene.with_tapes(*names)


def _one_moved(line_map: LineMap) -> LineMap:
    """Believe the eastern line 0.2 m farther out than it is."""
    shift = np.array([0.2, 0.0, 0.0])
    return LineMap(tuple(
        dataclasses.replace(line, start=line.start + shift, end=line.end + shift)
        if line.name == 'east' else line
        for line in line_map))


def _mirror_moved(scene: Scene, _: Pose2) -> Scene:
    """Knock the mirror 1 mm sideways, against the camera and the robot."""
    rig, shift = scene.rig, np.array([0.0, 0.001, 0.0])
    mounting = rig.T_base_mirror
    moved = dataclasses.replace(
        rig, cop=rig.cop - shift,
        T_base_mirror=RigidTransform(mounting.rotation, mounting.apply(shift)))
    return dataclasses.replace(scene, rig=moved)


def _carried(rehearsal: Rehearsal, put_down: Pose2) -> Drive:
    """Lift the robot where the fault begins; its wheels do not notice, and it drives on."""
    drive, start = rehearsal.drive, rehearsal.start
    lifted = drive.poses[start]
    poses = tuple(
        pose if k < start else put_down @ (lifted.inverse() @ pose)
        for k, pose in enumerate(drive.poses))
    return dataclasses.replace(drive, poses=poses)


def _carried_away(rehearsal: Rehearsal) -> Drive:
    """Put the robot down 2 m away, on the side where it stays farthest from the arena's border."""

    def reach(drive: Drive) -> float:
        return max(max(abs(pose.x) / 2.0, abs(pose.y) / 1.5) for pose in drive.poses)

    pose = rehearsal.drive.poses[rehearsal.start]
    ways = (Pose2(2.0 * math.cos(angle), 2.0 * math.sin(angle), 0.0)
            for angle in np.linspace(0.0, 2.0 * np.pi, 32, endpoint=False))
    return min((_carried(rehearsal, way @ pose) for way in ways), key=reach)


def _turned_round(rehearsal: Rehearsal) -> Drive:
    pose = rehearsal.drive.poses[rehearsal.start]
    return _carried(rehearsal, pose @ Pose2(0.0, 0.0, np.pi))


def _faster(rehearsal: Rehearsal) -> Drive:
    drive, seed = rehearsal.drive, rehearsal.seed
    return make_drive(
        track(seed), 2 * len(drive), 40.0, WheelModel(), np.random.default_rng([seed, 1]),
        drive.stamps_ns[0])


def _dropped(events: Iterator[tuple[bool, Event]]) -> Iterator[Event]:
    return (event for _, event in events if not event.faulty)


def _frozen(events: Iterator[tuple[bool, Event]]) -> Iterator[Event]:
    """Repeat the last good picture under new stamps."""
    last = None
    for _, event in events:
        sample = event.sample
        if isinstance(sample, ImageSample):
            if event.faulty and last is not None:
                event = dataclasses.replace(event, sample=dataclasses.replace(sample, image=last))
            else:
                last = sample.image
        yield event


def _doubled(events: Iterator[tuple[bool, Event]]) -> Iterator[Event]:
    for _, event in events:
        yield event
        if event.faulty:
            yield event


def _disordered(events: Iterator[tuple[bool, Event]]) -> Iterator[Event]:
    """Let every second picture overtake the one before."""
    held = None
    for _, event in events:
        if held is None and event.faulty:
            held = event
            continue
        yield event
        if held is not None and event.is_image:
            yield held
            held = None


def _clock_jump(seconds: int, events: Iterator[tuple[bool, Event]]) -> Iterator[Event]:
    for begun, event in events:
        if begun:
            stamp = event.sample.stamp_ns + seconds * 1_000_000_000
            sample = dataclasses.replace(event.sample, stamp_ns=stamp)
            event = dataclasses.replace(event, sample=sample)
        yield event


def _wheels_begun_anew(events: Iterator[tuple[bool, Event]]) -> Iterator[Event]:
    """Silence the wheels for 0.3 s, after which they count from zero."""
    silent_ns, origin = None, None
    for begun, event in events:
        sample = event.sample
        if begun and not isinstance(sample, ImageSample):
            silent_ns = sample.stamp_ns if silent_ns is None else silent_ns
            if sample.stamp_ns - silent_ns < 300_000_000:
                continue
            origin = sample.pose if origin is None else origin
            sample = dataclasses.replace(sample, pose=origin.inverse() @ sample.pose)
            event = dataclasses.replace(event, sample=sample)
        yield event


def _occluders() -> tuple[Fault, ...]:
    words = ('one line', 'two lines', 'three lines', 'all four lines')
    return tuple(
        Fault(f'occluded_{n}', f'people stand in front of {word}',
              scene=functools.partial(_crowded, n))
        for n, word in enumerate(words, start=1))


FAULTS: tuple[Fault, ...] = (
    Fault('none', 'nothing goes wrong', faulty_frames=0),
    Fault('black', 'black frames', pixels=_level(0)),
    Fault('white', 'white frames', pixels=_level(255)),
    Fault('saturated', 'sixteen times the light', scene=_sensor(exposure=16.0)),
    Fault('frozen', 'the same picture under new stamps', events=_frozen),
    Fault('dropped', 'frames that never arrive', events=_dropped),
    Fault('duplicate', 'every frame arrives twice', events=_doubled),
    Fault('disordered', 'pairs of frames arrive the wrong way round', events=_disordered),
    Fault('clock_back', 'the clock jumps back 100 s', 0,
          events=functools.partial(_clock_jump, -100)),
    Fault('clock_ahead', 'the clock jumps ahead 1000 s', 0,
          events=functools.partial(_clock_jump, 1000)),
    Fault('wheels_anew', 'the wheels fall silent and count from zero, in the dark',
          pixels=_level(0), events=_wheels_begun_anew),
    Fault('defocus', 'out of focus, 2 px at 640', pixels=_defocused),
    Fault('motion_blur', '80 ms shutter', scene=_shaken),
    Fault('noise', 'Gaussian noise of 10 % of full scale', pixels=_noisy),
    Fault('jpeg_20', 'JPEG quality 20', pixels=_jpeg(20)),
    Fault('two_stops_up', 'exposure + 2 stops', scene=_sensor(exposure=4.0)),
    Fault('two_stops_down', 'exposure - 2 stops', scene=_sensor(exposure=0.25)),
    Fault('warm_cast', 'tungsten light', scene=_sensor(blue=0.6, red=1.4)),
    Fault('cold_cast', 'blue light', scene=_sensor(blue=1.4, red=0.65)),
    Fault('green_cast', 'green light', scene=_sensor(blue=0.8, green=1.25, red=0.8)),
    Fault('green_litter', 'green paper, a green strip and green boxes', scene=_littered),
    *_occluders(),
    Fault('one_line', 'only the southern line is there', scene=_only('south')),
    Fault('parallel_lines', 'only two parallel lines are there',
          world=Scene.with_parallel_tapes, scene=_only('south', 'north')),
    Fault('map_line_moved', 'the map has one line 0.2 m off', lasting=True, belief=_one_moved),
    Fault('carried_2m', 'the robot is carried 2 m away', 0, drive=_carried_away),
    Fault('turned_180', 'the robot is turned by 180 degrees', 0, drive=_turned_round),
    Fault('mirror_moved', 'the mirror is knocked by 1 mm', lasting=True, scene=_mirror_moved),
    Fault('four_times_faster', 'images at 40 Hz', lasting=True, drive=_faster),
)
