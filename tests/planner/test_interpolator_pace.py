"""Overrides, stopping, continuing and cancelling while the motion runs."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from planner.commands import FlyPercent, Move
from planner.moves import plan_moves
from planner.rrs import EventKind, Status
from tests.planner.interpolating import (
    PERIOD,
    events,
    positions,
    queue,
    ready,
    steps_to_rest,
    worst_ratios,
)

ROUNDING = 1e-5
OVERRIDE = np.array([1.0, 1.3, 1.7]) + ROUNDING
STOP = np.array([1.0, 2.0, 3.0]) + ROUNDING


@pytest.fixture(scope="module")
def points(random_points):
    return random_points(100, 4)


@pytest.fixture(scope="module")
def plan(six_axis_limits, points):
    moves = [Move(point, fly=FlyPercent(50.0)) for point in points[1:]]
    return plan_moves(points[0], moves, six_axis_limits).trajectory


@pytest.fixture(scope="module")
def off_path(plan):
    """How far points (m, n) lie off the path of the plan, in the largest joint [rad]."""
    times = np.linspace(0.0, plan.duration, 200_001)
    tree = cKDTree(plan.sample(times)[0])

    def distance(q):
        _, nearest = tree.query(q)
        t = times[nearest]
        for _ in range(3):  # Newton's way to the foot of the perpendicular
            p, v, _ = plan.sample(t)
            square = np.maximum(np.sum(v * v, axis=1), 1e-12)
            t = np.clip(t + np.sum((q - p) * v, axis=1) / square, 0.0, plan.duration)
        return np.abs(plan.sample(t)[0] - q).max()

    on_path = plan.sample(np.linspace(0.1, plan.duration, 50))[0]
    assert distance(on_path) <= 1e-11
    assert distance(on_path + 1e-8 * np.array([1, -1, 1, -1, 1, -1])) > 1e-9  # it can tell
    return distance


def run(interpolator, commands):
    """All steps to the end of the motion; `commands` are called before the steps they name."""
    steps = []
    while not any(kind is EventKind.MOTION_ENDED for kind, _ in events(steps[-1:])):
        for command in commands.get(len(steps), ()):
            assert command() == Status.OK
        steps.append(interpolator.get_next_step())
        assert len(steps) < 20_000
    return steps


@given(
    st.lists(
        st.tuples(st.integers(0, 3000), st.sampled_from([0.0, 1.0, 20.0, 50.0, 99.0, 100.0])),
        max_size=5,
    )
)
@settings(max_examples=20, deadline=None)
def test_an_override_changes_when_and_never_where(six_axis_limits, points, plan, off_path, changes):
    interpolator = ready(six_axis_limits, points[0], fly=50.0)
    queue(interpolator, points[1:])
    commands = {}
    last = max((when for when, _ in changes), default=0)
    for when, percent in [*changes, (last + 1, 100.0)]:
        order = lambda percent=percent: interpolator.set_override_speed(percent)  # noqa: E731
        commands.setdefault(when, []).append(order)
    q = positions(run(interpolator, commands))
    assert off_path(q) <= 1e-9
    assert np.all(worst_ratios(points[0], q, six_axis_limits) <= OVERRIDE)
    np.testing.assert_array_equal(q[-1], points[-1])


def test_a_constant_override_stretches_time(six_axis_limits, points, plan):
    interpolator = ready(six_axis_limits, points[0], fly=50.0)
    interpolator.set_override_speed(20.0)
    queue(interpolator, points[1:])
    steps = steps_to_rest(interpolator)
    q, _, _ = plan.sample(0.2 * PERIOD * np.arange(1, len(steps) + 1))
    np.testing.assert_allclose(positions(steps), q, rtol=0, atol=1e-12)
    assert steps[-1].elapsed_time == pytest.approx(5.0 * plan.duration, rel=1e-9)


@given(st.integers(1, 1200), st.integers(0, 300), st.sampled_from([100.0, 60.0, 5.0]))
@settings(max_examples=20, deadline=None)
def test_stop_and_continue_stay_on_the_path(
    six_axis_limits, points, off_path, when, pause, percent
):
    interpolator = ready(six_axis_limits, points[0], fly=50.0)
    interpolator.set_override_speed(percent)
    queue(interpolator, points[1:])
    commands = {
        when: [interpolator.stop_motion],
        when + pause: [lambda: interpolator.set_override_speed(100.0)],
        when + pause + 1: [interpolator.continue_motion],
    }
    steps = run(interpolator, commands)
    q = positions(steps)
    assert off_path(q) <= 1e-9
    assert np.all(worst_ratios(points[0], q, six_axis_limits) <= STOP)
    told = [kind for kind, _ in events(steps)]
    assert told.count(EventKind.VIA_POINT_PASSED) == 2
    still = np.all(np.diff(q, axis=0) == 0.0, axis=1)
    # What was told of a stop is so, and an arm that stood was told to stand.
    assert told.count(EventKind.MOTION_STOPPED) == int(np.any(still))


@pytest.mark.parametrize("after", [20, 60, 120, 180, 199])
def test_an_override_that_is_no_change_does_not_disturb_a_motion_that_goes_on(
    six_axis_limits, points, after
):
    """By then it gathers speed so fast that under the bounds of an override it would overshoot."""

    def go_on(*, again):
        interpolator = ready(six_axis_limits, points[0], fly=50.0)
        queue(interpolator, points[1:])
        commands = {
            200: [interpolator.stop_motion],
            400: [interpolator.continue_motion],
            400 + after: [lambda: interpolator.set_override_speed(100.0)] if again else [],
        }
        return positions(run(interpolator, commands))

    np.testing.assert_allclose(go_on(again=True), go_on(again=False), rtol=0, atol=1e-12)


def test_a_stopped_arm_stands_until_it_may_go_on(six_axis_limits, points):
    interpolator = ready(six_axis_limits, points[0], fly=50.0)
    queue(interpolator, points[1:])
    for _ in range(200):
        interpolator.get_next_step()
    target = interpolator.get_current_target_id()
    interpolator.stop_motion()
    stopping = steps_to_rest(interpolator)
    assert events(stopping)[-1] == (EventKind.MOTION_STOPPED, target)
    interpolator.set_override_speed(50.0)  # for later
    standing = [interpolator.get_next_step() for _ in range(50)]
    assert {step.status for step in standing} == {Status.FINAL_STEP}
    assert len({step.position.tobytes() for step in [stopping[-1], *standing]}) == 1
    assert not events(standing)
    assert interpolator.stop_motion() == Status.OK
    interpolator.continue_motion()
    assert events(steps_to_rest(interpolator))[-1] == (EventKind.MOTION_ENDED, 3)


def test_a_stop_before_the_first_step_holds_the_arm_where_it_is(six_axis_limits, points):
    interpolator = ready(six_axis_limits, points[0])
    interpolator.stop_motion()
    queue(interpolator, points[1:2])
    for _ in range(3):
        step = interpolator.get_next_step()
        assert step.status == Status.FINAL_STEP
        np.testing.assert_array_equal(step.position, points[0])
    interpolator.continue_motion()
    other = ready(six_axis_limits, points[0])
    queue(other, points[1:2])
    np.testing.assert_array_equal(
        positions(steps_to_rest(interpolator)), positions(steps_to_rest(other))
    )


def test_a_stop_outlasts_the_end_of_the_motion(six_axis_limits, points):
    """An arm that was told to stop does not set off for a target that comes later."""
    interpolator = ready(six_axis_limits, points[0])
    queue(interpolator, points[1:2])
    steps = []
    while interpolator.get_current_target_id() is not None:
        steps.append(interpolator.get_next_step())
        if len(steps) > 1 and np.abs(points[1] - steps[-1].position).max() < 1e-3:
            interpolator.stop_motion()
    assert events(steps) == [(EventKind.MOTION_ENDED, 1)]
    queue(interpolator, points[2:3], first=2)
    step = interpolator.get_next_step()
    assert (step.status, step.events) == (Status.FINAL_STEP, ())
    np.testing.assert_array_equal(step.position, points[1])
    interpolator.continue_motion()
    assert events(steps_to_rest(interpolator)) == [(EventKind.MOTION_ENDED, 2)]


@given(st.integers(1, 1000), st.booleans())
@settings(max_examples=20, deadline=None)
def test_a_cancelled_motion_leaves_the_arm_on_its_path_ready_for_another(
    six_axis_limits, points, off_path, when, stopped
):
    interpolator = ready(six_axis_limits, points[0], fly=50.0)
    queue(interpolator, points[1:])
    steps = [interpolator.get_next_step() for _ in range(when)]
    assume(not any(kind is EventKind.MOTION_ENDED for kind, _ in events(steps)))
    if stopped:
        interpolator.stop_motion()
        steps += [interpolator.get_next_step() for _ in range(300)]
        assume(interpolator.get_current_target_id() is not None)  # else the end came first
    interpolator.cancel_motion()
    if not stopped:
        assert interpolator.set_next_target(9, points[0]) == Status.INCONSISTENT
        steps += steps_to_rest(interpolator)
    assert off_path(positions(steps)) <= 1e-9
    assert interpolator.get_next_step().status == Status.NO_TARGET
    assert interpolator.get_current_target_id() is None
    queue(interpolator, points[:1], first=9)
    back = steps_to_rest(interpolator)
    q = positions(steps + back)
    assert np.all(worst_ratios(points[0], q, six_axis_limits) <= STOP)
    np.testing.assert_array_equal(q[-1], points[0])
    assert events(back) == [(EventKind.MOTION_ENDED, 9)]


def test_targets_may_come_while_the_override_changes(six_axis_limits, points, plan, off_path):
    interpolator = ready(six_axis_limits, points[0], fly=50.0)
    queue(interpolator, points[1:2])
    interpolator.set_override_speed(30.0)
    steps = [interpolator.get_next_step() for _ in range(20)]
    interpolator.set_override_speed(100.0)
    steps += [interpolator.get_next_step() for _ in range(20)]
    queue(interpolator, points[2:], first=2)
    steps += steps_to_rest(interpolator)
    assert off_path(positions(steps)) <= 1e-9
