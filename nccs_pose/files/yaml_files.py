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
"""The rig and the map as YAML files that a person writes by hand.

Lengths are metres, angles radians. A wrong key or value is refused by name; what the geometry
itself refuses (a camera inside the mirror, a line of no length) is refused with the file and key.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from nccs_pose.errors import GeometryError
from nccs_pose.files.text_files import write_text
from nccs_pose.files.yaml_sections import read_yaml, Section
from nccs_pose.geometry.camera import PinholeCamera
from nccs_pose.geometry.lines import Line, LineMap
from nccs_pose.geometry.mirror import QuadricMirror
from nccs_pose.geometry.pose import RigidTransform
from nccs_pose.geometry.rig import Rig
from nccs_pose.vision.colour import CONTRASTS
import numpy as np

DISTORTION_MODELS = ('plumb_bob', 'rational_polynomial')

_MOST_PIXELS = 16384  # width or height of an image
_SAME = 1e-3  # metres between the ends of what is one line given twice
_LONGEST = 1e4  # metres of a line; what is longer has an end at the origin or in other units

_Value = TypeVar('_Value')


def load_rig(path: str | Path) -> Rig:
    """Read a rig: sections `mirror`, `camera`, `mounting` (see config/room_rig.yaml).

    :raises FileError: one sentence that names the file, the key, the value and what is accepted.
    """
    top = read_yaml(path)
    mirror, camera, mounting = (top.section(key) for key in ('mirror', 'camera', 'mounting'))
    top.done()
    quadric = _mirror(mirror)
    pinhole = _camera(camera)
    cop = camera.numbers('cop', (3,), unit='m')
    rotation = camera.rotation('R_mirror_camera')
    camera.done()
    translation = mounting.numbers('translation', (3,), unit='m')
    if translation[2] <= 0.0:
        raise mounting.error(
            'translation[2]', "must be above 0, the mirror's height over the floor, not "
            f'{translation[2]}')
    transform = RigidTransform.from_rpy(mounting.numbers('rpy', (3,), unit='rad'), translation)
    mounting.done()
    return _build(top, 'camera', lambda: Rig(quadric, pinhole, cop, rotation, transform))


def load_map(path: str | Path) -> LineMap:
    """Read a map: `lines` with start and end, and their common width, colour and frame.

    Lines that no image shows, above the floor or without a width, are refused.

    :raises FileError: one sentence that names the file, the key, the value and what is accepted.
    """
    top = read_yaml(path)
    frame = top.text('frame', 'map')
    width = top.number('width', 0.0, unit='m', low=0.0)
    colour = top.text('colour', 'green', choices=tuple(CONTRASTS))
    sections = top.sections('lines')
    top.done()
    lines = [
        _line(section, width, colour, default_name=f'line{index}')
        for index, section in enumerate(sections)]
    if len(lines) < 2:
        raise top.error('lines', f'must hold at least 2 lines, it holds {len(lines)}')
    _refuse_repetition(lines, sections)
    for line, section in zip(lines, sections):
        if not line.is_tape:
            raise section.error(
                '', f'(line {line.name!r}) is no tape on the floor, and images show nothing else: '
                f'its width must be above 0 m, not {line.width:g}, and its z be 0 m, not '
                f'{line.start[2]:g} and {line.end[2]:g}')
    return _build(top, 'lines', lambda: LineMap(tuple(lines), frame=frame))


def save_rig(rig: Rig, path: str | Path, comment: str = '') -> None:
    """Write a rig as `load_rig` reads it, every number exactly; `comment` goes on top."""
    mirror, camera, mounting = rig.mirror, rig.camera, rig.T_base_mirror
    rim = f'  rim_radius: {_number(mirror.rim_radius)}  # m\n' if mirror.rim_radius else ''
    write_text(
        path,
        f'{_comment(comment)}'
        'mirror:  # x^2 + y^2 + A z^2 + B z - C = 0, symmetry axis z\n'
        f'  A: {_number(mirror.A)}\n'
        f'  B: {_number(mirror.B)}  # m\n'
        f'  C: {_number(mirror.C)}  # m^2\n'
        f'{rim}'
        'camera:\n'
        f'  width: {camera.width}  # px\n'
        f'  height: {camera.height}  # px\n'
        f'  K: {_rows(camera.K)}  # px, row by row\n'
        f'  distortion_model: {camera.distortion_model}\n'
        f'  distortion: {_list(camera.distortion)}\n'
        f'  cop: {_list(rig.cop)}  # m, centre of projection in the mirror frame\n'
        f'  R_mirror_camera: {_rows(rig.R_mirror_camera)}  # optical axes in the mirror frame\n'
        'mounting:  # T_base_mirror\n'
        f'  translation: {_list(mounting.translation)}  # m\n'
        f'  rpy: {_list(mounting.rpy())}  # rad, R = Rz(yaw) Ry(pitch) Rx(roll)\n',
    )


def save_map(line_map: LineMap, path: str | Path, comment: str = '') -> None:
    """Write a map as `load_map` reads it, every number exactly; `comment` goes on top."""
    rows = [
        f'  - {{name: {_quoted(line.name or f"line{index}")}, start: {_list(line.start)}, '
        f'end: {_list(line.end)}, width: {_number(line.width)}, colour: {_quoted(line.colour)}}}\n'
        for index, line in enumerate(line_map)
    ]
    write_text(
        path,
        f'{_comment(comment)}frame: {_quoted(line_map.frame)}\nlines:  # centre lines, metres\n'
        f'{"".join(rows)}',
    )


def _mirror(section: Section) -> QuadricMirror:
    A = section.number('A')
    B = section.number('B', unit='m')
    C = section.number('C', unit='m^2')
    rim_radius = section.number('rim_radius', None, unit='m', above=0.0)
    section.done()
    return _build(section, '', lambda: QuadricMirror(A, B, C, rim_radius=rim_radius))


def _camera(section: Section) -> PinholeCamera:
    width = section.count('width', _MOST_PIXELS)
    height = section.count('height', _MOST_PIXELS)
    K = section.numbers('K', (9,), unit='px').reshape(3, 3)
    if K[0, 0] <= 0.0 or K[1, 1] <= 0.0:
        raise section.error('K', f'must have focal lengths above 0, not {K[0, 0]} and {K[1, 1]}')
    if K[0, 1] != 0.0 or K[1, 0] != 0.0 or not np.array_equal(K[2], [0.0, 0.0, 1.0]):
        raise section.error('K', f'must be [fx, 0, cx, 0, fy, cy, 0, 0, 1], not {K.ravel()}')
    model = section.text('distortion_model', 'plumb_bob', choices=DISTORTION_MODELS)
    lengths = (0, 4, 5) if model == 'plumb_bob' else (8,)
    distortion = tuple(section.numbers('distortion', lengths, default=()))
    return _build(
        section, '', lambda: PinholeCamera.from_K(width, height, K, model, distortion)
    )


def _line(section: Section, width: float, colour: str, default_name: str) -> Line:
    name = section.text('name', default_name)
    start, end = _point(section, 'start'), _point(section, 'end')
    width = section.number('width', width, unit='m', low=0.0)
    colour = section.text('colour', colour, choices=tuple(CONTRASTS))
    section.done()
    if np.array_equal(start, end):
        raise section.error('', f'(line {name!r}) has no length: start and end are {start}')
    length = float(np.linalg.norm(end - start))
    # The estimator's tables grow with it: millions of metres fill the memory.
    if length > _LONGEST:
        raise section.error(
            '', f'(line {name!r}) is {length:g} m long, more than {_LONGEST:g} m: are both ends '
            'in metres, and of one origin?')
    return _build(section, '', lambda: Line(start, end, width, colour, name))


def _refuse_repetition(lines: list[Line], sections: list[Section]) -> None:
    """Refuse a name given twice, and a line whose ends are where another's are."""
    names: set[str] = set()
    ends = np.array([(line.start, line.end) for line in lines])  # (L, 2, 3)
    for index, (line, section) in enumerate(zip(lines, sections)):
        if line.name in names:
            raise section.error('name', f'is given twice in the map: {line.name!r}')
        names.add(line.name)
        apart = np.minimum(*(
            np.abs(ends[:index] - there).max(axis=(1, 2), initial=0.0)
            for there in (ends[index], ends[index, ::-1])))
        if (apart <= _SAME).any():
            twin = lines[int(apart.argmin())]
            raise section.error('', f'(line {line.name!r}) is line {twin.name!r} once more')


def _point(section: Section, key: str) -> np.ndarray:
    """Two numbers, on the ground, or three."""
    point = section.numbers(key, (2, 3), unit='m')
    return point if point.size == 3 else np.append(point, 0.0)


def _build(section: Section, key: str, make: Callable[[], _Value]) -> _Value:
    """Make a geometric value; what the geometry refuses is refused with the file and key."""
    try:
        return make()
    except GeometryError as error:
        raise section.error(key, f'is refused: {str(error).rstrip(".")}') from error


def _number(value: float) -> str:
    return repr(float(value))


def _list(values: object) -> str:
    return f'[{", ".join(_number(value) for value in np.ravel(np.asarray(values, dtype=float)))}]'


def _rows(matrix: np.ndarray) -> str:
    rows = [', '.join(_number(value) for value in row) for row in np.asarray(matrix, dtype=float)]
    return '[\n    ' + ',\n    '.join(rows) + ']'


def _quoted(text: str) -> str:
    """Write a word so that YAML reads the same word back, whatever it holds."""
    plain = text.isidentifier() and text.lower() not in {'null', 'true', 'false'}
    return text if plain else "'" + text.replace("'", "''") + "'"


def _comment(comment: str) -> str:
    return ''.join(f'# {line}'.rstrip() + '\n' for line in comment.splitlines())
