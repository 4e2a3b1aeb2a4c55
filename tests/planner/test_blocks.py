from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from planner import JointLimits, PiecewiseCubic, PlanningError, check_limits
from planner.blocks import Block
from planner.limits import Allowance
from planner.segments import StraightMoves
from planner.verify import check_smooth

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
