from __future__ import annotations

import numpy as np
import pytest
import ruckig

from planner import JointLimits
from planner.segments import StraightSegment


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
