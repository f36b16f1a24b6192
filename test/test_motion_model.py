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

"""Odometry between its samples against exact arcs, predictions against Monte Carlo."""

from __future__ import annotations

import itertools

from hypothesis import given
from hypothesis import strategies as st
from nccs_pose.estimation.course import Course
from nccs_pose.estimation.motion import (
    by_odometry,
    by_velocity,
    PAST,
    Prediction,
    Slip,
    Track,
)
from nccs_pose.estimation.odometry import Odometry, Wheels
from nccs_pose.geometry.pose import Pose2, wrap_angle
from nccs_pose.simulation.motion import integrate_twist, Twist
import numpy as np
import pytest

SECOND = 10**9
START = Pose2(3.0, -2.0, 2.9)
AHEAD = Twist(0.8, 0.0)


def _track(
    stamp_ns: int, pose: Pose2, covariance: np.ndarray, seen_ns: int | None = None,
) -> Track:
    return Track(stamp_ns, pose, covariance, None, stamp_ns if seen_ns is None else seen_ns)


def _difference(a: Pose2, b: Pose2) -> tuple[float, float]:
    return float(np.hypot(a.x - b.x, a.y - b.y)), abs(float(wrap_angle(a.yaw - b.yaw)))


def _seen_along_the_way(covariance: np.ndarray) -> np.ndarray:
    """Covariance (3, 3) of a way that leads straight on from START, along it and across."""
    c, s = np.cos(START.yaw), np.sin(START.yaw)
    turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    return turn @ covariance @ turn.T


def _on_an_arc(twist: Twist, rate: float = 20.0, seconds: float = 2.0) -> Odometry:
    odometry = Odometry(clock_jump=1.0)
    for k in range(int(seconds * rate) + 1):
        odometry.add(round(k * SECOND / rate), integrate_twist(START, twist, k / rate))
    return odometry


@given(forward=st.floats(-1.0, 1.0), turn=st.floats(-2.0, 2.0), t=st.floats(0.0, 2.0))
def test_odometry_between_samples_lies_on_the_arc(forward: float, turn: float, t: float) -> None:
    at = _on_an_arc(Twist(forward, turn)).at(round(t * SECOND))
    assert at is not None
    moved, turned = _difference(at.pose, integrate_twist(START, Twist(forward, turn), t))
    # A chord leaves its arc by its length times an eighth of its angle, 0.05 s x 1 m/s x 2 rad/s.
    assert moved < 0.05 * 0.1 / 8 + 1e-9
    assert turned < 1e-6


def test_odometry_is_carried_on_a_little_past_its_last_sample() -> None:
    twist = Twist(0.4, 0.5)
    odometry = _on_an_arc(twist)
    at = odometry.at(round(2.1 * SECOND))
    assert at is not None
    moved, turned = _difference(at.pose, integrate_twist(START, twist, 2.1))
    assert moved < 2e-3
    assert turned < 1e-6
    assert odometry.at(round(2.3 * SECOND)) is None


@pytest.mark.parametrize('apart_ns', [10_000, 100_000, 1_000_000])
def test_samples_that_are_stamped_in_bursts_are_carried_on_as_fast_as_the_wheels_roll(
        apart_ns: int) -> None:
    """Each burst of three tells of 60 ms of even motion, under stamps at its end."""
    twist, odometry = Twist(0.3, 0.4), Odometry(clock_jump=1.0)
    for burst in range(20):
        for k in range(3):
            rolled = integrate_twist(START, twist, 0.02 * (3 * burst + k))
            odometry.add(burst * 60_000_000 + (k - 2) * apart_ns, rolled)
    at = odometry.at(19 * 60_000_000 + 40_000_000)
    assert at is not None
    moved, turned = _difference(at.pose, integrate_twist(START, twist, 0.02 * 59 + 0.04))
    assert moved < 0.02
    assert turned < 0.03


def test_odometry_says_nothing_of_what_it_does_not_cover() -> None:
    odometry = Odometry(clock_jump=1.0)
    assert odometry.at(0) is None
    odometry.add(SECOND, START)
    assert odometry.at(SECOND) is None, 'one sample is no motion'
    odometry.add(2 * SECOND, START @ Pose2(0.1, 0.0, 0.0))
    assert odometry.at(SECOND // 2) is None
    assert odometry.at(3 * SECOND // 2) is not None
    odometry.add(10 * SECOND, START)
    assert odometry.at(6 * SECOND) is None, 'eight seconds without a sample'
    odometry.clear()
    assert odometry.at(3 * SECOND // 2) is None


def test_late_and_doubled_samples_are_no_news() -> None:
    odometry = _on_an_arc(Twist(0.4, 0.5))
    before = odometry.at(SECOND + 7)
    odometry.add(SECOND, Pose2(99.0, 99.0, 0.0))
    odometry.add(2 * SECOND, Pose2(99.0, 99.0, 0.0))
    after = odometry.at(SECOND + 7)
    assert before is not None and after is not None
    assert before == after


def test_odometry_kept_for_hours_answers_for_the_newest_stamps() -> None:
    odometry = Odometry(clock_jump=1.0)
    for k in range(20_000):
        odometry.add(k * SECOND // 20, Pose2(0.01 * k, 0.0, 0.0))
    at = odometry.at(19_990 * SECOND // 20 + SECOND // 40)
    assert at is not None
    assert at.pose.x == pytest.approx(199.905, abs=1e-9)
    assert odometry.at(SECOND) is None


def test_a_sample_from_the_future_does_not_silence_the_wheels() -> None:
    odometry = Odometry(1.0)
    for k in range(10):
        odometry.add(k * SECOND // 10, Pose2(0.1 * k, 0.0, 0.0))
    odometry.add(9 * SECOND // 10 + 8 * SECOND // 10, Pose2(0.9, 0.0, 0.0))
    for k in range(10, 14):
        odometry.add(k * SECOND // 10, Pose2(0.1 * k, 0.0, 0.0))
    at = odometry.at(13 * SECOND // 10)
    assert at is not None
    assert at.pose.x == pytest.approx(1.3, abs=1e-9)
    # One that comes late, and one that comes twice, change nothing.
    for k in (12, 13, 13, 13, 13):
        odometry.add(k * SECOND // 10, Pose2(-7.0, 0.0, 0.0))
    at = odometry.at(13 * SECOND // 10)
    assert at is not None
    assert at.pose.x == pytest.approx(1.3, abs=1e-9)


def test_wheels_err_by_all_of_their_way() -> None:
    """A way that ends where it began as much as one as long that leads straight on."""
    sigmas = []
    for turn in (0.0, 2.0 * np.pi):
        odometry = Odometry(1.0)
        for k in range(101):
            odometry.add(k * SECOND // 50, integrate_twist(START, Twist(1.0, turn), 0.01 * k))
        begun, ended = odometry.at(0), odometry.at(2 * SECOND)
        assert begun is not None and ended is not None
        carried = by_odometry(START, np.zeros((3, 3)), begun, ended).carried
        sigmas.append(np.sqrt(np.diag(_seen_along_the_way(carried))))
    # 3 cm by chance, 2 cm by the wheels' size: where the way leads, or anywhere if it is a circle.
    place = np.hypot(0.03, 0.02)
    assert sigmas[0] == pytest.approx([place, 0.03, 0.03], rel=1e-3)
    assert sigmas[1] == pytest.approx(
        [place, place, np.hypot(0.03, 0.05 * np.sqrt(2.0 * np.pi))], rel=1e-3)


def _begun_anew(speed: float, rate: int, silence: float, restart: Pose2) -> list[Wheels]:
    """What wheels say before and after a silence (s), after which they leap."""
    odometry, said = Odometry(1.0), []
    for k in range(40 + rate):
        pose = Pose2(speed * k / rate, 0.0, 0.0)
        if k < 40:
            odometry.add(k * SECOND // rate, pose)
        elif k >= 40 + silence * rate:
            odometry.add(k * SECOND // rate, pose @ restart)
    for k in (39, 39 + rate):
        wheels = odometry.at(k * SECOND // rate)
        assert wheels is not None
        said.append(wheels)
    return said


@pytest.mark.parametrize('leap', [
    Pose2(0.7, 0.0, 0.0), Pose2(0.0, -0.4, 0.0), Pose2(0.0, 0.0, 1.5), Pose2(-1.0, 0.5, -0.6)])
@pytest.mark.parametrize('silence', [0.1, 0.3, 0.9])
@pytest.mark.parametrize('rate', [20, 50])
def test_wheels_that_begin_anew_unnoticed_are_no_surer_than_they_leapt(
        rate: int, silence: int, leap: Pose2) -> None:
    speed = 0.35
    before, after = _begun_anew(speed, rate, silence, leap)
    predicted = by_odometry(START, np.zeros((3, 3)), before, after)
    error = predicted.pose.minus(START @ Pose2(speed, 0.0, 0.0))
    sigma = np.sqrt(np.diag(predicted.carried))
    assert np.hypot(*error[:2]) < 2.0 * sigma[0]
    assert abs(error[2]) < 2.0 * sigma[2]


@pytest.mark.parametrize('rate', [10, 50, 100])
def test_what_wheels_do_is_no_leap(rate: int) -> None:
    """They speed up, turn, stop at once, and fall silent while they roll evenly."""
    odometry, pose, k = Odometry(1.0), START, 0
    speeding_up = [Twist(2.9 * j / rate, 0.0) for j in range(rate // 2)]
    turning = [Twist(1.4, 5.0 * j / rate) for j in range(rate // 2)]
    still, rolling = rate * [Twist(0.0, 0.0)], rate * [Twist(0.1, 0.0)]
    for twist in (*speeding_up, *turning, *still, *rolling):
        pose, k = integrate_twist(pose, twist, 1.0 / rate), k + 1
        if not 3.4 * rate < k < 3.7 * rate:
            odometry.add(k * SECOND // rate, pose)
    wheels = odometry.at(k * SECOND // rate)
    assert wheels is not None
    assert wheels.leapt == (0.0, 0.0)


def test_wheels_that_stand_and_tremble_have_not_moved() -> None:
    odometry, rng = Odometry(1.0), np.random.default_rng(3)
    for k in range(3000):
        x, y = 0.001 * rng.standard_normal(2)
        odometry.add(k * SECOND // 50, Pose2(x, y, 0.001 * rng.standard_normal()))
    at = odometry.at(59 * SECOND)
    assert at is not None
    assert (at.way, at.turn) == (0.0, 0.0)


def test_wheels_that_are_taken_for_smaller_than_they_are_err_in_proportion() -> None:
    """However many images in between fix nothing of what they do."""
    zero, steps = np.zeros((3, 3)), np.linspace(0.0, 10.0, 41)
    wheels = [Wheels(Pose2(x, 0.0, 0.0), 3.0 + x) for x in steps]
    pose, covariance = START, zero
    for before, after in itertools.pairwise(wheels):
        prediction = by_odometry(pose, covariance, before, after, 3.0)
        # Its yaw is known all the way.
        pose, covariance = prediction.pose, prediction.carried * np.outer([1, 1, 0], [1, 1, 0])
    at_once = by_odometry(START, zero, wheels[0], wheels[-1], 3.0).carried
    assert covariance[:2, :2] == pytest.approx(at_once[:2, :2], rel=1e-9)
    along, across, _ = np.diag(_seen_along_the_way(covariance))
    assert along == pytest.approx(0.03**2 * 10.0 + (0.02 * 10.0) ** 2, rel=1e-9)
    assert across == pytest.approx(0.03**2 * 10.0, rel=1e-9)


@pytest.mark.parametrize('asked', [0.1, 0.45, 0.8, 0.95, 1.1])
def test_what_wheels_may_have_done_unheard_counts(asked: float) -> None:
    """Of a robot that brakes and turns faster by one standard deviation, in a gap and after it."""
    accelerations = np.array([-1.0, 0.0, 2.0])
    speed = np.array([0.7, 0.0, -0.4])

    def pose(t: float) -> np.ndarray:
        return speed * t + 0.5 * accelerations * t**2

    odometry = Odometry(1.0)
    for t in (0.0, 0.1, 0.8, 0.9):
        odometry.add(round(t * SECOND), Pose2(*pose(t)))
    stamp = round(asked * SECOND)
    at = odometry.at(stamp)
    assert at is not None
    missed = at.pose.as_array() - pose(asked)
    prediction = by_odometry(START, np.zeros((3, 3)), at, at)
    sigma = np.sqrt(np.diag(prediction.carried))
    assert sigma == pytest.approx([abs(missed[0]), abs(missed[0]), abs(missed[2])], abs=1e-9)


def test_a_prediction_is_vague_along_its_longest_axis() -> None:
    for sigma, vague in (((0.09, 0.09, 0.19), False), ((0.11, 0.0, 0.0), True),
                         ((0.0, 0.0, 0.21), True)):
        for angle in (0.0, 0.7):
            turn = np.eye(3)
            turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
            carried = turn @ np.diag(sigma) ** 2 @ turn.T
            assert Prediction(START, carried, True).is_vague is vague


def test_a_prediction_is_right_whatever_frame_odometry_counts_in() -> None:
    twist, dt = Twist(0.5, 0.8), 0.3
    truth = integrate_twist(START, twist, dt)
    origin = Pose2(-40.0, 7.0, -1.1)
    prediction = by_odometry(
        START, 1e-6 * np.eye(3), Wheels(origin), Wheels(integrate_twist(origin, twist, dt)))
    assert _difference(prediction.pose, truth) == pytest.approx((0.0, 0.0), abs=1e-12)
    assert prediction.by_odometry


def test_a_steady_motion_is_predicted_from_two_poses() -> None:
    # A straight run exactly; on an arc the chord is turned once per step as well.
    for turn, moved_limit in ((0.0, 1e-12), (0.6, 1e-3)):
        twist = Twist(0.4, turn)
        poses = [integrate_twist(START, twist, 0.1 * k) for k in range(3)]
        before, last = (
            _track(k * SECOND // 10, poses[k], 1e-6 * np.eye(3)) for k in (0, 1))
        prediction = by_velocity((before,), last, SECOND // 5)
        assert prediction is not None
        moved, turned = _difference(prediction.pose, poses[2])
        assert moved <= moved_limit
        assert turned < 1e-9


def test_a_velocity_that_changes_steadily_goes_on_to_change() -> None:
    """Against the closed form of constant accelerations, at uneven stamps."""
    stamps = (0.0, 0.1, 0.25, 0.3, 0.42)
    # Straight ahead, so that poses are plain sums; turning on the spot.
    for acceleration in (np.array([0.8, 0.0, 0.0]), np.array([0.0, 0.0, -1.5])):
        poses = [Pose2(*(np.array([0.3, 0.0, 0.4]) * (acceleration != 0.0) * t
                         + 0.5 * acceleration * t**2)) for t in stamps]
        # As long as the poses are known so well that their errors are not taken for a change.
        for sigma, goes_on in ((1e-4, True), (2e-2, False)):
            tracks = [_track(round(t * SECOND), pose, sigma**2 * np.eye(3))
                      for t, pose in zip(stamps, poses)]
            prediction = by_velocity(tracks[:3], tracks[3], tracks[4].stamp_ns)
            even = by_velocity(tracks[2:3], tracks[3], tracks[4].stamp_ns)
            assert prediction is not None and even is not None
            assert _difference(prediction.pose, poses[4] if goes_on else even.pose) == (
                pytest.approx((0.0, 0.0), abs=1e-9))


@pytest.mark.parametrize('way', [
    # It halts; it stood and sets off; it drives to and fro.
    (0.0, 0.1, 0.2, 0.2, 0.2), (0.0, 0.0, 0.0, 0.1, 0.2), (0.0, 0.1, 0.0, 0.1, 0.2)])
def test_a_jerk_does_not_go_on(way: tuple[float, ...]) -> None:
    tracks = [_track(k * SECOND // 10, Pose2(x, 0.0, x), 1e-6 * np.eye(3))
              for k, x in enumerate(way)]
    prediction = by_velocity(tracks[:3], tracks[3], tracks[4].stamp_ns)
    assert prediction is not None
    # From so small a turn on, the chord of an arc stands for it.
    assert prediction.pose.yaw == pytest.approx(2.0 * way[3] - way[2], abs=1e-12)


def test_an_old_velocity_is_not_believed() -> None:
    before, last = _track(0, START, np.eye(3)), START @ Pose2(0.1, 0.0, 0.0)
    assert by_velocity((before,), _track(SECOND // 2, last, np.eye(3)), SECOND) is not None
    assert by_velocity((before,), _track(SECOND // 2, last, np.eye(3)), 2 * SECOND) is None
    assert by_velocity((before,), _track(3 * SECOND, last, np.eye(3)), 3 * SECOND + 1) is None
    still = _track(SECOND // 2, last, np.eye(3))
    assert by_velocity((before,), still, SECOND // 2) is None, 'no time has passed'


def test_without_a_velocity_the_robot_may_have_gone_anywhere_near() -> None:
    last = _track(SECOND, START, 1e-6 * np.eye(3))
    prediction = by_velocity((), last, SECOND + SECOND // 10)
    assert prediction is not None
    assert prediction.pose == START
    # A robot at 1 m/s and 2 rad/s is one deviation away.
    moved, _, turned = np.sqrt(np.diag(prediction.carried))
    assert moved == pytest.approx(0.1, rel=0.01)
    assert turned == pytest.approx(0.2, rel=0.01)


def test_a_direction_out_of_sight_grows_uncertain_since_it_was_last_seen() -> None:
    before = _track(0, START, 1e-6 * np.eye(3))
    deviations = []
    for seen_ns in (SECOND, SECOND // 2, SECOND // 4):
        last = _track(SECOND, START @ Pose2(0.1, 0.0, 0.0), 1e-6 * np.eye(3), seen_ns)
        prediction = by_velocity((before,), last, SECOND + SECOND // 10)
        assert prediction is not None
        deviations.append(float(np.sqrt(prediction.carried[0, 0])))
    assert deviations[0] < deviations[1] < deviations[2]
    # Half of 1 m/s^2 for 0.85 s, and as much again from the velocity's own second.
    assert deviations[2] == pytest.approx(0.5 * 0.85 * 1.85, rel=0.01)
    unseen = _track(SECOND, START, 1e-6 * np.eye(3), 0)
    assert by_velocity((before,), unseen, SECOND + SECOND // 10) is None


def test_the_inflation_of_a_prediction_is_taken_out_where_the_image_says_nothing() -> None:
    """Against the solution of both problems written out: x observed, y not."""
    carried = np.diag([0.03, 0.05, 0.01]) ** 2
    prediction = Prediction(START, carried, True)
    image = np.diag([1.0 / 0.001**2, 0.0, 1.0 / 0.002**2])
    solved = np.linalg.inv(image + np.linalg.inv(prediction.covariance))
    for multiple in (1.0, 4.0):
        got = prediction.without_inflation(multiple * solved, solved)
        assert np.sqrt(got[1, 1]) == pytest.approx(0.05, rel=1e-9)
        # What the image sees keeps its own uncertainty: never less for having a good prediction.
        assert np.sqrt(got[0, 0]) == pytest.approx(np.sqrt(multiple) * 0.001, rel=0.01)
        assert np.sqrt(got[2, 2]) == pytest.approx(np.sqrt(multiple) * 0.002, rel=0.05)


def test_the_covariance_of_a_prediction_is_that_of_many_predictions() -> None:
    rng = np.random.default_rng(5)
    root = np.array([[0.05, 0.0, 0.0], [0.02, 0.03, 0.0], [0.02, -0.01, 0.04]])
    covariance = root @ root.T
    step = Pose2(1.2, 0.3, 0.7)
    start = START.as_array() + rng.standard_normal((20_000, 3)) @ root.T
    ends = np.array([(Pose2.from_array(row) @ step).as_array() for row in start])
    ends[:, 2] = wrap_angle(ends[:, 2] - START.yaw)
    origin = Pose2(0.0, 0.0, 0.0)
    carried = by_odometry(START, covariance, Wheels(origin), Wheels(step)).covariance
    added = carried - by_odometry(
        START, 0.0 * covariance, Wheels(origin), Wheels(step)).covariance
    sampled = np.cov(ends.T)
    scale = np.sqrt(np.outer(np.diag(sampled), np.diag(sampled)))
    assert (np.abs(added - sampled) / scale).max() < 0.04


def test_what_a_prediction_may_be_off_by_grows_with_the_motion() -> None:
    still, zero = Pose2(0.0, 0.0, 0.0), np.zeros((3, 3))
    sizes = [
        np.sqrt(np.diag(by_odometry(
            START, zero, Wheels(still), Wheels(Pose2(d, 0.0, d))).covariance))
        for d in (0.0, 0.2, 1.0)]
    assert (np.diff(sizes, axis=0) > 0.0).all()
    # What wheels get wrong is a few hundredths of a metre's run.
    assert 0.03 < sizes[2][0] < 0.06
    before, last = _track(0, START, zero), _track(SECOND // 2, START @ Pose2(0.1, 0.0, 0.0), zero)
    soon, later = (
        by_velocity((before,), last, SECOND // 2 + dt) for dt in (SECOND // 10, SECOND // 2))
    assert soon is not None and later is not None
    assert (np.diag(later.covariance) > np.diag(soon.covariance)).all()


def _after(course: Course, stamp_ns: int, x: float, **about: bool) -> Course:
    return course.after(stamp_ns, Pose2(x, 0.0, 0.0), 1e-6 * np.eye(3), None, **about)


def test_a_course_leads_on_by_the_velocity_of_its_last_poses() -> None:
    assert Course().at(0, None) is None, 'nobody knows where it begins'
    course = Course()
    for k in range(6):
        course = _after(course, k * SECOND // 10, 0.1 * k, is_fixed=True)
    assert len(course.past) == PAST
    prediction = course.at(6 * SECOND // 10, None)
    assert prediction is not None
    assert prediction.pose.x == pytest.approx(0.6)
    assert course.seconds_to(6 * SECOND // 10) == pytest.approx(0.1)


def test_no_velocity_of_a_course_leads_across_a_jump() -> None:
    course = _after(_after(Course(), 0, 0.0, is_fixed=True), SECOND // 10, 0.1, is_fixed=True)
    jumped = _after(course, SECOND // 5, 2.0, is_fixed=True, is_jump=True)
    assert jumped.past == ()
    # Nor to where an image sets right what the one before had left open.
    blind = _after(course, SECOND // 5, 0.2, is_fixed=False)
    assert blind.last is not None and blind.last.seen_ns == SECOND // 10
    assert len(blind.past) == 2
    right = _after(blind, 3 * SECOND // 10, 0.5, is_fixed=True)
    assert right.past == () and right.last is not None
    assert right.last.seen_ns == right.last.stamp_ns


def test_a_course_goes_by_the_wheels_until_their_reckoning_breaks_off() -> None:
    course = Course().after(
        0, START, 1e-6 * np.eye(3), Wheels(Pose2()), is_fixed=True)
    told = course.at(SECOND // 10, Wheels(Pose2(0.1, 0.0, 0.0)))
    assert told is not None and told.by_odometry
    assert _difference(told.pose, START @ Pose2(0.1, 0.0, 0.0))[0] < 1e-12
    broken = course.without_odometry().at(SECOND // 10, Wheels(Pose2(0.1, 0.0, 0.0)))
    assert broken is not None and not broken.by_odometry
    assert broken.pose == START


def _held_against_images(
    size: float = 1.0, size_of_turn: float = 1.0, bend: float = 0.0, *,
    twist: Twist = AHEAD, sigma: float = 0.0005, seconds: float = 2.0,
) -> Course:
    """A course at 10 Hz of wheels that tell so much more than the robot drives and turns.

    :param bend: what they turn too much, rad/m.
    :param sigma: of the images' poses, metres and rad.
    """
    course, rng = Course(), np.random.default_rng(4)
    wrong = Twist(size * twist.forward, size_of_turn * twist.turn + bend * twist.forward)
    for k in range(round(10 * seconds) + 1):
        t = 0.1 * k
        seen = Pose2.from_array(
            integrate_twist(START, twist, t).as_array() + sigma * rng.standard_normal(3))
        course = course.after(
            k * SECOND // 10, seen, sigma**2 * np.eye(3), _rolled(wrong, t), is_fixed=True)
    return course


def _rolled(twist: Twist, t: float) -> Wheels:
    return Wheels(
        integrate_twist(Pose2(), twist, t), abs(twist.forward) * t, abs(twist.turn) * t)


@pytest.mark.parametrize('size', [0.8, 0.85, 1.15, 1.2])
@pytest.mark.parametrize('forward', [0.8, -0.8])
def test_what_images_have_shown_of_the_wheels_way_is_reckoned_with(
        size: float, forward: float) -> None:
    twist = Twist(forward, 0.0)
    course = _held_against_images(size, twist=twist)
    # Of what the wheels tell, so much is too much or too little.
    assert course.errors.flaw.way == pytest.approx(abs(size - 1.0) / size, rel=0.15)
    predicted = course.at(39 * SECOND // 10, _rolled(Twist(size * forward, 0.0), 3.9))
    assert predicted is not None
    error = predicted.pose.minus(integrate_twist(START, twist, 3.9))
    assert error @ np.linalg.solve(predicted.carried, error) < 3.0**2
    assert predicted.is_vague


@pytest.mark.parametrize(('about', 'twist'), [
    ({'size_of_turn': 1.2}, Twist(0.0, 1.0)), ({'size_of_turn': 0.8}, Twist(0.0, -1.0)),
    ({'size': 1.2, 'size_of_turn': 1.2}, Twist(0.9, 1.2)), ({'bend': 0.4}, Twist(0.8, 0.0))])
def test_what_images_have_shown_of_the_wheels_turn_is_reckoned_with(
        about: dict[str, float], twist: Twist) -> None:
    course = _held_against_images(**about, twist=twist, seconds=3.0)
    size, size_of_turn = about.get('size', 1.0), about.get('size_of_turn', 1.0)
    wrong = Twist(
        size * twist.forward, size_of_turn * twist.turn + about.get('bend', 0.0) * twist.forward)
    predicted = course.at(4 * SECOND, _rolled(wrong, 4.0))
    assert predicted is not None
    error = predicted.pose.minus(integrate_twist(START, twist, 4.0))
    assert error @ np.linalg.solve(predicted.carried, error) < 3.0**2


@pytest.mark.parametrize('about', [
    # It stands, creeps, drives, and turns, under poses that are 5 mm and 5 mrad off.
    {'twist': Twist(0.0, 0.0)}, {'twist': Twist(0.03, 0.0)}, {'twist': Twist(0.6, 0.0)},
    {'twist': Twist(0.3, 1.0)}, {'twist': Twist(0.6, 0.0), 'size': 1.02}])
def test_what_images_err_by_is_not_laid_on_the_wheels(about: dict) -> None:
    for seconds in (0.5, 1.0, 3.0, 10.0):
        course = _held_against_images(**about, sigma=0.005, seconds=seconds)
        assert course.errors.flaw.way < 0.02
        assert course.errors.flaw.turn < 0.02
        assert course.errors.flaw.bend < 0.02


def test_a_robot_that_is_carried_away_does_not_speak_against_its_wheels() -> None:
    new = Course().after(0, START, 1e-6 * np.eye(3), Wheels(Pose2()), is_fixed=True)
    for course in (_held_against_images(), new):
        last = course.last
        assert last is not None and last.wheels is not None
        wheels = Wheels(last.wheels.pose @ Pose2(0.2, 0.0, 0.0), last.wheels.way + 0.2)
        elsewhere = last.pose @ Pose2(-1.5, 0.0, 0.0)
        after = course.after(
            last.stamp_ns + SECOND, elsewhere, 1e-6 * np.eye(3), wheels, is_fixed=True)
        assert after.errors.flaw == course.errors.flaw
        assert after.errors.begin is after.last


def test_what_wheels_erred_by_once_is_forgotten_on_the_way() -> None:
    course = _held_against_images(1.2)
    last = course.last
    assert last is not None and last.wheels is not None
    for k in range(1, 61):
        step = Pose2(0.1 * k, 0.0, 0.0)
        wheels = Wheels(last.wheels.pose @ step, last.wheels.way + 0.1 * k)
        course = course.after(
            last.stamp_ns + k * SECOND // 10, last.pose @ step, 1e-6 * np.eye(3), wheels,
            is_fixed=True)
    assert course.errors.flaw.way < 0.02


def test_wheels_that_no_image_confirms_are_vague_after_a_while() -> None:
    course = Course().after(0, START, 1e-6 * np.eye(3), Wheels(Pose2()), is_fixed=True)
    for way, vague in ((0.1, (False, False)), (0.8, (False, True)), (1.2, (True, True))):
        wheels = Wheels(Pose2(way, 0.0, 0.0), way)
        sure, doubted = (
            course.at(SECOND, wheels, doubted=doubted) for doubted in (False, True))
        assert sure is not None and doubted is not None
        assert (sure.is_vague, doubted.is_vague) == vague


@pytest.mark.parametrize('slip', [-0.2, 0.2])
@pytest.mark.parametrize('way', [0.1, 0.5, 1.0, 2.5])
def test_wheels_may_slip_where_no_image_watches_them(way: float, slip: float) -> None:
    """By a fifth, on all of the way or while they turn on the spot; or one alone by a tenth."""
    course = Course().after(0, START, 1e-6 * np.eye(3), Wheels(Pose2()), is_fixed=True)
    ahead, turned = Wheels(Pose2(way, 0.0, 0.0), way), Wheels(Pose2(0.0, 0.0, way), 0.0, way)
    one = 0.5 * slip
    swerved = integrate_twist(Pose2(), Twist(1.0 + 0.5 * one, one / 0.4), way)
    for wheels, did in (
            (ahead, Pose2((1.0 + slip) * way, 0.0, 0.0)), (ahead, swerved),
            (turned, Pose2(0.0, 0.0, (1.0 + slip) * way))):
        prediction = course.at(SECOND, wheels)
        assert prediction is not None
        error = prediction.pose.minus(START @ did)
        assert error @ np.linalg.solve(prediction.covariance, error) < 3.0**2


def test_in_the_blink_between_two_images_hardly_ever_does_a_slip_begin() -> None:
    course = Course().after(0, START, 1e-6 * np.eye(3), Wheels(Pose2()), is_fixed=True)
    blink = Wheels(Pose2(0.1, 0.0, 0.0), 0.1)
    prediction = course.at(SECOND, blink)
    assert prediction is not None
    sure = by_odometry(START, 1e-6 * np.eye(3), Wheels(Pose2()), blink)
    assert np.sqrt(np.diag(prediction.covariance)) == pytest.approx(
        np.sqrt(np.diag(sure.covariance)), rel=0.1)


def test_where_wheels_swerve_leads_across_a_straight_way() -> None:
    """What they roll too far lies along it."""
    ahead = Wheels(Pose2(2.0, 0.0, 0.0), 2.0)
    sure, slipping = (_seen_along_the_way(by_odometry(
        START, np.zeros((3, 3)), Wheels(Pose2()), ahead, slip=slip).carried)
        for slip in (Slip.NONE, Slip.POSSIBLE))
    added = slipping - sure
    # A tenth of two metres; one wheel's tenth, 0.4 m from the other, and half of it halfway.
    assert np.diag(added) == pytest.approx([0.2**2, (0.5 * 0.5 * 2.0) ** 2, 0.5**2], rel=1e-9)
    assert added[0, 1] == pytest.approx(0.0, abs=1e-12)


def test_a_slip_adds_up_however_many_images_fix_nothing_of_it() -> None:
    """But only along the lines in view: across them every image shows where the robot is."""
    fixed, steps = 1e-9, np.linspace(0.0, 3.0, 31)
    wheels = [Wheels(Pose2(x, 0.0, 0.0), 3.0 + x) for x in steps]
    begun = np.diag([0.0, fixed, 0.0])
    covariance = begun
    for before, after in itertools.pairwise(wheels):
        carried, sure = (
            by_odometry(Pose2(), covariance, before, after, 3.0, slip=slip).carried
            for slip in (Slip.POSSIBLE, Slip.NONE))
        assert carried[1, 1] == pytest.approx(sure[1, 1], rel=0.01)
        covariance = np.diag([carried[0, 0], fixed, 0.0])
    at_once = by_odometry(
        Pose2(), begun, wheels[0], wheels[-1], 3.0, slip=Slip.POSSIBLE).carried
    assert covariance[0, 0] == pytest.approx(at_once[0, 0], rel=1e-9)
