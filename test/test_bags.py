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
"""Bags: what others recorded is read, what is written others read, and damage is named."""

from __future__ import annotations

from collections.abc import Callable
import os
from pathlib import Path

from calibration_reader import read_calibration
import cv2
from nccs_pose.errors import FileError, VisionError
from nccs_pose.files.bag_topics import find_topics
from nccs_pose.files.bags import (
    BagReader,
    BagTopics,
    BagWriter,
    StampedImage,
    StampedOdometry,
)
from nccs_pose.files.trajectories import read_tum
from nccs_pose.geometry.camera import PinholeCamera
from nccs_pose.geometry.pose import Pose2, RigidTransform
import numpy as np
import pytest
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import get_typestore, Stores
import yaml

REPO = Path(__file__).resolve().parents[1]
ROOM = REPO / 'bags' / 'room'
T0 = 1_700_000_000_000_000_001
TYPES = get_typestore(Stores.ROS2_JAZZY)
CAMERA = PinholeCamera(64, 48, 50.0, 51.0, 31.5, 23.5, distortion=(0.1, -0.01, 0.001, 0.002))
V, U = np.mgrid[0:48, 0:64]
PICTURE = np.stack([2 * U + 40, 3 * V + 30, 250 - U - V], axis=-1).astype(np.uint8)


def small_bag(path: Path, compression: str = '') -> Path:
    """Two images, three odometry and two truth poses, camera info, a static transform."""
    with BagWriter(path) as writer:
        writer.write_tf_static(T0, [('base_link', 'mirror', RigidTransform.from_rpy(
            [3.1, -0.1, 0.7], [-0.03, 0.01, 0.75]))])
        for i in range(3):
            writer.write_odometry(
                T0 + i * 10**8, Pose2(0.1 * i, 0.0, 0.5), twist=(1.0, 0.2))
        for i in range(2):
            stamp = T0 + i * 10**8
            writer.write_truth(stamp, Pose2(1.0 + i, 2.0, -3.0))
            writer.write_camera_info(stamp, CAMERA)
            writer.write_image(stamp, PICTURE, compression=compression)
    return path


def refusal(path: Path, topics: BagTopics | None = None) -> str:
    with pytest.raises(FileError) as refused, BagReader(path, topics) as reader:
        list(reader.events())
    message = str(refused.value)
    assert message.startswith(str(path))
    assert '\n' not in message
    return message[len(str(path)):]


def test_the_room_s_bag_says_what_its_files_say(ray_traced: Path) -> None:
    folder = ray_traced / 'dev_room'
    rig, _ = read_calibration(folder)
    truth, odometry = (read_tum(folder / f'{name}.tum') for name in ('groundtruth', 'odometry'))
    with BagReader(folder / 'bag') as reader:
        assert reader.topics == BagTopics(
            '/camera/image_raw/compressed', '/camera/camera_info', '/odom', '/ground_truth/pose')
        assert reader.image_count() == 60
        camera = reader.camera()
        np.testing.assert_array_equal(camera.K, rig.camera.K)
        images = [e for e in reader.events() if isinstance(e, StampedImage)]
        recorded_truth, recorded_odometry = reader.ground_truth(), reader.odometry()
    assert [image.stamp_ns for image in images] == truth.stamps_ns.tolist()
    assert images[7].decode().shape == (720, 960, 3)
    at = np.searchsorted(recorded_truth.stamps_ns, truth.stamps_ns)
    np.testing.assert_array_equal(recorded_truth.stamps_ns[at], truth.stamps_ns)
    np.testing.assert_allclose(recorded_truth.poses[at], truth.poses, atol=2e-9)
    np.testing.assert_array_equal(recorded_odometry.stamps_ns, odometry.stamps_ns)
    np.testing.assert_allclose(recorded_odometry.poses, odometry.poses, atol=2e-6)


def test_the_shipped_bag_is_the_room_and_small_enough_to_ship() -> None:
    with BagReader(ROOM) as reader:
        assert reader.image_count() == 60
        # Its images arrived 35 ms after their stamps, what the wheels said at once.
        received = [event.stamp_ns + 35_000_000 * isinstance(event, StampedImage)
                    for event in reader.events()]
    assert received == sorted(received)
    assert len(received) == 60 + 611
    assert sum(file.stat().st_size for file in (REPO / 'bags').rglob('*')) < 12e6


@pytest.mark.parametrize('compression', ['', 'png', 'jpeg'])
def test_what_is_written_is_read(tmp_path: Path, compression: str) -> None:
    with BagReader(small_bag(tmp_path / 'bag', compression)) as reader:
        events = list(reader.events())
        camera, truth = reader.camera(), reader.ground_truth()
    images = [event for event in events if isinstance(event, StampedImage)]
    assert [image.stamp_ns for image in images] == [T0, T0 + 10**8]
    error = np.abs(images[1].decode().astype(int) - PICTURE)
    assert error.max() <= (8 if compression == 'jpeg' else 0)
    odometry = [event for event in events if isinstance(event, StampedOdometry)]
    assert [event.stamp_ns for event in odometry] == [T0, T0 + 10**8, T0 + 2 * 10**8]
    np.testing.assert_allclose(odometry[2].pose.as_array(), [0.2, 0.0, 0.5], atol=1e-15)
    assert (odometry[0].frame_id, odometry[0].child_frame_id) == ('odom', 'base_link')
    np.testing.assert_allclose(truth.poses, [[1.0, 2.0, -3.0], [2.0, 2.0, -3.0]], atol=1e-14)
    assert camera == PinholeCamera(
        64, 48, 50.0, 51.0, 31.5, 23.5, distortion=(0.1, -0.01, 0.001, 0.002, 0.0))
    assert [event.stamp_ns for event in events] == sorted(e.stamp_ns for e in events)


def test_the_messages_are_what_ros_defines(tmp_path: Path) -> None:
    """Read back by rosbags alone, field by field."""
    messages: dict[str, list] = {}
    with Reader(small_bag(tmp_path / 'bag')) as reader:
        for connection, _, data in reader.messages():
            messages.setdefault(connection.topic, []).append(
                TYPES.deserialize_cdr(data, connection.msgtype))
    image = messages['/camera/image_raw'][0]
    assert (image.encoding, image.height, image.width, image.step) == ('bgr8', 48, 64, 192)
    assert image.data.tobytes() == PICTURE.tobytes()
    info = messages['/camera/camera_info'][0]
    assert info.k.tolist() == [50.0, 0.0, 31.5, 0.0, 51.0, 23.5, 0.0, 0.0, 1.0]
    assert info.p.reshape(3, 4)[:, :3].ravel().tolist() == info.k.tolist()
    assert info.d.tolist() == [0.1, -0.01, 0.001, 0.002, 0.0]
    odometry = messages['/odom'][0]
    assert not odometry.pose.covariance.any()
    assert (odometry.twist.twist.linear.x, odometry.twist.twist.angular.z) == (1.0, 0.2)
    transform = messages['/tf_static'][0].transforms[0]
    assert (transform.header.frame_id, transform.child_frame_id) == ('base_link', 'mirror')
    q = transform.transform.rotation
    rotation = cv2.Rodrigues(2 * np.arccos(q.w) * np.array([q.x, q.y, q.z])
                             / np.sin(np.arccos(q.w)))[0]
    expected = RigidTransform.from_rpy([3.1, -0.1, 0.7], [0, 0, 0]).rotation
    np.testing.assert_allclose(rotation, expected, atol=1e-12)


def test_the_metadata_is_what_jazzy_s_player_parses(tmp_path: Path) -> None:
    """Keys and words of rosbag2_storage's yaml.hpp and qos.cpp, metadata version 9."""
    text = (small_bag(tmp_path / 'bag') / 'metadata.yaml').read_text()
    info = yaml.safe_load(text)['rosbag2_bagfile_information']
    assert info['version'] == 9
    assert info['storage_identifier'] == 'mcap'
    assert info['message_count'] == 10
    assert info['custom_data'] == {'written_by': 'nccs_pose'}
    assert info['relative_file_paths'] == ['bag.mcap'] == [f['path'] for f in info['files']]
    for topic in info['topics_with_message_count']:
        metadata = topic['topic_metadata']
        (qos,) = metadata['offered_qos_profiles']
        latched = metadata['name'] == '/tf_static'
        assert qos['reliability'] == 'reliable'
        assert qos['durability'] == ('transient_local' if latched else 'volatile')
        assert qos['history'] == 'keep_last'
        assert qos['liveliness'] == 'automatic'
        assert qos['depth'] == (1 if latched else 10)
        # rmw_time_t's infinity (RMW_DURATION_INFINITE)
        assert qos['deadline'] == {'sec': 9223372036, 'nsec': 854775807}
        assert metadata['type_description_hash'].startswith('RIHS01_')


def test_a_bag_is_never_overwritten_and_stamps_must_be_ros_time(tmp_path: Path) -> None:
    path = small_bag(tmp_path / 'bag')
    with pytest.raises(FileError, match='exists already'), BagWriter(path):
        pass
    with pytest.raises(FileError, match='-1 ns'), BagWriter(tmp_path / 'other') as writer:
        writer.write_truth(-1, Pose2())
    assert not (tmp_path / 'other' / 'metadata.yaml').exists()
    with pytest.raises(FileError, match="'gif'"), BagWriter(tmp_path / 'third') as writer:
        writer.write_image(T0, PICTURE, compression='gif')


def test_a_path_that_cannot_be_is_named(tmp_path: Path) -> None:
    path = tmp_path / ('x' * 300)
    with pytest.raises(FileError, match=r'x: cannot be made: File name too long'):
        BagWriter(path).__enter__()
    assert ': cannot be read: File name too long' in refusal(path)
    bag = small_bag(tmp_path / 'bag')
    (bag / 'bag.mcap').unlink()
    assert 'bag.mcap' in refusal(bag)


@pytest.mark.parametrize('part', [0.0, 0.001, 0.3, 0.7, 0.99, 0.9999])
def test_a_truncated_bag_is_refused(tmp_path: Path, part: float) -> None:
    path = small_bag(tmp_path / 'bag')
    data = (path / 'bag.mcap').read_bytes()
    (path / 'bag.mcap').write_bytes(data[:int(part * len(data))])
    assert 'cut short' in refusal(path)


def test_flipped_bytes_never_end_in_a_traceback(tmp_path: Path) -> None:
    path = small_bag(tmp_path / 'bag', 'png')
    data = (path / 'bag.mcap').read_bytes()
    rng = np.random.default_rng(5)
    refused = 0
    for _ in range(30):
        damaged = bytearray(data)
        for at in rng.integers(0, len(data), 8):
            damaged[at] = rng.integers(0, 256)
        (path / 'bag.mcap').write_bytes(damaged)
        try:
            with BagReader(path) as reader:
                for event in reader.events():
                    if isinstance(event, StampedImage):
                        event.decode()
        except (FileError, VisionError):
            refused += 1
    assert refused > 5


def rewrite_metadata(path: Path, change: Callable[[str], str]) -> None:
    metadata = path / 'metadata.yaml'
    metadata.write_text(change(metadata.read_text()))


def test_bags_with_wrong_metadata_are_refused(tmp_path: Path) -> None:
    path = small_bag(tmp_path / 'bag')
    rewrite_metadata(path, lambda text: text.replace('bag.mcap', 'lost.mcap'))
    assert 'lost.mcap' in refusal(path)
    rewrite_metadata(path, lambda text: text.replace('relative_file_paths', 'paths'))
    assert 'relative_file_paths' in refusal(path)
    rewrite_metadata(path, lambda text: '{[')
    assert 'cannot be read' in refusal(path)
    (path / 'metadata.yaml').unlink()
    assert 'bag.mcap can be given by itself' in refusal(path)
    with BagReader(path / 'bag.mcap') as reader:
        assert reader.image_count() == 2
    assert 'no such bag' in refusal(tmp_path / 'absent')
    (tmp_path / 'a.txt').write_text('no bag')
    assert 'cannot be read' in refusal(tmp_path / 'a.txt')
    (tmp_path / 'folder').mkdir()
    assert refusal(tmp_path / 'folder') == ': is no bag: it has no metadata.yaml.'
    cv2.imwrite(str(tmp_path / 'folder' / '1.png'), PICTURE)
    assert 'is a folder of images, no bag' in refusal(tmp_path / 'folder')
    os.mkfifo(tmp_path / 'pipe.mcap')
    assert 'is no bag: it is a pipe' in refusal(tmp_path / 'pipe.mcap')


def test_a_bag_without_images_says_what_it_has(tmp_path: Path) -> None:
    with BagWriter(tmp_path / 'bag') as writer:
        writer.write_odometry(T0, Pose2())
    message = refusal(tmp_path / 'bag')
    assert 'no images' in message
    assert '/odom (nav_msgs/msg/Odometry)' in message
    with BagReader(tmp_path / 'bag') as reader:
        assert reader.camera() is None
        with pytest.raises(FileError, match=r'ground-truth.*/odom'):
            reader.ground_truth()


def test_topics_given_wrong_are_refused_by_name(tmp_path: Path) -> None:
    path = small_bag(tmp_path / 'bag')
    message = refusal(path, BagTopics(image='/camera/image'))
    assert "'/camera/image'" in message
    assert '/camera/image_raw (sensor_msgs/msg/Image)' in message
    message = refusal(path, BagTopics(image='/odom'))
    assert '/odom' in message and 'sensor_msgs/msg/CompressedImage' in message
    with BagReader(path, BagTopics(ground_truth='/odom')) as reader:
        assert len(reader.ground_truth()) == 3


@pytest.mark.parametrize(('present', 'expected'), [
    ({'/a/image_raw': 'Image', '/a/image_raw/compressed': 'CompressedImage',
      '/a/camera_info': 'CameraInfo', '/b/camera_info': 'CameraInfo'},
     BagTopics('/a/image_raw', '/a/camera_info')),
    ({'/image/compressed': 'CompressedImage', '/camera_info': 'CameraInfo'},
     BagTopics('/image/compressed', '/camera_info')),
    ({'/image': 'Image', '/l/camera_info': 'CameraInfo', '/r/camera_info': 'CameraInfo'},
     BagTopics('/image')),
    ({'/odom': 'Odometry', '/odometry/filtered': 'Odometry'}, BagTopics(odom='/odom')),
    ({'/robot/odom': 'Odometry', '/gt/odom': 'Odometry', '/pose': 'PoseStamped'},
     BagTopics(odom='/robot/odom', ground_truth='/gt/odom')),
    ({'/mocap': 'PoseWithCovarianceStamped', '/pose': 'PoseWithCovarianceStamped'},
     BagTopics(ground_truth='/mocap')),
    ({}, BagTopics()),
])
def test_topics_are_found_by_type_and_name(
    present: dict[str, str], expected: BagTopics,
) -> None:
    packages = {'Odometry': 'nav_msgs', 'PoseStamped': 'geometry_msgs',
                'PoseWithCovarianceStamped': 'geometry_msgs'}
    types = {name: f'{packages.get(kind, "sensor_msgs")}/msg/{kind}'
             for name, kind in present.items()}
    assert find_topics(BagTopics(), types, 'bag') == expected


@pytest.mark.parametrize(('kind', 'names'), [
    ('sensor_msgs/msg/Image', ['/left/image', '/right/image']),
    ('nav_msgs/msg/Odometry', ['/a/odom', '/b/odom']),
    ('geometry_msgs/msg/PoseStamped', ['/truth', '/vicon/robot']),
])
def test_ambiguous_topics_are_named(kind: str, names: list[str]) -> None:
    with pytest.raises(FileError) as refused:
        find_topics(BagTopics(), dict.fromkeys(names, kind), 'bag')
    assert all(name in str(refused.value) for name in names)


def write_with_rosbags(path: Path, topic: str, kind: str, message: object) -> Path:
    """A bag in the other storage format, as another program would write it."""
    with Writer(path, version=8, storage_plugin=StoragePlugin.SQLITE3) as writer:
        connection = writer.add_connection(topic, kind, typestore=TYPES)
        writer.write(connection, T0, TYPES.serialize_cdr(message, kind))
    return path


def header() -> object:
    stamp = TYPES.types['builtin_interfaces/msg/Time'](5, 6)
    return TYPES.types['std_msgs/msg/Header'](stamp, 'lens')


def test_an_image_that_lies_about_its_size_is_refused_when_decoded(tmp_path: Path) -> None:
    image = TYPES.types['sensor_msgs/msg/Image'](
        header(), 48, 64, 'rgb8', 0, 200, np.zeros(100, np.uint8))
    path = write_with_rosbags(tmp_path / 'bag', '/image', 'sensor_msgs/msg/Image', image)
    with BagReader(path) as reader:
        (event,) = reader.events()
    assert event.stamp_ns == 5_000_000_006
    with pytest.raises(VisionError, match='100 bytes'):
        event.decode()


@pytest.mark.parametrize('quaternion', [(0.0, 0.0, 0.0, 0.0), (0.0, 0.0, float('nan'), 1.0)])
def test_a_pose_that_is_none_is_refused_with_its_topic(
    tmp_path: Path, quaternion: tuple[float, ...],
) -> None:
    pose = TYPES.types['geometry_msgs/msg/Pose'](
        TYPES.types['geometry_msgs/msg/Point'](1.0, 2.0, 0.0),
        TYPES.types['geometry_msgs/msg/Quaternion'](*quaternion))
    message = TYPES.types['geometry_msgs/msg/PoseStamped'](header(), pose)
    path = write_with_rosbags(tmp_path / 'bag', '/truth', 'geometry_msgs/msg/PoseStamped', message)
    with BagReader(path) as reader, pytest.raises(FileError, match=r'/truth at 5000000006 ns'):
        reader.ground_truth()


def test_odometry_that_is_no_pose_is_left_out_and_said(tmp_path: Path) -> None:
    """As some drivers send it first; the node refuses it and goes on."""
    make = TYPES.types
    with BagWriter(tmp_path / 'bag') as writer:
        for k in range(3):
            writer.write_image(T0 + k, PICTURE)
            pose = make['geometry_msgs/msg/Pose'](
                make['geometry_msgs/msg/Point'](1.0, 2.0, 0.0),
                make['geometry_msgs/msg/Quaternion'](0.0, 0.0, 0.0, float(k > 0)))
            zero = make['geometry_msgs/msg/Vector3'](0.0, 0.0, 0.0)
            writer._write('/odom', 'nav_msgs/msg/Odometry', T0 + k, {
                'header': header(), 'child_frame_id': 'base_link',
                'pose': make['geometry_msgs/msg/PoseWithCovariance'](pose, np.zeros(36)),
                'twist': make['geometry_msgs/msg/TwistWithCovariance'](
                    make['geometry_msgs/msg/Twist'](zero, zero), np.zeros(36))})
    with BagReader(tmp_path / 'bag') as reader:
        kinds = [type(event) for event in reader.events()]
    assert (kinds.count(StampedImage), kinds.count(StampedOdometry)) == (3, 2)
    (words,) = reader.left_out
    assert '/odom at 5000000006 ns: quaternion (0.0, 0.0, 0.0, 0.0) is no rotation' in words


def test_an_uncalibrated_camera_info_is_no_camera(tmp_path: Path) -> None:
    region = TYPES.types['sensor_msgs/msg/RegionOfInterest'](0, 0, 0, 0, False)
    info = TYPES.types['sensor_msgs/msg/CameraInfo'](
        header(), 48, 64, '', np.zeros(0), np.zeros(9), np.zeros(9), np.zeros(12), 0, 0, region)
    path = write_with_rosbags(
        tmp_path / 'bag', '/camera_info', 'sensor_msgs/msg/CameraInfo', info)
    with BagReader(path) as reader:
        assert reader.camera() is None
