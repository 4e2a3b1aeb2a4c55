"""Conversion between packets and frames at both ends of the link, without I/O.

Start packets, and others that cyclic frames cannot carry, are sent as segments. After the init
packet, cyclic packets are sent as cyclic frames, and a reply is sent as its packet was.
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

from drivers.drive_train import Ages
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
from drivers.transports.can.codecs import (
    NEVER,
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
    BusRates,
    CanAxesError,
    CanModeError,
    Frame,
)

Floats = NDArray[np.float32]

LONGEST: Final = 1500
"""Bytes of the longest packet."""
_HEAD: Final = struct.Struct("<BBHI")
_PREFIX: Final = 2
TRANSFER_TIMEOUT: Final = 1.0
"""Time without a new segment after which a transfer is abandoned, s."""
DUPLICATE_TIME: Final = 0.1
"""Time within which a frame of a complete transfer counts as a duplicate, s."""


class Segmenter:
    """Divides packets into payloads of at most `size` bytes, 8 or 64.

    Segment 0 is the transfer number, 0, the length (u16) and the CRC-32 of the packet; the others
    are the transfer number, their index and data.
    """

    def __init__(self, size: int) -> None:
        self._size = size
        self._transfer = 0

    def split(self, packet: bytes) -> list[bytes]:
        """Return the payloads, in order; raises ValueError for a length outside 1..1500 bytes."""
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
    """Assembles packets from segments; only complete ones with the right CRC are returned.

    `size` is that of a full payload, 8 or 64 bytes. Counted in `discarded` are "torn" (a segment is
    missing), "corrupt" (wrong CRC or length) and "malformed" (not a segment).
    """

    def __init__(self, size: int, discarded: Counter[str]) -> None:
        self._room = size - _PREFIX
        self._discarded = discarded
        self._transfer = -1
        self._parts: dict[int, bytes] = {}
        self._done = True
        self._last = 0.0
        self._finished: dict[int, float] = {}

    def add(self, payload: bytes, time: float) -> bytes | None:
        """Add a segment received at `time` (s); returns the packet when it is complete."""
        if len(payload) <= _PREFIX or (payload[1] == 0 and len(payload) != _HEAD.size):
            self._discarded["malformed"] += 1
            return None
        transfer, index = payload[0], payload[1]
        finished = self._finished.get(transfer)
        if finished is not None and abs(time - finished) <= DUPLICATE_TIME:
            return None
        if not self._belongs(transfer, index, payload, time):
            if not self._done:
                self._discarded["torn"] += 1
            self._transfer, self._parts, self._done = transfer, {}, False
        self._last = time
        self._parts[index] = payload
        packet = self._complete()
        if self._done:
            self._finished[transfer] = time
        return packet

    def _belongs(self, transfer: int, index: int, payload: bytes, time: float) -> bool:
        """Whether this segment is of the present transfer."""
        known = self._parts.get(index, payload)
        recent = abs(time - self._last) <= TRANSFER_TIMEOUT
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
"""Cycles by which a frame may be older than the present set without starting a new one."""


class SetAssembler:
    """Collects one frame of each identifier with the same cycle number, modulo `modulus`.

    A frame of another cycle starts a new set; an incomplete set is dropped and counted as "torn".
    Duplicates and frames of up to `LATE` cycles earlier are ignored. Numbers repeat, so all frames
    of a set must also arrive within `span` s.
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
        """Add a frame; returns all payloads in the order of `ids` when the set is complete."""
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


MAX_SENT: Final = 16
"""Packets stored at each end, for late replies."""
_ARM: Final = 1


def require_carried(init: InitPacket, rates: BusRates) -> None:
    """Check that the session of this init packet fits the profile.

    Raises:
        CanAxesError, CanBusLoadError: too many axes, another arm, or too short a cycle.
        PacketError: the axis map is invalid.
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
    """Common base of both ends.

    Attributes:
        discarded: frames, sets and packets discarded, by kind: "foreign", "malformed", "torn",
            "corrupt", "unannounced" (cyclic frames without an init packet), "stale" (replies to
            packets no longer stored).
    """

    _upwards: ClassVar[bool]
    """Whether this is the PC's end."""

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
        self._sent: deque[Sent] = deque(maxlen=MAX_SENT)

    def _ids(self, codec: Codec) -> tuple[int, ...]:
        return codec.up_ids if self._upwards else codec.down_ids

    def _cyclic_session(self, packet: bytes) -> InitPacket | None:
        """Return the init packet if cyclic frames follow it, None for any other packet.

        One that is invalid is passed on to the session; no cyclic frames follow it.
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
        """Prepare for the cyclic frames of a session."""
        self._codec = codec = self._kind(init.n_axes)
        modulus = codec.up_modulus if self._upwards else codec.down_modulus
        span = codec.span_cycles * init.period
        self._sets = SetAssembler(self._ids(codec), modulus, span, self.discarded)
        self._sent.clear()

    def receive(self, frame: Frame, time: float) -> bytes | None:
        """Add a frame that arrived at `time` (s); returns the packet when it is complete.

        Raises CanError for an init packet of a session that this bus cannot carry.
        """
        if frame.id == (SEGMENT_UP if self._upwards else SEGMENT_DOWN):
            packet = self._segments.add(frame.data, time)
            if packet is not None:
                self._segmented_packet(packet)
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

    def _segmented_packet(self, packet: bytes) -> None:  # noqa: B027  used by one end
        """Handle a packet that came as segments."""

    @abstractmethod
    def _packet(self, codec: Codec, frame: Frame, payloads: Sequence[bytes]) -> bytes | None:
        """Decode a complete set of which `frame` is the last; PacketError if it is invalid."""

    def _as_segments(self, packet: bytes) -> list[Frame]:
        frame_id = SEGMENT_DOWN if self._upwards else SEGMENT_UP
        return [Frame(frame_id, payload) for payload in self._segmenter.split(packet)]


class PcEnd(End):
    """The PC's end; `ages` (n_axes, 8) of the last packet, None if it came as segments."""

    _upwards = True

    def __init__(self, rates: BusRates) -> None:
        super().__init__(rates)
        self._slow = SlowStore(1)
        self._before: NDArray[np.float64] | None = None
        self.ages: Ages | None = None

    def forget(self) -> None:
        """Discard the slow values after a silence."""
        self._slow.forget()
        self._before = None

    def _segmented_packet(self, packet: bytes) -> None:
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
            self._set_velocity(cycle.counts, cycle.words.view(np.float32), ahead)
        status = bytes((cycle.status, 0, 0, 0))
        axes = cycle.words.view(AXIS_DTYPE).reshape(-1)
        packet = CyclicPacket(cycle.number, status, self._slow.functionality, axes).encode()
        self._sent.append(Sent.of(packet, codec.n_axes))
        self.ages = self._slow.ages
        return packet

    def _set_velocity(self, counts: NDArray[np.float64], floats: Floats, ahead: int) -> None:
        """Set D4 to the mean over the cycles since the last set, which is its age."""
        if self._before is None or ahead < 1:
            floats[:, 4] = np.nan
            self._slow.ages[:, 3] = NEVER
        else:
            floats[:, 4] = (counts - self._before) / (ahead * COUNTS_PER_REVOLUTION)
            self._slow.ages[:, 3] = ahead - 1
        if ahead >= 0:
            self._before = counts

    def reply(self, packet: bytes) -> list[Frame]:
        """Return the frames of a reply.

        Raises:
            CanModeError, CanValueError: the frames cannot carry it.
        """
        codec = self._codec
        if codec is not None and len(packet) == cyclic_length(codec.n_axes):
            number = int.from_bytes(packet[:4], "little", signed=True)
            for sent in reversed(self._sent):
                if next_number(sent.number) == number:
                    return codec.down(read_reply(packet, sent), sent)
        return self._as_segments(packet)

    def drive_off(self) -> list[Frame]:
        """Return frames that request drive-off in reply to the newest cyclic packet, if any."""
        if not self._sent or self._codec is None:
            return []
        return self._codec.down(drive_off(self._sent[-1]), self._sent[-1])


class ControllerEnd(End):
    """The controller's end; `segmented` tells whether the last packet went as segments."""

    _upwards = False

    def __init__(self, rates: BusRates) -> None:
        super().__init__(rates)
        self._turns = slow_turns(1)
        self.segmented = False

    def packet(self, packet: bytes) -> list[Frame]:
        """Return the frames of a packet of the controller.

        Raises:
            CanError: an init packet of a session that this bus cannot carry.
        """
        init = self._cyclic_session(packet)
        if init is not None:
            self._start(init)
            self._turns = slow_turns(init.n_axes)
        frames = self._cyclic(packet)
        self.segmented = frames is None
        return self._as_segments(packet) if frames is None else frames

    def _cyclic(self, packet: bytes) -> list[Frame] | None:
        """Return cyclic frames, None if they cannot carry this packet."""
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
