"""Laws of what may be fed forward or corrected."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers import Guard, GuardError, GuardLimits, NotFinite
from drivers.errors import (
    AccelerationLimit,
    CommandedCurrentLimit,
    CommandedCurrentStep,
    CorrectionNotCarriedOn,
    CorrectionNotEnded,
    JerkLimit,
    PositionLimit,
    VelocityLimit,
)
from drivers.guard import CorrectionGuard
from tests.drivers import rig
from tests.drivers.rig import (
    FACTORS,
    JUST_ABOVE,
    JUST_BELOW,
    PERIOD,
    REST,
    N,
    at,
    joints,
    limits,
    refused,
    signs,
)

BOUNDS = limits()

shares = st.lists(st.floats(-1.3, 1.3), min_size=1, max_size=60)
names = st.sampled_from(sorted(FACTORS))
values = st.floats(allow_nan=True, allow_infinity=True)


def guard(kind: str) -> CorrectionGuard:
    checks = CorrectionGuard(Guard(BOUNDS, PERIOD), kind)
    checks.begin()
    return checks


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


@given(shares, names, st.sampled_from([("velocity", 2), ("offset", 3)]), st.data())
def test_what_passes_keeps_the_bounds_by_differences_of_ones_own(shares, bounds, what, data):
    kind, order = what
    factor_a, factor_j = FACTORS[bounds]
    rows = profile([100.0 * factor_j * share for share in shares], order)
    if data.draw(st.booleans()):
        where = data.draw(st.integers(0, len(rows) - 1)), data.draw(st.integers(0, N - 1))
        rows[where] = data.draw(values)
    sent = passed(guard(kind), rows, bounds)
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


@given(st.lists(st.floats(-1.0, 1.0), min_size=1, max_size=60), names)
def test_what_keeps_its_bounds_passes(shares, bounds):
    _, factor_j = FACTORS[bounds]
    for kind, scale in (("velocity", 1.0), ("offset", 0.5 * PERIOD)):
        # As a position, an offset has the change of that jerk for one: at most twice as much.
        # 60 cycles of the largest jerk stay below the other two bounds only if they are short.
        rows = profile([100.0 * factor_j * share for share in shares[:25]], 2) * scale
        assert len(passed(guard(kind), rows, bounds)) == len(rows)


def test_wider_bounds_stay_in_force_until_no_difference_reaches_back_to_them():
    checks = guard("velocity")
    rows = profile([290.0] * 10, 2)
    for cycle, row in enumerate(rows[:5]):
        checks.check_motion(row, "stop", cycle)
    checks.check_motion(rows[5], "plan", 5)
    checks.check_motion(rows[6], "plan", 6)
    with pytest.raises(JerkLimit):
        checks.check_motion(rows[7], "plan", 7)


@given(st.integers(0, N - 1), st.sampled_from([np.nan, np.inf, -np.inf]))
def test_what_is_not_finite_never_passes(joint, value):
    row = np.zeros(N)
    row[joint] = value
    checks = guard("velocity")
    for check in (
        lambda: checks.check_motion(row, "plan", 1),
        lambda: checks.check_current(row, None, 1),
        lambda: checks.check_current(row, np.zeros(N), 1),
        lambda: checks.check_current(np.zeros(N), row, 1),
        lambda: checks.check_position(row, 1),
    ):
        with np.errstate(invalid="ignore"), pytest.raises(NotFinite) as caught:
            check()
        assert caught.value.joint == joint


def test_the_end_is_judged_by_what_was_sent_last():
    checks = guard("velocity")
    checks.check_end(0)
    checks.check_current(np.full(N, 0.1), None, 1)
    with pytest.raises(CorrectionNotEnded):
        checks.check_end(1)
    checks.check_current(np.zeros(N), None, 2)
    checks.check_end(2)
    checks.check_current(np.full(N, 0.1), None, 3)
    checks.begin()
    checks.check_end(4)


def begun(kind: str, bounds: GuardLimits | None = None) -> CorrectionGuard:
    checks = CorrectionGuard(Guard(bounds or limits(), PERIOD), kind)
    checks.begin()
    return checks


def only(kind: str, **bounds: float) -> CorrectionGuard:
    """Every rate but those given is out of reach."""
    return begun(kind, rig.only(**bounds))


V, A, J = 0.5, 8.0, 100.0
T = PERIOD
EDGES = {
    # What is at its bound in the last row alone; before it, and by any other reading, it is less.
    "velocity: it is too fast": ("velocity", "velocity", [0.3, 0.6, 1.0], V),
    "velocity: it changes too fast": ("velocity", "acceleration", [0.5, 1.5], A * T),
    "velocity: its change does": ("velocity", "jerk", [0.5, 2.0], J * T**2),
    "offset: the step to it": ("offset", "velocity", [0.4, -0.6], V * T),
    "offset: a step made anew each cycle": ("offset", "velocity", [0.3, 0.6, 1.0], V * T),
    "offset: how its step changes": ("offset", "acceleration", [0.5, 0.0], A * T**2),
    "offset: how it changes, made anew": ("offset", "acceleration", [0.5, 1.5], A * T**2),
    "offset: how that changes": ("offset", "jerk", [0.5, 0.5], J * T**3),
    "offset: how that changes, made anew": ("offset", "jerk", [0.5, 2.0], J * T**3),
}
KINDS = {"velocity": VelocityLimit, "acceleration": AccelerationLimit, "jerk": JerkLimit}


class TestRates:
    @joints
    @signs
    @pytest.mark.parametrize("bounds", FACTORS)
    @pytest.mark.parametrize("edge", EDGES)
    def test_each_reading_of_a_correction_keeps_each_bound(self, edge, bounds, joint, sign):
        kind, field, shape, unit = EDGES[edge]
        factor = dict(zip(KINDS, (1.0, *FACTORS[bounds]), strict=True))[field]
        value = {"velocity": V, "acceleration": A, "jerk": J}[field]
        rows = [at(joint, sign * factor * unit * share) for share in shape]
        passes, fails = (only(kind, **{field: value}) for _ in range(2))
        for cycle, row in enumerate(rows):
            passes.check_motion(row * JUST_BELOW, bounds, cycle)
        for cycle, row in enumerate(rows[:-1]):
            fails.check_motion(row * JUST_ABOVE, bounds, cycle)
        error = refused(KINDS[field], fails.check_motion, rows[-1] * JUST_ABOVE, bounds, 9)
        assert (error.joint, error.cycle) == (joint, 9)
        assert abs(error.value) == pytest.approx(factor * value, rel=1e-5)
        assert error.bound == pytest.approx(factor * value, rel=1e-5)

    @pytest.mark.parametrize(("kind", "share"), [("velocity", 1.0), ("offset", T)])
    def test_what_is_allowed_once_is_allowed_for_ever(self, kind, share):
        checks = only(kind, velocity=V)
        for cycle in range(8):
            checks.check_motion(np.full(N, V * share), "plan", cycle)

    @pytest.mark.parametrize("kind", ["velocity", "offset"])
    def test_one_that_begins_anew_has_no_past(self, kind):
        """Neither a correction sent before nor the bounds it was granted."""
        checks = only(kind, jerk=J)
        unit = {"velocity": T**2, "offset": T**3}[kind]
        checks.check_motion(at(1, 2.9 * J * unit), "stop", 1)
        checks.begin()
        assert checks.resting
        checks.check_motion(REST, "plan", 2)
        checks.begin()
        refused(JerkLimit, checks.check_motion, at(1, 1.6 * J * unit), "plan", 3)
        checks = only(kind, jerk=J)
        refused(JerkLimit, checks.check_motion, at(1, 1.6 * J * unit), "plan", 1)


class TestRest:
    def test_a_velocity_rests_at_zero_once_no_difference_reaches_back(self):
        checks = only("velocity", velocity=2.0)
        assert checks.resting
        checks.check_motion(at(2, 0.1), "plan", 1)
        for cycle in range(2, 5):
            checks.check_motion(REST, "plan", cycle)
            assert not checks.resting
        checks.check_motion(REST, "plan", 5)
        assert checks.resting

    def test_a_velocity_that_stays_the_same_does_not_rest(self):
        checks = only("velocity", velocity=2.0)
        for cycle in range(8):
            checks.check_motion(at(2, -0.1), "plan", cycle)
        assert not checks.resting

    @pytest.mark.parametrize("value", [-1e-4, 1e-4])
    def test_an_offset_rests_wherever_it_stays(self, value):
        checks = only("offset", velocity=2.0)
        for cycle in range(4):
            checks.check_motion(at(2, value), "plan", cycle)
            assert checks.resting == (cycle == 3)
        checks.check_motion(REST, "plan", 5)
        assert not checks.resting


@pytest.mark.parametrize(
    ("check", "error"),
    [("check_end", CorrectionNotEnded), ("check_after_gap", CorrectionNotCarriedOn)],
)
class TestZero:
    """A millionth of the limit: what rounding leaves. The limits are 2 rad/s and 20 A."""

    @signs
    @pytest.mark.parametrize(
        ("kind", "nothing", "unit"), [("velocity", 2e-6, "rad/s"), ("offset", 2e-6 * T, "rad")]
    )
    def test_a_motion_part_has_to_be_zero(self, check, error, kind, nothing, unit, sign):
        checks = only(kind, velocity=2.0)
        checks.check_motion(at(3, sign * 0.9 * nothing), "plan", 1)
        getattr(checks, check)(1)
        checks.check_motion(at(3, sign * 1.1 * nothing), "plan", 2)
        found = refused(error, getattr(checks, check), 4)
        assert (found.joint, found.unit, found.cycle) == (3, unit, 4)
        assert found.value == pytest.approx(1.1 * nothing)
        assert found.bound == pytest.approx(nothing)

    @signs
    def test_a_current_has_to_be_zero(self, check, error, sign):
        checks = begun("velocity")
        checks.check_current(at(3, sign * 0.9 * 2e-5), None, 1)
        getattr(checks, check)(1)
        checks.check_current(at(3, sign * 1.1 * 2e-5), None, 2)
        found = refused(error, getattr(checks, check), 4)
        assert (found.joint, found.unit, found.cycle) == (3, "A", 4)
        assert found.bound == pytest.approx(2e-5)


class TestTarget:
    """Target and offset together move no faster than 0.5 rad/s, the offset read either way."""

    HERE = np.array([0.1, -0.2, 0.3, -0.4, 0.5, -0.6])

    def checks(self, offset=REST) -> CorrectionGuard:
        checks = only("offset", velocity=V)
        checks.note_target(self.HERE, offset, np.full(N, 7.0))
        return checks

    @joints
    @signs
    @pytest.mark.parametrize(("sent_in", "cycles"), [(7.0, 1.0), (8.0, 1.0), (10.0, 3.0)])
    def test_a_target_may_move_for_as_long_as_lies_between(self, joint, sign, sent_in, cycles):
        step, sent = at(joint, sign * V * cycles * T), np.full(N, sent_in)
        self.checks().check_target(self.HERE + step * JUST_BELOW, REST, sent, REST, 1)
        too_far = self.HERE + step * JUST_ABOVE
        check = self.checks().check_target
        error = refused(VelocityLimit, check, too_far, REST, sent, REST, 5)
        assert (error.joint, error.cycle) == (joint, 5)
        assert error.value == pytest.approx(V, rel=1e-5)

    @joints
    @pytest.mark.parametrize("cycles", [1.0, 4.0])
    def test_the_rounding_of_the_wire_is_no_motion(self, joint, cycles):
        rounding, sent = np.full(N, 1e-5), np.full(N, 7.0 + cycles)
        for share, kind in ((0.99, None), (1.01, VelocityLimit)):
            target = self.HERE + at(joint, V * cycles * T + share * 1e-5)
            if kind is None:
                self.checks().check_target(target, REST, sent, rounding, 1)
            else:
                refused(kind, self.checks().check_target, target, REST, sent, rounding, 1)

    def leaves_four_tenths(self, joint, sign, before, after):
        """Of the way of one cycle at full speed, for the target itself; the other way is free."""
        sent = np.full(N, 8.0)
        for share, kind in ((0.399, None), (0.401, VelocityLimit), (-1.0, None)):
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

    def test_each_cycle_is_held_against_the_one_before(self):
        checks = self.checks()
        for cycle in range(1, 5):
            target = self.HERE + cycle * V * T
            checks.check_target(target, REST, np.full(N, 7.0 + cycle), REST, cycle)
        offset = np.full(N, 0.9 * V * T)
        checks.check_target(target, offset, np.full(N, 12.0), REST, 6)
        refused(VelocityLimit, checks.check_target, target, -offset, np.full(N, 13.0), REST, 7)


class TestCurrent:
    """20 A, and from zero to there in no less than 0.01 s: 4 A per cycle of 2 ms."""

    @joints
    @signs
    def test_a_step_is_held_against_the_current_sent_last_whatever_the_servo_does(
        self, joint, sign
    ):
        checks = begun("velocity")
        for servo in (None, at(joint, sign * 9.0)):
            checks.begin()
            checks.check_current(at(joint, sign * 4.0), servo, 1)
            checks.check_current(at(joint, sign * 7.9999), servo, 2)
            checks.check_current(at(joint, sign * 4.0), None, 3)
            check = checks.check_current
            error = refused(CommandedCurrentStep, check, at(joint, sign * 8.001), servo, 4)
            assert (error.joint, error.cycle) == (joint, 4)
            assert error.bound == pytest.approx(4.0, rel=1e-5)

    @joints
    @signs
    def test_the_servo_s_own_counts_in_the_limit(self, joint, sign):
        checks = begun("velocity")
        checks.check_current(at(joint, sign), at(joint, sign * (20.0 * JUST_BELOW - 1.0)), 1)
        check = checks.check_current
        servo = at(joint, sign * (20.0 * JUST_ABOVE - 1.0))
        error = refused(CommandedCurrentLimit, check, at(joint, sign), servo, 5)
        assert (error.joint, error.cycle) == (joint, 5)
        assert error.value == pytest.approx(20.0, rel=1e-5)
        check(at(joint, sign), at(joint, -sign * 20.0), 6)

    def test_the_controller_s_narrower_limit_narrows_both(self):
        guard = Guard(limits(), PERIOD)
        checks = CorrectionGuard(guard, "velocity")
        guard.narrow(np.full(N, np.nan), np.full(N, 5.0))
        checks.begin()
        refused(CommandedCurrentStep, checks.check_current, at(0, 1.001), None, 1)
        checks.check_current(at(0, 1.0), at(0, 4.0), 1)
        refused(CommandedCurrentLimit, checks.check_current, at(0, 1.0), at(0, 4.001), 1)


class TestPosition:
    @joints
    @pytest.mark.parametrize("limit", [-1.0, 0.2])
    def test_the_range_need_not_lie_about_zero(self, joint, limit):
        ranges = limits(lower=np.full(N, -1.0), upper=np.full(N, 0.2))
        outwards = np.sign(limit)
        begun("offset", ranges).check_position(at(joint, limit + 5e-7 * outwards), 1)
        beyond = at(joint, limit + 7e-7 * outwards)
        error = refused(PositionLimit, begun("offset", ranges).check_position, beyond, 2)
        assert (error.joint, error.value) == (joint, beyond[joint])
        assert (error.bound, error.cycle) == (limit, 2)

    def test_the_first_joint_outside_is_named_with_its_own_limit(self):
        q = at(1, -3.0) + at(4, 3.0)
        error = refused(PositionLimit, begun("offset").check_position, q, 2)
        assert (error.joint, error.bound) == (1, -2.0)
