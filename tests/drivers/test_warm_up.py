"""Cycles of a session beside the real one, before each packet."""

from __future__ import annotations

import os
from dataclasses import dataclass, field

import numpy as np
import pytest

from drivers import CyclicPacket, Mode, State
from drivers.exchange.loop import exchange
from drivers.exchange.warm_up import LEAD, WarmUp, may_poll
from drivers.packets import LAST_NUMBER
from tests.drivers.rig import PERIOD, N, Rig, closed, drive_train, limits, moving

pytestmark = pytest.mark.safety

ARRIVED = 5.0
AT_PACKET = pytest.approx(PERIOD - LEAD)


@dataclass
class Link:
    """A link whose clock shows `now`, and to which a packet comes at time `comes`."""

    now: float = ARRIVED
    comes: float = ARRIVED + 2.0 * PERIOD
    waits: list[float] = field(default_factory=list)

    def wait(self, timeout: float) -> bool:
        self.waits.append(timeout)
        # Asking takes time, too.
        self.now = min(self.comes, self.now + timeout) + 1e-6
        return self.now > self.comes


@pytest.fixture(scope="module")
def warm_up():
    return WarmUp(drive_train(), limits(), PERIOD)


@pytest.fixture
def cycles(warm_up):
    """Returns how many cycles were run since."""
    before = warm_up.session.counters.replied
    warm_up.polls = False
    return lambda: warm_up.session.counters.replied - before


@pytest.mark.parametrize("period", [0.001, 0.002])
def test_it_holds_the_middle_of_the_range_in_open_mode(period):
    lower, upper = np.linspace(-3.0, -1.0, N), np.linspace(1.0, 2.5, N)
    warm_up = WarmUp(drive_train(), limits(lower=lower, upper=upper), period)
    assert warm_up.session.state is State.OPEN
    answer = CyclicPacket.decode(warm_up.reply, N)
    assert (answer.axes["mode"] == Mode.POSITION).all()
    reported = drive_train().joint_position(answer.axes["d"][:, 0].astype(float))
    np.testing.assert_allclose(reported, 0.5 * (lower + upper), atol=1e-6)


def test_it_stays_open_when_the_numbers_begin_again(warm_up):
    for _ in range(LAST_NUMBER + 10):
        warm_up.cycle()
    assert warm_up.session.state is State.OPEN
    assert warm_up.session.events() == []


def test_one_cycle_is_run_shortly_before_the_packet_is_due(warm_up, cycles):
    link = Link()
    warm_up.before_packet(link, moving()[0].session, ARRIVED)
    assert cycles() == 1
    assert link.waits == [AT_PACKET]


def test_a_packet_that_comes_early_finds_no_cycle_begun(warm_up, cycles):
    link = Link(comes=ARRIVED + 0.5 * PERIOD)
    warm_up.before_packet(link, moving()[0].session, ARRIVED)
    assert cycles() == 0


def test_after_a_long_reply_the_packet_is_awaited_at_once(warm_up, cycles):
    link = Link(now=ARRIVED + PERIOD - 0.5 * LEAD)
    warm_up.before_packet(link, moving()[0].session, ARRIVED)
    assert cycles() == 0
    assert link.waits == []


def test_without_open_axes_nothing_is_run(warm_up, cycles):
    link = Link()
    warm_up.before_packet(link, closed().session, ARRIVED)
    assert cycles() == 0
    assert link.waits == []


def test_a_link_that_cannot_wait_without_reading_is_read_at_once(warm_up, cycles):
    warm_up.before_packet(object(), moving()[0].session, ARRIVED)
    assert cycles() == 0


@pytest.mark.parametrize("late", [-0.5, 0.5])
def test_polling_ends_with_the_packet(warm_up, late):
    link = Link(comes=ARRIVED + PERIOD + late * LEAD)
    warm_up.polls = True
    warm_up.before_packet(link, moving()[0].session, ARRIVED)
    assert link.waits[0] == AT_PACKET
    assert set(link.waits[1:]) == {0.0}
    assert link.now == pytest.approx(link.comes, abs=1e-5)


def test_polling_ends_where_no_packet_comes(warm_up):
    link = Link()
    warm_up.polls = True
    warm_up.before_packet(link, moving()[0].session, ARRIVED)
    assert link.now == pytest.approx(ARRIVED + PERIOD + LEAD, abs=1e-5)


def test_polling_lets_threads_of_its_priority_run(warm_up, monkeypatch):
    """Such as that of the network card's interrupt, without which no packet comes."""
    link = Link()

    def deliver():
        link.comes = link.now

    monkeypatch.setattr(os, "sched_yield", deliver)
    warm_up.polls = True
    warm_up.before_packet(link, moving()[0].session, ARRIVED)
    assert link.now == pytest.approx(ARRIVED + PERIOD - LEAD, abs=1e-5)


@pytest.mark.parametrize(
    ("scheduling", "inherited", "now", "polls"),
    [
        ("SCHED_FIFO 50", {0, 1}, {0, 1}, True),
        ("SCHED_FIFO 50", {0, 1}, {1}, True),
        ("SCHED_FIFO 50", {0}, {1}, True),
        ("SCHED_FIFO 50", {0}, {0}, False),
        ("ordinary", {0, 1}, {0, 1}, False),
    ],
    ids=["all", "pinned", "pinned beside the others", "one for all", "no priority"],
)
def test_the_only_processor_is_not_used_to_poll(monkeypatch, scheduling, inherited, now, polls):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: now)
    assert may_poll(scheduling, inherited) is polls


@pytest.mark.parametrize(
    ("shares", "begun"),
    [([1.5] * 6, 3), ([1.5, 1.5, 0.5] * 2, 6), ([0.5] * 6, 6)],
    ids=["a slow processor", "lost turns", "a usual one"],
)
def test_cycles_that_would_delay_replies_are_given_up(monkeypatch, shares, begun):
    """Three in a row that take longer than there is time before the packet."""
    warm_up = WarmUp(drive_train(), limits(), PERIOD)
    calls = []
    link = Link(comes=np.inf)

    def lasting():
        link.now += shares[len(calls)] * LEAD
        calls.append(link.now)

    monkeypatch.setattr(warm_up, "cycle", lasting)
    session = moving()[0].session
    for cycle in range(len(shares)):
        link.now = ARRIVED + cycle * PERIOD
        warm_up.before_packet(link, session, ARRIVED + cycle * PERIOD)
    assert len(calls) == begun


def test_whatever_fails_beside_it_the_session_goes_on(warm_up, monkeypatch):
    def fail():
        raise MemoryError

    monkeypatch.setattr(warm_up, "cycle", fail)
    warm_up.before_packet(Link(), moving()[0].session, ARRIVED)


class PacketsAt:
    """A link that gives packets at these times, then is at its end."""

    def __init__(self, *packets):
        self.packets = list(packets)
        self.now = 0.0

    def receive(self, timeout):
        if not self.packets:
            return None
        self.now, packet = self.packets.pop(0)
        return packet

    def send(self, packet):
        self.now += 1e-4

    def rejected(self):
        return {}

    def forget_peer(self):
        pass


def test_the_exchange_says_when_the_last_packet_arrived():
    rig = Rig()
    link = PacketsAt((1.0, rig.init.encode()), (1.5, CyclicPacket.zeros(11, N).encode()))
    calls = []

    def note(transport, session, arrived):
        assert (transport, session) == (link, rig.session)
        calls.append(arrived)

    exchange(link, rig.session, ends_when=lambda: not link.packets, before_packet=note)
    assert calls == [1.0]
    assert rig.session.counters.replied == 2
