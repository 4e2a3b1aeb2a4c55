"""Identifiers, fields and codes of the frames of both profiles.

The DBC files in this folder describe the same for CAN tools. Standard (11-bit) identifiers; lower
ones have priority on the bus, so replies come first.
"""

from __future__ import annotations

from typing import Final, NamedTuple

MAX_AXES: Final = 6
PAYLOADS_FD: Final = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)
"""Bytes that a CAN FD frame can carry."""

# Identifiers.
FD_DOWN: Final = 0x100
FD_UP_A: Final = 0x110
FD_UP_B: Final = 0x111
CLASSIC_DOWN: Final = (0x120, 0x121, 0x122)
CLASSIC_UP_HEADER: Final = 0x130
CLASSIC_UP_AXIS: Final = tuple(range(0x131, 0x131 + MAX_AXES))
SEGMENT_DOWN: Final = 0x180
SEGMENT_UP: Final = 0x181

# Classic: packed integers.
REVOLUTION_BITS: Final = 27
DIFFERENCE_BITS: Final = 17
CURRENT_BITS: Final = 12
COUNTS_PER_REVOLUTION: Final = 65536
COUNTS_PER_AMPERE: Final = 64
UP_COUNTER_BITS: Final = 4
DOWN_COUNTER_BITS: Final = 6

FUNCTIONALITY: Final = 4 * MAX_AXES
"""Index of the functionality word, the last of the slow values: D2, extra1..3 of each axis go up
one value per cycle, in turn, then this."""


class Frame(NamedTuple):
    """One data frame with a standard identifier."""

    id: int
    data: bytes


FD_MODE_CODES: Final[dict[int, int]] = {
    **{mode: mode for mode in range(18)},
    **{mode: mode - 300 for mode in range(500, 509)},
}
"""Mode on the C4G wire to its byte in FD frames."""
CLASSIC_MODE_CODES: Final[dict[int, int]] = {
    mode: code
    for code, mode in enumerate((0, 1, 2, 4, 5, 7, 8, 9, 10, 500, 501, 502, 504, 505, 506, 508))
}
"""Mode on the C4G wire to its four bits in classic frames."""


class Action:
    """Action for one axis in a classic frame: two bits."""

    MIRROR: Final = 0
    SET: Final = 1
    SET_AND_EXIT: Final = 2
    WORD: Final = 3


class Word:
    """Meaning of the D1 field of an axis whose action is WORD; EXIT is added to any of them."""

    MIRROR: Final = 0
    CLOSED_ZERO: Final = 1
    ZERO: Final = 2
    DRIVE_OFF: Final = 3
    FOLLOWING_ERROR: Final = 4
    EXIT: Final = 16
