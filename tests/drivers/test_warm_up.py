"""Cycles of a session beside the real one, before each packet."""

from __future__ import annotations

import os

import numpy as np
import pytest

from drivers import CyclicPacket, Mode, State
from drivers.c4g_packets import LAST_NUMBER
from drivers.exchange.loop import exchange
from drivers.exchange.warm_up import LEAD_SECONDS, WarmUp, may_poll
from tests.drivers.rig import PERIOD, N, Rig, closed, drive_train, limits, moving

pytestmark = pytest.mark.safety

ARRIVED = 5.0
AT_PACKET = pytest.approx(PERIOD - LEAD_SECONDS)


class Packets:
    """A link that receives what it sends, for those who do not wait before."""

    def __init__(self):
        self.now = 0.0
        self.packets = []
        self.received = []

    def receive(self, timeout):
        if not self.packets:
            return None
        self.received.append(self.packets.pop(0))
        return self.received[-1]

    def send(self, packet):
        self.packets.append(packet)

    def rejected(self):
        return {}

    def forget_peer(self):
        pass

    def close(self):
        pass


class Link(Packets):
    """A link whose clock shows `now`, and to which a packet comes at time `comes`."""

    def __init__(self, now=ARRIVED, comes=ARRIVED + 2.0 * PERIOD):
        super().__init__()
        self.now = now
        self.comes = comes
        self.waits = []
        self.polls_until = -np.inf

    def loopback(self):
        return Packets()

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
    lower = np.linspace(-3.0, -1.0, N)
    upper = np.linspace(1.0, 2.5, N)
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
    link = Link(now=ARRIVED + PERIOD - 0.5 * LEAD_SECONDS)
    warm_up.before_packet(link, moving()[0].session, ARRIVED)
    assert cycles() == 0
    assert link.waits == []


def test_without_open_axes_nothing_is_run(warm_up, cycles):
    link = Link()
    warm_up.before_packet(link, closed().session, ARRIVED)
    assert cycles() == 0
    assert link.waits == []


def test_a_link_that_cannot_wait_without_reading_is_read_at_once(warm_up, cycles):
    warm_up.before_packet(Packets(), moving()[0].session, ARRIVED)
    assert cycles() == 0


@pytest.mark.parametrize("polls", [True, False])
def test_the_link_polls_until_the_packet_is_overdue(warm_up, polls):
    link = Link()
    warm_up.polls = polls
    warm_up.before_packet(link, moving()[0].session, ARRIVED)
    assert link.polls_until == (ARRIVED + PERIOD + LEAD_SECONDS if polls else -np.inf)


def test_the_packet_of_the_cycle_passes_a_link_of_its_own():
    link = Packets()
    warm_up = WarmUp(drive_train(), limits(), PERIOD, link)
    link.received.clear()
    warm_up.cycle()
    (packet,) = link.received
    assert CyclicPacket.decode(packet, N).axes["mode"].tolist() == [Mode.POSITION] * N
    assert link.packets == []


def test_packets_lost_on_that_link_do_not_matter(warm_up):
    """A firewall may reject what a computer sends to itself."""
    link = Packets()
    link.receive = lambda timeout: None
    warm_up = WarmUp(drive_train(), limits(), PERIOD, link)
    assert warm_up.session.state is State.OPEN


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
        link.now += shares[len(calls)] * LEAD_SECONDS
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


class PacketsAt(Packets):
    """A link that gives packets at these times, then is at its end."""

    def __init__(self, *packets):
        super().__init__()
        self.packets = list(packets)

    def receive(self, timeout):
        if not self.packets:
            return None
        self.now, packet = self.packets.pop(0)
        return packet

    def send(self, packet):
        self.now += 1e-4


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
