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
"""The experiment behind the paper's figure of projected lines.

Lines are drawn on the mirror by gamma and x alone; points of the same lines are projected
independently, by Agrawal's polynomial; and the two are compared.
"""

from __future__ import annotations

from dataclasses import dataclass

from nccs_pose.evaluation.experiment_options import ExperimentOptions
from nccs_pose.evaluation.experiment_summary import command, options_table
from nccs_pose.evaluation.tables import table
from nccs_pose.geometry.paper_polynomials import paper_polynomials
from nccs_pose.geometry.pose import Array
from nccs_pose.geometry.projection import reflect_points
from nccs_pose.geometry.reflection_curve import Branch, ReflectionCurve
from nccs_pose.geometry.rig import Rig
from nccs_pose.simulation.table_one import TABLE_ONE
import numpy as np
from numpy.typing import NDArray

_LINES = 5  # per scene
_POINTS = 12  # per line
_HEIGHTS = 400  # slices of the mirror that the curve is drawn from


@dataclass(frozen=True, eq=False)
class DrawnLine:
    """A line, its curve on the mirror, and its points projected independently.

    :ivar curve: mirror points by gamma and x, in order (K, 3).
    :ivar zeros: all zeros of gamma on the visible mirror (Z, 3).
    :ivar branch: what each of them is (Z,).
    :ivar points: points of the line that the mirror shows (P, 3).
    :ivar mirror_points: where, by Agrawal's projection (P, 3).
    """

    curve: Array
    zeros: Array
    branch: NDArray[np.int_]
    points: Array
    mirror_points: Array


@dataclass(frozen=True, eq=False)
class ProjectedScenes:
    """All scenes of one mirror; the first one is drawn.

    :ivar rows: one per projected point, as `header` says.
    :ivar drawn: lines of the first scene.
    :ivar zeros: how many zeros of gamma each branch has, over all scenes.
    """

    mirror: str
    rig: Rig
    rows: list[tuple[object, ...]]
    drawn: tuple[DrawnLine, ...]
    zeros: NDArray[np.int_]

    header = (
        'mirror', 'scene', 'line', 'x_m', 'y_m', 'z_m', 'mirror_x_m', 'mirror_y_m', 'mirror_z_m',
        'gamma_relative', 'x_error_m', 'ray_line_m')


def project_lines(options: ExperimentOptions, mirror: str, scenes: int) -> ProjectedScenes:
    """Random lines between ``nearest`` and ``farthest`` of the mirror, in its frame."""
    rig = options.rig(mirror)
    key = list(TABLE_ONE).index(mirror)
    rows: list[tuple[object, ...]] = []
    drawn: tuple[DrawnLine, ...] = ()
    zeros = np.zeros(len(Branch), dtype=int)
    for scene in range(scenes):
        rng = np.random.default_rng(
            np.random.SeedSequence(options.seed, spawn_key=(99, key, scene)))
        lines = []
        for index in range(options.lines or _LINES):
            curve, line = _draw(rig, options, rng)
            zeros += np.bincount(line.branch, minlength=len(Branch))
            rows += _rows(mirror, scene, index, curve, line)
            lines.append(line)
        drawn = drawn or tuple(lines)
    return ProjectedScenes(mirror, rig, rows, drawn, zeros)


def _draw(
    rig: Rig, options: ExperimentOptions, rng: np.random.Generator,
) -> tuple[ReflectionCurve, DrawnLine]:
    count = options.points or _POINTS
    while True:
        q, d = rng.normal(size=(2, 3))
        q *= rng.uniform(options.nearest, options.farthest) / np.linalg.norm(q)
        curve = ReflectionCurve(rig.mirror, rig.cop, q, d)
        along = options.length * np.linspace(-0.5, 0.5, count)
        points = q + along[:, None] * curve.direction
        mirror_points, visible = reflect_points(rig.mirror, rig.cop, points)
        if visible.sum() >= count // 2:
            break
    lowest = max(rig.mirror.z_min, rig.mirror.apex_z - np.abs(mirror_points).max())
    heights = np.linspace(lowest, rig.mirror.apex_z, _HEIGHTS)
    zeros, branch = curve.zeros_of_gamma(heights)
    return curve, DrawnLine(
        curve.physical(heights, np.inf), zeros, branch, points[visible], mirror_points[visible])


def _rows(
    mirror: str, scene: int, index: int, curve: ReflectionCurve, line: DrawnLine,
) -> list[tuple[object, ...]]:
    m = line.mirror_points
    y, z = m[:, 1], m[:, 2]
    c = paper_polynomials(curve.mirror, curve.cop, curve.point, curve.direction)
    c5, c6, c7, c8, c9 = (getattr(c, f'c{i}')(y, z) for i in range(5, 10))
    terms = np.stack([c5 * c9**2, -c6 * c8 * c9, c7 * c8**2])
    gamma = np.abs(terms.sum(axis=0)) / np.abs(terms).sum(axis=0)
    x = np.abs(c.c11(y, z) / c.c10(y, z) - m[:, 0])
    apart = curve.distance(m)
    return [
        (mirror, scene, index, *(f'{v:.9g}' for v in (*p, *q)), *(f'{v:.3g}' for v in e))
        for p, q, e in zip(line.points, m, np.stack([gamma, x, apart], axis=1))]


def projection_summary(
    scenes: list[ProjectedScenes], trials: int, options: ExperimentOptions,
) -> str:
    """Do the independently projected points lie on the curve? A Markdown page."""
    rows = [['mirror', 'points', 'γ, relative: worst', 'x − c11/c10: median (mm)', 'worst (mm)',
             'ray to line: worst (nm)']]
    for scene in scenes:
        gamma, x, apart = np.array([row[-3:] for row in scene.rows], dtype=float).T
        rows.append([
            scene.mirror, f'{len(x)}', f'{gamma.max():.1e}', f'{1e3 * np.median(x):.1e}',
            f'{1e3 * x.max():.1e}', f'{1e9 * apart.max():.2g}'])
    names = [b for b in Branch if b != Branch.OFF]
    shares = [['mirror', *(b.name.lower() for b in names)]]
    for scene in scenes:
        total = scene.zeros.sum()
        shares.append([scene.mirror, *(f'{100 * scene.zeros[b] / total:.0f} %' for b in names)])
    return '\n'.join([
        '# Projection of lines (the figure with lines, curves and projected points)\n',
        f'`{command("line-projection", trials, options)}`: {trials} scenes a mirror. '
        'Curves by γ and x; points projected independently by the polynomial of degree 8.\n',
        table(rows),
        "Where γ is zero on the visible mirror (slices of equal height): only the first is the "
        "line's image.\n", table(shares), '## Assumptions\n', options_table(options)])
