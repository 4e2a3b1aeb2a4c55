"""Whole sessions with the simulated controller in all its variants: modes, arms, slots, lengths."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from drivers import (
    MotionEnded,
    Refused,
    SimulatedTransport,
    exchange,
)
from planner import TrajectoryPlayer, plan
from sim_fixtures import Phase
from tests.fault_matrix import faulty_runs, small_cell
from tests.fault_matrix.faulty_runs import LIMITS

pytestmark = pytest.mark.safety

HOME = np.array(small_cell.HOME)
WAY = np.array([0.3, 0.375])


def run(
    source: Any,
    *,
    mode: int = 4,
    arm: int = 1,
    period: float = 0.001,
    others=frozenset(),
    **settings,
):
    session = faulty_runs.session(
        following_error=small_cell.FOLLOWING_ERROR, period=period, mode=mode, arm=arm,
        other_axes=others,
    )  # fmt: skip
    controller = small_cell.controller(
        open_mode=mode, arm=arm, period=period, open_intervals=1, **settings
    )
    session.request(source)
    link = SimulatedTransport(controller)
    exchange(link, session, ends_when=lambda: link.cycle > 20_000)
    events = session.events()
    refusals = [event.error for event in events if isinstance(event, Refused)]
    ends = [event for event in events if isinstance(event, MotionEnded)]
    assert not refusals, refusals
    assert [end.outcome for end in ends] == ["completed"], ends
    assert controller.phase is Phase.ENDED
    assert controller.rejected_replies == 0
    return controller, session._ring.last(8192)


def move(period: float = 0.001) -> TrajectoryPlayer:
    path = plan(np.vstack((HOME, HOME + WAY)), LIMITS, fly=0.0)
    return TrajectoryPlayer(path, period, LIMITS, start_tolerance=5e-3)


def assert_moved(controller: Any, way: Any = WAY) -> None:
    np.testing.assert_allclose(controller.plant.position, HOME + way, atol=2e-3)


@pytest.mark.parametrize("mode", [4, 5])
@pytest.mark.parametrize("period", [0.001, 0.002])
def test_the_modes_in_which_the_pc_makes_the_targets(mode: int, period: float) -> None:
    controller, _ = run(move(period), mode=mode, period=period)
    assert_moved(controller)


@pytest.mark.parametrize(
    ("arm", "slots", "foreign", "foreign_open"),
    [
        (1, (1, 0), 0, False),
        (1, None, 4, False),
        (1, (5, 2), 4, True),
        (2, (0, 3), 7, True),
        (4, (19, 0), 18, True),
    ],
)
def test_any_arm_in_any_slots_moves_and_no_other(
    arm: int, slots: Any, foreign: int, foreign_open: bool
) -> None:
    arms = [other for other in range(1, 5) if other != arm]
    others = frozenset((arms[axis // 10], axis % 10 + 1) for axis in range(foreign))
    controller, _ = run(
        move(), arm=arm, slots=slots, foreign_axes=foreign, foreign_open=foreign_open,
        others=others,
    )  # fmt: skip
    assert_moved(controller)
    layout = controller._layout
    targets = layout.axes["d"][layout._foreign, 0]
    np.testing.assert_array_equal(targets, np.arange(1.0, 1.0 + foreign) / 4.0)


@pytest.mark.parametrize(
    "settings",
    [
        {"cold_start": False},
        {"long_packets": True},
        {"opening_stagger": 0},
        {"opening_stagger": 40, "closing_stagger": 40},
        {"while_silent": "continue"},
        {"encoder_noise": 0.5, "current_noise": 0.02},
    ],
    ids=str,
)
def test_a_motion_completes_with_every_controller_variant(settings: dict) -> None:
    controller, _ = run(move(), **settings)
    assert_moved(controller)
