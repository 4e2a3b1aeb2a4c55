from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from planner import InvalidSetting, InvalidTrajectory, LimitExceeded, TrajectoryPlayer, check_limits
from planner.fourier import FourierSeries, harmonic_bounds
from tests.planner.six_axes import SIX_AXES


@st.composite
def series(draw, ramped=None):
    """Series of 1-3 joints and 1-4 sines, some equal, some constant, ramps of all lengths."""
    n, w = draw(st.integers(1, 3)), draw(st.integers(1, 4))
    amplitude = draw(arrays(np.float64, (n, w), elements=st.floats(-2.0, 2.0)))
    frequency = draw(
        arrays(np.float64, (n, w), elements=st.sampled_from([0.0, 0.3, 1.0, -2.0, 7.0]))
    )
    length = draw(st.sampled_from([0.5, 3.0, 20.0]))
    shares = [0.02, 0.25, 0.5] if ramped else [0.0] if ramped is False else [0.0, 0.1, 0.5]
    ramp = draw(st.sampled_from(shares)) * length
    offset = draw(arrays(np.float64, n, elements=st.floats(-3.0, 3.0)))
    return FourierSeries(offset, amplitude, frequency, length, ramp)


def ratios(motion: FourierSeries, limits) -> np.ndarray:
    """Largest velocity, acceleration and jerk, as shares of the limits."""
    extrema = motion.extrema()
    return np.array(
        [
            np.max(getattr(extrema, name) / getattr(limits, name))
            for name in ("velocity", "acceleration", "jerk")
        ]
    )


def room(motion: FourierSeries, order: int) -> np.ndarray:
    """Tolerance of bounds: 3e-4 of the sum of all sines and ramps."""
    rate = 7.0 + (4.0 / motion.ramp if motion.ramp else 0.0)
    return 3e-4 * np.abs(motion.amplitude).sum(axis=1) * rate**order


def jerk(motion: FourierSeries, t: np.ndarray, h: float) -> np.ndarray:
    return (motion.sample(t + h)[2] - motion.sample(t - h)[2]) / (2 * h)


def test_it_is_equation_8_without_and_between_ramps():
    offset, amplitude = np.array([0.5, -1.0]), np.array([[0.3, 0.1, -0.2], [0.4, 0.0, 0.7]])
    frequency = np.array([[0.4, 1.0, 2.0], [0.3, 0.9, 1.7]])
    t = np.linspace(0.0, 10.0, 301)
    expected = np.stack(
        [
            offset[j]
            + sum(a * np.sin(w * t) for a, w in zip(amplitude[j], frequency[j], strict=True))
            for j in range(2)
        ],
        axis=1,
    )
    bare = FourierSeries(offset, amplitude, frequency, 10.0)
    np.testing.assert_allclose(bare.sample(t)[0], expected, atol=1e-14)
    ramped = FourierSeries(offset, amplitude, frequency, 10.0, ramp=2.0)
    between = (t >= 2.0) & (t <= 8.0)
    for ours, theirs in zip(ramped.sample(t[between]), bare.sample(t[between]), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-14)


@given(series())
@settings(max_examples=40, deadline=None)
def test_velocity_and_acceleration_are_the_derivatives_of_position(motion):
    h = 1e-5 * motion.duration
    t = np.linspace(0.0, motion.duration, 203)[1:-1]
    before, here, after = (motion.sample(x) for x in (t - h, t, t + h))
    extrema = motion.extrema()
    assert np.all(np.abs((after[0] - before[0]) / (2 * h) - here[1]) <= h * h * extrema.jerk + 1e-8)
    assert np.all(np.abs((after[1] - before[1]) / (2 * h) - here[2]) <= h * extrema.jerk + 1e-8)


@given(series(ramped=True))
def test_a_ramped_series_starts_and_ends_at_rest(motion):
    q, qd, qdd = motion.sample(np.array([-1.0, 0.0, motion.duration, motion.duration + 1.0]))
    np.testing.assert_array_equal(q, np.broadcast_to(motion.offset, q.shape))
    assert not np.any(qd) and not np.any(qdd)


@given(series())
@settings(max_examples=30, deadline=None)
def test_extrema_bound_every_sample_and_are_reached(motion):
    extrema = motion.extrema()
    t = np.linspace(0.0, motion.duration, 20001)
    step = t[1]
    q, qd, qdd = motion.sample(t)
    for order, bound, sampled, slope in (
        (0, extrema.upper, q.max(axis=0), extrema.velocity),
        (0, -extrema.lower, (-q).max(axis=0), extrema.velocity),
        (1, extrema.velocity, np.abs(qd).max(axis=0), extrema.acceleration),
        (2, extrema.acceleration, np.abs(qdd).max(axis=0), extrema.jerk),
    ):
        assert np.all(bound >= sampled - 1e-13)
        # The truth lies half a step from a sample at most.
        assert np.all(bound <= sampled + 0.5 * step * slope + room(motion, order) + 1e-12)


@given(series())
@settings(max_examples=30, deadline=None)
def test_the_bound_of_jerk_holds_and_is_reached(motion):
    t = np.linspace(0.0, motion.duration, 20001)
    edges = np.array([motion.ramp, motion.duration - motion.ramp])
    h = 1e-6 * motion.duration
    # At the ends of a ramp jerk jumps; both sides are sampled, not the middle.
    ends = np.array([0.0, *edges, motion.duration])
    t = np.concatenate((t, ends - 2 * h, ends + 2 * h))
    t = t[(t > h) & (t < motion.duration - h)]
    t = t[np.all(np.abs(t[:, None] - edges) > 1.5 * h, axis=1)]
    bound, seen = motion.extrema().jerk, np.abs(jerk(motion, t, h)).max(axis=0)
    noise = 1e-15 * (1.0 + motion.extrema().acceleration) / h * 10
    assert np.all(bound >= seen - noise)
    # The ends are missed by 2 h; where a ramp of a tenth begins, jerk changes by 6 / ramp a second.
    assert np.all(bound <= (1 + 4 * 12e-5) * seen + noise + room(motion, 3))


def test_the_jump_of_jerk_at_the_end_of_a_ramp_is_included():
    # Sine at its top there: w''' = 60 / ramp³ meets S = 1; elsewhere jerk stays far below.
    ramp = 0.1
    motion = FourierSeries(np.zeros(1), np.ones((1, 1)), np.array([[np.pi / 2 / ramp]]), 4.0, ramp)
    # Leibniz at u = 1-: w''' S + 3 w'' S' + 3 w' S'' + S''' with w' = w'' = 0, S' = S''' = 0
    at_the_jump = 60.0 / ramp**3
    sampled = np.abs(jerk(motion, np.linspace(0.001, ramp - 0.001, 5001), 1e-6)).max()
    assert motion.extrema().jerk[0] >= max(at_the_jump, sampled)


@given(series())
@settings(max_examples=30, deadline=None)
def test_the_coarse_bound_of_a_derivative_contains_the_extremes(motion):
    extrema = motion.extrema()
    for order, reached in ((1, extrema.velocity), (2, extrema.acceleration), (3, extrema.jerk)):
        assert np.all(motion.derivative_bound(order) >= reached - 1e-14)
    # and the fourth bounds how the acceleration curves, ends of ramps apart
    t = np.linspace(0.0, motion.duration, 2001)
    h = 1e-4 * motion.duration
    inside = np.all(
        np.abs(t[:, None] - [0.0, motion.ramp, motion.duration - motion.ramp, motion.duration])
        > 2.5 * h,
        axis=1,
    )
    q2 = [motion.sample(t[inside] + k * h)[2] for k in (-1, 0, 1)]
    second = np.abs(q2[0] - 2.0 * q2[1] + q2[2]).max(axis=0, initial=0.0) / h**2
    noise = 1e-14 * (1.0 + extrema.acceleration) / h**2
    assert np.all(motion.derivative_bound(4) >= second - noise)


@given(series())
def test_storing_and_restoring_changes_no_bit(motion):
    restored = FourierSeries.from_dict(json.loads(json.dumps(motion.to_dict())))
    for name in ("offset", "amplitude", "frequency"):
        assert getattr(restored, name).tobytes() == getattr(motion, name).tobytes()
    assert (restored.length, restored.ramp) == (motion.length, motion.ramp)


@pytest.mark.parametrize(
    "damage",
    [
        {"offset": [0.0, 0.0]},
        {"offset": 0.0},
        {"amplitude": [[1.0, 2.0]]},
        {"amplitude": [[float("nan")]]},
        {"frequency": None},
        {"length": 0.0},
        {"length": "long"},
        {"ramp": 0.6},
        {"ramp": -0.1},
        {"ramp": float("inf")},
    ],
)
def test_invalid_stored_data_are_refused(damage):
    good = {
        "type": "fourier_series",
        "offset": [0.0],
        "amplitude": [[1.0]],
        "frequency": [[1.0]],
        "length": 1.0,
        "ramp": 0.5,
    }
    FourierSeries.from_dict(good)
    with pytest.raises(InvalidTrajectory):
        FourierSeries.from_dict({**good, **damage})


@given(st.integers(0, 10**6), st.integers(1, 5))
@settings(max_examples=25)
def test_the_papers_bounds_limit_position_and_acceleration(seed, harmonics):
    random = np.random.default_rng(seed)
    limits = SIX_AXES
    offset = limits.lower + random.uniform(0.05, 0.95, 6) * (limits.upper - limits.lower)
    bounds = harmonic_bounds(limits, offset, harmonics)
    shares = random.uniform(-1.0, 1.0, (2, 6, harmonics))
    amplitude, frequency = shares * np.array(bounds)[:, :, None]
    extrema = FourierSeries(offset, amplitude, frequency, 10.0).extrema()
    assert np.all(extrema.upper <= limits.upper) and np.all(extrema.lower >= limits.lower)
    assert np.all(extrema.acceleration <= limits.acceleration)


def test_the_papers_bounds_need_an_offset_inside_the_limits():
    for offset in (SIX_AXES.upper, SIX_AXES.lower - 1.0, [0.0], [np.nan] * 6):
        with pytest.raises(InvalidSetting):
            harmonic_bounds(SIX_AXES, offset, 3)
    with pytest.raises(InvalidSetting):
        harmonic_bounds(SIX_AXES, np.zeros(6), 0)


def executable(limits, seed: int) -> FourierSeries:
    """A ramped series that reaches the tightest of the limits' rates exactly, but for 1e-9."""
    random = np.random.default_rng(seed)
    offset = (limits.lower + limits.upper) / 2.0
    bounds = harmonic_bounds(limits, offset, 3)
    amplitude = bounds.amplitude[:, None] * random.uniform(-1.0, 1.0, (6, 3))
    frequency = bounds.frequency[:, None] * random.uniform(0.1, 1.0, (6, 3))
    motion = FourierSeries(offset, amplitude, frequency, 20.0, ramp=3.0)
    # Run slower by s: velocity falls with s, acceleration with s², jerk with s³.
    slower = (1 + 1e-9) * float(np.max(ratios(motion, limits) ** (1.0, 1 / 2, 1 / 3)))
    return FourierSeries(offset, amplitude, frequency / slower, 20.0 * slower, 3.0 * slower)


@pytest.mark.parametrize("seed", range(4))
def test_limits_are_checked(seed):
    motion = executable(SIX_AXES, seed)
    check_limits(motion, SIX_AXES)
    worst = int(np.argmax(ratios(motion, SIX_AXES)))
    name = ("velocity", "acceleration", "jerk")[worst]
    with pytest.raises(LimitExceeded, match=name):
        check_limits(motion, SIX_AXES.scaled(**{name: 1.0 - 1e-8}))


@pytest.mark.parametrize("seed", range(4))
def test_set_points_of_a_player_satisfy_the_limits(seed):
    motion, period = executable(SIX_AXES, seed), 0.002
    player = TrajectoryPlayer(motion, period, SIX_AXES)
    player.begin(player.start)
    rows = [player.start] * 3
    while not player.finished:
        rows.append(player.advance()[0])
    rows += [rows[-1]] * 3
    for order, name in ((1, "velocity"), (2, "acceleration"), (3, "jerk")):
        rate = np.abs(np.diff(rows, order, axis=0)) / period**order
        assert np.all(rate <= getattr(SIX_AXES, name) * (1 + 1e-5)), name
    np.testing.assert_allclose(rows[-1], motion.offset, atol=1e-15)


def test_sines_too_fast_to_be_bounded_are_refused_unless_zero():
    amplitude = np.zeros((6, 2))
    amplitude[:, 0] = 0.01
    frequency = np.full((6, 2), 0.5)
    frequency[3, 1] = 1e70
    middle = (SIX_AXES.lower + SIX_AXES.upper) / 2.0
    for ramp in (0.0, 1.0):
        check_limits(FourierSeries(middle, amplitude, frequency, 9.0, ramp), SIX_AXES)
    amplitude[3, 1] = 1e-9
    for ramp in (0.0, 1.0):
        with pytest.raises(LimitExceeded, match="joint 3"):
            check_limits(FourierSeries(middle, amplitude, frequency, 9.0, ramp), SIX_AXES)
