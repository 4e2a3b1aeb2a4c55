"""Both ends of the profile without I/O: packets to frames and frames to packets.

Start packets, and anything else that cyclic frames cannot carry, go as segments. From the init
packet on, cyclic packets go as cyclic frames, and an answer goes the way its question came.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.errors import PacketError
from drivers.packets import (
    AXIS_DTYPE,
    LAST_NUMBER,
    CyclicPacket,
    InitPacket,
    cyclic_length,
    is_init,
    next_number,
)
from drivers.transports.can.bus_load import BusRates
from drivers.transports.can.classic import ClassicCodec
from drivers.transports.can.errors import CanAxesError, CanModeError
from drivers.transports.can.fd import FdCodec, UpSet
from drivers.transports.can.layout import (
    COUNTS_PER_REVOLUTION,
    MAX_AXES,
    SEGMENT_DOWN,
    SEGMENT_UP,
    Frame,
)
from drivers.transports.can.reply_fields import (
    Mirror,
    Sent,
    drive_off,
    read_reply,
    words_of,
    write_reply,
)
from drivers.transports.can.segments import SegmentAssembler, Segmenter
from drivers.transports.can.slow import NEVER, Ages, SlowSender, SlowStore

LATE: Final = 3
"""Cycles by which a frame may come after one of a later cycle without starting a new set."""


class SetAssembler:
    """Collects one frame of each identifier with the same cycle number.

    A frame of another cycle starts a new set; the incomplete one before it is given up and
    counted as "torn". A frame that comes once more changes nothing, and one of up to three cycles
    earlier is ignored. Numbers repeat, so a set must also be complete within `span`.

    Args:
        ids: identifiers of a whole set.
        modulus: the numbers count up modulo this.
        span: s between the first and the last frame of a set, by their time of arrival.
        discarded: where "torn" is counted.
    """

    def __init__(
        self, ids: Sequence[int], modulus: int, span: float, discarded: Counter[str]
    ) -> None:
        self._ids = tuple(ids)
        self._modulus = modulus
        self._span = span
        self._discarded = discarded
        self._number = -1
        self._began = 0.0
        self._parts: dict[int, bytes] = {}
        self._done = True

    def add(self, frame_id: int, number: int, data: bytes, time: float) -> list[bytes] | None:
        """Take a frame; all payloads in the order of `ids`, if that completes the set."""
        timely = abs(time - self._began) <= self._span
        if not timely or number != self._number or self._parts.get(frame_id, data) != data:
            if timely and self._number >= 0 and self._is_late(number):
                return None
            if not self._done:
                self._discarded["torn"] += 1
            self._number, self._began, self._parts, self._done = number, time, {}, False
        if self._done:
            return None
        self._parts[frame_id] = data
        if len(self._parts) < len(self._ids):
            return None
        self._done = True
        return [self._parts[frame_id] for frame_id in self._ids]

    def _is_late(self, number: int) -> bool:
        return 1 <= (self._number - number) % self._modulus <= LATE


REMEMBERED: Final = 16
"""Packets that either end remembers, for answers that come late."""
_ARM: Final = 1


Codec = FdCodec | ClassicCodec


def segment_size(rates: BusRates) -> int:
    """Bytes of a full frame."""
    return 64 if rates.profile == "fd" else 8


def _codec(rates: BusRates, n_axes: int) -> Codec:
    return FdCodec(n_axes) if rates.profile == "fd" else ClassicCodec(n_axes)


def require_carried(init: InitPacket, rates: BusRates) -> None:
    """See that the session this init packet begins fits the profile.

    Raises:
        CanAxesError: more than six axes, or axes of another arm.
        CanBusLoadError: the cycle is too short.
        PacketError: the axis map is not one.
    """
    arms = {axis.arm for axis in init.open_axes()}
    if init.n_axes > MAX_AXES:
        raise CanAxesError(f"the controller opens {init.n_axes} axes")
    if arms != {_ARM}:
        raise CanAxesError(f"the controller opens axes of arm {max(arms)}")
    if init.sample_time < 1:
        raise PacketError("sample_time", init.sample_time, "at least 1 ms")
    rates.require_load(init.n_axes, init.period)


def _cyclic_session(packet: bytes, rates: BusRates) -> InitPacket | None:
    """The init packet, if cyclic frames follow it; None for any other packet.

    An init packet that cannot be understood is for the session to judge; no cyclic frames follow.
    """
    if not is_init(packet):
        return None
    try:
        init = InitPacket.decode(packet)
        require_carried(init, rates)
    except PacketError:
        return None
    return init


class PcEnd:
    """The PC's end: frames of the controller to packets, replies to frames.

    Attributes:
        discarded: frames, sets and packets thrown away, by kind: "foreign", "malformed", "torn",
            "corrupt", "unannounced" (cyclic frames without an init packet).
    """

    def __init__(self, rates: BusRates) -> None:
        self.discarded: Counter[str] = Counter()
        self._rates = rates
        self._segmenter = Segmenter(segment_size(rates))
        self._segments = SegmentAssembler(segment_size(rates), self.discarded)
        self._codecs = {n: _codec(rates, n) for n in range(1, MAX_AXES + 1)}
        self._up_ids = frozenset(self._codecs[MAX_AXES].up_ids)
        self._codec: Codec | None = None
        self._sets: SetAssembler | None = None
        self._slow = SlowStore(1)
        self._before: NDArray[np.float64] | None = None
        self._mirror = Mirror()
        self._sent: deque[Sent] = deque(maxlen=REMEMBERED)
        self._ages: Ages | None = None

    @property
    def ages(self) -> Ages | None:
        """(n_axes, 8) of the packet that came out last; None for one that came as segments."""
        return self._ages

    def forget(self) -> None:
        """The controller was silent for so long that nothing slow is known any more."""
        self._slow.forget()
        self._before = None

    def receive(self, frame: Frame, time: float) -> bytes | None:
        """Take a frame that arrived at `time` (s); the packet, if that completes one.

        Raises:
            CanError: an init packet of a session that this bus cannot carry.
        """
        if frame.id == SEGMENT_UP:
            packet = self._segments.add(frame.data, time)
            if packet is not None:
                self._begin(packet)
            return packet
        if frame.id not in self._up_ids:
            self.discarded["foreign"] += 1
            return None
        codec, sets = self._codec, self._sets
        if codec is None or sets is None or frame.id not in codec.up_ids:
            self.discarded["unannounced"] += 1
            return None
        if len(frame.data) != codec.lengths[frame.id]:
            self.discarded["malformed"] += 1
            return None
        payloads = sets.add(frame.id, codec.number(frame), frame.data, time)
        return None if payloads is None else self._packet(codec, payloads)

    def _begin(self, packet: bytes) -> None:
        self._ages = None
        if not is_init(packet):
            return
        self._codec = self._sets = None
        self._sent.clear()
        init = _cyclic_session(packet, self._rates)
        if init is None:
            return
        codec = self._codecs[init.n_axes]
        span = codec.span_cycles * init.period
        self._codec = codec
        self._sets = SetAssembler(codec.up_ids, codec.up_modulus, span, self.discarded)
        self._slow = SlowStore(init.n_axes)
        self._before = None

    def _packet(self, codec: Codec, payloads: Sequence[bytes]) -> bytes | None:
        try:
            cycle = codec.read_up(payloads)
        except PacketError:
            self.discarded["malformed"] += 1
            return None
        ahead = self._slow.update(cycle.number, *cycle.slow, cycle.words)
        if cycle.counts is not None:
            self._form_velocity(cycle, ahead)
        packet = CyclicPacket(
            cycle.number,
            bytes((cycle.status, 0, 0, 0)),
            self._slow.functionality,
            cycle.words.view(AXIS_DTYPE).reshape(-1),
        ).encode()
        self._sent.append(self._mirror.sent(packet, codec.n_axes))
        self._ages = self._slow.ages
        return packet

    def _form_velocity(self, cycle: UpSet, ahead: int) -> None:
        """D4 as the mean over the cycles since the last set, which is how old it is."""
        counts = cycle.counts
        floats = cycle.words.view(np.float32)
        if counts is None or self._before is None or ahead < 1:
            floats[:, 4] = np.nan
            self._slow.ages[:, 3] = NEVER
        else:
            floats[:, 4] = (counts - self._before) / (ahead * COUNTS_PER_REVOLUTION)
            self._slow.ages[:, 3] = ahead - 1
        if ahead >= 0:
            self._before = counts

    def reply(self, packet: bytes) -> list[Frame]:
        """Frames of an answer.

        Raises:
            CanModeError, CanValueError: the frames cannot carry it.
            ValueError: neither cyclic nor 1..1500 bytes.
        """
        sent = self._answered(packet)
        if sent is not None and self._codec is not None:
            return self._codec.down(read_reply(packet, sent), sent)
        return [Frame(SEGMENT_DOWN, payload) for payload in self._segmenter.split(packet)]

    def _answered(self, reply: bytes) -> Sent | None:
        """The packet with cyclic frames that this answers, if there is one."""
        if self._codec is None or len(reply) != cyclic_length(self._codec.n_axes):
            return None
        number = int.from_bytes(reply[:4], "little", signed=True)
        for sent in reversed(self._sent):
            if next_number(sent.number) == number:
                return sent
        return None

    def drive_off(self) -> list[Frame]:
        """Frames that ask for drive-off in answer to the newest cyclic packet, if there is one."""
        if not self._sent or self._codec is None:
            return []
        return self._codec.down(drive_off(self._sent[-1]), self._sent[-1])


class ControllerEnd:
    """The controller's end: its packets to frames, frames of the PC to replies.

    Attributes:
        discarded: as of `PcEnd`; "stale" are answers to packets too long ago.
    """

    def __init__(self, rates: BusRates) -> None:
        self.discarded: Counter[str] = Counter()
        self._rates = rates
        self._segmenter = Segmenter(segment_size(rates))
        self._segments = SegmentAssembler(segment_size(rates), self.discarded)
        self._codec: Codec | None = None
        self._sets: SetAssembler | None = None
        self._slow = SlowSender(1)
        self._mirror = Mirror()
        self._sent: deque[Sent] = deque(maxlen=REMEMBERED)
        self.segmented = False
        """Whether the packet sent last went as segments."""

    def packet(self, packet: bytes) -> list[Frame]:
        """Frames of a packet of the controller, whatever it is.

        Raises:
            CanError: an init packet of a session that this bus cannot carry.
            ValueError: not 1..1500 bytes.
        """
        init = _cyclic_session(packet, self._rates)
        if init is not None:
            self._start(init)
        frames = self._cyclic(packet)
        self.segmented = frames is None
        if frames is None:
            frames = [Frame(SEGMENT_UP, payload) for payload in self._segmenter.split(packet)]
        return frames

    def _start(self, init: InitPacket) -> None:
        codec = _codec(self._rates, init.n_axes)
        span = codec.span_cycles * init.period
        self._codec = codec
        self._sets = SetAssembler(codec.down_ids, codec.down_modulus, span, self.discarded)
        self._slow = SlowSender(init.n_axes)
        self._sent.clear()

    def _cyclic(self, packet: bytes) -> list[Frame] | None:
        """Cyclic frames, if they can carry this packet."""
        codec = self._codec
        if codec is None or len(packet) != cyclic_length(codec.n_axes):
            return None
        number = int.from_bytes(packet[:4], "little", signed=True)
        if not 1 <= number <= LAST_NUMBER:
            return None
        words = words_of(packet, codec.n_axes)
        try:
            frames = codec.up(number, packet[4], words, self._slow.next(words, packet[8:12]))
        except CanModeError:
            return None
        self._sent.append(self._mirror.sent(packet, codec.n_axes))
        return frames

    def receive(self, frame: Frame, time: float) -> bytes | None:
        """Take a frame that arrived at `time` (s); the reply, if that completes one."""
        if frame.id == SEGMENT_DOWN:
            return self._segments.add(frame.data, time)
        codec, sets = self._codec, self._sets
        if codec is None or sets is None or frame.id not in codec.down_ids:
            self.discarded["foreign"] += 1
            return None
        if len(frame.data) != codec.lengths[frame.id]:
            self.discarded["malformed"] += 1
            return None
        payloads = sets.add(frame.id, codec.number(frame), frame.data, time)
        return None if payloads is None else self._reply(codec, frame, payloads)

    def _reply(self, codec: Codec, frame: Frame, payloads: Sequence[bytes]) -> bytes | None:
        for sent in reversed(self._sent):
            if codec.is_reply_to(frame, sent.number):
                break
        else:
            self.discarded["stale"] += 1
            return None
        try:
            return write_reply(codec.read_down(payloads, sent), sent)
        except PacketError:
            self.discarded["malformed"] += 1
            return None
