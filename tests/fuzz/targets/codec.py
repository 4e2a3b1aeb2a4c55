"""Packets and CAN frames: decoded, or refused by a `PacketError`, and encoded as they were."""

from __future__ import annotations

import numpy as np

from drivers import CyclicPacket, InitPacket
from drivers.errors import PacketError
from drivers.packets import (
    INIT_LENGTH,
    MAX_AXES,
    cyclic_length,
    echo,
    is_init,
    next_number,
    packet_number,
)
from drivers.transports.can.bus_load import BusRates
from tests.fuzz.can_talk import Talk
from tests.fuzz.draw import Draw, mutate_bytes
from tests.fuzz.targets import Target

GENTLE = np.array((0, 0, 1, 192, 194, 201), np.uint8)
"""Bytes that draw no harm: their last three bits are below four."""
RATES = (BusRates("classic", 1_000_000, 1_000_000), BusRates("fd", 1_000_000, 5_000_000))


def run(data: bytes) -> bool:
    """The first byte says what the others are; whether they can be read."""
    draw = Draw(data)
    kind = draw.below(4)
    if kind == 0:
        return cyclic(draw)
    if kind == 1:
        return init(draw.rest())
    if kind == 2:
        return numbers(draw.rest())
    return Talk(draw, draw.choice(RATES)).play()


def cyclic(draw: Draw) -> bool:
    """What is decoded encodes to the same bytes, less an unused tail."""
    n_axes = draw.below(MAX_AXES + 1)
    packet = draw.rest()
    try:
        decoded = CyclicPacket.decode(packet, n_axes)
    except PacketError:
        return False
    assert decoded.encode() == packet[: cyclic_length(n_axes)]
    again = CyclicPacket.decode(decoded.encode(), n_axes)
    assert again.axes.tobytes() == decoded.axes.tobytes()
    assert 1 <= next_number(decoded.number) <= 0x7FFF
    return True


def init(packet: bytes) -> bool:
    """An init packet gives back its bytes; what it says of axes is a map or refused."""
    packet = packet.ljust(INIT_LENGTH, b"\0") if len(packet) > 64 else packet
    try:
        decoded = InitPacket.decode(packet)
    except PacketError:
        return False
    assert is_init(packet)
    assert decoded.encode() == packet
    assert echo(packet)[4:] == packet[4:]
    try:
        axes = decoded.open_axes()
    except PacketError:
        return False
    assert [axis.slot for axis in axes] == list(range(decoded.n_axes))
    assert all(1 <= axis.arm <= 4 and 0 <= axis.axis < 10 for axis in axes)
    for arm in range(1, 5):
        decoded.wrist_coupling(arm)
    assert decoded.period == decoded.sample_time / 1000
    return True


def numbers(packet: bytes) -> bool:
    """Any bytes have a number or none, and an echo with the next one."""
    try:
        number = packet_number(packet)
    except PacketError:
        return False
    answer = echo(packet)
    assert len(answer) == len(packet)
    assert packet_number(answer) == next_number(number)
    return True


def seeds() -> list[bytes]:
    """Each kind once, well formed."""
    rng = np.random.default_rng(1)
    packet = CyclicPacket.zeros(11, 6).encode()
    table = InitPacket.build(6, 2, {"gear_ratio": np.ones(6)}).encode()
    return [
        bytes((0, 6)) + packet,
        b"\x01" + table,
        b"\x02" + packet[:48],
        *(bytes((3, k, 5)) + bytes(8) + rng.bytes(200) for k in (0, 1)),
        # Of these no frame is harmed, so that everything must arrive.
        *(
            bytes((3, k, 2, 0, 0)) + rng.choice(GENTLE, 400).tobytes()
            for k in (0, 1)
            for _ in "abc"
        ),
        bytes((3, 0, 1)) + bytes(120),
        bytes((3, 1, 5)) + bytes(400),
    ]


TARGET = Target(run, seeds, mutate_bytes, most=1300, replayed=400)
