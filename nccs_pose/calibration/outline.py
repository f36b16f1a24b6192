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

"""The mirror's outline in the images of a drive, to a fraction of a pixel.

First the outline that the rough rig expects is slid and scaled over the image until the most of
its length lies on brightness edges that cross it; then it is measured along rays from its middle,
and an ellipse that most of the rays share is kept and measured again from closer by.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
from nccs_pose.calibration.options import CalibrationOptions
from nccs_pose.calibration.rim import outline_points
from nccs_pose.errors import CalibrationError
from nccs_pose.geometry.pose import Array
from nccs_pose.geometry.rig import Rig
import numpy as np
from numpy.typing import NDArray

_RAYS = 240  # directions in which the outline is measured
_SPREADS = 2.0  # how many standard deviations off the rough rig may be
_SCALES = (0.86, 0.93, 1.0, 1.07, 1.15)
_STEPS = 24  # of the slide, each way, at most
_REACH = (0.15, 0.05)  # of the radius, how far the outline may be from where it is looked for
_BLUR = 1.5  # px
_CONTRAST = 3.0  # an edge must be steeper than so many times the usual slope
_TRIALS = 400
_CLOSE = (4.0, 1.5)  # px, how near to the ellipse a ray's edge must be
_LEAST = 0.35  # fraction of the rays that must agree on one outline


def find_outline(
    rig: Rig, images: list[NDArray[np.uint8]], options: CalibrationOptions | None = None,
) -> Array:
    """Pixels (N, 2) of the mirror's outline in images (H, W, 3) of one drive.

    What moves through the images averages out over them; the outline stays.

    :param options: how rough the rig is.
    :raises CalibrationError: if no ellipse stands out.
    """
    options = options or CalibrationOptions()
    grey = np.mean([cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) for image in images], axis=0)
    outline = _slid(rig, grey, options)
    grey = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), _BLUR)
    for reach, close in zip(_REACH, _CLOSE):
        points = _measured(grey, outline, reach)
        ellipse, agreed = _consensus(points, close)
        if ellipse is None or agreed.sum() < _LEAST * _RAYS:
            raise CalibrationError(
                f"the mirror's outline was not found: {int(agreed.sum())} of {_RAYS} directions "
                'agree on an ellipse')
        outline, points = ellipse.outline(), points[agreed]
    return points


def _slid(rig: Rig, grey: Array, options: CalibrationOptions) -> Array:
    """The expected outline (N, 2) where the image has it, to within a step of the search."""
    expected = outline_points(rig, _RAYS)
    middle = expected.mean(axis=0)
    radius = float(np.linalg.norm(expected - middle, axis=1).min())
    camera = rig.camera
    # A camera off by that much sees the mirror shifted by so many pixels.
    distance = float(np.linalg.norm(rig.cop - [0.0, 0.0, rig.mirror.apex_z]))
    off = camera.fx * _SPREADS * np.hypot(options.rough_cop / distance, options.rough_camera_tilt)
    step = max(off / _STEPS, 0.03 * radius)
    slope_x, slope_y = _slopes(grey, max(0.7 * step, 1.0))
    # Beyond some slopes a steeper edge is no better: one lamp is no outline.
    enough = _CONTRAST * float(np.median(np.hypot(slope_x, slope_y))) + 1e-6
    closed = np.roll(expected, -1, axis=0) - np.roll(expected, 1, axis=0)
    normal = np.stack([closed[:, 1], -closed[:, 0]], axis=1)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    shifts = np.arange(-np.ceil(off / step), np.ceil(off / step) + 1.0) * step
    shift = np.stack(np.meshgrid(shifts, shifts), axis=2).reshape(-1, 1, 2)
    best, found = -1.0, expected
    for scale in _SCALES:
        at = (middle + scale * (expected - middle) + shift).astype(np.float32)
        across = (_sampled(slope_x, at) * normal[:, 0] + _sampled(slope_y, at) * normal[:, 1])
        # The mirror is brighter than what is around it, or darker, not both by turns.
        score = np.abs(np.clip(across / enough, -1.0, 1.0).mean(axis=1))
        if score.max() > best:
            best, found = float(score.max()), at[int(score.argmax())].astype(float)
    return found


def _slopes(grey: Array, blur: float) -> tuple[Array, Array]:
    """Brightness slopes along u and v (H, W), grey levels a pixel, of a blurred image."""
    smooth = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), blur)
    return (cv2.Sobel(smooth, cv2.CV_32F, 1, 0, scale=0.125),
            cv2.Sobel(smooth, cv2.CV_32F, 0, 1, scale=0.125))


def _sampled(image: Array, at: Array) -> Array:
    """Values of an image (H, W) at pixels (M, N, 2), between them linear; zero outside."""
    return cv2.remap(
        image, at.astype(np.float32), None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)


def _measured(grey: Array, outline: Array, reach: float) -> Array:
    """The steepest edge (K, 2) along each ray from the middle, near an outline (N, 2)."""
    middle = outline.mean(axis=0)
    angle = np.linspace(0.0, 2.0 * np.pi, _RAYS, endpoint=False)
    out = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    radius = _radius_at(outline - middle, angle)
    # Every ray has its own range, so that all are sampled at whole pixels from where they begin.
    steps = int(np.ceil(reach * radius.max())) + 2
    offset = np.arange(-steps, steps + 1.0)
    at = middle + (radius[:, None] + offset)[:, :, None] * out[:, None, :]
    profile = _sampled(grey, at).astype(float)
    slope = np.abs(np.gradient(profile, axis=1))
    near = np.abs(offset) <= np.maximum(reach * radius[:, None], 3.0)
    best = np.where(near, slope, -1.0)[:, 1:-1].argmax(axis=1) + 1
    row = np.arange(_RAYS)
    before, peak, after = (slope[row, best + k] for k in (-1, 0, 1))
    curvature = before - 2.0 * peak + after
    # The top of the parabola through the three slopes around the steepest.
    fraction = np.where(curvature < 0.0, 0.5 * (before - after) / np.minimum(curvature, -1e-9), 0)
    edge = middle + (radius + offset[best] + np.clip(fraction, -0.5, 0.5))[:, None] * out
    height, width = grey.shape
    inside = ((edge > 1.0) & (edge < [width - 2.0, height - 2.0])).all(axis=1)
    strong = peak > _CONTRAST * float(np.median(slope)) + 1e-6
    return edge[strong & inside]


def _radius_at(points: Array, angle: Array) -> Array:
    """Distance of a closed curve (N, 2) about the origin at angles (K,)."""
    own = np.arctan2(points[:, 1], points[:, 0])
    order = np.argsort(own)
    return np.interp(
        angle, own[order], np.linalg.norm(points, axis=1)[order], period=2.0 * np.pi)


def _consensus(points: Array, close: float) -> tuple[_Ellipse | None, NDArray[np.bool_]]:
    """The ellipse that most of the points (N, 2) share within that many px, and which do."""
    best = np.zeros(len(points), dtype=bool)
    if len(points) < 8:
        return None, best
    rng = np.random.default_rng(0)
    for _ in range(_TRIALS):
        ellipse = _Ellipse.through(points[rng.choice(len(points), 5, replace=False)])
        if ellipse is not None:
            near = ellipse.distance(points) < close
            if near.sum() > best.sum():
                best = near
    ellipse = _Ellipse.through(points[best]) if best.sum() >= 6 else None
    return ellipse, best if ellipse is None else ellipse.distance(points) < close


@dataclass(frozen=True, eq=False)
class _Ellipse:
    """q^T form q = 0 for q = ((u, v) - middle, 1) (3,)."""

    middle: Array
    form: Array

    @classmethod
    def through(cls, points: Array) -> _Ellipse | None:
        """Nearest to points (N, 2), N >= 5, algebraically; None if that is no ellipse."""
        middle, size = points.mean(axis=0), float(points.std())
        x, y = ((points - middle) / size).T
        rows = np.stack([x * x, x * y, y * y, x, y, np.ones_like(x)], axis=1)
        a, b, c, d, e, f = np.linalg.svd(rows)[2][-1]
        if 4.0 * a * c <= b * b:
            return None
        form = np.array([[a, b / 2.0, d / 2.0], [b / 2.0, c, e / 2.0], [d / 2.0, e / 2.0, f]])
        scale = np.diag([1.0 / size, 1.0 / size, 1.0])
        return cls(middle, scale @ form @ scale)

    def distance(self, points: Array) -> Array:
        """Sampson distance (N,), px."""
        q = np.column_stack([points - self.middle, np.ones(len(points))]) @ self.form
        value = np.einsum('ni,ni->n', q[:, :2], points - self.middle) + q[:, 2]
        return np.abs(value) / np.maximum(2.0 * np.hypot(q[:, 0], q[:, 1]), 1e-12)

    def outline(self) -> Array:
        """Points (N, 2) all around."""
        centre = -np.linalg.solve(self.form[:2, :2], self.form[:2, 2])
        angle = np.linspace(0.0, 2.0 * np.pi, _RAYS, endpoint=False)
        out = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        level = -(self.form[2, 2] + self.form[2, :2] @ centre)
        squared = level / np.einsum('ni,ij,nj->n', out, self.form[:2, :2], out)
        return self.middle + centre + np.sqrt(np.maximum(squared, 0.0))[:, None] * out
