from __future__ import annotations

import os
import signal

import numpy as np
import pytest

from planner import worker
from planner.errors import InvalidSetting, PlannerNotStarted
from planner.interpolator import Interpolator
from planner.moves import corner
from planner.rrs import EventKind, FlybyCriterion, SpeedCorrection, Status
from planner.worker import in_child
from tests.planner.interpolating import (
    PERIOD,
    events,
    positions,
    queue,
    ready,
    steps_to_rest,
    worst_ratios,
)


def test_nothing_is_answered_before_initialize_and_after_terminate(six_axis_limits, random_points):
    a, b = random_points(50, 2)
    interpolator = Interpolator(six_axis_limits, PERIOD)
    for _ in range(2):
        for refused in (
            interpolator.set_initial_position(a),
            interpolator.set_next_target(1, b),
            interpolator.set_override_speed(50.0),
            interpolator.stop_motion(),
            interpolator.cancel_motion(),
            interpolator.select_flyby_mode(True),
            interpolator.reset(),
            interpolator.terminate(),
        ):
            assert refused == Status.INCONSISTENT
        step = interpolator.get_next_step()
        assert step.status == Status.INCONSISTENT
        assert np.all(np.isnan(step.position))
        interpolator.initialize()
        assert interpolator.set_next_target(1, b) == Status.INCONSISTENT  # no position yet
        interpolator.set_initial_position(a)
        assert interpolator.get_next_step().status == Status.NO_TARGET == -42
        queue(interpolator, [b])
        steps_to_rest(interpolator)
        assert interpolator.terminate() == Status.OK


@pytest.mark.parametrize(
    ("service", "arguments", "code"),
    [
        ("select_motion_type", (2,), -76),
        ("select_motion_type", (4,), -76),
        ("set_advance_motion", (-1,), -76),
        ("set_advance_motion", (1.5,), -76),
        ("set_advance_motion", (True,), -76),
        ("set_advance_motion", ("1",), -76),
        ("select_motion_type", (True,), -76),
        ("select_motion_type", ([1],), -76),
        ("set_joint_speeds", (50.0, [-1]), -76),
        ("set_joint_speeds", (50.0, [True, False]), -76),
        ("set_joint_speeds", (50.0, [0.5]), -76),
        ("set_joint_speeds", (50.0, 1), -76),
        ("set_joint_speeds", ([[50.0] * 6],), -76),
        ("set_joint_speeds", (10**400,), -76),
        ("set_joint_speeds", (None,), -76),
        ("set_joint_speeds", ([True] * 6,), -76),
        ("set_override_speed", ("fast",), -76),
        ("set_override_speed", (None,), -76),
        ("set_override_speed", (True,), -76),
        ("set_override_speed", (10**400,), -76),
        ("set_override_speed", (50.0, 7), -76),
        ("set_override_speed", (50.0, []), -76),
        ("set_override_acceleration", ("50",), -76),
        ("set_override_acceleration", (50.0, 9), -76),
        ("select_flyby_mode", ("off",), -76),
        ("select_flyby_mode", (None,), -76),
        ("select_flyby_mode", ([],), -76),
        ("select_flyby_criteria", (np.nan,), -76),
        ("select_flyby_criteria", ([],), -76),
        ("set_flyby_criteria_parameter", ([], 1.0), -76),
        ("set_flyby_criteria_parameter", (FlybyCriterion.PERCENT, "x"), -76),
        ("cancel_flyby_criteria", ({},), -76),
        ("select_point_accuracy", ("fine",), -76),
        ("select_point_accuracy", (True,), -76),
        ("set_motion_time", (None,), -76),
        ("set_motion_time", ("1",), -76),
        ("set_interpolation_time", ("a",), -76),
        ("set_interpolation_time", (np.nan,), -76),
        ("set_initial_position", (None,), -76),
        ("set_initial_position", ([10**400] + [0] * 5,), -76),
        ("set_initial_position", ([1j] * 6,), -76),
        ("set_initial_position", ([[0.0], [0.0, 1.0]],), -76),
        ("set_next_target", ("two", [0.0] * 6), -76),
        ("set_next_target", (True, [0.0] * 6), -76),
        ("set_next_target", (2, ["0"] * 6), -76),
        ("set_next_target", (2, [False] * 6), -76),
        ("set_joint_speeds", (0.0,), -76),
        ("set_joint_speeds", (101.0,), -76),
        ("set_joint_speeds", (np.nan,), -76),
        ("set_joint_speeds", ([50.0, 50.0],), -76),
        ("set_joint_speeds", (50.0, [6]), -76),
        ("set_joint_accelerations", (-5.0,), -76),
        ("set_joint_jerks", ("fast",), -76),
        ("set_override_speed", (-1.0,), -76),
        ("set_override_speed", (np.nan,), -76),
        ("set_override_speed", (0.0, SpeedCorrection.PROGRAM), -76),
        ("set_override_acceleration", (0.0,), -76),
        ("select_flyby_criteria", (7,), -76),
        ("set_flyby_criteria_parameter", (FlybyCriterion.PERCENT, 100.5), -76),
        ("set_flyby_criteria_parameter", (FlybyCriterion.DISTANCE, -0.1), -76),
        ("set_flyby_criteria_parameter", (3, 10.0), -76),
        ("set_point_accuracy_parameter", (3, 10.0), -76),
        ("cancel_flyby_criteria", (3,), -76),
        ("select_point_accuracy", (9,), -76),
        ("set_motion_time", (-1.0,), -76),
        ("set_motion_time", (np.inf,), -76),
        ("set_interpolation_time", (0.0,), -76),
        ("set_next_target", (2, [0.0] * 5), -76),
        ("set_next_target", (2, [np.nan] * 6), -76),
        ("set_next_target", (2, [0.0] * 5 + [99.0]), -76),
        ("set_next_target", (2, ["north"] * 6), -76),
    ],
)
def test_a_refused_service_changes_nothing(
    six_axis_limits, random_points, service, arguments, code
):
    points = random_points(51, 3)

    def run(*, disturbed):
        interpolator = ready(six_axis_limits, points[0], fly=80.0)
        if disturbed:
            assert getattr(interpolator, service)(*arguments) == code
            assert interpolator.refusal
        queue(interpolator, points[1:])
        return positions(steps_to_rest(interpolator))

    np.testing.assert_array_equal(run(disturbed=True), run(disturbed=False))


def test_numbers_of_numpy_are_numbers(six_axis_limits, random_points):
    points = random_points(56, 2)
    interpolator = ready(six_axis_limits, points[0])
    for status in (
        interpolator.set_advance_motion(np.int64(2)),
        interpolator.set_joint_speeds(np.float32(50.0), np.arange(2)),
        interpolator.set_joint_speeds(np.full(6, 50)),
        interpolator.set_override_speed(np.int32(100), np.int64(SpeedCorrection.PROGRAM)),
        interpolator.select_flyby_mode(np.True_),
        interpolator.select_flyby_criteria(np.int16(FlybyCriterion.DISTANCE)),
    ):
        assert status == Status.OK, interpolator.refusal
    assert interpolator.set_next_target(np.int64(3), points[1]) >= 0
    assert interpolator.get_current_target_id() == 3


@pytest.mark.parametrize("wanted", ["joint", 5, None, [0], np.zeros(2)])
def test_a_step_in_any_other_format_is_refused(six_axis_limits, random_points, wanted):
    a, b = random_points(57, 2)
    interpolator = ready(six_axis_limits, a)
    queue(interpolator, [b])
    assert interpolator.get_next_step(wanted).status == Status.OUTPUT_FORMAT
    assert interpolator.get_next_step(np.int64(0)).status >= 0


@pytest.mark.parametrize("bring_to_rest", ["stop_motion", "cancel_motion"])
@pytest.mark.parametrize("service", ["initialize", "reset", "terminate"])
def test_a_moving_arm_is_not_forgotten(six_axis_limits, random_points, service, bring_to_rest):
    a, b = random_points(58, 2)
    interpolator = ready(six_axis_limits, a)
    queue(interpolator, [b])
    moving = [interpolator.get_next_step() for _ in range(50)]
    assert getattr(interpolator, service)() == Status.INCONSISTENT
    getattr(interpolator, bring_to_rest)()
    assert getattr(interpolator, service)() == Status.INCONSISTENT  # it still comes to rest
    steps = moving + steps_to_rest(interpolator)
    assert np.max(np.abs(np.diff(positions(steps), axis=0))) < 1.01 * PERIOD * np.max(
        six_axis_limits.velocity
    )
    assert getattr(interpolator, service)() == Status.OK
    assert interpolator.get_current_target_id() is None


def test_what_would_make_a_moving_arm_jump_is_refused(six_axis_limits, random_points):
    a, b = random_points(52, 2)
    interpolator = ready(six_axis_limits, a)
    queue(interpolator, [b])
    for _ in range(20):
        interpolator.get_next_step()
    assert interpolator.set_initial_position(b) == Status.INCONSISTENT
    assert interpolator.set_interpolation_time(0.001) == Status.INCONSISTENT
    assert interpolator.reset() == Status.INCONSISTENT
    cartesian = interpolator.get_next_step(1)
    assert cartesian.status == Status.OUTPUT_FORMAT == -13
    steps_to_rest(interpolator)
    assert interpolator.reset() == Status.OK
    assert interpolator.get_next_step().status == Status.INCONSISTENT


def test_a_planner_that_died_leaves_the_motion_to_the_target_before_and_nobody_waits(
    six_axis_limits, random_points
):
    points = random_points(53, 3)
    interpolator = ready(six_axis_limits, points[0], fly=50.0, isolated=True)
    queue(interpolator, points[1:2])

    dead = in_child(os.getpid)
    os.kill(dead, signal.SIGKILL)
    assert worker._warm[0].connection.poll(5.0)
    assert interpolator.set_next_target(2, points[2]) == Status.FATAL == -68
    assert "signal 9" in interpolator.refusal
    steps = steps_to_rest(interpolator)
    assert events(steps) == [(EventKind.MOTION_ENDED, 1)]
    np.testing.assert_array_equal(steps[-1].position, points[1])
    assert in_child(os.getpid) != dead


def test_a_corner_that_would_jump_is_not_taken(six_axis_limits, random_points, monkeypatch):
    points = random_points(55, 3)

    def careless(before, after, fly):
        planned = corner(before, after, fly)
        return planned._replace(leave=0.9 * planned.leave)

    monkeypatch.setattr("planner.interpolator.corner", careless)
    interpolator = ready(six_axis_limits, points[0], fly=50.0, isolated=False)
    queue(interpolator, points[1:2])
    assert interpolator.set_next_target(2, points[2]) == Status.FATAL
    steps = steps_to_rest(interpolator)
    assert events(steps) == [(EventKind.MOTION_ENDED, 1)]
    assert max(worst_ratios(points[0], positions(steps), six_axis_limits)) <= 1.0 + 1e-5


def test_corners_planned_in_a_child_process_are_the_same(six_axis_limits, random_points):
    points = random_points(54, 4)
    runs = []
    for isolated in (False, True):
        interpolator = ready(six_axis_limits, points[0], fly=60.0, isolated=isolated)
        queue(interpolator, points[1:])
        runs.append(positions(steps_to_rest(interpolator)))
    np.testing.assert_array_equal(*runs)


@pytest.mark.parametrize(
    ("period", "options"),
    [
        (0.0, {}),
        (np.nan, {}),
        (PERIOD, {"override_bounds": (1.0, 1.7)}),
        (PERIOD, {"override_bounds": (2.5, 2.5)}),
        (PERIOD, {"stop_bounds": (1.2, 3.0)}),
    ],
)
def test_an_interpolator_that_cannot_be_is_refused(six_axis_limits, period, options):
    with pytest.raises(InvalidSetting):
        Interpolator(six_axis_limits, period, **options)


def test_joints_at_an_end_of_their_range_are_flagged(six_axis_limits):
    start = np.zeros(6)
    target = np.zeros(6)
    target[[1, 4]] = six_axis_limits.upper[1], six_axis_limits.lower[4]
    interpolator = ready(six_axis_limits, start)
    queue(interpolator, [target])
    steps = steps_to_rest(interpolator)
    assert steps[-1].joint_limits == 0b010010
    assert not any(step.joint_limits for step in steps[:-2])


def test_an_interpolator_whose_planning_process_does_not_start_is_not_initialized(
    six_axis_limits, random_points, monkeypatch
):
    def fails(*_):
        raise PlannerNotStarted(1)

    monkeypatch.setattr("planner.interpolator.in_child", fails)
    interpolator = Interpolator(six_axis_limits, PERIOD)
    assert interpolator.initialize() == Status.FATAL
    assert "could not be started" in interpolator.refusal
    assert interpolator.set_initial_position(random_points(0, 1)[0]) == Status.INCONSISTENT
    assert Interpolator(six_axis_limits, PERIOD, isolated=False).initialize() == Status.OK
