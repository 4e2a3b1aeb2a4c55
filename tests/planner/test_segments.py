from __future__ import annotations

import numpy as np
import pytest
import ruckig
from hypothesis import given
from hypothesis import strategies as st

from planner import JointLimits, PiecewiseCubic
from planner.segments import StraightSegment, rest_to_rest


def test_the_line_stays_straight_where_the_slowest_joint_is_not_the_one_with_least_jerk():
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
    segment = StraightSegment.between(start, end, limits)
    motion = segment.pieces(0.0, segment.duration)
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

    segment = StraightSegment.between(start, end, six_axis_limits)
    assert segment.duration == pytest.approx(solution.duration)
    motion = segment.pieces(0.0, segment.duration)
    for t in np.linspace(0.0, motion.duration, 50):
        for ours, theirs in zip(motion.sample_one(t), solution.at_time(t), strict=True):
            np.testing.assert_allclose(ours, theirs, atol=1e-6)


def test_a_state_is_what_the_table_says(six_axis_limits, random_points):
    segment = StraightSegment.between(*random_points(4, 2), six_axis_limits)
    motion = segment.pieces(0.0, segment.duration)
    for t in (0.0, 0.05, 0.4, segment.duration):
        np.testing.assert_allclose(
            segment.state(t), np.stack(motion.sample_one(t), axis=1), atol=1e-12
        )


def test_no_way_to_go_takes_no_time(six_axis_limits, random_points):
    point = random_points(5, 1)[0]
    segment = StraightSegment.between(point, point, six_axis_limits)
    assert segment.duration == 0.0
    np.testing.assert_array_equal(segment.state(0.0)[:, 0], point)


def test_a_deceleration_of_its_own_bounds_the_second_ramp_only(six_axis_limits, random_points):
    start, end = random_points(6, 2)
    slowing = six_axis_limits.acceleration / np.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    segment = StraightSegment.between(start, end, six_axis_limits, slowing)
    assert segment.slowing_down > segment.speeding_up
    up = segment.pieces(0.0, segment.speeding_up).extrema().acceleration
    down = segment.pieces(segment.duration - segment.slowing_down, segment.duration).extrema()
    # On a line the ratio between the joints is fixed: one of them reaches its bound.
    assert np.max(up / six_axis_limits.acceleration) == pytest.approx(1.0)
    assert np.max(down.acceleration / slowing) == pytest.approx(1.0)
    plain = StraightSegment.between(start, end, six_axis_limits)
    assert plain.speeding_up == pytest.approx(segment.speeding_up)


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
