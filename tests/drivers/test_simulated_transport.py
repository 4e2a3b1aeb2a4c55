from __future__ import annotations

from collections import deque
from time import perf_counter

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers import Corrupt, Duplicate, Lose, SimulatedTransport, TransportClosed
from drivers.transports.simulated import Delay, FaultyLink, Reorder
from tests.drivers.transport_contract import TransportContract


class Script:
    """A peer that sends the given packets and records the replies."""

    period = 0.002

    def __init__(self, packets=()):
        self.packets = deque(packets)
        self.accepted: list[bytes | None] = []

    def next_packet(self):
        return self.packets.popleft() if self.packets else None

    def accept(self, reply):
        self.accepted.append(reply)


class FarEnd(Script):
    """For the contract: silent cycles while the test has nothing to send."""

    def next_packet(self):
        return super().next_packet() or b""

    def send(self, packet):
        self.packets.append(packet)

    def wait(self):
        pass

    @property
    def replies(self):
        return [reply for reply in self.accepted if reply is not None]


class TestContract(TransportContract):
    @pytest.fixture
    def link(self):
        far = FarEnd()
        return SimulatedTransport(far), far


def packets(count: int) -> list[bytes]:
    return [bytes([index]) * 4 for index in range(count)]


class TestTime:
    def test_each_packet_is_one_cycle_without_drift(self):
        transport = SimulatedTransport(Script([b"x"] * 100_000))
        for cycle in range(1, 100_001):
            transport.receive(1.0)
            assert transport.now == cycle * 0.002
        assert transport.rejected() == {}
        with pytest.raises(TransportClosed, match="no more packets"):
            transport.receive(1.0)

    @pytest.mark.parametrize(
        ("script", "faults", "waits"),
        [
            (packets(1), [], [(0.0015, 0.0015, None), (0.001, 0.002, 0)]),
            (packets(100), [Lose(0, count=60)], [(0.1, 0.1, None), (0.1, 0.122, 60)]),
            ([b"\0" * 4, *[b""] * 50], [Delay(0, seconds=0.05)],
             [(0.04, 0.04, None), (0.04, 0.052, 0)]),
        ],
        ids=["within a cycle", "loss", "delay"],
    )  # fmt: skip
    def test_timeout_before_the_packet(self, script, faults, waits):
        transport = SimulatedTransport(Script(script), faults)
        for timeout, now, index in waits:
            packet = transport.receive(timeout)
            assert (packet and packet[0]) == index
            assert transport.now == pytest.approx(now)


def on_time(*which: int) -> list[tuple[float, int]]:
    """Packets that arrive in their own cycle; packet k is sent at cycle time k + 1."""
    return [(k + 1.0, k) for k in which]


TO_CONTROLLER = "to_controller"
CASES = {
    "nothing": ([Corrupt(0, offset=99)], on_time(0, 1, 2, 3), [0, 1, 2, 3], [], []),
    "packets lost": ([Lose(1, count=2)], on_time(0, 3), [0, None, None, 3], [], []),
    "answer lost": ([Lose(2, TO_CONTROLLER)], on_time(0, 1, 2, 3), [0, 1, None, 3], [], []),
    "packet doubled": ([Duplicate(1)], on_time(0, 1, 1, 2, 3), [0, 1, 2, 3], [1], []),
    "answer doubled": (
        [Duplicate(1, TO_CONTROLLER)], on_time(0, 1, 2, 3), [0, 1, 2, 3], [1], []),
    "changed": (
        [Corrupt(1, offset=0, mask=0x40), Corrupt(2, TO_CONTROLLER, offset=3, mask=0x20)],
        [(1.0, 0), (2.0, 65), (3.0, 2), (4.0, 3)], [0, 65, 34, 3], [], []),
    "late within its cycle": (
        [Delay(1, seconds=0.0005)], [(1.0, 0), (2.25, 1), *on_time(2, 3)], [0, 1, 2, 3], [], []),
    # The answer comes in the next cycle, which has had its own.
    "past its cycle": (
        [Delay(1, cycles=1.5)], [(1.0, 0), (3.0, 2), (3.5, 1), (4.0, 3)], [0, None, 2, 3], [1], []),
    # What comes in cycle 2 is the answer to packet 1: the peer rejects it by its number.
    "past a lost one": (
        [Delay(1, cycles=1.25), Lose(2)], [(1.0, 0), (3.25, 1), (4.0, 3)], [0, None, 1, 3], [], []),
    "answer late within its cycle": (
        [Delay(1, seconds=0.0019, direction=TO_CONTROLLER)], on_time(0, 1, 2, 3), [0, 1, 2, 3],
        [], []),
    **{f"answer {cycles:g} cycles late": (
        [Delay(1, cycles=cycles, direction=TO_CONTROLLER)], on_time(*range(10)),
        [0, None, *range(2, 10)], [], [1]) for cycles in (1.0, 1.5, 2.0, 7.0)},
    "packet overtaken": (
        [Reorder(1)], [(1.0, 0), (3.0, 2), (3.25, 1), (4.0, 3)], [0, None, 2, 3], [1], []),
    "answer overtaken": (
        [Reorder(1, TO_CONTROLLER)], on_time(0, 1, 2, 3), [0, None, 2, 3], [], [1]),
}  # fmt: skip
"""Faults; when each packet arrives, in cycles, and which; answers by cycle, surplus and late."""


class TestFaults:
    @pytest.mark.parametrize("name", CASES)
    def test_effect(self, name):
        faults, expected, accepted, surplus, late = CASES[name]
        peer = Script(packets(len(accepted)))
        transport = SimulatedTransport(peer, faults)
        seen = []
        with pytest.raises(TransportClosed):
            while True:
                packet = transport.receive(1.0)
                seen.append((transport.now / peer.period, packet[0]))
                transport.send(b"re:" + packet)
        assert seen == [pytest.approx(packet_time) for packet_time in expected]
        for received, replies in zip(
            (peer.accepted, transport.surplus_replies, transport.late_replies),
            (accepted, surplus, late), strict=True,
        ):  # fmt: skip
            assert [reply and reply[3] for reply in received] == replies

    cycles = st.integers(0, 30)
    directions = st.sampled_from(["to_pc", "to_controller"])
    counts = st.integers(1, 3)
    any_fault = st.one_of(
        st.builds(Lose, cycles, directions, counts),
        st.builds(Delay, cycles, directions, counts, seconds=st.floats(1e-5, 0.01)),
        st.builds(Duplicate, cycles, directions, counts),
        st.builds(Reorder, cycles, directions),
        st.builds(Corrupt, cycles, directions, offset=st.just(1), mask=st.just(1)),
    )

    @pytest.mark.safety
    @given(st.lists(any_fault, max_size=12), st.floats(1e-4, 0.02))
    def test_time_increases_and_each_cycle_has_one_reply(self, faults, timeout):
        peer = Script(packets(30))
        transport = SimulatedTransport(peer, faults)
        before = 0.0
        with pytest.raises(TransportClosed):
            while True:
                packet = transport.receive(timeout)
                assert transport.now >= before
                before = transport.now
                if packet is not None:
                    transport.send(b"re:" + packet)
        assert len(peer.accepted) == 30
        answered = [reply for reply in peer.accepted if reply is not None]
        assert len(answered) + len(transport.surplus_replies) + len(transport.late_replies) <= 60

    def test_faults_of_one_packet_add_up(self):
        link = FaultyLink([Delay(3, cycles=2.0), Delay(3, seconds=0.5), Duplicate(3)], 0.25)
        assert link.carry(3, "to_pc", b"x") == [(1.0, b"x")] * 2
        assert link.carry(3, "to_controller", b"x") == [(0.0, b"x")]
        assert FaultyLink([Duplicate(3), Lose(3)], 0.001).carry(3, "to_pc", b"x") == []
        assert FaultyLink([Duplicate(3)], 0.001).carry(3, "to_pc", b"") == []

    def test_fault_of_a_thousand_million_cycles_is_fast(self):
        began = perf_counter()
        link = FaultyLink([Lose(1, count=1_000_000_000)], 0.001)
        assert link.carry(0, "to_pc", b"x") == [(0.0, b"x")]
        for cycle in (1, 2, 1_000_000_000):
            assert link.carry(cycle, "to_pc", b"x") == []
            assert link.carry(cycle, "to_controller", b"x") == [(0.0, b"x")]
        assert link.carry(1_000_000_001, "to_pc", b"x") == [(0.0, b"x")]
        assert perf_counter() - began < 1.0
