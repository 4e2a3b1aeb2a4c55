from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import ruckig
from hypothesis import example, given, settings
from hypothesis import strategies as st

from planner import JointLimits, plan
from planner.time_law import (
    RateBounds,
    TimeLaw,
    admits,
    ramp,
    slowing_bounds,
)
from tests.planner.six_axes import SIX_AXES, random_points

fractions = st.one_of(st.sampled_from([0.0, 0.2, 1.0]), st.floats(0.0, 1.0))
bounds_of_any_size = st.builds(RateBounds, st.floats(0.01, 100.0), st.floats(0.01, 1000.0))


@st.composite
def states(draw):
    """Bounds and a state that they admit, often a limiting one."""
    bounds = draw(bounds_of_any_size)
    final = draw(fractions)
    # The slope can be as large as one that ends there from 0, or from 1 if it is negative.
    most = min(bounds.slope, (2.0 * bounds.change * final) ** 0.5)
    least = -min(bounds.slope, (2.0 * bounds.change * (1.0 - final)) ** 0.5)
    slope = draw(st.one_of(st.just(0.0), st.just(most), st.just(least), st.floats(least, most)))
    return bounds, final - slope * abs(slope) / (2.0 * bounds.change), slope


@given(states(), fractions)
@example((RateBounds(1.0, 10.0), 0.0, 0.0), 5e-324)
@example((RateBounds(1.0, 10.0), 1.0, 0.0), 1.0)
def test_a_ramp_is_smooth_within_its_bounds_to_the_target(state, target):
    bounds, rate, slope = state
    way = ramp(rate, slope, target, bounds)
    assert way.sample(0.0) == (0.0, rate, slope) or way.duration == 0.0
    begins = [piece.begin for piece in way.pieces]
    assert [0.0, *begins[1:], way.duration] == sorted([0.0, *begins[1:], way.duration])
    size = max(1.0, bounds.slope, bounds.change)
    for begin, end, piece in zip(begins, [*begins[1:], way.duration], way.pieces, strict=True):
        assert abs(piece.change) <= bounds.change
        x = end - begin
        assert abs(piece.slope) <= bounds.slope * (1 + 1e-12)
        # No jump to the next piece or the target.
        after = way.sample(end)
        assert after[2] == pytest.approx(piece.slope + x * piece.change, abs=1e-10 * size)
        assert after[1] == pytest.approx(
            piece.rate + x * piece.slope + x * x * piece.change / 2.0, abs=1e-10 * size
        )
        # A cubic is integrated exactly from its ends and middle.
        middle = piece.rate + x * piece.slope / 2.0 + x * x * piece.change / 8.0
        assert after[0] - piece.motion_time == pytest.approx(
            x / 6.0 * (piece.rate + 4.0 * middle + after[1]), abs=1e-9 * max(1.0, x)
        )
    assert way.sample(way.duration) == (way.motion_time, target, 0.0)
    assert way.sample(way.duration + 2.0)[0] == pytest.approx(way.motion_time + 2.0 * target)


@given(states(), fractions)
def test_no_ramp_is_faster(state, target):
    bounds, rate, slope = state
    # The reference is known to crash at states on their limit, and is exact to 1e-8.
    slope = float(np.clip(slope, -0.9 * bounds.slope, 0.9 * bounds.slope))
    problem = ruckig.InputParameter(1)
    problem.control_interface = ruckig.ControlInterface.Velocity
    problem.current_position, problem.current_velocity = [0.0], [rate]
    problem.current_acceleration = [slope]
    problem.target_velocity, problem.target_acceleration = [target], [0.0]
    problem.max_acceleration, problem.max_jerk = [bounds.slope], [bounds.change]
    reference = ruckig.Trajectory(1)
    ruckig.Ruckig(1).calculate(problem, reference)
    duration = ramp(rate, slope, target, bounds).duration
    assert duration == pytest.approx(reference.duration, rel=1e-6, abs=1e-7)


moments = st.one_of(st.just(0.0), st.floats(0.0, 3.0))


@given(states(), st.lists(st.tuples(fractions, moments, st.booleans()), min_size=1, max_size=12))
def test_targets_and_wider_bounds_stay_in_the_range(state, changes):
    bounds, rate, slope = state
    seen = []
    for target, share, widen in changes:
        if widen:
            bounds = RateBounds(1.5 * bounds.slope, 2.0 * bounds.change)
        way = ramp(rate, slope, target, bounds)
        until = share * way.duration
        # Extremes lie where the slope is zero: at the ends, or in the middle of a piece.
        at = [0.0, *np.linspace(0.0, until, 9)]
        at += [p.begin - p.slope / p.change for p in way.pieces if p.change != 0.0]
        seen += [way.sample(t)[1] for t in at if 0.0 <= t <= until]
        steps = [way.sample(t)[0] for t in np.linspace(0.0, until, 9)]
        assert all(b >= a - 1e-12 for a, b in pairwise(steps))
        _, rate, slope = way.sample(until)
    assert min(seen) >= -1e-9
    assert max(seen) <= 1.0 + 1e-9


@given(states(), st.booleans())
def test_a_state_outside_its_bounds_is_not_admitted(state, rising):
    bounds, rate, _ = state
    assert admits(bounds, 0.5, 0.0)
    assert not admits(bounds, rate, (1.0 + 1e-9) * (bounds.slope if rising else -bounds.slope))
    too_steep = (2.0 * bounds.change * 0.25) ** 0.5 * (1.0 + 1e-9)
    assert not admits(bounds, 0.75 if rising else 0.25, too_steep if rising else -too_steep)


def test_motion_time_follows_the_ramp_and_settles():
    bounds, period = RateBounds(2.0, 20.0), 0.002
    law = TimeLaw(period)
    law.restart(1.5, 1.0)
    assert law.settled
    law.advance()
    assert (law.motion_time, law.rate, law.slope, law.settled) == (1.502, 1.0, 0.0, True)
    law.aim(0.25, bounds)
    way = ramp(1.0, 0.0, 0.25, bounds)
    assert not law.settled
    for tick in range(1, 500):
        law.advance()
        gone, rate, slope = way.sample(tick * period)
        assert (law.motion_time, law.rate, law.slope) == (1.502 + gone, rate, slope)
        assert law.settled == (tick * period >= way.duration)
    assert law.rate == 0.25


rates = st.floats(-1.0, 2.0).map(lambda exponent: 10.0**exponent)
joints = st.lists(st.tuples(rates, rates, rates), min_size=1, max_size=4)
shares = st.floats(0.0, 1.5)


def limits_of(velocity, acceleration, jerk):
    return JointLimits(-np.ones(len(jerk)), np.ones(len(jerk)), velocity, acceleration, jerk)


@given(joints, rates, rates)
def test_the_worst_path_just_satisfies_the_bounds(joints, more, much_more):
    # Velocity, acceleration and jerk at their limits at once, with the worst signs.
    velocity, acceleration, jerk = np.array(joints).T
    bounds = slowing_bounds(limits_of(velocity, acceleration, jerk), 1.0 + more, 1.0 + much_more)
    assert bounds.slope > 0.0
    assert bounds.change > 0.0
    used_acceleration = (acceleration + velocity * bounds.slope) / acceleration
    used_jerk = (jerk + 3 * acceleration * bounds.slope + velocity * bounds.change) / jerk
    assert np.all(used_acceleration <= (1.0 + more) * (1 + 1e-9))
    # At least one joint uses all its jerk, or there would be a faster change.
    assert np.max(used_jerk) == pytest.approx(1.0 + much_more)


@pytest.fixture(scope="module")
def motions():
    return [plan(random_points(seed, 4), SIX_AXES) for seed in range(6)]


@given(
    which=st.integers(0, 5),
    share=st.floats(0.0, 1.0),
    factors=st.sampled_from([(1.3, 1.7), (2.0, 3.0), (1.05, 4.0)]),
    from_rate=st.floats(0.0, 1.0),
    to_rate=st.floats(0.0, 1.0),
)
@settings(max_examples=60)
def test_bounds_are_satisfied_between_set_points_too(
    motions, which, share, factors, from_rate, to_rate
):
    motion, limits = motions[which], SIX_AXES
    way = ramp(from_rate, 0.0, to_rate, slowing_bounds(limits, *factors, motion.extrema()))
    t = np.linspace(0.0, way.duration, 2000)
    s, r, dr = np.array([way.sample(float(x)) for x in t]).T[:, :, None]
    begins = [piece.begin for piece in way.pieces[1:]]
    piece = np.searchsorted(begins, t, side="right")
    ddr = np.array([piece.change for piece in way.pieces])[piece][:, None]
    s = s[:, 0] + share * motion.duration
    _, v, a = motion.sample(s)
    jerk = np.empty_like(v)
    for joint, knots in enumerate(motion.knots):
        at = np.searchsorted(knots[1:-1], s, side="right")
        jerk[:, joint] = motion.coefficients[joint][at, 3]
    jerk[s > motion.duration] = 0.0
    rounding = 1 + 1e-9
    assert np.all(np.abs(v * r) <= limits.velocity * rounding)
    assert np.all(np.abs(a * r**2 + v * dr) <= factors[0] * limits.acceleration * rounding)
    assert np.all(
        np.abs(jerk * r**3 + 3 * a * r * dr + v * ddr) <= factors[1] * limits.jerk * rounding
    )
