from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from planner import (
    InvalidSetting,
    InvalidViaPoints,
    JointLimits,
    LimitExceeded,
    NonFiniteViaPoint,
    NotSmooth,
    PiecewiseCubic,
    TooFewViaPoints,
    ViaPointOutOfLimits,
    WrongShape,
    plan,
)
from planner.segments import StraightSegment
from planner.verify import check_limits, check_smooth


def decades(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high).map(lambda exponent: 10.0**exponent)


@st.composite
def problems(draw):
    """Via points that planners stumble over, and joints of very different nature."""
    n = draw(st.integers(1, 7))
    joints = [draw(st.tuples(*[decades(-2, 1)] * 4)) for _ in range(n)]
    span, velocity, ramp, rise = np.array(joints).T
    acceleration = velocity / ramp
    centre = np.array(draw(st.lists(st.floats(-5, 5), min_size=n, max_size=n)))
    limits = JointLimits(
        centre - span, centre + span, velocity, acceleration, acceleration / rise * 10.0
    )
    count = draw(st.integers(2, 7))
    rows = [centre]
    for _ in range(count):
        kind = draw(st.sampled_from(["random", "limits", "same", "tiny", "one joint"]))
        row = rows[-1].copy()
        if kind == "random":
            row = centre + span * np.array(draw(st.lists(st.floats(-1, 1), min_size=n, max_size=n)))
        elif kind == "limits":
            on = np.array(draw(st.lists(st.booleans(), min_size=n, max_size=n)))
            row = np.where(on, limits.lower, limits.upper)
        elif kind == "tiny":
            row = row + draw(st.sampled_from([1e-15, 1e-12, 1e-9, 1e-6, 1e-4])) * span
        elif kind == "one joint":
            joint = draw(st.integers(0, n - 1))
            row[joint] = draw(st.sampled_from([limits.lower[joint], limits.upper[joint]]))
        rows.append(np.clip(row, limits.lower, limits.upper))
    speed = np.array(draw(st.lists(st.floats(0.05, 1.0), min_size=n, max_size=n)))
    fly = draw(st.sampled_from([0.0, 0.01, 0.1, 0.5, 1.0]))
    return np.array(rows[1:]), limits, speed, fly


@given(problems())
@settings(max_examples=300)
def test_no_input_makes_a_plan_break_a_limit_or_jump(problem):
    points, limits, speed, fly = problem
    motion = plan(points, limits, speed=speed, fly=fly)
    extrema = motion.extrema()
    rounding = 1e-12 * np.maximum(np.abs(limits.lower), np.abs(limits.upper))
    assert np.all(extrema.lower >= limits.lower - rounding)
    assert np.all(extrema.upper <= limits.upper + rounding)
    assert np.all(extrema.velocity <= speed * limits.velocity)
    assert np.all(extrema.acceleration <= limits.acceleration)
    assert np.all(extrema.jerk <= limits.jerk)
    # Rounding of the numbers, and of the clock late in a long motion.
    tick = 4.0 * np.spacing(motion.duration)
    for joint, ends in enumerate(motion.ends()):
        jumps = np.abs(motion.coefficients[joint][1:, :3] - ends[:-1])
        v, a, j = limits.velocity[joint], limits.acceleration[joint], limits.jerk[joint]
        assert np.all(
            jumps <= [rounding[joint] + tick * v, 1e-9 * v + tick * a, 1e-9 * a + tick * j]
        )
    q, qd, qdd = motion.sample(np.array([0.0, motion.duration]))
    np.testing.assert_allclose(q, points[[0, -1]], rtol=0, atol=2 * rounding.max())
    assert np.all(np.abs(qd) <= 1e-9 * limits.velocity + tick * limits.acceleration)
    assert np.all(np.abs(qdd) <= 1e-9 * limits.acceleration + tick * limits.jerk)


@given(st.integers(0, 10**6), st.sampled_from([0.05, 0.25, 0.5, 1.0]))
@settings(max_examples=25)
def test_set_points_differenced_by_a_stranger_keep_the_limits_too(
    six_axis_limits, random_points, seed, fly
):
    motion = plan(random_points(seed), six_axis_limits, fly=fly)
    period = 0.001
    q = motion.sample(np.arange(-5.0, motion.duration / period + 5.0) * period)[0]
    for order, bound in ((1, "velocity"), (2, "acceleration"), (3, "jerk")):
        rate = np.abs(np.diff(q, order, axis=0)) / period**order
        assert np.all(rate <= getattr(six_axis_limits, bound) * (1 + 1e-5)), bound


def test_without_fly_every_point_is_a_stop_on_straight_lines(six_axis_limits, random_points):
    points = random_points(11)
    motion = plan(points, six_axis_limits, fly=0.0)
    cautious = six_axis_limits.scaled(velocity=0.99, acceleration=0.98, jerk=0.98)
    segments = [StraightSegment.between(*ab, cautious) for ab in pairwise(points)]
    arrival = np.cumsum([segment.duration for segment in segments])
    assert motion.duration == pytest.approx(arrival[-1])
    q, qd, _ = motion.sample(arrival[:-1])
    np.testing.assert_allclose(q, points[1:-1], atol=1e-12)
    np.testing.assert_allclose(qd, 0.0, atol=1e-12)


def test_more_fly_is_faster_and_rounder(six_axis_limits):
    # Ranges, time against stopping everywhere and passing distances as measured elsewhere.
    narrow = np.pi / 180.0 * np.array([[180, 92, 78, 200, 125, 200], [0, 33, -87, 0, 0, 0]])
    draws = np.random.default_rng(0).uniform(-1.0, 1.0, (100, 6, 6))
    limits = replace(six_axis_limits, lower=narrow[1] - narrow[0], upper=narrow[1] + narrow[0])
    durations, distances = [], []
    for fly in (0.0, 0.1, 0.25, 0.5, 0.75, 1.0):
        sets = [narrow[1] + draw * narrow[0] for draw in draws]
        motions = [plan(points, limits, fly=fly) for points in sets]
        durations.append(np.mean([motion.duration for motion in motions]))
        passing = []
        for points, motion in zip(sets, motions, strict=True):
            q = motion.sample(np.linspace(0.0, motion.duration, 2000))[0]
            apart = np.linalg.norm(q[None] - points[1:-1, None], axis=2).min(axis=1)
            passing.append(np.rad2deg(apart.mean()))
        distances.append(np.mean(passing))
    np.testing.assert_allclose(
        np.array(durations[1:]) / durations[0], [0.99, 0.96, 0.93, 0.915, 0.90], atol=0.012
    )
    assert distances == sorted(distances)
    np.testing.assert_allclose(distances[3:], [2.6, 8.0, 16.0], rtol=0.3)


def test_a_repeated_point_is_a_stop(six_axis_limits, random_points):
    a, b, c = random_points(12, 3)
    motion = plan([a, b, b, c], six_axis_limits, fly=1.0)
    _, qd, _ = motion.sample(np.linspace(0.0, motion.duration, 5000)[1:-1])
    q = motion.sample(np.linspace(0.0, motion.duration, 5000)[1:-1])[0]
    nearest = np.argmin(np.abs(q - b).max(axis=1))
    assert np.max(np.abs(qd[nearest])) < 0.1
    assert np.min(np.abs(q - b).max(axis=1)) < 1e-4
    flown = plan([a, b, c], six_axis_limits, fly=1.0)
    assert flown.duration < motion.duration


def test_a_motion_that_goes_nowhere_takes_no_time(six_axis_limits, random_points):
    point = random_points(13, 1)[0]
    motion = plan([point, point, point], six_axis_limits)
    assert motion.duration == 0.0
    q, qd, _ = motion.sample(np.array([0.0, 1.0]))
    np.testing.assert_array_equal(q, [point, point])
    assert not np.any(qd)


def test_speed_slows_the_joint_it_is_meant_for(six_axis_limits, random_points):
    points = random_points(14)
    speed = np.array([1.0, 1.0, 1.0, 1.0, 1.0, 0.1])
    motion = plan(points, six_axis_limits, speed=speed)
    assert motion.extrema().velocity[5] <= 0.1 * six_axis_limits.velocity[5]
    assert motion.duration > plan(points, six_axis_limits).duration


@example(np.nextafter(1.0, 2.0))
@given(st.floats(1.0, 1e9, exclude_min=True))
@settings(max_examples=20)
def test_a_via_point_out_of_limits_is_refused_by_name(six_axis_limits, random_points, factor):
    points = random_points(15)
    points[2, 4] = six_axis_limits.lower[4] * factor
    with pytest.raises(ViaPointOutOfLimits) as refusal:
        plan(points, six_axis_limits)
    error = refusal.value
    assert (error.index, error.joint, error.value) == (2, 4, points[2, 4])
    assert (error.lower, error.upper) == (six_axis_limits.lower[4], six_axis_limits.upper[4])
    assert "via point 2, joint 4" in str(error)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_via_point_that_is_no_number_is_refused_by_name(six_axis_limits, random_points, value):
    points = random_points(16)
    points[5, 0] = value
    with pytest.raises(NonFiniteViaPoint) as refusal:
        plan(points, six_axis_limits)
    assert (refusal.value.index, refusal.value.joint) == (5, 0)


@pytest.mark.parametrize(
    ("points", "error"),
    [
        (np.zeros((1, 6)), TooFewViaPoints),
        (np.zeros((0, 6)), TooFewViaPoints),
        (np.zeros((3, 5)), WrongShape),
        (np.zeros(6), WrongShape),
        (np.zeros((2, 3, 6)), WrongShape),
        ([[0.0] * 6, [0.0] * 5], InvalidViaPoints),
        ([["north"] * 6, ["south"] * 6], InvalidViaPoints),
    ],
)
def test_via_points_of_the_wrong_form_are_refused(six_axis_limits, points, error):
    with pytest.raises(error):
        plan(points, six_axis_limits)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(("fly", value) for value in (-0.1, 1.1, np.nan)),
        *(("speed", value) for value in (0.0, 1.01, -1.0, np.nan, [1.0, 1.0], [1.0] * 5 + [0.0])),
    ],
)
def test_settings_outside_their_range_are_refused(six_axis_limits, random_points, name, value):
    with pytest.raises(InvalidSetting) as refusal:
        plan(random_points(17), six_axis_limits, **{name: value})
    assert refusal.value.name == name


@pytest.mark.parametrize(
    ("scale", "quantity"),
    [
        ({"velocity": 0.9}, "velocity"),
        ({"acceleration": 0.9}, "acceleration"),
        ({"jerk": 0.9}, "jerk"),
    ],
)
def test_the_final_check_finds_each_kind_of_excess(six_axis_limits, random_points, scale, quantity):
    motion = plan(random_points(18), six_axis_limits)
    check_limits(motion, six_axis_limits)
    with pytest.raises(LimitExceeded) as refusal:
        check_limits(motion, six_axis_limits.scaled(**scale))
    assert refusal.value.quantity == quantity
    assert refusal.value.value > refusal.value.bound


def test_the_final_check_finds_positions_jumps_and_numbers_that_are_none(
    six_axis_limits, random_points
):
    motion = plan(random_points(19), six_axis_limits)

    def with_position(value):
        table = motion.coefficients[2].copy()
        table[7, 0] = value
        tables = (*motion.coefficients[:2], table, *motion.coefficients[3:])
        return PiecewiseCubic(motion.knots, tables)

    with pytest.raises(NotSmooth) as refusal:
        check_smooth(with_position(motion.coefficients[2][7, 0] + 1e-8), six_axis_limits)
    assert (refusal.value.quantity, refusal.value.joint) == ("position", 2)
    with pytest.raises(LimitExceeded):
        check_limits(with_position(np.nan), six_axis_limits)
    with pytest.raises(LimitExceeded) as refusal:
        check_limits(with_position(six_axis_limits.upper[2] + 0.1), six_axis_limits)
    assert (refusal.value.quantity, refusal.value.joint) == ("position", 2)


def test_a_motion_cut_off_while_moving_is_not_smooth(six_axis_limits, random_points):
    motion = plan(random_points(20), six_axis_limits)
    with pytest.raises(NotSmooth):
        check_smooth(motion.restricted(0.0, motion.duration / 2), six_axis_limits)
