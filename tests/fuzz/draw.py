"""Bytes as decisions: what a fuzzer changes in them changes one decision, not all that follow."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import TypeVar

T = TypeVar("T")


class Draw:
    """Takes decisions off the front of bytes; when they run out, everything is the first choice."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._at = 0

    @property
    def left(self) -> int:
        """Bytes that no decision has used yet."""
        return len(self._data) - self._at

    def raw(self, count: int) -> bytes:
        """Up to `count` bytes as they are."""
        part = self._data[self._at : self._at + count]
        self._at += len(part)
        return part

    def byte(self) -> int:
        """0..255."""
        part = self.raw(1)
        return part[0] if part else 0

    def below(self, bound: int) -> int:
        """0..bound - 1, for bounds up to 65536."""
        size = 1 if bound <= 256 else 2
        return int.from_bytes(self.raw(size), "little") % bound

    def between(self, low: int, high: int) -> int:
        """`low`..`high`, both possible."""
        return low + self.below(high - low + 1)

    def choice(self, options: Sequence[T]) -> T:
        """One of these."""
        return options[self.below(len(options))]

    def chance(self, of_256: int) -> bool:
        """True for so many of the 256 values of a byte, never where the bytes have run out."""
        return bool(self.left) and self.byte() >= 256 - of_256

    def integer(self) -> int:
        """Any int32."""
        value: int = struct.unpack("<i", self.raw(4).ljust(4, b"\0"))[0]
        return value

    def float32(self) -> float:
        """Any float32, NaN and infinities too."""
        value: float = struct.unpack("<f", self.raw(4).ljust(4, b"\0"))[0]
        return value

    def rest(self) -> bytes:
        """All that is left."""
        return self.raw(self.left)
