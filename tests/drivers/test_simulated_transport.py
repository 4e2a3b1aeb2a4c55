from __future__ import annotations

from collections import deque
from time import perf_counter

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers import Corrupt, Duplicate, Lose, SimulatedTransport, TransportClosed
from drivers.transports.faults import Delay, FaultyLink, Reorder
from tests.drivers.transport_contract import TransportContract


class Script:
    """A peer that sends what it is given and nothing for ever after; notes each `accept`."""

    period = 0.002

    def __init__(self, packets=()):
        self.packets = deque(packets)
        self.accepted: list[bytes | None] = []

    def next_packet(self):
        return self.packets.popleft() if self.packets else None

    def accept(self, reply):
        self.accepted.append(reply)


class FarEnd(Script):
    """For the contract: idle cycles while the test has nothing to send."""

    IDLE = b"idle"

    def send(self, packet):
        self.packets.append(packet)

    def next_packet(self):
        return self.packets.popleft() if self.packets else self.IDLE

    def wait(self):
        pass

    @property
    def replies(self):
        return [reply for reply in self.accepted if reply is not None]


class WithoutIdlePackets(SimulatedTransport):
    """A controller has something to send in every cycle; the contract also wants silence."""

    def _next_cycle(self):
        packet = super()._next_cycle()
        return None if packet == FarEnd.IDLE else packet


class TestContract(TransportContract):
    @pytest.fixture
    def link(self):
        far = FarEnd()
        return WithoutIdlePackets(far), far


cycles = st.integers(0, 30)
directions = st.sampled_from(["to_pc", "to_controller"])
counts = st.integers(1, 3)
faults_of_any_kind = st.one_of(
    st.builds(Lose, cycles, directions, counts),
    st.builds(Delay, cycles, directions, counts, seconds=st.floats(1e-5, 0.01)),
    st.builds(Duplicate, cycles, directions, counts),
    st.builds(Reorder, cycles, directions),
    st.builds(Corrupt, cycles, directions, offset=st.just(1), mask=st.just(1)),
)


def packets(count: int) -> list[bytes]:
    return [bytes([index]) * 4 for index in range(count)]


def answer_all(transport, limit: int = 100) -> list[bytes]:
    received = []
    try:
        for _ in range(limit):
            packet = transport.receive(1.0)
            received.append(packet)
            transport.send(b"re:" + packet)
    except TransportClosed:
        pass
    return received


def test_each_packet_is_one_cycle_of_virtual_time():
    transport = SimulatedTransport(Script(packets(3)))
    times = []
    for _ in range(3):
        transport.receive(1.0)
        times.append(transport.now)
    assert times == pytest.approx([0.002, 0.004, 0.006])


def test_time_does_not_drift():
    transport = SimulatedTransport(Script([b"x"] * 100_000))
    for _ in range(100_000):
        transport.receive(1.0)
    assert transport.now == 100_000 * 0.002


def test_waiting_less_than_a_cycle_is_waiting():
    transport = SimulatedTransport(Script(packets(1)))
    assert transport.receive(0.0015) is None
    assert transport.now == pytest.approx(0.0015)
    assert transport.receive(0.001) is not None
    assert transport.now == pytest.approx(0.002)


def test_the_peer_sees_one_answer_or_none_per_cycle():
    peer = Script(packets(4))
    transport = SimulatedTransport(peer)
    for index in range(4):
        transport.receive(1.0)
        if index != 1:
            transport.send(bytes([index]))
    with pytest.raises(TransportClosed):
        transport.receive(1.0)
    assert peer.accepted == [b"\0", None, b"\2", b"\3"]


def test_a_peer_without_more_packets_closes_the_link():
    transport = SimulatedTransport(Script())
    with pytest.raises(TransportClosed, match="no more packets"):
        transport.receive(1.0)


class TestFaults:
    def test_lost_to_the_pc(self):
        peer = Script(packets(5))
        transport = SimulatedTransport(peer, [Lose(1, count=2)])
        assert [packet[0] for packet in answer_all(transport)] == [0, 3, 4]
        assert [reply is None for reply in peer.accepted] == [False, True, True, False, False]
        assert transport.now == pytest.approx(5 * 0.002)

    def test_lost_to_the_controller(self):
        peer = Script(packets(4))
        received = answer_all(SimulatedTransport(peer, [Lose(2, "to_controller")]))
        assert len(received) == 4
        assert [reply is None for reply in peer.accepted] == [False, False, True, False]

    def test_a_loss_longer_than_the_patience_is_silence(self):
        transport = SimulatedTransport(Script(packets(100)), [Lose(0, count=60)])
        assert transport.receive(0.1) is None
        assert transport.now == pytest.approx(0.1)
        assert transport.receive(0.1)[0] == 60

    def test_a_fault_of_a_thousand_million_cycles_costs_no_more_than_one(self):
        began = perf_counter()
        link = FaultyLink([Lose(1, count=1_000_000_000)], 0.001)
        assert link.carry(0, "to_pc", b"x") == [(0.0, b"x")]
        for cycle in (1, 2, 1_000_000_000):
            assert link.carry(cycle, "to_pc", b"x") == []
            assert link.carry(cycle, "to_controller", b"x") == [(0.0, b"x")]
        assert link.carry(1_000_000_001, "to_pc", b"x") == [(0.0, b"x")]
        assert perf_counter() - began < 1.0

    def test_duplicated(self):
        peer = Script(packets(3))
        transport = SimulatedTransport(peer, [Duplicate(1)])
        assert [packet[0] for packet in answer_all(transport)] == [0, 1, 1, 2]
        assert len(peer.accepted) == 3
        assert transport.surplus_replies == [b"re:" + bytes([1]) * 4]

    def test_corrupted_either_way(self):
        peer = Script(packets(3))
        faults = [Corrupt(1, offset=2, mask=0x80), Corrupt(2, "to_controller", offset=0, mask=0x01)]
        received = answer_all(SimulatedTransport(peer, faults))
        assert received[1] == bytes([1, 1, 0x81, 1])
        assert peer.accepted[2] == bytes([ord("r") ^ 1]) + b"e:" + bytes([2]) * 4
        assert received[0] == bytes(4)

    def test_corruption_beyond_the_end_changes_nothing(self):
        assert answer_all(
            SimulatedTransport(Script(packets(1)), [Corrupt(0, offset=99)])
        ) == packets(1)

    def test_answers_doubled_reach_the_controller_once(self):
        peer = Script(packets(3))
        transport = SimulatedTransport(peer, [Duplicate(1, "to_controller")])
        answer_all(transport)
        assert [reply[3] for reply in peer.accepted] == [0, 1, 2]
        assert [reply[3] for reply in transport.surplus_replies] == [1]

    def test_a_silent_controller_sends_nothing_and_is_told_that_nothing_came(self):
        peer = Script([b"a", b"", b"", b"d"])
        transport = SimulatedTransport(peer)
        assert answer_all(transport) == [b"a", b"d"]
        assert peer.accepted == [b"re:a", None, None, b"re:d"]

    @pytest.mark.parametrize(
        ("make", "name"),
        [
            (lambda: Lose(0, count=0), "Lose"),
            (lambda: Lose(-1), "Lose"),
            (lambda: Duplicate(0, count=0), "Duplicate"),
            (lambda: Reorder(-1), "Reorder"),
            (lambda: Corrupt(0, offset=0, mask=0), "Corrupt"),
            (lambda: Corrupt(0, offset=-1), "Corrupt"),
            (lambda: Lose(1_000_000_001), "Lose: cycle is more than"),
            (lambda: Duplicate(0, count=10**20), "Duplicate: count is more than"),
            (lambda: Delay(0), "Delay"),
            (lambda: Delay(0, seconds=-1.0), "Delay"),
            (lambda: Delay(0, seconds=float("nan")), "Delay"),
        ],
    )
    def test_a_fault_that_is_none_is_refused(self, make, name):
        with pytest.raises(ValueError, match=name):
            make()


def arrivals(peer, faults) -> list[tuple[float, int]]:
    """When each packet arrives, in cycles, and which; every one is answered at once."""
    transport = SimulatedTransport(peer, faults)
    seen = []
    try:
        while True:
            packet = transport.receive(1.0)
            seen.append((transport.now / peer.period, packet[0]))
            transport.send(b"re:" + packet)
    except TransportClosed:
        return seen


class TestDelay:
    """Packet k is sent at cycle time k + 1; period 2 ms."""

    def test_within_its_cycle_a_packet_is_late_and_its_answer_in_time(self):
        peer = Script(packets(3))
        seen = arrivals(peer, [Delay(1, seconds=0.0005)])
        assert seen == [pytest.approx((time, which)) for time, which in [(1, 0), (2.25, 1), (3, 2)]]
        assert None not in peer.accepted

    def test_past_its_cycle_the_controller_has_had_no_answer(self):
        peer = Script(packets(4))
        seen = arrivals(peer, [Delay(1, cycles=1.5)])
        assert seen == [pytest.approx(expected) for expected in [(1, 0), (3, 2), (3.5, 1), (4, 3)]]
        # the answer to the late packet comes in the next cycle, which has had its own
        assert [reply and reply[3] for reply in peer.accepted] == [0, None, 2, 3]

    def test_the_answer_to_a_late_packet_meets_the_number_of_the_next_cycle(self):
        peer = Script(packets(4))
        transport = SimulatedTransport(peer, [Delay(1, cycles=1.25), Lose(2)])
        answer_all(transport)
        # what came in cycle 2 was the answer to packet 1: the peer rejects it by its number
        assert [reply and reply[3] for reply in peer.accepted] == [0, None, 1, 3]
        assert transport.surplus_replies == []

    def test_an_answer_may_be_late_within_its_cycle(self):
        peer = Script(packets(3))
        transport = SimulatedTransport(peer, [Delay(1, seconds=0.0019, direction="to_controller")])
        answer_all(transport)
        assert [reply[3] for reply in peer.accepted] == [0, 1, 2]

    @pytest.mark.parametrize("cycles", [1.0, 1.5, 2.0, 7.0])
    def test_an_answer_past_its_cycle_came_too_late(self, cycles):
        peer = Script(packets(10))
        transport = SimulatedTransport(peer, [Delay(1, cycles=cycles, direction="to_controller")])
        answer_all(transport)
        assert [reply and reply[3] for reply in peer.accepted] == [0, None, *range(2, 10)]
        assert transport.late_replies == [b"re:" + bytes([1]) * 4]

    def test_an_overtaken_packet_comes_after_the_next(self):
        peer = Script(packets(5))
        assert [which for _, which in arrivals(peer, [Reorder(1)])] == [0, 2, 1, 3, 4]
        assert [reply and reply[3] for reply in peer.accepted] == [0, None, 2, 3, 4]

    def test_an_overtaken_answer_is_none(self):
        peer = Script(packets(4))
        transport = SimulatedTransport(peer, [Reorder(1, "to_controller")])
        answer_all(transport)
        assert [reply and reply[3] for reply in peer.accepted] == [0, None, 2, 3]
        assert len(transport.late_replies) == 1

    def test_patience_shorter_than_the_delay_is_silence(self):
        transport = SimulatedTransport(Script([b"x", *[b""] * 50]), [Delay(0, seconds=0.05)])
        assert transport.receive(0.04) is None
        assert transport.now == pytest.approx(0.04)
        assert transport.receive(0.04) == b"x"
        assert transport.now == pytest.approx(0.052)

    @given(st.lists(faults_of_any_kind, max_size=12), st.floats(1e-4, 0.02))
    def test_whatever_goes_wrong_time_goes_on_and_each_cycle_has_one_answer(self, faults, patience):
        peer = Script(packets(30))
        transport = SimulatedTransport(peer, faults)
        before = 0.0
        try:
            while True:
                packet = transport.receive(patience)
                assert transport.now >= before
                before = transport.now
                if packet is not None:
                    transport.send(b"re:" + packet)
        except TransportClosed:
            pass
        assert len(peer.accepted) == 30
        answered = [reply for reply in peer.accepted if reply is not None]
        assert len(answered) + len(transport.surplus_replies) + len(transport.late_replies) <= 60


class TestFaultyLink:
    def test_without_a_fault_everything_arrives_at_once(self):
        assert FaultyLink([], 0.001).carry(5, "to_pc", b"x") == [(0.0, b"x")]

    def test_faults_of_one_packet_add_up(self):
        link = FaultyLink([Delay(3, cycles=2.0), Delay(3, seconds=0.5), Duplicate(3)], 0.25)
        assert link.carry(3, "to_pc", b"x") == [(1.0, b"x")] * 2
        assert link.carry(3, "to_controller", b"x") == [(0.0, b"x")]

    def test_a_lost_packet_is_lost_whatever_else_befalls_it(self):
        assert FaultyLink([Duplicate(3), Lose(3)], 0.001).carry(3, "to_pc", b"x") == []

    def test_nothing_sent_is_nothing_carried(self):
        assert FaultyLink([Duplicate(3)], 0.001).carry(3, "to_pc", b"") == []


def test_nothing_is_aged_or_discarded_below_the_session():
    transport = SimulatedTransport(Script(packets(1)))
    transport.receive(1.0)
    transport.forget_peer()
    assert transport.ages is None
    assert transport.rejected() == {}
