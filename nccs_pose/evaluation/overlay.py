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
"""What was detected and what was predicted, drawn over the image."""

from __future__ import annotations

import math

import cv2
from nccs_pose.estimation.estimate import Estimate, State
from nccs_pose.geometry.lines import LineMap
from nccs_pose.geometry.pose import Array, Pose2
from nccs_pose.geometry.rig import Rig
from nccs_pose.vision.decode import Image
import numpy as np

_PALETTE = (
    (60, 76, 255), (255, 160, 40), (30, 200, 255), (235, 80, 220), (120, 255, 255),
    (255, 120, 150), (20, 120, 255), (255, 230, 90))
"""Blue, green, red; no green, which the tapes have."""
_UNLABELLED = (200, 200, 200)
_STATE_COLOURS = {
    State.SEARCHING: (200, 200, 200), State.AMBIGUOUS: (60, 200, 255),
    State.TRACKING: (120, 230, 120), State.COASTING: (60, 200, 255), State.LOST: (90, 90, 255)}
KEY = 'dots: pixels that the pose rests on   curves: line edges as predicted'
_ROWS = 6
"""Of text, always: pictures of one stream are of one size. Two are left for a long reason."""
_STRIP = 24  # grey level
_SAMPLES = 240
_SHIFT = 4  # OpenCV draws in sixteenths of a pixel


def draw_overlay(
    image: Image, rig: Rig, line_map: LineMap, estimate: Estimate, truth: Pose2 | None = None,
    scale: int = 1, key: str = KEY,
) -> Image:
    """Draw an estimate over its image, and write what it says in a strip below.

    Points are the pixels that the pose rests on, one colour a line; the thin curves are both
    edges of every line as the rig would show them from the estimated pose.

    :param image: BGR (H, W, 3) uint8; it is left as it is.
    :param truth: the true pose, if known; its error is written.
    :param scale: how many times larger to draw, so that what is thin can be seen.
    :param key: what the marks mean, for the last row.
    :returns: BGR (scale H + strip, scale W, 3) uint8; pixels are where they are in the image.
    """
    canvas = np.ascontiguousarray(image).copy()
    if scale > 1:
        canvas = cv2.resize(canvas, None, fx=scale, fy=scale, interpolation=cv2.INTER_LINEAR)
    if estimate.points is not None:
        for pixel, label in zip(
            _fixed(estimate.points.pixels, scale).tolist(), estimate.points.label,
        ):
            cv2.circle(canvas, tuple(pixel), int(1.6 * 2**_SHIFT), _colour(int(label)), -1,
                       cv2.LINE_AA, _SHIFT)
    if estimate.pose is not None:
        _draw_prediction(canvas, rig, line_map, estimate.pose, scale)
    strip = _strip(canvas, _words(estimate, truth), key, _STATE_COLOURS[estimate.state])
    return np.vstack([canvas, strip])


def predicted_curves(rig: Rig, points_map: Array, pose: Pose2) -> list[Array]:
    """Project a row of points (N, 3) of the map; where some are not seen the curve is cut.

    :returns: pieces (M, 2) in pixels.
    """
    pixels, visible = rig.project(pose.inverse().apply(points_map))
    cuts = np.flatnonzero(np.diff(visible.astype(int))) + 1
    return [
        piece for piece, seen in zip(np.split(pixels, cuts), np.split(visible, cuts))
        if seen[0] and len(piece) > 1]


def _draw_prediction(
    canvas: Image, rig: Rig, line_map: LineMap, pose: Pose2, scale: int,
) -> None:
    share = np.linspace(0.0, 1.0, _SAMPLES)[:, None]
    for index, line in enumerate(line_map):
        colour = _colour(index)
        for edge in line.edges() if line.width > 0.0 else (line,):
            for piece in predicted_curves(rig, edge.start + share * (edge.end - edge.start), pose):
                cv2.polylines(
                    canvas, [_fixed(piece, scale)], False, colour, 1, cv2.LINE_AA, _SHIFT)
        pieces = predicted_curves(rig, line.start + share * (line.end - line.start), pose)
        if pieces and line.name:
            longest = max(pieces, key=len)
            middle = scale * longest[len(longest) // 2]
            centre = 0.5 * np.array(canvas.shape[1::-1])
            size = _text_scale(canvas)
            width, height = cv2.getTextSize(line.name, cv2.FONT_HERSHEY_SIMPLEX, size, 1)[0]
            u, v = middle + 0.14 * (centre - middle) + [-0.5 * width, 0.5 * height]
            _put_text(canvas, line.name, (int(u), int(v)), colour, size)


def _words(estimate: Estimate, truth: Pose2 | None) -> list[str]:
    words = [f'{estimate.state.value.upper()}: {estimate.reason}']
    measured: list[str] = []
    pose, quality = estimate.pose, estimate.quality
    if pose is not None:
        row = f'x {pose.x:+.4f} m   y {pose.y:+.4f} m   yaw {math.degrees(pose.yaw):+.3f} deg'
        if estimate.covariance is not None:
            x, y, yaw = np.sqrt(np.diag(estimate.covariance))
            row += (f'   sigma {1e3 * x:.2f} mm, {1e3 * y:.2f} mm, '
                    f'{math.degrees(yaw):.4f} deg')
        words.append(row)
        if truth is not None:
            x, y, yaw = pose.minus(truth).tolist()
            measured.append(
                f'error {1e3 * math.hypot(x, y):.2f} mm, {math.degrees(abs(yaw)):.4f} deg')
    # What was not measured is left out.
    if quality.points_used:
        measured += [f'{quality.lines_used} lines', f'{quality.points_used} points']
    if math.isfinite(quality.residual_px):
        measured.append(f'residual {quality.residual_px:.2f} px')
    if math.isfinite(quality.explained):
        measured.append(f'explained {100 * quality.explained:.0f} %')
    if measured:
        words.append('   '.join(measured))
    if quality.unobserved:
        words.append(f'not observed: {", ".join(quality.unobserved)}')
    return words


def _strip(canvas: Image, words: list[str], key: str, accent: tuple[int, int, int]) -> Image:
    """Words on a dark strip as wide as the canvas: the first in the state's colour, then the key.

    Below the image it hides no line.
    """
    scale = _text_scale(canvas)
    step, width = round(38 * scale), canvas.shape[1]
    strip = np.full((step * _ROWS + step // 2, width, 3), _STRIP, np.uint8)
    rows = [
        (row, accent if number == 0 else (255, 255, 255))
        for number, text in enumerate(words) for row in _wrapped(text, width - step, scale)]
    last = [(row, _UNLABELLED) for row in _wrapped(key, width - step, scale)][:_ROWS - 1]
    room = _ROWS - len(last)
    # What does not fit is of the least use: the end.
    placed = [*enumerate(rows[:room], 1), *enumerate(last, room + 1)]
    for number, (row, colour) in placed:
        _put_text(strip, row, (step // 2, step * number), colour, scale)
    return strip


def _wrapped(text: str, width: int, scale: float) -> list[str]:
    """A text in rows of no more than so many pixels, unless a single word is longer."""
    rows = ['']
    for word in _ascii(text).split(' '):
        longer = f'{rows[-1]} {word}' if rows[-1] else word
        if cv2.getTextSize(longer, cv2.FONT_HERSHEY_SIMPLEX, scale, 1)[0][0] <= width:
            rows[-1] = longer
        else:
            rows.append(word)
    return rows


def _put_text(
    canvas: Image, text: str, at: tuple[int, int], colour: tuple[int, int, int], scale: float,
) -> None:
    for ink, (u, v) in (((0, 0, 0), (at[0] + 1, at[1] + 1)), (colour, at)):
        cv2.putText(
            canvas, _ascii(text), (u, v), cv2.FONT_HERSHEY_SIMPLEX, scale, ink, 1, cv2.LINE_AA)


def _text_scale(canvas: Image) -> float:
    return min(0.9, max(0.4, canvas.shape[1] / 1900.0))


def _ascii(text: str) -> str:
    """OpenCV's fonts have nothing else."""
    for letter, plain in (('±', '+-'), ('σ', 'sigma'), ('°', ' deg'), ('×', 'x'), ('–', '-')):
        text = text.replace(letter, plain)
    return text.encode('ascii', 'replace').decode()


def _colour(label: int) -> tuple[int, int, int]:
    return _PALETTE[label % len(_PALETTE)] if label >= 0 else _UNLABELLED


def _fixed(pixels: Array, scale: int) -> np.ndarray:
    """Pixels (N, 2) as OpenCV's fixed-point coordinates in the enlarged image."""
    enlarged = (pixels + 0.5) * scale - 0.5
    return np.round(enlarged * 2**_SHIFT).astype(np.int32)
