"""Raw packets of a link as rows of constant size, and a ring that keeps the last of them."""

from __future__ import annotations

import struct
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from drivers.packets import INIT_LENGTH

LONGEST_PACKET: Final = INIT_LENGTH
"""Bytes kept of a packet; none of a controller is longer."""
CAPACITY: Final = 16_384
"""Packets kept: 8 s of both directions at 1 kHz, more than a disk may keep an archive waiting."""

_ROW: Final = struct.Struct(f"<qdHBx{LONGEST_PACKET}s4x")
PACKET_DTYPE: Final = np.dtype(
    {
        "names": ["cycle", "time", "length", "sent", "data"],
        "formats": ["<i8", "<f8", "<u2", "u1", ("u1", (LONGEST_PACKET,))],
        "offsets": [0, 8, 16, 18, 20],
        "itemsize": _ROW.size,
    }
)
"""One packet. ``cycle`` of the controller, as its cycle record has it; ``time`` s, on the link's
clock, when it arrived or was sent; ``length`` in bytes; ``sent`` 1 if the PC sent it, 0 if it
received it; ``data`` its bytes, then zeros (the first ones of a longer packet)."""

_MOST_LENGTH: Final = 0xFFFF


class PacketSink(Protocol):
    """Takes packets, and never waits."""

    def put(self, cycle: int, time: float, sent: bool, packet: bytes) -> None:
        """Keep one packet; see `PACKET_DTYPE`."""
        ...


class PacketRows:
    """The last `capacity` packets, in memory that may be shared with a reader.

    Args:
        memory: of `capacity` rows of `PACKET_DTYPE`, to write to.
    """

    def __init__(self, memory: memoryview) -> None:
        self._memory = memory
        self.capacity = len(memory) // _ROW.size
        self.written = 0

    def put(self, cycle: int, time: float, sent: bool, packet: bytes) -> None:
        """Keep one packet, over the oldest where there is no room."""
        place = self.written % self.capacity * _ROW.size
        length = min(len(packet), _MOST_LENGTH)
        _ROW.pack_into(self._memory, place, cycle, time, length, sent, packet)
        self.written += 1


class PacketRing(PacketRows):
    """Packets drained by the thread that writes them."""

    def __init__(self, capacity: int = CAPACITY) -> None:
        memory = bytearray(capacity * _ROW.size)
        super().__init__(memoryview(memory))
        self._rows: NDArray[np.void] = np.frombuffer(memory, PACKET_DTYPE)
        self._read = 0
        self._lost = 0

    @property
    def overflow(self) -> int:
        """Packets overwritten before they were drained, so far."""
        return self._lost + max(0, self.written - self._read - self.capacity)

    def drain(self) -> NDArray[np.void]:
        """A copy of the packets not drained yet, (k,), oldest first."""
        self._lost = self.overflow
        begin = max(self._read, self.written - self.capacity)
        self._read = self.written
        return self._rows.take(np.arange(begin, self.written), mode="wrap")
