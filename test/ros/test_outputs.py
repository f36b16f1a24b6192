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

"""What is computed only for somebody, and what is drawn."""

from __future__ import annotations

import re

import pytest

pytest.importorskip('rclpy', reason='ROS 2 is not available: no rclpy')

from diagnostic_msgs.msg import DiagnosticStatus
from nccs_pose.calibration.monitor import Condition, Verdict
from nccs_pose.estimation.estimate import Estimate, State
from nccs_pose.estimation.options import LocaliserOptions
from nccs_pose.geometry.pose import Pose2
from nccs_pose.node_options import NodeOptions
from nccs_pose.ros import calibration_watch, diagnostics
from nccs_pose.ros import outputs as outputs_module
from nccs_pose.ros.conversions import decode
from nccs_pose.ros.markers import ELLIPSE_SIGMAS, marker_array
from nccs_pose.ros.outputs import Outputs
from nccs_pose.ros.statuses import STATUSES
from nccs_pose.simulation.scene import arena_map, arena_rig
from nccs_pose.vision.line_points import LinePoints
import numpy as np
from visualization_msgs.msg import Marker


class Publisher:
    """Remembers what was published, and has as many subscribers as it is told."""

    def __init__(self) -> None:
        self.subscribers = 0
        self.messages: list[object] = []
        self.publish = self.messages.append

    def get_subscription_count(self) -> int:
        return self.subscribers


class Node:
    """Makes such publishers by topic."""

    def __init__(self) -> None:
        self.publishers: dict[str, Publisher] = {}

    def create_publisher(self, kind: type, topic: str, *_: object, **__: object) -> Publisher:
        return self.publishers.setdefault(topic, Publisher())


RIG, MAP = arena_rig().scaled(0.25), arena_map()
IMAGE = np.full((240, 320, 3), 90, np.uint8)
COVARIANCE = np.diag([4e-4, 1e-4, 1e-5])
TRACKING = Estimate(
    7, State.TRACKING, 'the pose explains the image', Pose2(0.1, 0.2, 0.3), COVARIANCE)
LOST = Estimate(8, State.LOST, 'no line-like strip in the image')


def made() -> tuple[Outputs, dict[str, Publisher]]:
    node = Node()
    return Outputs(node, NodeOptions, RIG, MAP, lambda *_: None), node.publishers


def test_nothing_is_drawn_while_nobody_subscribes(monkeypatch: pytest.MonkeyPatch):
    def never(*_: object) -> None:
        raise AssertionError('computed for nobody')

    monkeypatch.setattr(outputs_module, 'draw_debug_image', never)
    monkeypatch.setattr(outputs_module, 'marker_array', never)
    outputs, publishers = made()
    outputs.draw(TRACKING, 'camera', IMAGE, LocaliserOptions())
    assert outputs.publish(TRACKING)
    assert len(publishers['pose'].messages) == 1


def test_no_pose_leaves_when_there_is_none():
    outputs, publishers = made()
    assert not outputs.publish(LOST)
    assert publishers['pose'].messages == []


def test_debug_image_shows_the_mask_and_leaves_the_image_alone():
    outputs, publishers = made()
    debug = publishers['~/debug_image']
    debug.subscribers = 1
    image = IMAGE.copy()
    image[150:156, 40:280] = (40, 170, 40)  # a green strip
    before = image.copy()
    outputs.draw(LOST, 'camera', image, LocaliserOptions())
    np.testing.assert_array_equal(image, before)
    (message,) = debug.messages
    assert (message.header.frame_id, message.header.stamp.nanosec) == ('camera', 8)
    drawn = decode(message)[153, 60:260].astype(int)
    # Cyan on the strip: blue and green have risen over red.
    assert (drawn[:, 0] > drawn[:, 2] + 40).all()


def test_markers_lie_in_the_map():
    pixels = np.array([[120.0, 120.0], [90.0, 150.0]])
    seen = Estimate(7, State.TRACKING, '', TRACKING.pose, COVARIANCE, points=LinePoints(
        pixels, np.ones(2), np.zeros(2, dtype=int)))
    lines, points, arrow, ellipse = marker_array('map', seen, RIG, MAP).markers
    ends = np.array([[p.x, p.y] for p in lines.points]).reshape(len(MAP), 2, 2)
    np.testing.assert_allclose(ends[:, 0], [line.start[:2] for line in MAP])
    # A point that is drawn on the floor projects to where it was seen.
    on_floor = np.array([[p.x, p.y, 0.0] for p in points.points])
    back, visible = RIG.project(seen.pose.inverse().apply(on_floor))
    assert visible.all()
    np.testing.assert_allclose(back, pixels, atol=1e-3)
    assert (arrow.pose.position.x, arrow.pose.position.y) == (0.1, 0.2)
    axes = sorted([ellipse.scale.x, ellipse.scale.y])
    np.testing.assert_allclose(axes, [2 * ELLIPSE_SIGMAS * 0.01, 2 * ELLIPSE_SIGMAS * 0.02])
    gone = marker_array('map', LOST, RIG, MAP).markers
    assert [m.action for m in gone] == [Marker.ADD, *[Marker.DELETE] * 3]


@pytest.mark.parametrize('part', ['pose', 'images', 'time', 'calibration'])
def test_every_value_of_the_diagnostics_is_in_the_reference(part: str):
    tally = diagnostics.Tally()
    tally.refuse('image_size', 'small')
    tally.fail('module.function', RuntimeError('a mistake'))
    shown = {
        'pose': diagnostics.pose_status('n', 'active', '', '', TRACKING, 0.1, 0.1),
        'images': diagnostics.image_status('n', '/image', 1, tally, '', 0, 0),
        'time': diagnostics.time_status('n', TRACKING, 0.1, 0.1),
        'calibration': calibration_watch.CalibrationWatch(RIG, MAP).status('n')}[part]
    published = [re.sub(r'(refused|error)\..*', r'\1.*', value.key) for value in shown.values]
    (documented,) = ([value.key for value in s.values] for s in STATUSES if s.part == part)
    assert shown.name == f'n: {part}'
    assert sorted(published) == sorted(documented)


class Monitor:
    """A calibration monitor with a mind made up."""

    def __init__(self, rig: object, line_map: object) -> None:
        self.seen: list[int] = []
        self.condition = Condition.GOOD

    def add(self, estimate: Estimate) -> None:
        self.seen.append(estimate.stamp_ns)

    def verdict(self) -> Verdict:
        words = 'residuals suggest the mirror moved by about 0.3 mm'
        return Verdict(self.condition, words, 40, 90.0, 30.0, 0.02)


def test_calibration_is_watched_now_and_then_and_a_suspicion_is_a_warning(
        monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(calibration_watch, 'CalibrationMonitor', Monitor)
    watch = calibration_watch.CalibrationWatch(RIG, MAP)
    for k in range(31):  # a second at 30 Hz
        watch.look(Estimate(10**12 + k * 33_333_334, State.TRACKING, ''))
    watch.look(Estimate(5, State.LOST, 'the clock was set back'))
    monitor = watch._monitor
    assert len(monitor.seen) == 7
    assert min(np.diff(monitor.seen[:-1])) >= calibration_watch.PERIOD_NS
    assert watch.status('localiser').level == DiagnosticStatus.OK
    monitor.condition = Condition.UNKNOWN
    values = {v.key: v.value for v in watch.status('localiser').values}
    assert values['statistic'] == values['limit'] == values['pose_error_m'] == 'nan'
    monitor.condition = Condition.SUSPECT
    status = watch.status('localiser')
    assert (status.name, status.level) == ('localiser: calibration', DiagnosticStatus.WARN)
    assert 'the mirror moved by about 0.3 mm' in status.message
    assert {v.key: v.value for v in status.values}['pose_error_m'] == '0.02'
