"""The CAN profile without I/O: packets of C4G Open in CAN FD frames, whole, and the bus load.

Each packet, of any kind, is one *transfer*: frames of at most 64 bytes with one identifier for each
direction. Nothing is packed, rounded or left out, so that the session cannot tell the link from
UDP. `c4g_open_fd.dbc` in this folder describes the frames for CAN tools.
"""

from __future__ import annotations

import struct
import zlib
from collections import Counter
from dataclasses import dataclass
from typing import Final, NamedTuple

from drivers.c4g_packets import MAX_PACKET_BYTES, InitPacket, cyclic_length, is_init
from drivers.errors import DriverError, PacketError
from drivers.transports.base import TransportError

PAYLOADS_FD: Final = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)
"""Bytes that a CAN FD frame can carry."""
DOWN: Final = 0x100
"""Identifier of the PC's frames; lower ones have priority on the bus, so replies come first."""
UP: Final = 0x110
"""Identifier of the controller's frames."""
PACKED_IDS: Final = frozenset((0x111, *range(0x120, 0x123), *range(0x130, 0x137), 0x180, 0x181))
"""Identifiers of the packed profiles of before this version, which are not understood any more."""


class Frame(NamedTuple):
    """One data frame with a standard identifier."""

    id: int
    data: bytes


class CanError(TransportError):
    """The bus cannot carry this session."""

    def __init_subclass__(cls, *, remedy: str) -> None:
        cls.remedy = remedy

    def __init__(self, reason: str) -> None:
        DriverError.__init__(self, f"CAN: {reason}; {self.remedy}")
        self.link = "CAN"
        self.reason = reason


class CanBusLoadError(CanError, remedy="use a longer cycle, a faster bus or fewer axes, or UDP"):
    """The frames of a cycle take too large a share of its time."""


MAX_BUS_LOAD: Final = 0.70
"""Largest share of a cycle for the frames, with worst-case stuffing."""
_TAIL_BITS: Final = 1 + 2 + 7 + 3  # CRC delimiter, acknowledge, end of frame, interframe space
_ARBITRATION_BITS: Final = 1 + 11 + 5  # start, identifier, RRS IDE FDF res BRS
_CONTROL_BITS: Final = 1 + 4  # ESI, length


def fd_bits(n_bytes: int) -> tuple[int, int]:
    """Return the bits of an FD frame in its arbitration and data phases, with worst-case stuffing.

    Bits of ISO 11898-1 with 11-bit identifiers, interframe space included. A frame is stuffed up to
    its data, and its CRC field at fixed places. The worst case is a stuff bit after the first five
    equal bits and then after every fourth.
    """
    crc, fixed = (17, 6) if n_bytes <= 16 else (21, 7)
    payload = _CONTROL_BITS + 8 * n_bytes
    early = (_ARBITRATION_BITS - 1) // 4
    late = (_ARBITRATION_BITS + payload - 1) // 4 - early
    return _ARBITRATION_BITS + early + _TAIL_BITS, payload + late + 4 + crc + fixed


@dataclass(frozen=True)
class BusRates:
    """Bit rates of the arbitration and of the data phase, bit/s."""

    bitrate: int = 1_000_000
    data_bitrate: int = 5_000_000

    def duration(self, n_bytes: int) -> float:
        """Return the longest time on the bus of one frame with this payload, s."""
        nominal, data = fd_bits(n_bytes)
        return nominal / self.bitrate + data / self.data_bitrate

    def load(self, n_axes: int, period: float) -> float:
        """Return the share of the bus used by packets and replies; 1 is a full bus."""
        return 2.0 * sum(map(self.duration, payload_sizes(cyclic_length(n_axes)))) / period

    def require_load(self, n_axes: int, period: float) -> None:
        """Check that the frames of a cycle fit `MAX_BUS_LOAD`; raises CanBusLoadError."""
        load = self.load(n_axes, period)
        if load > MAX_BUS_LOAD:
            count = 2 * len(payload_sizes(cyclic_length(n_axes)))
            raise CanBusLoadError(
                f"{count} frames for {n_axes} axes fill {100.0 * load:.1f} % of a cycle of "
                f"{1e3 * period:g} ms; allowed is {100.0 * MAX_BUS_LOAD:.0f} %"
            )


FRAME_BYTES: Final = 64
_PREFIX: Final = struct.Struct("<BBH")
_HEAD: Final = struct.Struct("<BBHI")
_FIRST_FRAME_PAYLOAD: Final = FRAME_BYTES - _HEAD.size
_NEXT_FRAME_PAYLOAD: Final = FRAME_BYTES - _PREFIX.size
"""Bytes of a packet in the first and in each other frame: whole words, so that none is in two."""
TRANSFER_TIMEOUT: Final = 1.0
"""Time without a new frame after which a transfer is abandoned, s."""
DUPLICATE_TIME: Final = 0.1
"""Time within which a frame of a transfer that has ended counts as a duplicate, s."""


def payload_sizes(n_bytes: int) -> list[int]:
    """Return the bytes of each frame of a packet with this length."""
    remaining_bytes = max(0, n_bytes - _FIRST_FRAME_PAYLOAD)
    full, last = divmod(remaining_bytes, _NEXT_FRAME_PAYLOAD)
    sizes = [
        _HEAD.size + n_bytes - remaining_bytes,
        *[FRAME_BYTES] * full,
        *([_PREFIX.size + last] if last else []),
    ]
    return [_padded(size) for size in sizes]


def _padded(size: int) -> int:
    """Return the size of the smallest frame payload that holds `size` bytes."""
    return next(payload for payload in PAYLOADS_FD if payload >= size)


def payloads(packet: bytes, transfer: int) -> list[bytes]:
    """Divide a packet of 1..1500 bytes into the payloads of one transfer.

    Each begins with the number of the transfer (u8), its index (u8) and the length of the packet
    (u16). Frame 0 has the CRC-32 and the first 56 bytes of the packet, the others up to 60 bytes;
    the last one is padded with zeros.
    """
    if not 1 <= len(packet) <= MAX_PACKET_BYTES:
        raise ValueError(f"a packet has 1..{MAX_PACKET_BYTES} bytes, not {len(packet)}")
    length = len(packet)
    parts = [_HEAD.pack(transfer, 0, length, zlib.crc32(packet)) + packet[:_FIRST_FRAME_PAYLOAD]]
    for index, at in enumerate(range(_FIRST_FRAME_PAYLOAD, length, _NEXT_FRAME_PAYLOAD), start=1):
        parts.append(_PREFIX.pack(transfer, index, length) + packet[at : at + _NEXT_FRAME_PAYLOAD])
    return [part.ljust(_padded(len(part)), b"\0") for part in parts]


class TransferAssembler:
    """Assembles packets from frames; only complete ones with the right CRC are returned.

    Counted in `discarded` are "torn" (a frame is missing), "corrupt" (wrong CRC or length) and
    "malformed" (not a frame of a transfer).
    """

    def __init__(self, discarded: Counter[str]) -> None:
        self._discarded = discarded
        self._transfer = -1
        self._parts: dict[int, bytes] = {}
        self._done = True
        self._last = 0.0
        self._ended: dict[int, float] = {}

    def add(self, payload: bytes, time: float) -> bytes | None:
        """Add a frame received at `time` (s); returns the packet when it is complete.

        A frame of another transfer begins that one and abandons the present one, of which later
        frames are ignored.
        """
        if len(payload) <= _PREFIX.size or (payload[1] == 0 and len(payload) <= _HEAD.size):
            self._discarded["malformed"] += 1
            return None
        transfer = payload[0]
        index = payload[1]
        ended = self._ended.get(transfer)
        if ended is not None and abs(time - ended) <= DUPLICATE_TIME:
            return None
        is_new = self._parts.get(index, payload) == payload
        recent = abs(time - self._last) <= TRANSFER_TIMEOUT
        if self._done or transfer != self._transfer or not is_new or not recent:
            if not self._done:
                self._discarded["torn"] += 1
                if transfer != self._transfer:
                    self._ended[self._transfer] = time
            self._transfer = transfer
            self._parts = {}
            self._done = False
        self._last = time
        self._parts[index] = payload
        packet = self._complete()
        if self._done:
            self._ended[transfer] = time
        return packet

    def _complete(self) -> bytes | None:
        head = self._parts.get(0)
        if head is None:
            return None
        _, _, length, crc = _HEAD.unpack_from(head)
        if 1 <= length <= MAX_PACKET_BYTES:
            needed = range(1, len(payload_sizes(length)))
            if not self._parts.keys() >= set(needed):
                return None
            parts = (self._parts[index][_PREFIX.size :] for index in needed)
            packet = (head[_HEAD.size :] + b"".join(parts))[:length]
            if len(packet) == length and zlib.crc32(packet) == crc:
                self._done = True
                return packet
        self._done = True
        self._discarded["corrupt"] += 1
        return None


class CanEndpoint:
    """One end of a session on a bus: packets to frames and back; `sends` is its identifier.

    Attributes:
        discarded: frames and packets discarded, by kind: "foreign", "packed" (of the profiles of
            earlier versions), "malformed", "torn", "corrupt".
        cyclic_length: bytes of the session's cyclic packets, None before its init packet.
    """

    def __init__(self, rates: BusRates, sends: int) -> None:
        self.rates = rates
        self.discarded = Counter[str]()
        self.cyclic_length: int | None = None
        self._sends = sends
        self._receives = UP if sends == DOWN else DOWN
        self._transfer = -1
        self._assembler = TransferAssembler(self.discarded)

    def receive(self, frame: Frame, time: float) -> bytes | None:
        """Add a frame that arrived at `time` (s); returns the packet when it is complete.

        Raises:
            CanBusLoadError: it is the init packet of a session that this bus cannot carry.
        """
        if frame.id != self._receives:
            self.discarded["packed" if frame.id in PACKED_IDS else "foreign"] += 1
            return None
        packet = self._assembler.add(frame.data, time)
        if packet is not None:
            self._check(packet)
        return packet

    def frames(self, packet: bytes) -> list[Frame]:
        """Return the frames of a packet; raises CanBusLoadError as `receive`."""
        self._check(packet)
        self._transfer = (self._transfer + 1) % 256
        return [Frame(self._sends, payload) for payload in payloads(packet, self._transfer)]

    def _check(self, packet: bytes) -> None:
        """Check the load of a session that begins; what is invalid is the session's affair."""
        if not is_init(packet):
            return
        try:
            init = InitPacket.decode(packet)
        except PacketError:
            return
        if init.sample_time >= 1:
            self.rates.require_load(init.n_axes, init.period)
        self.cyclic_length = cyclic_length(init.n_axes)
