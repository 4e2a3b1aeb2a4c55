from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from planner import JointLimits, plan
from planner.piecewise_cubic import Extrema
from planner.time_law import RateBounds, ramp, slowing_bounds, within

rates = st.floats(-1.0, 2.0).map(lambda exponent: 10.0**exponent)
joints = st.lists(st.tuples(rates, rates, rates), min_size=1, max_size=4)
shares = st.floats(0.0, 1.5)


def limits_of(velocity, acceleration, jerk):
    return JointLimits(-np.ones(len(jerk)), np.ones(len(jerk)), velocity, acceleration, jerk)


@given(joints, rates, rates)
def test_the_worst_conceivable_path_just_keeps_the_bounds(joints, more, much_more):
    # All of velocity, acceleration and jerk at their limits at once, signs chosen against us.
    velocity, acceleration, jerk = np.array(joints).T
    bounds = slowing_bounds(limits_of(velocity, acceleration, jerk), 1.0 + more, 1.0 + much_more)
    assert bounds.slope > 0.0
    assert bounds.change > 0.0
    used_acceleration = (acceleration + velocity * bounds.slope) / acceleration
    used_jerk = (jerk + 3 * acceleration * bounds.slope + velocity * bounds.change) / jerk
    assert np.all(used_acceleration <= (1.0 + more) * (1 + 1e-9))
    # At least one joint uses all the jerk that it may, or there would be a faster change.
    assert np.max(used_jerk) == pytest.approx(1.0 + much_more)


@given(joints, rates, rates, st.floats(0.001, 1.0))
def test_no_other_division_of_the_spare_jerk_stops_much_faster(joints, more, much_more, share):
    velocity, acceleration, jerk = np.array(joints).T
    bounds = slowing_bounds(limits_of(velocity, acceleration, jerk), 1.0 + more, 1.0 + much_more)
    slope = share * np.min(
        np.minimum(more * acceleration / velocity, much_more * jerk / (3 * acceleration))
    )
    change = np.min((much_more * jerk - 3 * acceleration * slope) / velocity)
    if slope > 0.0 and change > 0.0:
        other = ramp(1.0, 0.0, 0.0, RateBounds(float(slope), float(change)))
        assert ramp(1.0, 0.0, 0.0, bounds).duration <= 1.02 * other.duration


@given(joints, st.tuples(shares, shares, shares), rates, rates)
@example([(1.0, 1.0, 1.0)], (0.0, 2.2250738585e-313, 0.0), 1.0, 1.0)
def test_a_path_that_uses_less_than_its_limits_may_slow_faster(joints, used, more, much_more):
    velocity, acceleration, jerk = np.array(joints).T
    limits = limits_of(velocity, acceleration, jerk)
    # Above 1 a path breaks its limits; what it breaks is nothing to count on, nor to divide by.
    v, a, j = (share * q for share, q in zip(used, (velocity, acceleration, jerk), strict=True))
    extrema = Extrema(limits.lower, limits.upper, v, a, j)
    bounds = slowing_bounds(limits, 1.0 + more, 1.0 + much_more, extrema)
    assert np.isfinite(bounds).all()
    v, a, j = np.minimum(v, velocity), np.minimum(a, acceleration), np.minimum(j, jerk)
    assert np.all(a + v * bounds.slope <= (1.0 + more) * acceleration * (1 + 1e-9))
    assert np.all(
        j + 3 * a * bounds.slope + v * bounds.change <= (1.0 + much_more) * jerk * (1 + 1e-9)
    )
    general = slowing_bounds(limits, 1.0 + more, 1.0 + much_more)
    duration = ramp(1.0, 0.0, 0.0, bounds).duration
    assert duration <= 1.02 * ramp(1.0, 0.0, 0.0, general).duration


def test_bounds_within_others_are_the_narrower_of_each():
    assert within(RateBounds(1.0, 9.0), RateBounds(2.0, 8.0)) == RateBounds(1.0, 8.0)


@pytest.fixture(scope="module")
def motions(six_axis_limits, random_points):
    return [plan(random_points(seed, 4), six_axis_limits) for seed in range(6)]


@given(
    which=st.integers(0, 5),
    share=st.floats(0.0, 1.0),
    factors=st.sampled_from([(1.3, 1.7), (2.0, 3.0), (1.05, 4.0)]),
    from_rate=st.floats(0.0, 1.0),
    to_rate=st.floats(0.0, 1.0),
)
@settings(max_examples=60)
def test_a_change_of_rate_keeps_its_bounds_between_the_set_points_too(
    motions, six_axis_limits, which, share, factors, from_rate, to_rate
):
    motion, limits = motions[which], six_axis_limits
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
