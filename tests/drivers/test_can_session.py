"""Whole sessions over CAN: session, loop, frames, bus, and the simulated NS 16 at the far end."""

from __future__ import annotations

import queue

import numpy as np
import pytest

from drivers import CycleRing, GapSeen, Guard, MotionEnded, PacketRejected, Session, State, exchange
from drivers.transports.can.transport import CanSpec
from sim_fixtures.can_end import open_far_end
from tests.drivers.can_bench import (
    HOME,
    PROFILES,
    Cycles,
    N,
    PacedByPackets,
    ns16_controller,
    ns16_train,
    virtual_ends,
    wide_limits,
)
from tests.drivers.can_run import MOVE, PERIOD, Run
from tests.drivers.slcan_adapter import SlcanBus


@pytest.fixture(scope="module", params=PROFILES)
def run(request):
    return Run(request.param)


def test_a_whole_motion_completes(run):
    (ended,) = run.seen(MotionEnded)
    assert ended.outcome == "completed", ended.reason
    assert run.session.state is State.ENDED
    assert None not in run.link.replies
    assert run.controller.rejected_replies == 0
    assert not run.seen(GapSeen)
    assert not run.seen(PacketRejected)


def test_the_arm_is_where_the_motion_led_it(run):
    np.testing.assert_allclose(run.controller.plant.position, HOME + MOVE, atol=1e-3)


def test_what_is_fresh_and_how_old_the_rest_is_stands_in_every_record(run):
    moving = run.records[run.records["interval"] >= 0]
    assert (moving["age"][:, [0, 2, 3, 4]] == 0).all()
    slow = moving["age"][:, [1, 5, 6, 7]]
    assert slow.max() == 24, "25 slow values take turns, so the oldest is 24 cycles old"
    assert slow.min() >= 5, "of six joints' values the oldest was sent five turns ago at least"


def test_slow_values_are_not_known_before_their_first_turn(run):
    first = run.records[0]
    assert (first["age"][[1, 5, 6, 7]] == 0xFFFF).all()
    assert np.isnan(first["model_current"][1:]).all()
    assert np.isfinite(run.records[30]["model_current"]).all()


@pytest.mark.parametrize("profile", PROFILES)
def test_a_motion_survives_lost_cycles(profile):
    run = Run(profile, lost=range(60, 2000, 7), missed_replies=5)
    (ended,) = run.seen(MotionEnded)
    assert ended.outcome == "completed", ended.reason
    assert len(run.seen(GapSeen)) > 10


@pytest.mark.parametrize("profile", PROFILES)
def test_mode_5_moves_too(profile):
    (ended,) = Run(profile, mode=5).seen(MotionEnded)
    assert ended.outcome == "completed", ended.reason


@pytest.mark.slow
@pytest.mark.parametrize("profile", PROFILES)
def test_a_whole_session_over_two_serial_adapters(profile):
    bus = SlcanBus()
    options = {"sleep_after_open": 0.0}
    ends = (
        CanSpec("slcan", bus.ports[0], profile, period=PERIOD, options=options).open(),
        open_far_end(CanSpec("slcan", bus.ports[1], profile, period=PERIOD, options=options)),
    )
    run = Run(profile, ends=ends, cycles=250, missed_replies=50)
    bus.close()
    (ended,) = run.seen(MotionEnded)
    assert ended.outcome == "completed", ended.reason
    assert bus.refused == []


class Overflowing(queue.Queue):
    """The kernel's receive queue: what finds it full is dropped, and nobody is told."""

    ROOM = 7

    def put(self, item, block=True, timeout=None):
        if self.qsize() < self.ROOM:
            super().put(item, block, timeout)


@pytest.mark.parametrize("profile", PROFILES)
def test_a_receiver_too_slow_for_the_bus_loses_frames_and_sees_gaps_in_the_numbers(profile):
    clock = Cycles()
    near, far = virtual_ends(profile, clock)
    bus = near._port._bus
    session = Session(ns16_train(), Guard(wide_limits(), PERIOD), CycleRing(N, 64))
    link = PacedByPackets(near, far, ns16_controller(cold_start=False), clock=clock)
    exchange(link, session, until=lambda: link.cycle == 40)
    session.events()
    full = Overflowing()
    bus.channel[bus.channel.index(bus.queue)] = full
    bus.queue = full
    for _ in range(10):
        far.send(link.controller.next_packet())
        link.controller.accept(None)
    exchange(link, session, until=lambda: link.cycle == 60)
    gaps = [event for event in session.events() if isinstance(event, GapSeen)]
    assert sum(gap.missed for gap in gaps) >= 6, "room for three sets of ten at most"
    assert session.counters.malformed == 0
    link.close()
