from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from planner import PiecewiseCubic, plan
from planner.corners import passing

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
