"""What the PC's end has to do on every CAN bus; a test of one subclasses this."""

from __future__ import annotations

import numpy as np

from drivers import CyclicPacket
from drivers.packets import next_number
from sim_fixtures.can_end import CanFarEnd
from tests.drivers.can_bench import init_packet, random_packet
from tests.drivers.transport_contract import TransportContract


class Far:
    """The contract's far end around ours."""

    def __init__(self, end: CanFarEnd) -> None:
        self.end = end
        self.replies: list[bytes] = []

    def send(self, packet: bytes) -> None:
        self.end.send(packet)

    def wait(self) -> None:
        reply = self.end.receive(2.0)
        assert reply is not None
        self.replies.append(reply)


class CanContract(TransportContract):
    """The contract of every transport, and what the cyclic frames have to do besides."""

    def test_cyclic_packets_go_both_ways_once_an_init_has_passed(self, link):
        near, far = link
        # Cycles so long that no pause of this machine tears the frames of one apart.
        begin = init_packet(sample_time=100)
        far.send(begin)
        init = near.receive(2.0)
        assert init == begin
        near.send(init)
        far.wait()
        rng = np.random.default_rng(1)
        for number in (11, 12, 13):
            sent = random_packet(rng, number)
            far.send(sent)
            received = CyclicPacket.decode(near.receive(2.0), 6)
            wanted = CyclicPacket.decode(sent, 6)
            assert received.number == number
            assert received.status == wanted.status
            for column in (0, 2, 4):
                np.testing.assert_array_equal(
                    received.axes["d"][:, column], wanted.axes["d"][:, column]
                )
            axes = wanted.axes.copy()
            axes["d"][:, 1:] = axes["extra"] = 0.0
            reply = CyclicPacket(next_number(number), bytes(4), bytes(4), axes).encode()
            near.send(reply)
            far.wait()
            arrived = CyclicPacket.decode(far.replies[-1], 6)
            np.testing.assert_array_equal(arrived.axes["d"][:, 0], axes["d"][:, 0])
            assert arrived.number == next_number(number)
        assert near.rejected() == {}
