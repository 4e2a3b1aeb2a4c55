"""Errors of the driver, all below `DriverError`.

A `RefusalError` states why a set-point was not sent; a `GuardError` among them names a quantity
outside its bound. `drivers.transports.base.TransportError` and
`drivers.exchange.process.ExchangeError` are defined there. All errors survive pickling with message
and attributes, without their cause.
"""

# ruff: noqa: N818  leaves are named after the fault; their roots end in Error

from __future__ import annotations

from typing import Any


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
    """

    remedy = "look at the arm, close open mode and switch the drive on again at the controller"

    def __init__(self, message: str, cycle: int) -> None:
        super().__init__(f"{message} (cycle {cycle})")
        self.cycle = cycle


class SourceFailed(RefusalError):
    """The motion source raised, or returned arrays of the wrong shape; the cause is chained."""


class AxisNotInMode(RefusalError):
    """Axis `joint` (from 0) is in `mode`, not in the open mode `wanted` that the motion needs."""

    def __init__(self, joint: int, mode: int, wanted: int, cycle: int) -> None:
        super().__init__(f"joint {joint + 1} is in mode {mode}; the motion needs {wanted}", cycle)
        self.joint = joint
        self.mode = mode
        self.wanted = wanted


class ModeRefused(RefusalError):
    """Axis `joint` (from 0) reports an unknown mode, or is open without having been closed."""

    remedy = "have the controller's program go from mode 0 to the open mode of the cell file"

    def __init__(self, joint: int, mode: int, known: bool, cycle: int) -> None:
        reason = "it was not closed before" if known else "the reply to that mode is unknown"
        super().__init__(f"joint {joint + 1} is in mode {mode}: {reason}", cycle)
        self.joint = joint
        self.mode = mode


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


class ExitTimeout(RefusalError):
    """The controller did not end open mode in `cycles` since the session asked for it."""

    def __init__(self, cycles: int, cycle: int) -> None:
        super().__init__(
            f"open mode was asked to end {cycles} cycles ago and axes are still open", cycle
        )
        self.cycles = cycles


class GuardError(RefusalError):
    """A quantity outside its bound.

    Attributes:
        check: name of the check.
        joint: index from 0.
        value: what was found, in `unit`.
        bound: largest magnitude allowed (or the nearer position limit), in `unit`.
    """

    check = "guard"
    unit = ""

    def __init_subclass__(cls, *, check: str = "", unit: str = "", remedy: str = "") -> None:
        cls.check = check or cls.check
        cls.unit = unit or cls.unit
        cls.remedy = remedy or cls.remedy

    def __init__(
        self, joint: int, value: float, bound: float, cycle: int, unit: str | None = None
    ) -> None:
        unit = self.unit if unit is None else unit
        super().__init__(
            f"{self.check} of joint {joint + 1} is {value:.9g} {unit}; "
            f"allowed is {bound:.9g} {unit}",
            cycle,
        )
        self.unit = unit
        self.joint = joint
        self.value = value
        self.bound = bound


class NotFinite(GuardError, check="finiteness"):
    """NaN or infinity where a finite number is required."""

    def __init__(
        self, joint: int, value: float, bound: float, cycle: int, unit: str | None = None
    ) -> None:
        super().__init__(joint, value, bound, cycle, unit)
        self.args = (f"joint {joint + 1} has {value} where a number must be (cycle {cycle})",)


class TargetNotFinite(NotFinite):
    """The target of an open axis of `arm` (from 1) outside the cell is not finite."""

    def __init__(self, arm: int, joint: int, value: float, cycle: int) -> None:
        super().__init__(joint, value, float("inf"), cycle)
        message = f"target received of axis {joint + 1} of arm {arm}, which is open, is {value}"
        self.args = (f"{message} (cycle {cycle})",)
        self.arm = arm


_BEYOND = "the motion exceeds the limits and would be refused again: design another one"


class PositionLimit(GuardError, check="position", unit="rad", remedy=_BEYOND):
    """Set-point outside the joint's range."""


class VelocityLimit(GuardError, check="velocity", unit="rad/s", remedy=_BEYOND):
    """Step between two sent set-points, or the stated velocity, too fast."""


class AccelerationLimit(GuardError, check="acceleration", unit="rad/s²", remedy=_BEYOND):
    """Second difference of the sent set-points too large."""


class JerkLimit(GuardError, check="jerk", unit="rad/s³", remedy=_BEYOND):
    """Third difference of the sent set-points too large."""


class VelocityMismatch(
    GuardError, check="difference between stated velocity and step", unit="rad/s"
):
    """The source's velocity is not the derivative of its positions."""


class FollowingError(
    GuardError,
    check="following error",
    unit="motor revolutions",
    remedy="check that the axis is free, then its following_error in [drive_train]",
):
    """The axis does not follow; the reply reports mode 508 in this axis."""


class CurrentLimit(
    GuardError,
    check="target current",
    unit="A",
    remedy="check that the arm is free, check its payload, then go slower",
):
    """The servo's target current exceeds the narrower of the cell's and controller's limits."""


class CommandedCurrentLimit(CurrentLimit, check="commanded current"):
    """A current fed forward, or its sum with the servo's own, exceeds the limit."""


class CommandedCurrentStep(CommandedCurrentLimit, check="change of commanded current in one cycle"):
    """A current fed forward, or added to the servo's own, changes too much in one cycle."""


class CorrectionNotEnded(GuardError, check="correction at the end"):
    """The source is finished while its correction or feed-forward is not zero."""


class FirstSetPoint(
    GuardError,
    check="distance between received target and actual position",
    unit="motor revolutions",
    remedy="let the arm come to rest before open mode is asked for",
):
    """The first set-point is not where the arm is, or the arm is not at rest."""


class NotAtStandstill(
    FirstSetPoint, check="velocity at the first set-point", unit="motor revolutions per cycle"
):
    """The axis moves in the cycle of its first set-point."""


class FirstSetPointUnknown(
    FirstSetPoint,
    check="age, at the first set-point, of received target, position or velocity",
    unit="cycles",
):
    """Target, position or velocity received with it were sent in an earlier cycle."""


class SetPointNotAccepted(
    GuardError,
    check="distance between received target and the set-points sent last",
    unit="motor revolutions",
    remedy="look for lost packets: the cable, other traffic, hil doctor",
):
    """The controller's target is none of the set-points sent last."""


class VelocityAfterGap(
    SetPointNotAccepted,
    check="difference, after a gap, between received velocity and the one sent last",
    unit="motor revolutions per cycle",
):
    """After a long gap the axis rests, or its velocity is not that of the set-point sent last."""


class VelocityAfterPause(
    SetPointNotAccepted,
    check="difference, after a pause, between the velocity received and the one sent last",
    unit="rad/s",
):
    """After a pause by the clock the arm's velocity is not that of the set-points sent last."""


class AgeAfterGap(
    VelocityAfterGap, check="age, after a gap, of received target or velocity", unit="cycles"
):
    """After a long gap, target or velocity received were sent in an earlier cycle."""


class CorrectionUnconfirmed(SetPointNotAccepted, check="correction sent last before a gap"):
    """After a long gap it is unknown whether the controller applied the correction sent last."""
