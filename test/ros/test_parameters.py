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

"""Parameters over DDS: described, checked, changed live."""

from __future__ import annotations

import pytest

pytest.importorskip('rclpy', reason='ROS 2 is not available: no rclpy')

from nccs_pose.ros.interface import OUTPUTS
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import (
    DescribeParameters,
    GetParameters,
    ListParameters,
    SetParameters,
    SetParametersAtomically,
)
from rclpy.lifecycle import TransitionCallbackReturn

ROOM = {'rig_file': 'config/room_rig.yaml', 'map_file': 'config/room_map.yaml'}


def number(name: str, value: float) -> Parameter:
    return Parameter(name=name, value=ParameterValue(
        type=ParameterType.PARAMETER_DOUBLE, double_value=value))


def integer(name: str, value: int) -> Parameter:
    return Parameter(name=name, value=ParameterValue(
        type=ParameterType.PARAMETER_INTEGER, integer_value=value))


def text(name: str, value: str) -> Parameter:
    return Parameter(name=name, value=ParameterValue(
        type=ParameterType.PARAMETER_STRING, string_value=value))


def read(user, *names: str):
    answer = user.call(
        GetParameters, '/localiser/get_parameters', GetParameters.Request(names=names))
    return answer.values


def set_each(user, *parameters: Parameter):
    return user.call(SetParameters, '/localiser/set_parameters',
                     SetParameters.Request(parameters=parameters)).results


def test_parameters_are_described_checked_and_changed(world):
    node, user = world.localiser(camera_info_tolerance=0, **ROOM), world.user
    names = user.call(
        ListParameters, '/localiser/list_parameters', ListParameters.Request()).result.names
    described = user.call(
        DescribeParameters, '/localiser/describe_parameters',
        DescribeParameters.Request(names=names)).descriptors
    ours = [d for d in described if not d.name.startswith(('qos_overrides', 'use_sim_time'))
            and 'type_description' not in d.name]
    assert len(ours) > 20
    assert all(len(d.description) > 10 for d in ours)
    by_name = {d.name: d for d in ours}
    assert by_name['rig_file'].read_only
    assert not by_name['camera_info_tolerance'].read_only
    assert by_name['camera_info_tolerance'].floating_point_range[0].to_value == 1.0
    assert any(name.endswith('image.subscription.reliability') for name in names)

    # An int in YAML or on the command line is meant as a number.
    assert read(user, 'camera_info_tolerance')[0].double_value == 0.0
    good, as_int, range_, kind, read_only, unknown = set_each(
        user, number('camera_info_tolerance', 0.1), integer('transform_tolerance', 1),
        number('camera_info_tolerance', 3.0), text('camera_info_tolerance', 'much'),
        text('rig_file', 'other.yaml'), number('no_such_parameter', 1.0))
    assert good.successful
    assert as_int.successful, as_int.reason
    for refused in (range_, kind, read_only, unknown):
        assert not refused.successful
        assert refused.reason
    choice, = set_each(user, text('camera_info_check', 'perhaps'))
    assert not choice.successful
    assert 'refuse, warn, off' in choice.reason
    values = read(user, 'camera_info_tolerance', 'transform_tolerance', 'rig_file')
    assert values[0].double_value == 0.1
    assert values[1].double_value == 1.0
    assert values[2].string_value == ROOM['rig_file']

    # All or nothing.
    result = user.call(
        SetParametersAtomically, '/localiser/set_parameters_atomically',
        SetParametersAtomically.Request(parameters=[
            number('camera_info_tolerance', 0.5), number('transform_tolerance', -1.0)])).result
    assert not result.successful
    assert 'transform_tolerance' in result.reason
    assert read(user, 'camera_info_tolerance')[0].double_value == 0.1
    assert node.running()


@pytest.mark.parametrize('name', ['use_sim_time', 'start_type_description_service'])
def test_a_parameter_of_rclpy_itself_of_another_type_is_named(world, name):
    node = world.localiser('-p', f'{name}:=1', **ROOM)
    assert node.wait() == 2
    assert f"cannot start: Trying to set parameter '{name}' to '1'" in node.output
    assert 'Traceback' not in node.output


@pytest.mark.parametrize(('topic', 'end', 'state'), [
    ('/odom', 'subscription', 'inactive'), ('/diagnostics', 'publisher', 'unconfigured')])
def test_an_impossible_depth_is_named(world, topic, end, state):
    user = world.user
    node = world.localiser('-p', f'qos_overrides.{topic}.{end}.depth:=-1', **ROOM)
    assert user.wait(lambda: user.value('localiser: pose', 'lifecycle') == state), node.output
    assert topic in node.output
    assert 'depth = -1: must lie in' in user.value('localiser: pose', 'reason')


@pytest.mark.parametrize('pair', [
    {'autostart': False, f'qos_overrides./{topic}.{end}.depth': -1} for topic, end in (
        ('localiser/markers', 'publisher'), ('initialpose', 'subscription'))], indirect=True)
def test_a_transition_that_fails_leaves_no_topic_behind(pair):
    def topics() -> list[str]:
        used = [*pair.node.publishers, *pair.node.subscriptions]
        return sorted(each.topic_name for each in used)

    before = topics()
    for _ in range(2):
        inactive = pair.node.trigger_configure() == TransitionCallbackReturn.SUCCESS
        if inactive:
            pair.node.trigger_activate()
        assert 'depth = -1' in pair.node._problem()
        if inactive:
            pair.node.trigger_cleanup()
        assert topics() == before


@pytest.mark.parametrize('pair', [
    {'map_frame': '', 'qos_overrides./diagnostics.publisher.depth': 7}], indirect=True)
def test_a_parameter_that_does_not_fit_is_the_only_one_refused(pair):
    assert pair.node._problem() == (
        "configuration failed: map_frame = '': a frame is not empty and has no leading /")
    assert pair.node._diagnostics.qos_profile.depth == 7
    pair.set(use_sim_time=True)


@pytest.mark.parametrize('override', ['depth:=0', 'depth:=deep', 'reliability:=perhaps'])
def test_an_impossible_override_ends_the_stand_in_camera_with_a_sentence(world, override):
    camera = world.start(
        'stand_in_camera', '--ros-args', '-p', f'qos_overrides./odom.publisher.{override}')
    assert camera.wait() == 2
    assert override.partition(':=')[0] in camera.output
    assert 'Traceback' not in camera.output


def test_unknown_parameter_is_named_with_the_one_meant(world):
    misspelt = 'qos_overrides./image.subscription.reliabilty'
    node, user = world.localiser('-p', f'{misspelt}:=reliable', map_fil='x', **ROOM), world.user
    assert user.wait(lambda: user.value('localiser: pose', 'lifecycle') == 'active')
    assert 'parameter map_fil is unknown and has no effect; did you mean map_file?' in node.output
    assert f'parameter {misspelt} has no effect' in node.output


@pytest.mark.parametrize('pair', [{
    f'qos_overrides.{topic}.publisher.depth': 7
    for topic in ('/pose', '/diagnostics', '/localiser/debug_image', '/localiser/markers')
}], indirect=True)
def test_every_published_topic_can_be_of_another_quality(pair, capfd):
    ours = {p.topic_name: p.qos_profile for p in pair.node.publishers}
    for endpoint in OUTPUTS:
        topic = pair.node.resolve_topic_name(endpoint.name)
        assert ours[topic].depth == 7, topic
    assert 'has no effect' not in capfd.readouterr().err
