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

"""Which numbers of the rig (and the map) are free, and how a rig moves with them.

The vector theta is the deviation from the rough rig, so that 'held by the rough value' is a
prior theta ~ N(0, spread^2), number by number. The mounting's x, y and yaw are never free: a robot
that moves in the plane cannot see where on it the mirror sits, only that base_link is there.

A rig file has its centre of projection at x = 0, by the choice of the mirror frame. Here it may
leave that plane, as a camera that is pushed sideways does; :meth:`RigParameters.model` then turns
the mirror frame about its axis until x is 0 again. Whether the camera was pushed sideways or
turned about the axis the lines cannot tell: together they turn base_link.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

from nccs_pose.calibration.options import CalibrationOptions
from nccs_pose.calibration.sensitivity import Sensitivity
from nccs_pose.errors import CalibrationError
from nccs_pose.geometry.lines import Line, LineMap
from nccs_pose.geometry.mirror import QuadricMirror
from nccs_pose.geometry.pose import Array, cross_matrix, RigidTransform, rotation_exp
from nccs_pose.geometry.rig import Rig
import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Parameter:
    """One free number.

    :ivar name: short, e.g. ``cop_y``.
    :ivar words: for sentences, e.g. ``the centre of projection across (y)``.
    :ivar unit: ``m``, ``rad``, ``px``, ``m^2`` or empty.
    :ivar spread: standard deviation of its rough value, in that unit.
    :ivar group: what it belongs to, in words.
    """

    name: str
    words: str
    unit: str
    spread: float
    group: str


@dataclass(frozen=True, eq=False)
class RigModel:
    """A rig and the map that goes with it."""

    rig: Rig
    line_map: LineMap


class RigParameters:
    """The free parameters around a rough rig and map.

    :param free_lines: names of map lines whose place is free.
    :param hold_gauge: leave out the tilt of a sphere, whose effect the camera's place and turn
        have as well: estimate one of the two.
    :raises CalibrationError: if a name is no line of the map, or every line would be free.
    """

    def __init__(
        self, rig: Rig, line_map: LineMap, options: CalibrationOptions | None = None,
        free_lines: Sequence[str] = (), *, hold_gauge: bool = True,
    ) -> None:
        options = options or CalibrationOptions()
        if hold_gauge and rig.mirror.kind == 'sphere':
            options = replace(options, tilt=False)
        self.rough = RigModel(rig, line_map)
        self.lines = _line_indices(line_map, free_lines)
        # A rim cuts rays off while the rig still moves; it is no measurement, so leave it out.
        self._bare = replace(rig, mirror=replace(rig.mirror, rim_radius=None))
        self.parameters = tuple(_parameters(rig, line_map, self.lines, options))
        self.index = {p.name: i for i, p in enumerate(self.parameters)}
        self.spread = np.array([p.spread for p in self.parameters])

    def __len__(self) -> int:
        return len(self.parameters)

    def _part(self, theta: Array, *names: str) -> Array:
        """Components of theta by name; zero for those that are not free."""
        return np.array([theta[self.index[n]] if n in self.index else 0.0 for n in names])

    def model(self, theta: Array, *, with_rim: bool = False) -> RigModel:
        """The rig and map at theta (P,).

        :param with_rim: put the mirror's rim back, for use outside the adjustment; no wider than
            the mirror has become.
        :raises GeometryError: if there can be no such rig.
        """
        rough = self._bare
        d_mirror = self._part(theta, 'mirror_A', 'mirror_B', 'mirror_C')
        mirror = QuadricMirror(
            rough.mirror.A + d_mirror[0], rough.mirror.B + d_mirror[1],
            rough.mirror.C + d_mirror[2])
        rim = self.rough.rig.mirror.rim_radius
        if with_rim and rim is not None:
            mirror = replace(mirror, rim_radius=min(rim, mirror.largest_radius))
        camera = rough.camera
        shift, zoom = self._part(theta, 'cx', 'cy'), 1.0 + self._part(theta, 'focal')[0]
        if {'cx', 'focal'} & self.index.keys():
            camera = replace(
                camera, cx=camera.cx + shift[0], cy=camera.cy + shift[1],
                fx=camera.fx * zoom, fy=camera.fy * zoom)
        mounting = rough.T_base_mirror
        tilt = rotation_exp([*self._part(theta, 'tilt_x', 'tilt_y'), 0.0])
        azimuth = self._azimuth(theta)
        cop = azimuth @ (rough.cop + self._part(theta, 'cop_x', 'cop_y', 'cop_z'))
        cop[0] = 0.0  # but for rounding
        rig = Rig(
            mirror, camera, cop,
            azimuth @ rotation_exp(self._part(theta, 'camera_x', 'camera_y', 'camera_z'))
            @ rough.R_mirror_camera,
            RigidTransform(
                tilt @ mounting.rotation @ azimuth.T,
                mounting.translation + np.array([0.0, 0.0, self._part(theta, 'height')[0]])))
        return RigModel(rig, self._map(theta))

    def _azimuth(self, theta: Array) -> Array:
        """The turn (3, 3) about the mirror's axis that brings the camera to x = 0."""
        x, y, _ = self._bare.cop + self._part(theta, 'cop_x', 'cop_y', 'cop_z')
        return rotation_exp([0.0, 0.0, np.arctan2(x if y >= 0.0 else -x, abs(y))])

    def _map(self, theta: Array) -> LineMap:
        if not (self.lines or 'tape_width' in self.index):
            return self.rough.line_map
        wider = self._part(theta, 'tape_width')[0]
        lines = []
        for i, line in enumerate(self.rough.line_map):
            offset, turn = self._part(theta, f'line{i}_offset', f'line{i}_turn')
            width = line.width + wider if line.width > 0.0 else 0.0
            lines.append(_moved(line, offset, turn, width) if i in self.lines
                         else replace(line, width=width))
        return LineMap(tuple(lines), self.rough.line_map.frame)

    def columns(self, theta: Array, sensitivity: Sensitivity, model: RigModel,
                pixels: Array, line: NDArray[np.intp]) -> Array:
        """dS/dtheta (N, P), exact at theta.

        :param model: the rig and map at theta.
        :param pixels: the points (N, 2).
        :param line: their lines (N,).
        """
        s, camera = sensitivity, model.rig.camera
        # theta is a rotation vector: a step in it turns by its left Jacobian.
        azimuth = self._azimuth(theta)
        cop = s.cop @ azimuth
        camera_turn = s.camera_rotation @ azimuth @ left_jacobian(
            self._part(theta, 'camera_x', 'camera_y', 'camera_z'))
        tilt = s.mounting_rotation @ left_jacobian(
            np.array([*self._part(theta, 'tilt_x', 'tilt_y'), 0.0]))
        zoom = 1.0 + self._part(theta, 'focal')[0]
        source: dict[str, Callable[[], Array]] = {
            'cop_x': lambda: cop[:, 0], 'cop_y': lambda: cop[:, 1], 'cop_z': lambda: cop[:, 2],
            'camera_x': lambda: camera_turn[:, 0], 'camera_y': lambda: camera_turn[:, 1],
            'camera_z': lambda: camera_turn[:, 2],
            'height': lambda: s.mounting_translation[:, 2],
            'tilt_x': lambda: tilt[:, 0], 'tilt_y': lambda: tilt[:, 1],
            'mirror_A': lambda: s.mirror[:, 0], 'mirror_B': lambda: s.mirror[:, 1],
            'mirror_C': lambda: s.mirror[:, 2],
            # The camera sees (u - c) / f: moving c is moving every pixel the other way.
            'cx': lambda: -s.pixel[:, 0], 'cy': lambda: -s.pixel[:, 1],
            'focal': lambda: -np.einsum(
                'ni,ni->n', s.pixel, pixels - [camera.cx, camera.cy]) / zoom,
            'tape_width': lambda: s.width,
        }
        for i in self.lines:
            on = line == i
            source[f'line{i}_offset'] = partial(np.multiply, s.line_offset, on)
            source[f'line{i}_turn'] = partial(np.multiply, s.line_turn, on)
        return np.stack([source[p.name]() for p in self.parameters], axis=1)


def left_jacobian(vector: Array) -> Array:
    """J (3, 3) with exp(v + dv) = exp(J dv) exp(v), to first order."""
    angle = float(np.linalg.norm(vector))
    k = cross_matrix(vector)
    if angle < 1e-4:
        return np.eye(3) + 0.5 * k + k @ k / 6.0
    return (np.eye(3) + (1.0 - np.cos(angle)) / angle**2 * k
            + (angle - np.sin(angle)) / angle**3 * (k @ k))


def _moved(line: Line, offset: float, turn: float, width: float) -> Line:
    """The line shifted to its left and turned about its middle."""
    middle = 0.5 * (line.start + line.end)
    rotation = rotation_exp([0.0, 0.0, turn])
    shift = middle + offset * np.cross([0.0, 0.0, 1.0], rotation @ line.direction)
    return replace(
        line, start=rotation @ (line.start - middle) + shift,
        end=rotation @ (line.end - middle) + shift, width=width)


def _line_indices(line_map: LineMap, names: Sequence[str]) -> tuple[int, ...]:
    known = [line.name for line in line_map]
    for name in names:
        if name not in known:
            raise CalibrationError(
                f'line {name!r} cannot be freed: the map has {", ".join(known)}')
    indices = tuple(i for i, name in enumerate(known) if name in names)
    if indices and len(known) - len(indices) < 2:
        raise CalibrationError(
            f'of {len(known)} lines {len(indices)} are free: at least two must stay where they '
            'are, or nothing says where the map is')
    return indices


def _parameters(
    rig: Rig, line_map: LineMap, lines: tuple[int, ...], options: CalibrationOptions,
) -> list[Parameter]:
    cop, camera = 'centre of projection', 'camera against mirror'
    out = [
        Parameter(f'cop_{axis}', f'centre of projection {word} ({axis})', 'm', spread, cop)
        for axis, word, spread in (
            ('x', 'sideways', options.rough_cop_sideways),
            ('y', 'across the axis', options.rough_cop),
            ('z', 'along the axis', options.rough_cop))]
    out += [
        Parameter(f'camera_{axis}', f"camera's turn about the mirror's {axis}", 'rad',
                  options.rough_camera_tilt, camera) for axis in 'xyz']
    if options.height:
        out.append(Parameter(
            'height', 'height of the mirror', 'm', options.rough_height, 'height'))
    if options.tilt:
        out += [
            Parameter(f'tilt_{axis}', f'{word} of the rig', 'rad', options.rough_tilt,
                      'tilt of the rig') for axis, word in (('x', 'roll'), ('y', 'pitch'))]
    if options.mirror:
        out += _mirror_parameters(rig.mirror, options.rough_mirror)
    if options.principal_point:
        out += [Parameter(f'c{axis}', f'principal point c{axis}', 'px',
                          options.rough_principal_point, 'principal point') for axis in 'xy']
    if options.focal_length:
        out.append(Parameter(
            'focal', 'focal length (relative)', '', options.rough_focal_length, 'focal length'))
    if options.tape_width:
        out.append(Parameter(
            'tape_width', 'width of the tapes', 'm', options.rough_tape_width, 'tape width'))
    for i in lines:
        line = line_map[i]
        group = f'line {line.name}'
        out.append(Parameter(
            f'line{i}_offset', f'offset of line {line.name}', 'm', options.rough_line, group))
        out.append(Parameter(
            f'line{i}_turn', f'turn of line {line.name}', 'rad',
            2.0 * options.rough_line / line.length, group))
    return out


def _mirror_parameters(mirror: QuadricMirror, relative: float) -> list[Parameter]:
    """The numbers that change the surface and keep its kind, spread by a fraction of its size."""
    group, size = "mirror's shape", float(np.sqrt(abs(mirror.C))) or abs(mirror.apex_z)
    spread = {'A': relative, 'B': relative * max(abs(mirror.B), size),
              'C': relative * max(2.0 * abs(mirror.C), size**2)}
    # A sphere has a radius; a paraboloid's C, like a sphere's B, only moves it along the axis.
    names = {'sphere': 'C', 'paraboloid': 'B'}.get(mirror.kind, 'ABC')
    unit = {'A': '', 'B': 'm', 'C': 'm^2'}
    return [Parameter(f'mirror_{n}', f"mirror's {n}", unit[n], spread[n], group) for n in names]
