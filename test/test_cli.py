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
"""The command line: what it writes, what it says, and the exit codes."""

from __future__ import annotations

from collections.abc import Callable
import dataclasses
import io
import json
import os
from pathlib import Path
import shutil
import subprocess
import sys

import cv2
from nccs_pose.cli import main
from nccs_pose.cli.localiser_options import make_options
from nccs_pose.cli.offline_run import repeatable_json
from nccs_pose.cli.paper_localiser import PaperLocaliser
from nccs_pose.cli.parser import COMMANDS, parse
from nccs_pose.cli.progress import Progress
from nccs_pose.errors import FileError, FrameRefusedError, OptionError
from nccs_pose.estimation.localiser import Localiser
from nccs_pose.estimation.options import LocaliserOptions
from nccs_pose.evaluation.trajectory import Trajectory
from nccs_pose.files.bags import BagReader, BagWriter
from nccs_pose.files.trajectories import read_tum, write_tum
from nccs_pose.files.yaml_files import load_map, load_rig, save_rig
from nccs_pose.geometry.pose import Pose2
import numpy as np
import pytest

REPO = Path(__file__).resolve().parents[1]
ROOM = ['--rig', str(REPO / 'config/room_rig.yaml'), '--map', str(REPO / 'config/room_map.yaml')]
Capture = pytest.CaptureFixture[str]


@pytest.fixture(scope='module')
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small simulated drive: a bag, its rig and its map."""
    bag = tmp_path_factory.mktemp('drive') / 'eight'
    assert main(['render', str(bag), '--frames', '5', '--width', '640', '--scene', 'ideal']) == 0
    return bag


def calibrated(bag: Path) -> list[str]:
    return ['--rig', f'{bag}_rig.yaml', '--map', f'{bag}_map.yaml']


@pytest.fixture(scope='module')
def room_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The shipped bag replayed once, with pictures."""
    folder = tmp_path_factory.mktemp('room')
    code = main(['replay', str(REPO / 'bags/room'), *ROOM, '--output', str(folder / 'poses.tum'),
                 '--plots', str(folder), '--overlays', '3'])
    assert code == 0
    return folder


def said(capsys: Capture, arguments: list[str]) -> tuple[int, str, str]:
    code = main(arguments)
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def refusal(capsys: Capture, arguments: list[str]) -> str:
    """The one sentence on stderr of a call that must end with exit code 2."""
    code, _, err = said(capsys, arguments)
    assert code == 2
    assert len(err.strip().splitlines()) == 1
    assert err.startswith(f'nccs-pose {arguments[0]}: ')
    return err


def test_the_shipped_bag_is_answered_and_right(room_run: Path, ray_traced: Path) -> None:
    """Judged by the sequence's own ground-truth file, not by the bag or the tool."""
    poses, truth = read_tum(room_run / 'poses.tum'), read_tum(
        ray_traced / 'dev_room' / 'groundtruth.tum')
    true = {int(s): p for s, p in zip(truth.stamps_ns, truth.poses)}
    errors = np.array([p - true[int(s)] for s, p in zip(poses.stamps_ns, poses.poses)])
    translation = np.hypot(errors[:, 0], errors[:, 1])
    yaw = np.degrees(np.abs(np.angle(np.exp(1j * errors[:, 2]))))
    assert np.count_nonzero((translation < 0.05) & (yaw < 1.0)) >= 0.9 * len(truth)
    numbers = json.loads((room_run / 'poses.evaluation.json').read_text())
    assert numbers['frames'] == 60
    assert numbers['answered'] == len(poses)
    assert numbers['translation_m']['rmse'] == pytest.approx(
        np.sqrt(np.mean(translation**2)), rel=1e-4)
    assert numbers['yaw_rad']['max'] == pytest.approx(np.radians(yaw.max()), rel=1e-4)


def test_replay_leaves_records_configuration_and_pictures(room_run: Path) -> None:
    rows = [json.loads(line) for line in (room_run / 'poses.frames.jsonl').open()]
    assert [row['index'] for row in rows] == list(range(60))
    poses = read_tum(room_run / 'poses.tum')
    answered = [row for row in rows if 'pose_x_y_yaw' in row]
    assert [row['stamp_ns'] for row in answered] == poses.stamps_ns.tolist()
    for row in answered:
        assert row['state'] and row['reason']
        assert np.linalg.eigvalsh(np.array(row['covariance'])).min() > 0.0
    used = json.loads((room_run / 'poses.run.json').read_text())
    assert used['rig']['text'] == (REPO / 'config/room_rig.yaml').read_text()
    assert used['topics']['image'] == '/camera/image_raw/compressed'
    assert used['options']
    pictures = sorted(path.name for path in room_run.glob('*.*g'))
    assert pictures == ['errors.png', 'histogram.png', 'overlay_0000.jpg', 'overlay_0030.jpg',
                        'overlay_0059.jpg', 'trajectory.png']
    for name in pictures:
        assert min(cv2.imread(str(room_run / name)).shape[:2]) > 300


def test_replaying_twice_gives_the_same_bytes(drive: Path, tmp_path: Path) -> None:
    contents = []
    for run in ('first', 'second'):
        folder = tmp_path / run
        assert main(['replay', str(drive), *calibrated(drive), '--plots', str(folder),
                     '--output', str(folder / 'poses.tum')]) == 0
        contents.append({path.name: path.read_bytes() for path in folder.iterdir()})
    assert len(contents[0]) >= 8
    assert contents[0] == contents[1]


def test_what_is_written_is_the_same_where_only_the_last_bits_differ() -> None:
    value = np.float64(2.3456789e-7)
    text = repeatable_json({'covariance': [[value, 0.0]], 'index': 123456789012})
    assert text == repeatable_json(
        {'covariance': [[value * (1.0 + 8e-16), 0.0]], 'index': 123456789012})
    assert json.loads(text) == {
        'covariance': [[pytest.approx(value, rel=1e-9), 0.0]], 'index': 123456789012}


def test_the_paper_s_chain_runs_over_the_same_bag_and_is_worse(
    drive: Path, tmp_path: Path,
) -> None:
    rmse = {}
    for method in ('nccs', 'paper'):
        output = tmp_path / f'{method}.tum'
        assert main(['replay', str(drive), *calibrated(drive), '--output', str(output),
                     '--method', method]) == 0
        assert json.loads((tmp_path / f'{method}.run.json').read_text())['method'] == method
        numbers = json.loads((tmp_path / f'{method}.evaluation.json').read_text())
        assert numbers['answered'] == 5
        assert ('nees' in numbers) == (method == 'nccs')  # the paper gives no covariance
        rmse[method] = numbers['translation_m']['rmse']
    assert 3.0 * rmse['nccs'] < rmse['paper'] < 0.3


def test_the_paper_s_chain_refuses_the_images_that_the_localiser_refuses(drive: Path) -> None:
    rig, line_map = load_rig(f'{drive}_rig.yaml'), load_map(f'{drive}_map.yaml')
    with BagReader(drive) as bag:
        images = [(event.stamp_ns, event.decode()) for event in bag.events(odometry=False)]
    for localiser in (kind(rig, line_map, LocaliserOptions()) for kind in (
            Localiser, PaperLocaliser)):
        for stamp, image in images:
            assert localiser.process(stamp, image).pose is not None
        last, image = images[-1]
        for wrong, cause in (
                ((last, image), 'duplicate_stamp'), ((last - 10**8, image), 'out_of_order'),
                ((last + 10**8, image[:-1]), 'image_size')):
            with pytest.raises(FrameRefusedError) as refused:
                localiser.process(*wrong)
            assert refused.value.cause == cause
        # A bag that is played again begins anew.
        assert localiser.process(images[0][0] - 10**10, images[0][1]).pose is not None


def test_rendering_twice_gives_the_same_bag(drive: Path, tmp_path: Path) -> None:
    again = tmp_path / 'eight'
    main(['render', str(again), '--frames', '5', '--width', '640', '--scene', 'ideal'])
    for name in ('eight.mcap', 'metadata.yaml'):
        assert (again / name).read_bytes() == (drive / name).read_bytes()
    with BagReader(drive) as bag:
        assert bag.image_count() == 5
        assert len(bag.ground_truth()) == 5
        assert len(bag.odometry()) >= 9
        assert bag.camera().width == 640


def test_render_takes_another_rig_and_map(tmp_path: Path) -> None:
    bag, rig = tmp_path / 'bag', tmp_path / 'small.yaml'
    save_rig(load_rig(ROOM[1]).scaled(1 / 3), rig)
    assert main(['render', str(bag), '--frames', '1', '--compression', 'none',
                 '--rig', str(rig), '--map', ROOM[3]]) == 0
    with BagReader(bag) as reader:
        assert reader.topics.image == '/camera/image_raw'
        assert reader.camera().width == 320
        assert next(reader.events(odometry=False)).decode().shape == (240, 320, 3)
    written = load_map(tmp_path / 'bag_map.yaml')
    np.testing.assert_array_equal(written.starts, load_map(ROOM[3]).starts)
    assert load_rig(tmp_path / 'bag_rig.yaml').camera == load_rig(rig).camera


def black_bag(path: Path, size: tuple[int, int] = (720, 960)) -> Path:
    with BagWriter(path) as writer:
        for i in range(3):
            writer.write_image(10**9 * (1 + i), np.zeros((*size, 3), np.uint8), compression='png')
            writer.write_odometry(10**9 * (1 + i), Pose2(0.1 * i, 0.0, 0.0))
            writer.write_truth(10**9 * (1 + i), Pose2(0.1 * i, 0.0, 0.0))
    return path


def test_a_bag_in_which_no_frame_is_answered_ends_with_1(tmp_path: Path, capsys: Capture) -> None:
    bag = black_bag(tmp_path / 'bag')
    code, out, _ = said(capsys, [
        'replay', str(bag), *ROOM, '--output', str(tmp_path / 'poses.tum'),
        '--plots', str(tmp_path / 'plots')])
    assert code == 1
    assert '0 of 3 frames answered' in out
    assert len(list((tmp_path / 'plots').iterdir())) == 6
    assert len(read_tum(tmp_path / 'poses.tum')) == 0
    rows = [json.loads(line) for line in (tmp_path / 'poses.frames.jsonl').open()]
    assert len(rows) == 3
    assert all(row['reason'] for row in rows)
    assert 'tracking' not in out


def test_odometry_that_the_node_would_refuse_is_used_and_said(
    tmp_path: Path, capsys: Capture,
) -> None:
    with BagWriter(tmp_path / 'bag') as writer:
        for stamp in (10**9, 2 * 10**9):
            writer.write_image(stamp, np.zeros((720, 960, 3), np.uint8), compression='png')
            writer.write_odometry(stamp, Pose2(), frame_id='r1/odom', child_frame_id='r1/base')
    call = ['replay', str(tmp_path / 'bag'), *ROOM, '--output', str(tmp_path / 'poses.tum')]
    warning = said(capsys, call)[2]
    assert warning.count('warning') == 1
    assert "odometry of 'r1/base' in 'r1/odom' is used; the node takes that of 'base_link' in" in (
        warning)
    parameters = tmp_path / 'robot.yaml'
    parameters.write_text(
        'localiser: {ros__parameters: {frame_prefix: r1/, base_frame: base}}')
    assert 'warning' not in said(capsys, [*call, '--params', str(parameters)])[2]
    parameters.write_text('localiser: {ros__parameters: {odom_frame: 3}}')
    assert 'robot.yaml: odom_frame = 3' in refusal(capsys, [*call, '--params', str(parameters)])


def test_images_of_another_size_are_refused_one_by_one(tmp_path: Path, capsys: Capture) -> None:
    bag = black_bag(tmp_path / 'bag', (48, 64))
    code, out, _ = said(
        capsys, ['replay', str(bag), *ROOM, '--output', str(tmp_path / 'poses.tum')])
    assert code == 1
    assert '3 refused' in out
    assert 'image_size' in out and '64' in out and '960' in out


def test_a_bag_of_another_camera_is_refused(drive: Path, tmp_path: Path, capsys: Capture) -> None:
    message = refusal(
        capsys, ['replay', str(drive), *ROOM, '--output', str(tmp_path / 'poses.tum')])
    assert '640 x 480' in message and '960 x 720' in message
    assert not (tmp_path / 'poses.tum').exists()


@pytest.mark.parametrize(('change', 'words'), [
    (lambda a: [*a, '--option', 'nonsense=1'], ['nonsense', 'there are']),
    (lambda a: [*a, '--option', 'reach'], ['--option reach', 'NAME=VALUE']),
    (lambda a: [*a, '--option', 'threshold=guess'], ['threshold', 'guess', 'hsv']),
    (lambda a: [*a, '--option', 'stations=many'], ['stations=many', 'int']),
    (lambda a: [*a, '--output', str(REPO)], [str(REPO), 'folder']),
    (lambda a: [*a, '--image-topic', '/odom'], ['/odom', 'nav_msgs/msg/Odometry']),
    (lambda a: [*a, '--map', 'absent.yaml'], ['absent.yaml']),
    (lambda a: [*a, '--map', f'{a[1]}_rig.yaml'], ['_rig.yaml', 'lines', 'missing']),
    (lambda a: ['replay', 'absent', *a[2:]], ['absent', 'no such bag']),
])
def test_wrong_input_ends_in_one_sentence(
    drive: Path, tmp_path: Path, capsys: Capture,
    change: Callable[[list[str]], list[str]], words: list[str],
) -> None:
    arguments = ['replay', str(drive), *calibrated(drive), '--output', str(tmp_path / 'p.tum')]
    message = refusal(capsys, change(arguments))
    for word in words:
        assert word in message


def test_the_package_s_own_files_are_found_from_any_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    words = ['replay', 'bags/room', '--rig', 'config/room_rig.yaml', '--map',
             'config/room_map.yaml', '--params', 'config/room.yaml', '--output', 'config/p.tum']
    given = parse(words).arguments
    assert (given.bag / 'metadata.yaml').exists()
    assert load_rig(given.rig) and load_map(given.map) and make_options(given.params, [])
    assert given.output == Path('config/p.tum')
    # One's own of that name comes first.
    Path('config').mkdir()
    Path('config/room_map.yaml').touch()
    assert parse(words).arguments.map == Path('config/room_map.yaml')


@pytest.mark.parametrize(('name', 'calibration_sigma'), [
    ('arena.yaml', 0.0),  # a simulation knows its camera exactly
    ('robot.yaml', 0.1), ('room.yaml', 0.1)])
def test_the_node_s_parameter_files_configure_a_replay(
    name: str, calibration_sigma: float,
) -> None:
    assert make_options(REPO / 'config' / name, []) == LocaliserOptions(
        calibration_sigma=calibration_sigma)


def test_options_come_from_the_file_and_then_from_settings(tmp_path: Path) -> None:
    number = next(f for f in dataclasses.fields(LocaliserOptions)
                  if isinstance(f.default, float) and f.metadata['low'] is not None)
    low = number.metadata['low']
    path = tmp_path / 'params.yaml'
    path.write_text(f"""
/**:
  ros__parameters: {{threshold: hsv}}
/robot/localiser:
  ros__parameters: {{{number.name}: {low}, rig_file: x.yaml, use_sim_time: true}}
talker:
  ros__parameters: {{nonsense: 1}}
""")
    options = make_options(path, [])
    assert (options.threshold, getattr(options, number.name)) == ('hsv', low)
    given = make_options(
        path, [f'{number.name}={number.default}', 'threshold=chromaticity'])
    assert given == LocaliserOptions()
    path.write_text(path.read_text().replace('rig_file', 'rig_fil'))
    with pytest.raises(FileError, match=r'params\.yaml: rig_fil '):
        make_options(path, [])
    path.write_text(f'localiser: {{ros__parameters: {{{number.name}: {low - 1}}}}}')
    with pytest.raises(FileError, match=rf'params\.yaml: {number.name} = '):
        make_options(path, [])
    for name in (number.name, 'window'):  # whole numbers that no float holds
        path.write_text(f'localiser: {{ros__parameters: {{{name}: 1{"0" * 400}}}}}')
        with pytest.raises(FileError, match=rf'params\.yaml: {name} = 10+.*: must lie in'):
            make_options(path, [])
    with pytest.raises(OptionError, match=r'--option window=10+: window = '):
        make_options(None, [f'window=1{"0" * 400}'])
    path.write_text('talker: {ros__parameters: {}}')
    with pytest.raises(FileError, match=r'params\.yaml: localiser is missing'):
        make_options(path, [])


@pytest.mark.parametrize(('text', 'window'), [
    ('hall: {robot: {localiser: {ros__parameters: {window: 21}}}}', 21),
    ('/**: {localiser: {ros__parameters: {window: 21}}, talker: {ros__parameters: {a: 1}}}', 21),
    ('{hall: {localiser: {ros__parameters: {window: 21}}}, /**: {ros__parameters: {window: 9}}}',
     9),
    ('{hall: &hall {door: *hall}, localiser: {ros__parameters: {window: 9}}}', 9),
    ('hall: &hall {door: *hall, localiser: {ros__parameters: {window: 9}}}', 9)])
def test_namespaces_may_be_mappings_as_ros_reads_them(
    tmp_path: Path, text: str, window: int,
) -> None:
    path = tmp_path / 'params.yaml'
    path.write_text(text)
    assert make_options(path, []).window == window


def test_a_parameter_file_of_other_nodes_names_them(tmp_path: Path) -> None:
    path = tmp_path / 'params.yaml'
    for text, words in (
            ('hall: {talker: {ros__parameters: {}}}', 'only parameters of hall.talker'),
            ('hall: {localiser: {ros_parameters: {}}}', 'only parameters of hall'),
            ('localiser: {ros_parameters: {}}', 'is localiser.ros_parameters meant?')):
        path.write_text(text)
        with pytest.raises(FileError) as refused:
            make_options(path, [])
        assert words in str(refused.value)


def test_evaluate_prints_and_writes_what_is_true(tmp_path: Path, capsys: Capture) -> None:
    stamps = 10**18 + np.arange(20) * 10**8
    poses = np.column_stack([np.arange(20), np.zeros(20), np.linspace(-3, 3, 20)])
    write_tum(Trajectory(stamps, poses), tmp_path / 'truth.tum')
    write_tum(Trajectory(stamps[::2], poses[::2] + np.array([0.006, 0.008, 0.0])),
              tmp_path / 'poses.tum')
    call = ['evaluate', str(tmp_path / 'poses.tum'), str(tmp_path / 'truth.tum')]
    code, out, _ = said(capsys, [
        *call, '--frames', '12', '--output', str(tmp_path / 'n.json'),
        '--plots', str(tmp_path / 'plots'), '--map', ROOM[3]])
    assert code == 0
    assert '10 of 12 frames answered' in out
    assert '10.00' in out
    assert json.loads((tmp_path / 'n.json').read_text())['translation_m']['median'] == (
        pytest.approx(0.01))
    assert len(list((tmp_path / 'plots').iterdir())) == 3
    assert said(capsys, [*call, '--output', str(tmp_path / 'n.md')])[0] == 0
    assert (tmp_path / 'n.md').read_text() == said(capsys, call)[1]
    assert '.json or .md' in refusal(capsys, [*call, '--output', str(tmp_path / 'n.txt')])
    assert 'more poses, 10' in refusal(capsys, [*call, '--frames', '3'])


def test_trajectories_without_common_time_end_with_1(tmp_path: Path, capsys: Capture) -> None:
    for name, start in (('a', 0), ('b', 10**12)):
        write_tum(Trajectory(start + np.arange(3), np.zeros((3, 3))), tmp_path / f'{name}.tum')
    code, out, err = said(
        capsys, ['evaluate', str(tmp_path / 'a.tum'), str(tmp_path / 'b.tum')])
    assert code == 1
    assert '0 compared' in out
    assert 'nothing to compare: no pose has a true one within 0.001 s' in err
    assert 'b.tum from 1000.000000000 to 1000.000000002 s' in err
    (tmp_path / 'b.tum').write_text('')
    code, _, err = said(capsys, ['evaluate', str(tmp_path / 'a.tum'), str(tmp_path / 'b.tum')])
    assert code == 1
    assert 'b.tum holds no pose' in err


def test_help_is_complete_and_explains_every_command(capsys: Capture) -> None:
    pytest.importorskip('joblib')  # for experiment alone
    code, out, _ = said(capsys, ['--help'])
    assert code == 0
    for command in COMMANDS:
        assert f'  {command.name} ' in out
        code, text, _ = said(capsys, [command.name, '--help'])
        assert code == 0
        assert command.example in text
        assert text.startswith(f'usage: nccs-pose {command.name} ')


@pytest.mark.parametrize(('arguments', 'words'), [
    (['replay', 'bag', '--overlays', '-1'], "'-1' is no whole number from 0 on"),
    (['render', 'bag', '--quality', '101'], "'101' is no whole number from 0 to 100"),
    (['render', 'bag', '--seed', '-1'], "'-1' is no whole number"),
    (['render', 'bag', '--rate', '1e-9'], "'1e-9' is no number from 0.01 to 1000 Hz"),
    (['render', 'bag', '--rate', 'inf'], "'inf' is no number from 0.01"),
    (['render', 'bag', '--rate', 'nan'], "'nan' is no number from 0.01"),
    (['render', 'bag', '--speed', '1e300'], "'1e300' is no number from 0.001 to 100 m/s"),
    (['render', 'bag', '--width', '1000000'], "'1000000' is no whole number from 64 to 8192"),
    (['render', 'bag', '--width', '66'], "'66' is no multiple of 4 px"),
    (['render', 'bag', '--frames', '0'], "'0' is no whole number from 1 to"),
    (['stages', '--width', '-4'], "'-4' is no whole number from 160"),
    (['stages', '--frames', '3'], "'3' is no whole number from 4"),
    (['precision', '--noise', 'inf'], "'inf' is no number from 0.0001 to 1"),
    (['precision', '--widths', '-4'], "'-4' is no whole number from 160"),
    (['precision', '--poses', '1'], "'1' is no whole number from 2"),
    (['coverage', '--trials', '1'], "'1' is no whole number from 2"),
    (['benchmark', '--repetitions', '2'], "'2' is no whole number from 3"),
    (['check', 'bag', '--pose-error', 'nan'], "'nan' is no number from 0.01 to 1000 mm"),
    (['check', 'bag', '--images', '0'], "'0' is no whole number from 1 on"),
    (['evaluate', 'a', 'b', '--max-gap', 'nan'], "'nan' is no time"),
    (['evaluate', 'a', 'b', '--tolerance', '-1'], "'-1' is no time")])
def test_a_number_out_of_its_range_is_named(
    arguments: list[str], words: str, capsys: Capture,
) -> None:
    code, _, err = said(capsys, arguments)
    assert code == 2
    assert f'argument {arguments[-2]}: {words}' in err


@pytest.mark.parametrize('arguments', [[], ['fly'], ['replay'], ['replay', '--nonsense']])
def test_wrong_usage_ends_with_2(arguments: list[str], capsys: Capture) -> None:
    code, _, err = said(capsys, arguments)
    assert code == 2
    assert 'usage' in err


def test_help_loads_neither_numpy_nor_opencv() -> None:
    """So that it is quick on a small robot's computer."""
    code = ('import sys; from nccs_pose.cli import main; main(["--help"]); '
            'print(sorted({"numpy", "cv2", "rosbags", "matplotlib"} & set(sys.modules)))')
    run = subprocess.run(
        [sys.executable, '-c', code], cwd=REPO, capture_output=True, text=True, check=True)
    assert run.stdout.splitlines()[-1] == '[]'


def test_what_is_there_is_not_overwritten_by_a_drive(tmp_path: Path, capsys: Capture) -> None:
    words = ['render', str(tmp_path / 'mine'), '--frames', '1', '--width', '64']
    for kind in ('rig', 'map'):
        own = tmp_path / f'mine_{kind}.yaml'
        own.write_text('my own')
        assert f'mine_{kind}.yaml: exists already' in refusal(capsys, words)
        assert own.read_text() == 'my own'
        assert not (tmp_path / 'mine').exists()
        own.unlink()


@pytest.mark.parametrize('arguments', [
    ['replay', str(REPO / 'bags/room'), *ROOM, '--output', 'OUT/p.tum', '--plots', 'BAD'],
    ['replay', str(REPO / 'bags/room'), *ROOM, '--output', 'OUT/p', '--plots', 'OUT/p'],
    ['replay', str(REPO / 'bags/room'), *ROOM, '--output', ''],
    ['calibrate', str(REPO / 'bags/room'), *ROOM, '--output', '.'],
    ['evaluate', 'OUT/a.tum', 'OUT/a.tum', '--output', 'BAD/n.md'],
    ['evaluate', 'OUT/a.tum', 'OUT/a.tum', '--output', 'OUT/n.md', '--plots', 'OUT/n.md'],
    ['evaluate', 'OUT/a.tum', 'OUT/a.tum', '--plots', 'BAD'],
    ['faults', '--output', 'BAD'], ['precision', '--output', 'BAD'],
    ['coverage', '--output', 'BAD/c.md'], ['stages', '--output', 'BAD/s.json'],
    ['starts', '--output', 'BAD/s.md'], ['experiment', 'no-guess', '--output', 'BAD'],
    ['calibrate', str(REPO / 'bags/room'), *ROOM, '--output', f'OUT/{"x" * 235}.yaml']])
def test_what_cannot_be_written_is_said_before_the_work(
    arguments: list[str], tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch,
) -> None:
    write_tum(Trajectory([0], np.zeros((1, 3))), tmp_path / 'a.tum')
    monkeypatch.setattr('nccs_pose.cli.progress.Progress.step', None)  # no work is done
    call = [a.replace('BAD', '/dev/null').replace('OUT', str(tmp_path)) for a in arguments]
    code, out, err = said(capsys, call)
    assert code == 2
    assert 'cannot be written' in err
    assert not out


def test_a_path_that_cannot_be_is_named(
    drive: Path, tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch,
) -> None:
    files, long = calibrated(drive), str(tmp_path / ('x' * 300))
    for arguments in (
            ['replay', long, *files, '--output', str(tmp_path / 'p.tum')],
            ['replay', str(drive), *files, '--output', f'{long}/p.tum'],
            ['replay', str(drive), '--rig', long, '--map', files[3], '--output', 'p.tum'],
            ['check', long, *files], ['render', long, '--frames', '1'], ['evaluate', long, long]):
        message = refusal(capsys, arguments)
        assert 'xxx' in message and 'File name too long' in message

    def fails(error: Exception) -> Callable[..., int]:
        def run(*_: object) -> int:
            raise error
        return run

    for error, words in (
            (PermissionError(13, 'Permission denied', 'a/b'), 'a/b: Permission denied.'),
            (OSError('odd'), 'evaluate: odd.'), (MemoryError(), 'too little memory')):
        monkeypatch.setattr('nccs_pose.cli.evaluate.run', fails(error))
        assert words in refusal(capsys, ['evaluate', 'a', 'b'])


def test_no_character_ends_finished_work(drive: Path, tmp_path: Path) -> None:
    plain = {**os.environ, 'LC_ALL': 'C', 'PYTHONUTF8': '0', 'PYTHONCOERCECLOCALE': '0'}
    odd = os.fsencode(tmp_path) + b'/re\xfe\xc3\xa4$_$'
    call = [sys.executable, '-m', 'nccs_pose.cli']
    for environment in (plain, {**os.environ, 'PYTHONUTF8': '1'}):
        run = subprocess.run(
            [*call, 'render', odd, '--frames', '1', '--width', '160'], cwd=REPO,
            env=environment, capture_output=True)
        assert run.returncode == 0, run.stderr
        assert b'1 frames; replay it with' in run.stdout
        load_rig(Path(os.fsdecode(odd) + '_rig.yaml'))
        run = subprocess.run(
            [*call, 'replay', odd, '--rig', odd + b'_rig.yaml', '--map', odd + b'_map.yaml',
             '--output', odd + b'.tum', '--plots', odd + b'_plots'], cwd=REPO, env=environment,
            capture_output=True)
        assert b'Traceback' not in run.stderr
        assert Path(os.fsdecode(odd) + '_plots', 'trajectory.png').exists()
        for made in tmp_path.iterdir():
            shutil.rmtree(made, ignore_errors=True)
            made.unlink(missing_ok=True)


@pytest.mark.parametrize(('package', 'words'), [
    ('rosbags', 'pip install "rosbags'), ('cv2', "pip install 'nccs_pose[pip]' brings it")])
def test_a_missing_package_is_named(package: str, words: str) -> None:
    code = (f'import sys; sys.modules[{package!r}] = None; from nccs_pose.cli import main; '
            'sys.exit(main(["replay", "--help"]))')
    run = subprocess.run([sys.executable, '-c', code], cwd=REPO, capture_output=True, text=True)
    assert run.returncode == 2
    assert words in run.stderr
    assert 'Traceback' not in run.stderr


def test_an_interrupt_ends_with_130(monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    def interrupted(*_: object) -> int:
        raise KeyboardInterrupt

    monkeypatch.setattr('nccs_pose.cli.evaluate.run', interrupted)
    code, _, err = said(capsys, ['evaluate', 'a.tum', 'b.tum'])
    assert code == 130
    assert 'interrupted' in err


@pytest.mark.parametrize('where', ['| true', '>&-'])
def test_a_closed_output_is_no_traceback(tmp_path: Path, where: str) -> None:
    write_tum(Trajectory([0], np.zeros((1, 3))), tmp_path / 'a.tum')
    line = f'{sys.executable} -m nccs_pose.cli evaluate {tmp_path}/a.tum {tmp_path}/a.tum'
    run = subprocess.run(
        ['bash', '-c', f'{line} {where}'], cwd=REPO, capture_output=True, text=True)
    assert 'Traceback' not in run.stderr
    assert 'Exception' not in run.stderr
    assert run.returncode == 0


@pytest.mark.parametrize('arguments', [
    ['replay', str(REPO / 'bags/room'), '--rig', 'RIG', '--map', 'MAP', '--output', 'MAP'],
    ['replay', str(REPO / 'bags/room'), '--rig', 'RIG', '--map', 'MAP', '--output', 'LINK'],
    ['calibrate', str(REPO / 'bags/room'), '--rig', 'RIG', '--map', 'MAP', '--output', 'RIG'],
    ['starts', '--map', 'MAP', '--output', 'MAP']])
def test_what_is_read_is_not_replaced(
    arguments: list[str], tmp_path: Path, capsys: Capture,
) -> None:
    files = {kind: tmp_path / f'{kind}.yaml' for kind in ('RIG', 'MAP', 'LINK')}
    for kind, path in zip(('RIG', 'MAP'), (ROOM[1], ROOM[3])):
        shutil.copy(path, files[kind])
    files['LINK'].symlink_to(files['RIG'])
    before = files['RIG'].read_text(), files['MAP'].read_text()
    call = [str(files.get(word, word)) for word in arguments]
    assert 'cannot be written: it is read' in refusal(capsys, call)
    assert (files['RIG'].read_text(), files['MAP'].read_text()) == before


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_progress_moves_on_a_terminal_and_is_silent_when_short(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now = [0.0]
    monkeypatch.setattr('nccs_pose.cli.progress.time.monotonic', lambda: now[0])

    def run(stream: io.StringIO, seconds: float) -> str:
        monkeypatch.setattr('sys.stderr', stream)
        with Progress(10, 'frames') as progress:
            for _ in range(10):
                now[0] += seconds
                progress.step('tracking')
        return stream.getvalue()

    assert run(io.StringIO(), 0.1) == ''
    lines = run(io.StringIO(), 3.0).splitlines()
    assert lines[0] == '2/10 frames, 24 s to go  tracking'
    assert len(lines) == 5
    moving = run(Terminal(), 0.2)
    assert moving.count('\r') == 12 and '\n' not in moving
    assert moving.endswith('\r')
