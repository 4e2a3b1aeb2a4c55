"""Packets and CAN frames: decoded, or refused by a `PacketError`, and encoded as they were."""

from __future__ import annotations

import numpy as np

from drivers import CyclicPacket, InitPacket
from drivers.errors import PacketError
from drivers.packets import (
    DRIVE_ON,
    EXIT_FROM_OPEN,
    INIT_LENGTH,
    MAX_AXES,
    Mode,
    cyclic_length,
    echo,
    is_init,
    next_number,
    packet_number,
)
from drivers.transports.can.profile import (
    SEGMENT_DOWN,
    SEGMENT_UP,
    BusRates,
    CanError,
    ControllerEnd,
    Frame,
    PcEnd,
)
from tests.fuzz.draw import Draw, mutate_bytes
from tests.fuzz.targets import Target

CYCLES = 12  # of one conversation
HELD = {0: 2, 501: 2, 10: 5}
"""How many of D1..D5 an axis in this mode is given back with the drive on."""


class Talk:
    """One conversation; `play` returns whether every packet had its reply."""

    def __init__(self, draw: Draw, rates: BusRates) -> None:
        self._draw, self._rates = draw, rates
        self._pc, self._controller = PcEnd(rates), ControllerEnd(rates)
        self._n = draw.between(1, 6)
        self._time, self._untouched = 0.0, True

    def play(self) -> bool:
        """Init packet, then cycles until the bytes run out; AssertionError if a law is broken."""
        draw, number, answered = self._draw, 10, 0
        init = InitPacket.build(self._n, draw.choice((2, 1)), {}).encode()
        try:
            begun = self._up(init, self._controller.packet(init))
        except CanError:  # more than this bus carries: what follows goes as segments
            begun = None
        for cycle in range(CYCLES):
            if not draw.left and cycle:
                break
            self._time += draw.choice((0.002, 0.002, 0.0, 0.05, 2.0))
            number = next_number(number)
            packet = self._packet(number)
            got = self._up(packet, self._controller.packet(packet))
            if got is None:
                continue
            if self._untouched and not self._controller.segmented:
                self._as_sent(
                    CyclicPacket.decode(got, self._n), CyclicPacket.decode(packet, self._n)
                )
            answered += self._answered(got, CyclicPacket.decode(packet, self._n))
        return begun is not None and answered > 0

    def _packet(self, number: int) -> bytes:
        draw, n = self._draw, self._n
        block = draw.raw(draw.choice((0, 36, 36 * n))).ljust(36 * n, b"\0")
        axes = np.frombuffer(block, CyclicPacket.zeros(number, n).axes.dtype).copy()
        if draw.chance(128):
            axes["mode"] = draw.choice((0, 4, 5, 7, 501, 10, 1, 8))
        status = bytes((draw.choice((DRIVE_ON, 0, 1, 4)), 0, 0, 0))
        return CyclicPacket(number, status, draw.raw(4).ljust(4, b"\0"), axes).encode()

    # Up ---------------------------------------------------------------------------------------

    def _up(self, packet: bytes, frames: list[Frame]) -> bytes | None:
        """What the PC makes of the frames of a packet."""
        received, touched = harmed(frames, self._draw)
        made = []
        for frame in received:
            try:
                made.append(self._pc.receive(frame, self._time))
            except CanError:
                assert touched, "an init packet that the controller's end could carry"
        got = [one for one in made if one is not None]
        self._untouched &= not touched
        if self._untouched:
            assert len(got) == 1, f"{len(got)} packets of one"
        if got and not touched and self._controller.segmented:
            assert got == [packet], "segments carry every byte"
        return got[-1] if got else None

    def _as_sent(self, got: CyclicPacket, sent: CyclicPacket) -> None:
        """Number, status and modes are what was sent; of FD frames also the numbers.

        `tests/drivers/test_can_profile.py` has the laws of rounding and age.
        """
        assert (got.number, got.status) == (sent.number, sent.status)
        assert (got.axes["mode"] == sent.axes["mode"]).all()
        if self._rates.profile == "fd":
            with np.errstate(invalid="ignore"):  # a signalling NaN is one like any other
                of, to = sent.axes["d"].astype(float), got.axes["d"].astype(float)
            assert np.array_equal(of[:, [0, 2, 3, 4]], to[:, [0, 2, 3, 4]], equal_nan=True)

    # Down -------------------------------------------------------------------------------------

    def _answered(self, got: bytes, sent: CyclicPacket) -> bool:
        """The PC's answer to what it got, sent back; whether it arrived."""
        try:
            arrived = CyclicPacket.decode(got, self._n)
        except PacketError:
            assert not self._untouched
            return False
        answer = self._answer(arrived)
        try:
            frames, refused = self._pc.reply(answer.encode()), False
        except CanError:
            frames, refused = self._pc.drive_off(), True
        received, touched = harmed(frames, self._draw)
        made = [self._controller.receive(frame, self._time) for frame in received]
        replies = [one for one in made if one is not None]
        self._untouched &= not touched
        if self._untouched:
            assert len(replies) == 1, f"{len(replies)} answers of one"
        for reply in () if touched else replies:
            # Another sender's frame may state another number, and fit by its last bits.
            if arrived.number == sent.number:
                assert reply[:4] == answer.encode()[:4], "an answer to another packet"
            if self._untouched and self._controller.segmented:
                assert reply == answer.encode(), "segments carry every byte"
            elif self._untouched:
                modes = Mode.DRIVE_OFF_REQUEST if refused else answer.axes["mode"]
                assert (CyclicPacket.decode(reply, self._n).axes["mode"] == modes).all()
        return bool(replies)

    def _answer(self, received: CyclicPacket) -> CyclicPacket:
        """Given back, as a session does while nothing moves; targets; or what no frame carries."""
        draw, axes = self._draw, received.axes.copy()
        kind = draw.below(4)
        if kind < 3:
            for axis in axes:
                give_back(axis, received.status[0])
        if kind in (1, 2):
            mode = draw.choice((0, 4, 505, 508, 7, 1, 5))
            for axis in axes[: draw.between(1, self._n)]:
                axis["mode"], axis["d"], axis["extra"] = (
                    mode if kind == 2 else axis["mode"],
                    0.0,
                    0.0,
                )
                axis["d"][0] = draw.float32() if draw.chance(64) else draw.integer() / 2.0**26
                axis["d"][1] = draw.byte() / 1024.0
        elif kind == 3:
            axes["d"][:, 0] = draw.float32()
        status = bytes((EXIT_FROM_OPEN if draw.chance(64) else 0, 0, 0, 0))
        return CyclicPacket(next_number(received.number), status, bytes(4), axes)


def give_back(axis: np.ndarray, status: int) -> None:
    """Leave of an axis what may be given back unchanged."""
    count = 5 if status != DRIVE_ON else HELD.get(int(axis["mode"]), 0)
    axis["d"][max(count, 2) :] = 0.0
    if status == DRIVE_ON:
        axis["extra"] = 0.0


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
    foreign = Frame(draw.choice((SEGMENT_UP, SEGMENT_DOWN, draw.below(2048))), draw.raw(8))
    return [*sent[:at], foreign, *sent[at:]], True


GENTLE = np.array((0, 0, 1, 192, 194, 201), np.uint8)
"""Bytes that draw no harm: their last three bits are below four."""
RATES = (BusRates("classic", 1_000_000, 1_000_000), BusRates("fd", 1_000_000, 5_000_000))


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
