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

"""What the node says of itself on /diagnostics (REP 107)."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
import math

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from nccs_pose.estimation.estimate import Estimate, State

LEVELS = {
    State.TRACKING: DiagnosticStatus.OK,
    State.COASTING: DiagnosticStatus.WARN,
    State.AMBIGUOUS: DiagnosticStatus.WARN,
    State.SEARCHING: DiagnosticStatus.WARN,
    State.LOST: DiagnosticStatus.ERROR,
}


@dataclass
class Tally:
    """Counts since the node started.

    :ivar received: images that arrived.
    :ivar missing: images that were sent and did not arrive, by their sequence numbers.
    :ivar lost: images that the middleware lost on the way.
    :ivar resets: jumps of the stamps into the past, each of which started the tracker anew.
    :ivar refused: messages by cause.
    :ivar errors: exceptions by the function that they came from.
    :ivar last_trouble: what the last of both said.
    """

    received: int = 0
    answered: int = 0
    missing: int = 0
    lost: int = 0
    resets: int = 0
    refused: Counter[str] = field(default_factory=Counter)
    errors: Counter[str] = field(default_factory=Counter)
    last_refusal: str = ''
    last_error: str = ''
    last_trouble: str = ''

    @property
    def let_go(self) -> int:
        """Images that a newer one replaced while the node was busy."""
        return max(0, self.missing - self.lost)

    def refuse(self, cause: str, words: str) -> None:
        """Count a message that could not be used."""
        self.refused[cause] += 1
        self.last_refusal = self.last_trouble = words

    def fail(self, name: str, error: BaseException) -> None:
        """Count an exception that no code of ours foresaw."""
        self.errors[name] += 1
        self.last_error = self.last_trouble = f'{name}: {type(error).__name__}: {error}'


def status(name: str, level: bytes, message: str, values: dict[str, object]) -> DiagnosticStatus:
    """One status; every value as text, floats with six digits."""
    return DiagnosticStatus(
        level=level, name=name, message=message, hardware_id='nccs_pose',
        values=[KeyValue(key=key, value=_text(value)) for key, value in values.items()])


def _text(value: object) -> str:
    return f'{value:.6g}' if isinstance(value, float) else str(value)


def pose_status(
    node: str, lifecycle: str, problem: str, silence: str, estimate: Estimate | None, age: float,
    odometry_lag: float,
) -> DiagnosticStatus:
    """State of the estimate.

    :param lifecycle: label of the node's lifecycle state.
    :param problem: why no pose is given although the estimator might; empty if none.
    :param silence: why no image comes; empty if they come. Then the estimate is none of now.
    :param age: seconds since the stamp of the last pose; NaN if there was none.
    :param odometry_lag: of the last sample of odometry behind the last image, s; NaN without.
    """
    name = f'{node}: pose'
    if lifecycle != 'active' or problem:
        level = DiagnosticStatus.ERROR if problem else DiagnosticStatus.WARN
        return status(name, level, problem or f'lifecycle state {lifecycle}', {
            'lifecycle': lifecycle, 'state': 'stopped' if lifecycle != 'active' else 'withheld',
            'reason': problem or lifecycle, 'age_s': age})
    if estimate is None:
        words = silence or 'no image yet'
        return status(name, DiagnosticStatus.WARN, words, {
            'lifecycle': lifecycle, 'state': State.SEARCHING.value, 'reason': words,
            'age_s': age})
    quality = estimate.quality
    values: dict[str, object] = {
        'lifecycle': lifecycle,
        'state': 'silent' if silence else estimate.state.value,
        'reason': silence or estimate.reason,
        'age_s': age,
        'odometry_lag_s': odometry_lag,
        'lines_used': quality.lines_used,
        'points_used': quality.points_used,
        'residual_px': float(quality.residual_px),
        'expected_px': float(quality.expected_px),
        'explained': float(quality.explained),
        'claimed': float(quality.claimed),
        'ambiguity': float(quality.ambiguity),
        'unobserved': ', '.join(quality.unobserved) or 'none',
        'candidates': '; '.join(
            f'({c.pose.x:.3f} m, {c.pose.y:.3f} m, {math.degrees(c.pose.yaw):.2f} deg) '
            f'{c.score:.3f}' for c in estimate.candidates) or 'none',
    }
    if estimate.covariance is not None:
        for key, variance in zip(('x_m', 'y_m', 'yaw_rad'), estimate.covariance.diagonal()):
            values[f'sigma_{key}'] = math.sqrt(float(variance))
    if silence:
        return status(
            name, DiagnosticStatus.WARN,
            f'{silence}; the last image said {estimate.state.value}', values)
    words = f'{estimate.state.value}: {estimate.reason}'
    return status(name, LEVELS[estimate.state], words, values)


def warned(pose: DiagnosticStatus, words: str) -> DiagnosticStatus:
    """A status that says further words, and is no good news if there are any."""
    if words:
        pose.level = max(pose.level, DiagnosticStatus.WARN)
        pose.message = f'{pose.message}; {words}'
    return pose


def image_status(
    node: str, topic: str, publishers: int, tally: Tally, problem: str, fresh_refusals: int,
    fresh_lost: int,
) -> DiagnosticStatus:
    """State of the input.

    :param problem: why no image comes; empty if they come.
    :param fresh_refusals: messages refused, or callbacks failed, since the last report.
    :param fresh_lost: images lost by the middleware since the last report.
    """
    words, level = (
        f'images come on {topic}' if tally.received else f'no image yet on {topic}'
    ), DiagnosticStatus.OK
    if fresh_lost:
        words, level = (
            f'{fresh_lost} images were lost by the middleware: does the camera use '
            'fastdds_large_images.xml?'), DiagnosticStatus.WARN
    if fresh_refusals:
        words, level = tally.last_trouble, DiagnosticStatus.WARN
    if problem:
        words, level = problem, DiagnosticStatus.WARN
    values: dict[str, object] = {
        'topic': topic, 'publishers': publishers,
        'frames_received': tally.received, 'frames_answered': tally.answered,
        'frames_dropped_busy': tally.let_go, 'frames_lost_by_middleware': tally.lost,
        'clock_resets': tally.resets,
        'refused': sum(tally.refused.values()), 'errors': sum(tally.errors.values()),
        'last_refusal': tally.last_refusal, 'last_error': tally.last_error}
    values.update({f'refused.{cause}': n for cause, n in sorted(tally.refused.items())})
    values.update({f'error.{name}': n for name, n in sorted(tally.errors.items())})
    return status(f'{node}: images', level, words, values)


def time_status(node: str, estimate: Estimate | None, decode: float, latency: float) -> (
        DiagnosticStatus):
    """Cost of the last image by stage, milliseconds.

    :param decode: seconds for decoding it.
    :param latency: seconds from its arrival to its answer.
    """
    values: dict[str, object] = {'decode_ms': 1e3 * decode}
    if estimate is not None:
        for stage in ('predict', 'detect', 'associate', 'measure', 'refine', 'total'):
            values[f'{stage}_ms'] = 1e3 * float(getattr(estimate.times, stage))
    values['arrival_to_answer_ms'] = 1e3 * latency
    return status(
        f'{node}: time', DiagnosticStatus.OK, f'{1e3 * latency:.1f} ms an image', values)


def diagnostic_array(stamp: Time, statuses: list[DiagnosticStatus]) -> DiagnosticArray:
    """The message; stamped with the node's clock, for it speaks of now."""
    message = DiagnosticArray(status=statuses)
    message.header.stamp = stamp
    return message
