"""Straight moves from rest to rest, and the corners that join them."""

from __future__ import annotations

import numpy as np
import pytest
import ruckig
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from planner import JointLimits, PiecewiseCubic
from planner.corners import FIRST_SHARES, LAST_SHARES, STOP, passing, solve_many
from planner.errors import UnsupportedSolver
from planner.interpolator import corner
from planner.piecewise_cubic import Block
from planner.straight import StraightMoves, rest_to_rest
from tests.planner.six_axes import SIX_AXES, join, legs_between, random_points, rows_of

magnitude = st.floats(-3.0, 3.0).map(lambda exponent: 10.0**exponent)


def straight(start, end, limits, deceleration=None):
    bounds = rows_of(limits)
    slowing = bounds.acceleration if deceleration is None else deceleration[None]
    return StraightMoves.between(start[None], end[None], bounds, slowing)


def straight_table(moves, begin=0.0, end=np.inf):
    (motion,) = moves.tables(np.array([begin]), np.minimum(moves.durations, end))
    return motion


def test_the_line_is_straight_for_any_slowest_joint():
    # Joint 0 has the least velocity, joint 1 the least acceleration, joint 2 the least jerk: here
    # ruckig's phase synchronisation leaves the line without an error.
    limits = JointLimits(
        lower=-5.0 * np.ones(3),
        upper=5.0 * np.ones(3),
        velocity=[1.0, 2.0, 5.0],
        acceleration=[3.0, 1.0, 9.0],
        jerk=[50.0, 100.0, 5.0],
    )
    start, end = np.array([0.1, -0.2, 0.3]), np.array([1.1, 0.9, -1.2])
    motion = straight_table(straight(start, end, limits))
    q, qd, _ = motion.sample(np.linspace(0.0, motion.duration, 200))
    share = (q[:, :1] - start[0]) / (end[0] - start[0])
    np.testing.assert_allclose(q, start + share * (end - start), atol=1e-12)
    assert np.max(np.abs(qd), axis=0)[0] <= 1.0
    extrema = motion.extrema()
    assert np.all(extrema.acceleration <= limits.acceleration * (1 + 1e-12))
    assert np.all(extrema.jerk <= limits.jerk * (1 + 1e-12))


def scalar(distance, velocity, acceleration, deceleration, jerk):
    """The move of one joint: path as a function of time, and the lengths of its ramps."""
    rates = (np.array([value]) for value in (distance, velocity, acceleration, deceleration, jerk))
    knots, pieces, up, down = rest_to_rest(*rates)
    return PiecewiseCubic((knots[0],), (pieces[0],)), float(up[0]), float(down[0])


@st.composite
def problems(draw):
    distance, velocity, acceleration, jerk = (draw(magnitude) for _ in range(4))
    return distance, velocity, acceleration, draw(st.just(acceleration) | magnitude), jerk


class TestRestToRest:
    @given(problems())
    def test_it_arrives_at_rest_within_the_limits(self, problem):
        distance, velocity, acceleration, deceleration, jerk = problem
        law, up, down = scalar(*problem)
        assert np.all(np.diff(law.knots[0]) >= 0.0)
        assert up == pytest.approx(law.knots[0][3])
        assert down == pytest.approx(law.duration - law.knots[0][4], abs=1e-9 * law.duration)
        within = 1 + 1e-9
        tick = 4 * jerk * np.spacing(law.duration)  # a knot is no finer than the clock
        first, last = law.coefficients[0][:4], law.coefficients[0][4:]
        assert np.max(first[:, 2]) <= acceleration * within + tick
        assert np.max(-last[:, 2]) <= deceleration * within + tick
        extrema = law.extrema()
        assert extrema.velocity[0] <= velocity * within
        assert extrema.jerk[0] == jerk
        assert extrema.lower[0] >= -1e-12 * distance
        # The pieces meet: the distance is covered exactly, at rest.
        ends = law.ends()[0]
        scale = [distance, velocity, max(acceleration, deceleration)]
        gap = np.abs(law.coefficients[0][1:, :3] - ends[:-1])
        assert np.all(gap <= 1e-12 * np.array(scale) + [0.0, law.duration * tick, tick])
        assert ends[-1, 0] == pytest.approx(distance, rel=1e-12)

    @given(problems())
    def test_it_is_as_fast_as_an_independent_planner(self, problem):
        distance, velocity, acceleration, deceleration, jerk = problem
        asked = ruckig.InputParameter(1)
        asked.target_position = [distance]
        asked.max_velocity, asked.max_acceleration = [velocity], [acceleration]
        asked.min_acceleration = [-deceleration]
        asked.max_jerk = [jerk]
        solution = ruckig.Trajectory(1)
        ruckig.Ruckig(1).calculate(asked, solution)
        assert scalar(*problem)[0].duration == pytest.approx(solution.duration, rel=1e-6)


def flown(points, limits, share=0.5):
    """The corner at the middle one of three points."""
    return corner(legs_between(points, limits), share)


def cut(points, limits, share):
    """The states that a corner joins, and the time that it replaces."""
    moves = legs_between(points, limits).moves
    leave, enter = share * moves.slowing_down[0], share * moves.speeding_up[1]
    start, end = moves.states(np.array([moves.durations[0] - leave, enter]))
    return start, end, leave + enter


@pytest.mark.parametrize("fly", [0.05, 0.1, 0.5, 1.0])
def test_a_join_begins_and_ends_exactly_in_its_states(fly):
    # The solver is exact to 1e-8 rad, which millisecond samples turn into jerk.
    for seed in range(20):
        start, end, time = cut(random_points(seed, 3), SIX_AXES, fly)
        joined = join(start, end, SIX_AXES, time)
        assert joined is not None
        ends = np.array([table[-1] for table in joined.ends()])
        starts = np.array([table[0, :3] for table in joined.coefficients])
        np.testing.assert_array_equal(starts, start)
        np.testing.assert_allclose(ends[:, 0], end[:, 0], rtol=0, atol=1e-12)
        np.testing.assert_allclose(ends[:, 1:], end[:, 1:], rtol=0, atol=1e-9)


class Solver:
    """A solver that raises an error."""

    error: Exception = AssertionError("the solver was called")

    def __init__(self, n_joints):
        assert n_joints == 6

    def calculate(self, *_):
        raise self.error


@pytest.mark.parametrize("quantity", [1, 2])
@pytest.mark.parametrize("which", [0, 1])
def test_states_near_the_limits_never_reach_the_solver(monkeypatch, quantity, which):
    monkeypatch.setattr("planner.corners.ruckig.Ruckig", Solver)
    states = np.zeros((2, 6, 3))
    bound = (SIX_AXES.velocity, SIX_AXES.acceleration)[quantity - 1]
    states[which, 3, quantity] = -0.995 * bound[3]
    assert join(*states, SIX_AXES, 0.4) is None


@pytest.mark.parametrize("error", [ruckig.RuckigError, ValueError])
def test_the_motion_stops_if_the_solver_raises(monkeypatch, error):
    # An error number unknown to its Python interface is a ValueError.
    monkeypatch.setattr(Solver, "error", error("-101 is not a valid Result"))
    monkeypatch.setattr("planner.corners.ruckig.Ruckig", Solver)
    assert flown(random_points(4, 3), SIX_AXES) is STOP


def test_a_corner_slower_than_a_stop_is_not_used(monkeypatch):
    points, asked = random_points(1, 3), []

    def slow(starts, *rest):
        asked.extend(starts)
        found = solve_many(starts, *rest)
        return found._replace(durations=np.full(len(starts), 10.0))

    monkeypatch.setattr("planner.corners.solve_many", slow)
    assert flown(points, SIX_AXES) is STOP
    parts = FIRST_SHARES + LAST_SHARES
    tried = [cut(points, SIX_AXES, 0.5 * part)[0] for part in parts]
    np.testing.assert_array_equal(asked, tried)


@pytest.mark.parametrize("missed", [1.2, np.inf], ids=["too slow", "unknown"])
def test_a_join_that_the_solver_misses_is_replaced_by_its_neighbour(monkeypatch, missed):
    def misses_the_first(*asked):
        found = solve_many(*asked)
        # Observed: a join much longer than necessary, still shorter than a stop.
        found.durations[0] *= missed
        return found

    monkeypatch.setattr("planner.corners.solve_many", misses_the_first)
    passed = flown(random_points(1, 3), SIX_AXES)
    assert (passed.how, passed.share) == ("reduced", 0.5 * 0.9999)
    assert passed.join is not None


@pytest.mark.parametrize("version", ["0.20.1", "0.1.9", "unknown", "0.19.9"])
def test_no_corner_is_planned_with_an_unknown_solver(monkeypatch, version):
    monkeypatch.setattr("planner.corners._VERSION", version)
    points = random_points(3, 3)
    assert flown(points, SIX_AXES, 0.0) is STOP
    if version == "0.19.9":
        assert flown(points, SIX_AXES).how == "flown"
    else:
        with pytest.raises(UnsupportedSolver, match=rf"{version}.*0\.19"):
            flown(points, SIX_AXES)


numbers = st.floats(-3.0, 3.0)


class TestPassing:
    """Where a motion is nearest to a point."""

    def test_it_finds_the_foot_of_the_perpendicular(self):
        # Along the first joint at 2 rad/s, past a point that lies 0.5 rad beside the line.
        line = PiecewiseCubic(
            (np.array([0.0, 3.0]),) * 2, (np.array([[0, 2, 0, 0.0]]), np.zeros((1, 4)))
        )
        passed = passing(line, np.array([1.37, 0.5]))
        assert passed.time == pytest.approx(1.37 / 2.0, abs=1e-12)
        assert passed.distance == pytest.approx(0.5, abs=1e-12)

    @given(
        arrays(np.float64, (2, 3), elements=numbers),
        arrays(np.float64, (2, 4), elements=numbers),
        arrays(np.float64, 2, elements=numbers),
    )
    def test_no_sample_is_nearer(self, start, jerks, point):
        knots = np.tile(np.linspace(0.0, 1.0, 5), (1, 2, 1))
        (motion,) = Block.from_jerks(start[None], knots, jerks[None]).tables()
        passed = passing(motion, point)
        q = motion.sample(np.linspace(0.0, 1.0, 2001))[0]
        sampled = np.linalg.norm(q - point, axis=1).min()
        # Two dips of like depth between the looks at a path may be mistaken for one another.
        between = 0.5 / 64 * np.linalg.norm(motion.extrema().velocity)
        assert sampled - 0.0005 * between * 64 <= passed.distance <= sampled + between
        # The path has this distance at this time.
        reached = motion.sample_one(passed.time)[0]
        assert passed.distance == pytest.approx(np.linalg.norm(reached - point), abs=1e-12)
