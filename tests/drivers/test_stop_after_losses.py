"""After lost replies the motion does not speed up again before it stops."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from drivers import SimulatedTransport, State
from drivers.errors import Check
from drivers.events import RepliesLost
from planner import PiecewiseCubic, TrajectoryPlayer, plan
from sim_fixtures.faults import parse_fault, split_faults
from tests.drivers.losses import FAR, at_speed, lose, planned
from tests.drivers.rig import PERIOD, N, at, limits, resumptions, running
from tests.fault_matrix import faulty_runs, small_cell
from tests.laws.motions import Array, slows_down


class Stopped:
    """A motion of the simulated arm of which replies are lost: its set-points and its rates.

    Args:
        first: cycle of the first lost reply.
        lost: replies lost in a row.
        share: of full speed.
        again: cycles after which two more replies are lost; 0 for never.
        motion: the motion, by default along a straight path.
    """

    def __init__(
        self,
        first: int,
        lost: int,
        share: float,
        again: int,
        motion: TrajectoryPlayer | None = None,
    ) -> None:
        losses = [f"lose@{first}x{lost}:to_controller"]
        if again:
            losses.append(f"lose@{first + lost + again}x2:to_controller")
        faults, _ = split_faults([parse_fault(text) for text in losses])
        cell = faulty_runs.controller("hold", tolerated=10_000)
        self.run = faulty_runs.Run(cell, True, speed=share)
        self.run._over = first
        self.run.transport = SimulatedTransport(cell, faults)
        straight = faulty_runs.motion(np.array(small_cell.HOME), faulty_runs.WAY, share)
        self.motion = motion or straight
        self.run.session.request(self.motion)
        self.rates: list[float] = []
        self.along: list[float] = []
        self.times: list[float] = []
        self.sent: list[Array] = []
        self.run._exchange(self._ended, 4000)

    def _ended(self) -> bool:
        if self.run.session.stop_reason is not None:
            sent = self.run.session._ring.last(1)["commanded_position"][0]
            self.rates.append(self.motion.rate)
            self.times.append(self.motion.motion_time)
            self.sent.append(sent)
            self.along.append(float((sent - small_cell.HOME) @ faulty_runs.WAY))
        return self.run.transport.cycle > 100 and not self.run.session.requested


@pytest.mark.safety
@settings(max_examples=10, deadline=None, phases=(Phase.explicit, Phase.reuse, Phase.generate))
@given(
    late=st.integers(0, 60),
    lost=st.integers(3, 120),
    share=st.sampled_from((0.3, 0.6, 1.0)),
    again=st.sampled_from((0, 1, 4, 30)),
)
def test_it_does_not_speed_up_before_it_stops(late, lost, share, again):
    first = faulty_runs.cycles_without_a_fault(True)["moving"] + late
    stopped = Stopped(first, lost, share, again)
    assert stopped.run.outcome == "" and not stopped.run.session.broken
    assert list(slows_down(stopped.rates, stopped.along)) == []


def curved(share: float) -> PiecewiseCubic:
    """A path round several corners, on which the joints speed up and turn at other times."""
    way = np.array([[0, 0], [0.15, -0.1], [0.3, 0.05], [0.25, 0.3], [0, 0.3], [-0.1, 0.1]])
    limits = replace(faulty_runs.LIMITS, velocity=share * faulty_runs.LIMITS.velocity)
    return plan(small_cell.HOME + way, limits, fly=1.0)


@pytest.mark.safety
@settings(max_examples=15, deadline=None, phases=(Phase.explicit, Phase.reuse, Phase.generate))
@given(
    at=st.floats(0.02, 0.98),
    lost=st.integers(3, 60),
    share=st.sampled_from((0.3, 1.0)),
    again=st.sampled_from((0, 1, 4, 30)),
)
def test_nor_on_a_path_that_turns_and_speeds_up(at, lost, share, again):
    """On its path, each joint at most as fast as planned there times the rate it began with."""
    path = curved(share)
    motion = TrajectoryPlayer(path, faulty_runs.PERIOD, faulty_runs.LIMITS, start_tolerance=5e-3)
    begun = faulty_runs.cycles_without_a_fault(True)["under way"]
    first = begun + round(at * path.duration / faulty_runs.PERIOD)
    stopped = Stopped(first, lost, share, again, motion)
    # "completed": the replies were lost where the motion ended.
    assert stopped.run._fate() in ("stopped", "completed") and not stopped.run.session.broken
    assert list(slows_down(stopped.rates, stopped.times)) == []
    steps = np.diff(stopped.times)
    assert (np.diff(steps[steps > 0.0]) <= 1e-12).all(), "zero where a set-point is sent again"
    sent = np.array(stopped.sent).reshape(-1, faulty_runs.N)
    planned = path.sample(np.minimum(stopped.times, path.duration))[0]
    apart = (sent - planned)[np.isfinite(sent).all(axis=1)]
    assert not apart.size or np.ptp(apart, axis=0).max() < 1e-9


def lose_slowing(lost: int, others: float = 0.95):
    """A motion whose target is held for some cycles, in each of which its joints slow down.

    The first slows down by a factor of 0.95, the others by `others`.
    """
    rig = running(planned(), 60, guard_limits=limits(**FAR))
    follow = rig._follow
    d = rig.axes["d"]

    def brake(answer):
        d[:, 1] = 0.0
        d[0, 3] *= 0.95
        d[1:, 3] *= others

    rig._follow = brake
    rig.cycle(lost)
    rig._follow = follow
    return rig


@pytest.mark.parametrize("lost", [4, 8, 30])
def test_a_stop_begins_with_the_speed_of_the_arm(lost):
    rig = lose_slowing(lost)
    last = rig.records["commanded_position"][-1]
    before = rig.records["commanded_velocity"][-1]
    rig.cycle(2)
    begun, velocity = (rig.records[f"commanded_{name}"][-1] for name in ("position", "velocity"))
    np.testing.assert_allclose(begun - last, velocity * rig.session._guard.period, atol=1e-12)
    share = np.linalg.norm(velocity) / np.linalg.norm(before)
    assert 0.8 * 0.95**lost <= share <= 0.95 ** (lost - 1)
    rig.run_to("stopped")
    assert rig.ended.reason == "3 replies were lost in 100 cycles"


def test_the_joint_that_slowed_down_least_says_how_fast():
    """One that cannot brake as fast as the others must not leave its target behind."""
    rig = lose_slowing(8, others=0.5)
    before = rig.records["commanded_velocity"][-1]
    rig.cycle(2)
    share = np.linalg.norm(rig.records["commanded_velocity"][-1]) / np.linalg.norm(before)
    assert 0.8 * 0.95**8 <= share <= 0.95**7


@pytest.mark.parametrize(("waits", "passes"), [(0, True), (1, False)])
def test_only_the_first_step_of_a_stop_may_be_a_jump(waits, passes):
    """Of acceleration: from the speed of the arm, here none, to that of the source."""
    far = limits(**FAR, acceleration=np.full(N, 80.0))
    rig = at_speed(1200, speed=0.2, guard_limits=far)
    source = rig.session.execution._source
    resumed = resumptions(rig)
    calls = []
    move = source.advance

    def advance():
        if not resumed:
            return move()
        calls.append(len(calls))
        steps = max(0, len(calls) - waits)
        return resumed[0][0] + at(0, 0.2 * PERIOD * steps), at(0, 0.2 * (steps > 0))

    source.advance = advance
    lose(rig, 4)
    rig.cycle(5)
    assert [(speed.any(), cycles) for _, speed, cycles in resumed] == [(False, 0)]
    assert (rig.state is State.OPEN) is passes
    assert passes or rig.refusal.check is Check.JERK


def test_an_arm_at_rest_stays_there():
    rig = running(planned(), 60, guard_limits=limits(**FAR))
    lose(rig, 6)
    last = rig.records["commanded_position"][-1]
    rig.run_to("stopped")
    sent = rig.records["commanded_position"]
    np.testing.assert_array_equal(sent[np.isfinite(sent).all(axis=1)][-1], last)


def test_after_single_losses_it_does_not_go_back():
    rig = running(planned(), 60, guard_limits=limits(**FAR))
    for _ in range(3):
        lose(rig, 1)
        rig.cycle(5)
    sent = rig.records["commanded_position"][:, 0]
    assert sum(event.count for event in rig.seen(RepliesLost)) == 3
    assert (np.diff(sent[-40:]) * np.sign(sent[-1] - sent[-40]) >= -1e-12).all()
