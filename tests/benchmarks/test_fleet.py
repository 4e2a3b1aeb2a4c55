"""The benchmark of fleets, on a small one: a fault is found and dated, and nothing else."""

from __future__ import annotations

from typing import get_args

import numpy as np
import pytest

from benchmarks.fleet import EVERY, Fault, Fleet, FleetPlan, Known, planned, watched

LOST = Fault(1, "lubricant", 2, 6.5, 0.25)


@pytest.mark.long
@pytest.mark.parametrize("known", get_args(Known))
def test_a_lost_lubricant_is_found_and_dated(known: Known) -> None:
    outcome = watched(FleetPlan(robots=6, months=10, faults=(LOST,)), known)
    ((fault, month, error),) = outcome.found
    assert fault is LOST
    assert month is not None
    assert 7 <= month <= 9
    assert error < 1.0
    assert outcome.alarms == 0


def test_a_fault_acts_on_its_joint_from_its_month_on() -> None:
    with_fault = Fleet(FleetPlan(robots=2, months=10, faults=(LOST,)))
    without = Fleet(FleetPlan(robots=2, months=10))
    ratio = [
        with_fault.condition(1, month).friction / without.condition(1, month).friction
        for month in (6, 7)
    ]
    np.testing.assert_allclose(ratio, [np.ones(6), [1.0, 1.0, 1.25, 1.0, 1.0, 1.0]])


def test_fleets_are_drawn_with_one_to_three_faults() -> None:
    faults = [planned(seed, faulty=True).faults for seed in range(20)]
    assert {sum(each.robot != EVERY for each in some) for some in faults} == {1, 2, 3}
    assert [any(each.robot == EVERY for each in some) for some in faults] == [False, True] * 10
    assert planned(3, faulty=False).faults == ()
