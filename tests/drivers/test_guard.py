"""The guard's checks of set-points and corrections: laws, and each bound at its limit."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers import Guard, GuardError, GuardLimits
from drivers.errors import (
    Check,
)
from drivers.guard import CorrectionGuard
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


def begun(**changes) -> Guard:
    guard = Guard(limits(**changes), PERIOD)
    guard.begin(START, 0)
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


def test_motion_at_its_limits_passes():
    """100 rad/s³ up to 8 rad/s², held, and down to 2 rad/s at rest in acceleration."""
    up, hold = 40, 85
    rows = jerk_profile([100.0] * up + [0.0] * hold + [-100.0] * up)
    speed = np.diff(rows[:, 5]) / PERIOD
    acceleration = np.diff(speed) / PERIOD
    assert acceleration.max() == pytest.approx(8.0, rel=1e-6)
    assert speed[-1] == pytest.approx(2.0, rel=2e-3)
    feed(begun(), rows)


@given(st.lists(st.floats(-1.0, 1.0), min_size=1, max_size=60), st.sampled_from([1.0, 1.7, 3.0]))
def test_motion_within_its_jerk_passes(shares, factor):
    """The k-th difference of a motion is a mean of its k-th derivative."""
    wide = {"acceleration": np.full(N, 1e6), "velocity": np.full(N, 1e6)}
    bounds = {1.0: "plan", 1.7: "override", 3.0: "stop"}[factor]
    rows = jerk_profile([100.0 * factor * share for share in shares])
    feed(begun(**wide, lower=np.full(N, -1e3), upper=np.full(N, 1e3)), rows, bounds)


@given(st.integers(0, N - 1), st.sampled_from([np.nan, np.inf, -np.inf]), st.booleans())
def test_values_that_are_not_finite_are_refused(joint, value, in_velocity):
    q, qd = START.copy(), REST.copy()
    (qd if in_velocity else q)[joint] = value
    with np.errstate(invalid="ignore"), pytest.raises(GuardError) as caught:
        begun().check_set_point(q, qd, "plan", 1)
    assert caught.value.check == "finiteness"
    assert "where a number must be" in str(caught.value)
    assert caught.value.joint == joint


class TestLimits:
    @pytest.mark.parametrize(
        "name",
        ["lower", "upper", "velocity", "acceleration", "jerk", "following_error", "current"],
    )
    def test_each_has_one_finite_number_per_joint(self, name):
        wrongs = (np.full(N - 1, 1.0), np.full((N, 1), 1.0), np.append(np.ones(N - 1), np.inf))
        for wrong in wrongs:
            if name == "lower" and wrong.shape == (N - 1,):
                continue  # its length is the number of joints
            with pytest.raises(ValueError, match=f"{name} must be {N} finite numbers"):
                limits(**{name: wrong})

    @pytest.mark.parametrize(
        "name", ["velocity", "acceleration", "jerk", "following_error", "current"]
    )
    @pytest.mark.parametrize("value", [0.0, -1.0])
    def test_magnitudes_are_positive_in_every_joint(self, name, value):
        with pytest.raises(ValueError, match=f"{name} must be positive"):
            limits(**{name: np.where(np.arange(N) == 3, value, 1.0)})

    @pytest.mark.parametrize("name", ["standstill", "current_rise"])
    def test_other_figures_are_positive(self, name):
        for value in (0.0, -1.0, np.nan):
            with pytest.raises(ValueError, match=f"{name} {value} is not positive"):
                limits(**{name: value})
        limits(**{name: 1e-9})
        with pytest.raises(ValueError, match="is not below"):
            limits(upper=np.where(np.arange(N) == 4, -2.0, 2.0))

    @pytest.mark.parametrize("what", ["acceleration", "jerk"])
    def test_the_sets_of_bounds_widen_from_plan_to_override_to_stop(self, what):
        ordered = limits(**{f"override_{what}": 1.0, f"stop_{what}": 1.0})
        assert getattr(ordered, f"override_{what}") == 1.0
        for override, stop in ((0.99, 1.5), (1.5, 1.49), (np.nan, 2.0), (1.2, np.nan)):
            with pytest.raises(ValueError, match="factors 1 <="):
                limits(**{f"override_{what}": override, f"stop_{what}": stop})

    def test_arrays_are_copied(self):
        velocity = np.full(N, 2.0)
        copied = limits(velocity=velocity, jerk=[100] * N)
        velocity[:] = 9.0
        np.testing.assert_array_equal(copied.velocity, np.full(N, 2.0))
        assert copied.jerk.dtype == np.float64
        assert copied.n_joints == N

    @pytest.mark.parametrize("period", [0.0, -0.002, np.nan])
    def test_a_period_has_to_be_positive(self, period):
        with pytest.raises(ValueError, match="is not positive"):
            Guard(limits(), period)


EVERY = np.ones(N, dtype=bool)
TURNS = np.array([40.0, -30.0, 20.0, -10.0, 5.0, -2.0])
"""Motor revolutions at which an arm may stand."""
RATES = {"velocity": Check.VELOCITY, "acceleration": Check.ACCELERATION, "jerk": Check.JERK}

names = pytest.mark.parametrize("bounds", FACTORS)


def only(**bounds: float) -> Guard:
    """At START, at rest; every rate but those given is out of reach."""
    guard = Guard(rig.only(**bounds), PERIOD)
    guard.begin(START, 0)
    return guard


class TestPositions:
    LOWER, UPPER = -1.0, 0.2

    @joints
    @pytest.mark.parametrize("limit", [LOWER, UPPER])
    def test_the_range_need_not_lie_about_zero(self, joint, limit):
        ranges = {"lower": np.full(N, self.LOWER), "upper": np.full(N, self.UPPER)}
        outwards = np.sign(limit)
        for off in (0.0, 3e-7):
            q = at(joint, limit + off * outwards)
            Guard(limits(**ranges), PERIOD).begin(q, 0)
        just_out = at(joint, limit + 2e-6 * outwards)
        guard = Guard(limits(**ranges), PERIOD)
        error = refused(Check.POSITION, guard.begin, just_out, 3)
        assert (error.joint, error.bound, error.cycle) == (joint, pytest.approx(limit), 3)
        assert error.value == pytest.approx(just_out[joint], abs=1e-12)

    @joints
    def test_range_applies_at_any_speed(self, joint):
        guard, speed = only(), at(joint, 1.5)
        edge = START + at(joint, 2.0 - START[joint])
        guard.check_set_point(edge, speed, "plan", 1)
        guard.check_set_point(edge, -speed, "plan", 2)
        beyond = edge + at(joint, 1e-3)
        error = refused(Check.POSITION, guard.check_set_point, beyond, -speed, "plan", 3)
        assert (error.joint, error.bound) == (joint, pytest.approx(2.0))


RATE_EDGES = {
    # Kind, bound in reach, its factor; what is at it: limit, step, velocity stated.
    "velocity by the step": (Check.VELOCITY, ("velocity", 0.5), 0, 0.5, PERIOD, 0.0),
    "velocity as stated": (Check.VELOCITY, ("velocity", 0.5), 0, 0.5, 0.0, 1.0),
    "step and velocity": (
        *(Check.STATED_VELOCITY, ("acceleration", 8.0), 1),
        *(8.0 * PERIOD, 0.25 * PERIOD, 1.25),
    ),
    "acceleration": (Check.ACCELERATION, ("acceleration", 50.0), 1, 50.0, PERIOD**2, PERIOD),
    "jerk": (Check.JERK, ("jerk", 50.0), 2, 50.0, PERIOD**3, PERIOD**2),
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
        passes, fails = only(**dict([bound])), only(**dict([bound]))
        below, above = ((START + step * s * x, stated * s * x) for s in (JUST_BELOW, JUST_ABOVE))
        passes.check_set_point(*below, bounds, 1)
        error = refused(kind, fails.check_set_point, *above, bounds, 1)
        assert (error.joint, error.cycle) == (joint, 1)
        text = f"{error.check} of joint {joint + 1} is {error.value:.9g} {error.unit}; allowed is"
        assert str(error) == f"{text} {error.bound:.9g} {error.unit} (cycle 1)"
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
            guard = Guard(limits(**wide | {name: np.full(N, 1e-12)}), PERIOD)
            guard.begin(start, 0)
            before = start
            for cycle, up in enumerate([1, 0, 1, 1, 0, 0, 1]):
                row = start + up * bits * last_bit
                guard.check_set_point(row, stated * (row - before) / PERIOD, "plan", cycle)
                before = row

        toggle(1.0)
        refused(RATES[name], toggle, 24.0, stated=1.0)

    @pytest.mark.parametrize("after", ["plan", "override"])
    def test_duration_of_wider_bounds(self, after):
        """A third difference has four set-points: after two more the last wide one is the first."""
        jerk = 50.0 * 0.5 * (FACTORS[after][1] + FACTORS["stop"][1])
        t = PERIOD * np.arange(1, 8)
        rows = [START + at(2, jerk * s**3 / 6.0) for s in t]
        guard = only(jerk=50.0)
        for cycle, row in enumerate(rows[:2]):
            guard.check_set_point(row, REST, "stop", cycle)
        guard.check_set_point(rows[2], REST, after, 2)
        guard.check_set_point(rows[3], REST, after, 3)
        error = refused(Check.JERK, guard.check_set_point, rows[4], REST, after, 4)
        assert error.bound == pytest.approx(50.0 * FACTORS[after][1], rel=1e-5)

    def test_wider_set_point_restarts_the_duration(self):
        guard, jerk = only(jerk=50.0), 140.0
        wide = ["stop", "plan", "stop", "plan", "plan"]
        rows = [START + at(2, jerk * (PERIOD * k) ** 3 / 6.0) for k in range(1, 8)]
        for cycle, (row, bounds) in enumerate(zip(rows, wide, strict=False)):
            guard.check_set_point(row, REST, bounds, cycle)
        refused(Check.JERK, guard.check_set_point, rows[5], REST, "plan", 5)

    def test_begin_resets_the_history(self):
        """Neither the way it came nor the bounds it was granted there."""
        guard = only(jerk=50.0)
        for cycle in range(1, 4):
            row = START + at(2, 140.0 * (PERIOD * cycle) ** 3 / 6.0)
            guard.check_set_point(row, REST, "stop", cycle)
        guard.begin(START, 9)
        step = START + at(2, 60.0 * PERIOD**3)
        refused(Check.JERK, guard.check_set_point, step, REST, "plan", 10)


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
    guard, x = Guard(limits(), PERIOD), at(joint, sign * bound)
    check(guard, x * below, EVERY)
    check(guard, 1e3 * x, np.arange(N) != joint)
    error = refused(kind, check, guard, x * JUST_ABOVE, EVERY)
    assert (error.joint, error.cycle) == (joint, 7)
    assert error.value == pytest.approx(bound, rel=1e-5)
    assert error.bound == pytest.approx(bound, rel=1e-5)


class TestFeedback:
    """Thresholds of 2 revolutions and 20 A, unless the controller has narrower ones."""

    def test_narrower_limits_of_the_controller(self):
        guard = Guard(limits(), PERIOD)
        guard.narrow(at(1, 1.0) + at(0, 3.0) + 0.5, at(1, 4.5) + at(0, 30.0) + 5.0)
        np.testing.assert_array_equal(guard.following_error, [2.0, 1.5, 0.5, 0.5, 0.5, 0.5])
        np.testing.assert_array_equal(guard.current, [20.0, 9.5, 5.0, 5.0, 5.0, 5.0])
        for joint, threshold in ((0, 2.0), (1, 1.5)):
            guard.check_feedback(REST, at(joint, threshold * JUST_BELOW), REST, REST, 1)
            far = at(joint, threshold * JUST_ABOVE)
            refused(Check.FOLLOWING_ERROR, guard.check_feedback, REST, far, REST, REST, 1)
        guard.check_feedback(REST, REST, at(1, 9.5 * JUST_BELOW), REST, 1)
        strong = at(1, 9.5 * JUST_ABOVE)
        refused(Check.CURRENT, guard.check_feedback, REST, REST, strong, REST, 1)

    def test_nan_is_no_limit_and_new_limits_replace_old(self):
        guard = Guard(limits(), PERIOD)
        guard.narrow(np.full(N, 0.5), np.full(N, 5.0))
        guard.narrow(np.full(N, np.nan), np.full(N, np.nan))
        np.testing.assert_array_equal(guard.following_error, np.full(N, 2.0))
        np.testing.assert_array_equal(guard.current, np.full(N, 20.0))


class TestNotFinite:
    def test_targets_and_positions(self):
        guard = Guard(limits(), PERIOD)
        target = np.where(np.arange(N) == 3, np.nan, 0.0)
        error = refused(Check.FINITE, guard.check_hold, target, REST, EVERY, 5)
        assert (error.joint, error.cycle) == (3, 5)
        assert np.isnan(error.value)
        guard.check_hold(target, REST, np.arange(N) != 3, 5)
        actual = np.where(np.arange(N) == 2, np.inf, 0.0)
        assert refused(Check.FINITE, guard.check_start, REST, actual, STILL, 8).joint == 2
        error = refused(Check.FINITE, guard.check_start, target, target, STILL, 8)
        assert (error.joint, error.cycle) == (3, 8)


class TestAfterGap:
    """Half of the step sent last, at least 5e-4 per cycle."""

    @joints
    @signs
    @pytest.mark.parametrize(
        ("sent", "off"), [(0.0, 5e-4), (8e-4, 5e-4), (1e-3, 5e-4), (4e-3, 2e-3)]
    )
    def test_the_target_s_velocity_is_the_one_sent(self, joint, sign, sent, off):
        guard, step = Guard(limits(), PERIOD), at(joint, sign * sent)
        for way in (-1.0, 1.0):
            found = np.zeros((2, N))
            found[0] = step + at(joint, way * off * 0.999)
            found[1] = step  # the arm does as commanded
            guard.check_after_gap(REST, found, REST, step, 1, EVERY)
            found[0] = step + at(joint, way * off * 1.001)
            error = refused(
                Check.GAP_VELOCITY, guard.check_after_gap, REST, found, REST, step, 3, EVERY
            )
            assert (error.joint, error.cycle) == (joint, 3)
            assert error.value == pytest.approx(1.001 * off)
            assert error.bound == pytest.approx(off)
            guard.check_after_gap(REST, found, REST, step, 1, np.arange(N) != joint)

    @joints
    @signs
    def test_velocity_of_the_arm(self, joint, sign):
        guard, step = Guard(limits(), PERIOD), at(joint, sign * 4e-3)
        stands = np.array([step, at(joint, sign * 5e-4)])
        error = refused(
            Check.GAP_VELOCITY, guard.check_after_gap, REST, stands, REST, step, 3, EVERY
        )
        assert error.joint == joint
        guard.check_after_gap(REST, stands, REST, step, 3, np.arange(N) != joint)
        lags = np.array([step, at(joint, sign * 5e-4 * 1.001)])
        guard.check_after_gap(REST, lags, REST, step, 3, EVERY)


class TestAfterPause:
    """What a servo gains in 50 ms at the acceleration allowed."""

    @joints
    @signs
    @names
    def test_the_arm_moves_as_the_set_points_sent_last(self, joint, sign, bounds):
        guard, speed, q = only(acceleration=8.0), at(joint, sign), START
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


class TestExtrapolated:
    """A controller's own steps: velocity and acceleration count on, jerk for some cycles not."""

    BOUND = 2.0 * 8.0 * PERIOD**2  # of a stop, per cycle

    @joints
    @signs
    def test_acceleration_and_later_jerk_are_bounded(self, joint, sign):
        guard, q, step = Guard(limits(), PERIOD), START, at(joint, sign * 1.5 * PERIOD)
        guard.resume_from(q, step / PERIOD, 2)
        for way in (1.0, -1.0, 1.0, -1.0):
            step = step + at(joint, way * JUST_BELOW * self.BOUND)
            q = q + step
            guard.check_set_point(q, step / PERIOD, "stop", 1)
        far = q + step + at(joint, JUST_BELOW * self.BOUND)
        refused(Check.JERK, guard.check_set_point, far, step / PERIOD, "stop", 2)
        guard.resume_from(q, step / PERIOD, 2)
        far = q + step + at(joint, 1.1 * self.BOUND)
        refused(Check.ACCELERATION, guard.check_set_point, far, (far - q) / PERIOD, "stop", 3)


class TestReported:
    def test_the_first_joint_of_the_first_check_that_fails(self):
        guard = only(velocity=0.5, jerk=50.0)
        step = START + at(1, 60.0 * PERIOD**3) + at(4, PERIOD)
        stated = (step - START) / PERIOD
        assert refused(Check.VELOCITY, guard.check_set_point, step, stated, "plan", 1).joint == 4
        both = START + at(1, PERIOD) + at(4, PERIOD)
        guard = only(velocity=0.5)
        assert refused(Check.VELOCITY, guard.check_set_point, both, REST, "plan", 1).joint == 1

    @pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
    def test_not_finite_comes_first(self, value):
        guard = Guard(limits(), PERIOD)
        current, actual = at(0, 1.0), at(1, 100.0)
        current[0] = value
        error = refused(Check.FINITE, guard.check_feedback, REST, actual, current, REST, 1)
        assert error.joint == 0


BOUNDS = limits()

jerk_shares = st.lists(st.floats(-1.3, 1.3), min_size=1, max_size=60)
bound_names = st.sampled_from(sorted(FACTORS))
values = st.floats(allow_nan=True, allow_infinity=True)


def profile(jerks, order: int) -> np.ndarray:
    """Joint 3 under a piecewise constant jerk, summed up `order` times, (m, n)."""
    rows = np.array(jerks)[:, None] * np.eye(N)[2]
    for _ in range(order):
        rows = np.cumsum(rows, axis=0) * PERIOD
    return rows


def passed(checks: CorrectionGuard, rows, bounds: str) -> np.ndarray:
    """The rows that passed before the first that did not."""
    for cycle, row in enumerate(rows):
        try:
            with np.errstate(all="ignore"):  # as the session has it
                checks.check_motion(row, bounds, cycle)
        except GuardError:
            return rows[:cycle]
    return rows


@given(jerk_shares, bound_names, st.sampled_from([("velocity", 2), ("offset", 3)]), st.data())
def test_accepted_corrections_are_within_the_bounds(jerk_shares, bounds, what, data):
    kind, order = what
    factor_a, factor_j = FACTORS[bounds]
    rows = profile([100.0 * factor_j * share for share in jerk_shares], order)
    if data.draw(st.booleans()):
        where = data.draw(st.integers(0, len(rows) - 1)), data.draw(st.integers(0, N - 1))
        rows[where] = data.draw(values)
    sent = passed(correcting(kind), rows, bounds)
    assert np.isfinite(sent).all()
    from_zero = np.vstack([np.zeros((3, N)), sent])
    highest = {"velocity": (0, 1, 2), "offset": (1, 2, 3)}[kind]
    for difference, bound, factor in zip(
        highest,
        (BOUNDS.velocity, BOUNDS.acceleration, BOUNDS.jerk),
        (1.0, factor_a, factor_j),
        strict=True,
    ):
        rate = np.abs(np.diff(from_zero, difference, axis=0)) / PERIOD**difference
        assert (rate <= bound * factor * (1 + 1e-5)).all()
        if kind == "offset":  # as well if it is a step made in each cycle
            rate = np.abs(np.diff(from_zero, difference - 1, axis=0)) / PERIOD**difference
            assert (rate <= bound * factor * (1 + 1e-5)).all()


@given(st.lists(st.floats(-1.0, 1.0), min_size=1, max_size=60), bound_names)
def test_corrections_within_the_bounds_pass(jerk_shares, bounds):
    _, factor_j = FACTORS[bounds]
    for kind, scale in (("velocity", 1.0), ("offset", 0.5 * PERIOD)):
        # As a position, an offset has the change of that jerk for one: at most twice as much.
        # 60 cycles of the largest jerk stay below the other two bounds only if they are short.
        rows = profile([100.0 * factor_j * share for share in jerk_shares[:25]], 2) * scale
        assert len(passed(correcting(kind), rows, bounds)) == len(rows)


def test_duration_of_wider_bounds_of_corrections():
    checks = correcting("velocity")
    rows = profile([290.0] * 10, 2)
    for cycle, row in enumerate(rows[:7]):
        checks.check_motion(row, "stop" if cycle < 5 else "plan", cycle)
    refused(Check.JERK, checks.check_motion, rows[7], "plan", 7)


@given(st.integers(0, N - 1), st.sampled_from([np.nan, np.inf, -np.inf]))
def test_corrections_that_are_not_finite_are_refused(joint, value):
    row, checks = at(joint, 1.0), correcting("velocity")
    row[joint] = value
    for check, *arguments in (
        (checks.check_motion, row, "plan"),
        (checks.check_current, row, None),
        (checks.check_current, row, REST),
        (checks.check_current, REST, row),
        (Guard(limits(), PERIOD).check_position, row),
    ):
        with np.errstate(invalid="ignore"):
            assert refused(Check.FINITE, check, *arguments, 1).joint == joint


def test_end_is_checked_by_the_value_sent_last():
    checks = correcting("velocity")
    checks.require_zero(Check.CORRECTION_END, 0)
    checks.check_current(np.full(N, 0.1), None, 1)
    refused(Check.CORRECTION_END, checks.require_zero, Check.CORRECTION_END, 1)
    checks.check_current(np.zeros(N), None, 2)
    checks.require_zero(Check.CORRECTION_END, 2)
    checks.check_current(np.full(N, 0.1), None, 3)
    checks.begin()
    checks.require_zero(Check.CORRECTION_END, 4)


def correcting(kind: str, bounds: GuardLimits | None = None) -> CorrectionGuard:
    checks = CorrectionGuard(Guard(bounds or limits(), PERIOD), kind)
    checks.begin()
    return checks


def correcting_only(kind: str, **bounds: float) -> CorrectionGuard:
    """Every rate but those given is out of reach."""
    return correcting(kind, rig.only(**bounds))


V, A, J = 0.5, 8.0, 100.0
T = PERIOD
EDGES = {
    # What is at its bound in the last row alone; before it, and by any other reading, it is less.
    "velocity: it is too fast": ("velocity", "velocity", [0.3, 0.6, 1.0], V),
    "velocity: it changes too fast": ("velocity", "acceleration", [0.5, 1.5], A * T),
    "velocity: its change does": ("velocity", "jerk", [0.5, 2.0], J * T**2),
    "offset: the step to it": ("offset", "velocity", [0.4, -0.6], V * T),
    "offset: a step in each cycle": ("offset", "velocity", [0.3, 0.6, 1.0], V * T),
    "offset: how its step changes": ("offset", "acceleration", [0.5, 0.0], A * T**2),
    "offset: how it changes, in each cycle": ("offset", "acceleration", [0.5, 1.5], A * T**2),
    "offset: how that changes": ("offset", "jerk", [0.5, 0.5], J * T**3),
    "offset: how that changes, in each cycle": ("offset", "jerk", [0.5, 2.0], J * T**3),
}


class TestCorrectionRates:
    @joints
    @signs
    @pytest.mark.parametrize("bounds", FACTORS)
    @pytest.mark.parametrize("edge", EDGES)
    def test_bounds_of_corrections(self, edge, bounds, joint, sign):
        kind, field, shape, unit = EDGES[edge]
        factor = dict(zip(RATES, (1.0, *FACTORS[bounds]), strict=True))[field]
        value = {"velocity": V, "acceleration": A, "jerk": J}[field]
        rows = [at(joint, sign * factor * unit * share) for share in shape]
        passes, fails = (correcting_only(kind, **{field: value}) for _ in range(2))
        for cycle, row in enumerate(rows):
            passes.check_motion(row * JUST_BELOW, bounds, cycle)
        for cycle, row in enumerate(rows[:-1]):
            fails.check_motion(row * JUST_ABOVE, bounds, cycle)
        error = refused(RATES[field], fails.check_motion, rows[-1] * JUST_ABOVE, bounds, 9)
        assert (error.joint, error.cycle) == (joint, 9)
        assert abs(error.value) == pytest.approx(factor * value, rel=1e-5)
        assert error.bound == pytest.approx(factor * value, rel=1e-5)

    @pytest.mark.parametrize("kind", ["velocity", "offset"])
    def test_begin_resets_the_history(self, kind):
        """Neither a correction sent before nor the bounds it was granted."""
        checks = correcting_only(kind, jerk=J)
        unit = {"velocity": T**2, "offset": T**3}[kind]
        checks.check_motion(at(1, 2.9 * J * unit), "stop", 1)
        checks.begin()
        assert checks.resting
        checks.check_motion(REST, "plan", 2)
        checks.begin()
        refused(Check.JERK, checks.check_motion, at(1, 1.6 * J * unit), "plan", 3)
        checks = correcting_only(kind, jerk=J)
        refused(Check.JERK, checks.check_motion, at(1, 1.6 * J * unit), "plan", 1)


class TestRest:
    def test_velocity_rests_at_zero_after_four_cycles(self):
        checks = correcting_only("velocity", velocity=2.0)
        assert checks.resting
        checks.check_motion(at(2, 0.1), "plan", 1)
        for cycle in range(2, 5):
            checks.check_motion(REST, "plan", cycle)
            assert not checks.resting
        checks.check_motion(REST, "plan", 5)
        assert checks.resting

    def test_a_velocity_that_stays_the_same_does_not_rest(self):
        checks = correcting_only("velocity", velocity=2.0)
        for cycle in range(8):
            checks.check_motion(at(2, -0.1), "plan", cycle)
        assert not checks.resting

    @pytest.mark.parametrize("value", [-1e-4, 1e-4])
    def test_an_offset_rests_wherever_it_stays(self, value):
        checks = correcting_only("offset", velocity=2.0)
        for cycle in range(4):
            checks.check_motion(at(2, value), "plan", cycle)
            assert checks.resting == (cycle == 3)
        checks.check_motion(REST, "plan", 5)
        assert not checks.resting


@pytest.mark.parametrize("error", [Check.CORRECTION_END, Check.GAP_CORRECTION])
class TestZero:
    """A millionth of the limit: what rounding leaves. The limits are 2 rad/s and 20 A."""

    @signs
    @pytest.mark.parametrize(
        ("kind", "nothing", "unit"), [("velocity", 2e-6, "rad/s"), ("offset", 2e-6 * T, "rad")]
    )
    def test_a_motion_part_has_to_be_zero(self, error, kind, nothing, unit, sign):
        checks = correcting_only(kind, velocity=2.0)
        checks.check_motion(at(3, sign * 0.9 * nothing), "plan", 1)
        checks.require_zero(error, 1)
        checks.check_motion(at(3, sign * 1.1 * nothing), "plan", 2)
        found = refused(error, checks.require_zero, error, 4)
        assert (found.joint, found.unit, found.cycle) == (3, unit, 4)
        assert found.value == pytest.approx(1.1 * nothing)
        assert found.bound == pytest.approx(nothing)

    @signs
    def test_a_current_has_to_be_zero(self, error, sign):
        checks = correcting("velocity")
        checks.check_current(at(3, sign * 0.9 * 2e-5), None, 1)
        checks.require_zero(error, 1)
        checks.check_current(at(3, sign * 1.1 * 2e-5), None, 2)
        found = refused(error, checks.require_zero, error, 4)
        assert (found.joint, found.unit, found.cycle) == (3, "A", 4)
        assert found.bound == pytest.approx(2e-5)


class TestTarget:
    """Target and offset together move no faster than 0.5 rad/s, the offset read either way."""

    HERE = np.array([0.1, -0.2, 0.3, -0.4, 0.5, -0.6])

    def checks(self, offset=REST) -> CorrectionGuard:
        checks = correcting_only("offset", velocity=V)
        checks.set_target(self.HERE, offset, np.full(N, 7.0))
        return checks

    @joints
    @signs
    @pytest.mark.parametrize(("sent_in", "cycles"), [(7.0, 1.0), (8.0, 1.0), (10.0, 3.0)])
    def test_target_moves_for_the_time_between(self, joint, sign, sent_in, cycles):
        step, sent = at(joint, sign * V * cycles * T), np.full(N, sent_in)
        self.checks().check_target(self.HERE + step * JUST_BELOW, REST, sent, REST, 1)
        too_far = self.HERE + step * JUST_ABOVE
        check = self.checks().check_target
        error = refused(Check.VELOCITY, check, too_far, REST, sent, REST, 5)
        assert (error.joint, error.cycle) == (joint, 5)
        assert error.value == pytest.approx(V, rel=1e-5)

    @joints
    @pytest.mark.parametrize("cycles", [1.0, 4.0])
    def test_the_rounding_of_the_wire_is_no_motion(self, joint, cycles):
        rounding, sent = np.full(N, 1e-5), np.full(N, 7.0 + cycles)
        for share, kind in ((0.99, None), (1.01, Check.VELOCITY)):
            target = self.HERE + at(joint, V * cycles * T + share * 1e-5)
            if kind is None:
                self.checks().check_target(target, REST, sent, rounding, 1)
            else:
                refused(kind, self.checks().check_target, target, REST, sent, rounding, 1)

    def leaves_four_tenths(self, joint, sign, before, after):
        """Of the way of one cycle at full speed, for the target itself; the other way is free."""
        sent = np.full(N, 8.0)
        for share, kind in ((0.399, None), (0.401, Check.VELOCITY), (-1.0, None)):
            target = self.HERE + at(joint, sign * share * V * T)
            check = self.checks(before).check_target
            if kind is None:
                check(target, after, sent, REST, 1)
            else:
                refused(kind, check, target, after, sent, REST, 1)

    @joints
    @signs
    def test_an_offset_that_stays_counts_as_a_step_in_each_cycle(self, joint, sign):
        offset = at(joint, sign * 0.6 * V * T)
        self.leaves_four_tenths(joint, sign, offset, offset)

    @joints
    @signs
    def test_an_offset_that_changes_moves_the_arm_by_its_change(self, joint, sign):
        before, after = at(joint, -sign * 0.3 * V * T), at(joint, sign * 0.3 * V * T)
        self.leaves_four_tenths(joint, sign, before, after)

    def test_each_cycle_is_compared_with_the_one_before(self):
        checks = self.checks()
        for cycle in range(1, 5):
            target = self.HERE + cycle * V * T
            checks.check_target(target, REST, np.full(N, 7.0 + cycle), REST, cycle)
        offset = np.full(N, 0.9 * V * T)
        checks.check_target(target, offset, np.full(N, 12.0), REST, 6)
        refused(Check.VELOCITY, checks.check_target, target, -offset, np.full(N, 13.0), REST, 7)


class TestCurrent:
    """20 A, and from zero to there in no less than 0.01 s: 4 A per cycle of 2 ms."""

    @joints
    @signs
    def test_step_of_the_current_sent(self, joint, sign):
        checks = correcting("velocity")
        for servo in (None, at(joint, sign * 9.0)):
            checks.begin()
            checks.check_current(at(joint, sign * 4.0), servo, 1)
            checks.check_current(at(joint, sign * 7.9999), servo, 2)
            checks.check_current(at(joint, sign * 4.0), None, 3)
            check = checks.check_current
            error = refused(Check.CURRENT_STEP, check, at(joint, sign * 8.001), servo, 4)
            assert (error.joint, error.cycle) == (joint, 4)
            assert error.bound == pytest.approx(4.0, rel=1e-5)

    @joints
    @signs
    def test_the_servo_s_own_counts_in_the_limit(self, joint, sign):
        checks = correcting("velocity")
        checks.check_current(at(joint, sign), at(joint, sign * (20.0 * JUST_BELOW - 1.0)), 1)
        check = checks.check_current
        servo = at(joint, sign * (20.0 * JUST_ABOVE - 1.0))
        error = refused(Check.COMMANDED_CURRENT, check, at(joint, sign), servo, 5)
        assert (error.joint, error.cycle) == (joint, 5)
        assert error.value == pytest.approx(20.0, rel=1e-5)
        check(at(joint, sign), at(joint, -sign * 20.0), 6)

    def test_the_controller_s_narrower_limit_narrows_both(self):
        guard = Guard(limits(), PERIOD)
        checks = CorrectionGuard(guard, "velocity")
        guard.narrow(np.full(N, np.nan), np.full(N, 5.0))
        checks.begin()
        refused(Check.CURRENT_STEP, checks.check_current, at(0, 1.001), None, 1)
        checks.check_current(at(0, 1.0), at(0, 4.0), 1)
        refused(Check.COMMANDED_CURRENT, checks.check_current, at(0, 1.0), at(0, 4.001), 1)


class TestCorrectedPosition:
    @joints
    @pytest.mark.parametrize("limit", [-1.0, 0.2])
    def test_the_range_need_not_lie_about_zero(self, joint, limit):
        ranges = limits(lower=np.full(N, -1.0), upper=np.full(N, 0.2))
        outwards = np.sign(limit)
        Guard(ranges, PERIOD).check_position(at(joint, limit + 5e-7 * outwards), 1)
        beyond = at(joint, limit + 7e-7 * outwards)
        error = refused(Check.POSITION, Guard(ranges, PERIOD).check_position, beyond, 2)
        assert (error.joint, error.value) == (joint, pytest.approx(beyond[joint]))
        assert (error.bound, error.cycle) == (pytest.approx(limit), 2)

    def test_the_first_joint_outside_is_named_with_its_own_limit(self):
        q = at(1, -3.0) + at(4, 3.0)
        error = refused(Check.POSITION, Guard(limits(), PERIOD).check_position, q, 2)
        assert (error.joint, error.bound) == (1, pytest.approx(-2.0))
