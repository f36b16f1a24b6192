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

"""The node `localiser`: images in, pose with covariance out; a managed node.

Everything is decided elsewhere: the core estimates, the modules beside this one convert; here the
parts are wired to the lifecycle.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
import gc
import math
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from nccs_pose.errors import NccsPoseError, OptionError
from nccs_pose.estimation.estimate import Estimate
from nccs_pose.estimation.localiser import Localiser
from nccs_pose.estimation.options import LocaliserOptions
from nccs_pose.files.resources import resolve
from nccs_pose.files.yaml_files import load_map, load_rig
from nccs_pose.geometry.rig import Rig
from nccs_pose.node_options import NodeOptions
from nccs_pose.ros import diagnostics
from nccs_pose.ros.calibration_watch import CalibrationWatch
from nccs_pose.ros.image_stream import ImageStream
from nccs_pose.ros.inputs import Inputs
from nccs_pose.ros.interface import DIAGNOSTICS, RELOCALISE, SET_PAUSED
from nccs_pose.ros.lifecycle import answer_every_request, in_words
from nccs_pose.ros.outputs import Outputs
from nccs_pose.ros.parameters import NodeParameters
from nccs_pose.ros.pose_keeper import PoseKeeper
from nccs_pose.ros.qos import overridable, profile
import numpy as np
from numpy.typing import NDArray
from rclpy.clock import Clock, ClockType
from rclpy.exceptions import InvalidHandle
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.publisher import Publisher
from std_srvs.srv import SetBool, Trigger

TRANSFORM_RETRY_PERIOD = 0.02


@dataclass(frozen=True, eq=False)
class _Parts:
    """What a configuration makes, and cleaning up forgets."""

    rig: Rig
    localiser: Localiser
    keeper: PoseKeeper
    watch: CalibrationWatch
    outputs: Outputs


@dataclass(frozen=True, eq=False)
class _Latest:
    """What the images since the activation came to.

    :ivar estimate: of the last one; None before any, and once a user has had it forgotten.
    :ivar image_stamp_ns: of the last one.
    :ivar pose_stamp_ns: of the last one whose pose was published.
    :ivar latency_s: from the last one's arrival until it was answered, seconds.
    """

    estimate: Estimate | None = None
    image_stamp_ns: int | None = None
    pose_stamp_ns: int | None = None
    latency_s: float = 0.0


class LocaliserNode(LifecycleNode):
    """Wires topics, services and parameters to a Localiser."""

    def __init__(self, **node_arguments: Any) -> None:
        super().__init__('localiser', **node_arguments)
        answer_every_request(self)
        self._tally = diagnostics.Tally()
        self._parts: _Parts | None = None
        self._inputs: Inputs | None = None
        self._stream: ImageStream | None = None
        self._latest = _Latest()
        self._paused = False
        self._configuration_problem = ''
        self._shown: tuple[Any, ...] = ()
        self._reported = (0, 0)
        self._options = NodeOptions()
        self._settings = NodeParameters(
            self, (NodeOptions, LocaliserOptions), self._on_live_change)
        self._diagnostics = self._create_diagnostics()
        self.create_service(Trigger, RELOCALISE.name, self._on_relocalise)
        self.create_service(SetBool, SET_PAUSED.name, self._on_set_paused)
        # Steady time: reports come also before the first /clock and while a bag is paused.
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(
            self.get_parameter('diagnostics_period').value, self._on_period, clock=self._steady)
        self._retry_timer = self.create_timer(
            TRANSFORM_RETRY_PERIOD, self._on_retry, clock=self._steady, autostart=False)

    def _create_diagnostics(self) -> Publisher:
        try:
            return self.create_publisher(
                DiagnosticArray, DIAGNOSTICS.name, profile(DIAGNOSTICS),
                qos_overriding_options=overridable())
        except Exception as error:  # rclpy raises what the value led to
            # Said where it can be heard: the configuration fails with it.
            self._settings.refused[DIAGNOSTICS.name] = in_words(error)
            return self.create_publisher(DiagnosticArray, DIAGNOSTICS.name, profile(DIAGNOSTICS))

    # Lifecycle

    def autostart(self) -> None:
        """Configure and activate, if the parameter says so."""
        if (self.get_parameter('autostart').value
                and self.trigger_configure() == TransitionCallbackReturn.SUCCESS):
            self.trigger_activate()

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Load and check rig, map and parameters."""
        return self._attempt('configuration', self._configure, self._clean_up)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Start to listen."""
        return self._attempt('activation', self._activate, self._deactivate)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop listening; the last good pose is saved."""
        return self._attempt('deactivation', self._deactivate)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Forget rig, map and pose."""
        return self._attempt('cleaning up', self._clean_up)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop and forget everything."""
        return self._attempt('shutdown', self._shut_down)

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Return to unconfigured, from where it can be tried again."""
        self._deactivate()
        self._clean_up()
        return TransitionCallbackReturn.SUCCESS

    def _attempt(
        self, what: str, step: Callable[[], None], undo: Callable[[], None] | None = None,
    ) -> TransitionCallbackReturn:
        """Take a step, or say why not; `undo` leaves nothing half made behind one that failed."""
        try:
            step()
        except Exception as error:
            words = str(error) if isinstance(error, NccsPoseError) else in_words(error)
            self._configuration_problem = f'{what} failed: {words}'
            self.get_logger().error(self._configuration_problem)
            if undo is not None:
                undo()
            return TransitionCallbackReturn.FAILURE
        self._configuration_problem = ''
        self.get_logger().info(f'{what} done')
        return TransitionCallbackReturn.SUCCESS

    def _configure(self) -> None:
        self._options, estimator = self._settings.options()
        for name in ('rig_file', 'map_file'):
            if not getattr(self._options, name):
                raise OptionError(
                    f'parameter {name} is not set; a parameter file has to name this node, '
                    f'{self.get_fully_qualified_name()}, or /**')
        rig = load_rig(resolve(self._options.rig_file))
        line_map = load_map(resolve(self._options.map_file))
        if line_map.frame != self._options.map_frame:
            raise OptionError(
                f'map_frame = {self._options.map_frame!r}, but {self._options.map_file} has '
                f'frame: {line_map.frame}')
        self._parts = _Parts(
            rig, Localiser(rig, line_map, estimator),
            PoseKeeper(self._options, line_map, self.get_logger()),
            CalibrationWatch(rig, line_map),
            # The last: nothing is left on the graph where another cannot be made.
            Outputs(self, lambda: self._options, rig, line_map, self._refuse))

    def _activate(self) -> None:
        assert self._parts is not None
        parts, self._latest = self._parts, _Latest()
        parts.localiser.reset()
        parts.outputs.transforms.forget()
        parts.keeper.offer(parts.localiser)
        self._inputs = Inputs(
            self, lambda: self._options, parts.rig.camera, parts.localiser, parts.keeper,
            self._refuse, self._report_diagnostics)
        self._stream = ImageStream(
            self, self._options.image_transport, self._tally, self._on_frame,
            self._report_diagnostics)
        if self._options.tf_mode == 'map_to_odom':
            self._retry_timer.reset()
        self._settings.warn_of_unused()

    def _deactivate(self) -> None:
        self._retry_timer.cancel()
        if self._stream is not None:
            self._stream.close()
            self._stream = None
        if self._inputs is not None:
            self._inputs.close()
            self._inputs = None
        if self._parts is not None:
            self._parts.keeper.save()

    def _clean_up(self) -> None:
        if self._parts is not None:
            self._parts.outputs.close()
        self._parts, self._latest = None, _Latest()

    def _shut_down(self) -> None:
        try:
            self._deactivate()
        finally:
            self._clean_up()

    # Input

    def _on_frame(self, stamp_ns: int, frame_id: str, image: NDArray[np.uint8]) -> None:
        assert self._parts is not None and self._inputs is not None
        assert self._stream is not None
        if self._paused:
            return
        localiser, outputs, before = self._parts.localiser, self._parts.outputs, self._latest
        self._inputs.use_waiting_odometry()
        estimate = localiser.process(stamp_ns, image)
        self._latest = replace(before, estimate=estimate, image_stamp_ns=stamp_ns)
        if before.image_stamp_ns is not None and stamp_ns < before.image_stamp_ns:
            back = 1e-9 * (before.image_stamp_ns - stamp_ns)
            self._tally.resets += 1
            outputs.transforms.forget()
            self._latest = replace(self._latest, pose_stamp_ns=None)
            self.get_logger().warning(
                f'the stamps jumped back by {back:.3f} s: the tracker starts anew')
        if not self._withheld() and outputs.publish(estimate):
            self._tally.answered += 1
            self._latest = replace(self._latest, pose_stamp_ns=stamp_ns)
            self._parts.keeper.remember(estimate)
        self._latest = replace(
            self._latest, latency_s=time.monotonic() - self._stream.arrived)
        outputs.draw(estimate, frame_id, image, localiser.options)
        self._parts.watch.look(estimate)
        if self._shown != self._summary():
            self._report_diagnostics()

    def _on_relocalise(
        self, request: Trigger.Request, response: Trigger.Response,
    ) -> Trigger.Response:
        if self._parts is None:
            response.success, response.message = False, 'the node is not configured'
            return response
        self._parts.localiser.relocalise()
        # What the last image said is forgotten.
        self._latest = replace(self._latest, estimate=None)
        self._report_diagnostics()
        response.success, response.message = True, 'searching everywhere from the next image on'
        return response

    def _on_set_paused(
        self, request: SetBool.Request, response: SetBool.Response,
    ) -> SetBool.Response:
        self._paused = bool(request.data)
        response.success, response.message = True, 'paused' if self._paused else 'running'
        self._report_diagnostics()
        return response

    def _on_live_change(self, options: NodeOptions, estimator: LocaliserOptions) -> None:
        self._options = options
        if self._parts is not None:
            self._parts.localiser.update_options(estimator)

    def _refuse(self, cause: str, words: str) -> None:
        self._tally.refuse(cause, words)
        self.get_logger().warning(f'refused ({cause}): {words}', throttle_duration_sec=5.0)

    # Reports

    def report(self, name: str, error: BaseException) -> None:
        """Take note of an exception that a callback let out; the node lives on."""
        self._tally.fail(name, error)
        self.get_logger().error(
            f'error in {name}: {in_words(error)}', throttle_duration_sec=5.0)

    def close(self) -> None:
        """Save the pose and stop, whatever state the node is in."""
        self._deactivate()

    def _withheld(self) -> str:
        """Why no pose may leave, whatever the estimator says; empty if it may."""
        if self._inputs is not None and self._options.camera_info_check == 'refuse':
            return self._inputs.camera_problem
        return ''

    def _problem(self) -> str:
        if self._configuration_problem:
            return self._configuration_problem
        return 'paused' if self._paused else self._withheld()

    def _odometry_lag(self) -> float:
        """Of the last sample of odometry behind the last image, s; NaN without either."""
        if self._parts is None or self._latest.estimate is None:
            return math.nan
        last_ns = self._parts.localiser.last_odometry_ns
        return (math.nan if last_ns is None
                else 1e-9 * (self._latest.estimate.stamp_ns - last_ns))

    def _summary(self) -> tuple[Any, ...]:
        """What a change of makes a report due at once."""
        estimate = self._latest.estimate
        return estimate.state if estimate else None, self._problem()

    def _on_retry(self) -> None:
        if self._parts is not None:
            self._parts.outputs.transforms.retry(self.get_clock().now().nanoseconds)

    def _on_period(self) -> None:
        if self._parts is not None:
            self._parts.keeper.save_if_due()
        self._report_diagnostics()

    def _report_diagnostics(self) -> None:
        try:
            label = self._state_machine.current_state[1]
        except InvalidHandle:
            return
        now = self.get_clock().now()
        latest = self._latest
        age = (math.nan if latest.pose_stamp_ns is None
               else 1e-9 * (now.nanoseconds - latest.pose_stamp_ns))
        name, tally = self.get_fully_qualified_name().lstrip('/'), self._tally
        silence = '' if self._stream is None else self._stream.problem(
            self._options.silence_warning)
        others = '' if self._parts is None else self._parts.outputs.others()
        if others:
            self.get_logger().warning(others, throttle_duration_sec=60.0)
        statuses = [diagnostics.warned(diagnostics.pose_status(
            name, label, self._problem(), silence, latest.estimate, age, self._odometry_lag()),
            others)]
        if self._stream is not None:
            troubles = sum(tally.refused.values()) + sum(tally.errors.values())
            statuses += [
                diagnostics.image_status(
                    name, self._stream.topic, self._stream.publishers, tally, silence,
                    troubles - self._reported[0], tally.lost - self._reported[1]),
                diagnostics.time_status(
                    name, latest.estimate, self._stream.decode_s, latest.latency_s)]
            self._reported = (troubles, tally.lost)
        if self._parts is not None:
            statuses.append(self._parts.watch.status(name))
        self._shown = self._summary()
        self._diagnostics.publish(diagnostics.diagnostic_array(now.to_msg(), statuses))


def make_node() -> LocaliserNode:
    """Create the node and start it, if it is to start by itself."""
    node = LocaliserNode()
    node.autostart()
    # What the imports have made stays; a collection that walks through it all holds up an image.
    gc.collect()
    gc.freeze()
    return node
