"""What every transport has to do; a test of one subclasses this and has a fixture `link`.

The fixture gives a transport (`Transport`) and the controller's end (`FarEnd`).

The controller's end is driven by the test: `far.send` lets the controller send a packet, and
`far.replies` is what reached it, in order. `far.wait` gives real links the time they need.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
import pytest

from drivers import TransportClosed

PATIENCE = 5.0


class FarEnd(Protocol):
    replies: list[bytes]

    def send(self, packet: bytes) -> None: ...

    def wait(self) -> None: ...


class TransportContract:
    @pytest.mark.parametrize("length", [12, 48, 228, 732, 1200])
    def test_packets_and_replies_arrive_unchanged(self, link, length):
        near, far = link
        packet = (bytes(range(256)) * 5)[:length]
        far.send(packet)
        assert near.receive(PATIENCE) == packet
        near.send(b"answer" * 10)
        far.wait()
        assert far.replies == [b"answer" * 10]
        assert near.rejected() == {}

    def test_packets_arrive_in_order(self, link):
        near, far = link
        for number in range(5):
            far.send(bytes([number]) * 48)
        received = [near.receive(PATIENCE) for _ in range(5)]
        assert received == [bytes([number]) * 48 for number in range(5)]

    def test_no_packet_is_none_after_the_timeout(self, link):
        near, far = link
        before = near.now
        assert near.receive(0.05) is None
        assert near.now - before >= 0.05 * (1.0 - 1e-9)
        times = []
        for _ in range(5):
            far.send(bytes(48))
            near.receive(PATIENCE)
            times.append(near.now)
            assert near.receive(0.0) is None
            times.append(near.now)
        assert times == sorted(times)
        assert min(np.diff(times)[::2]) < 0.01, "no wait"

    def test_forgotten_peer_is_received_again(self, link):
        near, far = link
        far.send(bytes(48))
        near.receive(PATIENCE)
        near.forget_peer()
        far.send(bytes(range(84)))
        assert near.receive(PATIENCE) == bytes(range(84))
        near.send(b"answer" * 10)
        far.wait()
        assert far.replies[-1] == b"answer" * 10

    def test_closed_link_raises(self, link):
        near, _ = link
        near.close()
        near.close()
        with pytest.raises(TransportClosed):
            near.receive(0.0)
        with pytest.raises(TransportClosed):
            near.send(bytes(48))
