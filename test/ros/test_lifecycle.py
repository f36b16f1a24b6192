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

"""The managed node: transitions, refusals, signals."""

from __future__ import annotations

import os
import signal
import subprocess
import sys

import pytest

pytest.importorskip('rclpy', reason='ROS 2 is not available: no rclpy')

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from nccs_pose.ros.command_line import without_ros
from nccs_pose.ros.conversions import image_message
import numpy as np
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.utilities import remove_ros_args
from sensor_msgs.msg import CompressedImage, Image
from std_srvs.srv import SetBool, Trigger

ARENA = {'rig_file': 'config/arena_640_rig.yaml', 'map_file': 'config/arena_map.yaml'}
ROOM = {'rig_file': 'config/room_rig.yaml', 'map_file': 'config/room_map.yaml'}


def state(user, node: str = 'localiser') -> int:
    return user.call(GetState, f'/{node}/get_state', GetState.Request()).current_state.id


def change(user, transition: int, label: str = '', node: str = 'localiser') -> bool:
    request = ChangeState.Request(transition=Transition(id=transition, label=label))
    return user.call(ChangeState, f'/{node}/change_state', request).success


def test_full_cycle_and_transitions_that_are_not_allowed(world):
    node, user = world.localiser(autostart=False, **ROOM), world.user
    assert state(user) == State.PRIMARY_STATE_UNCONFIGURED
    # Not allowed here: answered, and nothing changes.
    for transition in (Transition.TRANSITION_ACTIVATE, Transition.TRANSITION_DEACTIVATE,
                       Transition.TRANSITION_CLEANUP, 99, 255):
        assert not change(user, transition), transition
    assert not change(user, 0, 'no such transition')
    assert state(user) == State.PRIMARY_STATE_UNCONFIGURED
    for _ in range(2):
        assert change(user, Transition.TRANSITION_CONFIGURE)
        assert not change(user, Transition.TRANSITION_CONFIGURE)
        assert change(user, Transition.TRANSITION_ACTIVATE)
        assert state(user) == State.PRIMARY_STATE_ACTIVE
        assert not change(user, Transition.TRANSITION_CONFIGURE)
        assert change(user, Transition.TRANSITION_DEACTIVATE)
        assert state(user) == State.PRIMARY_STATE_INACTIVE
        assert change(user, Transition.TRANSITION_CLEANUP)
        assert state(user) == State.PRIMARY_STATE_UNCONFIGURED
    assert change(user, Transition.TRANSITION_UNCONFIGURED_SHUTDOWN)
    assert state(user) == State.PRIMARY_STATE_FINALIZED
    assert not change(user, Transition.TRANSITION_CONFIGURE)
    assert node.stop(signal.SIGINT) == 0, node.output


def age(reports) -> str:
    """Age of the last pose in the last report."""
    values = reports[-1].status[0].values if reports else ()
    return next((v.value for v in values if v.key == 'age_s'), '')


@pytest.mark.parametrize('pair', [{'diagnostics_period': 0.05}], indirect=True)
def test_what_is_forgotten_has_no_age(pair, arena):
    reports, images = pair.listen(DiagnosticArray, '/diagnostics'), pair.publisher(
        Image, 'image', 1)
    images.publish(image_message(arena[0].stamp_ns, 'camera', arena[0].image))
    pair.wait(lambda: pair.node._tally.answered)
    pair.wait(lambda: age(reports) not in ('', 'nan'))
    pair.node.trigger_deactivate()
    pair.node.trigger_cleanup()
    pair.wait(lambda: age(reports) == 'nan')


@pytest.mark.parametrize('relocalised', [False, True])
def test_where_the_stamps_begin_anew_what_was_before_is_forgotten(
        pair, arena, monkeypatch, relocalised):
    forgotten: list[int] = []
    monkeypatch.setattr(
        pair.node._parts.outputs.transforms, 'forget', lambda: forgotten.append(
            pair.node._tally.answered))
    pair.node.trigger_deactivate()
    pair.node.trigger_activate()
    assert forgotten == [0]
    image = arena[0].image
    pair.node._on_frame(30_000_000_000, 'camera', image)
    assert pair.node._latest.pose_stamp_ns == 30_000_000_000
    if relocalised:
        pair.node._on_relocalise(Trigger.Request(), Trigger.Response())
    pair.node._on_frame(5_000_000_000, 'camera', np.zeros_like(image))
    assert pair.node._latest.pose_stamp_ns is None
    pair.node._on_frame(5_100_000_000, 'camera', image)
    # Before what the new time says is broadcast.
    assert forgotten == [0, 1]
    assert pair.node._tally.resets == 1


@pytest.mark.parametrize('pair', [{'diagnostics_period': 0.05}], indirect=True)
def test_a_shutdown_that_fails_says_so_and_forgets_everything_all_the_same(
        pair, monkeypatch, capfd):
    def full() -> None:
        raise OSError('the disk is full')

    reports = pair.listen(DiagnosticArray, '/diagnostics')
    monkeypatch.setattr(pair.node._parts.keeper, 'save', full)
    pair.node.trigger_shutdown()
    pair.wait(lambda: reports
              and reports[-1].status[0].message == 'shutdown failed: OSError: the disk is full')
    assert pair.node._parts is None
    assert 'shutdown done' not in capfd.readouterr().err


def test_a_shutdown_is_said_once(pair, capfd):
    pair.node.trigger_shutdown()
    assert capfd.readouterr().err.count('shutdown done') == 1


BAD_CONFIGURATIONS = [
    ({'map_file': 'nowhere/map.yaml'}, 'nowhere/map.yaml'),
    ({'rig_file': 'config/room_map.yaml'}, 'room_map.yaml'),
    ({'rig_file': None}, 'rig_file is not set'),
    ({'map_frame': 'moon'}, "map_frame = 'moon', but config/room_map.yaml has frame: map"),
    ({'tf_mode': 'map_to_moon'}, 'tf_mode'),
    ({'camera_info_tolerance': 7.5}, 'camera_info_tolerance'),
    ({'silence_warning': 'soon'}, 'silence_warning'),
]


def test_bad_configuration_fails_with_the_reason_and_the_node_lives(world):
    user = world.user
    nodes = [world.localiser('-r', f'__ns:=/n{k}', **{**ROOM, **changed})
             for k, (changed, _) in enumerate(BAD_CONFIGURATIONS)]
    for k, (node, (_, words)) in enumerate(zip(nodes, BAD_CONFIGURATIONS)):
        name = f'n{k}/localiser'
        status = user.wait(lambda n=name: user.statuses.get(f'{n}: pose'))
        assert status, node.output
        assert words in status.message
        assert status.level == b'\x02'
        assert words in node.output
        assert state(user, name) == State.PRIMARY_STATE_UNCONFIGURED
        assert not change(user, Transition.TRANSITION_CONFIGURE, node=name)
        relocalise = user.call(Trigger, f'/{name}/relocalise', Trigger.Request())
        assert not relocalise.success
        assert node.stop(signal.SIGTERM) == 0, node.output


def test_a_parameter_file_that_names_another_node_is_suspected(world):
    # The shipped files name the localiser, in any namespace.
    node = world.localiser('--params-file', 'config/room.yaml', '-r', '__node:=eye')
    status = world.user.wait(lambda: world.user.statuses.get('eye: pose'))
    assert status, node.output
    assert status.message.endswith(
        'rig_file is not set; a parameter file has to name this node, /eye, or /**')


def test_transforms_without_tf2_ros_fail_with_the_reason(world):
    try:
        import tf2_ros  # noqa: F401
    except ImportError:
        pass
    else:
        pytest.skip('tf2_ros is installed')
    node, user = world.localiser(tf_mode='map_to_base', **ROOM), world.user
    assert user.wait(lambda: 'tf2_ros' in user.value('localiser: pose', 'reason'))
    assert node.running()


@pytest.mark.parametrize('how', [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_signals_end_the_node_that_works_on_images(world, arena, how):
    node, user = world.localiser(**ARENA), world.user
    images = user.publisher(Image, 'image')
    messages = [image_message(s.stamp_ns, 'camera', s.image) for s in arena]
    user.show(images, messages[0])
    for message in messages[1:]:
        images.publish(message)
    assert node.stop(how) == 0, node.output
    assert 'Traceback' not in node.output


@pytest.mark.parametrize('how', [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_signals_end_the_node_while_it_starts(world, how):
    caught = [world.localiser(**ROOM) for _ in range(3)]
    # From the program's first line on; among the imports; somewhere before it is active.
    for node, pause in zip(caught, (0.0, 0.3, 1.0)):
        # Python itself catches SIGINT even earlier, while it cannot yet handle it.
        assert world.user.wait(lambda n=node: n.catches(signal.SIGTERM)), node.output
        world.user.spin(pause)
        assert node.stop(how) == 0, node.output
        assert 'Traceback' not in node.output


@pytest.mark.parametrize('how', ['SIGINT', 'SIGTERM', 'SIGHUP'])
def test_a_signal_is_noted_and_ros_stays_up_until_it_is_left(how):
    program = f"""
import os, signal, time
from nccs_pose.ros.start import initialise, leave, told_to_end
import rclpy
initialise([])
assert rclpy.ok() and not told_to_end()
for _ in range(3):
    os.kill(os.getpid(), signal.{how})
    time.sleep(0.2)  # for a thread of ROS that would shut it down
assert rclpy.ok() and told_to_end()
leave()
assert not rclpy.ok()
"""
    end = subprocess.run([sys.executable, '-c', program], capture_output=True, text=True)
    assert end.returncode == 0, end.stderr


@pytest.mark.parametrize('module', ['localiser', 'stand_in_camera', 'player'])
def test_without_a_home_it_starts_all_the_same(world, module):
    arguments = {'player': ['bags/room', '--loop']}.get(module, [])
    node = world.start(module, *arguments, ROS_LOG_DIR='', HOME='', TMPDIR=str(world.folder))
    assert world.user.wait(
        lambda: [*world.folder.glob(f'ros_log_{os.getuid()}/*')] or not node.running())
    assert node.running(), node.output
    assert 'cannot start' not in node.output


def test_silence_is_said_with_the_topic_and_the_reason(world):
    reliability = 'qos_overrides./front/image.subscription.reliability'
    node = world.localiser(
        '-r', 'image:=/front/image', '-p', f'{reliability}:=reliable', silence_warning=0.5, **ROOM)
    user = world.user

    def said(words: str) -> bool:
        return words in getattr(user.statuses.get('localiser: images'), 'message', '')

    # That images come is not said before one has.
    assert user.wait(lambda: 'localiser: images' in user.statuses), node.output
    assert said('no image yet on /front/image') or said('nothing publishes /front/image')
    assert user.wait(lambda: said('nothing publishes /front/image')), node.output
    assert 'nothing publishes /front/image' in node.output
    compressed = user.node.create_publisher(CompressedImage, '/front/image', 1)
    assert user.wait(lambda: said(
        '/front/image is published as sensor_msgs/msg/CompressedImage, but is subscribed as '
        'sensor_msgs/msg/Image')), node.output
    user.node.destroy_publisher(compressed)
    assert user.wait(lambda: said('nothing publishes /front/image')), node.output
    user.node.create_publisher(
        Image, '/front/image', QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT))
    assert user.wait(lambda: said(f'set {reliability}')), node.output
    # Another that it can hear cures that: the next silence has another reason.
    images = user.publisher(Image, '/front/image')
    images.publish(Image())
    assert user.wait(lambda: user.count('frames_received') == 1), node.output
    assert user.wait(lambda: said('no image came for a while')), node.output


@pytest.mark.parametrize('pair', [{'diagnostics_period': 0.05}], indirect=True)
def test_another_publisher_of_the_pose_is_noticed(pair, capfd):
    reports = pair.listen(DiagnosticArray, '/diagnostics')

    def warned() -> bool:
        """Whether the last report says it."""
        status = reports[-1].status[0]
        return '/pose has 1 other publisher:' in status.message and status.level > b'\0'

    pair.wait(lambda: reports)
    assert not warned()
    other = pair.user.create_publisher(PoseWithCovarianceStamped, 'pose', 1)
    pair.wait(warned)
    said = len(reports)
    pair.wait(lambda: len(reports) > said + 3)
    assert capfd.readouterr().err.count('/pose has 1 other publisher') == 1
    pair.user.destroy_publisher(other)
    pair.wait(lambda: not warned())


def test_paused_it_uses_no_image_and_says_so(world, arena):
    world.localiser(**ARENA)
    user = world.user
    images = user.publisher(Image, 'image')
    messages = [image_message(s.stamp_ns, 'camera', s.image) for s in arena]
    assert user.call(SetBool, '/localiser/set_paused', SetBool.Request(data=True)).success
    assert user.wait(lambda: user.value('localiser: pose', 'reason') == 'paused')
    user.show(images, *messages[:2])
    assert user.count('frames_answered') == 0
    assert user.call(SetBool, '/localiser/set_paused', SetBool.Request(data=False)).success
    assert user.wait(lambda: user.value('localiser: pose', 'reason') != 'paused')
    user.show(images, *messages[2:5])
    assert user.count('frames_answered') > 0


@pytest.mark.parametrize('module', [
    'localiser', 'stand_in_camera', 'player', 'demo', 'stream_benchmark'])
def test_help_is_printed_and_nothing_is_started(world, module):
    node = world.start(module, '--help', '--ros-args', '-r', '__node:=other')
    assert node.wait() == 0, node.output
    assert node.output.startswith('usage: ')


@pytest.mark.parametrize(('module', 'parameter'), [
    ('localiser', '  noise_gate (4.5)'), ('stand_in_camera', '  rate (5.0 Hz)')])
def test_the_help_of_a_node_has_its_parameters_and_no_other_argument_is_taken(
        world, module, parameter):
    helped, wrong = world.start(module, '-h'), world.start(module, '--hlep')
    assert helped.wait() == 0
    assert parameter in helped.output
    assert wrong.wait() == 2
    assert 'unrecognized arguments: --hlep' in wrong.output


@pytest.mark.parametrize(('arguments', 'own'), [
    (['--ros-args', '-p', 'a:=1'], []), (['x', '--ros-args', '-p', 'a:=1', '--', 'y'], ['x', 'y']),
    (['--ros-args', '--ros-args', '--', '--help', '--ros-args'], ['--help'])])
def test_the_arguments_of_ros_are_left_to_it(arguments, own):
    assert without_ros(arguments) == own == remove_ros_args(['name', *arguments])[1:]


@pytest.mark.parametrize('arguments', [
    ('--params-file', 'nowhere.yaml'), ('--no-such-option',), ('-r', '3:4:5')])
def test_ros_arguments_that_cannot_be_read_are_said_in_a_sentence(world, arguments):
    node = world.start('localiser', '--ros-args', *arguments)
    assert node.wait() == 2
    assert 'cannot start: ' in node.output
    assert 'Traceback' not in node.output
