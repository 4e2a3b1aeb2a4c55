from __future__ import annotations

import numpy as np
import pytest

from planner import NotSmooth, PiecewiseCubic, plan
from planner.verify import check_rest, check_smooth


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
def test_what_is_left_of_a_rate_at_an_end_is_named(six_axis_limits, column, quantity, at_end):
    with pytest.raises(NotSmooth) as refusal:
        check_rest(moving(column, 1e-3, at_end), six_axis_limits)
    assert (refusal.value.joint, refusal.value.time) == (3, 2.0 if at_end else 0.0)
    assert refusal.value.quantity in (quantity, "velocity")


def test_a_rate_that_is_no_number_is_refused(six_axis_limits):
    with pytest.raises(NotSmooth):
        check_rest(moving(1, np.nan, False), six_axis_limits)


def test_every_plan_is_at_rest_and_smooth(six_axis_limits, random_points):
    for seed in range(10):
        motion = plan(random_points(seed), six_axis_limits)
        check_rest(motion, six_axis_limits)
        check_smooth(motion, six_axis_limits)
