"""Packets that are not cyclic, cut into frames and put together again.

Segment 0 is the transfer number, 0, the length (u16) and the CRC-32 of the packet; the others are
the transfer number, their index and data. A packet comes out whole and with the right CRC or not
at all.
"""

from __future__ import annotations

import struct
import zlib
from collections import Counter
from typing import Final

from drivers.transports.can.layout import PAYLOADS_FD

LONGEST: Final = 1500
"""Bytes of the longest packet."""
_HEAD: Final = struct.Struct("<BBHI")
_PREFIX: Final = 2
ABANDONED: Final = 1.0
"""s after which a transfer that stands still is given up."""
REPEAT: Final = 0.1
"""s within which a frame of a finished transfer counts as a duplicate."""


class Segmenter:
    """Cuts packets into payloads of at most `size` bytes, 8 or 64."""

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
            payloads.append(payload + bytes(_padding(len(payload))))
        return payloads


def _padding(length: int) -> int:
    """Zeros up to the next length that a frame can have."""
    return next(size for size in PAYLOADS_FD if size >= length) - length


class SegmentAssembler:
    """Puts packets together.

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
        needed = -(-length // self._room)
        if 1 <= length <= LONGEST:
            if len(self._parts) <= needed or any(
                i not in self._parts for i in range(1, needed + 1)
            ):
                return None
            data = b"".join(self._parts[i][_PREFIX:] for i in range(1, needed + 1))[:length]
            self._done = True
            if len(data) == length and zlib.crc32(data) == crc:
                return data
        self._done = True
        self._discarded["corrupt"] += 1
        return None
