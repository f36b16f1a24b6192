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

"""Fixtures that every test may use."""

from __future__ import annotations

import os
from pathlib import Path

from hypothesis import HealthCheck, settings
import matplotlib
import pytest

matplotlib.use('Agg')

# The same examples on every run; a slow machine is no failure.
settings.register_profile(
    'nccs_pose', derandomize=True, deadline=None, max_examples=40,
    suppress_health_check=[HealthCheck.too_slow])
settings.load_profile('nccs_pose')

REPOSITORY = Path(__file__).resolve().parent.parent


@pytest.fixture(scope='session')
def repository() -> Path:
    """Root of the source tree."""
    return REPOSITORY


@pytest.fixture(scope='session')
def ray_traced() -> Path:
    """Folder of the ray-traced sequences, which are not shipped; without it tests skip."""
    folder = os.environ.get('NCCS_POSE_RAY_TRACED')
    if not folder:
        pytest.skip('the ray-traced sequences are not shipped; NCCS_POSE_RAY_TRACED names a copy')
    if not (Path(folder) / 'dev_clean').is_dir():
        pytest.fail(f'NCCS_POSE_RAY_TRACED: no sequence dev_clean in {folder!r}')
    return Path(folder)
