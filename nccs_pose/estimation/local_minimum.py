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


"""A minimum brought to its new place when the weights have changed: Newton's method.

The cost m^T G m is a square in the monomials m(x, y, yaw), whose second derivatives are as easy
to write down as the first, so the Hessian is exact and convergence quadratic. It is given up
where the Hessian is not positive definite, or the yaw strays; then all minima are found anew.
"""

from __future__ import annotations

import math

from nccs_pose.estimation.general_lines import all_minima
from nccs_pose.estimation.pose_monomials import Minimum, monomials_and_slopes
from nccs_pose.geometry.pose import Array, Pose2
from nccs_pose.geometry.small_matrices import solve_3x3

# Newton's method is given up further from its start than this (rad), or after so many steps.
_ASTRAY = 0.1
_STEPS = 8
# At a given yaw the cost is a square in x and y, which one step solves: what a step leaves to do
# is of the size of its turn times itself (rad^2, rad m).
_LEFT = 1e-10


def minimum_near(gram: Array, directions: Array, pose: Pose2) -> Minimum:
    """The local minimum that belongs to a pose from which it cannot be far.

    :param gram: Gram matrix of S (7, 7).
    :param directions: unit directions of the lines (L, 3).
    """
    found = _newton(gram, pose.x, pose.y, pose.yaw)
    if found is not None:
        return found
    return min(
        all_minima(gram, directions),
        key=lambda m: abs(math.remainder(m.pose.yaw - pose.yaw, 2.0 * math.pi)))


def _newton(gram: Array, x: float, y: float, yaw: float) -> Minimum | None:
    """Where Newton's method ends; None where it cannot be trusted."""
    start = yaw
    for _ in range(_STEPS):
        form = monomials_and_slopes(x, y, yaw)
        pulled = form @ gram
        # The cost, its gradient and the Hessian's part without second derivatives, all halved.
        (cost, *gradient), (_, xx, xy, xt), (_, _, yy, yt), (_, _, _, tt) = (
            pulled @ form.T).tolist()
        c, s, _, _, p, q, _ = form[0].tolist()
        on_c, on_s, _, _, on_p, on_q, _ = pulled[0].tolist()
        tt -= c * on_c + s * on_s + p * on_p + q * on_q
        xt -= s * on_p + c * on_q
        yt += c * on_p - s * on_q
        step = solve_3x3(xx, xy, yy, xt, yt, tt, *gradient)
        if step is None:
            return None
        dx, dy, turn = step
        x, y, yaw = x - dx, y - dy, yaw - turn
        if abs(yaw - start) > _ASTRAY:
            return None
        if abs(turn) * (abs(turn) + abs(dx) + abs(dy)) < _LEFT:
            drop = gradient[0] * dx + gradient[1] * dy + gradient[2] * turn
            return Minimum(Pose2(x, y, yaw), cost - drop)
    return None
