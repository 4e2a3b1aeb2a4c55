"""After lost replies an arm does not speed up again before it stops."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from drivers import SimulatedTransport
from drivers.events import RepliesLost
from drivers.open_mode import EXIT_TIMEOUT
from sim_fixtures.faults import parse_fault, split_faults
from tests.drivers.rig import PERIOD, limits, running
from tests.drivers.test_session_losses import FAR, lose, planned
from tests.fault_matrix import faulty_runs, small_cell

DIRECTION = faulty_runs.WAY / np.linalg.norm(faulty_runs.WAY)

KICK = 0.05
"""Share of the planned speed by which the simulated servo's feed-forward of acceleration pushes the
arm where the target, which stood, moves again; at most 0.037 was seen."""


class Stopped:
    """A motion of the simulated arm of which replies are lost, and its speed from the stop on."""

    def __init__(self, first: int, lost: int, share: float, again: int) -> None:
        losses = [f"lose@{first}x{lost}:to_controller"]
        if again:
            losses.append(f"lose@{first + lost + again}x2:to_controller")
        faults, _ = split_faults([parse_fault(text) for text in losses])
        cell = faulty_runs.controller("hold", tolerated=10_000)
        self.run = faulty_runs.Run(cell, True, speed=share)
        self.run._over = first
        self.run.transport = SimulatedTransport(cell, faults)
        self.run.session.request(faulty_runs.motion(np.array(small_cell.HOME), self.way, share))
        self.speed: list[float] = []
        self.run._exchange(self._ended, 1500)

    way = faulty_runs.WAY

    def _ended(self) -> bool:
        if self.run.session.stop_reason is not None:
            self.speed.append(float(self.run.controller.plant.velocity @ DIRECTION))
        return self.run.transport.cycle > 100 and not self.run.session.requested

    @property
    def growth(self) -> float:
        """Largest growth of the speed along the path over its least since the stop, rad/s."""
        speed = np.array(self.speed)
        forward = np.maximum(speed, 0.0)
        return float((forward - np.minimum.accumulate(forward)).max())


@pytest.mark.safety
@settings(max_examples=10, deadline=None, phases=(Phase.explicit, Phase.reuse, Phase.generate))
@given(
    late=st.integers(0, 60),
    lost=st.integers(3, 120),
    share=st.sampled_from((0.3, 0.6, 1.0)),
    again=st.sampled_from((0, 1, 4, 30)),
)
def test_the_arm_does_not_speed_up_before_it_stops(late, lost, share, again):
    """Seen without the rule: by 0.5 to 1.2 of the planned speed after 10 lost replies or more."""
    first = faulty_runs.cycles_without_a_fault(True)["moving"] + late
    seen = Stopped(first, lost, share, again)
    assert seen.run.outcome == "" and not seen.run.session.broken
    assert seen.growth <= KICK * share * np.linalg.norm(small_cell.SPEED)


def lose_slowing(lost: int):
    """A motion whose target is held for some cycles, in each of which the arm loses 5 %."""
    rig = running(planned(), 60, guard_limits=limits(**FAR))
    follow, d = rig._follow, rig.axes["d"]
    rig._follow = lambda answer: d.__setitem__((slice(None), [1, 3]), d[:, [1, 3]] * [0, 0.95])
    rig.cycle(lost)
    rig._follow = follow
    return rig


@pytest.mark.parametrize("lost", [4, 8, 30])
def test_a_stop_begins_at_target_and_speed_of_the_arm(lost):
    rig = lose_slowing(lost)
    held = rig.axes["d"][:, 0].copy()
    answer = rig.cycle()
    begun = answer.axes["d"][:, 0] - answer.axes["d"][:, 1]
    np.testing.assert_allclose(begun, held, atol=2e-5)
    speed = np.linalg.norm(rig.records["commanded_velocity"][-1])
    before = np.linalg.norm(rig.records["commanded_velocity"][-lost])
    assert 0.8 * 0.95**lost * before <= speed <= 0.95**lost * before
    rig.run_to("stopped")
    assert rig.ended.reason == "3 replies were lost in 100 cycles"


def test_an_arm_at_rest_stays_at_the_target_held():
    rig = running(planned(), 60, guard_limits=limits(**FAR))
    lose(rig, 6)
    held = rig.axes["d"][:, 0].copy()
    rig.run_to("stopped")
    np.testing.assert_allclose(rig.axes["d"][:, 0], held, atol=2e-5)


@pytest.mark.safety
def test_a_controller_that_accepts_no_reply_at_rest_is_left():
    """Nothing more is sent than the target that it holds; open mode has to end."""
    rig = running(planned(), 60, guard_limits=limits(**FAR))
    lose(rig, round(EXIT_TIMEOUT / PERIOD) + 300)
    assert rig.ended.outcome == "refused"
    assert type(rig.refusal).__name__ == "ExitTimeout"


def test_a_late_report_is_no_held_target():
    """A target reported a cycle late is not that from which a stop begins: it would go back."""
    rig = running(planned(), 60, guard_limits=limits(**FAR))
    for _ in range(3):
        lose(rig, 1)
        rig.cycle(5)
    sent = rig.records["commanded_position"][:, 0]
    assert sum(event.count for event in rig.seen(RepliesLost)) == 3
    assert (np.diff(sent[-40:]) * np.sign(sent[-1] - sent[-40]) >= -1e-12).all()
