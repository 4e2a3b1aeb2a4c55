"""A CB3 controller, whose cycle is 8 ms: the same program, session and outcomes."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from drivers.exchange.warm_up import WarmUp
from drivers.states import State
from drivers.transports.simulated import Lose
from hil.cell import Cell
from tests.drivers.ur.ur_bench import UrBench, ur_cell

pytestmark = pytest.mark.safety

PERIOD = 0.008
MIDST = 150
"""A cycle within the motion, at speed."""
CB3 = {"controller.cycle_ms": 8, "controller.rtde.model": "UR5"}


@cache
def cb3_cell() -> Cell:
    return ur_cell().with_values(CB3)


def cb3_bench(*faults: str, **settings: object) -> UrBench:
    return UrBench(*faults, cell=cb3_cell(), **settings)


def test_a_motion_arrives_where_it_was_planned_to() -> None:
    bench = cb3_bench().move(by=20.0)
    assert bench.robot.settings.version[0] == 3 and bench.robot.period == PERIOD
    assert (bench.ended.outcome, bench.state) == ("completed", State.CLOSED)
    there = bench.cell.initial + np.radians([20.0, 0, 0, 0, 0, 0])
    assert bench.run(50).robot.arm.plant.position == pytest.approx(there, abs=2e-3)
    assert bench.rests and not bench.robot.playing


def test_the_plan_is_the_one_of_a_shorter_cycle() -> None:
    """Set-points of 8 ms are every fourth of 2 ms."""
    moves = [bench.move().ring.last(4000) for bench in (cb3_bench(), UrBench())]
    sent = [
        records["commanded_position"][np.isfinite(records["commanded_position"]).all(axis=1)][:, 0]
        for records in moves
    ]
    steps = [values[np.flatnonzero(np.diff(values))[0] :] for values in sent]
    moved = [values - values[0] for values in steps]
    short = moved[1][3::4]
    n = min(len(moved[0]) - 1, len(short))
    # The settling before a motion is not a multiple of 8 ms: they begin within a cycle.
    rate = np.abs(np.diff(moved[0])).max()
    assert np.abs(moved[0][1 : n + 1] - short[:n]).max() <= rate


def test_without_the_pc_the_arm_stops_within_20_ms() -> None:
    bench = cb3_bench()
    bench.silent_from = MIDST
    bench.move()
    bench.run(100)
    used = next(k for k in range(MIDST, len(bench.stages)) if bench.stages[k] == 3)
    assert (used - (MIDST + 1)) * PERIOD <= 0.020
    assert bench.rests and not bench.robot.playing
    assert (bench.ended.outcome, "no new set-point" in bench.ended.reason) == ("lost", True)


@pytest.mark.parametrize("direction", ["to_controller", "to_pc"])
@pytest.mark.parametrize(("gap", "outcomes"), [(1, {"completed"}), (2, {"lost", "refused"})])
def test_one_missing_set_point_is_bridged(gap: int, outcomes: set[str], direction: str) -> None:
    bench = cb3_bench(link=[Lose(MIDST, direction, gap)]).move()
    assert bench.ended.outcome in outcomes, bench.ended
    assert bench.run(100).rests and not bench.robot.playing


@pytest.mark.parametrize(
    ("fault", "outcome", "state"),
    [
        ("stop@{c}", "lost", State.FAULTED),
        ("emergency-stop@{c}", "lost", State.DRIVE_OFF),
        ("safeguard@{c}", "lost", State.FREEZING),
        ("halt@{c}", "lost", State.CLOSED),
        ("freedrive@{c}x50", "refused", State.FAULTED),
        ("slider@{c}x50", "refused", State.FAULTED),
        ("push@{c}x300", "lost", State.FAULTED),
    ],
)
def test_what_happens_at_the_controller_ends_the_motion(
    fault: str, outcome: str, state: State
) -> None:
    bench = cb3_bench(fault.format(c=MIDST)).move()
    assert (bench.ended.outcome, bench.state) == (outcome, state), bench.ended
    assert bench.run(100).rests and not bench.robot.playing


def test_the_operator_slows_holds_and_releases_it() -> None:
    bench = cb3_bench()
    bench.run(3)
    bench.session.request(bench.player(by=40.0))
    bench.run(MIDST - 3)
    bench.session.override(0.5)
    bench.run(30)
    bench.session.hold()
    bench.run(150)
    assert bench.rests and bench.state is State.OPEN
    bench.session.resume()
    bench.run(2000, until=lambda: not bench.session.requested)
    assert (bench.ended.outcome, bench.state) == ("completed", State.CLOSED)


def test_warm_up_cycles_are_of_this_controller() -> None:
    cell = cb3_cell()
    warm_up = WarmUp(cell.drive_train, cell.guard_limits, cell.period, protocol=cell.ur_protocol)
    warm_up.cycle()
    assert warm_up.session.state is State.OPEN
