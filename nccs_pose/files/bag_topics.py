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
"""Which topic of a bag is what: given by name, or found by type and name."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace

from nccs_pose.errors import FileError

RAW_IMAGE = 'sensor_msgs/msg/Image'
COMPRESSED_IMAGE = 'sensor_msgs/msg/CompressedImage'
CAMERA_INFO = 'sensor_msgs/msg/CameraInfo'
ODOMETRY = 'nav_msgs/msg/Odometry'
POSE = 'geometry_msgs/msg/PoseStamped'
POSE_WITH_COVARIANCE = 'geometry_msgs/msg/PoseWithCovarianceStamped'

TYPES = {
    'image': (RAW_IMAGE, COMPRESSED_IMAGE),
    'camera_info': (CAMERA_INFO,),
    'odom': (ODOMETRY,),
    'ground_truth': (POSE, POSE_WITH_COVARIANCE, ODOMETRY),
}
"""Message types that each kind of topic may have."""

_TRUTH_WORDS = ('truth', 'groundtruth', 'ground_truth', 'gt', 'mocap', 'vicon', 'optitrack')


@dataclass(frozen=True)
class BagTopics:
    """Names of the topics that a bag is read by; None: find it (or, once found: has none).

    :ivar image: sensor_msgs/Image or CompressedImage.
    :ivar camera_info: sensor_msgs/CameraInfo.
    :ivar odom: nav_msgs/Odometry.
    :ivar ground_truth: PoseStamped, PoseWithCovarianceStamped or Odometry.
    """

    image: str | None = None
    camera_info: str | None = None
    odom: str | None = None
    ground_truth: str | None = None


def find_topics(wanted: BagTopics, present: Mapping[str, str], source: str) -> BagTopics:
    """Complete `wanted` from the topics that a bag has messages on.

    A topic is taken as ground truth only if its name says so: a pose topic might as well be some
    localiser's answer. Of an image in raw and compressed form the raw one is taken.

    :param present: message type by topic name.
    :param source: the bag's name, for messages.
    :raises FileError: if a given topic is absent or of another type, or two would do.
    """
    for field in fields(BagTopics):
        name = getattr(wanted, field.name)
        if name is not None:
            _check_given(field.name, name, present, source)
    truth = {name for name in present if _says_truth(name)}
    odometry = {name for name, kind in present.items() if kind == ODOMETRY}
    image = wanted.image or _one(
        'image', _without_twins(_of_types('image', present)), present, source)
    return replace(
        wanted,
        image=image,
        camera_info=wanted.camera_info or _sibling_info(image, present),
        odom=wanted.odom or _one('odom', _plain_odometry(odometry - truth), present, source),
        ground_truth=wanted.ground_truth or _one(
            'ground_truth', _of_types('ground_truth', present) & truth, present, source),
    )


def list_topics(present: Mapping[str, str]) -> str:
    """The topics and their types, for a message."""
    return ', '.join(f'{name} ({kind})' for name, kind in sorted(present.items())) or 'no topic'


def _check_given(kind: str, name: str, present: Mapping[str, str], source: str) -> None:
    if name not in present:
        raise FileError(
            f'{source}: has no message on the {kind} topic {name!r}; it has '
            f'{list_topics(present)}.')
    if present[name] not in TYPES[kind]:
        raise FileError(
            f'{source}: the {kind} topic {name!r} is a {present[name]}; accepted are '
            f'{", ".join(TYPES[kind])}.')


def _of_types(kind: str, present: Mapping[str, str]) -> set[str]:
    return {name for name, message_type in present.items() if message_type in TYPES[kind]}


def _one(
    kind: str, names: set[str], present: Mapping[str, str], source: str,
) -> str | None:
    if len(names) > 1:
        found = list_topics({name: present[name] for name in names})
        raise FileError(f'{source}: several topics could be the {kind}: {found}; name one.')
    return next(iter(names), None)


def _says_truth(name: str) -> bool:
    words = name.lower().strip('/').split('/')
    return any(word in _TRUTH_WORDS or 'truth' in word for word in words)


def _without_twins(names: set[str]) -> set[str]:
    """Leave out `<image>/compressed` where `<image>` itself is there."""
    return {name for name in names if name.removesuffix('/compressed') not in names - {name}}


def _plain_odometry(names: set[str]) -> set[str]:
    """Prefer the one topic called odom; /odometry/filtered and its like are somebody's answer."""
    plain = {name for name in names if name.rsplit('/', 1)[-1] == 'odom'}
    return plain if len(plain) == 1 else names


def _sibling_info(image: str | None, present: Mapping[str, str]) -> str | None:
    """The camera_info beside the image; else the only one there is."""
    names = _of_types('camera_info', present)
    if image is not None:
        namespace = image.removesuffix('/compressed').rpartition('/')[0]
        if f'{namespace}/camera_info' in names:
            return f'{namespace}/camera_info'
    return next(iter(names)) if len(names) == 1 else None
