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
"""Pictures of a run: where it drove, how far off it was, and how often.

Matplotlib's object interface with the Agg canvas: no window, no global state, threads are safe.
"""

from __future__ import annotations

from collections.abc import Iterable
import math

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from nccs_pose.evaluation.metrics import PoseErrors
from nccs_pose.evaluation.trajectory import Trajectory
from nccs_pose.geometry.lines import Line
from nccs_pose.geometry.pose import Array
import numpy as np

ESTIMATED = '#1f5fa8'
TRUE = '#1a1a1a'
BAND = '#9cc2ea'
# No robot drives further than this between two poses, m.
_JUMP = 0.5
_LINE_COLOURS = {'green': '#2e9e44', 'white': '#b0b0b0', 'yellow': '#d4b400', 'red': '#c8372d',
                 'blue': '#3a6fd8'}


def new_figure(width: float, height: float, dpi: int = 130) -> Figure:
    """Make an empty figure.

    :param width: inches.
    :param height: inches.
    :param dpi: pixels to an inch of the saved picture.
    """
    figure = Figure(figsize=(width, height), dpi=dpi, layout='constrained')
    FigureCanvasAgg(figure)
    return figure


def trajectory_figure(
    estimated: Trajectory, truth: Trajectory | None, lines: Iterable[Line], title: str = '',
) -> Figure:
    """Draw the estimated poses over the true path, among the lines (a map is one)."""
    figure = new_figure(7.5, 7.0)
    axes = figure.add_subplot()
    for line in lines:
        (x0, y0), (x1, y1) = line.start[:2], line.end[:2]
        colour = _LINE_COLOURS.get(line.colour, '#2e9e44')
        axes.plot([x0, x1], [y0, y1], color=colour, linewidth=5, alpha=0.55,
                  solid_capstyle='butt', zorder=1)
        axes.annotate(line.name, (0.5 * (x0 + x1), 0.5 * (y0 + y1)), xytext=(4, 4),
                      textcoords='offset points', fontsize=8, color=colour)
    if truth is not None and len(truth):
        for part in _continuous(truth.in_order()):
            axes.plot(part[:, 0], part[:, 1], color=TRUE, linewidth=1.2, zorder=2)
        axes.plot([], [], color=TRUE, linewidth=1.2, label='true')
    poses = estimated.poses
    axes.plot(poses[:, 0], poses[:, 1], 'o', color=ESTIMATED, markersize=4, zorder=4,
              label='estimated')
    axes.quiver(poses[:, 0], poses[:, 1], np.cos(poses[:, 2]), np.sin(poses[:, 2]),
                color=ESTIMATED, scale=28, width=0.0028, zorder=3)
    if len(poses):
        axes.plot(*poses[0, :2], 'o', markersize=11, markerfacecolor='none',
                  markeredgecolor=ESTIMATED, zorder=4, label='first pose')
    axes.set_aspect('equal', adjustable='datalim')
    axes.set(xlabel='x (m)', ylabel='y (m)', title=title)
    axes.grid(color='#e4e4e4', linewidth=0.6)
    axes.set_axisbelow(True)
    axes.legend(loc='best', fontsize=9)
    return figure


def error_figure(
    errors: PoseErrors, covariance: Array | None = None, title: str = '',
) -> Figure:
    """Draw the errors of x, y and yaw over time, with the 2-sigma band of the covariances.

    :param covariance: (N, 3, 3), row by row with `errors`.
    """
    figure = new_figure(9.0, 6.5)
    time = (errors.stamps_ns - errors.stamps_ns[0]) * 1e-9 if len(errors) else np.zeros(0)
    panels = figure.subplots(3, 1, sharex=True)
    for k, (axes, name, unit, factor) in enumerate(zip(
        panels, ('x', 'y', 'yaw'), ('mm', 'mm', 'deg'), (1e3, 1e3, math.degrees(1.0)),
    )):
        values = factor * errors.error[:, k]
        if covariance is not None and len(errors):
            band = 2.0 * factor * np.sqrt(covariance[:, k, k])
            axes.fill_between(time, -band, band, color=BAND, alpha=0.5, linewidth=0,
                              label='±2σ')
            _limit(axes, values, band)
        axes.axhline(0.0, color='#888888', linewidth=0.8)
        axes.plot(time, values, '.-', color=ESTIMATED, linewidth=0.9, markersize=5,
                  label='estimated minus true')
        axes.set_ylabel(f'{name} ({unit})')
        axes.grid(color='#e4e4e4', linewidth=0.6)
    panels[0].legend(
        loc='lower right', bbox_to_anchor=(1.0, 1.0), fontsize=9, ncols=2, frameon=False)
    panels[0].set_title(title, loc='left')
    panels[-1].set_xlabel('time (s)')
    return figure


def histogram_figure(errors: PoseErrors, title: str = '') -> Figure:
    """Draw how often each size of error occurred, with median and RMSE marked."""
    figure = new_figure(9.0, 3.8)
    for axes, values, name in zip(
        figure.subplots(1, 2), (1e3 * errors.translation, np.degrees(errors.yaw)),
        ('translation error (mm)', 'yaw error (deg)'),
    ):
        if len(values):
            bins = min(40, max(8, round(2 * math.sqrt(len(values)))))
            axes.hist(values, bins=bins, color=ESTIMATED, alpha=0.75)
            for value, style, label in (
                (np.median(values), '-', 'median'), (np.sqrt(np.mean(values**2)), '--', 'RMSE'),
            ):
                axes.axvline(value, color=TRUE, linestyle=style, linewidth=1.2,
                             label=f'{label} {value:.3g}')
            axes.legend(fontsize=9)
        axes.set(xlabel=name, ylabel='frames')
        axes.set_xlim(left=0.0)
        axes.grid(color='#e4e4e4', linewidth=0.6)
        axes.set_axisbelow(True)
    figure.suptitle(title)
    return figure


def _limit(axes: Axes, values: Array, band: Array) -> None:
    """Keep one very uncertain frame from flattening all the others."""
    usual = 3.0 * float(np.percentile(band, 90))
    reach = 1.15 * max(float(np.abs(values).max()), min(float(band.max()), usual))
    if reach > 0.0:
        axes.set_ylim(-reach, reach)


def _continuous(trajectory: Trajectory) -> list[Array]:
    """Split a path where it jumps (a kidnapped robot), so that no line is drawn across."""
    steps = np.hypot(*np.diff(trajectory.poses[:, :2], axis=0).T)
    usual = max(_JUMP, 6.0 * float(np.median(steps))) if len(steps) else _JUMP
    return np.split(trajectory.poses, np.flatnonzero(steps > usual) + 1)
