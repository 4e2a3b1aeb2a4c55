from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import ruckig
from hypothesis import example, given
from hypothesis import strategies as st

from planner.time_law import RateBounds, TimeLaw, admits, ramp, stopping_rate

fractions = st.one_of(st.sampled_from([0.0, 0.2, 1.0]), st.floats(0.0, 1.0))
bounds_of_any_size = st.builds(RateBounds, st.floats(0.01, 100.0), st.floats(0.01, 1000.0))


@st.composite
def states(draw):
    """Bounds and a state that they admit, often one at the edge of what they do."""
    bounds = draw(bounds_of_any_size)
    settles = draw(fractions)
    # The slope can be as large as it takes to settle there from 0, or from 1 for a falling one.
    most = min(bounds.slope, (2.0 * bounds.change * settles) ** 0.5)
    least = -min(bounds.slope, (2.0 * bounds.change * (1.0 - settles)) ** 0.5)
    slope = draw(st.one_of(st.just(0.0), st.just(most), st.just(least), st.floats(least, most)))
    return bounds, settles - slope * abs(slope) / (2.0 * bounds.change), slope


@given(states(), fractions)
@example((RateBounds(1.0, 10.0), 0.0, 0.0), 5e-324)
@example((RateBounds(1.0, 10.0), 1.0, 0.0), 1.0)
def test_a_ramp_is_smooth_keeps_its_bounds_and_ends_at_the_target(state, target):
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
        # Where the next piece begins, or the target: what this one comes to, without a jump.
        after = way.sample(end)
        assert after[2] == pytest.approx(piece.slope + x * piece.change, abs=1e-10 * size)
        assert after[1] == pytest.approx(
            piece.rate + x * piece.slope + x * x * piece.change / 2.0, abs=1e-10 * size
        )
        # A cubic is integrated exactly from its ends and middle.
        middle = piece.rate + x * piece.slope / 2.0 + x * x * piece.change / 8.0
        assert after[0] - piece.gone == pytest.approx(
            x / 6.0 * (piece.rate + 4.0 * middle + after[1]), abs=1e-9 * max(1.0, x)
        )
    assert way.sample(way.duration) == (way.gone, target, 0.0)
    assert way.sample(way.duration + 2.0)[0] == pytest.approx(way.gone + 2.0 * target)


@given(states(), fractions)
def test_no_ramp_is_faster(state, target):
    bounds, rate, slope = state
    # The reference is known to crash at states on their limit, and not to care below 1e-8.
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
def test_no_sequence_of_targets_and_wider_bounds_leaves_the_range(state, changes):
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


@given(states(), fractions, st.floats(0.0, 1.0))
def test_where_the_slope_would_die_away_moves_monotonically_to_the_target(state, target, share):
    bounds, rate, slope = state
    way = ramp(rate, slope, target, bounds)
    now = way.sample(share * way.duration)
    later = way.sample((share + (1.0 - share) / 2.0) * way.duration)
    off = [abs(target - stopping_rate(r, dr, bounds.change)) for _, r, dr in (now, later)]
    assert off[1] <= off[0] + 1e-9


@given(states(), st.booleans())
def test_a_state_outside_its_bounds_is_not_admitted(state, rising):
    bounds, rate, _ = state
    assert admits(bounds, 0.5, 0.0)
    assert not admits(bounds, rate, (1.0 + 1e-9) * (bounds.slope if rising else -bounds.slope))
    too_steep = (2.0 * bounds.change * 0.25) ** 0.5 * (1.0 + 1e-9)
    assert not admits(bounds, 0.75 if rising else 0.25, too_steep if rising else -too_steep)


def test_wider_bounds_leave_a_state_that_narrower_ones_do_not_admit_and_still_end_it():
    steep, gentle = RateBounds(4.0, 40.0), RateBounds(1.0, 10.0)
    _, rate, slope = ramp(0.0, 0.0, 1.0, steep).sample(0.15)
    assert not admits(gentle, rate, slope)
    way = ramp(rate, slope, 0.3, gentle)  # all that can be done is not to make it worse
    slopes = [way.sample(t)[2] for t in np.linspace(0.0, way.duration, 100)]
    assert max(slopes) <= slope
    assert way.sample(way.duration)[1:] == (0.3, 0.0)


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


def test_aiming_at_the_rate_that_is_changes_nothing():
    law = TimeLaw(0.001)
    law.aim(1.0, RateBounds(1.0, 1.0))
    assert law.settled
    assert law.rate == 1.0
