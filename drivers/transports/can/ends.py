"""Both ends of the profile without I/O: packets to frames and frames to packets.

Start packets, and anything else that cyclic frames cannot carry, go as segments. From the init
packet on, cyclic packets go as cyclic frames, and an answer goes the way its question came.
"""

from __future__ import annotations

import struct
import zlib
from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Sequence
from typing import ClassVar, Final

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
from drivers.transports.can.bus_load import BusRates, CanAxesError, CanModeError
from drivers.transports.can.codecs import (
    NEVER,
    Ages,
    ClassicCodec,
    Codec,
    FdCodec,
    Sent,
    SlowStore,
    drive_off,
    read_reply,
    slow_turns,
    slow_value,
    write_reply,
)
from drivers.transports.can.layout import (
    COUNTS_PER_REVOLUTION,
    MAX_AXES,
    PAYLOADS_FD,
    SEGMENT_DOWN,
    SEGMENT_UP,
    Frame,
)

Floats = NDArray[np.float32]

LONGEST: Final = 1500
"""Bytes of the longest packet."""
_HEAD: Final = struct.Struct("<BBHI")
_PREFIX: Final = 2
ABANDONED: Final = 1.0
"""s after which a transfer that stands still is given up."""
REPEAT: Final = 0.1
"""s within which a frame of a finished transfer counts as a duplicate."""


class Segmenter:
    """Cuts packets into payloads of at most `size` bytes, 8 or 64.

    Segment 0 is the transfer number, 0, the length (u16) and the CRC-32 of the packet; the others
    are the transfer number, their index and data.
    """

    def __init__(self, size: int) -> None:
        self._size = size
        self._transfer = 0

    def split(self, packet: bytes) -> list[bytes]:
        """The payloads, in order.

        Raises:
            ValueError: empty, or longer than 1500 bytes.
        """
        if not 1 <= len(packet) <= LONGEST:
            raise ValueError(f"a packet has 1..{LONGEST} bytes, not {len(packet)}")
        transfer = self._transfer
        self._transfer = (transfer + 1) % 256
        payloads = [_HEAD.pack(transfer, 0, len(packet), zlib.crc32(packet))]
        room = self._size - _PREFIX
        for index, at in enumerate(range(0, len(packet), room), start=1):
            payload = bytes((transfer, index)) + packet[at : at + room]
            length = next(size for size in PAYLOADS_FD if size >= len(payload))
            payloads.append(payload.ljust(length, b"\0"))
        return payloads


class SegmentAssembler:
    """Puts packets together: each comes out whole and with the right CRC or not at all.

    Args:
        size: bytes of a full payload, 8 or 64.
        discarded: counts "torn" (a segment is missing), "corrupt" (wrong CRC or length) and
            "malformed" (no segment at all).
    """

    def __init__(self, size: int, discarded: Counter[str]) -> None:
        self._room = size - _PREFIX
        self._discarded = discarded
        self._transfer = -1
        self._parts: dict[int, bytes] = {}
        self._done = True
        self._seen = 0.0
        self._finished: dict[int, float] = {}

    def add(self, payload: bytes, time: float) -> bytes | None:
        """Take one segment, received at `time` (s); the packet, if that completes it."""
        if len(payload) <= _PREFIX or (payload[1] == 0 and len(payload) != _HEAD.size):
            self._discarded["malformed"] += 1
            return None
        transfer, index = payload[0], payload[1]
        finished = self._finished.get(transfer)
        if finished is not None and abs(time - finished) <= REPEAT:
            return None
        if not self._belongs(transfer, index, payload, time):
            if not self._done:
                self._discarded["torn"] += 1
            self._transfer, self._parts, self._done = transfer, {}, False
        self._seen = time
        self._parts[index] = payload
        packet = self._complete()
        if self._done:
            self._finished[transfer] = time
        return packet

    def _belongs(self, transfer: int, index: int, payload: bytes, time: float) -> bool:
        """Whether this is of the transfer under way."""
        known = self._parts.get(index, payload)
        recent = abs(time - self._seen) <= ABANDONED
        return transfer == self._transfer and not self._done and known == payload and recent

    def _complete(self) -> bytes | None:
        head = self._parts.get(0)
        if head is None:
            return None
        _, _, length, crc = _HEAD.unpack(head)
        if 1 <= length <= LONGEST:
            needed = range(1, 1 - (-length // self._room))
            if not self._parts.keys() >= set(needed):
                return None
            data = b"".join(self._parts[i][_PREFIX:] for i in needed)[:length]
            if len(data) == length and zlib.crc32(data) == crc:
                self._done = True
                return data
        self._done = True
        self._discarded["corrupt"] += 1
        return None


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


class End(ABC):
    """What both ends have in common.

    Attributes:
        discarded: frames, sets and packets thrown away, by kind: "foreign", "malformed", "torn",
            "corrupt", "unannounced" (cyclic frames without an init packet), "stale" (answers to
            packets too long ago).
    """

    _upwards: ClassVar[bool]
    """Whether this end receives what the controller sends."""

    def __init__(self, rates: BusRates) -> None:
        self.discarded: Counter[str] = Counter()
        self._rates = rates
        self._kind = FdCodec if rates.profile == "fd" else ClassicCodec
        size = 64 if rates.profile == "fd" else 8
        self._segmenter = Segmenter(size)
        self._segments = SegmentAssembler(size, self.discarded)
        self._profile_ids = self._ids(self._kind(MAX_AXES))
        self._codec: Codec | None = None
        self._sets: SetAssembler | None = None
        self._sent: deque[Sent] = deque(maxlen=REMEMBERED)

    def _ids(self, codec: Codec) -> tuple[int, ...]:
        return codec.up_ids if self._upwards else codec.down_ids

    def _cyclic_session(self, packet: bytes) -> InitPacket | None:
        """The init packet, if cyclic frames follow it; None for any other packet.

        An init packet that cannot be understood is for the session to judge; no cyclic frames
        follow it.
        """
        if not is_init(packet):
            return None
        try:
            init = InitPacket.decode(packet)
            require_carried(init, self._rates)
        except PacketError:
            return None
        return init

    def _start(self, init: InitPacket) -> None:
        """Cyclic frames of the session that this packet begins."""
        self._codec = codec = self._kind(init.n_axes)
        modulus = codec.up_modulus if self._upwards else codec.down_modulus
        span = codec.span_cycles * init.period
        self._sets = SetAssembler(self._ids(codec), modulus, span, self.discarded)
        self._sent.clear()

    def receive(self, frame: Frame, time: float) -> bytes | None:
        """Take a frame that arrived at `time` (s); the packet, if that completes one.

        Raises:
            CanError: an init packet of a session that this bus cannot carry.
        """
        if frame.id == (SEGMENT_UP if self._upwards else SEGMENT_DOWN):
            packet = self._segments.add(frame.data, time)
            if packet is not None:
                self._whole(packet)
            return packet
        codec, sets = self._codec, self._sets
        if frame.id not in self._profile_ids:
            self.discarded["foreign"] += 1
        elif codec is None or sets is None or frame.id not in self._ids(codec):
            self.discarded["unannounced" if self._upwards else "foreign"] += 1
        elif len(frame.data) != codec.lengths[frame.id]:
            self.discarded["malformed"] += 1
        else:
            payloads = sets.add(frame.id, codec.number(frame), frame.data, time)
            try:
                return None if payloads is None else self._packet(codec, frame, payloads)
            except PacketError:
                self.discarded["malformed"] += 1
        return None

    def _whole(self, packet: bytes) -> None:  # noqa: B027  one end needs it
        """A packet came as segments."""

    @abstractmethod
    def _packet(self, codec: Codec, frame: Frame, payloads: Sequence[bytes]) -> bytes | None:
        """The packet of a set that its last frame completes; PacketError for one without sense."""

    def _as_segments(self, packet: bytes) -> list[Frame]:
        frame_id = SEGMENT_DOWN if self._upwards else SEGMENT_UP
        return [Frame(frame_id, payload) for payload in self._segmenter.split(packet)]


class PcEnd(End):
    """The PC's end: frames of the controller to packets, replies to frames.

    Attributes:
        ages: (n_axes, 8) of the packet that came out last; None for one that came as segments.
    """

    _upwards = True

    def __init__(self, rates: BusRates) -> None:
        super().__init__(rates)
        self._slow = SlowStore(1)
        self._before: NDArray[np.float64] | None = None
        self.ages: Ages | None = None

    def forget(self) -> None:
        """The controller was silent for so long that nothing slow is known any more."""
        self._slow.forget()
        self._before = None

    def _whole(self, packet: bytes) -> None:
        self.ages = None
        if not is_init(packet):
            return
        self._codec = self._sets = None
        self._sent.clear()
        init = self._cyclic_session(packet)
        if init is not None:
            self._start(init)
            self._slow = SlowStore(init.n_axes)
            self._before = None

    def _packet(self, codec: Codec, frame: Frame, payloads: Sequence[bytes]) -> bytes:  # noqa: ARG002
        cycle = codec.read_up(payloads)
        ahead = self._slow.update(cycle.number, *cycle.slow, cycle.words)
        if cycle.counts is not None:
            self._form_velocity(cycle.counts, cycle.words.view(np.float32), ahead)
        status = bytes((cycle.status, 0, 0, 0))
        axes = cycle.words.view(AXIS_DTYPE).reshape(-1)
        packet = CyclicPacket(cycle.number, status, self._slow.functionality, axes).encode()
        self._sent.append(Sent.of(packet, codec.n_axes))
        self.ages = self._slow.ages
        return packet

    def _form_velocity(self, counts: NDArray[np.float64], floats: Floats, ahead: int) -> None:
        """D4 as the mean over the cycles since the last set, which is how old it is."""
        if self._before is None or ahead < 1:
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
        codec = self._codec
        if codec is not None and len(packet) == cyclic_length(codec.n_axes):
            number = int.from_bytes(packet[:4], "little", signed=True)
            for sent in reversed(self._sent):
                if next_number(sent.number) == number:
                    return codec.down(read_reply(packet, sent), sent)
        return self._as_segments(packet)

    def drive_off(self) -> list[Frame]:
        """Frames that ask for drive-off in answer to the newest cyclic packet, if there is one."""
        if not self._sent or self._codec is None:
            return []
        return self._codec.down(drive_off(self._sent[-1]), self._sent[-1])


class ControllerEnd(End):
    """The controller's end: its packets to frames, frames of the PC to replies.

    Attributes:
        segmented: whether the packet sent last went as segments.
    """

    _upwards = False

    def __init__(self, rates: BusRates) -> None:
        super().__init__(rates)
        self._turns = slow_turns(1)
        self.segmented = False

    def packet(self, packet: bytes) -> list[Frame]:
        """Frames of a packet of the controller, whatever it is.

        Raises:
            CanError: an init packet of a session that this bus cannot carry.
            ValueError: not 1..1500 bytes.
        """
        init = self._cyclic_session(packet)
        if init is not None:
            self._start(init)
            self._turns = slow_turns(init.n_axes)
        frames = self._cyclic(packet)
        self.segmented = frames is None
        return self._as_segments(packet) if frames is None else frames

    def _cyclic(self, packet: bytes) -> list[Frame] | None:
        """Cyclic frames, if they can carry this packet."""
        codec = self._codec
        if codec is None or len(packet) != cyclic_length(codec.n_axes):
            return None
        sent = Sent.of(packet, codec.n_axes)
        if not 1 <= sent.number <= LAST_NUMBER:
            return None
        index = next(self._turns)
        slow = (index, slow_value(index, sent.words, packet[8:12]))
        try:
            frames = codec.up(sent.number, sent.status, sent.words, slow)
        except CanModeError:
            return None
        self._sent.append(sent)
        return frames

    def _packet(self, codec: Codec, frame: Frame, payloads: Sequence[bytes]) -> bytes | None:
        for sent in reversed(self._sent):
            if codec.is_reply_to(frame, sent.number):
                return write_reply(codec.read_down(payloads, sent), sent)
        self.discarded["stale"] += 1
        return None
