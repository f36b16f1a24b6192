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
"""Rig, map and trajectory files: what is right is read exactly, what is wrong is named."""

from __future__ import annotations

from collections.abc import Callable
import os
from pathlib import Path
import subprocess
import sys
import time

from calibration_reader import read_calibration
from nccs_pose.errors import FileError
from nccs_pose.evaluation.trajectory import Trajectory
from nccs_pose.files.saved_pose import read_saved_pose
from nccs_pose.files.text_files import check_writable, write_text
from nccs_pose.files.trajectories import read_tum, write_tum
from nccs_pose.files.yaml_files import load_map, load_rig, save_map, save_rig
from nccs_pose.files.yaml_sections import read_yaml
from nccs_pose.geometry.rig import Rig
import numpy as np
import pytest
import yaml

REPO = Path(__file__).resolve().parents[1]
RIG = (REPO / 'config' / 'room_rig.yaml').read_text()
MAP = (REPO / 'config' / 'room_map.yaml').read_text()


def assert_same_rig(a: Rig, b: Rig, tolerance: float) -> None:
    assert (a.mirror.A, a.mirror.B, a.mirror.C) == (b.mirror.A, b.mirror.B, b.mirror.C)
    assert a.mirror.rim_radius == b.mirror.rim_radius
    assert (a.camera.width, a.camera.height) == (b.camera.width, b.camera.height)
    np.testing.assert_array_equal(a.camera.K, b.camera.K)
    np.testing.assert_array_equal(a.camera.distortion, b.camera.distortion)
    np.testing.assert_array_equal(a.cop, b.cop)
    np.testing.assert_allclose(a.R_mirror_camera, b.R_mirror_camera, atol=tolerance)
    np.testing.assert_allclose(
        a.T_base_mirror.rotation, b.T_base_mirror.rotation, atol=tolerance)
    np.testing.assert_array_equal(a.T_base_mirror.translation, b.T_base_mirror.translation)


def rig_file(tmp_path: Path, old: str, new: str) -> Path:
    assert old in RIG
    path = tmp_path / 'rig.yaml'
    path.write_text(RIG.replace(old, new, 1))
    return path


def map_file(tmp_path: Path, text: str) -> Path:
    path = tmp_path / 'map.yaml'
    path.write_text(text)
    return path


def refusal(load: object, path: Path) -> str:
    with pytest.raises(FileError) as refused:
        load(path)
    message = str(refused.value)
    assert message.startswith(str(path))
    assert '\n' not in message
    return message[len(str(path)):]


def test_the_shipped_rig_is_the_sequence_s_calibration(ray_traced: Path) -> None:
    rig, line_map = read_calibration(ray_traced / 'dev_room')
    assert_same_rig(load_rig(REPO / 'config' / 'room_rig.yaml'), rig, 1e-12)
    shipped = load_map(REPO / 'config' / 'room_map.yaml')
    np.testing.assert_array_equal(shipped.starts, line_map.starts)
    np.testing.assert_array_equal(shipped.ends, line_map.ends)
    np.testing.assert_array_equal(shipped.widths, line_map.widths)


@pytest.mark.parametrize('sequence', ['dev_room', 'dev_parabolic'])
def test_a_rig_survives_saving(ray_traced: Path, tmp_path: Path, sequence: str) -> None:
    rig, _ = read_calibration(ray_traced / sequence)
    save_rig(rig, tmp_path / 'rig.yaml', comment='after calibration\nsecond line')
    assert_same_rig(load_rig(tmp_path / 'rig.yaml'), rig, 4e-16)
    plain = yaml.safe_load((tmp_path / 'rig.yaml').read_text())  # another reader's view of it
    assert plain['mirror']['C'] == rig.mirror.C
    assert plain['camera']['K'] == list(rig.camera.K.ravel())


def test_a_map_survives_saving(tmp_path: Path) -> None:
    text = """
frame: arena
colour: red
width: 1e-3
lines:
  - {start: [0, 0], end: [1e0, 2]}
  - {name: "it's: no", start: [0.1, 0, 0], end: [.5, 2, 0.0], width: 5e-2, colour: green}
  - {start: [0, 1, 0], end: [0, -1, 0], width: 2, name: "null"}
"""
    line_map = load_map(map_file(tmp_path, text))
    save_map(line_map, tmp_path / 'again.yaml', comment='saved')
    again = load_map(tmp_path / 'again.yaml')
    assert line_map.frame == again.frame == 'arena'
    assert [line.name for line in again] == ['line0', "it's: no", 'null']
    assert [line.colour for line in again] == ['red', 'green', 'red']
    # YAML 1.1 would read 1e-3 as a word
    np.testing.assert_array_equal(again.widths, [0.001, 0.05, 2.0])
    np.testing.assert_array_equal(again.starts, [[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0, 1, 0]])
    np.testing.assert_array_equal(again.ends, [[1.0, 2.0, 0.0], [0.5, 2.0, 0.0], [0, -1, 0]])


@pytest.mark.parametrize(('old', 'new', 'words'), [
    ('rim_radius: 0.032', 'rim_radus: 0.032',
     ['mirror.rim_radus', 'unknown', "'rim_radius'"]),
    ('  A: 1.0\n', '', ['mirror.A', 'missing', 'a number']),
    ('A: 1.0', 'A: one', ['mirror.A', 'a number', "'one'"]),
    ('A: 1.0', 'A: true', ['mirror.A', 'a number', 'True']),
    ('A: 1.0', 'A: .nan', ['mirror.A', 'finite', 'nan']),
    ('A: 1.0', 'A: 1.0\n  A: 1.0', ['line', "'A'", 'twice']),
    ('C: 0.001024', 'C: -0.001024', ['mirror', '-0.001024']),
    ('width: 960', 'width: 960.5', ['camera.width', 'whole number', '960.5']),
    ('height: 720', 'height: 0', ['camera.height', '1 to 16384', '0']),
    ('K: [588.75, ', 'K: [', ['camera.K', '9 numbers', '8']),
    ('K: [588.75, 0.0', 'K: [588.75, 7.5', ['camera.K', '7.5']),
    ('K: [588.75', 'K: [-588.75', ['camera.K', 'above 0', '-588.75']),
    ('plumb_bob', 'fisheye', ['camera.distortion_model', 'plumb_bob', "'fisheye'"]),
    ('0.9945218953682733', '0.9845218953682733', ['camera.R_mirror_camera', 'rotation']),
    ('0.02049971822798583, -0.1950417904299272, -0.9805806756909201',
     '-0.02049971822798583, 0.1950417904299272, 0.9805806756909201',
     ['camera.R_mirror_camera', 'mirrors']),
    ('cop: [0.0, -0.012, 0.06]', 'cop: [0.0, -0.012, 0.01]', ['camera', 'inside the mirror']),
    ('cop: [0.0, -0.012, 0.06]', 'cop: [0.0, 0.5, 0.06]', ['camera', 'not see the mirror']),
    ('cop: [0.0', 'cop: [.inf', ['camera.cop[0]', 'finite', 'inf']),
    ('mounting:', 'mountings:', ['mounting', 'missing', 'is mountings meant?']),
    ('rpy: [3.1485739705977704, ', 'rpy: [', ['mounting.rpy', '3 numbers', '2']),
    ('mirror:', 'mirror: [1', ['line']),
    ('A: 1.0', 'A: 1e150', ['mirror.A', 'at most 1e+07', '1e+150']),
    ('B: 0.0', 'B: 1e300', ['mirror.B', 'at most 1e+07', '1e+300']),
    ('rim_radius: 0.032', 'rim_radius: 1e300', ['mirror.rim_radius', 'at most 1e+07']),
    ('0.75]', '1e300]', ['mounting.translation[2]', 'at most 1e+07']),
    ('0.75]', '-0.75]', ['mounting.translation[2]', 'above 0', 'floor', '-0.75']),
    ('width: 960', 'width: 1000000', ['camera.width', '1 to 16384', '1000000']),
])
def test_a_wrong_rig_is_refused_by_key_and_value(
    tmp_path: Path, old: str, new: str, words: list[str],
) -> None:
    message = refusal(load_rig, rig_file(tmp_path, old, new))
    for word in words:
        assert word in message


@pytest.mark.parametrize(('text', 'words'), [
    ('lines:\n  - {start: [0, 0], end: [1, 0]}\n', ['lines', 'at least 2', '1']),
    ('lines: []\n', ['lines', 'at least 2', '0']),
    ('lines: 7\n', ['lines', 'list', '7']),
    ('lines: [1, 2]\n', ['lines[0]', 'mapping', '1']),
    (MAP.replace('end: [1.25, -1.65]', 'end: [-1.6, -1.55]'), ['lines[0]', 'south', 'no length']),
    (MAP.replace('end: [1.25, -1.65]', 'end: [1.25]'), ['lines[0].end', '2 or 3 numbers', '1']),
    (MAP.replace('end: [1.25, -1.65]', 'end: [455000, 5.4e+6]'),
     ['lines[0]', 'south', '5.41914e+06 m long', 'more than 10000 m']),
    (MAP.replace('name: east', 'name: south'), ['lines[1].name', 'twice', 'south']),
    (MAP.replace('end: [1.25, -1.65]', 'end: [1.25, 2.0e+7]'), ['lines[0].end', '20000000.0']),
    (f'{MAP}  - {{name: again, start: [1.25, -1.65], end: [-1.6, -1.55]}}\n',
     ['again', 'south', 'once more']),
    (MAP.replace('name: east', 'name: 7'), ['lines[1].name', '7', 'quotes']),
    (MAP.replace('width: 0.05', 'width: -0.05'), ['width', 'at least 0', '-0.05']),
    (MAP.replace('width: 0.05', 'width: 1e300'), ['width', 'at most 1e+07', '1e+300']),
    (MAP.replace('width: 0.05', 'width: 0'), ['lines[0]', 'south', 'no tape', 'above 0 m']),
    (MAP.replace('-1.55]', '-1.55, 1]').replace('end: [1.25, -1.65]', 'end: [1.25, -1.65, 1]'),
     ['lines[0]', 'south', 'no tape', 'not 1 and 1']),
    (MAP.replace('end: [1.25, -1.65]', 'end: [1.25, -1.65], colour: octarine'),
     ['lines[0].colour', 'octarine', 'green, red']),
    (MAP.replace('colour: green', 'colour: octarine'), ['colour', 'octarine', 'green, red']),
    (MAP.replace('width: 0.05', 'width: 5 cm'), ['width', 'number in m', '5 cm']),
    (MAP.replace('colour', 'color'), ['color', 'unknown', 'colour']),
    (MAP.replace('end: [1.25, -1.65]', 'end: [1.25, -1.65, 0.3]'), ['lines[0]', 'horizontal']),
    (MAP.replace('end: [1.25, -1.65]}', 'end: [1.25, -1.65], thick: 1}'),
     ['lines[0].thick', 'unknown']),
    ('', ['nothing']),
    ('- 1\n- 2\n', ['[1, 2]']),
    ('{' * 1200, []),
    ('frame: !!python/object:os.system {}\nlines: []\n', ['line 1']),
    ('1: 2\n', ['line 1', '1', 'word']),
])
def test_a_wrong_map_is_refused_by_key_and_value(
    tmp_path: Path, text: str, words: list[str],
) -> None:
    message = refusal(load_map, map_file(tmp_path, text))
    for word in words:
        assert word in message


def test_a_thousand_lines_are_compared_at_once(tmp_path: Path) -> None:
    ends = np.random.default_rng(0).uniform(-30.0, 30.0, (1000, 4)).round(3).tolist()
    rows = [f'  - {{start: {e[:2]}, end: {e[2:]}}}\n' for e in ends]
    path = map_file(tmp_path, f'width: 0.05\nlines:\n{"".join(rows)}')
    begin = time.perf_counter()
    read_yaml(path)
    middle = time.perf_counter()
    assert len(load_map(path)) == 1000
    # A second is for a busy machine; of pairs compared one by one it were half a minute.
    assert time.perf_counter() - middle < 1.0 + 3.0 * (middle - begin)
    again = ', '.join(str(v + 9e-4) for v in ends[500][2:]), ', '.join(map(str, ends[500][:2]))
    rows.append(f'  - {{name: again, start: [{again[0]}], end: [{again[1]}]}}\n')
    message = refusal(load_map, map_file(tmp_path, f'width: 0.05\nlines:\n{"".join(rows)}'))
    assert "lines[1000] (line 'again') is line 'line500' once more" in message


def test_a_file_that_is_no_text_is_refused(tmp_path: Path) -> None:
    (tmp_path / 'binary.yaml').write_bytes(b'\x89PNG\xff\xfe\x00')
    assert 'UTF-8' in refusal(load_rig, tmp_path / 'binary.yaml')
    assert 'No such file' in refusal(load_rig, tmp_path / 'absent.yaml')
    assert 'directory' in refusal(load_map, tmp_path).lower()


def test_text_is_written_whole_or_not_at_all(tmp_path: Path) -> None:
    write_text(tmp_path / 'new' / 'a.txt', 'one\n')
    write_text(tmp_path / 'new' / 'a.txt', 'two\n')
    assert (tmp_path / 'new' / 'a.txt').read_bytes() == b'two\n'
    assert [path.name for path in (tmp_path / 'new').iterdir()] == ['a.txt']
    write_text('/dev/null', 'gone')  # must stay a device
    for leads_to in (tmp_path / 'new' / 'a.txt', tmp_path / 'new' / 'none yet.txt'):
        link = tmp_path / f'to {leads_to.name}'
        link.symlink_to(leads_to)
        check_writable(link)
        write_text(link, 'through\n')
        assert link.is_symlink()
        assert leads_to.read_text() == 'through\n'
    assert not Path('/dev/null').is_file()
    # What a process has open, as /dev/stdout may lead to, stays the file that it has open.
    with (tmp_path / 'open').open('w+') as file:
        (tmp_path / 'standard output').symlink_to(f'/proc/self/fd/{file.fileno()}')
        write_text(tmp_path / 'standard output', 'into it\n')
        assert file.read() == 'into it\n'
    with pytest.raises(FileError, match=r'b\.txt.*cannot be written'):
        write_text(tmp_path / 'new' / 'a.txt' / 'b.txt', 'x')


@pytest.mark.parametrize('read', [load_rig, load_map, read_tum, read_saved_pose])
def test_only_regular_files_of_some_size_are_read(
    read: Callable[[Path], object], tmp_path: Path,
) -> None:
    os.mkfifo(tmp_path / 'pipe')
    (tmp_path / 'endless').symlink_to('/dev/zero')
    for name in ('pipe', 'endless'):
        assert 'cannot be read: it is a pipe or a device' in refusal(
            read, tmp_path / name)
    with (tmp_path / 'large').open('wb') as file:
        file.truncate(2**28 + 1)
    assert 'cannot be read: it has more than' in refusal(read, tmp_path / 'large')
    assert 'File name too long' in refusal(read, tmp_path / ('x' * 300))


def test_what_cannot_be_written_is_said_before_and_after(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / 'pipe')
    (tmp_path / 'circle').symlink_to(tmp_path / 'circle')

    def write(path: Path) -> None:
        write_text(path, 'text')

    for path, words in (
            (tmp_path / ('x' * 250), 'File name too long'),
            (tmp_path / ('x' * 300) / 'a', 'File name too long'),
            (Path('/proc/nowhere/a'), 'cannot be written: No such file'),
            (tmp_path / 'circle' / 'a', 'cannot be written')):
        assert words in refusal(check_writable, path)
        assert words in refusal(write, path)
    assert 'folder' in refusal(check_writable, tmp_path)
    # Nobody reads it: to wait for a reader would be to hang.
    assert 'cannot be written' in refusal(write, tmp_path / 'pipe')
    check_writable('/dev/null')
    check_writable(tmp_path / 'fine')
    assert sorted(path.name for path in tmp_path.iterdir()) == ['circle', 'pipe']


def test_a_name_in_another_encoding_is_written_as_an_escape(tmp_path: Path) -> None:
    write_text(tmp_path / 'a', '# of re\udcfe\n')
    assert (tmp_path / 'a').read_text(encoding='utf-8') == '# of re\\udcfe\n'


def example_trajectory() -> Trajectory:
    rng = np.random.default_rng(3)
    stamps = 1_700_000_000_000_000_000 + np.cumsum(rng.integers(1, 10**9, 50))
    poses = np.column_stack([rng.normal(size=(50, 2)), rng.uniform(-np.pi, np.pi, 50)])
    return Trajectory(stamps, poses)


def test_a_trajectory_survives_tum_to_the_nanosecond(tmp_path: Path) -> None:
    trajectory = example_trajectory()
    write_tum(trajectory, tmp_path / 'poses.tum')
    again = read_tum(tmp_path / 'poses.tum')
    np.testing.assert_array_equal(again.stamps_ns, trajectory.stamps_ns)
    np.testing.assert_allclose(again.poses, trajectory.poses, atol=1e-9)


def test_ground_truth_of_others_is_read(ray_traced: Path) -> None:
    truth = read_tum(ray_traced / 'dev_room' / 'groundtruth.tum')
    assert len(truth) == 60
    assert truth.stamps_ns[0] == 1_700_000_000_498_451_000
    # qz = -0.9368, qw = 0.3498 as the file's first row has them
    np.testing.assert_allclose(
        truth.poses[0], [-0.706653514, 0.874762476, 2 * np.arctan2(-0.936815613684,
                                                                    0.349823535453)], atol=1e-12)


def test_evo_reads_what_is_written(tmp_path: Path) -> None:
    program = Path(sys.executable).with_name('evo_ape')
    if not program.exists():
        pytest.skip('evo is not installed')
    trajectory = example_trajectory()
    shifted = Trajectory(trajectory.stamps_ns, trajectory.poses + np.array([0.03, 0.04, 0]))
    write_tum(trajectory, tmp_path / 'truth.tum')
    write_tum(shifted, tmp_path / 'estimated.tum')
    run = subprocess.run(
        [program, 'tum', 'truth.tum', 'estimated.tum', '--no_warnings'], cwd=tmp_path,
        env={'HOME': str(tmp_path), 'PATH': '/usr/bin:/bin', 'MPLBACKEND': 'Agg'},
        capture_output=True, text=True, timeout=120)
    assert run.returncode == 0, run.stderr
    values = dict(line.split() for line in run.stdout.splitlines() if len(line.split()) == 2)
    assert float(values['rmse']) == pytest.approx(0.05, abs=1e-6)


@pytest.mark.parametrize(('row', 'words'), [
    ('1.0 2.0 3.0', ['line 3', '8 numbers', '3']),
    ('1.0 a 0 0 0 0 0 1', ['line 3', "'a'"]),
    ('x 0 0 0 0 0 0 1', ['line 3', "'x'"]),
    ('1.0 nan 0 0 0 0 0 1', ['line 3', 'finite']),
    ('1.0 0 0 0 0 0 0 0', ['line 3', 'quaternion']),
])
def test_a_wrong_trajectory_is_refused_by_line(
    tmp_path: Path, row: str, words: list[str],
) -> None:
    path = tmp_path / 'poses.tum'
    path.write_text(f'# timestamp x y z qx qy qz qw\n0.5 0 0 0 0 0 0 1\n{row}\n')
    message = refusal(read_tum, path)
    for word in words:
        assert word in message
