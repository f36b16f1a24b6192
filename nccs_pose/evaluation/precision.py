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


"""How precise a pose is against what the image allows, and against the paper's sampling.

On ideal renderings (one grey, one green, independent noise on every channel) the Cramér-Rao bound
of the image itself is known: the noise-free image is differenced over the pose. Each image is
given to the localiser, which searches it from nothing, with the mirror's height held and with its
defaults, which estimate the height along; each is compared with the bound for what it takes for
known. The paper's sampling gets the true label of every pixel and a warm start, so that only its
precision is compared. The mirror is hung straight, because the paper's motion model knows no tilt.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
import math
from typing import Any

from nccs_pose.errors import EstimationError, OptionError
from nccs_pose.estimation.localiser import Localiser
from nccs_pose.estimation.options import LocaliserOptions
from nccs_pose.estimation.paper import paper_estimate
from nccs_pose.estimation.refine import refine
from nccs_pose.evaluation.tables import table
from nccs_pose.geometry.pose import Array, Pose2, RigidTransform
from nccs_pose.geometry.small_matrices import inverse
from nccs_pose.simulation.renderer import expected_image, render
from nccs_pose.simulation.scene import ideal_scene, Scene
from nccs_pose.vision.segment import hsv_mask
import numpy as np
from numpy.typing import NDArray

OURS = 'localiser, from the image alone'
DEFAULT = "the same, the mirror's height estimated along (default)"
WEIGHTED = '75 random blob pixels a line, pixel-weighted'
PAPER = "75 random blob pixels a line, the paper's objective"
PAPER_FREE = "75 random blob pixels a line, the paper's without g2"
METHODS = (OURS, DEFAULT, WEIGHTED, PAPER, PAPER_FREE)
PIXELS_A_LINE = 75

# Small against a pixel's footprint on the floor, large against the renderer's rounding; m, rad.
_STEP = 2e-4
# Where the robot stands, |x| and |y| in m; the tapes are 0.9 m or more away along either.
_SPREAD = (0.9, 0.6)
# How far off the warm start is, m and rad: a frame of driving.
_START = (0.01, 0.01, math.radians(0.5))
# A blob pixel may be centred this far outside the tape's edge, px.
_OUTSIDE = 1.0


@dataclass(frozen=True, eq=False)
class Precision:
    """Errors at one image size.

    :ivar width: of the images, px.
    :ivar noise: of every channel, as a fraction of full scale.
    :ivar errors: by method, x, y (m) and yaw (rad) of the images that it answered (N, 3).
    :ivar images: how many images there were.
    :ivar bounds: Cramér-Rao bound (images, 3, 3) of (x, y, yaw), the mirror's height known.
    :ivar height_bounds: the same where the height is known as well as the default takes it to be.
    """

    width: int
    noise: float
    errors: dict[str, Array]
    images: int
    bounds: Array
    height_bounds: Array

    def rms(self, method: str) -> tuple[float, float]:
        """Root mean square error of a method in translation (m) and in yaw (rad)."""
        return _rms(self.errors[method])

    def bound(self, method: str = OURS) -> tuple[float, float]:
        """What the best unbiased estimator has that knows what a method does; m and rad."""
        bounds = self.height_bounds if method == DEFAULT else self.bounds
        variance = bounds.mean(axis=0)
        return math.sqrt(variance[0, 0] + variance[1, 1]), math.sqrt(variance[2, 2])


def _rms(error: Array) -> tuple[float, float]:
    if len(error) == 0:
        return math.nan, math.nan
    x, y, yaw = np.mean(error**2, axis=0)
    return math.sqrt(x + y), math.sqrt(yaw)


def straight_scene(width: int, noise: float) -> Scene:
    """The ideal arena with the mirror's tilt taken out."""
    scene = ideal_scene(width, noise)
    mounting = scene.rig.T_base_mirror
    _, _, yaw = mounting.rpy()
    straight = RigidTransform.from_rpy(np.array([np.pi, 0.0, yaw]), mounting.translation)
    return scene.mounted(straight)


def image_information(scene: Scene, pose: Pose2) -> Array:
    """What all pixels of one image tell of (x, y, yaw, height of the mirror) (4, 4).

    Independent noise of the scene's read noise and of rounding on every channel; everything else
    is taken as known.

    :param scene: with read noise alone, and a linear response.
    :raises OptionError: if there is no noise, which leaves no bound.
    """
    sensor = scene.sensor
    if not (sensor.read_noise > 0.0 and sensor.shot_noise == 0.0 and sensor.gamma == 1.0):
        raise OptionError('the bound needs read noise alone, and a linear response')
    rows = []
    for step in _STEP * np.eye(4):
        ahead, behind = (
            expected_image(_raised(scene, sign * step[3]),
                           Pose2.from_array(pose.as_array() + sign * step[:3]))
            for sign in (1.0, -1.0))
        rows.append((ahead - behind).ravel() / (2.0 * _STEP))
    slope = np.array(rows, dtype=float)
    variance = (255.0 * sensor.read_noise) ** 2 + 1.0 / 12.0
    return slope @ slope.T / variance


def image_bound(information: Array, height_sigma: float = 0.0) -> Array:
    """Cramér-Rao bound (3, 3) of (x, y, yaw).

    :param information: of an image, see :func:`image_information` (4, 4).
    :param height_sigma: how well the mirror's height is known, metres; 0 for exactly.
    """
    told = information[:3, :3]
    if height_sigma > 0.0:
        told = information + np.diag([0.0, 0.0, 0.0, height_sigma**-2])
    return inverse(told)[:3, :3]


def _raised(scene: Scene, height: float) -> Scene:
    """The scene seen by a mirror that hangs so much higher, metres."""
    mounting = scene.rig.T_base_mirror
    return scene.mounted(RigidTransform(
        mounting.rotation, mounting.translation + np.array([0.0, 0.0, height])))


def blob_pixels(
    scene: Scene, pose: Pose2, image: NDArray[np.uint8], rng: np.random.Generator,
) -> tuple[Array, NDArray[np.intp]]:
    """The paper's sampling: random pixels of each line's blob after a fixed colour threshold.

    :param pose: the true one; it tells which line a pixel is on.
    :returns: pixels (N, 2), at most 75 a line, and the line of each (N,).
    """
    v, u = np.nonzero(hsv_mask(image, 'green'))
    pixels = np.stack([u, v], axis=1).astype(float)
    rays = scene.rig.back_project(pixels)
    floor, reaches = rays.floor_points()
    aside, _ = scene.rig.back_project(pixels + np.array([_OUTSIDE, 0.0])).floor_points()
    below, _ = scene.rig.back_project(pixels + np.array([0.0, _OUTSIDE])).floor_points()
    chosen, labels = [], []
    for k, line in enumerate(scene.line_map):
        normal = line.left[:2]
        turned = normal @ pose.rotation[:2, :2]
        offset = pose.apply(floor) - line.start[:2]
        footprint = np.hypot((aside - floor) @ turned, (below - floor) @ turned)
        along = offset @ line.direction[:2]
        on = np.flatnonzero(
            reaches & (along > 0.0) & (along < line.length)
            & (np.abs(offset @ normal) < 0.5 * line.width + footprint))
        chosen.append(rng.permutation(on)[:PIXELS_A_LINE])
        labels.append(np.full(len(chosen[-1]), k, dtype=np.intp))
    return pixels[np.concatenate(chosen)], np.concatenate(labels)


def _by_sampling(
    scene: Scene, pose: Pose2, image: NDArray[np.uint8], rng: np.random.Generator,
) -> dict[str, Pose2]:
    """What the sampled pixels give, by method; those that fail are left out."""
    pixels, label = blob_pixels(scene, pose, image, rng)
    start = Pose2.from_array(pose.as_array() + rng.normal(size=3) * _START)
    lines = scene.line_map.directions[label], scene.line_map.moments[label]
    solvers: dict[str, Callable[[], Pose2]] = {
        WEIGHTED: lambda: refine(scene.rig.back_project(pixels), *lines, start).pose,
        PAPER: lambda: paper_estimate(scene.rig, pixels, *lines, start).pose,
        PAPER_FREE: lambda: paper_estimate(
            scene.rig, pixels, *lines, start, use_g2=False).pose,
    }
    found = {}
    for name, solver in solvers.items():
        try:
            found[name] = solver()
        except EstimationError:
            continue
    return found


def run_precision(
    width: int, poses: int, *, noise: float, seed: int,
    progress: Callable[[str], None] = lambda text: None,
) -> Precision:
    """Measure all methods on one image of each of some random poses.

    :param width: of the images, px; 4:3.
    :param poses: how many.
    :param noise: of every channel, as a fraction of full scale.
    :raises OptionError: for fewer than 2 poses.
    """
    if poses < 2:
        raise OptionError(f'poses = {poses}: a spread needs at least 2')
    scene = straight_scene(width, noise)
    default = LocaliserOptions()
    localisers = {
        OURS: Localiser(scene.rig, scene.line_map, LocaliserOptions(height_sigma=0.0)),
        DEFAULT: Localiser(scene.rig, scene.line_map, default)}
    errors: dict[str, list[Array]] = {name: [] for name in METHODS}
    bounds, height_bounds = [], []
    for k in range(poses):
        rng = np.random.default_rng([seed, width, k])
        pose = Pose2(*rng.uniform(-1.0, 1.0, 3) * (*_SPREAD, np.pi))
        image = render(scene, pose, rng)
        information = image_information(scene, pose)
        bounds.append(image_bound(information))
        height_bounds.append(image_bound(information, default.height_sigma))
        found = _by_sampling(scene, pose, image, rng)
        for name, localiser in localisers.items():
            localiser.relocalise()
            answer = localiser.process(k, image).pose
            if answer is not None:
                found[name] = answer
        for name, estimate in found.items():
            errors[name].append(estimate.minus(pose))
        progress(f'{width} px')
    return Precision(
        width, noise, {name: np.reshape(e, (-1, 3)) for name, e in errors.items()}, poses,
        np.array(bounds), np.array(height_bounds))


def precision_table(result: Precision) -> str:
    """The result at one size as Markdown."""
    rows = [['method', 'answered', 'translation RMS (mm)', 'rotation RMS (mdeg)',
             'translation / bound', 'rotation / bound', 'worse than ours']]
    ours = result.rms(OURS)
    for name in METHODS:
        rms, bound = result.rms(name), result.bound(name)
        rows.append([
            name, f'{len(result.errors[name])} of {result.images}', *_in_units(rms),
            f'{rms[0] / bound[0]:.2f}', f'{rms[1] / bound[1]:.2f}',
            f'{rms[0] / ours[0]:.1f} and {rms[1] / ours[1]:.1f} times'])
    rows.append(['Cramér-Rao bound of the image', '', *_in_units(result.bound()), '1', '1', ''])
    rows.append(["the same, the mirror's height known as by default", '',
                 *_in_units(result.bound(DEFAULT)), '1', '1', ''])
    height = result.width * 3 // 4
    return (f'{result.width} x {height} px, {100 * result.noise:g} % noise, {result.images} '
            f'poses in the 4 x 3 m arena.\n\n{table(rows)}')


def _in_units(rms: tuple[float, float]) -> list[str]:
    return [f'{1e3 * rms[0]:.4f}', f'{1e3 * math.degrees(rms[1]):.3f}']


def as_numbers(result: Precision) -> dict[str, Any]:
    """The same for JSON, in metres and radians, with every single error."""
    def pair(rms: tuple[float, float]) -> dict[str, float]:
        return {'translation_m': rms[0], 'yaw_rad': rms[1]}

    return {
        'width': result.width, 'noise': result.noise, 'images': result.images,
        'bound': pair(result.bound()), 'height_bound': pair(result.bound(DEFAULT)),
        'methods': {
            name: {'rms': pair(result.rms(name)) if len(error) else None,
                   'errors': error.tolist()}
            for name, error in result.errors.items()}}
