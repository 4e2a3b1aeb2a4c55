from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers import AccelerationLimit, Guard, GuardError, JerkLimit, VelocityLimit
from tests.drivers.rig import PERIOD, START, N, limits

REST = np.zeros(N)


def begun(**changes) -> Guard:
    guard = Guard(limits(**changes), PERIOD)
    guard.begin(START, REST, REST, np.zeros((2, N)), 0)
    return guard


def feed(guard: Guard, rows, bounds="plan") -> None:
    """Set-points (m, n) after START, each with its backward difference as velocity."""
    before = START
    for cycle, row in enumerate(rows):
        guard.check_set_point(row, (row - before) / PERIOD, bounds, cycle + 1)
        before = row


def jerk_profile(jerks) -> np.ndarray:
    """Joint 6 from rest under a piecewise constant jerk, exactly integrated, (m, n)."""
    rows, q, v, a = [], START[5], 0.0, 0.0
    for jerk in jerks:
        q += v * PERIOD + a * PERIOD**2 / 2 + jerk * PERIOD**3 / 6
        v += a * PERIOD + jerk * PERIOD**2 / 2
        a += jerk * PERIOD
        rows.append([*START[:5], q])
    return np.array(rows)


def test_a_motion_exactly_at_its_limits_passes():
    """100 rad/s³ up to 8 rad/s², held, and down to 2 rad/s at rest in acceleration."""
    up, hold = 40, 85
    rows = jerk_profile([100.0] * up + [0.0] * hold + [-100.0] * up)
    speed = np.diff(rows[:, 5]) / PERIOD
    acceleration = np.diff(speed) / PERIOD
    assert acceleration.max() == pytest.approx(8.0, rel=1e-6)
    assert speed[-1] == pytest.approx(2.0, rel=2e-3)
    feed(begun(), rows)


@pytest.mark.parametrize("excess", [1e-4, 1e-2, 1.0])
def test_a_little_more_does_not(excess):
    with pytest.raises(JerkLimit) as caught:
        feed(begun(), jerk_profile([100.0 * (1.0 + excess)] * 10))
    assert caught.value.joint == 5
    # The third difference has all of the jerk from the third step on, 5/6 in the second.
    assert caught.value.cycle <= 3


@given(st.lists(st.floats(-1.0, 1.0), min_size=1, max_size=60), st.sampled_from([1.0, 1.7, 3.0]))
def test_whatever_keeps_its_jerk_passes_the_check_on_jerk(shares, factor):
    """The k-th difference of a motion is a mean of its k-th derivative."""
    wide = {"acceleration": np.full(N, 1e6), "velocity": np.full(N, 1e6)}
    bounds = {1.0: "plan", 1.7: "override", 3.0: "stop"}[factor]
    rows = jerk_profile([100.0 * factor * share for share in shares])
    feed(begun(**wide, lower=np.full(N, -1e3), upper=np.full(N, 1e3)), rows, bounds)


@pytest.mark.parametrize(("bounds", "factor"), [("plan", 1.0), ("override", 1.3), ("stop", 2.0)])
def test_each_set_of_bounds_has_its_acceleration(bounds, factor):
    t = PERIOD * np.arange(1, 40)[:, None]
    path = START + 0.5 * 8.0 * factor * t**2 * np.array([0, 1, 0, 0, 0, 0])
    wide = {"jerk": np.full(N, 1e9)}
    feed(begun(**wide), START + 0.999 * (path - START), bounds)
    with pytest.raises(AccelerationLimit):
        feed(begun(**wide), START + 1.001 * (path - START), bounds)


@given(st.integers(0, N - 1), st.sampled_from([np.nan, np.inf, -np.inf]), st.booleans())
def test_what_is_not_finite_never_passes(joint, value, in_velocity):
    q, qd = START.copy(), REST.copy()
    (qd if in_velocity else q)[joint] = value
    with np.errstate(invalid="ignore"), pytest.raises(GuardError) as caught:
        begun().check_set_point(q, qd, "plan", 1)
    assert caught.value.check == "finiteness"
    assert "where a number must be" in str(caught.value)
    assert caught.value.joint == joint


def test_a_planner_that_keeps_its_limits_to_a_millionth_passes():
    feed(begun(), jerk_profile([100.0 * (1.0 + 8e-7)] * 30))


@pytest.mark.parametrize("turns", [0, 1, 10, 30])
def test_rounding_of_joint_angles_of_many_turns_is_not_mistaken_for_jerk(turns):
    """At 1 ms the last bit of 200 rad is 2e-5 rad/s³ in a third difference."""
    T = 0.001
    reach = 2.0 * np.pi * (turns + 1)
    wide = limits(lower=np.full(N, -reach), upper=np.full(N, reach), jerk=np.full(N, 10.0))
    guard = Guard(wide, T)
    start = 2.0 * np.pi * turns + np.arange(N) * 0.1
    guard.begin(start, REST, REST, np.zeros((2, N)), 0)
    before = start
    for cycle in range(1, 300):
        row = start + 10.0 * (cycle * T) ** 3 / 6.0
        guard.check_set_point(row, (row - before) / T, "plan", cycle)
        before = row


def test_speed_is_judged_by_the_step_as_well_as_by_the_stated_velocity():
    guard = begun(jerk=np.full(N, 1e9), velocity=np.full(N, 0.5))
    q, speed = START.copy(), 0.0
    with pytest.raises(VelocityLimit) as caught:
        for cycle in range(1, 100):
            speed += 7.9 * PERIOD
            q = q + np.array([0, speed * PERIOD, 0, 0, 0, 0])
            stated = np.array([0, min(speed, 0.499), 0, 0, 0, 0])
            guard.check_set_point(q, stated, "plan", cycle)
    assert caught.value.value == pytest.approx(speed)
    assert 0.5 < speed < 0.5 + 7.9 * PERIOD


def test_errors_carry_joint_value_bound_and_cycle():
    with pytest.raises(JerkLimit) as caught:
        feed(begun(), [START + np.array([0, 0, 1e-5, 0, 0, 0])])
    error = caught.value
    assert (error.joint, error.cycle) == (2, 1)
    assert error.value == pytest.approx(1e-5 / PERIOD**3)
    assert error.bound == pytest.approx(100.0, rel=1e-5)
    assert str(error) == (
        f"jerk of joint 3 is {error.value:.9g} rad/s³; "
        f"allowed is {error.bound:.9g} rad/s³ (cycle 1)"
    )


class TestLimits:
    @pytest.mark.parametrize(
        "changes",
        [
            {"velocity": np.full(5, 1.0)},
            {"velocity": np.full(N, 0.0)},
            {"jerk": np.full(N, np.nan)},
            {"lower": np.full(N, 3.0)},
            {"following_error": np.full(N, -1.0)},
            {"override_jerk": 0.9},
            {"stop_acceleration": 1.2},
            {"standstill": 0.0},
        ],
    )
    def test_limits_that_cannot_be_are_refused_by_name(self, changes):
        with pytest.raises(ValueError, match="guard limits"):
            limits(**changes)

    def test_a_period_has_to_be_positive(self):
        with pytest.raises(ValueError, match="period"):
            Guard(limits(), 0.0)

    def test_the_narrower_of_cell_and_controller_is_in_force_and_nan_is_no_limit(self):
        guard = Guard(limits(), PERIOD)
        guard.narrow(np.array([1.0, 3.0, np.nan, 2.0, 0.5, 2.0]), np.full(N, np.nan))
        np.testing.assert_array_equal(guard.following_error, [1.0, 2.0, 2.0, 2.0, 0.5, 2.0])
