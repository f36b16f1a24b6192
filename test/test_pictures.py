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
"""Overlays and figures: what is drawn lies where it belongs."""

from __future__ import annotations

import csv
from pathlib import Path

from calibration_reader import read_calibration
import cv2
from nccs_pose.errors import FileError
from nccs_pose.estimation.estimate import Estimate, Quality, State
from nccs_pose.evaluation.metrics import compare
from nccs_pose.evaluation.overlay import draw_overlay, predicted_curves
from nccs_pose.evaluation.plots import error_figure, histogram_figure, trajectory_figure
from nccs_pose.evaluation.trajectory import Trajectory
from nccs_pose.files.image_folder import image_files, read_images
from nccs_pose.files.pictures import save_figure, save_image
from nccs_pose.files.trajectories import read_tum
from nccs_pose.geometry.pose import Pose2
from nccs_pose.simulation.scene import arena_map, arena_rig
from nccs_pose.vision.line_points import LinePoints
import numpy as np
import pytest


def test_a_folder_of_images_gives_pixels_as_they_lie_and_no_half_image(tmp_path: Path) -> None:
    image = np.random.default_rng(0).integers(0, 255, (24, 32, 3), np.uint8)
    jpeg = cv2.imencode('.jpg', image)[1].tobytes()
    # Exif: orientation (0x0112) 6, to be turned by a quarter.
    exif = (b'Exif\x00\x00MM\x00*\x00\x00\x00\x08\x00\x01\x01\x12\x00\x03\x00\x00\x00\x01'
            b'\x00\x06\x00\x00\x00\x00\x00\x00')
    turned = jpeg[:2] + b'\xff\xe1' + (len(exif) + 2).to_bytes(2, 'big') + exif + jpeg[2:]
    assert cv2.imdecode(np.frombuffer(turned, np.uint8), cv2.IMREAD_COLOR).shape == (32, 24, 3)
    (tmp_path / '0.jpg').write_bytes(turned)
    (tmp_path / '1.bmp').write_bytes(cv2.imencode('.bmp', image)[1].tobytes())
    read = dict(read_images(image_files(tmp_path)))
    assert [i.shape for i in read.values()] == 2 * [(24, 32, 3)]
    np.testing.assert_array_equal(read[100_000_000], image)
    # A bag stays one with pictures in it.
    (tmp_path / 'metadata.yaml').write_text('')
    assert image_files(tmp_path) == image_files(tmp_path / '0.jpg') == []
    with pytest.raises(FileError, match='File name too long'):
        image_files(tmp_path / ('x' * 300))
    bad = {'half.jpg': jpeg[:len(jpeg) // 2], 'none.png': b'', 'x.bmp': b'x'}
    for name, content in bad.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(FileError, match=f'{name}: is no readable image'):
            list(read_images([tmp_path / name]))


def test_predicted_curves_run_along_the_tapes_of_the_image(ray_traced: Path) -> None:
    folder = ray_traced / 'dev_clean'
    rig, line_map = read_calibration(folder)
    truth = read_tum(folder / 'groundtruth.tum')
    rows = list(csv.DictReader((folder / 'frames.csv').open()))
    compared = 0
    for frame in (0, 13, 27):
        image = cv2.imread(str(folder / 'frames' / rows[frame]['file'])).astype(int)
        for k, line in enumerate(line_map):
            if float(rows[frame][f'width_px_line{k}']) < 3.0:
                continue  # too thin to hit a pixel's middle with certainty
            share = np.linspace(0.02, 0.98, 200)[:, None]
            points = line.start + share * (line.end - line.start)
            pieces = predicted_curves(rig, points, Pose2.from_array(truth.poses[frame]))
            pixels = np.concatenate(pieces).round().astype(int)
            b, g, r = image[pixels[:, 1], pixels[:, 0]].T
            assert np.mean(g > 1.3 * np.maximum(b, r)) > 0.97
            compared += 1
    assert compared >= 4


def test_a_curve_is_cut_where_it_is_not_seen(ray_traced: Path) -> None:
    rig, _ = read_calibration(ray_traced / 'dev_clean')
    row = np.zeros((400, 3))
    row[:, 0] = np.linspace(-3.0, 3.0, 400)
    row[150:200, 2] = 5.0  # over the mirror
    pieces = predicted_curves(rig, row, Pose2())
    assert len(pieces) >= 2
    for piece in pieces:
        assert np.linalg.norm(np.diff(piece, axis=0), axis=1).max() < 40.0
    assert predicted_curves(rig, row[150:200], Pose2()) == []


@pytest.mark.parametrize('scale', [1, 2])
def test_an_overlay_draws_points_where_they_were_found(ray_traced: Path, scale: int) -> None:
    rig, line_map = read_calibration(ray_traced / 'dev_clean')
    image = np.full((960, 1280, 3), 90, np.uint8)
    before = image.copy()
    points = LinePoints(np.array([[700.0, 500.25], [900.0, 300.0], [640.0, 800.0]]),
                        np.ones(3), np.array([0, 2, -1]))
    estimate = Estimate(0, State.LOST, 'kidnapped – 3σ', points=points, quality=Quality(
        unobserved=('along x',)))
    overlay = draw_overlay(image, rig, line_map, estimate, scale=scale)
    assert overlay.shape[1:] == (1280 * scale, 3)
    np.testing.assert_array_equal(image, before)
    drawn = np.argwhere(np.any(overlay[:960 * scale] != 90, axis=2))[:, ::-1] / scale
    distance = np.linalg.norm(drawn[:, None] - points.pixels, axis=2)
    assert distance.min(axis=1).max() < 3.5  # nothing else is drawn without a pose
    assert (distance.min(axis=0) < 1.0).all()
    with_pose = Estimate(
        0, State.TRACKING, 'explained', Pose2(0.1, 0.2, 0.3), np.diag([1e-6, 1e-6, 1e-6]))
    drawn = draw_overlay(image, rig, line_map, with_pose, truth=Pose2(), scale=scale)
    assert np.count_nonzero(np.any(drawn[:960 * scale] != 90, axis=2)) > 1500
    assert drawn.shape == overlay.shape


@pytest.mark.parametrize('width', [320, 640, 1280])
def test_an_overlay_writes_below_the_image_and_within_its_width(
        width: int) -> None:
    image = np.full((96, width, 3), 90, np.uint8)
    shapes = set()
    for reason in ('lost', 'the second scores 0.93 of the first; ' * 9):
        for pose in (None, Pose2(0.1, 0.2, 0.3)):
            estimate = Estimate(0, State.SEARCHING, reason, pose, pose and 1e-4 * np.eye(3))
            overlay = draw_overlay(image, arena_rig(), arena_map(), estimate)
            shapes.add(overlay.shape)
            if pose is None:  # else the lines are drawn
                np.testing.assert_array_equal(overlay[:96], image)
            strip = overlay[96:].astype(int)
            assert np.ptp(strip) > 100  # it is written on
            assert np.ptp(strip[:, :3]) == np.ptp(strip[:, -3:]) == 0
    assert len(shapes) == 1


def test_an_overlay_leaves_out_what_was_not_measured(
        monkeypatch: pytest.MonkeyPatch) -> None:
    written: list[str] = []
    monkeypatch.setattr(cv2, 'putText', lambda canvas, text, *_: written.append(text))

    def words(quality: Quality) -> str:
        written.clear()
        draw_overlay(np.zeros((960, 1280, 3), np.uint8), arena_rig(), arena_map(), Estimate(
            0, State.COASTING, 'carried on', Pose2(), 1e-4 * np.eye(3), quality=quality))
        return '\n'.join(written)

    coasting = words(Quality())
    for word in ('points ', 'residual', 'explained', 'nan'):
        assert word not in coasting
    assert '3 lines   70 points   residual 0.31 px   explained 90 %' in words(
        Quality(3, 70, 0.31, 0.3, 0.9))
    assert '3 lines   70 points\n' in words(Quality(3, 70))


def test_the_error_figure_shows_the_errors_and_their_band() -> None:
    stamps = 10**18 + np.arange(30) * 10**8
    truth = Trajectory(stamps, np.zeros((30, 3)))
    error = np.random.default_rng(0).normal(size=(30, 3)) * [2e-3, 3e-3, 1e-3]
    errors = compare(Trajectory(stamps, error), truth)
    figure = error_figure(errors, np.tile(np.diag([4e-6, 9e-6, 1e-6]), (30, 1, 1)))
    for axes, factor, column, sigma in zip(
        figure.axes, (1e3, 1e3, np.degrees(1)), error.T, (2e-3, 3e-3, 1e-3),
    ):
        curve = axes.lines[-1]
        np.testing.assert_allclose(curve.get_ydata(), factor * column)
        np.testing.assert_allclose(curve.get_xdata(), np.arange(30) * 0.1)
        band = axes.collections[0].get_paths()[0].get_extents()
        assert (band.y0, band.y1) == pytest.approx((-2 * factor * sigma, 2 * factor * sigma))


def test_a_jump_of_the_true_path_is_not_joined() -> None:
    poses = np.zeros((40, 3))
    poses[:, 0] = np.r_[np.linspace(0, 1, 20), np.linspace(5, 6, 20)]
    truth = Trajectory(np.arange(40) * 10**8, poses)
    figure = trajectory_figure(Trajectory([], []), truth, [])
    drawn = [line.get_xdata() for line in figure.axes[0].lines if len(line.get_xdata()) > 1]
    assert [(x[0], x[-1]) for x in drawn] == [(0.0, 1.0), (5.0, 6.0)]


def test_the_same_figure_is_the_same_file(tmp_path: Path) -> None:
    truth = Trajectory(np.arange(9) * 10**8, np.zeros((9, 3)))
    errors = compare(Trajectory(truth.stamps_ns, np.full((9, 3), 0.01)), truth)
    for name in ('a.png', 'b.png'):
        save_figure(histogram_figure(errors, 'same'), tmp_path / name)
    assert (tmp_path / 'a.png').read_bytes() == (tmp_path / 'b.png').read_bytes()
    save_image(np.full((4, 5, 3), 7, np.uint8), tmp_path / 'new' / 'c.png')
    assert (cv2.imread(str(tmp_path / 'new' / 'c.png')) == 7).all()
