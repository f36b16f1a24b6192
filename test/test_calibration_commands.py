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

"""`nccs-pose calibrate` and `check`, from a bag to a rig, a report and an exit code."""

from __future__ import annotations

from dataclasses import replace
import json
from pathlib import Path
import re

import cv2
from nccs_pose.calibration.from_images import calibrate_images
from nccs_pose.cli import main
from nccs_pose.errors import CalibrationError
from nccs_pose.evaluation.calibration_study import disturbed
from nccs_pose.files.bags import BagReader
from nccs_pose.files.yaml_files import load_map, load_rig, save_map, save_rig
from nccs_pose.geometry.lines import LineMap
from nccs_pose.geometry.pose import RigidTransform
from nccs_pose.simulation.table_one import TABLE_ONE
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

REPOSITORY = Path(__file__).resolve().parents[1]


@pytest.fixture(scope='module')
def drive(tmp_path_factory):
    """A simulated figure of eight: a bag, with its rig and its map beside it."""
    bag = tmp_path_factory.mktemp('calibration') / 'eight'
    assert main([
        'render', str(bag), '--frames', '24', '--rate', '0.8', '--width', '640', '--scene',
        'ideal', '--compression', 'none']) == 0
    return bag


@pytest.fixture
def files(drive, tmp_path):
    """The bag's rig and map, and a function that writes others."""
    rig, line_map = load_rig(f'{drive}_rig.yaml'), load_map(f'{drive}_map.yaml')

    def written(name, value):
        path = tmp_path / name
        (save_map if isinstance(value, LineMap) else save_rig)(value, path)
        return str(path)

    return rig, line_map, written


def refusal(capsys, arguments):
    """The one sentence of a call that ends with exit code 2, without progress."""
    code = main(arguments)
    err = capsys.readouterr().err.strip().splitlines()
    assert code == 2
    assert err[-1].startswith(f'nccs-pose {arguments[0]}: ')
    assert not any(line.startswith('Traceback') for line in err)
    return err[-1]


def test_a_rough_rig_goes_in_and_a_good_one_comes_out(drive, files, tmp_path, capsys):
    true, _, written = files
    rough = disturbed(
        true, np.random.default_rng(1), cop=5e-4, tilt=np.deg2rad(0.5), height=0.01)
    line_map, output = f'{drive}_map.yaml', tmp_path / 'rig.yaml'
    code = main(['calibrate', str(drive), '--rig', written('rough.yaml', rough), '--map', line_map,
                 '--output', str(output)])
    assert code == 0
    said = capsys.readouterr()
    assert said.out.startswith('to be used: residuals went from')
    # Poses that are doubted are enough to begin with; nothing had to be asked of blobs.
    assert 'followed roughly under the rough rig' in said.err
    assert 'blobs' not in said.err
    found = load_rig(output)
    assert np.abs(found.cop - true.cop).max() < 2e-5
    assert found.camera == true.camera
    report = (tmp_path / 'rig.report.md').read_text()
    for word in ('**Verdict:** to be used', 'standard deviation', 'held out', 'Correlations',
                 "turn of the mirror frame about the sphere's centre", 'held by the rough rig',
                 '| south |'):
        assert word in report
    for name in ('residuals_image', 'residuals_mirror', 'histograms', 'correlations'):
        picture = f'rig.{name}.png'
        assert f'![{picture}]({picture})' in report
        assert cv2.imread(str(tmp_path / picture)) is not None
    # The bag knows where the robot was.
    poses = tmp_path / 'poses.tum'
    assert main(['replay', str(drive), '--rig', str(output), '--map', line_map,
                 '--output', str(poses)]) == 0
    judged = json.loads((tmp_path / 'poses.evaluation.json').read_text())
    assert judged['answered'] == 24
    assert judged['translation_m']['rmse'] < 2e-3


def test_a_rough_rig_in_a_room_is_found_from_the_one_image_that_it_shows_right():
    # Three of twenty images fit a wrong place, a quarter turn round, all under one wrong rig.
    true = load_rig(REPOSITORY / 'config/room_rig.yaml')
    line_map = load_map(REPOSITORY / 'config/room_map.yaml')
    turn = Rotation.from_rotvec([0.065, 0.429, 0.248], degrees=True).as_matrix()
    higher = RigidTransform.from_rpy((0.0, 0.0, 0.0), (0.0, 0.0, 0.01))
    rough = replace(
        true, cop=true.cop + np.array([0.0, -4.98e-4, 4.8e-5]),
        R_mirror_camera=turn @ true.R_mirror_camera, T_base_mirror=higher @ true.T_base_mirror)
    with BagReader(REPOSITORY / 'bags/room') as bag:
        images = [(event.stamp_ns, event.decode()) for event in bag.events(odometry=False)]
    found = calibrate_images(rough, line_map, lambda: images[::3])
    assert found.good
    # The sequence's own calibration is 0.08 px beside its images.
    assert np.abs(found.model.rig.cop - true.cop).max() < 2e-4


def test_without_an_image_that_is_what_is_said(files):
    rig, line_map, _ = files
    with pytest.raises(CalibrationError, match='there is no image to calibrate from'):
        calibrate_images(rig, line_map, list)


def test_check_tells_a_true_rig_from_one_a_tenth_of_a_millimetre_off(drive, files, capsys):
    true, _, written = files
    others = ['--map', f'{drive}_map.yaml']
    assert main(['check', str(drive), '--rig', f'{drive}_rig.yaml', *others]) == 0
    assert 'calibration good' in capsys.readouterr().out
    off = written('off.yaml', replace(true, cop=true.cop + np.array([0.0, 8e-5, -6e-5])))
    assert main(['check', str(drive), '--rig', off, *others]) == 1
    assert 'residuals suggest the mirror moved by about 0.1' in capsys.readouterr().out


def test_check_says_what_structure_is_worth_that_is_no_reason_to_calibrate(capsys):
    config = REPOSITORY / 'config'
    room = [str(REPOSITORY / 'bags/room'), '--rig', str(config / 'room_rig.yaml'),
            '--map', str(config / 'room_map.yaml')]
    assert main(['check', *room, '--pose-error', '6']) == 0
    said = capsys.readouterr().out
    structure = next(line for line in said.splitlines() if line.startswith('structure against'))
    # The sequence's own calibration is 0.08 px beside its images.
    assert re.search(
        r'\): worth \d\.\d mm in the poses, less than the 6 mm that matter', structure)
    assert main(['check', *room, '--pose-error', '1']) == 1
    assert 'worth' not in capsys.readouterr().out


def test_what_cannot_be_calibrated_is_refused_in_a_sentence(drive, files, tmp_path, capsys):
    rig, line_map, written = files
    red = LineMap(tuple(replace(line, colour='red') for line in line_map))
    longer = LineMap(tuple(
        replace(line, start=line.start * [1.3, 0.8, 1.0], end=line.end * [0.8, 1.3, 1.0])
        for line in line_map))
    mirror = replace(TABLE_ONE['parabolic'].mirror, rim_radius=None)
    here = f'{drive}_rig.yaml'
    for arguments, words in (
            (['--rig', here, '--map', written('red.yaml', red)], 'the colour of the lines'),
            (['--rig', here, '--map', written('longer.yaml', longer)], 'the map'),
            (['--rig', written('mirror.yaml', replace(rig, mirror=mirror)),
              '--map', f'{drive}_map.yaml'], 'the kind of mirror'),
            (['--rig', here, '--map', f'{drive}_map.yaml', '--images', '3'],
             'only 3 of 3 frames'),
            (['--rig', here, '--map', f'{drive}_map.yaml', '--images', '1'],
             'too few images to calibrate from: 1, of which 1 show'),
            (['--rig', here, '--map', f'{drive}_map.yaml', '--option', 'rough_cop=wide'],
             "'wide' is no float"),
            (['--rig', here, '--map', f'{drive}_map.yaml', '--option', 'tilt=1'],
             "there is no option 'tilt'; there are rough_cop, "),
            (['--rig', here, '--map', f'{drive}_map.yaml', '--option', 'rough_cop=0.2'],
             'rough_cop = 0.2 m: must lie in [1e-06, 0.1]'),
            (['--rig', here, '--map', f'{drive}_map.yaml', '--free-line', 'attic'],
             "'attic' cannot be freed"),
            (['--rig', here, '--map', f'{drive}_map.yaml', '--from-rim'],
             'outline was not found'),
            (['--rig', str(tmp_path / 'no.yaml'), '--map', f'{drive}_map.yaml'], 'no.yaml')):
        words_said = refusal(capsys, [
            'calibrate', str(drive), *arguments, '--output', str(tmp_path / 'out.yaml')])
        assert words in words_said
        assert not (tmp_path / 'out.yaml').exists()


def test_help_explains_every_option(capsys):
    assert main(['calibrate', '--help']) == 0
    text = capsys.readouterr().out
    assert '  rough_cop=0.003 m  (1e-06 to 0.1)\n      Of the centre of projection.\n' in text
    assert '  max_frames=40  (3 to 100000)\n      Most frames that enter the fit.\n' in text


def test_a_place_without_images_is_named(drive, tmp_path, capsys):
    others = ['--rig', f'{drive}_rig.yaml', '--map', f'{drive}_map.yaml']
    assert 'no such bag or folder' in refusal(
        capsys, ['check', str(tmp_path / 'nowhere'), *others])
    (tmp_path / 'empty').mkdir()
    assert 'is no bag' in refusal(capsys, ['check', str(tmp_path / 'empty'), *others])
    (tmp_path / 'small').mkdir()
    cv2.imwrite(str(tmp_path / 'small' / '1.png'), np.zeros((48, 64, 3), np.uint8))
    assert 'images have 64 x 48 pixels, the rig is for 640 x 480' in refusal(
        capsys, ['check', str(tmp_path / 'small'), *others])
    (tmp_path / 'dark').mkdir()
    for number in range(3):
        cv2.imwrite(str(tmp_path / 'dark' / f'{number}.png'),
                    np.zeros((480, 640, 3), np.uint8))
    assert 'in none of 3 images the lines could be followed' in refusal(
        capsys, ['check', str(tmp_path / 'dark'), *others])
