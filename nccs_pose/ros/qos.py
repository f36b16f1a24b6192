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

"""Quality of service of the node's topics, and how a user overrides it."""

from __future__ import annotations

from nccs_pose.ros.interface import Endpoint
from rcl_interfaces.msg import SetParametersResult
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions

MOST_KEPT = 100_000


def profile(endpoint: Endpoint) -> QoSProfile:
    """A profile of the endpoint's own.

    Always a fresh one: rclpy writes the overrides into the object that it is given, and the
    predefined profiles are shared by the whole process.
    """
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST, depth=endpoint.depth,
        reliability=(
            ReliabilityPolicy.RELIABLE if endpoint.reliable else ReliabilityPolicy.BEST_EFFORT))


def overridable() -> QoSOverridingOptions:
    """Let parameters `qos_overrides.<topic>.<publisher|subscription>.<policy>` override it."""
    return QoSOverridingOptions.with_default_policies(callback=_check)


def _check(qos: QoSProfile) -> SetParametersResult:
    """Refuse in words a depth of which the middleware only says that it failed."""
    good = 1 <= qos.depth <= MOST_KEPT
    return SetParametersResult(
        successful=good,
        reason='' if good else f'depth = {qos.depth}: must lie in [1, {MOST_KEPT}]')
