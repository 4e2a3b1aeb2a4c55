"""Frames of both CAN profiles: identifiers, fields, codes, errors, bit rates and bus load.

The DBC files in this folder describe the same for CAN tools. Standard (11-bit) identifiers; lower
ones have priority on the bus, so replies come first.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal, NamedTuple

from drivers.errors import DriverError
from drivers.transports.base import TransportError

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


class CanError(TransportError):
    """The bus cannot carry this session."""

    def __init_subclass__(cls, *, remedy: str) -> None:
        cls.remedy = remedy

    def __init__(self, reason: str) -> None:
        DriverError.__init__(self, f"CAN: {reason}; {self.remedy}")
        self.link, self.reason = "CAN", reason


class CanAxesError(CanError, remedy="the profile carries one to six axes of arm 1; use UDP"):
    """The controller opens axes that the frames cannot carry."""


class CanBusLoadError(CanError, remedy="use a longer cycle, a faster bus or fewer axes"):
    """The frames of a cycle take too large a share of it."""


class CanModeError(
    CanError, remedy="the profile moves axes in modes 4, 5 and 7; use UDP for others"
):
    """A mode or a reply that the frames cannot carry."""


class CanValueError(CanError, remedy="check calibration and gear ratios"):
    """A number outside the range of its field."""


ProfileName = Literal["fd", "classic"]
LOAD_LIMIT: Final = 0.70
"""Largest share of a cycle for the frames, with worst-case stuffing."""
_CLASSIC_HEAD: Final = 1 + 11 + 3 + 4  # start, identifier, RTR IDE r0, length
_TAIL: Final = 1 + 2 + 7 + 3  # CRC delimiter, acknowledge, end of frame, interframe space
_FD_ARBITRATION: Final = 1 + 11 + 5  # start, identifier, RRS IDE FDF res BRS
_FD_CONTROL: Final = 1 + 4  # ESI, length


class Bits(NamedTuple):
    """Bits of one frame, by bit rate."""

    nominal: int
    data: int = 0


def classic_bits(n_bytes: int) -> Bits:
    """Return the bits of a classic data frame with 0..8 bytes, with worst-case stuffing.

    Bits of ISO 11898-1 with 11-bit identifiers, interframe space included. A classic frame is
    stuffed up to its CRC; an FD frame up to its data, and its CRC field at fixed places. The worst
    case is a stuff bit after the first five equal bits and then after every fourth.
    """
    stuffable = _CLASSIC_HEAD + 8 * n_bytes + 15
    return Bits(stuffable + (stuffable - 1) // 4 + _TAIL)


def fd_bits(n_bytes: int) -> Bits:
    """Return the bits of an FD frame with bit rate switch; see `classic_bits`."""
    crc, fixed = (17, 6) if n_bytes <= 16 else (21, 7)
    payload = _FD_CONTROL + 8 * n_bytes
    early = (_FD_ARBITRATION - 1) // 4
    late = (_FD_ARBITRATION + payload - 1) // 4 - early
    return Bits(_FD_ARBITRATION + early + _TAIL, payload + late + 4 + crc + fixed)


@dataclass(frozen=True)
class BusRates:
    """Profile and bit rates, bit/s; on FD `bitrate` is that of the arbitration phase."""

    profile: ProfileName
    bitrate: int = 1_000_000
    data_bitrate: int = 5_000_000

    def duration(self, n_bytes: int) -> float:
        """Return the longest time on the bus of one frame with this payload, s."""
        bits = (fd_bits if self.profile == "fd" else classic_bits)(n_bytes)
        return bits.nominal / self.bitrate + bits.data / self.data_bitrate

    def cycle_payloads(self, n_axes: int) -> tuple[int, ...]:
        """Return the bytes of each frame of one cycle, in both directions."""
        if self.profile == "fd":
            return 64, 48, 64
        return (8,) * (1 + n_axes + (n_axes + 1) // 2)

    def load(self, n_axes: int, period: float) -> float:
        """Return the share of the bus used by the cyclic frames; 1 is a full bus."""
        return sum(self.duration(size) for size in self.cycle_payloads(n_axes)) / period

    def require_load(self, n_axes: int, period: float) -> None:
        """Check that the frames of a cycle fit `LOAD_LIMIT`; raises CanBusLoadError."""
        load = self.load(n_axes, period)
        if load > LOAD_LIMIT:
            count = len(self.cycle_payloads(n_axes))
            raise CanBusLoadError(
                f"{count} {self.profile} frames for {n_axes} axes fill {100.0 * load:.1f} % of a "
                f"cycle of {1e3 * period:g} ms; allowed is {100.0 * LOAD_LIMIT:.0f} %"
            )
