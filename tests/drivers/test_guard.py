"""The guard's checks of set-points: laws, and each bound at its limit."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers import Guard, GuardLimits
from drivers.errors import Check
from drivers.guard import RANK, ActiveBounds
from tests.drivers import rig
from tests.drivers.rig import (
    FACTORS,
    JUST_ABOVE,
    JUST_BELOW,
    PERIOD,
    REST,
    START,
    N,
    at,
    joints,
    limits,
    refused,
    signs,
)
from tests.messages import NUMBER_NEEDED

T = PERIOD
EVERY = np.ones(N, dtype=bool)
TURNS = np.array([40.0, -30.0, 20.0, -10.0, 5.0, -2.0])
"""Motor revolutions at which an arm may stand."""
RATES = {"velocity": Check.VELOCITY, "acceleration": Check.ACCELERATION, "jerk": Check.JERK}
NOT_FINITE = st.sampled_from([np.nan, np.inf, -np.inf])

names = pytest.mark.parametrize("bounds", FACTORS)


def begun(bounds: GuardLimits, start=START) -> Guard:
    guard = Guard(bounds, PERIOD)
    guard.begin(start, 0)
    return guard


def only(**bounds: float) -> Guard:
    """At START, at rest; every rate but those given is out of reach."""
    return begun(rig.only(**bounds))


class TestLimits:
    @pytest.mark.parametrize(
        "name",
        ["lower", "upper", "velocity", "acceleration", "jerk", "following_error", "current"],
    )
    def test_each_has_one_finite_number_per_joint(self, name):
        wrongs = [np.full((N, 1), 1.0), np.append(np.ones(N - 1), np.inf)]
        # The length of `lower` is the number of joints.
        wrongs += [] if name == "lower" else [np.full(N - 1, 1.0)]
        for wrong in wrongs:
            with pytest.raises(ValueError, match=f"{name} must be {N} finite numbers"):
                limits(**{name: wrong})
        for value in () if name in ("lower", "upper") else (0.0, -1.0):
            with pytest.raises(ValueError, match=f"{name} must be positive"):
                limits(**{name: np.where(np.arange(N) == 3, value, 1.0)})

    @pytest.mark.parametrize(
        ("changes", "message"),
        [
            *(
                ({name: value}, f"{name} {value} is not positive")
                for name in ("standstill",)
                for value in (0.0, -1.0, np.nan)
            ),
            ({"upper": np.where(np.arange(N) == 4, -2.0, 2.0)}, "is not below"),
            *(
                ({f"override_{what}": override, f"stop_{what}": stop}, "factors 1 <=")
                for what in ("acceleration", "jerk")
                for override, stop in ((0.99, 1.5), (1.5, 1.49), (np.nan, 2.0), (1.2, np.nan))
            ),
        ],
    )
    def test_other_figures(self, changes, message):
        with pytest.raises(ValueError, match=message):
            limits(**changes)
        limits(**{name: 1.0 for name in changes if name != "upper"})

    def test_arrays_are_copied(self):
        velocity = np.full(N, 2.0)
        copied = limits(velocity=velocity, jerk=[100] * N)
        velocity[:] = 9.0
        np.testing.assert_array_equal(copied.velocity, np.full(N, 2.0))
        assert copied.jerk.dtype == np.float64

    @pytest.mark.parametrize("period", [0.0, -0.002, np.nan])
    def test_a_period_has_to_be_positive(self, period):
        with pytest.raises(ValueError, match="is not positive"):
            Guard(limits(), period)


STILL = np.zeros((2, N))
CHECKS = {
    "set-point": lambda guard, row: (guard.check_set_point, row, REST, "plan"),
    "velocity": lambda guard, row: (guard.check_set_point, START, row, "plan"),
    "current": lambda guard, row: (guard.check_feedback, REST, at(1, 100.0), row, REST),
    "target held": lambda guard, row: (guard.check_hold, row, REST, EVERY),
    "target and axes held": lambda guard, row: (guard.check_hold, row, row, EVERY),
    "axes at the start": lambda guard, row: (guard.check_start, REST, row, STILL),
    "target and axes at the start": lambda guard, row: (guard.check_start, row, row, STILL),
    "first set-point": lambda guard, row: (guard.begin, row),
}
"""Each check of a guard with its arguments, of which one is a row (n,)."""


@pytest.mark.parametrize("name", CHECKS)
@given(st.integers(0, N - 1), NOT_FINITE)
def test_values_that_are_not_finite_are_refused(name, joint, value):
    """Of any joint, before any other violation."""
    row = at(joint, 1.0)
    row[joint] = value
    with np.errstate(invalid="ignore"):
        error = refused(Check.FINITE, *CHECKS[name](begun(limits()), row), 5)
    assert (error.joint, error.cycle, error.check) == (joint, 5, Check.FINITE)
    assert NUMBER_NEEDED in str(error)


@given(st.integers(0, N - 1), NOT_FINITE)
def test_a_closed_axis_may_have_no_number(joint, value):
    others = np.arange(N) != joint
    Guard(limits(), PERIOD).check_hold(np.where(others, 0.0, value), REST, others, 5)


@given(st.lists(st.floats(-1.0, 1.0), min_size=1, max_size=60), st.sampled_from([1.0, 1.7, 3.0]))
def test_motion_within_its_jerk_passes(shares, factor):
    """The k-th difference of a motion is a mean of its k-th derivative."""
    far = np.full(N, 1e6)
    guard = begun(limits(acceleration=far, velocity=far, lower=-far, upper=far))
    bounds = {1.0: "plan", 1.7: "override", 3.0: "stop"}[factor]
    jerks = 100.0 * np.array(shares)
    q = START[5]
    v = 0.0
    a = 0.0
    for jerk in factor * jerks:
        step = v * PERIOD + a * PERIOD**2 / 2 + jerk * PERIOD**3 / 6
        q = q + step
        v = v + a * PERIOD + jerk * PERIOD**2 / 2
        a = a + jerk * PERIOD
        guard.check_set_point(np.append(START[:5], q), at(5, step / PERIOD), bounds, 1)


class TestPositions:
    LOWER = -1.0
    UPPER = 0.2

    @joints
    @pytest.mark.parametrize("limit", [LOWER, UPPER])
    def test_the_range_need_not_lie_about_zero(self, joint, limit):
        outwards = np.sign(limit)

        def at_limit(off: float) -> tuple[Guard, np.ndarray]:
            ranges = limits(lower=np.full(N, self.LOWER), upper=np.full(N, self.UPPER))
            return Guard(ranges, PERIOD), at(joint, limit + off * outwards)

        for off in (0.0, 5e-7):
            Guard.begin(*at_limit(off), 0)
        guard, q = at_limit(7e-7)
        error = refused(Check.POSITION, guard.begin, q, 3)
        assert (error.joint, error.bound, error.cycle) == (joint, pytest.approx(limit), 3)
        assert error.value == pytest.approx(q[joint], abs=1e-12)

    @joints
    def test_range_applies_at_any_speed(self, joint):
        guard = only()
        speed = at(joint, 1.5)
        edge = START + at(joint, 2.0 - START[joint])
        guard.check_set_point(edge, speed, "plan", 1)
        guard.check_set_point(edge, -speed, "plan", 2)
        beyond = edge + at(joint, 1e-3)
        error = refused(Check.POSITION, guard.check_set_point, beyond, -speed, "plan", 3)
        assert (error.joint, error.bound) == (joint, pytest.approx(2.0))

    @joints
    def test_a_position_at_its_bound_passes_at_any_speed_limit(self, joint):
        guard = Guard(limits(velocity=np.full(N, 0.01)), PERIOD)
        guard.begin(at(joint, 2.0 * (1.0 + 1e-6)), 0)


RATE_EDGES = {
    # Kind, bound in reach, its factor; what is at it: limit, step, velocity stated.
    "velocity by the step": (Check.VELOCITY, ("velocity", 0.5), 0, 0.5, T, 0.0),
    "velocity as stated": (Check.VELOCITY, ("velocity", 0.5), 0, 0.5, 0.0, 1.0),
    "step and velocity": (
        *(Check.STATED_VELOCITY, ("acceleration", 8.0), 1),
        *(8.0 * T, 0.25 * T, 1.25),
    ),
    "acceleration": (Check.ACCELERATION, ("acceleration", 50.0), 1, 50.0, T**2, T),
    "jerk": (Check.JERK, ("jerk", 50.0), 2, 50.0, T**3, T**2),
}


class TestRates:
    @joints
    @signs
    @names
    @pytest.mark.parametrize("edge", RATE_EDGES)
    def test_each_rate_of_each_set_of_bounds(self, joint, sign, bounds, edge):
        kind, bound, order, limit, step, stated = RATE_EDGES[edge]
        limit *= (1.0, *FACTORS[bounds])[order]
        x = at(joint, sign * limit)
        passes = only(**dict([bound]))
        fails = only(**dict([bound]))
        below, above = ((START + step * s * x, stated * s * x) for s in (JUST_BELOW, JUST_ABOVE))
        passes.check_set_point(*below, bounds, 1)
        error = refused(kind, fails.check_set_point, *above, bounds, 1)
        assert (error.joint, error.cycle) == (joint, 1)
        text = f"of joint {joint + 1} is {error.value:.9g} {error.unit}; allowed is"
        assert str(error) == f"{kind.quantity} {text} {error.bound:.9g} {error.unit} (cycle 1)"
        assert error.value == pytest.approx(sign * limit, rel=1e-5)
        assert error.bound == pytest.approx(limit, rel=1e-5)

    @signs
    @pytest.mark.parametrize("name", RATES)
    def test_rounding_of_large_angles(self, name, sign):
        """At a million rad an angle toggles in its last bit, of an arm that must hardly move."""
        lower, upper = sorted((-sign, sign * 2.0**20))
        wide = {"lower": np.full(N, lower), "upper": np.full(N, upper)} | dict.fromkeys(
            RATES, np.full(N, 100.0)
        )
        start = np.full(N, sign * (2.0**20 - 1.0))
        last_bit = np.spacing(start)

        def toggle(bits: float, stated: float = 0.0) -> None:
            guard = begun(limits(**wide | {name: np.full(N, 1e-12)}), start)
            before = start
            for cycle, up in enumerate([1, 0, 1, 1, 0, 0, 1]):
                row = start + up * bits * last_bit
                guard.check_set_point(row, stated * (row - before) / PERIOD, "plan", cycle)
                before = row

        toggle(7.0)
        refused(RATES[name], toggle, 9.0, stated=1.0)

    def test_the_bounds_of_a_plan_apply_at_first(self):
        assert ActiveBounds().rank == ActiveBounds().update("plan") == RANK["plan"]

    @pytest.mark.parametrize(
        ("bounds", "jerk"),
        [
            (["stop", "stop", "plan", "plan", "plan"], 100.0),
            (["stop", "stop", "override", "override", "override"], 117.5),
            (["stop", "plan", "stop", "plan", "plan", "plan"], 140.0),
        ],
    )
    def test_duration_of_wider_bounds(self, bounds, jerk):
        """A third difference has four set-points: after two more the last wide one is the first."""
        guard = only(jerk=50.0)
        rows = [START + at(2, jerk * (T * k) ** 3 / 6.0) for k in range(1, 7)]
        for cycle, (row, name) in enumerate(zip(rows, bounds[:-1], strict=False)):
            guard.check_set_point(row, REST, name, cycle)
        last = rows[len(bounds) - 1]
        error = refused(Check.JERK, guard.check_set_point, last, REST, bounds[-1], 5)
        assert error.bound == pytest.approx(50.0 * FACTORS[bounds[-1]][1], rel=1e-5)
        guard = only(jerk=50.0)
        for cycle, row in enumerate(rows[:3]):
            guard.check_set_point(row, REST, "stop", cycle)
        guard.begin(START, 9)  # forgets the way, and the bounds granted there
        step = START + at(2, 60.0 * T**3)
        refused(Check.JERK, guard.check_set_point, step, REST, "plan", 10)

    def test_the_first_joint_of_the_first_check_that_fails(self):
        guard = only(velocity=0.5, jerk=50.0)
        moved = at(1, 60.0 * T**3) + at(4, T)
        step = START + moved
        assert refused(Check.VELOCITY, guard.check_set_point, step, moved / T, "plan", 1).joint == 4
        guard = only(velocity=0.5)
        both = START + at(1, T) + at(4, T)
        assert refused(Check.VELOCITY, guard.check_set_point, both, REST, "plan", 1).joint == 1
        q = at(1, -3.0) + at(4, 3.0)
        error = refused(Check.POSITION, Guard(limits(), PERIOD).begin, q, 2)
        assert (error.joint, error.bound) == (1, pytest.approx(-2.0))


STILL = np.zeros((2, N))
EXACT = 1.0 - 5e-4
"""Below a bound without tolerance, but for rounding."""


def feedback(place: int):
    """A check of feedback that is at rest but for one of target, arm, current and set-point."""

    def check(guard: Guard, x, where) -> None:
        given = [x if k == place else REST for k in range(4)]
        guard.check_feedback(*given, 7, where=where)

    return check


def start(place: int):
    """A check of a start at rest but for one of target, arm and their velocities."""

    def check(guard: Guard, x, where) -> None:
        given = [TURNS, TURNS, REST, REST]
        given[place] = given[place] + x * where
        guard.check_start(given[0], given[1], np.array(given[2:]), 7)

    return check


def held(guard: Guard, x, where) -> None:
    guard.check_hold(TURNS, TURNS + x, where, 7)


def after_gap(guard: Guard, x, where) -> None:
    guard.check_after_gap(TURNS + x, STILL, TURNS, REST, 7, where)


EDGES_OF_FEEDBACK = {
    "target received": (Check.FOLLOWING_ERROR, 2.0, JUST_BELOW, feedback(0)),
    "arm": (Check.FOLLOWING_ERROR, 2.0, JUST_BELOW, feedback(1)),
    "current": (Check.CURRENT, 20.0, JUST_BELOW, feedback(2)),
    "set-point sent": (Check.FOLLOWING_ERROR, 2.0, JUST_BELOW, feedback(3)),
    "arm of a held axis": (Check.FOLLOWING_ERROR, 2.0, JUST_BELOW, held),
    "target at the start": (Check.FIRST_SET_POINT, 0.2, EXACT, start(0)),
    "arm at the start": (Check.FIRST_SET_POINT, 0.2, EXACT, start(1)),
    "velocity of the target at the start": (Check.STANDSTILL, 5e-4, 1.0, start(2)),
    "velocity of the arm at the start": (Check.STANDSTILL, 5e-4, 1.0, start(3)),
    "target after a gap": (Check.ACCEPTED, 0.2, EXACT, after_gap),
}
"""Thresholds of 2 revolutions and 20 A; a tenth of 2 revolutions and 5e-4 per cycle to begin."""


@joints
@signs
@pytest.mark.parametrize("edge", EDGES_OF_FEEDBACK)
def test_bounds_of_feedback_and_start(edge, joint, sign):
    kind, bound, below, check = EDGES_OF_FEEDBACK[edge]
    guard = Guard(limits(), PERIOD)
    x = at(joint, sign * bound)
    check(guard, x * below, EVERY)
    check(guard, 1e3 * x, np.arange(N) != joint)
    error = refused(kind, check, guard, x * JUST_ABOVE, EVERY)
    assert (error.joint, error.cycle) == (joint, 7)
    assert error.value == pytest.approx(bound, rel=1e-5)
    assert error.bound == pytest.approx(bound, rel=1e-5)


def test_joints_left_out_of_feedback_pass_any_threshold():
    guard = begun(limits(following_error=np.full(N, 1e-3), current=np.full(N, 1e-3)))
    guard.check_feedback(REST, at(1, 9.0), at(1, 9.0), REST, 1, np.arange(N) != 1)


def test_thresholds_of_zero_hold_an_arm_at_its_target():
    guard = Guard(limits(), PERIOD)
    guard.narrow(np.zeros(N), np.zeros(N))
    guard.check_feedback(TURNS, TURNS, REST, TURNS, 1)
    check = guard.check_feedback
    error = refused(Check.FOLLOWING_ERROR, check, TURNS, TURNS + at(3, 1e-9), REST, TURNS, 1)
    assert error.joint == 3


def test_narrower_limits_of_the_controller():
    """NaN is no limit; new limits replace old ones."""
    guard = Guard(limits(), PERIOD)
    nothing = np.full(N, np.nan)
    guard.narrow(at(1, 1.0) + at(0, 3.0) + 0.5, at(1, 4.5) + at(0, 30.0) + 5.0)
    np.testing.assert_array_equal(guard.following_error, [2.0, 1.5, 0.5, 0.5, 0.5, 0.5])
    np.testing.assert_array_equal(guard.current, [20.0, 9.5, 5.0, 5.0, 5.0, 5.0])
    for joint, threshold in ((0, 2.0), (1, 1.5)):
        guard.check_feedback(REST, at(joint, threshold * JUST_BELOW), REST, REST, 1)
        far = at(joint, threshold * JUST_ABOVE)
        refused(Check.FOLLOWING_ERROR, guard.check_feedback, REST, far, REST, REST, 1)
    guard.check_feedback(REST, REST, at(1, 9.5 * JUST_BELOW), REST, 1)
    refused(Check.CURRENT, guard.check_feedback, REST, REST, at(1, 9.5 * JUST_ABOVE), REST, 1)
    guard.narrow(nothing, nothing)
    np.testing.assert_array_equal(guard.following_error, np.full(N, 2.0))
    np.testing.assert_array_equal(guard.current, np.full(N, 20.0))


@joints
@signs
class TestAfterGap:
    """Half of the step sent last, at least 5e-4 per cycle."""

    @pytest.mark.parametrize(
        ("sent", "off"), [(0.0, 5e-4), (8e-4, 5e-4), (1e-3, 5e-4), (4e-3, 2e-3)]
    )
    @pytest.mark.parametrize("way", [-1.0, 1.0])
    def test_the_target_s_velocity_is_the_one_sent(self, joint, sign, sent, off, way):
        guard = Guard(limits(), PERIOD)
        step = at(joint, sign * sent)
        # The arm does as commanded.
        measured = np.array([step + at(joint, way * off * 0.999), step])
        guard.check_after_gap(REST, measured, REST, step, 1, EVERY)
        measured[0] = step + at(joint, way * off * 1.001)
        check = guard.check_after_gap
        error = refused(Check.GAP_VELOCITY, check, REST, measured, REST, step, 3, EVERY)
        assert (error.joint, error.cycle) == (joint, 3)
        assert (error.value, error.bound) == (pytest.approx(1.001 * off), pytest.approx(off))
        check(REST, measured, REST, step, 1, np.arange(N) != joint)

    def test_velocity_of_the_arm(self, joint, sign):
        check = Guard(limits(), PERIOD).check_after_gap
        step = at(joint, sign * 4e-3)
        stands = np.array([step, at(joint, sign * 5e-4)])
        error = refused(Check.GAP_VELOCITY, check, REST, stands, REST, step, 3, EVERY)
        assert error.joint == joint
        check(REST, stands, REST, step, 3, np.arange(N) != joint)
        lags = np.array([step, at(joint, sign * 5e-4 * 1.001)])
        check(REST, lags, REST, step, 3, EVERY)

    @names
    def test_after_a_pause_the_arm_moves_as_the_set_points_sent_last(self, joint, sign, bounds):
        """But for what a servo gains in 50 ms at the acceleration allowed."""
        guard = only(acceleration=8.0)
        speed = at(joint, sign)
        q = START
        guard.resume_from(q, speed, 0)
        for cycle in range(3):
            q = q + PERIOD * speed
            guard.check_set_point(q, speed, bounds, cycle)
        gain = 0.05 * FACTORS[bounds][0] * 8.0
        for way in (-1.0, 1.0):
            guard.check_after_pause(speed + at(joint, way * 0.999 * gain), 4, EVERY)
            other = speed + at(joint, way * 1.001 * gain)
            error = refused(Check.PAUSE_VELOCITY, guard.check_after_pause, other, 5, EVERY)
            assert (error.joint, error.cycle) == (joint, 5)
            assert error.bound == pytest.approx(gain)
            guard.check_after_pause(other, 5, np.arange(N) != joint)

    def test_extrapolated_steps_have_bounded_acceleration_and_jerk(self, joint, sign):
        guard = Guard(limits(), PERIOD)
        q = START
        step = at(joint, sign * 1.5 * PERIOD)
        bound = 2.0 * 8.0 * PERIOD**2  # of a stop, per cycle
        guard.resume_from(q, step / PERIOD, 2)
        for way in (1.0, -1.0, 1.0, -1.0):
            step = step + at(joint, way * JUST_BELOW * bound)
            q = q + step
            guard.check_set_point(q, step / PERIOD, "stop", 1)
        far = q + step + at(joint, JUST_BELOW * bound)
        refused(Check.JERK, guard.check_set_point, far, step / PERIOD, "stop", 2)
        guard.resume_from(q, step / PERIOD, 2)
        far = q + step + at(joint, 1.1 * bound)
        refused(Check.ACCELERATION, guard.check_set_point, far, (far - q) / PERIOD, "stop", 3)
