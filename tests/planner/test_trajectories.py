"""Cubics, sums of sines, straight moves with their corners, and time laws."""

from __future__ import annotations

import json
from itertools import pairwise

import numpy as np
import pytest
import ruckig
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.interpolate import PPoly

from planner import (
    InvalidLimits,
    InvalidTrajectory,
    JointLimits,
    LimitExceeded,
    NotSmooth,
    PiecewiseCubic,
    TrajectoryPlayer,
    check_limits,
    plan,
)
from planner.corners import (
    FIRST_FLY_SHARES,
    LAST_FLY_SHARES,
    STOP,
    StraightMoves,
    passing,
    rest_to_rest,
    solve_many,
)
from planner.errors import UnsupportedSolver
from planner.fourier import FourierSeries, harmonic_bounds
from planner.motion_queue import corner
from planner.piecewise_cubic import Block, check_rest
from planner.time_law import RateBounds, TimeLaw, admits, ramp, slowing_bounds
from tests.planner.six_axes import SIX_AXES, join, legs_between, random_points, rows_of

numbers = st.floats(-10.0, 10.0)


@st.composite
def tables(draw):
    """Tables of 1-3 joints, 1-5 constant jerks, some pieces of zero length."""
    n = draw(st.integers(1, 3))
    m = draw(st.integers(1, 5))
    start = draw(arrays(np.float64, (n, 3), elements=numbers))
    jerks = draw(arrays(np.float64, (n, m), elements=numbers))
    lengths = draw(arrays(np.float64, (n, m), elements=st.sampled_from([0.0, 0.1, 0.3, 1.0, 2.0])))
    lengths[:, -1] += 0.5
    lengths *= 2.0 / lengths.sum(axis=1, keepdims=True)
    knots = np.concatenate((np.zeros((n, 1)), np.cumsum(lengths, axis=1)), axis=1)
    knots[:, -1] = 2.0
    knots = np.minimum(knots, 2.0)
    block = Block.from_jerks(start[None], knots[None], jerks[None])
    return PiecewiseCubic(tuple(block.knots[0]), tuple(block.coefficients[0]))


@given(tables(), arrays(np.float64, 20, elements=st.floats(0.0, 2.0)))
def test_samples_agree_with_an_independent_polynomial(table, t):
    q, qd, qdd = table.sample(t)
    for joint in range(table.n_joints):
        keep = np.diff(table.knots[joint]) > 0
        breaks = np.append(table.knots[joint][:-1][keep], table.duration)
        p, v, a, j = table.coefficients[joint][keep].T
        polynomial = PPoly(np.array([j / 6, a / 2, v, p]), breaks)
        np.testing.assert_allclose(q[:, joint], polynomial(t), atol=1e-10)
        np.testing.assert_allclose(qd[:, joint], polynomial(t, 1), atol=1e-10)
        np.testing.assert_allclose(qdd[:, joint], polynomial(t, 2), atol=1e-10)
    single_samples = [table.sample_one(x) for x in t.tolist()]
    for ours, scalar in zip((q, qd, qdd), zip(*single_samples, strict=True), strict=True):
        np.testing.assert_allclose(ours, scalar, atol=1e-12)


@given(tables())
def test_it_rests_at_its_ends_outside_its_time(table):
    q, qd, qdd = table.sample(np.array([-1.0, 0.0, 2.0, 2.0 + 1e-9, 50.0]))
    np.testing.assert_array_equal(q[0], q[1])
    np.testing.assert_array_equal(q[3:], q[[2, 2]])
    assert not np.any(qd[[0, 3, 4]]) and not np.any(qdd[[0, 3, 4]])
    for t, row in ((-1.0, 0), (2.5, 4)):
        sample = table.sample_one(t)
        np.testing.assert_allclose(sample[0], q[row], atol=1e-12)
        assert not np.any(sample[1]) and not np.any(sample[2])


@given(tables())
def test_pieces_meet_to_the_last_bit(table):
    for pieces, ends in zip(table.coefficients, table.ends(), strict=True):
        np.testing.assert_array_equal(pieces[1:, :3], ends[:-1])


GOOD_LIMITS = {
    "lower": [-1.0, -2.0],
    "upper": [1.0, 2.0],
    "velocity": [1.0, 1.0],
    "acceleration": [2.0, 2.0],
    "jerk": [10.0, 10.0],
}


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("upper", [1.0, np.inf]),
        ("velocity", [1.0, np.nan]),
        ("velocity", [1.0, 0.0]),
        ("acceleration", [-2.0, 2.0]),
        ("velocity", [1.0, 1e-300]),
        ("jerk", [1e100, 10.0]),
        ("jerk", [10.0]),
        ("jerk", [[10.0, 10.0]]),
        ("lower", [-1.0, 2.0]),
        ("lower", []),
    ],
)
def test_impossible_limits_are_refused_by_name(name, value):
    with pytest.raises(InvalidLimits) as refusal:
        JointLimits(**{**GOOD_LIMITS, name: value})
    assert refusal.value.name == name


def moving(column: int, value: float, at_end: bool) -> PiecewiseCubic:
    """Six joints that rest, but for joint 3 at one of its ends."""
    knots = np.tile([0.0, 1.0, 2.0], (6, 1))
    tables = np.zeros((6, 2, 4))
    if at_end:
        tables[3, 1, column + 1] = value
    else:
        tables[3, 0, column] = value
    return PiecewiseCubic(tuple(knots), tuple(tables))


@pytest.mark.parametrize("at_end", [False, True])
@pytest.mark.parametrize(("column", "quantity"), [(1, "velocity"), (2, "acceleration")])
def test_a_rate_at_an_end_is_named(column, quantity, at_end):
    with pytest.raises(NotSmooth) as refusal:
        check_rest(moving(column, 1e-3, at_end), SIX_AXES)
    assert (refusal.value.joint, refusal.value.time) == (3, 2.0 if at_end else 0.0)
    assert refusal.value.quantity in (quantity, "velocity")


@st.composite
def series(draw, ramped=None):
    """Series of 1-3 joints and 1-4 sines, some equal, some constant, ramps of all lengths."""
    n = draw(st.integers(1, 3))
    w = draw(st.integers(1, 4))
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


def jerk_of(motion: FourierSeries, t: np.ndarray, h: float) -> np.ndarray:
    return (motion.sample(t + h)[2] - motion.sample(t - h)[2]) / (2 * h)


def test_it_is_equation_8_without_and_between_ramps():
    offset = np.array([0.5, -1.0])
    amplitude = np.array([[0.3, 0.1, -0.2], [0.4, 0.0, 0.7]])
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
def test_velocity_and_acceleration_are_derivatives_of_position(motion):
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


@given(tables() | series())
@settings(max_examples=60, deadline=None)
def test_extrema_bound_every_sample_and_are_reached(motion):
    extrema = motion.extrema()
    rounding = 1e-9
    rough = np.zeros(4)
    t = np.linspace(0.0, motion.duration, 20001)
    step = t[1]
    if isinstance(motion, FourierSeries):
        rounding = 1e-13
        rough = [room(motion, order) for order in range(4)]
    else:
        t = np.union1d(t, np.concatenate(motion.knots))
    q, qd, qdd = motion.sample(t)
    for order, bound, sampled, slope in (
        (0, extrema.upper, q.max(axis=0), extrema.velocity),
        (0, -extrema.lower, (-q).max(axis=0), extrema.velocity),
        (1, extrema.velocity, np.abs(qd).max(axis=0), extrema.acceleration),
        (2, extrema.acceleration, np.abs(qdd).max(axis=0), extrema.jerk),
    ):
        assert np.all(bound >= sampled - rounding)
        # The truth lies half a step from a sample at most.
        assert np.all(bound <= sampled + 0.5 * step * slope + rough[order] + 10.0 * rounding)


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
    bound = motion.extrema().jerk
    seen = np.abs(jerk_of(motion, t, h)).max(axis=0)
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
    sampled = np.abs(jerk_of(motion, np.linspace(0.001, ramp - 0.001, 5001), 1e-6)).max()
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


@given(tables() | series())
def test_storing_and_restoring_changes_no_bit(motion):
    data = json.dumps(motion.to_dict())  # distinguishes -0.0 from 0.0
    assert json.dumps(type(motion).from_dict(json.loads(data)).to_dict()) == data


CUBIC = {
    "type": "piecewise_cubic",
    "knots": [[0.0, 1.0], [0.0, 1.0]],
    "coefficients": [[[0.0, 1.0, 2.0, 3.0]], [[0.0, 1.0, 2.0, 3.0]]],
}
SINES = {"type": "fourier_series", "offset": [0.0], "amplitude": [[1.0]], "frequency": [[1.0]],
         "length": 1.0, "ramp": 0.5}  # fmt: skip
DAMAGE = (
    {"knots": [[0.0, 1.0]]},
    {"knots": [[0.0], [0.0]], "coefficients": [[], []]},
    {"knots": [[0.0, 1.0], [0.0, 2.0]]},
    {"knots": [[0.5, 1.0], [0.5, 1.0]]},
    {"knots": [[0.0, 1.0, 0.5], [0.0, 1.0]]},
    {"coefficients": [[[0.0, 0.0, 0.0]], [[0.0, 0.0, 0.0]]]},
    {"coefficients": [[[0.0, 0.0, float("nan"), 0.0]], [[0.0, 0.0, 0.0, 0.0]]]},
    {"coefficients": [["text"], []]},
    {"coefficients": None},
    {"offset": [0.0, 0.0]},
    {"offset": 0.0},
    {"amplitude": [[1.0, 2.0]]},
    {"amplitude": [[float("nan")]]},
    {"frequency": None},
    *({"length": length} for length in (0.0, "long")),
    *({"ramp": ramp} for ramp in (0.6, -0.1, float("inf"))),
    *({name: good[name], "type": "line"} for name, good in (("knots", CUBIC), ("offset", SINES))),
)


@pytest.mark.parametrize("damage", DAMAGE)
def test_invalid_stored_data_are_refused(damage):
    kind, good = (PiecewiseCubic, CUBIC) if next(iter(damage)) in CUBIC else (FourierSeries, SINES)
    kind.from_dict(good)
    with pytest.raises(InvalidTrajectory):
        kind.from_dict({**good, **damage})


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
def test_set_points_of_a_player_satisfy_the_limits(seed):
    motion = executable(SIX_AXES, seed)
    period = 0.002
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
    for length in (0.0, 1.0):
        check_limits(FourierSeries(middle, amplitude, frequency, 9.0, length), SIX_AXES)
    amplitude[3, 1] = 1e-9
    for length in (0.0, 1.0):
        with pytest.raises(LimitExceeded, match="joint 3"):
            check_limits(FourierSeries(middle, amplitude, frequency, 9.0, length), SIX_AXES)


magnitude = st.floats(-3.0, 3.0).map(lambda exponent: 10.0**exponent)


def straight(start, end, limits, deceleration=None):
    bounds = rows_of(limits)
    slowing = bounds.acceleration if deceleration is None else deceleration[None]
    return StraightMoves.between(start[None], end[None], bounds, slowing)


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
    start = np.array([0.1, -0.2, 0.3])
    end = np.array([1.1, 0.9, -1.2])
    moves = straight(start, end, limits)
    (motion,) = moves.tables(np.zeros(1), moves.durations)
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
        first = law.coefficients[0][:4]
        last = law.coefficients[0][4:]
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
        asked.max_velocity = [velocity]
        asked.max_acceleration = [acceleration]
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
    leave = share * moves.slowing_down[0]
    enter = share * moves.speeding_up[1]
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
    points = random_points(1, 3)
    asked = []

    def slow(starts, *arguments):
        asked.extend(starts)
        solutions = solve_many(starts, *arguments)
        return solutions._replace(durations=np.full(len(starts), 10.0))

    monkeypatch.setattr("planner.corners.solve_many", slow)
    assert flown(points, SIX_AXES) is STOP
    parts = FIRST_FLY_SHARES + LAST_FLY_SHARES
    tried = [cut(points, SIX_AXES, 0.5 * part)[0] for part in parts]
    np.testing.assert_array_equal(asked, tried)


@pytest.mark.parametrize("missed", [1.2, np.inf], ids=["too slow", "unknown"])
def test_a_join_without_solution_is_replaced_by_its_neighbour(monkeypatch, missed):
    def misses_the_first(*asked):
        solutions = solve_many(*asked)
        # Observed: a join much longer than necessary, still shorter than a stop.
        solutions.durations[0] *= missed
        return solutions

    monkeypatch.setattr("planner.corners.solve_many", misses_the_first)
    passed = flown(random_points(1, 3), SIX_AXES)
    assert (passed.how, passed.share) == ("reduced", 0.5 * 0.9999)
    assert passed.join is not None


@pytest.mark.parametrize("version", ["0.20.1", "0.1.9", "unknown", "0.19.9"])
def test_no_corner_is_planned_with_an_unknown_solver(monkeypatch, version):
    monkeypatch.setattr("planner.corners._RUCKIG_VERSION", version)
    points = random_points(3, 3)
    assert flown(points, SIX_AXES, 0.0) is STOP
    if version == "0.19.9":
        assert flown(points, SIX_AXES).how == "flown"
    else:
        with pytest.raises(UnsupportedSolver, match=rf"{version}.*0\.19"):
            flown(points, SIX_AXES)


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

    @given(tables(), st.data())
    def test_no_sample_is_nearer(self, motion, data):
        point = np.array(data.draw(st.tuples(*[numbers] * motion.n_joints)))
        passed = passing(motion, point)
        q = motion.sample(np.linspace(0.0, motion.duration, 2001))[0]
        sampled = np.linalg.norm(q - point, axis=1).min()
        # Two dips of like depth between the looks at a path may be mistaken for one another.
        between = 0.5 * motion.duration / 64 * np.linalg.norm(motion.extrema().velocity)
        assert passed.distance <= sampled + between
        reached = motion.sample_one(passed.time)[0]
        assert passed.distance == pytest.approx(np.linalg.norm(reached - point), abs=1e-12)


fractions = st.one_of(st.sampled_from([0.0, 0.2, 1.0]), st.floats(0.0, 1.0))
rate_bounds = st.builds(RateBounds, st.floats(0.01, 100.0), st.floats(0.01, 1000.0))


@st.composite
def states(draw):
    """Bounds and a state that they admit, often a limiting one."""
    bounds = draw(rate_bounds)
    final = draw(fractions)
    # The slope can be as large as one that ends there from 0, or from 1 if it is negative.
    most = min(bounds.slope, (2.0 * bounds.change * final) ** 0.5)
    least = -min(bounds.slope, (2.0 * bounds.change * (1.0 - final)) ** 0.5)
    slope = draw(st.one_of(st.just(0.0), st.just(most), st.just(least), st.floats(least, most)))
    return bounds, final - slope * abs(slope) / (2.0 * bounds.change), slope


@given(states(), fractions)
@example((RateBounds(1.0, 10.0), 0.0, 0.0), 5e-324)
@example((RateBounds(1.0, 10.0), 1.0, 0.0), 1.0)
def test_a_ramp_is_smooth_within_its_bounds_to_the_target(state, target):
    bounds, rate, slope = state
    way = ramp(rate, slope, target, bounds)
    assert way.sample(0.0) == (0.0, rate, slope) or way.duration == 0.0
    begins = [piece.begin for piece in way.pieces]
    assert [0.0, *begins[1:], way.duration] == sorted([0.0, *begins[1:], way.duration])
    size = max(1.0, bounds.slope, bounds.change)
    for begin, end, piece in zip(begins, [*begins[1:], way.duration], way.pieces, strict=True):
        assert abs(piece.change) <= bounds.change
        x = end - begin
        assert abs(piece.slope) <= bounds.slope * (1 + 1e-12)
        # No jump to the next piece or the target.
        after = way.sample(end)
        assert after[2] == pytest.approx(piece.slope + x * piece.change, abs=1e-10 * size)
        assert after[1] == pytest.approx(
            piece.rate + x * piece.slope + x * x * piece.change / 2.0, abs=1e-10 * size
        )
        # A cubic is integrated exactly from its ends and middle.
        middle = piece.rate + x * piece.slope / 2.0 + x * x * piece.change / 8.0
        assert after[0] - piece.motion_time == pytest.approx(
            x / 6.0 * (piece.rate + 4.0 * middle + after[1]), abs=1e-9 * max(1.0, x)
        )
    assert way.sample(way.duration) == (way.motion_time, target, 0.0)
    assert way.sample(way.duration + 2.0)[0] == pytest.approx(way.motion_time + 2.0 * target)


@given(states(), fractions)
def test_no_ramp_is_faster(state, target):
    bounds, rate, slope = state
    # The reference is known to crash at states on their limit, and is exact to 1e-8.
    slope = float(np.clip(slope, -0.9 * bounds.slope, 0.9 * bounds.slope))
    problem = ruckig.InputParameter(1)
    problem.control_interface = ruckig.ControlInterface.Velocity
    problem.current_velocity = [rate]
    problem.current_acceleration = [slope]
    problem.target_velocity = [target]
    problem.max_acceleration = [bounds.slope]
    problem.max_jerk = [bounds.change]
    reference = ruckig.Trajectory(1)
    ruckig.Ruckig(1).calculate(problem, reference)
    duration = ramp(rate, slope, target, bounds).duration
    assert duration == pytest.approx(reference.duration, rel=1e-6, abs=1e-7)


moments = st.one_of(st.just(0.0), st.floats(0.0, 3.0))


@given(states(), st.lists(st.tuples(fractions, moments, st.booleans()), min_size=1, max_size=12))
def test_targets_and_wider_bounds_stay_in_the_range(state, changes):
    bounds, rate, slope = state
    seen = []
    for target, share, widen in changes:
        if widen:
            bounds = RateBounds(1.5 * bounds.slope, 2.0 * bounds.change)
        way = ramp(rate, slope, target, bounds)
        until = share * way.duration
        # Extremes lie where the slope is zero: at the ends, or in the middle of a piece.
        at = [0.0, *np.linspace(0.0, until, 9)]
        at += [p.begin - p.slope / p.change for p in way.pieces if p.change != 0.0]
        seen += [way.sample(t)[1] for t in at if 0.0 <= t <= until]
        steps = [way.sample(t)[0] for t in np.linspace(0.0, until, 9)]
        assert all(b >= a - 1e-12 for a, b in pairwise(steps))
        _, rate, slope = way.sample(until)
    assert min(seen) >= -1e-9
    assert max(seen) <= 1.0 + 1e-9


@given(states(), st.booleans())
def test_a_state_outside_its_bounds_is_not_admitted(state, rising):
    bounds, rate, _ = state
    assert admits(bounds, 0.5, 0.0)
    assert not admits(bounds, rate, (1.0 + 1e-9) * (bounds.slope if rising else -bounds.slope))
    too_steep = (2.0 * bounds.change * 0.25) ** 0.5 * (1.0 + 1e-9)
    assert not admits(bounds, 0.75 if rising else 0.25, too_steep if rising else -too_steep)


def test_motion_time_follows_the_ramp_and_settles():
    bounds = RateBounds(2.0, 20.0)
    period = 0.002
    law = TimeLaw(period)
    law.restart(1.5, 1.0)
    assert law.settled
    law.advance()
    assert (law.motion_time, law.rate, law.slope, law.settled) == (1.502, 1.0, 0.0, True)
    law.aim(0.25, bounds)
    way = ramp(1.0, 0.0, 0.25, bounds)
    assert not law.settled
    for tick in range(1, 500):
        law.advance()
        gone, rate, slope = way.sample(tick * period)
        assert (law.motion_time, law.rate, law.slope) == (1.502 + gone, rate, slope)
        assert law.settled == (tick * period >= way.duration)
    assert law.rate == 0.25


rates = st.floats(-1.0, 2.0).map(lambda exponent: 10.0**exponent)
joints = st.lists(st.tuples(rates, rates, rates), min_size=1, max_size=4)
shares = st.floats(0.0, 1.5)


@given(joints, rates, rates)
def test_the_worst_path_just_satisfies_the_bounds(joints, more, much_more):
    # Velocity, acceleration and jerk at their limits at once, with the worst signs.
    velocity, acceleration, jerk = np.array(joints).T
    limits = JointLimits(-np.ones_like(jerk), np.ones_like(jerk), velocity, acceleration, jerk)
    bounds = slowing_bounds(limits, 1.0 + more, 1.0 + much_more)
    assert bounds.slope > 0.0
    assert bounds.change > 0.0
    used_acceleration = (acceleration + velocity * bounds.slope) / acceleration
    used_jerk = (jerk + 3 * acceleration * bounds.slope + velocity * bounds.change) / jerk
    assert np.all(used_acceleration <= (1.0 + more) * (1 + 1e-9))
    # At least one joint uses all its jerk, or there would be a faster change.
    assert np.max(used_jerk) == pytest.approx(1.0 + much_more)


@pytest.fixture(scope="module")
def motions():
    return [plan(random_points(seed, 4), SIX_AXES) for seed in range(6)]


@given(
    which=st.integers(0, 5),
    share=st.floats(0.0, 1.0),
    factors=st.sampled_from([(1.3, 1.7), (2.0, 3.0), (1.05, 4.0)]),
    from_rate=st.floats(0.0, 1.0),
    to_rate=st.floats(0.0, 1.0),
)
@settings(max_examples=60)
def test_bounds_are_satisfied_between_set_points_too(
    motions, which, share, factors, from_rate, to_rate
):
    motion = motions[which]
    limits = SIX_AXES
    way = ramp(from_rate, 0.0, to_rate, slowing_bounds(limits, *factors, motion.extrema()))
    t = np.linspace(0.0, way.duration, 2000)
    s, r, dr = np.array([way.sample(float(x)) for x in t]).T[:, :, None]
    begins = [piece.begin for piece in way.pieces[1:]]
    piece = np.searchsorted(begins, t, side="right")
    ddr = np.array([piece.change for piece in way.pieces])[piece][:, None]
    s = s[:, 0] + share * motion.duration
    _, v, a = motion.sample(s)
    jerk = np.empty_like(v)
    for joint, knots in enumerate(motion.knots):
        at = np.searchsorted(knots[1:-1], s, side="right")
        jerk[:, joint] = motion.coefficients[joint][at, 3]
    jerk[s > motion.duration] = 0.0
    rounding = 1 + 1e-9
    assert np.all(np.abs(v * r) <= limits.velocity * rounding)
    assert np.all(np.abs(a * r**2 + v * dr) <= factors[0] * limits.acceleration * rounding)
    assert np.all(
        np.abs(jerk * r**3 + 3 * a * r * dr + v * ddr) <= factors[1] * limits.jerk * rounding
    )
