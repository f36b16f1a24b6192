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

"""The closed form for floor lines, and for vertical ones: no initial guess, global minimum.

Horizontal lines, at any height, make S linear in (c, s, x, y); vertical lines in (c, s, p, q)
(see pose_monomials). The translation is eliminated by Schur's complement, and what is left is

    min  a^T H a + 2 g^T a + k   on the circle |a| = 1,   a = (c, s)

whose Lagrange condition a = -(H + lambda)^-1 g gives the secular equation
sum g_i^2 / (h_i + lambda)^2 = 1. Its largest root is the global minimum. The circle can hold
one more local minimum, just when g lies inside the astroid
|g_1|^(2/3) + |g_2|^(2/3) < (h_max - h_min)^(2/3); it is returned too, for it is the twin pose
wherever the lines cannot tell the two apart.
"""

from __future__ import annotations

import math

from nccs_pose.estimation.pose_monomials import Minimum
from nccs_pose.geometry.pose import Array, Pose2
from nccs_pose.geometry.small_matrices import inverse_2x2, ROUNDING


def horizontal_minima(gram: Array) -> tuple[Minimum, ...]:
    """All local minima, the global one first, for lines with d_z = 0.

    Along a direction in which the lines say nothing, as for parallel lines, the position is the
    one nearest to the map's origin.

    :param gram: Gram matrix of S (7, 7).
    """
    return tuple(
        Minimum(Pose2(x, y, math.atan2(s, c)), cost)
        for c, s, x, y, cost in _eliminate(gram, 2))


def vertical_minima(gram: Array) -> tuple[Minimum, ...]:
    """All local minima, the global one first, for lines with d_x = d_y = 0.

    A single vertical line lets the robot turn about it: then the yaw is 0.

    :param gram: Gram matrix of S (7, 7).
    """
    return tuple(
        Minimum(Pose2(c * p - s * q, s * p + c * q, math.atan2(s, c)), cost)
        for c, s, p, q, cost in _eliminate(gram, 4))


def _eliminate(gram: Array, first: int) -> list[tuple[float, float, float, float, float]]:
    """Minima (c, s, two translations, cost) of the form in (c, s, t_1, t_2, 1).

    :param first: index of t_1 among the monomials.
    """
    (c0, s0, _, _, _, _, k0), (_, s1, _, _, _, _, k1) = gram[0].tolist(), gram[1].tolist()
    k6 = float(gram[6, 6])
    upper, lower = gram[first].tolist(), gram[first + 1].tolist()
    a, b, d = inverse_2x2(upper[first], upper[first + 1], lower[first + 1])
    # Translation that goes with each of c, s, 1.
    u, v = (upper[0], upper[1], upper[6]), (lower[0], lower[1], lower[6])
    t1 = [-a * p - b * q for p, q in zip(u, v)]
    t2 = [-b * p - d * q for p, q in zip(u, v)]
    h00 = c0 + u[0] * t1[0] + v[0] * t2[0]
    h01 = s0 + u[0] * t1[1] + v[0] * t2[1]
    h11 = s1 + u[1] * t1[1] + v[1] * t2[1]
    g0 = k0 + u[0] * t1[2] + v[0] * t2[2]
    g1 = k1 + u[1] * t1[2] + v[1] * t2[2]
    k = k6 + u[2] * t1[2] + v[2] * t2[2]
    found = []
    for c, s in circle_minima(h00, h01, h11, g0, g1, ROUNDING * max(c0, s1, k6)):
        cost = h00 * c * c + 2.0 * h01 * c * s + h11 * s * s + 2.0 * (g0 * c + g1 * s) + k
        found.append((
            c, s, t1[0] * c + t1[1] * s + t1[2], t2[0] * c + t2[1] * s + t2[2], cost))
    return found


def circle_minima(
    h00: float, h01: float, h11: float, g0: float, g1: float, nothing: float = 0.0,
) -> list[tuple[float, float]]:
    """Local minima (c, s) of a^T H a + 2 g^T a on the unit circle, the global one first.

    :param nothing: if H is a multiple of 1 and g zero up to this, the circle is flat and its
        one answer is (1, 0).
    """
    radius = math.hypot(0.5 * (h00 - h11), h01)
    if max(radius, abs(g0), abs(g1)) <= nothing:
        return [(1.0, 0.0)]
    # Axes of H: e is that of the larger eigenvalue, f of the smaller.
    angle = 0.5 * math.atan2(2.0 * h01, h00 - h11)
    e0, e1 = math.cos(angle), math.sin(angle)
    ge, gf = g0 * e0 + g1 * e1, g1 * e0 - g0 * e1
    gap = 2.0 * radius
    points = [_largest_root(ge, gf, gap)]
    if abs(ge) ** (2 / 3) + abs(gf) ** (2 / 3) < gap ** (2 / 3):
        points.append(_other_root(ge, gf, gap))
    return [(e0 * ae - e1 * af, e1 * ae + e0 * af) for ae, af in points]


def _largest_root(ge: float, gf: float, gap: float) -> tuple[float, float]:
    """The global minimum (along e, along f); lambda is counted from -h_min upwards."""
    if gf == 0.0 and abs(ge) <= gap:
        # The hard case: two equal minima, mirrored in e.
        along = -ge / gap
        return along, math.sqrt(max(0.0, 1.0 - along * along))
    root = max(abs(gf), abs(ge) - gap)
    for _ in range(50):
        ae, af = -ge / (gap + root), -gf / root if gf else 0.0
        norm = math.hypot(ae, af)
        # Newton on 1/|a| - 1, which is convex: from below it cannot overshoot.
        slope = ae * ae / (gap + root) + (af * af / root if gf else 0.0)
        step = (norm - 1.0) * norm * norm / slope
        root += step
        if abs(step) <= 1e-15 * root:
            break
    return _unit(-ge / (gap + root), -gf / root if gf else 0.0)


def _other_root(ge: float, gf: float, gap: float) -> tuple[float, float]:
    """The other local minimum (along e, along f), for -gap < lambda < 0."""
    if gf == 0.0:
        along = -ge / gap
        return along, -math.sqrt(max(0.0, 1.0 - along * along))
    root = -abs(gf)
    for _ in range(100):
        ae, af = -ge / (gap + root), -gf / root
        # Newton on the convex |a|^2 - 1, coming down from the pole at lambda = 0.
        slope = -2.0 * (ae * ae / (gap + root) + af * af / root)
        step = -(ae * ae + af * af - 1.0) / slope
        root += step
        if abs(step) <= 1e-15 * abs(root):
            break
    return _unit(-ge / (gap + root), -gf / root)


def _unit(a: float, b: float) -> tuple[float, float]:
    norm = math.hypot(a, b)
    return a / norm, b / norm
