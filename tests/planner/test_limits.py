from __future__ import annotations

import numpy as np
import pytest

from planner import InvalidLimits, JointLimits

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
