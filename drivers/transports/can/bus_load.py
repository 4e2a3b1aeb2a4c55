"""Errors, bit rates and bus load of the CAN profiles.

Bits of ISO 11898-1 frames with 11-bit identifiers, interframe space included. A classic frame is
stuffed up to its CRC; an FD frame up to its data, and its CRC field at fixed places. The worst
case is a stuff bit after the first five equal bits and then after every fourth.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal, NamedTuple

from drivers.errors import DriverError
from drivers.transports.base import TransportError
from drivers.transports.can.layout import PAYLOADS_FD


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


def classic_bits(n_bytes: int, *, stuffed: bool = True) -> Bits:
    """Return the bits of a classic data frame with 0..8 bytes, with worst-case stuffing."""
    if not 0 <= n_bytes <= 8:
        raise ValueError(f"a classic frame carries 0..8 bytes, not {n_bytes}")
    stuffable = _CLASSIC_HEAD + 8 * n_bytes + 15
    stuffing = (stuffable - 1) // 4 if stuffed else 0
    return Bits(stuffable + stuffing + _TAIL)


def fd_bits(n_bytes: int, *, stuffed: bool = True) -> Bits:
    """Return the bits of an FD frame with bit rate switch."""
    if n_bytes not in PAYLOADS_FD:
        raise ValueError(f"an FD frame carries one of {PAYLOADS_FD} bytes, not {n_bytes}")
    crc, fixed = (17, 6) if n_bytes <= 16 else (21, 7)
    payload = _FD_CONTROL + 8 * n_bytes
    early = (_FD_ARBITRATION - 1) // 4 if stuffed else 0
    late = (_FD_ARBITRATION + payload - 1) // 4 - early if stuffed else 0
    return Bits(_FD_ARBITRATION + early + _TAIL, payload + late + 4 + crc + fixed)


@dataclass(frozen=True)
class BusRates:
    """Profile and bit rates of a bus.

    Attributes:
        profile: "fd" or "classic".
        bitrate: bit/s, of the arbitration phase on FD.
        data_bitrate: bit/s of the data phase on FD.
    """

    profile: ProfileName
    bitrate: int = 1_000_000
    data_bitrate: int = 5_000_000

    def __post_init__(self) -> None:
        if self.profile not in ("fd", "classic"):
            raise ValueError(f"profile {self.profile!r} is neither 'fd' nor 'classic'")
        if self.bitrate <= 0 or self.data_bitrate <= 0:
            raise ValueError(f"bit rates {self.bitrate}, {self.data_bitrate} are not positive")

    def duration(self, n_bytes: int, *, stuffed: bool = True) -> float:
        """Return the time on the bus of one frame with this payload, s."""
        fd = self.profile == "fd"
        bits = (fd_bits if fd else classic_bits)(n_bytes, stuffed=stuffed)
        return bits.nominal / self.bitrate + bits.data / self.data_bitrate

    def cycle_payloads(self, n_axes: int) -> tuple[int, ...]:
        """Return the bytes of each frame of one cycle, both ways."""
        if self.profile == "fd":
            return 64, 48, 64
        return (8,) * (1 + n_axes + (n_axes + 1) // 2)

    def load(self, n_axes: int, period: float, *, stuffed: bool = True) -> float:
        """Return the share of the bus used by the cyclic frames; 1 is a full bus."""
        payloads = self.cycle_payloads(n_axes)
        return sum(self.duration(size, stuffed=stuffed) for size in payloads) / period

    def require_load(self, n_axes: int, period: float) -> None:
        """Check that the frames of a cycle fit.

        Raises:
            CanBusLoadError: their share exceeds `LOAD_LIMIT` with worst-case stuffing.
        """
        load = self.load(n_axes, period)
        if load > LOAD_LIMIT:
            count = len(self.cycle_payloads(n_axes))
            raise CanBusLoadError(
                f"{count} {self.profile} frames for {n_axes} axes fill {100.0 * load:.1f} % of a "
                f"cycle of {1e3 * period:g} ms; allowed is {100.0 * LOAD_LIMIT:.0f} %"
            )
