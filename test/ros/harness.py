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

"""Processes and a user for tests over DDS."""

from __future__ import annotations

from collections.abc import Callable
import os
from pathlib import Path
import signal
import subprocess
import sys
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # So begins a shell's background job, and so would the programs that it starts.
    signal.signal(signal.SIGINT, signal.default_int_handler)
if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
    # So does what nohup starts.
    signal.signal(signal.SIGHUP, signal.SIG_DFL)

REPOSITORY = Path(__file__).resolve().parents[2]
PATIENCE = 90.0
"""Seconds until a test gives up waiting; a loaded machine is no failure."""
RELIABLE = {
    'rig_file': 'config/arena_640_rig.yaml', 'map_file': 'config/arena_map.yaml',
    'qos_overrides./odom.subscription.reliability': 'reliable',
    'qos_overrides./image.subscription.reliability': 'reliable'}


class Process:
    """A program of the package in its own process."""

    def __init__(
        self, module: str, arguments: list[str], environment: dict[str, str], log: Path,
    ) -> None:
        self.log = log
        with log.open('w') as file:
            self._popen = subprocess.Popen(
                [sys.executable, '-m', f'nccs_pose.ros.{module}', *arguments], cwd=REPOSITORY,
                env=environment, stdout=file, stderr=subprocess.STDOUT)

    def catches(self, how: signal.Signals) -> bool:
        """Whether it has a handler for a signal yet."""
        status = Path(f'/proc/{self._popen.pid}/status').read_text()
        mask = next(line for line in status.splitlines() if line.startswith('SigCgt'))
        return bool(int(mask.split()[1], 16) >> (how - 1) & 1)

    def running(self) -> bool:
        """Whether it still runs."""
        return self._popen.poll() is None

    def stop(self, how: signal.Signals = signal.SIGINT, times: int = 1) -> int:
        """Send a signal, as often as told while it runs, and return the exit code."""
        for _ in range(times):
            if self.running():
                self._popen.send_signal(how)
                time.sleep(0.01 if times > 1 else 0.0)
        return self.wait()

    def wait(self) -> int:
        """Return the exit code once it ends."""
        try:
            return self._popen.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            self._popen.kill()
            self._popen.wait()
            raise

    def tell_to_end(self) -> None:
        """Ask it to end, if it still runs."""
        if self.running():
            self._popen.terminate()

    @property
    def output(self) -> str:
        """Everything that it printed so far."""
        return self.log.read_text(errors='replace')


class User:
    """Somebody at the other end: subscribes, publishes, calls services."""

    def __init__(self, domain: int) -> None:
        self.domain = domain
        self._context = Context()
        rclpy.init(context=self._context, domain_id=domain)
        self.node = Node('user', context=self._context, use_global_arguments=False)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self.statuses: dict[str, DiagnosticStatus] = {}
        self.history: list[DiagnosticStatus] = []
        self.node.create_subscription(DiagnosticArray, '/diagnostics', self._on_diagnostics, 100)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            self.statuses[status.name] = status
            self.history.append(status)

    def listen(self, kind: type, topic: str, qos: QoSProfile | int = 100) -> list[Any]:
        """Subscribe; the list fills with messages."""
        messages: list[Any] = []
        self.node.create_subscription(kind, topic, messages.append, qos)
        return messages

    def meet(self, node: Process, name: str = 'localiser') -> None:
        """Wait until the node is active and heard: discovery can take a few seconds."""
        assert self.wait(
            lambda: self.value(f'{name}: pose', 'lifecycle') == 'active'), node.output

    def publisher(
        self, kind: type, topic: str, node: str = 'localiser', depth: int = 100,
    ) -> Any:
        """A publisher that the node already knows of."""
        publisher = self.node.create_publisher(kind, topic, depth)
        assert self.wait(lambda: publisher.get_subscription_count() > 0), topic
        if topic.split('/')[-1] in ('image', 'compressed'):
            assert self.wait(lambda: self.count('publishers', node) > 0), topic
        else:
            self.spin(0.3)  # a best-effort subscriber may learn of us a little later
        return publisher

    def wait(self, condition: Callable[[], Any], timeout: float = PATIENCE) -> Any:
        """Spin until the condition holds; its value, false after the timeout."""
        end = time.monotonic() + timeout
        while not (value := condition()):
            if time.monotonic() > end:
                return value
            self._executor.spin_once(timeout_sec=0.02)
        return value

    def insist(self, publisher: Any, message: Any, condition: Callable[[], Any]) -> Any:
        """Publish until the condition holds: a best-effort subscriber may learn of us late."""
        end = time.monotonic() + PATIENCE
        while time.monotonic() < end:
            publisher.publish(message)
            if value := self.wait(condition, 1.0):
                return value
        return False

    def frames(self, node: str = 'localiser') -> int:
        """How many images the node has accounted for."""
        return sum(self.count(key, node) for key in (
            'frames_received', 'frames_dropped_busy', 'frames_lost_by_middleware'))

    def show(self, publisher: Any, *images: Any, node: str = 'localiser') -> None:
        """Publish images, each when the node has accounted for the one before."""
        for image in images:
            before = self.frames(node)
            publisher.publish(image)
            assert self.wait(lambda n=before: self.frames(node) > n), self.statuses

    def spin(self, seconds: float) -> None:
        """Spin for a while."""
        self.wait(lambda: False, seconds)

    def call(self, kind: type, service: str, request: Any) -> Any:
        """Call a service and return its answer."""
        client = self.node.create_client(kind, service)
        assert self.wait(client.service_is_ready), service
        future = client.call_async(request)
        assert self.wait(future.done), f'{service} does not answer'
        self.node.destroy_client(client)
        return future.result()

    def value(self, status: str, key: str) -> str:
        """Latest value of a diagnostic; empty if there is none."""
        found = self.statuses.get(status)
        return next((v.value for v in found.values if v.key == key), '') if found else ''

    def count(self, key: str, node: str = 'localiser') -> int:
        """Latest count among the diagnostics of the images."""
        return int(self.value(f'{node}: images', key) or 0)

    def close(self) -> None:
        """Leave."""
        self._executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self._context)


class Pair:
    """The node and a user of it in one process, where it is known what has arrived."""

    def __init__(self, context: Context, parameters: dict[str, Any]) -> None:
        from nccs_pose.ros.localiser_node import LocaliserNode

        self.executor = SingleThreadedExecutor(context=context)
        given = {**RELIABLE, **parameters}
        self.node = LocaliserNode(
            context=context, use_global_arguments=False, parameter_overrides=[
                Parameter(name, value=value) for name, value in given.items()])
        self.executor.add_node(self.node)
        self.node.autostart()
        self.user = Node('user', context=context, use_global_arguments=False)

    def publisher(self, kind: type, topic: str, depth: int) -> Any:
        publisher = self.user.create_publisher(kind, topic, QoSProfile(depth=depth))
        self.wait(publisher.get_subscription_count)
        return publisher

    def listen(self, kind: type, topic: str) -> list[Any]:
        """Subscribe; the list fills with messages."""
        messages: list[Any] = []
        if self.user not in self.executor.get_nodes():
            self.executor.add_node(self.user)
        subscription = self.user.create_subscription(kind, topic, messages.append, 100)
        self.wait(subscription.get_publisher_count)
        return messages

    def set(self, **values: Any) -> None:
        """Change parameters of the node that runs."""
        for result in self.node.set_parameters(
                [Parameter(name, value=value) for name, value in values.items()]):
            assert result.successful, result.reason

    def wait(self, condition: Callable[[], Any]) -> None:
        for _ in range(1000):
            if condition():
                return
            self.executor.spin_once(timeout_sec=0.02)
        raise AssertionError('waited in vain')


class World:
    """A DDS domain of its own, the processes in it and a user."""

    def __init__(self, domain: int, folder: Path) -> None:
        self.folder = folder
        self._domain = domain
        self._processes: list[Process] = []
        self.user = User(domain)

    def start(self, module: str, *arguments: str, **environment: str) -> Process:
        """Start `python -m nccs_pose.ros.<module>`."""
        log = self.folder / f'{len(self._processes)}_{module}.log'
        process = Process(module, list(arguments), {
            **os.environ, 'ROS_DOMAIN_ID': str(self._domain),
            'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
            'ROS_LOG_DIR': str(self.folder / 'ros_log'),
            'PYTHONFAULTHANDLER': '1',  # where, if it ends by a segmentation fault
            **environment}, log)
        self._processes.append(process)
        return process

    def localiser(self, *ros_arguments: str, **parameters: object) -> Process:
        """Start the node under test; a parameter that is None is not given."""
        arguments = ['--ros-args', *ros_arguments]
        for name, value in {'diagnostics_period': 0.1, **parameters}.items():
            if value is None:
                continue
            text = str(value).lower() if isinstance(value, bool) else value
            arguments += ['-p', f'{name}:={text}']
        return self.start('localiser', *arguments)

    def close(self) -> None:
        """End everything, in order: who is killed leaves its shared memory, 35 MB, behind."""
        for process in self._processes:
            process.tell_to_end()
        try:
            for process in self._processes:
                process.wait()
        finally:
            self.user.close()
