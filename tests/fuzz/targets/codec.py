"""Packets and CAN frames: decoded, or refused by a `PacketError`, and encoded as they were."""

from __future__ import annotations

import numpy as np

from drivers import CyclicPacket, InitPacket
from drivers.errors import DriverError, PacketError
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
from drivers.transports.can.ends import ControllerEnd, PcEnd
from drivers.transports.can.layout import SEGMENT_DOWN, SEGMENT_UP, Frame
from tests.fuzz.draw import Draw
from tests.fuzz.mutate_bytes import mutate_bytes
from tests.fuzz.targets import Target

CYCLES = 12  # of one conversation by CAN
RATES = (BusRates("classic", 1_000_000, 1_000_000), BusRates("fd", 1_000_000, 5_000_000))


def run(data: bytes) -> None:
    """The first byte says what the others are."""
    draw = Draw(data)
    kind = draw.below(4)
    if kind == 0:
        cyclic(draw)
    elif kind == 1:
        init(draw.rest())
    elif kind == 2:
        numbers(draw.rest())
    else:
        frames(draw)


def cyclic(draw: Draw) -> None:
    """What is decoded encodes to the same bytes, less an unused tail."""
    n_axes = draw.below(MAX_AXES + 1)
    packet = draw.rest()
    try:
        decoded = CyclicPacket.decode(packet, n_axes)
    except PacketError:
        return
    assert decoded.encode() == packet[: cyclic_length(n_axes)]
    again = CyclicPacket.decode(decoded.encode(), n_axes)
    assert again.axes.tobytes() == decoded.axes.tobytes()
    assert 1 <= next_number(decoded.number) <= 0x7FFF


def init(packet: bytes) -> None:
    """An init packet gives back its bytes; what it says of axes is a map or refused."""
    packet = packet.ljust(INIT_LENGTH, b"\0") if len(packet) > 64 else packet
    try:
        decoded = InitPacket.decode(packet)
    except PacketError:
        return
    assert is_init(packet)
    assert decoded.encode() == packet
    assert echo(packet)[4:] == packet[4:]
    try:
        axes = decoded.open_axes()
    except PacketError:
        return
    assert [axis.slot for axis in axes] == list(range(decoded.n_axes))
    assert all(1 <= axis.arm <= 4 and 0 <= axis.axis < 10 for axis in axes)
    for arm in range(1, 5):
        decoded.wrist_coupling(arm)
    assert decoded.period == decoded.sample_time / 1000


def numbers(packet: bytes) -> None:
    """Any bytes have a number or none, and an echo with the next one."""
    try:
        number = packet_number(packet)
    except PacketError:
        return
    answer = echo(packet)
    assert len(answer) == len(packet)
    assert packet_number(answer) == next_number(number)


def frames(draw: Draw) -> None:
    """Both ends of a CAN link: packets there and back, frames lost, repeated, changed, foreign."""
    rates, n_axes = draw.choice(RATES), draw.between(1, 6)
    pc, controller = PcEnd(rates), ControllerEnd(rates)
    time, number = 0.0, 10
    started = InitPacket.build(n_axes, draw.choice((2, 1)), {}).encode()
    _carried(controller, pc, started, draw, time)
    for _ in range(CYCLES):
        if not draw.left:
            return
        time += draw.choice((0.002, 0.002, 0.0, 0.05, 2.0))
        number = next_number(number)
        made = CyclicPacket.zeros(number, n_axes)
        block = draw.raw(draw.choice((0, 36, 36 * n_axes))).ljust(36 * n_axes, b"\0")
        axes = np.frombuffer(block, made.axes.dtype)
        status = bytes((draw.choice((5, 0, 1)), 0, 0, 0))
        packet = CyclicPacket(number, status, bytes(4), axes).encode()
        got = _carried(controller, pc, packet, draw, time)
        if got is not None:
            _answered(controller, pc, got, n_axes, draw, time)


def _carried(
    controller: ControllerEnd, pc: PcEnd, packet: bytes, draw: Draw, time: float
) -> bytes | None:
    """A packet through frames; whole and unchanged if no frame was."""
    try:
        sent = controller.packet(packet)
    except (DriverError, ValueError):
        return None
    received, touched = _harmed(sent, draw)
    got = None
    for frame in received:
        try:
            made = pc.receive(frame, time)
        except DriverError:
            made = None
        got = got if made is None else made
    if controller.segmented and got is not None and not touched:
        assert got == packet, "segments carry every byte"
    if got is not None and not touched:
        packet_number(got)
    return got


def _answered(
    controller: ControllerEnd, pc: PcEnd, packet: bytes, n_axes: int, draw: Draw, time: float
) -> None:
    try:
        received = CyclicPacket.decode(packet, n_axes)
    except PacketError:
        return
    axes = received.axes.copy()
    if draw.chance(128):
        axes["mode"] = draw.choice((0, 4, 505, 508, 7, 1))
        axes["d"][:, 0] = draw.float32()
    answer = CyclicPacket(next_number(received.number), bytes(4), bytes(4), axes).encode()
    try:
        sent = pc.reply(answer)
    except (DriverError, ValueError):
        sent = pc.drive_off()
    received_frames, touched = _harmed(sent, draw)
    for frame in received_frames:
        reply = controller.receive(frame, time)
        if reply is not None and not touched:
            assert reply[:4] == answer[:4], "an answer to another packet"


def _harmed(sent: list[Frame], draw: Draw) -> tuple[list[Frame], bool]:
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
    stranger = Frame(draw.choice((SEGMENT_UP, SEGMENT_DOWN, draw.below(2048))), draw.raw(8))
    return [*sent[:at], stranger, *sent[at:]], True


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
        bytes((3, 0, 1)) + bytes(120),
        bytes((3, 1, 5)) + bytes(400),
    ]


TARGET = Target(run, seeds, mutate_bytes, most=1300, replayed=400)
