"""What the CAN profile cannot carry, refused by name.

::

    TransportError
    └── CanError              the link as described cannot carry this session
        ├── CanAxesError      more than six axes, or an axis of another arm
        ├── CanBusLoadError   the frames of a cycle would fill the bus
        ├── CanModeError      a mode or an answer that the frames have no room for
        └── CanValueError     a number that its field cannot hold
"""

from __future__ import annotations

from drivers.errors import DriverError
from drivers.transports.base import TransportError


class CanError(TransportError):
    """The link as described cannot carry this session.

    Attributes:
        link: "CAN" and the profile.
        reason: what does not fit.
        remedy: what to do about it.
    """

    def __init__(self, reason: str, remedy: str) -> None:
        DriverError.__init__(self, f"CAN: {reason}; {remedy}")
        self.link = "CAN"
        self.reason = reason
        self.remedy = remedy

    def __reduce__(self) -> tuple[object, ...]:
        return _restored, (type(self), self.args, vars(self))


def _restored(kind: type[CanError], args: tuple[object, ...], state: dict[str, object]) -> CanError:
    """An error as it was, whatever its constructor takes."""
    error = kind.__new__(kind, *args)
    vars(error).update(state)
    return error


class CanAxesError(CanError):
    """The controller opens axes that the frames have no place for."""

    def __init__(self, reason: str) -> None:
        super().__init__(reason, "the profile carries one to six axes of arm 1; use UDP")


class CanBusLoadError(CanError):
    """The frames of a cycle would take too large a share of it.

    Attributes:
        load: share of the cycle with worst-case bit stuffing, 1 is a full bus.
        limit: largest share allowed.
        period: cycle in s.
    """

    def __init__(self, load: float, limit: float, period: float, frames: str) -> None:
        super().__init__(
            f"{frames} fill {100.0 * load:.1f} % of a cycle of {1e3 * period:g} ms; "
            f"allowed is {100.0 * limit:.0f} %",
            "use a longer cycle, a faster bus or fewer axes",
        )
        self.load = load
        self.limit = limit
        self.period = period


class CanModeError(CanError):
    """A mode or an answer that the frames have no room for.

    Attributes:
        mode: the mode concerned, None where it is the status byte.
        slot: slot of the axis, None where it is the whole packet.
    """

    def __init__(self, mode: int | None, slot: int | None, reason: str) -> None:
        super().__init__(reason, "the profile moves axes in modes 4, 5 and 7; use UDP for others")
        self.mode = mode
        self.slot = slot


class CanValueError(CanError):
    """A number that its field cannot hold.

    Attributes:
        field: "D1" or "D2".
        slot: slot of the axis.
        value: what was to be sent.
    """

    def __init__(self, field: str, slot: int, value: float, held: str) -> None:
        super().__init__(
            f"{field} of slot {slot} is {value:.9g}; its field holds {held}",
            "check calibration and gear ratios",
        )
        self.field = field
        self.slot = slot
        self.value = value
