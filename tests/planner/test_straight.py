from __future__ import annotations

import numpy as np
import pytest
import ruckig
from hypothesis import given
from hypothesis import strategies as st

from planner import JointLimits, PiecewiseCubic
from planner.straight import StraightMoves, rest_to_rest
from tests.planner.conftest import rows_of

magnitude = st.floats(-3.0, 3.0).map(lambda exponent: 10.0**exponent)


def straight(start, end, limits, deceleration=None):
    bounds = rows_of(limits)
    slowing = bounds.acceleration if deceleration is None else deceleration[None]
    return StraightMoves.between(start[None], end[None], bounds, slowing)


def table(moves, begin=0.0, end=np.inf):
    (motion,) = moves.tables(np.array([begin]), np.minimum(moves.durations, end))
    return motion


def test_the_line_is_straight_whichever_joint_is_slowest():
    # Joint 0 has the least velocity, joint 1 the least acceleration, joint 2 the least jerk: a
    # general planner asked for phase synchronisation silently leaves the line here.
    limits = JointLimits(
        lower=-5.0 * np.ones(3),
        upper=5.0 * np.ones(3),
        velocity=[1.0, 2.0, 5.0],
        acceleration=[3.0, 1.0, 9.0],
        jerk=[50.0, 100.0, 5.0],
    )
    start, end = np.array([0.1, -0.2, 0.3]), np.array([1.1, 0.9, -1.2])
    motion = table(straight(start, end, limits))
    q, qd, _ = motion.sample(np.linspace(0.0, motion.duration, 200))
    share = (q[:, :1] - start[0]) / (end[0] - start[0])
    np.testing.assert_allclose(q, start + share * (end - start), atol=1e-12)
    assert np.max(np.abs(qd), axis=0)[0] <= 1.0
    extrema = motion.extrema()
    assert np.all(extrema.acceleration <= limits.acceleration * (1 + 1e-12))
    assert np.all(extrema.jerk <= limits.jerk * (1 + 1e-12))


def test_it_equals_ruckig_where_ruckig_keeps_the_phase(six_axis_limits, random_points):
    start, end = random_points(3, 2)
    problem = ruckig.InputParameter(6)
    problem.synchronization = ruckig.Synchronization.Phase
    problem.current_position, problem.target_position = start, end
    problem.max_velocity = six_axis_limits.velocity
    problem.max_acceleration = six_axis_limits.acceleration
    problem.max_jerk = six_axis_limits.jerk
    solution = ruckig.Trajectory(6)
    ruckig.Ruckig(6).calculate(problem, solution)
    motion = table(straight(start, end, six_axis_limits))
    assert motion.duration == pytest.approx(solution.duration)
    for t in np.linspace(0.0, motion.duration, 50):
        for ours, theirs in zip(motion.sample_one(t), solution.at_time(t), strict=True):
            np.testing.assert_allclose(ours, theirs, atol=1e-6)


def test_states_and_parts_are_those_of_the_whole(six_axis_limits, random_points):
    moves = straight(*random_points(4, 2), six_axis_limits)
    motion, duration = table(moves), float(moves.durations[0])
    for t in (0.0, 0.05, 0.4, duration):
        state = np.stack(motion.sample_one(t), axis=1)
        np.testing.assert_allclose(moves.states(np.array([t]))[0], state, atol=1e-12)
    part = table(moves, 0.1, 0.7 * duration)
    assert part.duration == pytest.approx(0.7 * duration - 0.1)
    times = np.linspace(0.0, part.duration, 23)[1:-1]
    for ours, whole in zip(part.sample(times), motion.sample(times + 0.1), strict=True):
        np.testing.assert_allclose(ours, whole, atol=1e-12)


def test_a_deceleration_of_its_own_bounds_the_second_ramp(six_axis_limits, random_points):
    start, end = random_points(6, 2)
    slowing = six_axis_limits.acceleration / np.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    moves = straight(start, end, six_axis_limits, slowing)
    assert moves.slowing_down > moves.speeding_up
    up = table(moves, 0.0, moves.speeding_up[0]).extrema().acceleration
    down = table(moves, moves.durations[0] - moves.slowing_down[0]).extrema().acceleration
    # On a line the ratio between the joints is fixed: one of them reaches its bound.
    assert np.max(up / six_axis_limits.acceleration) == pytest.approx(1.0)
    assert np.max(down / slowing) == pytest.approx(1.0)
    alike = straight(start, end, six_axis_limits)
    assert alike.speeding_up == pytest.approx(moves.speeding_up)


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
