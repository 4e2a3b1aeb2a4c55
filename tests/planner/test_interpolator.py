"""The interpolator: its motion, its services in any order, and its page."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule
from scipy.spatial import cKDTree

from planner import JointLimits
from planner.errors import InvalidSetting, PlannerCrashed, PlannerNotStarted
from planner.interpolator import (
    AccelerationKind,
    EventKind,
    FlybyCriterion,
    Interpolator,
    OutputFormat,
    SpeedCorrection,
    Status,
)
from planner.motion_queue import corner
from planner.moves import Move, Overrides, plan_moves
from tests.planner.six_axes import SIX_AXES, random_points

pytestmark = pytest.mark.long

PERIOD = 0.002


def ready(limits, position, *, fly=None, advance=1, **options):
    """An interpolator that waits for targets, flying by `fly` %."""
    interpolator = Interpolator(limits, PERIOD, **options)
    assert interpolator.initialize() == Status.OK
    assert interpolator.set_initial_position(position) == Status.OK
    if fly is not None:
        interpolator.select_flyby_mode(True)
        interpolator.set_flyby_criteria_parameter(FlybyCriterion.PERCENT, fly)
    interpolator.set_advance_motion(advance)
    return interpolator


def queue(interpolator, points, first=1):
    for target_id, point in enumerate(points, first):
        assert interpolator.set_next_target(target_id, point) >= 0, interpolator.refusal


def steps_to_rest(interpolator, at_most=20_000):
    """All steps up to one that is final."""
    steps = []
    while not steps or steps[-1].status in (Status.OK, Status.NEED_MORE_DATA):
        steps.append(interpolator.get_next_step())
        assert len(steps) < at_most
    assert steps[-1].status == Status.FINAL_STEP
    return steps


def positions(steps):
    return np.array([step.position for step in steps])


def events(steps):
    return [(event.kind, event.target_id) for step in steps for event in step.events]


def worst_ratios(start, q, limits, period=PERIOD):
    """Largest velocity, acceleration, jerk of set-points from rest to rest, by differences."""
    padded = np.concatenate((np.tile(start, (4, 1)), q, np.tile(q[-1], (4, 1))))
    return [
        np.max(np.abs(np.diff(padded, order, axis=0)) / period**order / bound)
        for order, bound in enumerate((limits.velocity, limits.acceleration, limits.jerk), 1)
    ]


# -- the motion ---------------------------------------------------------------------------


@given(st.integers(0, 10**6), st.sampled_from([0.0, 10.0, 50.0, 100.0]), st.integers(2, 6))
@settings(max_examples=20, deadline=None)
def test_targets_queued_at_once_are_the_plan_of_the_same_moves(seed, fly, count):
    points = random_points(seed, count)
    interpolator = ready(SIX_AXES, points[0], fly=fly)
    queue(interpolator, points[1:])
    steps = steps_to_rest(interpolator)
    moves = [Move(point, fly_percent=fly) for point in points[1:]]
    plan = plan_moves(points[0], moves, SIX_AXES)
    q, _, _ = plan.trajectory.sample(PERIOD * np.arange(1, len(steps) + 1))
    np.testing.assert_allclose(positions(steps), q, rtol=0, atol=1e-12)
    assert steps[-1].elapsed_time == pytest.approx(plan.trajectory.duration, abs=1e-9)
    # Each via point is reported in the first step at or after its passage.
    reported = {event.target_id: k for k, step in enumerate(steps, 1) for event in step.events}
    for target, passage in enumerate(plan.targets, 1):
        assert reported[target] == np.ceil(passage.time / PERIOD - 1e-6)


def test_every_setting_reaches_the_plan():
    points = random_points(5, 4)
    interpolator = ready(SIX_AXES, points[0])
    interpolator.set_joint_speeds(80.0)
    interpolator.set_joint_speeds(35.0, joints=[2])
    interpolator.set_joint_accelerations([90.0, 80.0, 70.0, 60.0, 50.0, 40.0])
    interpolator.set_joint_jerks([50.0, 60.0], joints=[0, 5])
    interpolator.set_override_speed(90.0, SpeedCorrection.PROGRAM)
    interpolator.set_override_acceleration(70.0, AccelerationKind.ACCELERATION)
    interpolator.set_override_acceleration(60.0, AccelerationKind.DECELERATION)
    interpolator.select_flyby_mode(True)
    interpolator.set_point_accuracy_parameter(FlybyCriterion.PERCENT, 60.0)
    queue(interpolator, points[1:])
    shares = {
        "joint_speed": np.array([0.8, 0.8, 0.35, 0.8, 0.8, 0.8]),
        "joint_acceleration": np.array([0.9, 0.8, 0.7, 0.6, 0.5, 0.4]),
        "joint_jerk": np.array([0.5, 1.0, 1.0, 1.0, 1.0, 0.6]),
    }
    plan = plan_moves(
        points[0],
        [Move(point, fly_percent=60.0, **shares) for point in points[1:]],
        SIX_AXES,
        Overrides(speed=0.9, acceleration=0.7, deceleration=0.6),
    )
    steps = steps_to_rest(interpolator)
    q, _, _ = plan.trajectory.sample(PERIOD * np.arange(1, len(steps) + 1))
    np.testing.assert_allclose(positions(steps), q, rtol=0, atol=1e-12)


@pytest.mark.parametrize("fly", [25.0, 100.0])
def test_targets_set_on_request_give_the_same_motion(fly):
    points = random_points(7, 6)
    at_once = ready(SIX_AXES, points[0], fly=fly)
    queue(at_once, points[1:])
    one_by_one = ready(SIX_AXES, points[0], fly=fly)
    waiting = list(enumerate(points[1:], 1))
    steps = []
    expected = steps_to_rest(at_once)
    one_by_one.set_next_target(*waiting.pop(0))
    while not steps or steps[-1].status != Status.FINAL_STEP:
        steps.append(one_by_one.get_next_step())
        if steps[-1].status == Status.NEED_MORE_DATA and waiting:
            one_by_one.set_next_target(*waiting.pop(0))
    np.testing.assert_array_equal(positions(steps), positions(expected))
    assert events(steps) == events(expected)


@given(st.integers(0, 10**6), st.floats(0.0, 1.0))
@settings(max_examples=15, deadline=None)
def test_a_late_target_finds_the_arm_stopping(seed, late):
    a, b, c = random_points(seed, 3)
    plan = plan_moves(a, [Move(b, fly_percent=50.0), Move(c)], SIX_AXES)
    alone = plan_moves(a, [Move(b)], SIX_AXES).trajectory.duration
    assume(plan.targets[0].how != "stopped")
    interpolator = ready(SIX_AXES, a, fly=50.0)
    queue(interpolator, [b])
    # Somewhere between where the corner would begin and the stop.
    corner_begins = _last_shared(plan.trajectory, a, b, SIX_AXES)
    wait = int((corner_begins + late * (alone - corner_begins)) / PERIOD)
    steps = [interpolator.get_next_step() for _ in range(wait + 1)]
    assume(steps[-1].elapsed_time >= corner_begins and steps[-1].status >= 0)
    assume(steps[-1].status != Status.FINAL_STEP)
    assert interpolator.set_next_target(2, c) >= 0
    steps += steps_to_rest(interpolator)
    stopping = plan_moves(a, [Move(b, fly_percent=0.0), Move(c)], SIX_AXES).trajectory
    q, _, _ = stopping.sample(PERIOD * np.arange(1, len(steps) + 1))
    np.testing.assert_allclose(positions(steps), q, rtol=0, atol=1e-12)
    assert events(steps) == [(EventKind.VIA_POINT_PASSED, 1), (EventKind.MOTION_ENDED, 2)]


def _last_shared(flown, a, b, limits):
    """The time at which a motion that flies by `b` leaves the one that stops there."""
    stopping = plan_moves(a, [Move(b)], limits).trajectory
    times = np.linspace(0.0, stopping.duration, 20_001)
    apart = np.abs(flown.sample(times)[0] - stopping.sample(times)[0]).max(axis=1)
    return times[np.argmax(apart > 1e-9)]


# -- more data, targets -------------------------------------------------------------------


@pytest.mark.parametrize("advance", [0, 1, 3])
def test_data_are_requested_while_few_targets_are_ahead(advance):
    points = random_points(30, 6)
    interpolator = ready(SIX_AXES, points[0], fly=50.0, advance=advance)
    statuses = [interpolator.set_next_target(k, point) for k, point in enumerate(points[1:])]
    requested = [status == Status.NEED_MORE_DATA for status in statuses]
    assert requested == [targets_set <= advance for targets_set in range(1, 6)]
    ahead = 5
    for step in steps_to_rest(interpolator)[:-1]:
        ahead -= len(step.events)
        assert (step.status == Status.NEED_MORE_DATA) == (ahead <= advance)


# -- time ---------------------------------------------------------------------------------


@given(st.integers(0, 10**6), st.floats(1.0, 6.0))
@settings(max_examples=15, deadline=None)
def test_a_motion_time_is_met(seed, factor):
    a, b, c = random_points(seed, 3)
    shortest = plan_moves(a, [Move(b)], SIX_AXES).trajectory.duration
    interpolator = ready(SIX_AXES, a)
    assert interpolator.set_motion_time(factor * shortest) == Status.OK
    queue(interpolator, [b, c])  # the time is that of one move
    first = plan_moves(b, [Move(c)], SIX_AXES).trajectory.duration
    last = steps_to_rest(interpolator)[-1].elapsed_time
    assert last == pytest.approx(factor * shortest + first, rel=1e-9)


@pytest.mark.parametrize(
    ("period", "options"),
    [(0.0, {}), (1e-3, {"override_bounds": (0.9, 1.7)}), (1e-3, {"override_bounds": (1.3, 3.5)})],
)
def test_settings_without_sense_are_refused(period, options):
    with pytest.raises(InvalidSetting):
        Interpolator(SIX_AXES, period, **options)


def test_without_a_position_there_is_no_motion():
    interpolator = Interpolator(SIX_AXES, 1e-3)
    interpolator.initialize()
    assert interpolator.set_next_target(1, random_points(1, 1)[0]) == Status.INCONSISTENT
    assert "initial position" in interpolator.refusal
    assert interpolator.get_next_step().status == Status.INCONSISTENT


def test_a_motion_time_too_short_is_refused():
    a, b = random_points(40, 2)
    shortest = plan_moves(a, [Move(b)], SIX_AXES).trajectory.duration
    interpolator = ready(SIX_AXES, a)
    interpolator.set_motion_time(0.999 * shortest)
    assert interpolator.set_next_target(1, b) == Status.TIME_TOO_SHORT == -25
    assert interpolator.get_next_step().status == Status.NO_TARGET
    assert interpolator.set_next_target(1, a) == Status.INCONSISTENT  # nowhere, in some time
    interpolator.set_motion_time(0.0)
    queue(interpolator, [b])
    assert steps_to_rest(interpolator)[-1].elapsed_time == pytest.approx(shortest)


def test_the_interpolation_time_changes_the_steps_not_the_motion():
    a, b = random_points(41, 2)
    fine = ready(SIX_AXES, a)
    coarse = ready(SIX_AXES, a)
    assert coarse.set_interpolation_time(2.0 * PERIOD) == Status.OK
    queue(fine, [b])
    queue(coarse, [b])
    slow = steps_to_rest(coarse)
    fast = steps_to_rest(fine)
    every_other = positions(fast)[1 : 2 * len(slow) - 2 : 2]
    np.testing.assert_allclose(positions(slow)[:-1], every_other, rtol=0, atol=1e-12)
    assert slow[-1].elapsed_time == pytest.approx(fast[-1].elapsed_time)


# -- overrides, stopping, continuing and cancelling ---------------------------------------

PACE_ROUNDING = 1e-5
OVERRIDE = np.array([1.0, 1.3, 1.7]) + PACE_ROUNDING
STOP = np.array([1.0, 2.0, 3.0]) + PACE_ROUNDING


@pytest.fixture(scope="module")
def points():
    return random_points(100, 4)


@pytest.fixture(scope="module")
def flown(points):
    moves = [Move(point, fly_percent=50.0) for point in points[1:]]
    return plan_moves(points[0], moves, SIX_AXES).trajectory


@pytest.fixture(scope="module")
def off_path(flown):
    """How far points (m, n) lie off the path of the plan, in the largest joint [rad]."""
    times = np.linspace(0.0, flown.duration, 200_001)
    tree = cKDTree(flown.sample(times)[0])

    def distance(q):
        _, nearest = tree.query(q)
        t = times[nearest]
        for _ in range(3):  # Newton's way to the foot of the perpendicular
            p, v, _ = flown.sample(t)
            square = np.maximum(np.sum(v * v, axis=1), 1e-12)
            t = np.clip(t + np.sum((q - p) * v, axis=1) / square, 0.0, flown.duration)
        return np.abs(flown.sample(t)[0] - q).max()

    on_path = flown.sample(np.linspace(0.1, flown.duration, 50))[0]
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
def test_an_override_changes_when_and_never_where(points, flown, off_path, changes):
    interpolator = ready(SIX_AXES, points[0], fly=50.0)
    queue(interpolator, points[1:])
    commands = {}
    last = max((when for when, _ in changes), default=0)
    for when, percent in [*changes, (last + 1, 100.0)]:
        order = lambda percent=percent: interpolator.set_override_speed(percent)  # noqa: E731
        commands.setdefault(when, []).append(order)
    q = positions(run(interpolator, commands))
    assert off_path(q) <= 1e-9
    assert np.all(worst_ratios(points[0], q, SIX_AXES) <= OVERRIDE)
    np.testing.assert_array_equal(q[-1], points[-1])


@given(st.integers(1, 1200), st.integers(0, 300), st.sampled_from([100.0, 60.0, 5.0]))
@settings(max_examples=20, deadline=None)
def test_stop_and_continue_stay_on_the_path(points, off_path, when, pause, percent):
    interpolator = ready(SIX_AXES, points[0], fly=50.0)
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
    assert np.all(worst_ratios(points[0], q, SIX_AXES) <= STOP)
    kinds = [kind for kind, _ in events(steps)]
    assert kinds.count(EventKind.VIA_POINT_PASSED) == 2
    rested = np.any(np.all(np.diff(q, axis=0) == 0.0, axis=1))
    assert kinds.count(EventKind.MOTION_STOPPED) == int(rested)


def test_a_stop_lasts_beyond_the_end_of_the_motion(points):
    """A stopped arm does not start towards a target that is set later."""
    interpolator = ready(SIX_AXES, points[0])
    queue(interpolator, points[1:2])
    steps = []
    while interpolator.get_current_target_id() is not None:
        steps.append(interpolator.get_next_step())
        if len(steps) > 1 and np.abs(points[1] - steps[-1].position).max() < 1e-3:
            interpolator.stop_motion()
    assert events(steps) == [(EventKind.MOTION_ENDED, 1)]
    queue(interpolator, points[2:3], first=2)
    step = interpolator.get_next_step()
    assert (step.status, step.events, step.elapsed_time) == (Status.FINAL_STEP, (), 0.0)
    np.testing.assert_array_equal(step.position, points[1])
    interpolator.continue_motion()
    assert events(steps_to_rest(interpolator)) == [(EventKind.MOTION_ENDED, 2)]


# -- refusals -----------------------------------------------------------------------------


REFUSED = {
    "select_motion_type": [(2,)],
    "set_advance_motion": [(-1,), (1.5,)],
    "set_joint_speeds": [(50.0, [6]), (50.0, [0.5]), (50.0, 1), ([50.0, 50.0],), (10**400,),
                         (None,), (0.0,), (101.0,), (np.nan,)],
    "set_joint_accelerations": [(-5.0,)],
    "set_joint_jerks": [("fast",)],
    "set_override_speed": [("50",), (-1.0,), (50.0, 7), (0.0, SpeedCorrection.PROGRAM)],
    "set_override_acceleration": [(50.0, 9), (0.0,)],
    "select_flyby_mode": [("off",)],
    "select_flyby_criteria": [([],), (7,), (FlybyCriterion.DISTANCE,)],
    "set_flyby_criteria_parameter": [(3, 10.0), (FlybyCriterion.PERCENT, "x"),
                                     (FlybyCriterion.PERCENT, 100.5)],
    "cancel_flyby_criteria": [(3,)],
    "select_point_accuracy": [("fine",)],
    "set_point_accuracy_parameter": [(3, 10.0)],
    "set_motion_time": [(-1.0,), (np.inf,)],
    "set_interpolation_time": [(np.nan,), (0.0,)],
    "set_initial_position": [(None,), ([[0.0], [0.0, 1.0]],)],
    "set_next_target": [("two", [0.0] * 6), (2, [0.0] * 5), (2, [0.0] * 5 + [99.0])],
}  # fmt: skip


@pytest.mark.parametrize(
    ("service", "arguments"),
    [(service, arguments) for service, each in REFUSED.items() for arguments in each],
)
def test_a_refused_service_changes_nothing(service, arguments):
    points = random_points(51, 3)

    def run(*, disturbed):
        interpolator = ready(SIX_AXES, points[0], fly=80.0)
        if disturbed:
            assert getattr(interpolator, service)(*arguments) == Status.INCONSISTENT == -76
            assert interpolator.refusal
        queue(interpolator, points[1:])
        return positions(steps_to_rest(interpolator))

    np.testing.assert_array_equal(run(disturbed=True), run(disturbed=False))


def test_a_step_in_another_format_than_joints_is_refused():
    a, b = random_points(57, 2)
    interpolator = ready(SIX_AXES, a)
    queue(interpolator, [b])
    assert interpolator.get_next_step(OutputFormat.CARTESIAN).status == Status.OUTPUT_FORMAT
    assert interpolator.get_next_step(0).status >= 0


@pytest.mark.parametrize("bring_to_rest", ["stop_motion", "cancel_motion"])
@pytest.mark.parametrize("service", ["initialize", "reset", "terminate"])
def test_a_moving_arm_refuses_the_end_of_the_session(service, bring_to_rest):
    a, b = random_points(58, 2)
    interpolator = ready(SIX_AXES, a)
    queue(interpolator, [b])
    moving = [interpolator.get_next_step() for _ in range(50)]
    assert getattr(interpolator, service)() == Status.INCONSISTENT
    getattr(interpolator, bring_to_rest)()
    assert getattr(interpolator, service)() == Status.INCONSISTENT  # it still comes to rest
    steps = moving + steps_to_rest(interpolator)
    assert max(worst_ratios(a, positions(steps), SIX_AXES)) <= STOP[2]
    assert getattr(interpolator, service)() == Status.OK
    assert interpolator.get_current_target_id() is None


def test_a_crash_of_the_planner_does_not_change_the_motion(monkeypatch):
    points = random_points(53, 3)
    interpolator = ready(SIX_AXES, points[0], fly=50.0, isolated=True)
    queue(interpolator, points[1:2])

    def crashes(*_):
        raise PlannerCrashed(-9)

    monkeypatch.setattr("planner.motion_queue.in_child", crashes)
    assert interpolator.set_next_target(2, points[2]) == Status.FATAL == -68
    assert "signal 9" in interpolator.refusal
    steps = steps_to_rest(interpolator)
    assert events(steps) == [(EventKind.MOTION_ENDED, 1)]
    np.testing.assert_array_equal(steps[-1].position, points[1])


def test_a_corner_with_a_jump_is_refused(monkeypatch):
    points = random_points(55, 3)

    def careless(legs, fly):
        planned = corner(legs, fly)
        return planned._replace(leave=0.9 * planned.leave)

    monkeypatch.setattr("planner.motion_queue.corner", careless)
    interpolator = ready(SIX_AXES, points[0], fly=50.0, isolated=False)
    queue(interpolator, points[1:2])
    assert interpolator.set_next_target(2, points[2]) == Status.FATAL
    steps = steps_to_rest(interpolator)
    assert events(steps) == [(EventKind.MOTION_ENDED, 1)]
    assert max(worst_ratios(points[0], positions(steps), SIX_AXES)) <= 1.0 + 1e-5


def test_joints_at_an_end_of_their_range_are_flagged():
    start = np.zeros(6)
    target = np.zeros(6)
    target[[1, 4]] = SIX_AXES.upper[1], SIX_AXES.lower[4]
    interpolator = ready(SIX_AXES, start)
    queue(interpolator, [target])
    steps = steps_to_rest(interpolator)
    assert steps[-1].joint_limits == 0b010010
    assert not any(step.joint_limits for step in steps[:-2])


def test_without_a_planning_process_it_is_not_initialized(monkeypatch):
    def fails(*_):
        raise PlannerNotStarted(1)

    monkeypatch.setattr("planner.interpolator.in_child", fails)
    interpolator = Interpolator(SIX_AXES, PERIOD)
    assert interpolator.initialize() == Status.FATAL
    assert "could not be started" in interpolator.refusal
    assert interpolator.set_initial_position(random_points(0, 1)[0]) == Status.INCONSISTENT
    assert Interpolator(SIX_AXES, PERIOD, isolated=False).initialize() == Status.OK


# -- any services in any order ------------------------------------------------------------

ROUNDING = 1e-4  # of differences over three periods
PERIODS = (0.004, 0.01)
LIMITS = JointLimits(
    lower=np.array([-3.0, -1.0, -0.02]),
    upper=np.array([3.0, 2.0, 0.03]),
    velocity=np.array([2.5, 3.0, 0.5]),
    acceleration=np.array([9.0, 25.0, 6.0]),
    jerk=np.array([90.0, 400.0, 90.0]),
)
RATES = (LIMITS.velocity, LIMITS.acceleration, LIMITS.jerk)
SHARES = st.one_of(st.just(0.0), st.just(1.0), st.floats(0.0, 1.0))
PERCENT = st.one_of(st.just(100.0), st.floats(30.0, 100.0))


def point(shares):
    inside = LIMITS.lower + np.array(shares) * (LIMITS.upper - LIMITS.lower)
    return np.clip(inside, LIMITS.lower, LIMITS.upper)


class AnyServices(RuleBasedStateMachine):
    """Set-points are judged as a guard would: by differences of what was sent."""

    @initialize(shares=st.tuples(SHARES, SHARES, SHARES))
    def begin(self, shares):
        self.interpolator = Interpolator(LIMITS, PERIODS[0])
        self.period = PERIODS[0]
        start = point(shares)
        assert self.interpolator.set_next_target(1, start) == Status.INCONSISTENT
        assert self.interpolator.initialize() == Status.OK
        assert self.interpolator.set_initial_position(start) == Status.OK
        self.sent = [start] * 4
        self.queued: list[tuple[int, np.ndarray]] = []
        self.next_id = 1
        self.factors = (1.0, 1.0, 1.0)
        self.stopped = self.cancelled = False

    @rule(shares=st.tuples(SHARES, SHARES, SHARES), tiny=st.booleans())
    def set_target(self, shares, tiny):
        target = point(shares)
        if tiny:
            last = self.queued[-1][1] if self.queued else self.sent[-1]
            target = np.clip(last + 1e-6 * (target - last), LIMITS.lower, LIMITS.upper)
        status = self.interpolator.set_next_target(self.next_id, target)
        if self.cancelled:
            assert status == Status.INCONSISTENT
        elif status != Status.TIME_TOO_SHORT and status != Status.INCONSISTENT:
            assert status in (Status.OK, Status.NEED_MORE_DATA), self.interpolator.refusal
            self.queued.append((self.next_id, target))
            self.next_id += 1
        else:
            assert "motion time" in self.interpolator.refusal
            assert self.interpolator.set_motion_time(0.0) == Status.OK

    @rule(seconds=st.floats(0.0, 2.0))
    def take_time(self, seconds):
        assert self.interpolator.set_motion_time(seconds) == Status.OK

    @rule(count=st.sampled_from([1, 3, 20, 100]))
    def step(self, count):
        for _ in range(count):
            self._step()

    def _step(self):
        step = self.interpolator.get_next_step()
        if not self.queued:
            assert step.status == Status.NO_TARGET
        else:
            assert step.status in (Status.OK, Status.NEED_MORE_DATA, Status.FINAL_STEP)
        self.sent = [*self.sent[-3:], step.position]
        for order, (rate, factor) in enumerate(zip(RATES, self.factors, strict=True), 1):
            reached = np.abs(np.diff(self.sent[-order - 1 :], order, axis=0)[-1])
            assert np.all(reached <= factor * (1.0 + ROUNDING) * rate * self.period**order)
        assert np.all(step.position >= LIMITS.lower - 1e-11)
        assert np.all(step.position <= LIMITS.upper + 1e-11)
        for event in step.events:
            self._heed(event, step)

    def _heed(self, event, step):
        target_id, target = self.queued[0]
        assert event.target_id == target_id
        if event.kind is EventKind.MOTION_STOPPED:
            assert step.status == Status.FINAL_STEP
            assert self.stopped or self.cancelled
            if self.cancelled:
                self.queued.clear()
                self.stopped = self.cancelled = False
            return
        self.queued.pop(0)
        if event.kind is EventKind.MOTION_ENDED:
            assert step.status == Status.FINAL_STEP
            assert not self.queued
            np.testing.assert_array_equal(step.position, target)
            self.cancelled = False

    @rule(percent=st.one_of(st.just(0.0), PERCENT))
    def override(self, percent):
        self.factors = tuple(np.maximum(self.factors, (1.0, 1.3, 1.7)))
        assert self.interpolator.set_override_speed(percent) == Status.OK

    @rule()
    def stop(self):
        self.factors = (1.0, 2.0, 3.0)
        assert self.interpolator.stop_motion() == Status.OK
        self.stopped = True

    @rule()
    def resume(self):
        assert self.interpolator.continue_motion() == Status.OK
        self.stopped = False

    @rule()
    def cancel(self):
        self.factors = (1.0, 2.0, 3.0)
        assert self.interpolator.cancel_motion() == Status.OK
        if self.interpolator.get_current_target_id() is None:  # the arm stood already
            self.queued.clear()
            self.stopped = self.cancelled = False
        else:
            self.cancelled = True

    @rule(on=st.booleans(), percent=st.floats(0.0, 100.0))
    def fly(self, on, percent):
        interpolator = self.interpolator
        assert interpolator.select_flyby_mode(on) == Status.OK
        status = interpolator.set_point_accuracy_parameter(FlybyCriterion.PERCENT, percent)
        assert status == Status.OK

    @rule(a=PERCENT, b=PERCENT, c=PERCENT, joint=st.integers(0, 2))
    def rates(self, a, b, c, joint):
        interpolator = self.interpolator
        assert interpolator.set_joint_speeds(a) == Status.OK
        assert interpolator.set_joint_accelerations(b, [joint]) == Status.OK
        assert interpolator.set_joint_jerks(c, [joint]) == Status.OK
        assert interpolator.set_override_speed(c, SpeedCorrection.PROGRAM) == Status.OK
        assert interpolator.set_override_acceleration(a, AccelerationKind.DECELERATION) == 0

    @rule(period=st.sampled_from(PERIODS))
    def change_period(self, period):
        if self.interpolator.set_interpolation_time(period) == Status.OK:
            self.period = period
            self.sent = [self.sent[-1]] * 4  # only an arm at rest lets it change

    @precondition(lambda self: not self.queued)
    @rule()
    def place(self):
        assert self.interpolator.set_initial_position(self.sent[-1]) in (0, -76)

    @invariant()
    def the_current_target_is_the_first_unreported(self):
        expected = self.queued[0][0] if self.queued else None
        assert self.interpolator.get_current_target_id() == expected

    def teardown(self):
        if not hasattr(self, "sent"):
            return
        self.resume()
        self.override(100.0)
        last = self.queued[-1][1] if self.queued and not self.cancelled else None
        for _ in range(40_000):
            if not self.queued:
                break
            self._step()
        assert not self.queued
        if last is not None:
            np.testing.assert_array_equal(self.sent[-1], last)


class TestAnyServices(AnyServices.TestCase):
    settings = settings(max_examples=25, stateful_step_count=25, deadline=None)


@pytest.mark.slow
class TestManyServices(AnyServices.TestCase):
    settings = settings(max_examples=1000, stateful_step_count=60, deadline=None)


# -- the page ------------------------------------------------------------------------------

PAGE = Path(__file__).parents[2] / "docs" / "motion.md"


@pytest.fixture(scope="module")
def page():
    return PAGE.read_text().split("\n## The interpolator\n")[1]


def test_the_example_runs_to_its_last_target(page):
    (code,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    names: dict = {}
    exec(code, names)
    assert [event.target_id for event in names["events"]] == [1, 2, 3, 4]
    assert names["events"][-1].kind is EventKind.MOTION_ENDED
    np.testing.assert_array_equal(names["set_points"][-1], [0.0, 0.0])
    assert not any(np.allclose(q, [1.0, 0.5], atol=1e-4) for q in names["set_points"])  # flown by


def test_every_service_and_code_is_on_the_page_and_no_other(page):
    services = {
        name
        for name in dir(Interpolator)
        if not name.startswith("_") and callable(getattr(Interpolator, name))
    }
    table = page.split("## Services")[1].split("## Differences")[0]
    assert set(re.findall(r"`([a-z_]+)`", table)) == services
    codes = re.findall(r"^\| (-?\d+) \| ([A-Z_]+) \|", page, re.MULTILINE)
    assert [(int(code), name) for code, name in codes] == [(s.value, s.name) for s in Status]
