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
"""Figures of the paper's experiments: box plots, and lines with their curves on the mirror."""

from __future__ import annotations

from collections.abc import Callable

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from mpl_toolkits.mplot3d import Axes3D
from nccs_pose.evaluation.experiment_summary import Results
from nccs_pose.evaluation.line_projection import ProjectedScenes
from nccs_pose.evaluation.plots import new_figure
from nccs_pose.evaluation.trials import Answer, Cell
from nccs_pose.geometry.pose import Array
from nccs_pose.geometry.reflection_curve import Branch
import numpy as np

_DPI = 90  # the figures are large
_COLOURS = {
    'paper': '#c8372d', 'paper without g2': '#e39a3b', 'ours': '#1f5fa8', 'bound': '#7f7f7f'}
_LINE_COLOURS = ('#1f5fa8', '#c8372d', '#2e9e44', '#8a4fb0', '#d08a00')
_BRANCHES = {
    Branch.SPURIOUS: ('#9a9a9a', 'spurious: E = 0'),
    Branch.MIRRORED: ('#e39a3b', 'mirrored: x → −x'),
    Branch.VIRTUAL: ('#8a4fb0', 'virtual: line behind the ray'),
    Branch.PHYSICAL: ('#1f5fa8', "physical: the line's image"),
}


def box_figure(title: str, axis: str, results: Results) -> Figure:
    """Rotation above, translation below, one column for each mirror, four boxes a level.

    Boxes from quartile to quartile, whiskers to 1.5 of that beyond, outliers left out as in the
    paper's figure; logarithmic, because the estimators differ by orders of magnitude. Without
    noise most errors are rounding alone: a box that lies below the axis is a mark on it.
    """
    mirrors = list(dict.fromkeys(cell.mirror for cell, _ in results))
    figure = new_figure(5.2 * len(mirrors), 8.0, _DPI)
    axes = figure.subplots(2, len(mirrors), squeeze=False, sharex='col', sharey='row')
    for column, mirror in enumerate(mirrors):
        mine = [(cell, answers) for cell, answers in results if cell.mirror == mirror]
        _boxes(axes[0, column], mine, lambda a: a.rotation_deg)
        _boxes(axes[1, column], mine, lambda a: 1e3 * a.translation)
        axes[0, column].set_title(f'{mirror} mirror')
        axes[1, column].set_xlabel(axis)
    axes[0, 0].set_ylabel('rotation error (°)')
    axes[1, 0].set_ylabel('translation error (mm)')
    names = [answer.estimator for answer in results[0][1][0]]
    handles = [Line2D([], [], color=_COLOURS[name], linewidth=6) for name in names]
    if any(not _is_noisy(cell) for cell, _ in results):
        handles.append(Line2D([], [], color='black', marker='v', linestyle='none'))
        names.append('below the axis')
    figure.legend(handles, names, loc='outside lower center', ncols=5, fontsize=10)
    figure.suptitle(title)
    return figure


def _boxes(axes: Axes, results: Results, value: Callable[[Answer], float]) -> None:
    """Boxes of one mirror; levels are spread evenly, whatever their numbers."""
    shown, boxes = [], []
    for k, estimator in enumerate(answer.estimator for answer in results[0][1][0]):
        data = []
        for _, answers in results:
            values = np.array([value(trial[k]) for trial in answers])
            # a missing estimate is drawn where the worst are; zero has no logarithm
            data.append(np.clip(values, 1e-9, 1e6))
        places = np.arange(len(data)) + 0.2 * (k - 1.5)
        drawn = axes.boxplot(
            data, positions=places, widths=0.17, showfliers=False, patch_artist=True,
            manage_ticks=False, medianprops={'color': 'black', 'linewidth': 1.2},
            whiskerprops={'linewidth': 0.7}, capprops={'linewidth': 0.7},
            boxprops={'linewidth': 0.5})
        for box in drawn['boxes']:
            box.set_facecolor(_COLOURS[estimator])
        boxes += [(place, np.quantile(d, 0.75), estimator) for place, d in zip(places, data)]
        shown += [d for (cell, _), d in zip(results, data) if _is_noisy(cell)]
    axes.set_yscale('log')
    if shown:
        low, high = np.percentile(np.concatenate(shown), [1.0, 98.0])
        axes.set_ylim(0.5 * low, 3.0 * high)
        for place, upper, estimator in boxes:
            if upper < 0.5 * low:
                axes.plot(
                    place, 0.02, 'v', color=_COLOURS[estimator], markersize=5,
                    transform=axes.get_xaxis_transform())
    axes.set_xticks(np.arange(len(results)), [f'{cell.level:g}' for cell, _ in results])
    axes.grid(axis='y', which='major', color='#dddddd', linewidth=0.6)
    axes.set_axisbelow(True)


def _is_noisy(cell: Cell) -> bool:
    return cell.sigma_px > 0.0 or cell.sigma_world > 0.0


def projection_figure(scenes: list[ProjectedScenes]) -> Figure:
    """Lines in space, their curves on the mirror with the points, the branches of one line."""
    figure, count = new_figure(5.0 * len(scenes), 13.5, _DPI), len(scenes)
    for column, scene in enumerate(scenes):
        top = figure.add_subplot(3, count, column + 1, projection='3d')
        _draw_lines(top, scene)
        top.set_title(f'{scene.mirror} mirror')
        _draw_mirror(figure.add_subplot(3, count, count + column + 1, projection='3d'), scene)
        below = figure.add_subplot(3, count, 2 * count + column + 1)
        _draw_branches(below, scene)
    handles, labels = below.get_legend_handles_labels()
    figure.legend(handles, labels, loc='outside lower center', ncols=5, markerscale=2.0)
    figure.suptitle(
        'Top: lines in the mirror frame (m), the camera looks at the mirror from +z. Middle: '
        'their curves on the mirror by γ and x,\nand points of the same lines projected '
        'independently (circles), mm. Bottom: where γ = 0 for the first line, in the image (px).',
        fontsize=11)
    return figure


def _draw_lines(axes: Axes3D, scene: ProjectedScenes) -> None:
    for colour, line in zip(_LINE_COLOURS * 9, scene.drawn):
        axes.plot(*line.points.T, color=colour, linewidth=1.4)
        axes.plot(*line.points.T, '*', color=colour, markersize=6, linestyle='none')
    axes.plot([0], [0], [0], 's', color='black', markersize=6)
    axes.text(0.0, 0.0, 0.0, '  mirror', fontsize=8)
    axes.set(xlabel='x', ylabel='y', zlabel='z')


def _draw_mirror(axes: Axes3D, scene: ProjectedScenes) -> None:
    mirror = scene.rig.mirror
    reach = 1.1 * float(np.quantile(np.concatenate(
        [np.hypot(line.mirror_points[:, 0], line.mirror_points[:, 1]) for line in scene.drawn]),
        0.8))  # a mirror without a rim can show a point far down its side
    radius, angle = np.meshgrid(np.linspace(0.0, reach, 16), np.linspace(-np.pi, np.pi, 49))
    slope = mirror.A * mirror.apex_z + mirror.B / 2
    depth = radius**2 / (slope + np.sqrt(np.maximum(slope**2 - mirror.A * radius**2, 0.0)))
    surface = [radius * np.cos(angle), radius * np.sin(angle), mirror.apex_z - depth]
    axes.plot_surface(*(1e3 * s for s in surface), color='#cfd8e3', alpha=0.35, linewidth=0)
    for colour, line in zip(_LINE_COLOURS * 9, scene.drawn):
        for part in _unbroken(_within(line.curve, reach), 0.2 * reach):
            axes.plot(*(1e3 * part.T), color=colour, linewidth=1.6)
        axes.plot(
            *(1e3 * _within(line.mirror_points, reach).T), 'o', color=colour, markersize=4,
            markerfacecolor='white', linestyle='none')
    axes.set(xlabel='x', ylabel='y', zlabel='z')
    axes.view_init(elev=55.0, azim=-60.0)


def _within(points: Array, reach: float) -> Array:
    return points[np.hypot(points[:, 0], points[:, 1]) <= reach]


def _draw_branches(axes: Axes, scene: ProjectedScenes) -> None:
    rig, line = scene.rig, scene.drawn[0]
    pixels, _ = rig.camera.project((line.zeros - rig.cop) @ rig.R_mirror_camera)
    for branch, (colour, words) in _BRANCHES.items():
        mine = pixels[line.branch == branch]
        axes.plot(mine[:, 0], mine[:, 1], '.', color=colour, markersize=2.5, label=words)
    points, _ = rig.camera.project((line.mirror_points - rig.cop) @ rig.R_mirror_camera)
    axes.plot(
        points[:, 0], points[:, 1], 'o', color='black', markersize=5, markerfacecolor='none',
        linestyle='none', label='points, projected independently')
    axes.set(xlim=(0, rig.camera.width), ylim=(rig.camera.height, 0), xlabel='u (px)')
    axes.set_aspect('equal')


def _unbroken(curve: Array, jump: float) -> list[Array]:
    """Pieces of a curve (K, 3) without gaps wider than ``jump``."""
    if not len(curve):
        return []
    gaps = np.flatnonzero(np.linalg.norm(np.diff(curve, axis=0), axis=1) > jump) + 1
    return np.split(curve, gaps)
