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

"""Where the package's own files (config, launch, bags) lie, installed or not."""

from __future__ import annotations

import os
from pathlib import Path
import sys

PACKAGE = 'nccs_pose'


def share_directory() -> Path:
    """Folder that holds config/ and launch/.

    The source tree when the code runs from one, the ament index when ROS is installed, the
    environment's share/ when pip installed the package.
    """
    source = Path(__file__).resolve().parents[2]
    if (source / 'package.xml').is_file():
        return source
    try:
        from ament_index_python.packages import get_package_share_directory

        return Path(get_package_share_directory(PACKAGE))
    except (ImportError, LookupError, OSError):  # no ROS; not in the index; no index at all
        return Path(sys.prefix) / 'share' / PACKAGE


def expanded(path: str) -> Path:
    """A path with `~` and `~user` filled in; where there is no such user it stays as it is."""
    return Path(os.path.expanduser(path))


def resolve(path: str) -> Path:
    """A file as the user meant it: as given if it is there, else below the share directory."""
    given = expanded(path)
    if given.is_absolute() or given.exists():
        return given
    shipped = share_directory() / given
    return shipped if shipped.exists() else given
