"""Errors of planning and playing motions; all derive from `PlannerError`. Joints count from 0."""

# ruff: noqa: N818  the leaves are named for what is wrong; their root ends in Error

from __future__ import annotations


class PlannerError(Exception):
    """Base of every error of this package."""


class InvalidLimits(PlannerError, ValueError):
    """Joint limits of the wrong shape, not finite, empty or reversed; `name` is the field."""

    def __init__(self, name: str, reason: str) -> None:
        self.name = name
        super().__init__(f"joint limits: {name} {reason}")


class InvalidSetting(PlannerError, ValueError):
    """Setting of a plan or a player (speed, fly, period, bound) outside its range."""

    def __init__(self, name: str, value: object, valid: str) -> None:
        self.name = name
        self.value = value
        self.valid = valid
        super().__init__(f"{name} = {value} is not allowed; valid is {valid}")


class InvalidTrajectory(PlannerError, ValueError):
    """Stored data that do not make a trajectory."""


class InvalidViaPoints(PlannerError, ValueError):
    """Via points of the wrong shape, too few, not finite, or out of limits."""


class InvalidPlanFile(PlannerError, ValueError):
    """Stored plan that cannot be read, or whose motion does not belong to its moves."""


class PlanningError(PlannerError):
    """The planned motion breaks a limit or is not smooth; it is not returned."""


class LimitExceeded(PlanningError):
    """The planned motion would break a limit of one joint (SI units).

    Args:
        quantity: such as velocity.
        joint: index from 0.
        value: that is reached.
        bound: its limit.
    """

    def __init__(self, quantity: str, joint: int, value: float, bound: float) -> None:
        self.quantity = quantity
        self.joint = joint
        self.value = value
        self.bound = bound
        super().__init__(
            f"planned {quantity} of joint {joint} reaches {value:.9g}, its limit is {bound:.9g}"
        )


class NotSmooth(PlanningError):
    """The planned motion would jump between two of its pieces (SI units).

    Args:
        quantity: such as velocity.
        joint: index from 0.
        time: of the jump [s].
        jump: its size.
    """

    def __init__(self, quantity: str, joint: int, time: float, jump: float) -> None:
        self.quantity = quantity
        self.joint = joint
        self.time = time
        self.jump = jump
        super().__init__(
            f"planned {quantity} of joint {joint} jumps by {jump:.3g} at {time:.6g} s; "
            "it must be continuous"
        )


class UnsupportedSolver(PlannerError, RuntimeError):
    """The installed ruckig is not of the series whose margins were measured."""


class StartMismatch(PlannerError):
    """A joint is farther from the start or resume point of a motion than the tolerance [rad].

    Args:
        joint: index from 0.
        value: position of the joint [rad].
        expected: position in the motion [rad].
        tolerance: largest distance [rad].
    """

    def __init__(self, joint: int, value: float, expected: float, tolerance: float) -> None:
        self.joint = joint
        self.value = value
        self.expected = expected
        self.tolerance = tolerance
        super().__init__(
            f"joint {joint} is at {value:.6g} rad, the motion at {expected:.6g} rad; "
            f"the tolerance is {tolerance:.3g} rad"
        )


class PlannerCrashed(PlannerError, RuntimeError):
    """The planning process died during the call."""

    def __init__(self, status: int) -> None:
        self.status = status
        super().__init__(
            "the planning process "
            + (f"was killed by signal {-status}" if status < 0 else f"ended with status {status}")
        )


class PlannerNotStarted(PlannerError, RuntimeError):
    """A planning process died before its first call; the reason is on stderr."""

    def __init__(self, status: int) -> None:
        super().__init__(f"a planning process could not be started (status {status})")


class PlanningTimedOut(PlannerError, TimeoutError):
    """Planning took longer than allowed [s]; its process was ended."""

    def __init__(self, timeout: float) -> None:
        super().__init__(f"no plan within {timeout:g} s; the planning process was ended")
