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

"""A drive: when the camera and the wheels report, and what they report."""

from __future__ import annotations

from collections.abc import Iterator
import dataclasses
import heapq
import itertools
import math

from nccs_pose.errors import SimulationError
from nccs_pose.geometry.pose import Pose2, wrap_angle
from nccs_pose.simulation.motion import integrate_twist, Trajectory, Twist
from nccs_pose.simulation.renderer import render
from nccs_pose.simulation.scene import Scene
import numpy as np

_NS = 1_000_000_000


@dataclasses.dataclass(frozen=True)
class WheelModel:
    """Two driven wheels and their encoders, wrong by a scale each and by noise.

    :ivar rate: of the reports, Hz.
    :ivar track: distance between the wheels, m.
    :ivar left_scale, right_scale: measured over true path of each wheel.
    :ivar noise: standard deviation of a wheel's path over the square root of the path, m^(1/2);
        a wheel that stands still measures nothing.
    """

    rate: float = 20.0
    track: float = 0.33
    left_scale: float = 1.010
    right_scale: float = 1.004
    noise: float = 0.004

    def __post_init__(self) -> None:
        for name in ('rate', 'track', 'left_scale', 'right_scale'):
            if not getattr(self, name) > 0.0:
                raise SimulationError(f'wheel {name} must be > 0, is {getattr(self, name)}')
        if not self.noise >= 0.0:
            raise SimulationError(f'wheel noise must be >= 0, is {self.noise}')


@dataclasses.dataclass(frozen=True)
class OdometrySample:
    """One report of the wheels.

    :ivar stamp_ns: of the report.
    :ivar pose: of base_link in the odometry's own frame, which begins where the drive begins.
    :ivar twist: measured over the last interval.
    """

    stamp_ns: int
    pose: Pose2
    twist: Twist


@dataclasses.dataclass(frozen=True, eq=False)
class ImageSample:
    """One picture.

    :ivar stamp_ns: middle of the exposure.
    :ivar image: (H, W, 3) uint8, BGR.
    :ivar pose: true pose of base_link in the map at the stamp.
    """

    stamp_ns: int
    image: np.ndarray
    pose: Pose2


Sample = ImageSample | OdometrySample


@dataclasses.dataclass(frozen=True)
class Drive:
    """What happens when, before any picture is taken.

    :ivar stamps_ns: of the images, ascending.
    :ivar poses: of base_link in the map at these stamps.
    :ivar twists: at these stamps.
    :ivar odometry: ascending in time, from the first image's stamp or before.
    """

    stamps_ns: tuple[int, ...]
    poses: tuple[Pose2, ...]
    twists: tuple[Twist, ...]
    odometry: tuple[OdometrySample, ...]

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def order(self) -> Iterator[tuple[bool, int]]:
        """Give (is image, number of the image or report) by stamp, reports before images."""
        reports = ((sample.stamp_ns, False, k) for k, sample in enumerate(self.odometry))
        images = ((stamp, True, k) for k, stamp in enumerate(self.stamps_ns))
        return ((is_image, k) for _, is_image, k in heapq.merge(reports, images))


def make_drive(
    trajectory: Trajectory,
    frames: int,
    rate: float = 10.0,
    wheels: WheelModel | None = None,
    rng: np.random.Generator | None = None,
    start_ns: int = 1_000 * _NS,
) -> Drive:
    """Drive along a trajectory and note what the camera and the wheels report.

    :param trajectory: driven from its time 0, which is `start_ns`.
    :param frames: number of images.
    :param rate: of the images, Hz.
    :param wheels: their errors; None leaves odometry away.
    :param rng: source of the odometry's noise; needed when there are noisy wheels.
    :param start_ns: stamp of the first image.
    :raises SimulationError: without frames or a positive rate.
    """
    if frames < 1 or not rate > 0.0:
        raise SimulationError(f'a drive of {frames} frames at {rate} Hz has no image')
    stamps = tuple(start_ns + round(k * _NS / rate) for k in range(frames))
    times = [(stamp - start_ns) / _NS for stamp in stamps]
    odometry: tuple[OdometrySample, ...] = ()
    if wheels is not None:
        rng = rng if rng is not None else np.random.default_rng(0)
        odometry = measure_odometry(trajectory, times[-1], wheels, rng, start_ns)
    return Drive(
        stamps, tuple(trajectory.pose(t) for t in times),
        tuple(trajectory.twist(t) for t in times), odometry)


def measure_odometry(
    trajectory: Trajectory, duration: float, wheels: WheelModel, rng: np.random.Generator,
    start_ns: int,
) -> tuple[OdometrySample, ...]:
    """Give what the encoders make of the first `duration` s, and one report beyond it.

    Each interval counts as an arc, whose length and angle are measured by the two wheels.
    """
    interval = 1.0 / wheels.rate
    count = math.ceil(duration * wheels.rate - 1e-9) + 1
    true = [trajectory.pose(k * interval) for k in range(count + 1)]
    samples = [OdometrySample(start_ns, Pose2(), Twist())]
    pose = Pose2()
    for k, (before, after) in enumerate(itertools.pairwise(true), start=1):
        angle = float(wrap_angle(after.yaw - before.yaw))
        chord = before.inverse() @ after
        half = 0.5 * angle
        arc = chord.x * math.cos(half) + chord.y * math.sin(half)
        arc *= half / math.sin(half) if abs(half) > 1e-8 else 1.0
        side = 0.5 * wheels.track * angle
        noise_left, noise_right = (wheels.noise * rng.standard_normal(2)).tolist()
        left = wheels.left_scale * (arc - side) + noise_left * math.sqrt(abs(arc - side))
        right = wheels.right_scale * (arc + side) + noise_right * math.sqrt(abs(arc + side))
        twist = Twist(0.5 * (left + right) / interval, (right - left) / wheels.track / interval)
        pose = integrate_twist(pose, twist, interval)
        samples.append(OdometrySample(start_ns + round(k * interval * _NS), pose, twist))
    return tuple(samples)


def stream(scene: Scene, drive: Drive, seed: int) -> Iterator[Sample]:
    """Give images and odometry in the order of their stamps, each image rendered in its turn.

    A frame's noise depends on the seed and its number alone, so that any frame can be rendered
    again by itself with `render_frame`.
    """
    for is_image, k in drive.order():
        yield render_frame(scene, drive, k, seed) if is_image else drive.odometry[k]


def render_frame(scene: Scene, drive: Drive, frame: int, seed: int = 0) -> ImageSample:
    """Take the picture of one frame of a drive."""
    rng = np.random.default_rng([seed, frame])
    pose = drive.poses[frame]
    image = render(scene, pose, rng, drive.twists[frame])
    return ImageSample(drive.stamps_ns[frame], image, pose)
