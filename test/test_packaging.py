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

"""What the package promises to colcon, pip, ros2 launch and make, checked without any of them."""

from __future__ import annotations

import ast
import dataclasses
import importlib.util
from pathlib import Path
import re
import subprocess
import sys
import types
from typing import Any
import xml.etree.ElementTree as ElementTree

from nccs_pose.estimation.options import LocaliserOptions
from nccs_pose.files.resources import resolve, share_directory
from nccs_pose.files.yaml_files import load_map, load_rig
from nccs_pose.node_options import NodeOptions
from nccs_pose.ros import reference
from nccs_pose.ros.camera_options import CameraOptions
from nccs_pose.ros.interface import INPUTS, OUTPUTS, STAND_IN_OUTPUTS
from nccs_pose.simulation.scene import arena_rig
import numpy as np
import pytest
import yaml

LAUNCH_FILES = ('bag_demo', 'synthetic_robot', 'robot')
PARAMETER_FILES = ('room', 'arena', 'robot')


def setup_arguments(repository: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """What setup.py hands to setuptools."""
    given: dict[str, Any] = {}
    monkeypatch.setattr('setuptools.setup', lambda **arguments: given.update(arguments))
    monkeypatch.chdir(repository)
    exec(compile((repository / 'setup.py').read_text(), 'setup.py', 'exec'), {})
    return given


def test_every_entry_point_is_a_function(repository: Path, monkeypatch: pytest.MonkeyPatch):
    scripts = setup_arguments(repository, monkeypatch)['entry_points']['console_scripts']
    for script in scripts:
        module, _, function = script.partition('=')[2].strip().partition(':')
        file = repository / (module.replace('.', '/') + '.py')
        if not file.exists():
            file = repository / module.replace('.', '/') / '__init__.py'
        names = {node.name for node in ast.parse(file.read_text()).body
                 if isinstance(node, ast.FunctionDef)}
        assert function in names, script


def test_setup_installs_what_ament_needs(repository: Path, monkeypatch: pytest.MonkeyPatch):
    arguments = setup_arguments(repository, monkeypatch)
    files = {folder: set(names) for folder, names in arguments['data_files']}
    assert files['share/ament_index/resource_index/packages'] == {'resource/nccs_pose'}
    assert 'package.xml' in files['share/nccs_pose']
    assert 'config/fastdds_large_images.xml' in files['share/nccs_pose/config']
    assert files['share/nccs_pose/launch'] == {f'launch/{n}.launch.py' for n in LAUNCH_FILES}
    assert 'bags/room/metadata.yaml' in files['share/nccs_pose/bags/room']
    assert all((repository / name).is_file() for names in files.values() for name in names)
    assert 'nccs_pose.ros' in arguments['packages']
    # An unmet requirement would break pkg_resources' entry points under apt's Python packages.
    assert not any(re.search('ros|opencv|rclpy', r) for r in arguments['install_requires'])


def test_a_source_archive_has_no_tests(repository: Path, tmp_path: Path):
    # By default those named test*.py are in it, without what they import.
    subprocess.run([sys.executable, 'setup.py', '-q', 'egg_info', '--egg-base', str(tmp_path)],
                   cwd=repository, check=True, capture_output=True)
    names = (tmp_path / 'nccs_pose.egg-info/SOURCES.txt').read_text().splitlines()
    assert 'bags/room/metadata.yaml' in names
    assert not [name for name in names if name.startswith('test/')]


def test_scripts_go_where_ros2_run_looks(repository: Path):
    text = (repository / 'setup.cfg').read_text()
    assert 'script_dir=$base/lib/nccs_pose' in text
    assert 'install_scripts=$base/lib/nccs_pose' in text


def test_package_xml(repository: Path, monkeypatch: pytest.MonkeyPatch):
    package = ElementTree.parse(repository / 'package.xml').getroot()
    arguments = setup_arguments(repository, monkeypatch)
    assert package.get('format') == '3'
    assert package.findtext('name') == arguments['name']
    assert package.findtext('version') == arguments['version']
    assert package.findtext('license') == 'Apache-2.0'
    assert package.findtext('export/build_type') == 'ament_python'
    assert re.fullmatch(r'[^@\s]+@[^@\s]+\.[a-z]+', package.find('maintainer').get('email'))


def test_package_xml_names_every_ros_package_that_is_imported(repository: Path):
    package = ElementTree.parse(repository / 'package.xml').getroot()
    declared = {element.text for element in package.findall('exec_depend')}
    imported = set()
    for file in [*(repository / 'nccs_pose/ros').glob('*.py'),
                 *(repository / 'launch').glob('*.py')]:
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.ImportFrom) and node.module:
                imported.add(node.module.partition('.')[0])
            elif isinstance(node, ast.Import):
                imported.update(alias.name.partition('.')[0] for alias in node.names)
    keys = {'tf2_ros': 'tf2_ros_py', 'numpy': 'python3-numpy', 'cv2': 'python3-opencv'}
    needed = {keys.get(name, name) for name in imported
              if name not in sys.stdlib_module_names and name != 'nccs_pose'}
    assert needed <= declared


def test_reference_page_is_up_to_date(repository: Path):
    page = (repository / 'docs/reference.md').read_text()
    assert page == reference.page(), 'run: python -m nccs_pose.ros.reference'


def test_reference_page_has_the_stand_in_camera_and_the_launch_files(repository: Path):
    _, _, page = reference.page().partition('## The node `stand_in_camera`')
    for field in dataclasses.fields(CameraOptions):
        assert f'| `{field.name}` |' in page
    camera, *files = page.split('\n### ')
    for endpoint in STAND_IN_OUTPUTS:
        assert f'| `{endpoint.name}` | `{endpoint.type}` |' in camera
    shipped = sorted((repository / 'launch').glob('*.launch.py'))
    assert [text.partition('\n')[0] for text in files] == [f'`{f.name}`' for f in shipped]
    for text, file in zip(files, shipped):
        declared = re.findall(r"DeclareLaunchArgument\(\s*'(\w+)'", file.read_text())
        assert re.findall(r'^\| `(\w+)` \|', text, re.MULTILINE) == declared


@pytest.mark.parametrize('name', PARAMETER_FILES)
def test_parameter_file_names_parameters_that_exist(name: str, repository: Path):
    content = yaml.safe_load((repository / f'config/{name}.yaml').read_text())
    ((node, below),) = content.items()
    assert node == '/**/localiser'
    parameters = below['ros__parameters']
    estimator = {key: parameters.pop(key) for key in list(parameters)
                 if key in LocaliserOptions.__dataclass_fields__}
    LocaliserOptions(**estimator)
    options = NodeOptions(**parameters)  # refuses unknown names, types and ranges
    if name != 'robot':
        rig, line_map = load_rig(resolve(options.rig_file)), load_map(resolve(options.map_file))
        assert len(line_map) >= 4
        assert rig.camera.width in (640, 960)


def test_small_arena_rig_is_the_arena_rig_scaled():
    small, full = load_rig(resolve('config/arena_640_rig.yaml')), arena_rig().scaled(0.5)
    assert (small.camera.width, small.camera.height) == (full.camera.width, full.camera.height)
    np.testing.assert_allclose(small.camera.K, full.camera.K, atol=1e-12)
    pixels = np.array([[320.0, 300.0], [200.0, 240.0]])
    np.testing.assert_allclose(
        small.back_project(pixels).moment, full.back_project(pixels).moment, atol=1e-12)


def test_fast_dds_profile_holds_a_large_image(repository: Path):
    text = (repository / 'config/fastdds_large_images.xml').read_text()
    ElementTree.fromstring(text.encode())
    image = 1280 * 960 * 3
    segment, message = (int(re.search(f'<{tag}>(\\d+)<', text).group(1))
                        for tag in ('segment_size', 'maxMessageSize'))
    assert segment >= 8 * image
    assert message > image
    assert '<useBuiltinTransports>false<' in text


def test_share_directory_of_the_source_tree(repository: Path):
    assert share_directory() == repository


class Recorded:
    """Stands in for any class of launch: remembers what it was made with."""

    def __init__(self, *arguments: Any, **named: Any) -> None:
        self.arguments, self.named = arguments, named


@pytest.fixture
def launch_modules(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make launch and launch_ros importable where they are not installed."""
    names = {
        'launch': ('LaunchDescription',),
        'launch.actions': ('DeclareLaunchArgument',),
        'launch.conditions': ('IfCondition',),
        'launch.substitutions': ('LaunchConfiguration', 'PathJoinSubstitution'),
        'launch_ros': (),
        'launch_ros.actions': ('Node',),
        'launch_ros.parameter_descriptions': ('ParameterValue',),
        'launch_ros.substitutions': ('FindPackageShare',),
    }
    for module_name, classes in names.items():
        module = types.ModuleType(module_name)
        for name in classes:
            setattr(module, name, type(name, (Recorded,), {}))
        monkeypatch.setitem(sys.modules, module_name, module)


def load_launch(repository: Path, name: str) -> list[Any]:
    """Actions of a launch file."""
    path = repository / f'launch/{name}.launch.py'
    spec = importlib.util.spec_from_file_location(f'{name}_launch', path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.generate_launch_description().arguments[0]


def leaves(value: Any) -> list[Any]:
    """Everything that a launch value is made of."""
    if isinstance(value, Recorded):
        return [value, *leaves(value.arguments), *leaves(value.named)]
    if isinstance(value, dict):
        return leaves(list(value.items()))
    if isinstance(value, (list, tuple)):
        return [leaf for item in value for leaf in leaves(item)]
    return [value]


@pytest.mark.parametrize('name', LAUNCH_FILES)
def test_launch_file_names_only_what_exists(
    name: str, repository: Path, launch_modules: None, monkeypatch: pytest.MonkeyPatch,
):
    scripts = setup_arguments(repository, monkeypatch)['entry_points']['console_scripts']
    executables = {script.partition('=')[0].strip() for script in scripts} | {'rviz2'}
    actions = load_launch(repository, name)
    declared = {a.arguments[0] for a in actions if type(a).__name__ == 'DeclareLaunchArgument'}
    assert all(a.named['description'] for a in actions
               if type(a).__name__ == 'DeclareLaunchArgument')
    nodes = [action for action in actions if type(action).__name__ == 'Node']
    assert nodes
    for action in leaves(actions):
        kind = type(action).__name__
        if kind == 'LaunchConfiguration':
            assert action.arguments[0] in declared
        elif kind == 'PathJoinSubstitution':
            share, *below = action.arguments[0]
            assert share.arguments[0] == 'nccs_pose'
            assert repository.joinpath(*below).exists()
    inputs = {endpoint.name for endpoint in INPUTS}
    for node in nodes:
        assert node.named['executable'] in executables
        if node.named['executable'] == 'localiser':
            assert {source for source, _ in node.named.get('remappings', [])} <= inputs
            check_parameters(node.named['parameters'], NodeOptions)
    if name == 'synthetic_robot':
        check_parameters(nodes[0].named['parameters'], CameraOptions)


def check_parameters(parameters: list[Any], group: type) -> None:
    """Every parameter given by name is one of the group's."""
    known = {*group.__dataclass_fields__, 'use_sim_time'}
    for given in parameters:
        if isinstance(given, dict):
            assert set(given) <= known


def test_rviz_shows_topics_that_exist(repository: Path):
    content = yaml.safe_load((repository / 'config/localiser.rviz').read_text())
    displays = content['Visualization Manager']['Displays']
    topics = {d['Topic']['Value'] for d in displays if 'Topic' in d}
    ours = {'/' + e.name.replace('~', 'localiser').lstrip('/') for e in (*INPUTS, *OUTPUTS)}
    assert topics - {'/ground_truth/pose'} <= ours
    tools = content['Visualization Manager']['Tools']
    assert {t['Topic']['Value'] for t in tools if 'Topic' in t} == {'/initialpose'}


def test_only_files_of_the_package_are_tracked(repository: Path):
    tracked = subprocess.run(
        ['git', 'ls-files'], cwd=repository, capture_output=True, text=True, check=False)
    if tracked.returncode:
        pytest.skip('not a git work tree')
    names = tracked.stdout.split('\n')
    assert not [n for n in names if n.endswith(('.pyc', '.orig', '.log')) or '.venv' in n]
    size = sum((repository / n).stat().st_size for n in names if n.startswith('bags/'))
    assert size < 12e6
