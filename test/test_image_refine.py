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

"""Refinement in the image, against distances to the traced curves and the Cramér-Rao bound."""

from __future__ import annotations

from nccs_pose.errors import EstimationError
from nccs_pose.estimation.bound import cramer_rao_bound
from nccs_pose.estimation.image_refine import refine_in_image
from nccs_pose.estimation.refine import refine
from nccs_pose.evaluation.experiment_options import ExperimentOptions
from nccs_pose.evaluation.trials import Cell, DataSet, make_data_set
from nccs_pose.geometry.line_trace import trace_line
from nccs_pose.geometry.lines import Line
from nccs_pose.geometry.pose import Pose2
from nccs_pose.geometry.rig import Rig
import numpy as np
import pytest

OPTIONS = ExperimentOptions()


def scene(mirror: str, trial: int, **noise) -> tuple[Rig, DataSet, np.ndarray, np.ndarray]:
    rig, cell = OPTIONS.rig(mirror), Cell(mirror, 0.0, 5, 20, **noise)
    data = make_data_set(rig, OPTIONS, cell, np.random.default_rng([61, trial]))
    return rig, data, data.directions[data.label], data.moments[data.label]


def distances(rig: Rig, data: DataSet, pose: Pose2) -> np.ndarray:
    """Distances (N,) in pixels from the pixels to the traced images of their lines."""
    found = np.zeros(len(data.pixels))
    for k, (d, mu) in enumerate(zip(data.directions, data.moments)):
        foot = np.cross(d, mu) + d * (d @ (pose.translation - np.cross(d, mu)))
        line = Line(foot - 20.0 * d, foot + 20.0 * d)
        curve = trace_line(rig, line.transformed(pose.inverse()), spacing=1.0)
        pixels = data.pixels[data.label == k]
        apart = np.linalg.norm(pixels[:, None] - curve[None], axis=2)
        found[data.label == k] = apart.min(axis=1)
    return found


def nees(data: DataSet, pose: Pose2, bound: np.ndarray) -> float:
    error = pose.minus(data.truth)
    return float(error @ np.linalg.solve(bound, error))


@pytest.mark.parametrize('mirror', ['parabolic', 'hyperbolic'])
def test_coarse_pixels_come_nearer_to_their_curves_and_the_pose_to_the_bound(mirror: str) -> None:
    better, sampson, image = 0, [], []
    for trial in range(30):
        rig, data, d, mu = scene(mirror, trial, sigma_px=10.0)
        rays = rig.back_project(data.pixels)
        one = refine(rays, d, mu, data.truth, sigma=10.0).pose
        two = refine_in_image(rig, data.pixels, d, mu, data.truth, sigma=10.0).pose
        bound = cramer_rao_bound(rig.back_project(data.clean), d, mu, data.truth, sigma=10.0)
        sampson.append(nees(data, one, bound))
        image.append(nees(data, two, bound))
        if trial < 5:  # the likelihood itself, up to a constant
            costs = [np.square(distances(rig, data, pose)).sum() for pose in (one, two)]
            better += costs[1] < costs[0]
    assert better >= 4
    assert np.mean(np.minimum(image, 25.0)) < 0.93 * np.mean(np.minimum(sampson, 25.0))


def test_fine_pixels_and_noise_in_the_world_leave_it_as_it_was() -> None:
    for noise in ({'sigma_px': 0.3}, {'sigma_px': 0.0, 'sigma_world': 0.05}):
        rig, data, d, mu = scene('spherical', 3, **noise)
        told = {'sigma': noise['sigma_px'] or 1e-3, 'sigma_world': noise.get('sigma_world', 0.0)}
        one = refine(rig.back_project(data.pixels), d, mu, data.truth, **told)
        two = refine_in_image(rig, data.pixels, d, mu, data.truth, **told)
        step = two.pose.as_array() - one.pose.as_array()
        assert step @ np.linalg.solve(one.covariance, step) < 0.05**2
        assert two.covariance == pytest.approx(one.covariance, rel=0.05)


def test_without_noise_it_ends_at_the_truth() -> None:
    rig, data, d, mu = scene('hyperbolic', 4)
    start = Pose2(data.truth.x + 0.02, data.truth.y - 0.01, data.truth.yaw + 0.02)
    found = refine_in_image(rig, data.pixels, d, mu, start).pose
    assert found.as_array() == pytest.approx(data.truth.as_array(), abs=1e-7)


def test_impossible_input_is_refused_by_name() -> None:
    rig, data, d, mu = scene('spherical', 5)
    with pytest.raises(EstimationError, match='2 pixels'):
        refine_in_image(rig, data.pixels[:2], d[:2], mu[:2], data.truth)
    with pytest.raises(EstimationError, match='miss the mirror'):
        refine_in_image(rig, data.pixels * [0.0, 1.0], d, mu, data.truth)
