from __future__ import annotations

import numpy as np
import pytest
import ruckig
from hypothesis import given
from hypothesis import strategies as st

from planner import PiecewiseCubic
from planner.segments import rest_to_rest

magnitude = st.floats(-3.0, 3.0).map(lambda exponent: 10.0**exponent)


@given(magnitude, magnitude, magnitude, magnitude)
def test_rest_to_rest_arrives_at_rest_within_the_limits(distance, velocity, acceleration, jerk):
    law, up, down = rest_to_rest(distance, velocity, acceleration, jerk)
    extrema = law.extrema()
    within = 1 + 1e-9
    tick = 4 * jerk * np.spacing(law.duration)  # a knot is no finer than the clock it is told in
    assert extrema.velocity[0] <= velocity * within
    assert extrema.acceleration[0] <= acceleration * within + tick
    assert extrema.jerk[0] == jerk
    assert extrema.lower[0] >= -1e-12 * distance
    end = law.ends()[0][-1]
    assert end[0] == pytest.approx(distance, rel=1e-13)
    assert abs(end[1]) <= 1e-12 * velocity + law.duration * tick
    assert abs(end[2]) <= 1e-12 * acceleration + tick
    assert up == down == pytest.approx(law.knots[0][3])
    assert np.all(np.diff(law.knots[0]) >= 0.0)


@given(magnitude, magnitude, magnitude, magnitude)
def test_its_pieces_are_what_integrating_their_jerks_gives(distance, velocity, acceleration, jerk):
    law, _, _ = rest_to_rest(distance, velocity, acceleration, jerk)
    integrated = PiecewiseCubic.from_jerks(
        np.zeros((1, 3)), law.knots[0][None], law.coefficients[0][None, :, 3]
    )
    # A knot is no finer than the clock it is told in, and a blind integration carries the trace
    # of acceleration that this leaves along a long cruise.
    tick = 4 * jerk * np.spacing(law.duration)
    drift = tick * np.array([law.duration**2, law.duration, 1.0, 0.0])
    gap = np.abs(law.coefficients[0] - integrated.coefficients[0])
    assert np.all(gap <= 1e-12 * np.array([distance, velocity, acceleration, jerk]) + drift)


@given(magnitude, magnitude, magnitude, magnitude)
def test_rest_to_rest_is_as_fast_as_an_independent_time_optimal_planner(
    distance, velocity, acceleration, jerk
):
    problem = ruckig.InputParameter(1)
    problem.target_position = [distance]
    problem.max_velocity, problem.max_acceleration = [velocity], [acceleration]
    problem.max_jerk = [jerk]
    solution = ruckig.Trajectory(1)
    ruckig.Ruckig(1).calculate(problem, solution)
    law, _, _ = rest_to_rest(distance, velocity, acceleration, jerk)
    assert law.duration == pytest.approx(solution.duration, rel=1e-6)


@given(magnitude, magnitude, magnitude, magnitude, magnitude)
def test_unlike_ramps_keep_each_its_limit_and_arrive_at_rest(
    distance, velocity, acceleration, deceleration, jerk
):
    law, up, down = rest_to_rest(distance, velocity, acceleration, jerk, deceleration)
    assert np.all(np.diff(law.knots[0]) >= 0.0)
    assert up == pytest.approx(law.knots[0][3])
    assert down == pytest.approx(law.duration - law.knots[0][4], abs=1e-9 * law.duration)
    within = 1 + 1e-9
    tick = 4 * jerk * np.spacing(law.duration)
    first, last = law.coefficients[0][:4], law.coefficients[0][4:]
    assert np.max(first[:, 2]) <= acceleration * within + tick
    assert np.max(-last[:, 2]) <= deceleration * within + tick
    assert law.extrema().velocity[0] <= velocity * within
    # The pieces meet: the distance is covered exactly, at rest.
    ends = law.ends()[0]
    scale = [distance, velocity, max(acceleration, deceleration)]
    gap = np.abs(law.coefficients[0][1:, :3] - ends[:-1])
    clock = np.array([0.0, law.duration * tick, tick])
    assert np.all(gap <= 1e-12 * np.array(scale) + clock)
    assert ends[-1, 0] == pytest.approx(distance, rel=1e-12)


@given(magnitude, magnitude, magnitude, magnitude, magnitude)
def test_unlike_ramps_are_as_fast_as_an_independent_time_optimal_planner(
    distance, velocity, acceleration, deceleration, jerk
):
    problem = ruckig.InputParameter(1)
    problem.target_position = [distance]
    problem.max_velocity, problem.max_acceleration = [velocity], [acceleration]
    problem.min_acceleration = [-deceleration]
    problem.max_jerk = [jerk]
    solution = ruckig.Trajectory(1)
    ruckig.Ruckig(1).calculate(problem, solution)
    law, _, _ = rest_to_rest(distance, velocity, acceleration, jerk, deceleration)
    assert law.duration == pytest.approx(solution.duration, rel=1e-6)


@given(magnitude, magnitude, magnitude, magnitude, magnitude, st.floats(1.0, 2.0))
def test_more_of_any_limit_never_takes_longer(
    distance, velocity, acceleration, deceleration, jerk, more
):
    limits = {"velocity": velocity, "acceleration": acceleration, "deceleration": deceleration}
    time = rest_to_rest(distance, jerk=jerk, **limits).law.duration
    for name in limits:
        widened = {**limits, name: more * limits[name]}
        assert rest_to_rest(distance, jerk=jerk, **widened).law.duration <= time * (1 + 1e-14)
