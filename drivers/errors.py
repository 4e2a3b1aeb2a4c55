"""Errors of the driver, all below `DriverError`.

A `RefusalError` states why a set-point was not sent; a `GuardError` among them names a quantity
outside its bound. `drivers.transports.base.TransportError` and
`drivers.exchange.process_handle.ExchangeError` are defined there. All errors survive pickling with
message and attributes, without their cause.
"""

# ruff: noqa: N818  leaves are named after the fault; their roots end in Error

from __future__ import annotations

import math
from enum import Enum
from typing import Any, Final


class DriverError(Exception):
    """Root of the errors of this package."""

    def __reduce__(self) -> tuple[Any, ...]:
        # By default an exception is unpickled by calling its class with `args`, here the message.
        return _restored, (type(self), self.args, self.__dict__)


def _restored(
    kind: type[DriverError], args: tuple[object, ...], attributes: dict[str, object]
) -> DriverError:
    error = kind.__new__(kind, *args)
    error.__dict__.update(attributes)
    return error


class _FieldError(DriverError):
    """A field with an invalid value.

    Attributes:
        field: its name.
        value: what was found.
        expected: what would have been valid.
    """

    what = ""

    def __init__(self, field: str, value: object, expected: str) -> None:
        super().__init__(f"{self.what} {field} is {value!r}; expected {expected}")
        self.field = field
        self.value = value
        self.expected = expected


class PacketError(_FieldError):
    """Bytes that are not a valid packet: `field`, its value, and what was expected."""

    what = "packet"


class DriveTrainError(_FieldError):
    """Invalid drive train: a gear ratio of zero, coupling without a wrist."""

    what = "drive train"


class RequestError(DriverError):
    """A motion, or a change of its speed, was requested in a `state` that does not allow it."""

    def __init__(self, state: str, reason: str, what: str = "motion") -> None:
        super().__init__(f"no {what} can be requested in state '{state}': {reason}")
        self.state = state
        self.reason = reason


class TransportClosed(DriverError):
    """The link was closed on this side, or its peer has ended."""


class RefusalError(DriverError):
    """Why a set-point was not sent.

    Attributes:
        cycle: the controller's cycle in which it was due.
        remedy: what the operator should do.
        is_general: whether the remedy suits any controller; a link may have a better one.
    """

    is_general = True
    remedy = "look at the arm, close open mode and switch the drive on again at the controller"

    def __init__(self, message: str, cycle: int) -> None:
        super().__init__(f"{message} (cycle {cycle})")
        self.cycle = cycle


class SourceFailed(RefusalError):
    """The motion source raised, or returned arrays of the wrong shape; the cause is chained."""


class AxisNotInMode(RefusalError):
    """A joint is not in the open mode that the motion needs."""


class ModeRefused(RefusalError):
    """A joint reports an unknown mode, or is open without having been closed."""

    is_general = False
    remedy = "have the controller's program go from mode 0 to the open mode of the cell file"


class ExitTimeout(RefusalError):
    """The controller did not end open mode after the session requested it."""


class SessionFailed(RefusalError):
    """Unexpected exception inside the session: a defect. The cause is chained."""


def as_refusal(error: BaseException, cycle: int) -> RefusalError:
    """Return the error itself if it is a refusal, else a `SessionFailed` caused by it."""
    if isinstance(error, RefusalError):
        return error
    failed = SessionFailed(f"the session failed: {error_text(error)}", cycle)
    failed.__cause__ = error
    return failed


def error_text(error: BaseException) -> str:
    """Return type and message of any error, even of one whose `__str__` raises."""
    kind = type(error).__name__
    try:
        return f"{kind}: {error}"
    except BaseException:
        return f"{kind} without a message"


_BEYOND: Final = "the motion exceeds the limits and would be refused again: design another one"
_REST_FIRST: Final = "let the arm come to rest before the motion begins"
_LOOK_FOR_LOSSES: Final = "look for lost packets: the cable, other traffic, hil doctor"
_CHECK_ARM: Final = "check that the arm is free, check its payload, then go slower"
_CHECK_AXIS: Final = "check that the axis is free, then its following_error in [drive_train]"
_REVOLUTIONS: Final = "motor revolutions"
_PER_CYCLE: Final = "motor revolutions per cycle"


class Check(Enum):
    """A check of the guard: the quantity as messages name it, its unit, and a remedy if special."""

    FINITE = "finiteness", ""
    POSITION = "position", "rad", _BEYOND
    VELOCITY = "velocity", "rad/s", _BEYOND
    ACCELERATION = "acceleration", "rad/s²", _BEYOND
    JERK = "jerk", "rad/s³", _BEYOND
    STATED_VELOCITY = "difference between stated velocity and step", "rad/s"
    FOLLOWING_ERROR = "following error", _REVOLUTIONS, _CHECK_AXIS
    CURRENT = "target current", "A", _CHECK_ARM
    FIRST_SET_POINT = (
        "distance between received target and actual position",
        _REVOLUTIONS,
        _REST_FIRST,
    )
    STANDSTILL = "velocity at the first set-point", _PER_CYCLE, _REST_FIRST
    ACCEPTED = (
        "distance between received target and the set-points sent last",
        _REVOLUTIONS,
        _LOOK_FOR_LOSSES,
    )
    GAP_VELOCITY = (
        "difference, after a gap, between received velocity and the one sent last",
        _PER_CYCLE,
        _LOOK_FOR_LOSSES,
    )
    PAUSE_VELOCITY = (
        "difference, after a pause, between the velocity received and the one sent last",
        "rad/s",
        _LOOK_FOR_LOSSES,
    )

    def __init__(self, quantity: str, unit: str, remedy: str | None = None) -> None:
        self.quantity = quantity
        self.unit = unit
        self.is_general = remedy is None
        self.remedy = RefusalError.remedy if remedy is None else remedy


class GuardError(RefusalError):
    """A quantity outside its bound.

    Args:
        check: the one that failed.
        joint: index from 0.
        value: what was found.
        bound: largest magnitude allowed (or the nearer position limit).
        cycle: in which it was found.

    Attributes:
        check, joint, value, bound: as given.
        unit: of value and bound.
    """

    def __init__(
        self,
        check: Check,
        joint: int,
        value: float,
        bound: float,
        cycle: int,
    ) -> None:
        self.unit = unit = check.unit
        message = (
            f"{check.quantity} of joint {joint + 1} is {value:.9g} {unit}; "
            f"allowed is {bound:.9g} {unit}"
        )
        if not math.isfinite(value):
            check = Check.FINITE
            message = f"joint {joint + 1} is {value}, not a finite number"
        super().__init__(message, cycle)
        self.check = check
        self.remedy = check.remedy
        self.is_general = check.is_general
        self.joint = joint
        self.value = value
        self.bound = bound
