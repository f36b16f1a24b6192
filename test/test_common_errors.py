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

"""Errors that neighbours share, against errors drawn with known shares."""

from __future__ import annotations

import math

from nccs_pose.estimation.common_errors import (
    common_misfit,
    common_variance,
    sums_of_neighbours,
)
import numpy as np
import pytest
from scipy.signal import lfilter

LINES, PER_LINE = 4, 60
LABEL = np.repeat(np.arange(LINES), PER_LINE)
SIGMA = np.full(len(LABEL), 0.05)
# Two shifts and a turn of four lines round the robot, which a pose takes out of the residuals.
ALONG = np.tile(np.linspace(-1.0, 1.0, PER_LINE), LINES)
POSE = np.linalg.qr(np.stack([
    np.where(LABEL == 0, 1.0, 0.0) - np.where(LABEL == 2, 1.0, 0.0),
    np.where(LABEL == 1, 1.0, 0.0) - np.where(LABEL == 3, 1.0, 0.0), ALONG], axis=1))[0]
LEVERAGE = np.square(POSE).sum(axis=1)
FIRST = np.arange(0, len(LABEL), 6)


def _squared_errors(b: list[float], a: list[float], trials: int = 600) -> tuple[float, float]:
    """Errors that run through the filter b / a along each line, from white noise.

    :returns: variance claimed, in units of that of a single error (the harmonic mean: it is the
        inverse that a pose is weighed with), and the mean square of what a pose takes out, in
        units of the variance claimed for it; 1 where that is right.
    """
    rng, found = np.random.default_rng(3), []
    white = lfilter(b, a, np.eye(1, 200)[0])
    for _ in range(trials):
        error = lfilter(b, a, rng.standard_normal((LINES, 2 * PER_LINE)))[:, PER_LINE:].ravel()
        taken = POSE.T @ error
        claimed = common_variance(error - POSE @ taken, LEVERAGE, LABEL, FIRST)
        found.append(((white @ white) / claimed, np.mean(taken**2) / claimed))
    information, nees = np.mean(found, axis=0)
    return float(1.0 / information), float(nees)


def test_independent_errors_are_told_as_such() -> None:
    variance, nees = _squared_errors([1.0], [1.0])
    assert variance == pytest.approx(1.0, abs=0.06)
    # Of 1800 squares.
    assert nees == pytest.approx(1.0, abs=3.0 * math.sqrt(2.0 / 1800.0))


@pytest.mark.parametrize(('b', 'a'), [
    ([1.0, 0.2], [1.0]),
    ([1.0, -0.2], [1.0]),
    ([1.0], [1.0, -0.2]),
    ([1.0], [1.0, 0.2]),
])
def test_what_neighbours_share_or_take_from_each_other_is_counted(
        b: list[float], a: list[float]) -> None:
    # Long sums of filtered noise have the variance of the filter's gain at rest.
    white = lfilter(b, a, np.eye(1, 200)[0])
    true = float(white.sum() ** 2 / (white @ white))
    variance, nees = _squared_errors(b, a)
    assert abs(true - 1.0) > 0.3
    assert variance == pytest.approx(true, rel=0.25)
    assert nees == pytest.approx(1.0, abs=0.25)


@pytest.mark.parametrize(('b', 'a'), [
    # Tiles under several stations, and what alternates: farther than what is looked at.
    ([1.0] * 2, [1.0]), ([1.0] * 3, [1.0]), ([1.0] * 5, [1.0]), ([1.0], [1.0, 0.4]),
])
def test_what_many_neighbours_share_is_rather_overrated(b: list[float], a: list[float]) -> None:
    white = lfilter(b, a, np.eye(1, 200)[0])
    variance, nees = _squared_errors(b, a)
    assert variance > float(white.sum() ** 2 / (white @ white))
    assert nees < 1.0


@pytest.mark.parametrize('share', [0.0, 0.1, 0.2])
def test_what_a_tile_shares_counts_in_a_fine_image_too(share: float) -> None:
    # More than twice the stations: a tile spans twelve, a group six of them.
    per_line, tile = 138, 12
    label = np.repeat(np.arange(LINES), per_line)
    along = np.tile(np.linspace(-1.0, 1.0, per_line), LINES)
    pose = np.linalg.qr(np.stack([
        1.0 * (label == 0) - (label == 2), 1.0 * (label == 1) - (label == 3), along], axis=1))[0]
    leverage = np.square(pose).sum(axis=1)
    first = sums_of_neighbours(np.arange(0, len(label), 6), label)
    rng, squares = np.random.default_rng(3), []
    for _ in range(600):
        own = rng.standard_normal((LINES, per_line))
        tiles = lfilter(
            np.ones(tile), [1.0], rng.standard_normal((LINES, per_line + tile)))[:, tile:]
        error = np.sqrt(1.0 - share) * own.ravel() + np.sqrt(share / tile) * tiles.ravel()
        taken = pose.T @ error
        squares.append(np.mean(taken**2) / common_variance(
            error - pose @ taken, leverage, label, first))
    assert np.mean(squares) == pytest.approx(1.0, abs=0.25)


@pytest.mark.parametrize(('near', 'far'), [(1.5, 0.5), (0.5, 1.5)])
def test_errors_count_by_what_they_do_to_the_pose(near: float, far: float) -> None:
    # Two lines tell of the pose; the others are as many stations, but far away.
    tells = LABEL < 2
    pose = np.linalg.qr(POSE * np.where(tells, 1.0, 0.1)[:, None])[0]
    leverage = np.square(pose).sum(axis=1)
    rng, squares = np.random.default_rng(6), []
    for _ in range(600):
        error = np.where(tells, near, far) * rng.standard_normal(len(LABEL))
        taken = pose.T @ error
        squares.append(np.mean(taken**2) / common_variance(
            error - pose @ taken, leverage, LABEL, FIRST))
    assert np.mean(squares) == pytest.approx(1.0, abs=3.0 * math.sqrt(2.0 / 1800.0))


def test_correlations_that_few_stations_show_widen_the_claim_by_their_scatter() -> None:
    per_line, group, share = 24, 6, 0.6
    label = np.repeat(np.arange(LINES), per_line)
    along = np.tile(np.linspace(-1.0, 1.0, per_line), LINES)
    pose = np.linalg.qr(np.stack([
        1.0 * (label == 0) - (label == 2), 1.0 * (label == 1) - (label == 3), along], axis=1))[0]
    leverage, first = np.square(pose).sum(axis=1), np.arange(0, len(label), group)
    # Errors with a share of their neighbour's: the variance, the one correlation, that of a sum.
    own, correlation = 1.0 + share**2, share / (1.0 + share**2)
    together = own * (1.0 + 2.0 * (1.0 - 1.0 / group) * correlation)
    rng, inverses = np.random.default_rng(3), []
    for _ in range(3000):
        error = lfilter(
            [1.0, share], [1.0], rng.standard_normal((LINES, per_line + 1)))[:, 1:].ravel()
        inverses.append(1.0 / common_variance(
            error - pose @ (pose.T @ error), leverage, label, first))
    # Too large by 15 % still, as sums and correlations scatter together; by 20 % without.
    told = float(np.mean(inverses)) * together * math.exp(2.5 * correlation**2)
    assert 1.0 < told < 1.17


def test_ends_of_two_lines_are_no_neighbours() -> None:
    label, leverage = np.repeat([0, 1], 30), np.full(60, 0.05)
    residual = np.random.default_rng(5).standard_normal(60)
    turned = residual.copy()
    turned[:30] *= -1.0
    # Only products of one line with the other change their sign.
    first = np.arange(0, 60, 6)
    assert common_variance(turned, leverage, label, first) == pytest.approx(
        common_variance(residual, leverage, label, first), rel=1e-12)


def test_few_residuals_are_no_obstacle() -> None:
    label = np.array([0, 1, 1, 2, 2, 2])
    claimed = common_variance(np.full(6, 0.5), np.full(6, 0.5), label, np.array([0, 1, 3]))
    assert 0.5 < claimed < 6.0
    assert common_misfit(np.full(6, 0.05), label) == 0.0


def _misfit(share: float, size: float) -> float:
    """Mean misfit of errors of a size, this share of whose variance blocks share."""
    rng, found = np.random.default_rng(3), []
    for _ in range(300):
        common = np.repeat(rng.standard_normal(len(LABEL) // 4), 4)
        own = rng.standard_normal(len(LABEL))
        error = size * (np.sqrt(share) * common + np.sqrt(1.0 - share) * own)
        found.append(common_misfit(SIGMA * (error - POSE @ (POSE.T @ error)), LABEL))
    return float(np.mean(found))


def test_noise_alone_is_hardly_a_misfit() -> None:
    assert _misfit(0.0, 1.0) < 0.5 * SIGMA[0]


@pytest.mark.parametrize('share', [0.2, 0.4, 0.7])
def test_misfit_is_what_blocks_share_beyond_noise(share: float) -> None:
    # Blocks' means scatter by what they share and a quarter of the rest; all errors being
    # independent, it would be a quarter of all.
    assert _misfit(share, 2.0) == pytest.approx(2.0 * SIGMA[0] * np.sqrt(0.75 * share), rel=0.25)
