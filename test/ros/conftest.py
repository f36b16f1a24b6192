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

"""Fixtures for tests over DDS; without rclpy they skip."""

from __future__ import annotations

from collections.abc import Iterator
import contextlib
import itertools
import os
from pathlib import Path
import socket
from typing import Any

import pytest

# Before the first rclpy.init of this process.
os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
os.environ['FASTRTPS_DEFAULT_PROFILES_FILE'] = str(
    Path(__file__).resolve().parents[2] / 'config' / 'fastdds_large_images.xml')
_NUMBERS = itertools.count()


def _is_free(domain: int) -> bool:
    """Whether nobody has the port of a domain's first participant, as DDS numbers them."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as user:
        try:
            user.bind(('', 7410 + 250 * domain))
        except OSError:
            return False
    return True


def _free_domain() -> int:
    """A domain of one's own: 1 to 99 are safe on every system."""
    # Neighbours in time and other runs differ.
    domains = (1 + (os.getpid() * 7 + next(_NUMBERS)) % 99 for _ in range(99))
    return next(domain for domain in domains if _is_free(domain))


@contextlib.contextmanager
def a_world(folder: Path) -> Iterator[Any]:
    """A DDS domain of its own, with a user in it."""
    pytest.importorskip('rclpy', reason='ROS 2 is not available: no rclpy')
    from harness import World

    domain = _free_domain()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv('ROS_LOG_DIR', str(folder / 'ros_log'))
        world = World(domain, folder)
        try:
            yield world
        finally:
            world.close()


@pytest.fixture
def world(tmp_path: Path) -> Iterator[Any]:
    """A world for one test."""
    with a_world(tmp_path) as world:
        yield world


@pytest.fixture(scope='module')
def shared_world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """A world in which the tests of a module meet the same nodes: discovery takes seconds."""
    with a_world(tmp_path_factory.mktemp('world')) as world:
        yield world


@pytest.fixture
def pair(
    request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
) -> Iterator[Any]:
    """The node and a user of it in this process; `request.param` holds further parameters."""
    rclpy = pytest.importorskip('rclpy', reason='ROS 2 is not available: no rclpy')
    from harness import Pair

    monkeypatch.setenv('ROS_LOG_DIR', str(tmp_path))
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=_free_domain())
    pair = Pair(context, getattr(request, 'param', {}))
    try:
        yield pair
        pair.node.close()
    finally:
        pair.executor.shutdown()
        # What is left to the garbage collector would be met by the next test.
        pair.node.destroy_node()
        pair.user.destroy_node()
        rclpy.shutdown(context=context)


@pytest.fixture(scope='session')
def arena() -> Any:
    """Images of a short drive through the simulated arena, with their true poses."""
    from nccs_pose.files.yaml_files import load_map, load_rig
    from nccs_pose.simulation.drive import make_drive, render_frame
    from nccs_pose.simulation.motion import figure_of_eight
    from nccs_pose.simulation.scene import ideal_scene, Scene

    look = ideal_scene(640, noise=0.01)
    folder = Path(__file__).resolve().parents[2] / 'config'
    scene = Scene(load_rig(folder / 'arena_640_rig.yaml'), load_map(folder / 'arena_map.yaml'),
                  look.appearance, look.sensor)
    drive = make_drive(figure_of_eight(), 12, rate=10.0, start_ns=1_000_000_000_000)
    return [render_frame(scene, drive, k) for k in range(len(drive))]
