from __future__ import annotations

import numpy as np
import pytest

from planner import JointLimits
from planner.corners import STOP, fly_by, join
from planner.segments import StraightSegment

CUT = {"velocity": 0.99, "acceleration": 0.98, "jerk": 0.98}


def corner(points, limits):
    cautious = limits.scaled(**CUT)
    return (
        StraightSegment.between(points[0], points[1], cautious),
        StraightSegment.between(points[1], points[2], cautious),
    )


@pytest.mark.parametrize("fly", [0.05, 0.1, 0.5, 1.0])
def test_a_join_begins_and_ends_exactly_in_the_states_it_joins(six_axis_limits, random_points, fly):
    # The solver by itself is content with 1e-8 rad, which millisecond samples turn into jerk.
    for seed in range(20):
        before, after = corner(random_points(seed, 3), six_axis_limits)
        start = before.state(before.duration - fly * before.ramp)
        end = after.state(fly * after.ramp)
        joined = join(start, end, six_axis_limits)
        assert joined is not None
        ends = np.array([table[-1] for table in joined.ends()])
        starts = np.array([table[0, :3] for table in joined.coefficients])
        np.testing.assert_array_equal(starts, start)
        np.testing.assert_allclose(ends[:, 0], end[:, 0], rtol=0, atol=1e-12)
        np.testing.assert_allclose(ends[:, 1:], end[:, 1:], rtol=0, atol=1e-9)


@pytest.mark.parametrize("quantity", [1, 2])
@pytest.mark.parametrize("which", [0, 1])
def test_states_near_the_limits_never_reach_the_solver(
    six_axis_limits, random_points, monkeypatch, quantity, which
):
    def no_solver(*_):
        raise AssertionError("the solver was called")

    monkeypatch.setattr("planner.corners.ruckig.Ruckig", no_solver)
    states = np.zeros((2, 6, 3))
    bound = (six_axis_limits.velocity, six_axis_limits.acceleration)[quantity - 1]
    states[which, 3, quantity] = -0.995 * bound[3]
    assert join(*states, six_axis_limits) is None


def test_the_input_that_crashes_the_solver_is_refused(six_axis_limits):
    limits = JointLimits(
        [-3.0], [3.0], [2.792526803190927], [9.30842267730309], [93.08422677303089]
    )
    start = np.array([[-2.8452037956537097, -0.4654211338651546, 9.30842267730309]])
    end = np.array([[-2.8452037956537097, 0.4654211338651546, 9.30842267730309]])
    assert join(start, end, limits) is None


def test_a_join_that_would_leave_the_position_limits_is_tightened_until_it_does_not(
    six_axis_limits, random_points
):
    tightened = 0
    for seed in range(300):
        points = random_points(seed, 3)
        # Joint 5 turns round exactly on its limit while joint 0 sets the pace.
        points[1] = six_axis_limits.upper
        passed = fly_by(*corner(points, six_axis_limits), six_axis_limits, 1.0)
        if passed.join is not None:
            assert np.all(passed.join.extrema().upper <= six_axis_limits.upper + 1e-9)
        before, _ = corner(points, six_axis_limits)
        tightened += passed.leave < 0.99 * before.ramp
    assert tightened > 0


def test_a_join_that_takes_longer_than_what_it_replaces_is_given_up(
    six_axis_limits, random_points, monkeypatch
):
    before, after = corner(random_points(1, 3), six_axis_limits)
    detour = StraightSegment.between(*random_points(2, 2), six_axis_limits).pieces(0.0, 9.0)
    asked = []

    def slow_join(start, end, limits):
        asked.append(start)
        return detour

    monkeypatch.setattr("planner.corners.join", slow_join)
    assert fly_by(before, after, six_axis_limits, 0.5) is STOP
    tried = [before.state(before.duration - fly * before.ramp) for fly in 0.5 / 2 ** np.arange(5)]
    np.testing.assert_array_equal(asked, tried)  # as asked, then halved four times


def test_nothing_is_cut_from_a_stop(six_axis_limits, random_points):
    a, b, c = random_points(6, 3)
    assert fly_by(*corner((a, b, c), six_axis_limits), six_axis_limits, 0.0) is STOP
    assert fly_by(*corner((a, b, b), six_axis_limits), six_axis_limits, 0.5) is STOP
