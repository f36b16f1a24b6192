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

"""Errors that neighbours share, against errors drawn with a known share."""

from __future__ import annotations

from nccs_pose.estimation.common_errors import common_errors
import numpy as np
import pytest

LINES, PER_LINE = 4, 24
LABEL = np.repeat(np.arange(LINES), PER_LINE)
SIGMA = np.full(len(LABEL), 0.05)
# Two shifts and a turn of four lines round the robot, which a pose takes out of the residuals.
ALONG = np.tile(np.linspace(-1.0, 1.0, PER_LINE), LINES)
POSE = np.linalg.qr(np.stack([
    np.where(LABEL == 0, 1.0, 0.0) - np.where(LABEL == 2, 1.0, 0.0),
    np.where(LABEL == 1, 1.0, 0.0) - np.where(LABEL == 3, 1.0, 0.0), ALONG], axis=1))[0]


def _factors(blocks: float, size: float, trials: int = 300) -> tuple[float, float, float]:
    """Errors of a size, this share of whose variance a block shares.

    :returns: mean factor and misfit, and the variance of what a pose takes out over that which
        independent errors would give it.
    """
    rng, found = np.random.default_rng(3), []
    for _ in range(trials):
        common = np.repeat(rng.standard_normal(len(LABEL) // 4), 4)
        own = rng.standard_normal(len(LABEL))
        error = size * (np.sqrt(blocks) * common + np.sqrt(1.0 - blocks) * own)
        taken = POSE.T @ error
        residual = error - POSE @ taken
        degrees = len(error) - 3
        found.append((*common_errors(residual, SIGMA, LABEL),
                      np.mean(taken**2) * degrees / (residual @ residual)))
    factor, misfit, true = np.mean(found, axis=0)
    return float(factor), float(misfit), float(true)


def test_the_noise_of_pixels_is_left_as_it_is() -> None:
    factor, misfit, true = _factors(0.0, 1.0)
    # The largest of several estimates is taken: a little too careful.
    assert true < factor < 1.25 * true
    assert misfit < 0.5 * SIGMA[0]


@pytest.mark.parametrize('share', [0.2, 0.4, 0.7])
def test_what_a_block_shares_counts_once(share: float) -> None:
    factor, misfit, true = _factors(share, 2.0)
    assert true > 1.4
    assert factor == pytest.approx(true, rel=0.3)
    # Blocks' means scatter by what they share and a quarter of the rest; all errors being
    # independent, it would be a quarter of all.
    assert misfit == pytest.approx(2.0 * SIGMA[0] * np.sqrt(0.75 * share), rel=0.25)


def test_larger_errors_than_the_pixels_make_are_taken_for_patterns() -> None:
    one, two, four = (_factors(0.0, size)[0] for size in (1.0, 2.0, 4.0))
    assert one < two < four


def test_a_line_of_one_or_two_residuals_is_no_obstacle() -> None:
    label = np.array([0, 1, 1, 2, 2, 2])
    factor, misfit = common_errors(np.full(6, 0.5), np.full(6, 0.1), label)
    # By hand: the halves of the two longer lines give 5 over what independent errors would, in one
    # degree of freedom, beside five times the 1 that such small errors let expect.
    assert factor == pytest.approx((5.0 + 5.0) / (5.0 + 1.0))
    assert misfit == 0.0
