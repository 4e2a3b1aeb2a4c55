"""Packets and CAN frames: decoded, or refused by a `PacketError`, and encoded as they were."""

from __future__ import annotations

import numpy as np

from drivers import CyclicPacket, InitPacket
from drivers.c4g_packets import (
    DRIVE_ON,
    INIT_LENGTH,
    MAX_AXES,
    cyclic_length,
    echo,
    is_init,
    next_number,
    packet_number,
)
from drivers.errors import PacketError
from drivers.transports.can.frames import DOWN, UP, BusRates, CanEndpoint, CanError, Frame
from tests.fuzz.draw import Draw, mutate_bytes
from tests.fuzz.targets import Target

CYCLES = 12  # of one conversation


class Talk:
    """One conversation over CAN; `play` returns whether every packet had its reply."""

    def __init__(self, draw: Draw) -> None:
        self._draw = draw
        self._pc = CanEndpoint(BusRates(), DOWN)
        self._controller = CanEndpoint(BusRates(), UP)
        self._n = draw.between(1, 6)
        self._time = 0.0
        self._untouched = True
        self._sent: set[bytes] = set()

    def play(self) -> bool:
        """Init packet, then cycles until the bytes run out; AssertionError if a law is broken."""
        draw = self._draw
        number = 10
        answered = 0
        init = InitPacket.build(self._n, draw.choice((2, 1)), {}).encode()
        try:
            begun = self._passed(init, self._controller, self._pc)
        except CanError:  # more than this bus carries
            begun = None
        for cycle in range(CYCLES):
            if not draw.left and cycle:
                break
            self._time += draw.choice((0.002, 0.002, 0.0, 0.05, 2.0))
            number = next_number(number)
            got = self._passed(self._packet(number), self._controller, self._pc)
            if got is not None:
                reply = self._passed(self._packet(number), self._pc, self._controller)
                answered += reply is not None
        return begun is not None and answered > 0

    def _packet(self, number: int) -> bytes:
        draw = self._draw
        n = self._n
        block = draw.raw(draw.choice((0, 36, 36 * n))).ljust(36 * n, b"\0")
        axes = np.frombuffer(block, CyclicPacket.zeros(number, n).axes.dtype).copy()
        if draw.chance(128):
            axes["mode"] = draw.choice((0, 4, 5, 7, 501, 10, 1, 8))
        status = bytes((draw.choice((DRIVE_ON, 0, 1, 4)), 0, 0, 0))
        return CyclicPacket(number, status, draw.raw(4).ljust(4, b"\0"), axes).encode()

    def _passed(self, packet: bytes, sender: CanEndpoint, receiver: CanEndpoint) -> bytes | None:
        """The packet as it arrives: to the byte, or not at all where a frame was harmed."""
        frames = sender.frames(packet)
        self._sent.add(packet)
        received, touched = harmed(frames, self._draw)
        self._untouched &= not touched
        made = [receiver.receive(frame, self._time) for frame in received]
        got = [assembled for assembled in made if assembled is not None]
        assert self._sent.issuperset(got), "a packet that nobody sent"
        if self._untouched:
            assert got == [packet]
        return got[-1] if got else None


def harmed(sent: list[Frame], draw: Draw) -> tuple[list[Frame], bool]:
    """The frames as they arrive, and whether anything happened to them."""
    act = draw.below(8)
    if act < 4 or not sent:
        return sent, False
    at = draw.below(len(sent))
    if act == 4:
        return sent[:at] + sent[at + 1 :], True
    if act == 5:
        return sent[: at + 1] + sent[at:], True
    if act == 6:
        frame = sent[at]
        changed = draw.raw(8) + frame.data[8:] if draw.chance(128) else frame.data[: draw.below(9)]
        return [*sent[:at], Frame(frame.id, changed), *sent[at + 1 :]], True
    foreign = Frame(draw.choice((UP, DOWN, draw.below(2048))), draw.raw(8))
    return [*sent[:at], foreign, *sent[at:]], True


GENTLE = np.array((0, 0, 1, 192, 194, 201), np.uint8)
"""Bytes that draw no harm: their last three bits are below four."""


def run(data: bytes) -> bool:
    """The first byte is the kind of the others; return whether they can be read."""
    draw = Draw(data)
    kind = draw.below(4)
    if kind == 0:
        return cyclic(draw)
    if kind == 1:
        return init(draw.rest())
    if kind == 2:
        return numbers(draw.rest())
    draw.below(2)  # as stored inputs have it
    return Talk(draw).play()


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
    """An init packet gives back its bytes; its axes are a map or refused."""
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
