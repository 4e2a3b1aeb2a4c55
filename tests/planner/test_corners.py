from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import ruckig
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from planner import PiecewiseCubic, plan
from planner.corners import (
    FIRST_SHARES,
    LAST_SHARES,
    STOP,
    fly_by,
    fly_within,
    is_supported,
    passing,
    ranked,
    solve_many,
)
from planner.errors import UnsupportedSolver
from planner.segments import StraightSegment

CUT = {"velocity": 0.99, "acceleration": 0.98, "jerk": 0.98}


def corner(points, limits):
    cautious = limits.scaled(**CUT)
    return (
        StraightSegment.between(points[0], points[1], cautious),
        StraightSegment.between(points[1], points[2], cautious),
    )


@pytest.mark.parametrize("fly", [0.05, 0.1, 0.5, 1.0])
def test_a_join_begins_and_ends_exactly_in_the_states_it_joins(
    six_axis_limits, random_points, join, fly
):
    # The solver by itself is content with 1e-8 rad, which millisecond samples turn into jerk.
    for seed in range(20):
        before, after = corner(random_points(seed, 3), six_axis_limits)
        start = before.state(before.duration - fly * before.slowing_down)
        end = after.state(fly * after.speeding_up)
        joined = join(start, end, six_axis_limits, fly * (before.slowing_down + after.speeding_up))
        assert joined is not None
        ends = np.array([table[-1] for table in joined.ends()])
        starts = np.array([table[0, :3] for table in joined.coefficients])
        np.testing.assert_array_equal(starts, start)
        np.testing.assert_allclose(ends[:, 0], end[:, 0], rtol=0, atol=1e-12)
        np.testing.assert_allclose(ends[:, 1:], end[:, 1:], rtol=0, atol=1e-9)


@pytest.mark.parametrize("quantity", [1, 2])
@pytest.mark.parametrize("which", [0, 1])
def test_states_near_the_limits_never_reach_the_solver(
    six_axis_limits, join, monkeypatch, quantity, which
):
    class NoSolver:
        def __init__(self, n_joints):
            assert n_joints == 6

        def calculate(self, *_):
            raise AssertionError("the solver was asked")

    monkeypatch.setattr("planner.corners.ruckig.Ruckig", NoSolver)
    states = np.zeros((2, 6, 3))
    bound = (six_axis_limits.velocity, six_axis_limits.acceleration)[quantity - 1]
    states[which, 3, quantity] = -0.995 * bound[3]
    assert join(*states, six_axis_limits, 0.4) is None


@pytest.mark.parametrize("kind", ["RuckigError", "ValueError"])
def test_whatever_the_solver_raises_the_motion_stops_instead(
    six_axis_limits, random_points, monkeypatch, kind
):
    # A number of an error that its Python face does not know is a ValueError.
    error = ruckig.RuckigError if kind == "RuckigError" else ValueError

    class Refuses:
        def __init__(self, n_joints):
            assert n_joints == 6

        def calculate(self, *_):
            raise error("-101 is not a valid Result")

    monkeypatch.setattr("planner.corners.ruckig.Ruckig", Refuses)
    assert fly_by(*corner(random_points(4, 3), six_axis_limits), six_axis_limits, 0.5) is STOP


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
        tightened += passed.leave < 0.89 * before.slowing_down
    assert tightened > 0


def test_a_corner_that_would_take_longer_than_a_stop_is_given_up(
    six_axis_limits, random_points, monkeypatch
):
    before, after = corner(random_points(1, 3), six_axis_limits)
    asked = []

    def slow(starts, ends, times, bounds):
        asked.extend(starts)
        found = solve_many(starts, ends, times, bounds)
        return found._replace(durations=np.full(len(starts), 10.0))

    monkeypatch.setattr("planner.corners.solve_many", slow)
    assert fly_by(before, after, six_axis_limits, 0.5) is STOP
    tried = [
        before.state(before.duration - 0.5 * part * before.slowing_down)
        for part in FIRST_SHARES + LAST_SHARES
    ]
    np.testing.assert_array_equal(asked, tried)


@pytest.mark.parametrize("missed", ["too slow", "unknown"])
def test_a_join_that_the_solver_misses_is_replaced_by_one_next_to_it(
    six_axis_limits, random_points, monkeypatch, missed
):
    before, after = corner(random_points(1, 3), six_axis_limits)

    def misses_the_first(*asked):
        found = solve_many(*asked)
        # What was seen to happen: a join much longer than need be, still shorter than to stop.
        found.durations[0] *= 1.2 if missed == "too slow" else np.inf
        return found

    monkeypatch.setattr("planner.corners.solve_many", misses_the_first)
    passed = fly_by(before, after, six_axis_limits, 0.5)
    assert passed.how == "reduced"
    assert passed.share == 0.5 * 0.9999
    assert passed.join is not None


savings = st.lists(st.floats(-1.0, 1.0), min_size=1, max_size=5)


@given(savings)
def test_corners_are_ranked_by_what_they_save(savings):
    order = ranked(np.array(savings)).tolist()
    assert sorted(order) == list(range(len(savings)))
    ranks = [savings[i] for i in order]
    assert all(a + 1e-9 >= b for a, b in pairwise(ranks))


def test_the_corner_asked_for_comes_first_among_equals_and_an_unknown_one_last():
    def order(*savings):
        return ranked(np.array(savings)).tolist()

    assert order(0.5, 0.5 + 1e-12, 0.5) == [0, 1, 2]
    assert order(0.5, 0.6, 0.55) == [1, 2, 0]
    # Where the one asked for is unknown, no other takes its place.
    assert order(-np.inf, 0.5, 0.5 + 1e-12) == [2, 1, 0]


@pytest.mark.parametrize("distance", [1e-6, 1e-3, 0.05, 0.3, 10.0])
def test_a_corner_within_a_distance_uses_most_of_it_and_no_more(
    six_axis_limits, random_points, distance
):
    used = []
    for seed in range(25):
        before, after = corner(random_points(seed, 3), six_axis_limits)
        passed = fly_within(before, after, six_axis_limits, distance)
        whole = fly_by(before, after, six_axis_limits, 1.0)
        assert passed.join is not None and whole.join is not None
        q = passed.join.sample(np.linspace(0.0, passed.join.duration, 20001))[0]
        nearest = np.linalg.norm(q - after.start, axis=1).min()
        assert nearest <= distance * (1 + 1e-6)
        widest = passing(whole.join, after.start).distance
        used.append(nearest / min(distance, widest))
    assert np.median(used) >= 0.9


def test_a_distance_of_nothing_is_a_stop(six_axis_limits, random_points):
    assert fly_within(*corner(random_points(2, 3), six_axis_limits), six_axis_limits, 0.0) is STOP


def test_no_corner_is_planned_with_an_unknown_solver(six_axis_limits, random_points, monkeypatch):
    monkeypatch.setattr("planner.corners._VERSION", "0.20.1")
    monkeypatch.setattr("planner.corners._SUPPORTED", False)
    segments = corner(random_points(3, 3), six_axis_limits)
    with pytest.raises(UnsupportedSolver, match=r"0\.20\.1.*0\.19"):
        fly_by(*segments, six_axis_limits, 0.5)
    assert fly_by(*segments, six_axis_limits, 0.0) is STOP


@pytest.mark.parametrize(
    ("version", "known"),
    [("0.19.4", True), ("0.19.9", True), ("0.20.0", False), ("0.1.9", False), ("unknown", False)],
)
def test_the_series_of_a_version_is_what_counts(version, known):
    assert is_supported(version) is known


def test_nothing_is_cut_from_a_stop(six_axis_limits, random_points):
    a, b, c = random_points(6, 3)
    assert fly_by(*corner((a, b, c), six_axis_limits), six_axis_limits, 0.0) is STOP
    assert fly_by(*corner((a, b, b), six_axis_limits), six_axis_limits, 0.5) is STOP


numbers = st.floats(-3.0, 3.0)


def test_it_finds_the_foot_of_the_perpendicular():
    # Along the first joint at 2 rad/s, past a point that lies 0.5 rad beside the line.
    line = PiecewiseCubic(
        (np.array([0.0, 3.0]),) * 2, (np.array([[0, 2, 0, 0.0]]), np.zeros((1, 4)))
    )
    passed = passing(line, np.array([1.37, 0.5]))
    assert passed.time == pytest.approx(1.37 / 2.0, abs=1e-12)
    assert passed.distance == pytest.approx(0.5, abs=1e-12)


def test_a_point_on_the_path_is_met(six_axis_limits, random_points):
    whole = plan(random_points(1, 3), six_axis_limits, fly=0.5)
    # As long as a join, at rest at one end, at both, or at neither.
    for begin in (0.0, 0.3 * whole.duration, whole.duration - 0.5):
        motion = whole.restricted(begin, begin + 0.5)
        for time in np.linspace(0.01, 0.99, 37) * motion.duration:
            passed = passing(motion, motion.sample_one(time)[0])
            assert passed.distance < 1e-8
            assert motion.sample_one(passed.time)[0] == pytest.approx(
                motion.sample_one(time)[0], abs=1e-8
            )


@given(
    arrays(np.float64, (2, 3), elements=numbers),
    arrays(np.float64, (2, 4), elements=numbers),
    arrays(np.float64, 2, elements=numbers),
)
def test_no_sample_is_nearer_by_more_than_the_path_runs_between_two(start, jerks, point):
    knots = np.tile(np.linspace(0.0, 1.0, 5), (2, 1))
    motion = PiecewiseCubic.from_jerks(start, knots, jerks)
    passed = passing(motion, point)
    q = motion.sample(np.linspace(0.0, 1.0, 2001))[0]
    sampled = np.linalg.norm(q - point, axis=1).min()
    # Two dips of like depth between the looks at a path may be mistaken for one another.
    between = 0.5 / 64 * np.linalg.norm(motion.extrema().velocity)
    assert sampled - 0.0005 * between * 64 <= passed.distance <= sampled + between
    # What is said is true of the path: the point is that near at that time.
    reached = motion.sample_one(passed.time)[0]
    assert passed.distance == pytest.approx(np.linalg.norm(reached - point), abs=1e-12)


def test_a_motion_of_no_length_is_where_it_is():
    still = PiecewiseCubic((np.zeros(2),), (np.zeros((1, 4)),))
    assert passing(still, np.array([0.25])) == (0.0, 0.25)
