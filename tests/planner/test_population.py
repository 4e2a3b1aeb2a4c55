from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from planner import (
    JointLimits,
    PiecewiseCubic,
    PlanningError,
    ViaPointOutOfLimits,
    check_limits,
    plan,
)
from planner.batch import plan_chunk
from planner.blocks import Block
from planner.errors import NonFiniteViaPoint, TooFewViaPoints, WrongShape
from planner.limits import Allowance
from planner.segments import StraightMoves
from planner.verify import check_smooth


def bits(motion: PiecewiseCubic) -> bytes:
    return b"".join(array.tobytes() for array in motion.knots + motion.coefficients)


def rates(draw, n: int) -> JointLimits:
    """Limits of joints of very different nature."""
    exponents = st.lists(st.floats(-2.0, 1.0), min_size=4, max_size=4)
    span, velocity, ramp, rise = 10.0 ** np.array([draw(exponents) for _ in range(n)]).T
    acceleration = velocity / ramp
    return JointLimits(-span, span, velocity, acceleration, acceleration / rise)


@st.composite
def populations(draw):
    """Motions that planners stumble over, together: still, microscopic, along limits."""
    n, count, k = draw(st.integers(1, 6)), draw(st.integers(1, 5)), draw(st.integers(2, 6))
    limits = rates(draw, n)
    random = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    points = random.uniform(limits.lower, limits.upper, (count, k, n))
    for row in points.reshape(-1, n)[1:]:
        kind = draw(st.sampled_from(["random", "random", "limits", "same", "tiny", "one joint"]))
        before = points[0, 0]
        if kind == "limits":
            row[:] = np.where(random.random(n) < 0.5, limits.lower, limits.upper)
        elif kind == "same":
            row[:] = before
        elif kind == "tiny":
            row[:] = before * (1.0 - 10.0 ** draw(st.integers(-15, -4)))
        elif kind == "one joint":
            row[1:] = before[1:]
    speed = random.uniform(0.05, 1.0, (count, n))
    return points, limits, speed, draw(st.sampled_from([0.0, 0.01, 0.07, 0.25, 0.5, 1.0]))


@given(populations())
@settings(max_examples=150)
def test_a_motion_of_a_population_is_the_motion_planned_alone(problem):
    points, limits, speed, fly = problem
    together = plan_chunk(points, speed, limits, fly)
    for via_points, shares, motion in zip(points, speed, together, strict=True):
        alone = plan(via_points, limits, speed=shares, fly=fly)
        assert motion.duration == alone.duration
        times = np.linspace(-0.1, 1.1, 200) * alone.duration
        for ours, theirs in zip(motion.sample(times), alone.sample(times), strict=True):
            np.testing.assert_array_equal(ours, theirs)


@given(populations())
@settings(max_examples=150)
def test_a_population_keeps_what_a_plan_promises(problem):
    points, limits, speed, fly = problem
    for shares, motion in zip(speed, plan_chunk(points, speed, limits, fly), strict=True):
        allowed = limits.scaled(velocity=shares)
        check_limits(motion, allowed)
        check_smooth(motion, allowed)
        # Pieces of no length are of no use to those who sample.
        assert all(np.all(np.diff(knots) > 0.0) for knots in motion.knots if knots[-1] > 0.0)


@given(populations(), st.data())
@settings(max_examples=50)
def test_company_changes_no_bit(problem, data):
    points, limits, speed, fly = problem
    together = plan_chunk(points, speed, limits, fly)
    index = data.draw(st.integers(0, len(points) - 1))
    (alone,) = plan_chunk(points[[index]], speed[[index]], limits, fly)
    assert bits(alone) == bits(together[index])


@pytest.mark.slow
def test_of_a_thousand_ordinary_motions_none_differs(six_axis_limits, random_points):
    points = np.array([random_points(seed) for seed in range(1000)])
    planned = plan_chunk(points, np.ones((1000, 6)), six_axis_limits, 0.5)
    for via_points, motion in zip(points, planned, strict=True):
        alone = plan(via_points, six_axis_limits)
        assert motion.duration == alone.duration
        times = np.linspace(0.0, alone.duration, 50)
        for ours, theirs in zip(motion.sample(times), alone.sample(times), strict=True):
            np.testing.assert_array_equal(ours, theirs)


def test_what_cannot_be_planned_is_told_in_its_place(six_axis_limits, random_points):
    good, outside, unknown = random_points(0), random_points(1), random_points(2)
    outside[3, 2] = 50.0
    unknown[0, 0] = np.nan
    individuals = [good, outside, good[:1], unknown, good[:, :5], good[:3], good]
    planned = plan_chunk(individuals, np.ones((7, 6)), six_axis_limits, 0.5)
    assert [type(each) for each in planned] == [
        PiecewiseCubic,
        ViaPointOutOfLimits,
        TooFewViaPoints,
        NonFiniteViaPoint,
        WrongShape,
        PiecewiseCubic,
        PiecewiseCubic,
    ]
    assert bits(planned[0]) == bits(planned[6])
    assert planned[5].sample(np.array([np.inf]))[0][0] == pytest.approx(good[2], abs=1e-11)


def test_nobody_to_plan_for(six_axis_limits):
    assert plan_chunk([], np.ones((0, 6)), six_axis_limits, 0.5) == []


COUNT, JOINTS, PIECES = 3, 2, 5
JUST = [0.5, 1.0 - 1e-6, 1.0, 1.0 + 1e-6, 2.0]


@st.composite
def blocks(draw):
    """Motions of constant jerks, some pieces without length or without jerk."""
    random = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    shape = (COUNT, JOINTS, PIECES)
    knots = np.zeros((COUNT, JOINTS, PIECES + 1))
    lengths = random.uniform(0.0, 1.0, shape) * (random.random(shape) < 0.8)
    knots[..., 1:] = np.cumsum(lengths, axis=-1)
    knots *= (1.0 / np.maximum(knots[..., -1:], 1e-3)) * random.uniform(0.1, 10.0, (COUNT, 1, 1))
    knots[..., -1] = knots[:, :1, -1]
    jerks = random.normal(size=shape) * (random.random(shape) < 0.8)
    return Block.from_jerks(random.normal(size=(COUNT, JOINTS, 3)), knots, jerks)


def table(block: Block, row: int) -> PiecewiseCubic:
    return PiecewiseCubic(tuple(block.knots[row].copy()), tuple(block.coefficients[row].copy()))


def holds(check, motion: PiecewiseCubic, limits: JointLimits) -> bool:
    try:
        check(motion, limits)
    except PlanningError:
        return False
    return True


@given(blocks(), st.lists(st.sampled_from(JUST), min_size=5, max_size=5))
def test_limits_are_kept_exactly_where_the_check_of_one_motion_says_so(block, factors):
    each = []
    for row in range(COUNT):
        reach = table(block, row).extrema()
        far = 1.0 + np.maximum(np.abs(reach.lower), np.abs(reach.upper))
        lower = np.where(reach.lower < 0, reach.lower * factors[0], -far)
        upper = np.where(reach.upper > 0, reach.upper * factors[1], far)
        rates = [
            np.maximum(rate, 1e-3) * factor
            for rate, factor in zip(reach[2:], factors[2:], strict=True)
        ]
        each.append(JointLimits(lower, upper, *rates))
    rows = Allowance.of_many(each)
    expected = [holds(check_limits, table(block, row), each[row]) for row in range(COUNT)]
    assert block.keeps(rows).tolist() == expected


@given(
    st.integers(0, 2**32 - 1),
    st.integers(0, 6),
    st.integers(0, 2),
    st.sampled_from([0.0, 1e-11, 1e-3]),
)
def test_motions_are_smooth_exactly_where_the_check_of_one_motion_says_so(
    seed, piece, quantity, jump
):
    starts, ends = np.random.default_rng(seed).uniform(-1.0, 1.0, (2, COUNT, JOINTS))
    ones = np.ones((COUNT, JOINTS))
    moves = StraightMoves.between(starts, ends, ones, ones, ones)
    knots, pieces = moves.cut(np.zeros(COUNT), moves.durations)
    pieces[1, 0, piece, quantity] += jump
    motion = Block.of_pieces(np.repeat(knots[:, None], JOINTS, axis=1), pieces)
    limits = JointLimits(-ones[0], ones[0], ones[0], ones[0], ones[0])
    rows = Allowance.of_many([limits] * COUNT)
    expected = [holds(check_smooth, table(motion, row), limits) for row in range(COUNT)]
    assert motion.smooth(rows).tolist() == expected
    assert expected[0]
    assert expected[2]
    if jump != 1e-11:  # about what counts as rounding: there only the two have to agree
        assert expected[1] is (jump == 0.0)


@given(blocks())
def test_tables_are_the_same_motions_without_empty_pieces(block):
    for row, motion in enumerate(block.tables()):
        whole = table(block, row)
        assert motion.duration == whole.duration
        times = np.linspace(-0.1, 1.1, 97) * whole.duration
        for ours, theirs in zip(motion.sample(times), whole.sample(times), strict=True):
            np.testing.assert_array_equal(ours, theirs)
        assert all(np.all(np.diff(knots) > 0.0) for knots in motion.knots)


def test_a_motion_of_no_length_keeps_one_piece():
    still = Block.from_jerks(
        np.array([[[1.0, 0.0, 0.0]]]), np.zeros((1, 1, PIECES + 1)), np.zeros((1, 1, PIECES))
    )
    (motion,) = still.tables()
    assert motion.duration == 0.0
    assert motion.sample(np.array([0.0]))[0] == pytest.approx(1.0)


@given(blocks())
def test_a_block_is_integrated_as_one_motion_is(block):
    for row in range(COUNT):
        one = PiecewiseCubic.from_jerks(
            block.coefficients[row, :, 0, :3], block.knots[row], block.coefficients[row, :, :, 3]
        )
        np.testing.assert_array_equal(np.array(one.coefficients), block.coefficients[row])
        np.testing.assert_array_equal(np.array([ends[-1] for ends in one.ends()]), block.end[row])
