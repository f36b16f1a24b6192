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

"""The report of a calibration: a page of Markdown and its pictures."""

from __future__ import annotations

from matplotlib.figure import Figure
from nccs_pose.calibration.gauge import amount, deviation
from nccs_pose.calibration.judgement import robust_deviation
from nccs_pose.calibration.parameters import Parameter
from nccs_pose.calibration.procedure import Calibration
from nccs_pose.evaluation.plots import new_figure
from nccs_pose.geometry.pose import Array
from nccs_pose.geometry.rig import Rig
import numpy as np
from numpy.typing import NDArray

_STRONG = 0.9  # correlations that are named
_HELD = 0.9  # of its spread: a number that the data did not narrow
_DPI = 120
_CELLS = 12  # of the residual map, each way


def report_text(calibration: Calibration, pictures: tuple[str, ...] = ()) -> str:
    """The report in Markdown.

    :param pictures: file names of the pictures, to be shown at the end.
    """
    c = calibration
    fit, held = c.fit, c.held_out
    u = c.uncertainty
    lines = [
        '# Calibration', '', f'**Verdict:** {c.verdict}.', '', '## Parameters', '',
        *_parameter_table(c), '', *_cut_rim(c),
        'The standard deviations are those of the numbers that the lines show; what the rough '
        'rig holds is listed below and not in them.', '',
        '## Residuals', '',
        'Distance of the measured points from their lines in the image, each frame posed by '
        'itself; robust standard deviation.', '',
        '| frames | number | points | before, px | after, px |', '|---|---|---|---|---|',
        f'| in the fit | {fit.frames} | {len(fit.pixels)} | {fit.before:.3f} | {fit.after:.3f} |',
        f'| held out | {held.frames} | {len(held.pixels)} | {held.before:.3f} '
        f'| {held.after:.3f} |', '',
        f'After the fit they are {c.adjustment.scale:.2f} times the noise that was measured in '
        f'the images (chi-squared per degree of freedom {c.adjustment.reduced_chi2:.2f}); '
        f'{100.0 * c.adjustment.inlier.mean():.1f} % of the points are inliers. {_shared(c)}', '',
        *_by_line(c), '',
        '## What the remaining uncertainty means', '',
        f'- A pose: {1e3 * u.position:.2f} mm and {np.rad2deg(u.heading):.4f}°, root mean square '
        'over the poses of the drive.',
        f'- The place of base_link, the same in every pose: {1e3 * u.base_position:.2f} mm and '
        f'{np.rad2deg(u.base_heading):.3f}°. The x, y and yaw of the mount are those of the rough '
        'rig: no line can show them.', '',
        '## What the lines do not show', '', *_weak_list(c), '',
        '## Correlations', '', *_correlations(c), '']
    for name in pictures:
        lines += [f'![{name}]({name})', '']
    return '\n'.join(lines)


def _parameter_table(c: Calibration) -> list[str]:
    rough, model = c.parameters.rough, c.model
    sigma = np.sqrt(np.diag(c.seen_covariance))
    total = np.sqrt(np.diag(c.adjustment.covariance))
    sigma = np.where(total > _HELD * c.parameters.spread, 0.0, sigma)
    rows = [
        '| parameter | before | after | change | standard deviation |', '|---|---|---|---|---|']
    for p, change, s in zip(c.parameters.parameters, c.adjustment.theta, sigma):
        before = _value(rough.rig, p)
        after = _value(model.rig, p)
        told = deviation(p, s) if s > 0.0 else 'held by the rough rig'
        rows.append(
            f'| {p.words} | {before} | {after} | {amount(change, p.unit)} | {told} |')
    return rows


def _cut_rim(c: Calibration) -> list[str]:
    """The rim is no free number, but a mirror that has shrunk cannot keep its rim."""
    before, after = c.parameters.rough.rig.mirror.rim_radius, c.model.rig.mirror.rim_radius
    if before is None or after is None or after == before:
        return []
    return [
        f'The rim_radius was {1e3 * before:.4f} mm, more than the largest radius of the refined '
        f'mirror; it was cut to that, {1e3 * after:.4f} mm.', '']


def _shared(c: Calibration) -> str:
    """What the scatter between frames says."""
    if c.adjustment.shared <= 1.0:
        return 'The frames differ by no more than that noise explains.'
    return (
        f'The frames differ by {np.sqrt(c.adjustment.shared):.1f} times as much as that noise '
        'explains: their points share errors (of the map, of the shape of the mirror, of what '
        'lies beside the lines). The standard deviations are that much larger.')


def _by_line(c: Calibration) -> list[str]:
    """Residuals of the held-out frames line by line: a mean is structure."""
    rows = ['| line, held-out frames | points | mean before, px | mean after, px |',
            '|---|---|---|---|']
    for index, line in enumerate(c.model.line_map):
        own = c.held_out.line == index
        if own.any():
            before, after = (
                _finite(r[own]).mean() if np.isfinite(r[own]).any() else np.nan
                for r in (c.held_out.residual_before, c.held_out.residual_after))
            rows.append(f'| {line.name or index} | {own.sum()} | {before:+.3f} | {after:+.3f} |')
    return rows


def _value(rig: Rig, parameter: Parameter) -> str:
    """The parameter's own number in a rig; a dash where it has none (a turn is a change)."""
    camera, mirror = rig.camera, rig.mirror
    values = {
        'cop_y': rig.cop[1], 'cop_z': rig.cop[2], 'height': rig.T_base_mirror.translation[2],
        'mirror_A': mirror.A, 'mirror_B': mirror.B, 'mirror_C': mirror.C, 'cx': camera.cx,
        'cy': camera.cy, 'focal': camera.fx}
    if parameter.name not in values:
        return '–'
    value = float(values[parameter.name])
    if parameter.unit == 'm':
        return f'{1e3 * value:.4f} mm'
    if parameter.unit == 'm^2':
        return f'{1e6 * value:.3f} mm²'
    return f'{value:.4f} {"px" if parameter.name == "focal" else parameter.unit}'.rstrip()


def _weak_list(c: Calibration) -> list[str]:
    if not c.weak:
        return ['Every free number is seen.']
    return [f'- {weak.words}.' for weak in c.weak]


def _correlations(c: Calibration) -> list[str]:
    sigma = np.sqrt(np.diag(c.seen_covariance))
    rows = []
    for i, a in enumerate(c.parameters.parameters):
        for j, b in enumerate(c.parameters.parameters[:i]):
            if sigma[i] > 0.0 and sigma[j] > 0.0:
                value = c.seen_covariance[i, j] / (sigma[i] * sigma[j])
                if abs(value) > _STRONG:
                    rows.append(f'- {b.words} and {a.words}: {value:+.3f}')
    return rows or [f'None above {_STRONG} in size.']


def report_figures(calibration: Calibration) -> dict[str, Figure]:
    """Pictures by name: residuals over the image and the mirror, correlations, histograms."""
    return {
        'residuals_image': _residual_maps(calibration, over_mirror=False),
        'residuals_mirror': _residual_maps(calibration, over_mirror=True),
        'histograms': _histograms(calibration), 'correlations': _correlation_map(calibration)}


def _both(c: Calibration) -> tuple[Array, Array, Array]:
    """Pixels and residuals, before and after, of all frames together."""
    return (np.concatenate([c.fit.pixels, c.held_out.pixels]),
            np.concatenate([c.fit.residual_before, c.held_out.residual_before]),
            np.concatenate([c.fit.residual_after, c.held_out.residual_after]))


def _residual_maps(c: Calibration, *, over_mirror: bool) -> Figure:
    pixels, before, after = _both(c)
    figure = new_figure(11.0, 4.6, _DPI)
    for axes, residual, rig, name in zip(
            figure.subplots(1, 2), (before, after), (c.parameters.rough.rig, c.model.rig),
            ('before', 'after')):
        good = np.isfinite(residual)
        if over_mirror:
            points, hit = rig.mirror_points(pixels)
            good &= hit
            at, unit = 1e3 * points[:, :2], 'mm'
        else:
            at, unit = pixels, 'px'
        x, y, mean = cell_means(at[good], residual[good])
        limit = float(np.nanmax(np.abs(mean), initial=1e-3))
        drawn = axes.pcolormesh(x, y, mean.T, cmap='RdBu_r', vmin=-limit, vmax=limit)
        figure.colorbar(drawn, ax=axes, label='mean residual, px')
        axes.set_title(f'{name}: {robust_deviation(residual):.3f} px')
        axes.set_xlabel(f'{"x" if over_mirror else "u"}, {unit}')
        axes.set_ylabel(f'{"y" if over_mirror else "v"}, {unit}')
        axes.set_aspect('equal')
        if not over_mirror:
            axes.set_xlim(0, rig.camera.width)
            axes.set_ylim(rig.camera.height, 0)
    figure.suptitle('Mean residual over the ' + ('mirror' if over_mirror else 'image'))
    return figure


def cell_means(at: Array, residual: Array, cells: int = _CELLS) -> tuple[Array, Array, Array]:
    """Edges (cells + 1,) in x and y, and mean residual in each cell (cells, cells), NaN if empty.

    :param at: where the residuals are (N, 2).
    """
    if not len(at):
        edges = np.arange(cells + 1.0)
        return edges, edges, np.full((cells, cells), np.nan)
    spans = [np.linspace(at[:, k].min(), at[:, k].max() + 1e-9, cells + 1) for k in (0, 1)]
    total, x, y = np.histogram2d(at[:, 0], at[:, 1], bins=spans, weights=residual)
    count = np.histogram2d(at[:, 0], at[:, 1], bins=spans)[0]
    return x, y, np.where(count >= 5, total / np.maximum(count, 1), np.nan)


def _histograms(c: Calibration) -> Figure:
    figure = new_figure(9.0, 3.6, _DPI)
    for axes, judged, name in zip(
            figure.subplots(1, 2), (c.fit, c.held_out), ('in the fit', 'held out')):
        before, after = (_finite(judged.residual_before), _finite(judged.residual_after))
        reach = max(1e-3, 4.0 * robust_deviation(before)) if len(before) else 1.0
        for values, colour, word in ((before, '#b0b0b0', 'before'), (after, '#1f5fa8', 'after')):
            axes.hist(
                np.clip(values, -reach, reach), bins=60, range=(-reach, reach), color=colour,
                alpha=0.8, label=word)
        axes.set_title(name)
        axes.set_xlabel('residual, px')
        axes.legend()
    return figure


def _finite(values: Array) -> Array:
    finite: NDArray[np.bool_] = np.isfinite(values)
    return values[finite]


def _correlation_map(c: Calibration) -> Figure:
    sigma = np.sqrt(np.diag(c.seen_covariance))
    seen = np.flatnonzero(sigma > 0.0)
    names = [c.parameters.parameters[i].name for i in seen]
    matrix = (c.seen_covariance / np.outer(
        np.where(sigma > 0.0, sigma, 1.0), np.where(sigma > 0.0, sigma, 1.0)))[np.ix_(seen, seen)]
    figure = new_figure(5.6, 5.0, _DPI)
    axes = figure.add_subplot()
    drawn = axes.imshow(matrix, cmap='RdBu_r', vmin=-1.0, vmax=1.0)
    figure.colorbar(drawn, ax=axes, label='correlation')
    axes.set_xticks(range(len(names)), names, rotation=90)
    axes.set_yticks(range(len(names)), names)
    return figure
