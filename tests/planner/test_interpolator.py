from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from planner.commands import FlyDistance, FlyPercent, Move, Overrides, Stop
from planner.moves import plan_moves
from planner.rrs import AccelerationKind, EventKind, FlybyCriterion, SpeedCorrection, Status
from tests.planner.interpolating import (
    PERIOD,
    events,
    positions,
    queue,
    ready,
    steps_to_rest,
    worst_ratios,
)

# -- the motion ---------------------------------------------------------------------------


@given(st.integers(0, 10**6), st.sampled_from([0.0, 10.0, 50.0, 100.0]), st.integers(2, 6))
@settings(max_examples=20, deadline=None)
def test_targets_queued_at_once_are_the_plan_of_the_same_moves(
    six_axis_limits, random_points, seed, fly, count
):
    points = random_points(seed, count)
    interpolator = ready(six_axis_limits, points[0], fly=fly)
    queue(interpolator, points[1:])
    steps = steps_to_rest(interpolator)
    moves = [Move(point, fly=FlyPercent(fly)) for point in points[1:]]
    plan = plan_moves(points[0], moves, six_axis_limits)
    q, _, _ = plan.trajectory.sample(PERIOD * np.arange(1, len(steps) + 1))
    np.testing.assert_allclose(positions(steps), q, rtol=0, atol=1e-12)
    assert steps[-1].elapsed_time == pytest.approx(plan.trajectory.duration, abs=1e-9)
    # Each via point is told in the first step at or after its passage.
    told = {event.target_id: k for k, step in enumerate(steps, 1) for event in step.events}
    for target, passage in enumerate(plan.targets, 1):
        assert told[target] == pytest.approx(np.ceil(passage.time / PERIOD - 1e-6), abs=0)


def test_every_setting_reaches_the_plan(six_axis_limits, random_points):
    points = random_points(5, 4)
    interpolator = ready(six_axis_limits, points[0])
    interpolator.set_joint_speeds(80.0)
    interpolator.set_joint_speeds(35.0, joints=[2])
    interpolator.set_joint_accelerations([90.0, 80.0, 70.0, 60.0, 50.0, 40.0])
    interpolator.set_joint_jerks([50.0, 60.0], joints=[0, 5])
    interpolator.set_override_speed(90.0, SpeedCorrection.PROGRAM)
    interpolator.set_override_acceleration(70.0, AccelerationKind.ACCELERATION)
    interpolator.set_override_acceleration(60.0, AccelerationKind.DECELERATION)
    interpolator.select_flyby_mode(True)
    interpolator.set_point_accuracy_parameter(FlybyCriterion.DISTANCE, 0.05)
    queue(interpolator, points[1:])
    shares = {
        "joint_speed": np.array([0.8, 0.8, 0.35, 0.8, 0.8, 0.8]),
        "joint_acceleration": np.array([0.9, 0.8, 0.7, 0.6, 0.5, 0.4]),
        "joint_jerk": np.array([0.5, 1.0, 1.0, 1.0, 1.0, 0.6]),
    }
    plan = plan_moves(
        points[0],
        [Move(point, fly=FlyDistance(0.05), **shares) for point in points[1:]],
        six_axis_limits,
        Overrides(speed=0.9, acceleration=0.7, deceleration=0.6),
    )
    steps = steps_to_rest(interpolator)
    q, _, _ = plan.trajectory.sample(PERIOD * np.arange(1, len(steps) + 1))
    np.testing.assert_allclose(positions(steps), q, rtol=0, atol=1e-12)
    # None of them is idle: the plan without it is another.
    plain = plan_moves(
        points[0], [Move(point, fly=FlyDistance(0.05)) for point in points[1:]], six_axis_limits
    )
    assert plan.trajectory.duration > 1.2 * plain.trajectory.duration


@pytest.mark.parametrize("fly", [25.0, 100.0])
def test_a_target_set_in_time_is_as_good_as_one_set_at_once(six_axis_limits, random_points, fly):
    points = random_points(7, 6)
    at_once = ready(six_axis_limits, points[0], fly=fly)
    queue(at_once, points[1:])
    one_by_one = ready(six_axis_limits, points[0], fly=fly)
    waiting = list(enumerate(points[1:], 1))
    steps, one = [], steps_to_rest(at_once)
    one_by_one.set_next_target(*waiting.pop(0))
    while not steps or steps[-1].status != Status.FINAL_STEP:
        steps.append(one_by_one.get_next_step())
        if steps[-1].status == Status.NEED_MORE_DATA and waiting:
            one_by_one.set_next_target(*waiting.pop(0))
    np.testing.assert_array_equal(positions(steps), positions(one))
    assert events(steps) == events(one)


@given(st.integers(0, 10**6), st.floats(0.0, 1.0))
@settings(max_examples=15, deadline=None)
def test_a_late_target_finds_the_arm_stopping_at_the_point_before(
    six_axis_limits, random_points, seed, late
):
    a, b, c = random_points(seed, 3)
    plan = plan_moves(a, [Move(b, fly=FlyPercent(50.0)), Move(c)], six_axis_limits)
    alone = plan_moves(a, [Move(b)], six_axis_limits).trajectory.duration
    assume(plan.targets[0].how != "stopped")
    interpolator = ready(six_axis_limits, a, fly=50.0)
    queue(interpolator, [b])
    # Somewhere between where the corner would begin and the stop.
    corner_begins = _last_shared(plan.trajectory, a, b, six_axis_limits)
    wait = int((corner_begins + late * (alone - corner_begins)) / PERIOD)
    steps = [interpolator.get_next_step() for _ in range(wait + 1)]
    assume(steps[-1].elapsed_time >= corner_begins and steps[-1].status >= 0)
    assume(steps[-1].status != Status.FINAL_STEP)
    assert interpolator.set_next_target(2, c) >= 0
    steps += steps_to_rest(interpolator)
    stopping = plan_moves(a, [Move(b, fly=Stop()), Move(c)], six_axis_limits).trajectory
    q, _, _ = stopping.sample(PERIOD * np.arange(1, len(steps) + 1))
    np.testing.assert_allclose(positions(steps), q, rtol=0, atol=1e-12)
    assert events(steps) == [(EventKind.VIA_POINT_PASSED, 1), (EventKind.MOTION_ENDED, 2)]


def _last_shared(flown, a, b, limits):
    """The time at which a motion that flies by `b` leaves the one that stops there."""
    stopping = plan_moves(a, [Move(b)], limits).trajectory
    times = np.linspace(0.0, stopping.duration, 20_001)
    apart = np.abs(flown.sample(times)[0] - stopping.sample(times)[0]).max(axis=1)
    return times[np.argmax(apart > 1e-9)]


def test_after_the_end_a_new_target_begins_a_new_motion(six_axis_limits, random_points):
    a, b, c = random_points(9, 3)
    interpolator = ready(six_axis_limits, a, fly=100.0)
    queue(interpolator, [b])
    first = steps_to_rest(interpolator)
    np.testing.assert_array_equal(first[-1].position, b)
    idle = interpolator.get_next_step()
    assert (idle.status, idle.elapsed_time, idle.events) == (Status.NO_TARGET, 0.0, ())
    np.testing.assert_array_equal(idle.position, b)
    assert interpolator.get_current_target_id() is None
    queue(interpolator, [c], first=2)
    second = steps_to_rest(interpolator)
    other = ready(six_axis_limits, b)
    queue(other, [c], first=2)
    np.testing.assert_array_equal(positions(second), positions(steps_to_rest(other)))
    assert events(first + second) == [(EventKind.MOTION_ENDED, 1), (EventKind.MOTION_ENDED, 2)]


def test_a_target_where_the_arm_is_takes_no_time(six_axis_limits, random_points):
    (point,) = random_points(10, 1)
    for percent in (100.0, 0.0):
        interpolator = ready(six_axis_limits, point)
        interpolator.set_override_speed(percent)
        queue(interpolator, [point, point])
        (step,) = steps_to_rest(interpolator)
        assert (step.elapsed_time, events([step])) == (
            0.0,
            [(EventKind.VIA_POINT_PASSED, 1), (EventKind.MOTION_ENDED, 2)],
        )
        np.testing.assert_array_equal(step.position, point)


def test_targets_at_one_place_are_told_one_after_the_other(six_axis_limits, random_points):
    a, b, c = random_points(11, 3)
    interpolator = ready(six_axis_limits, a, fly=100.0)
    queue(interpolator, [b, b, b, c])
    steps = steps_to_rest(interpolator)
    assert [target for _, target in events(steps)] == [1, 2, 3, 4]
    assert max(len(step.events) for step in steps) == 3


@given(st.integers(0, 10**6), st.lists(st.integers(0, 400), min_size=4, max_size=4))
@settings(max_examples=15, deadline=None)
def test_whenever_targets_come_the_steps_keep_the_limits(
    six_axis_limits, random_points, seed, waits
):
    points = random_points(seed, 5)
    interpolator = ready(six_axis_limits, points[0], fly=100.0)
    steps = []
    for target_id, (point, wait) in enumerate(zip(points[1:], waits, strict=True)):
        queue(interpolator, [point], first=target_id)
        steps += [interpolator.get_next_step() for _ in range(wait)]
    while interpolator.get_current_target_id() is not None:
        steps.append(interpolator.get_next_step())
    assert max(worst_ratios(points[0], positions(steps), six_axis_limits)) <= 1.0 + 1e-5
    ended = [target for kind, target in events(steps)]
    assert ended == [0, 1, 2, 3]


def test_the_same_calls_give_the_same_bits(six_axis_limits, random_points):
    def run():
        points = random_points(20, 5)
        interpolator = ready(six_axis_limits, points[0], fly=70.0)
        queue(interpolator, points[1:3])
        steps = [interpolator.get_next_step() for _ in range(150)]
        interpolator.set_override_speed(33.0)
        steps += [interpolator.get_next_step() for _ in range(100)]
        queue(interpolator, points[3:], first=3)
        interpolator.set_override_speed(100.0)
        return steps + steps_to_rest(interpolator)

    first, second = run(), run()
    assert positions(first).tobytes() == positions(second).tobytes()
    assert [s[2:] for s in first] == [s[2:] for s in second]


# -- more data, targets -------------------------------------------------------------------


@pytest.mark.parametrize("advance", [0, 1, 3])
def test_data_are_asked_for_while_fewer_targets_are_ahead_than_wanted(
    six_axis_limits, random_points, advance
):
    points = random_points(30, 6)
    interpolator = ready(six_axis_limits, points[0], fly=50.0, advance=advance)
    answers = [interpolator.set_next_target(k, point) for k, point in enumerate(points[1:])]
    asked = [answer == Status.NEED_MORE_DATA for answer in answers]
    assert asked == [known <= advance for known in range(1, 6)]
    ahead = 5
    for step in steps_to_rest(interpolator)[:-1]:
        ahead -= len(step.events)
        assert (step.status == Status.NEED_MORE_DATA) == (ahead <= advance)


def test_the_current_target_is_the_next_one_not_passed(six_axis_limits, random_points):
    points = random_points(31, 4)
    interpolator = ready(six_axis_limits, points[0], fly=100.0)
    queue(interpolator, points[1:], first=11)
    current, passed = 11, []
    while interpolator.get_current_target_id() is not None:
        assert interpolator.get_current_target_id() == current
        for event in interpolator.get_next_step().events:
            passed.append(event.target_id)
            current = event.target_id + 1
    assert passed == [11, 12, 13]


# -- time ---------------------------------------------------------------------------------


@given(st.integers(0, 10**6), st.floats(1.0, 6.0))
@settings(max_examples=15, deadline=None)
def test_a_motion_time_is_met(six_axis_limits, random_points, seed, factor):
    a, b, c = random_points(seed, 3)
    shortest = plan_moves(a, [Move(b)], six_axis_limits).trajectory.duration
    interpolator = ready(six_axis_limits, a)
    assert interpolator.set_motion_time(factor * shortest) == Status.OK
    queue(interpolator, [b, c])  # the time is that of one move
    first = plan_moves(b, [Move(c)], six_axis_limits).trajectory.duration
    last = steps_to_rest(interpolator)[-1].elapsed_time
    assert last == pytest.approx(factor * shortest + first, rel=1e-9)


def test_a_motion_time_too_short_is_refused_and_changes_nothing(six_axis_limits, random_points):
    a, b = random_points(40, 2)
    shortest = plan_moves(a, [Move(b)], six_axis_limits).trajectory.duration
    interpolator = ready(six_axis_limits, a)
    interpolator.set_motion_time(0.999 * shortest)
    assert interpolator.set_next_target(1, b) == Status.TIME_TOO_SHORT == -25
    assert interpolator.get_next_step().status == Status.NO_TARGET
    assert interpolator.set_next_target(1, a) == Status.INCONSISTENT  # nowhere, in some time
    interpolator.set_motion_time(0.0)
    queue(interpolator, [b])
    assert steps_to_rest(interpolator)[-1].elapsed_time == pytest.approx(shortest)


def test_the_interpolation_time_changes_the_steps_not_the_motion(six_axis_limits, random_points):
    a, b = random_points(41, 2)
    fine, coarse = ready(six_axis_limits, a), ready(six_axis_limits, a)
    assert coarse.set_interpolation_time(2.0 * PERIOD) == Status.OK
    queue(fine, [b])
    queue(coarse, [b])
    slow, fast = steps_to_rest(coarse), steps_to_rest(fine)
    every_other = positions(fast)[1 : 2 * len(slow) - 2 : 2]
    np.testing.assert_allclose(positions(slow)[:-1], every_other, rtol=0, atol=1e-12)
    assert slow[-1].elapsed_time == pytest.approx(fast[-1].elapsed_time)
