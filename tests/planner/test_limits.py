from __future__ import annotations

import numpy as np
import pytest

from planner import InvalidLimits, JointLimits, NotSmooth, PiecewiseCubic, plan
from planner.verify import check_rest, check_smooth

GOOD = {
    "lower": [-1.0, -2.0],
    "upper": [1.0, 2.0],
    "velocity": [1.0, 1.0],
    "acceleration": [2.0, 2.0],
    "jerk": [10.0, 10.0],
}


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("upper", [1.0, np.inf]),
        ("velocity", [1.0, np.nan]),
        ("velocity", [1.0, 0.0]),
        ("acceleration", [-2.0, 2.0]),
        ("velocity", [1.0, 1e-300]),
        ("jerk", [1e100, 10.0]),
        ("jerk", [10.0]),
        ("jerk", [[10.0, 10.0]]),
    ],
)
def test_refuses_limits_that_describe_no_robot_and_names_the_field(name, value):
    with pytest.raises(InvalidLimits) as refusal:
        JointLimits(**{**GOOD, name: value})
    assert refusal.value.name == name


def test_refuses_a_reversed_range_and_names_the_joint():
    with pytest.raises(InvalidLimits, match="joint 1"):
        JointLimits(**{**GOOD, "lower": [-1.0, 2.0]})


def test_refuses_limits_of_no_joint():
    with pytest.raises(InvalidLimits):
        JointLimits(*[np.empty(0)] * 5)


def test_scaling_touches_only_the_rates_asked_for():
    limits = JointLimits(**GOOD)
    scaled = limits.scaled(velocity=0.5, jerk=[1.0, 0.1])
    np.testing.assert_array_equal(scaled.velocity, [0.5, 0.5])
    np.testing.assert_array_equal(scaled.jerk, [10.0, 1.0])
    np.testing.assert_array_equal(scaled.acceleration, limits.acceleration)
    np.testing.assert_array_equal(scaled.upper, limits.upper)


def test_limits_cannot_be_changed_behind_anyones_back():
    given = np.array(GOOD["velocity"])
    limits = JointLimits(**{**GOOD, "velocity": given})
    given[0] = 100.0
    assert limits.velocity[0] == 1.0
    with pytest.raises(ValueError, match="read-only"):
        limits.velocity[0] = 100.0


def moving(column: int, value: float, at_end: bool) -> PiecewiseCubic:
    """Six joints that rest, but for joint 3 at one of its ends."""
    knots = np.tile([0.0, 1.0, 2.0], (6, 1))
    tables = np.zeros((6, 2, 4))
    if at_end:
        tables[3, 1, column + 1] = value
    else:
        tables[3, 0, column] = value
    return PiecewiseCubic(tuple(knots), tuple(tables))


@pytest.mark.parametrize("at_end", [False, True])
@pytest.mark.parametrize(("column", "quantity"), [(1, "velocity"), (2, "acceleration")])
def test_what_is_left_of_a_rate_at_an_end_is_named(six_axis_limits, column, quantity, at_end):
    with pytest.raises(NotSmooth) as refusal:
        check_rest(moving(column, 1e-3, at_end), six_axis_limits)
    assert (refusal.value.joint, refusal.value.time) == (3, 2.0 if at_end else 0.0)
    assert refusal.value.quantity in (quantity, "velocity")


def test_a_rate_that_is_no_number_is_refused(six_axis_limits):
    with pytest.raises(NotSmooth):
        check_rest(moving(1, np.nan, False), six_axis_limits)


def test_every_plan_is_at_rest_and_smooth(six_axis_limits, random_points):
    for seed in range(10):
        motion = plan(random_points(seed), six_axis_limits)
        check_rest(motion, six_axis_limits)
        check_smooth(motion, six_axis_limits)
