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

"""The last good pose: its file, and its way through two runs of the node."""

from __future__ import annotations

import json
import signal

from nccs_pose.errors import FileError
from nccs_pose.files.saved_pose import map_hash, read_saved_pose, SavedPose, write_saved_pose
from nccs_pose.geometry.lines import LineMap
from nccs_pose.geometry.pose import Pose2
from nccs_pose.simulation.scene import arena_map
import numpy as np
import pytest

ARENA = {'rig_file': 'config/arena_640_rig.yaml', 'map_file': 'config/arena_map.yaml'}
COVARIANCE = np.array([[4e-4, 1e-5, 0.0], [1e-5, 1e-4, 0.0], [0.0, 0.0, 1e-5]])


def test_round_trip(tmp_path):
    path = tmp_path / 'below' / 'pose.json'
    assert read_saved_pose(path) is None
    saved = SavedPose(1_700_000_000_123_456_789, 'map', 'abc', Pose2(1.0, -2.0, 3.0), COVARIANCE)
    write_saved_pose(path, saved)
    back = read_saved_pose(path)
    assert (back.stamp_ns, back.frame, back.map_hash) == (saved.stamp_ns, 'map', 'abc')
    assert back.pose == saved.pose
    np.testing.assert_array_equal(back.covariance, COVARIANCE)
    assert [p.name for p in path.parent.iterdir()] == ['pose.json']


@pytest.mark.parametrize(('key', 'value'), [
    ('x_m', 'NaN'), ('yaw_rad', 'null'), ('stamp_ns', '"now"'), ('y_m', 'true'),
    ('covariance_x_y_yaw', '[[1, 0], [0, 1]]'), ('covariance_x_y_yaw', '"much"'),
    ('covariance_x_y_yaw', '[[1, 0, 0], [0, -1, 0], [0, 0, 1]]'),
    ('covariance_x_y_yaw', '[[1, 0.5, 0], [0, 1, 0], [0, 0, 1]]'),
    ('x_m', f'1{400 * "0"}'), ('covariance_x_y_yaw', f'[[1{400 * "0"}, 0, 0]]'),
])
def test_what_is_wrong_is_named(tmp_path, key, value):
    path = tmp_path / 'pose.json'
    write_saved_pose(path, SavedPose(1, 'map', 'abc', Pose2(), COVARIANCE))
    content = json.loads(path.read_text())
    content[key] = json.loads(value)
    path.write_text(json.dumps(content))
    with pytest.raises(FileError, match=key):
        read_saved_pose(path)


@pytest.mark.parametrize('text', ['', '{', '[1, 2]', '\x00', '[' * 100_000])
def test_what_is_no_json_is_said(tmp_path, text):
    path = tmp_path / 'pose.json'
    path.write_text(text)
    with pytest.raises(FileError, match=r'pose\.json'):
        read_saved_pose(path)


def test_hash_changes_with_every_line():
    lines = tuple(arena_map())
    same = map_hash(arena_map())
    assert map_hash(LineMap(lines)) == same
    assert map_hash(LineMap(lines[:-1])) != same
    assert map_hash(LineMap(lines[::-1])) != same


def test_pose_is_saved_at_the_end_and_offered_at_the_next_start(world, arena, tmp_path):
    from geometry_msgs.msg import PoseWithCovarianceStamped
    from nccs_pose.ros.conversions import image_message
    from sensor_msgs.msg import Image

    user, path = world.user, tmp_path / 'kept' / 'pose.json'
    node = world.localiser(saved_pose_file=path, **ARENA)
    poses = user.listen(PoseWithCovarianceStamped, 'pose')
    images = user.publisher(Image, 'image')
    user.show(images, *(image_message(s.stamp_ns, 'camera', s.image) for s in arena))
    assert user.wait(lambda: poses and len(poses) == user.count('frames_answered')), node.output
    assert node.stop(signal.SIGTERM) == 0, node.output
    saved, last = read_saved_pose(path), poses[-1].pose.pose.position
    assert (saved.pose.x, saved.pose.y) == (last.x, last.y)
    assert saved.map_hash == map_hash(arena_map())

    again = world.localiser(saved_pose_file=path, **ARENA)
    assert user.wait(lambda: f'prior: x {saved.pose.x:.3f} m' in again.output), again.output
    assert again.stop() == 0
    # Of another map it is worth nothing; damaged it is worth nothing either.
    other = world.localiser(
        saved_pose_file=path, rig_file='config/arena_640_rig.yaml',
        map_file='config/room_map.yaml')
    assert user.wait(lambda: 'is of another map' in other.output), other.output
    assert 'prior: ' not in other.output
    assert other.stop() == 0
    path.write_text('{')
    damaged = world.localiser(saved_pose_file=path, **ARENA)
    assert user.wait(lambda: 'the saved pose is not used' in damaged.output), damaged.output
    assert damaged.running()
    nobody = world.localiser('-r', '__node:=other', saved_pose_file='~no_such_user/x', **ARENA)
    user.meet(nobody, 'other')
