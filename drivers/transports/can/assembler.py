"""Frames of one cycle, collected; never those of two."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Final

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
