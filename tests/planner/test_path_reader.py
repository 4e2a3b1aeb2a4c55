from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from planner import FourierSeries, plan
from planner.player import PathReader


@pytest.fixture(scope="module")
def motions(six_axis_limits, random_points):
    return [plan(random_points(seed, 4), six_axis_limits) for seed in range(6)]


@given(which=st.integers(0, 5), share=st.floats(0.0, 1.0))
def test_it_reads_what_the_table_holds(motions, which, share):
    motion = motions[which]
    s = share * motion.duration
    position, velocity = PathReader(motion).read(s)
    q, qd, _ = motion.sample_one(s)
    np.testing.assert_allclose(position, q, rtol=0, atol=1e-13)
    np.testing.assert_allclose(velocity, qd, rtol=0, atol=1e-12)


def test_it_reads_at_every_knot_of_every_joint(motions):
    motion = motions[0]
    reader = PathReader(motion)
    for s in np.concatenate(motion.knots):
        for near in (np.nextafter(s, 0.0), s, min(np.nextafter(s, np.inf), motion.duration)):
            q, qd, _ = motion.sample_one(float(near))
            position, velocity = reader.read(float(near))
            np.testing.assert_allclose(position, q, rtol=0, atol=1e-13)
            np.testing.assert_allclose(velocity, qd, rtol=0, atol=1e-12)


@given(
    seed=st.integers(0, 99),
    share=st.floats(0.0, 1.0),
    ramp=st.sampled_from([0.0, 1e-3, 1.5, 4.0]),
)
def test_it_reads_what_a_sum_of_sines_says(seed, share, ramp):
    random = np.random.default_rng(seed)
    series = FourierSeries(
        offset=random.uniform(-1.0, 1.0, 6),
        amplitude=random.uniform(-1.0, 1.0, (6, 3)),
        frequency=random.uniform(0.3, 4.0, (6, 3)),
        length=8.0,
        ramp=ramp,
    )
    s = share * series.duration
    position, velocity = PathReader(series).read(s)
    q, qd, _ = series.sample_one(s)
    np.testing.assert_allclose(position, q, rtol=0, atol=1e-13)
    # A slope of rounding in u is one of rounding / ramp in time.
    np.testing.assert_allclose(velocity, qd, rtol=0, atol=1e-12 / min(ramp or 1.0, 1.0))


def test_a_trajectory_of_another_kind_is_asked_itself():
    class Line:
        duration = 2.0
        n_joints = 2

        def sample(self, t):
            slope = np.array([1.0, -2.0])
            return np.outer(t, slope), np.tile(slope, (len(t), 1)), np.zeros((len(t), 2))

    position, velocity = PathReader(Line()).read(0.5)
    np.testing.assert_array_equal(position, [0.5, -1.0])
    np.testing.assert_array_equal(velocity, [1.0, -2.0])
