"""Tables of cubics, and the limits that they are checked against."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.interpolate import PPoly

from planner import (
    InvalidLimits,
    InvalidTrajectory,
    JointLimits,
    NotSmooth,
    PiecewiseCubic,
)
from planner.piecewise_cubic import Block, check_rest
from tests.planner.six_axes import SIX_AXES

numbers = st.floats(-10.0, 10.0)


@st.composite
def tables(draw):
    """Tables of 1-3 joints, 1-5 constant jerks, some pieces of zero length."""
    n, m = draw(st.integers(1, 3)), draw(st.integers(1, 5))
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


def reference(table: PiecewiseCubic, joint: int) -> PPoly:
    keep = np.diff(table.knots[joint]) > 0
    breaks = np.append(table.knots[joint][:-1][keep], table.duration)
    p, v, a, j = table.coefficients[joint][keep].T
    return PPoly(np.array([j / 6, a / 2, v, p]), breaks)


@given(tables(), arrays(np.float64, 20, elements=st.floats(0.0, 2.0)))
def test_samples_agree_with_an_independent_polynomial(table, t):
    q, qd, qdd = table.sample(t)
    for joint in range(table.n_joints):
        polynomial = reference(table, joint)
        np.testing.assert_allclose(q[:, joint], polynomial(t), atol=1e-10)
        np.testing.assert_allclose(qd[:, joint], polynomial(t, 1), atol=1e-10)
        np.testing.assert_allclose(qdd[:, joint], polynomial(t, 2), atol=1e-10)
    one = [table.sample_one(x) for x in t.tolist()]
    for ours, scalar in zip((q, qd, qdd), zip(*one, strict=True), strict=True):
        np.testing.assert_allclose(ours, scalar, atol=1e-12)


@given(tables())
def test_it_rests_at_its_ends_outside_its_time(table):
    q, qd, qdd = table.sample(np.array([-1.0, 0.0, 2.0, 2.0 + 1e-9, 50.0]))
    np.testing.assert_array_equal(q[0], q[1])
    np.testing.assert_array_equal(q[3:], q[[2, 2]])
    assert not np.any(qd[[0, 3, 4]]) and not np.any(qdd[[0, 3, 4]])
    for t, row in ((-1.0, 0), (2.5, 4)):
        one = table.sample_one(t)
        np.testing.assert_allclose(one[0], q[row], atol=1e-12)
        assert not np.any(one[1]) and not np.any(one[2])


@given(tables())
def test_extrema_bound_every_sample_and_are_reached(table):
    extrema = table.extrema()
    t = np.union1d(np.linspace(0.0, 2.0, 4001), np.concatenate(table.knots))
    q, qd, qdd = table.sample(t)
    for exact, sampled, slope in (
        (extrema.upper, q.max(axis=0), extrema.velocity),
        (-extrema.lower, (-q).max(axis=0), extrema.velocity),
        (extrema.velocity, np.abs(qd).max(axis=0), extrema.acceleration),
        (extrema.acceleration, np.abs(qdd).max(axis=0), extrema.jerk),
    ):
        assert np.all(exact >= sampled - 1e-9)
        assert np.all(exact <= sampled + 0.0005 * slope + 1e-9)


@given(tables())
def test_storing_and_restoring_changes_no_bit(table):
    restored = PiecewiseCubic.from_dict(json.loads(json.dumps(table.to_dict())))
    for ours, theirs in zip(
        (*table.knots, *table.coefficients),
        (*restored.knots, *restored.coefficients),
        strict=True,
    ):
        assert ours.tobytes() == theirs.tobytes()


@given(tables())
def test_pieces_meet_to_the_last_bit(table):
    for pieces, ends in zip(table.coefficients, table.ends(), strict=True):
        np.testing.assert_array_equal(pieces[1:, :3], ends[:-1])


@pytest.mark.parametrize(
    "damage",
    [
        {"knots": [[0.0, 1.0]]},
        {"knots": [[0.0], [0.0]], "coefficients": [[], []]},
        {"knots": [[0.0, 1.0], [0.0, 2.0]]},
        {"knots": [[0.5, 1.0], [0.5, 1.0]]},
        {"knots": [[0.0, 1.0, 0.5], [0.0, 1.0]]},
        {"coefficients": [[[0.0, 0.0, 0.0]], [[0.0, 0.0, 0.0]]]},
        {"coefficients": [[[0.0, 0.0, float("nan"), 0.0]], [[0.0, 0.0, 0.0, 0.0]]]},
        {"coefficients": [["text"], []]},
        {"coefficients": None},
    ],
)
def test_invalid_stored_data_are_refused(damage):
    good = {
        "type": "piecewise_cubic",
        "knots": [[0.0, 1.0], [0.0, 1.0]],
        "coefficients": [[[0.0, 1.0, 2.0, 3.0]], [[0.0, 1.0, 2.0, 3.0]]],
    }
    PiecewiseCubic.from_dict(good)
    with pytest.raises(InvalidTrajectory):
        PiecewiseCubic.from_dict({**good, **damage})


GOOD = {
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
        JointLimits(**{**GOOD, name: value})
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
