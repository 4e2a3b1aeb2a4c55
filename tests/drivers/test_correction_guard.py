"""Laws of what may be fed forward or corrected."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers import Guard, GuardError, JerkLimit, NotFinite
from drivers.errors import CorrectionNotEnded, PositionLimit
from drivers.guard import CorrectionGuard
from tests.drivers.rig import PERIOD, N, limits

BOUNDS = limits()
FACTORS = {"plan": (1.0, 1.0), "override": (1.3, 1.7), "stop": (2.0, 3.0)}

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


@pytest.mark.parametrize("sign", [-1, 1])
def test_a_position_outside_its_range_names_the_limit_on_its_side(sign):
    q = np.zeros(N)
    q[3] = sign * 2.0
    guard("offset").check_position(q, 1)
    q[3] = sign * 2.001
    with pytest.raises(PositionLimit) as caught:
        guard("offset").check_position(q, 7)
    error = caught.value
    assert (error.joint, error.value, error.bound, error.cycle) == (3, sign * 2.001, sign * 2.0, 7)


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
