from __future__ import annotations

from collections import deque

import pytest
from transport_contract import TransportContract

from drivers import Corrupt, Duplicate, Lose, SimulatedTransport, TransportClosed


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

    def test_duplicated(self):
        peer = Script(packets(3))
        transport = SimulatedTransport(peer, [Duplicate(1)])
        assert [packet[0] for packet in answer_all(transport)] == [0, 1, 1, 2]
        assert len(peer.accepted) == 3
        assert transport.surplus_replies == [b"re:" + bytes([1]) * 4]

    def test_corrupted_either_way(self):
        peer = Script(packets(3))
        faults = [Corrupt(1, 2, 0x80), Corrupt(2, 0, 0x01, "to_controller")]
        received = answer_all(SimulatedTransport(peer, faults))
        assert received[1] == bytes([1, 1, 0x81, 1])
        assert peer.accepted[2] == bytes([ord("r") ^ 1]) + b"e:" + bytes([2]) * 4
        assert received[0] == bytes(4)

    def test_corruption_beyond_the_end_changes_nothing(self):
        assert answer_all(SimulatedTransport(Script(packets(1)), [Corrupt(0, 99)])) == packets(1)

    @pytest.mark.parametrize(
        "make", [lambda: Lose(0, count=0), lambda: Corrupt(0, 0, 0), lambda: Corrupt(0, -1)]
    )
    def test_a_fault_that_is_none_is_refused(self, make):
        with pytest.raises(ValueError, match=r"Lose|Corrupt"):
            make()
