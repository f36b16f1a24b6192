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

"""Where a pose says that the tapes of the map are seen, and how they move with the pose."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from functools import cached_property
import itertools
import math

from nccs_pose.estimation.whole_lines import first_pieces
from nccs_pose.geometry.floor_table import as_complex, as_points, Complex, FloorTable
from nccs_pose.geometry.lines import LineMap
from nccs_pose.geometry.pose import Array, Pose2
from nccs_pose.vision.bands import Bands, in_whole_parts
import numpy as np
from numpy.typing import NDArray

# Neighbours over about so many px share what they know of the floor, the contrast and the noise.
_SHARED_PX = 16.0
# Coarse samples of what is in reach of each line; between them its image is interpolated.
_COARSE = 32
_EVENLY = np.linspace(0.0, 1.0, _COARSE)
_SLOPE = 1e-9
# A tape's end is no edge: keep this much away from it, px.
_END = 3.0
# Floor that a profile needs beside its tape, px: nearer to another tape it would show both.
_BESIDE = 4.0
# So finely is known how near other tapes come: parts of a tape's length, or more of a part that
# would be longer than this, metres.
_GAPS = 256
_LONGEST_PART = 0.04
# So many stations at most, on all lines together.
_MOST = 1500
_LEVEL = np.zeros(3)


@dataclass(frozen=True, eq=False)
class Places:
    """Where on the floor tapes N stations stand.

    :ivar number: of the line in the map (N,).
    :ivar distance: from the line's start (N,), metres.
    :ivar spacing: length of curve that the station stands for (N,), px.
    :ivar members: of each group of neighbours, one after the other; every line has whole groups.
    """

    number: NDArray[np.intp]
    distance: Array
    spacing: Array
    members: int

    def __len__(self) -> int:
        return len(self.number)

    @cached_property
    def length(self) -> float:
        """Of curve that all of them stand for, px."""
        return float(self.spacing.sum())

    def every(self, step: int) -> Places:
        """One group out of so many."""
        at = np.arange(len(self)).reshape(-1, self.members)[step // 2::step].ravel()
        return Places(
            self.number.take(at), self.distance.take(at), self.spacing.take(at), self.members)


class BandPredictor:
    """Lays stations along the images of a map's lines, which are all tapes, for one rig."""

    def __init__(self, table: FloorTable, line_map: LineMap) -> None:
        self._table = table
        self._start = as_complex(line_map.starts[:, :2])
        self._direction = as_complex(line_map.directions[:, :2])
        self._length = line_map.lengths
        self._half_width = 0.5 * line_map.widths
        parts = np.maximum(_GAPS, np.ceil(self._length / _LONGEST_PART)).astype(np.intp)
        # Half width, half its square, length, parts per metre, the first of them and direction to
        # the left, by rows.
        self._tapes = np.array([
            self._half_width, 0.5 * self._half_width**2, self._length, parts / self._length,
            parts.cumsum() - parts, -self._direction.imag, self._direction.real])
        self._slope = _SLOPE * np.arange(_COARSE * len(line_map))
        self._gap = self._gaps(parts, first_pieces(line_map))

    def places(
        self, pose: Pose2, spacing: float, most: int, lines: Collection[int] | None = None,
    ) -> Places:
        """Stations evenly spaced in the image along each visible tape.

        :param pose: T_map_base.
        :param spacing: of the stations, px, or more.
        :param most: at most so many a line.
        :param lines: of the map that get any; None for all.
        """
        tapes = len(self._length)
        turn = _turned_back(pose)
        along = self._in_reach((self._start - complex(pose.x, pose.y)) * turn, turn)
        samples = self._start[:, None] + along * self._direction[:, None]
        pixels, seen = self._table.outline((samples.ravel() - complex(pose.x, pose.y)) * turn)
        # All lines one after the other on one axis, so that one interpolation serves them; where
        # a line is hidden, and from one to the next, its arc is flat, and a tiny slope keeps it
        # invertible.
        steps = np.zeros(len(pixels))
        after = np.abs(pixels[1:] - pixels[:-1], out=steps[1:])
        after *= seen[1:] & seen[:-1]
        steps[::_COARSE] = 0.0
        axis = steps.cumsum()
        # Lines are few beside their samples: number by number they cost less than any call.
        begin, end = axis[::_COARSE].tolist(), axis[_COARSE - 1::_COARSE].tolist()
        length = [max(b - a - 2.0 * _END, 0.0) for a, b in zip(begin, end)]
        limit = min(most, _MOST // max(tapes, 1))
        count = [min(limit, int(each / spacing)) for each in length]
        if lines is not None:
            count = [n if k in lines else 0 for k, n in enumerate(count)]
        # All groups are equal, so that what is summed over them needs no list of their sizes.
        shown = max(sum(each for each, n in zip(length, count) if n), spacing)
        members = max(round(_SHARED_PX * sum(count) / shown), 1)
        count = [n - n % members for n in count]
        apart = [each / max(n, 1) for each, n in zip(length, count)]
        first = itertools.accumulate(count, initial=0)
        before = [a + _END - n * each for a, n, each in zip(begin, first, apart)]
        number = np.arange(tapes).repeat(count)
        spacing_px, offset = np.array([apart, before]).take(number, axis=1)
        where = np.arange(0.5, len(number)) * spacing_px + offset
        distance = np.interp(where, axis + self._slope, along.ravel())
        return Places(number, distance, spacing_px, members)

    def bands(
        self, places: Places, pose: Pose2, attitude: Array = _LEVEL,
    ) -> tuple[Bands, Array]:
        """How stations are seen from a pose.

        :param pose: T_map_base, not far from where the stations were chosen.
        :param attitude: the base's (z, roll, pitch) off its plane (3,), metres and rad, small.
        :returns: those that are seen, and d(their place across)/d(x, y, yaw, z, roll, pitch)
            (N, 6), px per metre and rad; the last three as small motions of the base off its
            plane.
        """
        number, distance = places.number, places.distance
        turn = _turned_back(pose)
        origin = (self._start - complex(pose.x, pose.y)) * turn
        ahead = (self._direction * turn).take(number)
        back = ahead.conj()
        middle = origin.take(number) + distance * ahead
        if any(attitude.tolist()):
            middle = as_complex(self._table.met(*_leant(as_points(middle), attitude)))
        image = self._table.expand(middle)
        # The terms of a step ahead on the line, 2 V for V. To its left, i times as far, P and Q
        # bring in i and -i, U and W -1.
        pixels, p, q, u, v, w = image.terms
        p, q, u, v, w = p * ahead, q * back, u * (ahead * ahead), 2.0 * v, w * (back * back)
        by_ahead, twice = p + q, u + w
        twice_ahead, twice_mixed, twice_left = v + twice, 2j * (u - w), v - twice
        speed = np.abs(by_ahead)
        # Against how the pixel goes ahead, how it goes to the left, less i, and how it bends.
        turned, bent = (p - q) / by_ahead, twice_ahead / by_ahead
        tapes = self._tapes.take(number, axis=1)
        (half, half_square, length, gaps_per_metre, first_gap), left = tapes[:5], tapes[5:]
        # The cut across the tape whose image is normal to the curve leans along the line.
        lean = turned.imag
        gain = np.abs(turned.real) * speed
        # One over the speed, negative where the image is reflected.
        slowness = np.copysign(1.0, turned.real) / speed
        across = 1j * slowness * by_ahead
        bend = slowness * bent.imag
        # The two edges lie unequally far from the midline: a matter of the second order.
        centre = as_points(pixels + half_square * (
            (twice_ahead * lean + twice_mixed) * lean + twice_left))
        half_width = half * gain
        gap = self._gap.take(
            (distance * gaps_per_metre + first_gap).astype(np.intp), mode='clip')
        # Near its ends the leaning cut would leave the tape.
        keep = (self._table.sees_floor(centre) & (half_width > 1e-3) & (gap * gain > _BESIDE)
                & (np.minimum(distance, length - distance) > half * np.abs(lean)))
        bands = Bands(centre, as_points(pixels), as_points(across), bend, half_width,
                      places.spacing, number, places.members)
        slide = _slide(gain, left, middle, back, image.falls)
        if np.count_nonzero(keep) == len(keep):
            return bands, slide.T
        # The groups of each line are made whole again.
        at, = keep.nonzero()
        if len(at):
            keep[at] = in_whole_parts(number.take(at), places.members)
        return bands[keep], slide[:, keep].T

    def _in_reach(self, origin: Complex, turn: complex) -> Array:
        """Coarse samples of each line (L, _COARSE), metres from its start, where it is in reach.

        All of a line much longer than the reach would have hardly any where it is seen.

        :param origin: where the lines start (L,), in base_link.
        :param turn: from directions of the map to those of base_link.
        """
        to_foot = (complex(*self._table.foot) - origin) * (self._direction * turn).conj()
        half_chord = np.sqrt(np.maximum(self._table.reach**2 - to_foot.imag**2, 0.0))
        first, last = (
            np.minimum(np.maximum(end, 0.0), self._length)
            for end in (to_foot.real - half_chord, to_foot.real + half_chord))
        return first[:, None] + _EVENLY * (last - first)[:, None]

    def _gaps(self, parts: NDArray[np.intp], whole: NDArray[np.intp]) -> Array:
        """Floor between a tape's edge and the next tape, metres, along one tape after the other.

        :param parts: of each tape (L,).
        :param whole: the line that each is a piece of (L,): its other pieces are no next tape.
        """
        tape = np.arange(len(parts)).repeat(parts)
        part = np.arange(len(tape)) - (parts.cumsum() - parts).repeat(parts)
        along = (part + 0.5) * (self._length / parts).take(tape)
        points = self._start.take(tape) + along * self._direction.take(tape)
        gaps = np.full(points.shape, np.inf)
        # One other tape at a time: all at once would fill the memory on a large map.
        for k, half_width in enumerate(self._half_width):
            seen = (points - self._start[k]) * self._direction[k].conj()
            beyond = seen.real - np.clip(seen.real, 0.0, self._length[k])
            gap = np.hypot(beyond, seen.imag) - half_width
            gap[whole.take(tape) == whole[k]] = np.inf
            np.minimum(gaps, gap, out=gaps)
        return gaps - self._half_width.take(tape)


def _slide(gain: Array, left: Array, middle: Complex, back: Complex, falls: Complex) -> Array:
    """d(place of stations across their curves)/d(x, y, yaw, z, roll, pitch), (6, N).

    A point of the map moves in base_link by -R^T dt, and by (y, -x) dyaw; what moves it along its
    line does not count.

    :param gain: px across the curve by metres across the line (N,).
    :param left: direction across the line in the map, to its left (2, N).
    :param middle: the stations in base_link, x + iy (N,), metres.
    :param back: the line's direction in base_link, conjugate (N,).
    :param falls: how far out floor is seen that has sunk, per metre of that (N,).
    """
    slide = np.empty((6, len(gain)))
    against = -gain
    np.multiply(against, left, out=slide[:2])
    np.multiply(against, (back * middle).real, out=slide[2])
    # Floor that sinks by dz is seen where the ray would have met it, further out.
    sinking = against * (back * falls).imag
    slide[3] = sinking
    np.multiply(sinking, middle.imag, out=slide[4])
    np.multiply(-sinking, middle.real, out=slide[5])
    return slide


def _turned_back(pose: Pose2) -> complex:
    """What turns directions of the map, as x + iy, into those of base_link."""
    return complex(math.cos(pose.yaw), -math.sin(pose.yaw))


def _leant(points: Array, attitude: Array) -> tuple[Array, Array]:
    """Where a base off its plane has points of the floor: (N, 2), and how far over z = 0 (N,).

    Roll and pitch as in roll, pitch, yaw: to first order they move points up and down only, but
    their product turns the floor, as a yaw would.

    :param points: of the floor as the base has them on its plane (N, 2), metres.
    :param attitude: its (z, roll, pitch) off it (3,), metres and rad.
    """
    z, roll, pitch = attitude.tolist()
    x, y = points[:, 0], points[:, 1]
    up = math.sin(pitch) * x - math.cos(pitch) * z
    leant = np.empty_like(points)
    leant[:, 0] = math.cos(pitch) * x + math.sin(pitch) * z
    leant[:, 1] = math.cos(roll) * y + math.sin(roll) * up
    return leant, math.cos(roll) * up - math.sin(roll) * y
