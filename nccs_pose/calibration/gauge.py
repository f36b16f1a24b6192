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

"""What the lines do not tell about the rig, in words, and what that means for the pose.

In units of the rough values' spread the information matrix says how much more the data know than
the drawing did: an eigenvalue below 1 is a combination of numbers that stays as the drawing has
it (a gauge, if it is zero), one of some tens a combination that is seen, but weakly.
"""

from __future__ import annotations

from dataclasses import dataclass

from nccs_pose.calibration.parameters import Parameter, RigModel, RigParameters
from nccs_pose.geometry.pose import Array
import numpy as np

_HELD = 1.0  # the data know less than the rough value
_WEAK = 100.0  # the data know less than ten times as much as the rough value
_SHARE = 0.02  # of the largest: parts of a direction that are not worth a word


@dataclass(frozen=True, eq=False)
class WeakDirection:
    """A combination of numbers that the data see hardly or not at all.

    :ivar direction: how theta moves along it, one standard deviation of what is left (P,).
    :ivar held: whether the rough value says more of it than the data do.
    :ivar words: what it is.
    """

    direction: Array
    held: bool
    words: str


def weak_directions(
    information: Array, parameters: RigParameters, model: RigModel,
) -> tuple[WeakDirection, ...]:
    """Combinations that the information (P, P) does not fix, the least known first."""
    spread = parameters.spread
    scaled = information * np.outer(spread, spread)
    values, vectors = np.linalg.eigh(0.5 * (scaled + scaled.T))
    found = []
    for value, vector in zip(values, vectors.T):
        # As a ratio of information: the data's over the rough value's.
        knowledge = max(0.0, float(value))
        if knowledge >= _WEAK:
            break
        direction = vector * spread / np.sqrt(1.0 + knowledge)
        # The sign says nothing; let the largest part be positive.
        direction *= np.sign(vector[np.argmax(np.abs(vector))])
        held = knowledge < _HELD
        found.append(WeakDirection(
            direction, held, _words(direction, parameters, model, held)))
    return tuple(found)


def _words(direction: Array, parameters: RigParameters, model: RigModel, held: bool) -> str:
    relative = np.abs(direction / parameters.spread)
    parts = [
        f'{p.words} by {amount(value, p.unit)}'
        for p, value, size in zip(parameters.parameters, direction, relative)
        if size > _SHARE * relative.max()]
    together = ' together with '.join([', '.join(parts[:-1]), parts[-1]] if parts[1:] else parts)
    name = _name(direction, parameters, model)
    name = f'{name}: ' if name else ''
    if held:
        return f'{name}{together} changes nothing that the lines show; held by the rough rig'
    return f'{name}{together} is seen only weakly; one standard deviation'


def _name(direction: Array, parameters: RigParameters, model: RigModel) -> str:
    """The gauge that a direction is, if it is one that has a name."""
    best, name = 0.9, ''
    for label, gauge in gauges(parameters, model):
        columns = gauge / parameters.spread[:, None]
        target = direction / parameters.spread
        basis, triangle = np.linalg.qr(columns)
        basis = basis[:, np.abs(np.diag(triangle)) > 1e-12]
        cosine = float(np.linalg.norm(basis.T @ target) / np.linalg.norm(target))
        if cosine > best:
            best, name = cosine, label
    return name


def gauges(parameters: RigParameters, model: RigModel) -> list[tuple[str, Array]]:
    """Freedoms that can be foreseen: (name, (P, K)) with K moves that change no picture."""
    rig = model.rig
    heading = {'cop_x': -rig.cop[1], 'camera_z': 1.0}
    found = [("heading of base_link (the camera pushed sideways and turned about the mirror's "
              'axis)', _moves(parameters, [heading]))]
    if rig.mirror.kind == 'sphere' and {'tilt_x', 'tilt_y'} <= parameters.index.keys():
        arm = rig.cop - np.array([0.0, 0.0, rig.mirror.centre_z])
        moves = []
        for axis in np.eye(3)[:2]:
            shift = np.cross(axis, arm)
            tilt = -rig.T_base_mirror.rotation @ axis
            moves.append({
                'cop_x': shift[0], 'cop_y': shift[1], 'cop_z': shift[2], 'camera_x': axis[0],
                'camera_y': axis[1], 'tilt_x': tilt[0], 'tilt_y': tilt[1]})
        # Any heading of base_link comes with it.
        found.append(("turn of the mirror frame about the sphere's centre", _moves(
            parameters, [*moves, heading])))
    mirror = rig.mirror
    if {'mirror_C', 'cop_z', 'height'} <= parameters.index.keys():
        # Size of mirror and camera's distance together: the rays turn not at all and shift by
        # millimetres against metres of room.
        found.append(('size of the mirror with the distance of the camera', _moves(parameters, [
            {'cop_y': rig.cop[1], 'cop_z': rig.cop[2], 'mirror_B': mirror.B,
             'mirror_C': 2.0 * mirror.C}])))
        # Sliding the quadric along its axis by dz: B <- B - 2 A dz, C <- C + B dz.
        found.append(('place of the mirror along its axis', _moves(parameters, [
            {'cop_z': 1.0, 'height': 1.0, 'mirror_B': -2.0 * mirror.A, 'mirror_C': mirror.B}])))
    if 'focal' in parameters.index:
        found.append(('focal length with the distance of the camera', _moves(parameters, [
            {'focal': 1.0, 'cop_y': rig.cop[1], 'cop_z': rig.cop[2]}])))
    if 'cx' in parameters.index:
        found.append(("principal point with the camera's direction", _moves(parameters, [
            dict(zip(('camera_x', 'camera_y', 'camera_z'), rig.R_mirror_camera @ turn), **shift)
            for turn, shift in (
                (np.array([0.0, 1.0, 0.0]), {'cx': -rig.camera.fx}),
                (np.array([1.0, 0.0, 0.0]), {'cy': rig.camera.fy}))])))
    return found


def _moves(parameters: RigParameters, moves: list[dict[str, float]]) -> Array:
    """Moves (P, K) by name; parts that are not free are left out."""
    columns = np.zeros((len(parameters), len(moves)))
    for k, move in enumerate(moves):
        for name, value in move.items():
            if name in parameters.index:
                columns[parameters.index[name], k] = value
    return columns


def amount(value: float, unit: str) -> str:
    """A number for a person: lengths in mm, angles in degrees."""
    if unit == 'm':
        return f'{1e3 * value:+.3g} mm'
    if unit == 'rad':
        return f'{np.rad2deg(value):+.3g}°'
    if unit == 'm^2':
        return f'{1e6 * value:+.3g} mm²'
    return f'{value:+.3g} {unit}'.rstrip()


def deviation(parameter: Parameter, value: float) -> str:
    """The same without a sign, for a standard deviation."""
    return amount(abs(value), parameter.unit).lstrip('+')


@dataclass(frozen=True)
class PoseUncertainty:
    """What an uncertain rig means for a pose, root mean square over frames.

    :ivar position: metres, apart from an offset that is the same in every pose.
    :ivar heading: radians, likewise.
    :ivar base_position: of the constant offset, metres: where base_link is.
    :ivar base_heading: of the constant offset, radians.
    """

    position: float
    heading: float
    base_position: float
    base_heading: float


def pose_uncertainty(pose_gain: Array, poses: Array, covariance: Array) -> PoseUncertainty:
    """How far poses may be off because the rig is known with that covariance (P, P).

    An error that is the same in every pose, seen from the robot, only says that base_link sits
    elsewhere on it; it is given apart.

    :param pose_gain: -dpose/dtheta (F, 3, P), as the adjustment gives it.
    :param poses: T_map_base (F, 3).
    """
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    body = -pose_gain.copy()
    body[:, 0] = -(c[:, None] * pose_gain[:, 0] + s[:, None] * pose_gain[:, 1])
    body[:, 1] = -(c[:, None] * pose_gain[:, 1] - s[:, None] * pose_gain[:, 0])
    common = body.mean(axis=0)
    rest = np.einsum('fip,pq,fiq->i', body - common, covariance, body - common) / len(poses)
    base = np.einsum('ip,pq,iq->i', common, covariance, common)
    rest, base = np.maximum(rest, 0.0), np.maximum(base, 0.0)
    return PoseUncertainty(
        float(np.sqrt(rest[0] + rest[1])), float(np.sqrt(rest[2])),
        float(np.sqrt(base[0] + base[1])), float(np.sqrt(base[2])))
