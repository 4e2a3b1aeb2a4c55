"""Captured conversations, kept as raw packets in an archive, come out as they were."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from drivers import CyclicPacket, InitPacket
from drivers.packets import INIT_LENGTH
from drivers.record import PacketRing
from drivers.transports import SimulatedTransport
from drivers.transports.tapped import TappedTransport
from hil.archive import ArchiveWriter, open_archive
from hil.archive.schema import PACKETS
from tests.drivers import oracle
from tests.drivers.captures import CAPTURES, conversation

SEVEN_AXES = "s_TestMode4_movement_7ax_stagger"


class Replayed:
    """A controller that sends what was captured and hears what was answered."""

    period = 0.001

    def __init__(self, packets: list[bytes]) -> None:
        self._packets = iter(packets)

    def next_packet(self) -> bytes | None:
        return next(self._packets, None)

    def accept(self, reply: bytes | None) -> None:
        pass


def archived(path: Path, pairs: list[tuple[bytes, bytes | None]]) -> list[tuple[bool, bytes]]:
    """The packets of a conversation after a while in an archive: whether sent, and bytes."""
    ring, cycle = PacketRing(2 * len(pairs)), 0
    link = TappedTransport(SimulatedTransport(Replayed([p for p, _ in pairs])), ring, lambda: cycle)
    for _, answer in pairs:
        link.receive(1.0)
        if answer is not None:
            link.send(answer)
        link.settle()
        cycle += 1
    with ArchiveWriter(
        path, joint_names=["a"], period=0.001, metadata={}, durable=False, packets=True
    ) as archive:
        archive.add_packets(ring.drain())
        archive.flush()
        archive.close("completed")
    columns = open_archive(path, topics=[PACKETS]).columns
    return [
        (bool(sent), data[:length].tobytes())
        for sent, data, length in zip(
            *(columns[name] for name in ("sent", "data", "length")), strict=True
        )
    ]


@pytest.mark.parametrize("name", CAPTURES)
def test_bytes_and_values_are_those_of_the_capture(
    tmp_path: Path, shared_data: Path, name: str
) -> None:
    pairs = conversation(shared_data, name)
    packets = archived(tmp_path / "excitation_000_a1.mcap", pairs)
    expected = [
        (sent, data) for pair in pairs for sent, data in enumerate(pair) if data is not None
    ]
    assert packets == expected
    n = 7 if name == SEVEN_AXES else InitPacket.decode(_init(pairs)).n_axes
    for _, data in packets:
        if len(data) == INIT_LENGTH:
            continue
        packet, theirs = CyclicPacket.decode(data, n), oracle.parse(data, n)
        assert packet.number == theirs.number
        for axis, their in zip(packet.axes, theirs.axes, strict=True):
            assert axis["mode"] == their.mode
            values = np.concatenate([axis["d"], axis["extra"]])
            assert values.tobytes() == b"".join(their.d)


def _init(pairs: list[tuple[bytes, bytes | None]]) -> bytes:
    return next(packet for packet, _ in pairs if len(packet) == INIT_LENGTH)
