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
"""rosbags, or a sentence that says how to get it.

The node runs without rosbags (it has no rosdep key that a released package may depend on), so
only the bag tools ask for it.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

from nccs_pose.errors import FileError

try:
    from rosbags.highlevel import AnyReader
    from rosbags.interfaces import (
        Qos,
        QosDurability,
        QosHistory,
        QosLiveliness,
        QosReliability,
        QosTime,
    )
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import get_typestore, Stores
except ImportError as error:
    raise FileError(
        f'bags need the Python package rosbags (pip install "rosbags>=0.11"): {error}.') from error

__all__ = [
    'AnyReader', 'Qos', 'QosDurability', 'QosHistory', 'QosLiveliness', 'QosReliability',
    'QosTime', 'StoragePlugin', 'Writer', 'jazzy_typestore']


@lru_cache(maxsize=1)
def jazzy_typestore() -> Any:
    """The message definitions of ROS 2 Jazzy."""
    return get_typestore(Stores.ROS2_JAZZY)
