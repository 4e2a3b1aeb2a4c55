from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.interpolate import BPoly

from planner import InvalidTrajectory, plan
from planner.sampled import SampledTrajectory

numbers = st.floats(-10.0, 10.0)


@st.composite
def tables(draw):
    """Any table of a motion: 1-3 joints, rows close and far apart."""
    n, m = draw(st.integers(1, 3)), draw(st.integers(2, 6))
    steps = draw(st.lists(st.sampled_from([0.01, 0.1, 1.0]), min_size=m - 1, max_size=m - 1))
    rows = [draw(arrays(np.float64, (m, n), elements=numbers)) for _ in range(3)]
    return SampledTrajectory(np.concatenate(([0.0], np.cumsum(steps))), *rows)


@given(tables())
def test_every_row_is_passed_to_the_last_digit(table):
    for rows, name in zip(
        table.sample(table.time), ("position", "velocity", "acceleration"), strict=True
    ):
        np.testing.assert_array_equal(rows, getattr(table, name))


@given(tables(), arrays(np.float64, 20, elements=st.floats(0.0, 1.0)))
def test_between_rows_it_is_the_quintic_that_another_library_finds(table, shares):
    t = shares * table.duration
    # Near the end of a piece a power series in x loses what h powers of it cancel.
    scale = 1e-11 * np.array([1.0, 1e2, 1e4])
    for joint in range(table.n_joints):
        states = np.stack(
            (table.position[:, joint], table.velocity[:, joint], table.acceleration[:, joint]), 1
        )
        other = BPoly.from_derivatives(table.time, states)
        for order, ours in enumerate(table.sample(t)):
            theirs = other.derivative(order)(t) if order else other(t)
            size = np.max(np.abs(theirs)) + 100.0
            np.testing.assert_allclose(ours[:, joint], theirs, rtol=0, atol=scale[order] * size)


@given(tables())
@settings(deadline=None)
def test_extrema_bound_every_sample(table):
    extrema = table.extrema()
    t = np.linspace(0.0, table.duration, 3001)
    q, qd, qdd = table.sample(t)
    for bound, sampled in (
        (extrema.upper, q.max(axis=0)),
        (-extrema.lower, (-q).max(axis=0)),
        (extrema.velocity, np.abs(qd).max(axis=0)),
        (extrema.acceleration, np.abs(qdd).max(axis=0)),
    ):
        assert np.all(bound >= sampled - 1e-9 * (1.0 + np.abs(sampled)))
    h = table.duration * 1e-5
    inside = np.all(np.abs(t[1:-1, None] - table.time) > 2 * h, axis=1)
    t = t[1:-1][inside]
    jerk = (table.sample(t + h)[2] - table.sample(t - h)[2]) / (2 * h)
    snap = 1e-6 * (1.0 + extrema.jerk)
    assert np.all(np.abs(jerk) <= extrema.jerk + snap)


@given(tables())
def test_outside_its_time_the_ends_are_held_at_rest(table):
    q, qd, qdd = table.sample(np.array([-1.0, table.duration + 1e-6]))
    np.testing.assert_array_equal(q, table.position[[0, -1]])
    assert not np.any(qd) and not np.any(qdd)


def test_what_is_lost_by_sampling_falls_with_powers_of_the_period(six_axis_limits, random_points):
    motion = plan(random_points(5), six_axis_limits)
    t = np.linspace(0.0, motion.duration, 50_001)
    exact, lost = motion.sample(t), []
    for period in (0.008, 0.004, 0.002):
        time = np.append(np.arange(0.0, motion.duration, period), motion.duration)
        table = SampledTrajectory(time, *motion.sample(time))
        lost.append([np.max(np.abs(a - b)) for a, b in zip(table.sample(t), exact, strict=True)])
    ratio = np.array(lost[0]) / np.array(lost[2])
    assert ratio[0] > 4**2 and ratio[1] > 4**1.5 and ratio[2] > 4**0.5


def test_a_switch_of_jerk_between_two_rows_swings_to_two_and_a_half_times_the_limit():
    largest = 0.0
    for before in np.linspace(0.0, 1.0, 501):  # jerk is -1 so long, then 1
        after = 1.0 - before
        a, v, q = -before, -(before**2) / 2.0, -(before**3) / 6.0
        end = (q + after * (v + after * (a / 2.0 + after / 6.0)), v + after * (a + after / 2.0))
        table = SampledTrajectory(
            [0.0, 1.0], [[0.0], [end[0]]], [[0.0], [end[1]]], [[0.0], [a + after]]
        )
        largest = max(largest, float(table.extrema().jerk[0]))
    assert largest == pytest.approx(2.53, abs=0.005)


@pytest.mark.parametrize(
    ("name", "rows"),
    [
        ("time", [0.0]),
        ("time", [0.1, 1.0]),
        ("time", [0.0, 0.0]),
        ("time", [0.0, np.nan]),
        ("position", [[0.0], [np.inf]]),
        ("velocity", [[0.0]]),
        ("acceleration", [[0.0, 1.0], [0.0, 1.0]]),
    ],
)
def test_refuses_rows_that_make_no_motion(name, rows):
    good = {
        "time": [0.0, 1.0],
        "position": [[0.0], [1.0]],
        "velocity": [[0.0], [0.0]],
        "acceleration": [[0.0], [0.0]],
    }
    SampledTrajectory(**good)
    with pytest.raises(InvalidTrajectory):
        SampledTrajectory(**{**good, name: rows})
