"""What planning and playing a motion can refuse.

::

    PlannerError
     ├─ InvalidLimits           limits of the wrong shape, not finite, empty or reversed
     ├─ InvalidSetting          speed, fly, period or a stop factor outside its range
     ├─ InvalidTrajectory       a stored trajectory that is not one
     ├─ InvalidViaPoints        of the wrong shape, too few, not finite, or out of limits
     ├─ InvalidPlanFile         a plan file or motion table that cannot be what it says
     ├─ PlanningError
     │   ├─ LimitExceeded       the finished plan would break a limit
     │   └─ NotSmooth           the finished plan would jump
     ├─ UnsupportedSolver       the installed ruckig is not of the series measured
     ├─ PlannerCrashed          the process that planned died on this input
     ├─ PlannerNotStarted       it died before it could be asked
     ├─ PlanningTimedOut        it did not end in time
     ├─ NoCallPending        its result is not that of what was asked
     ├─ StartMismatch           the arm is not where the motion begins
     └─ NotBegun                a player was asked to advance before it was begun

Joints are counted from 0, as arrays are.
"""

# ruff: noqa: N818  the leaves are named for what is wrong; their root ends in Error

from __future__ import annotations


class PlannerError(Exception):
    """Base of every error of this package."""


class InvalidLimits(PlannerError, ValueError):
    """Joint limits that describe no robot; `name` is the field."""

    def __init__(self, name: str, reason: str) -> None:
        self.name = name
        super().__init__(f"joint limits: {name} {reason}")


class InvalidSetting(PlannerError, ValueError):
    """A number that steers planning or playing lies outside its range."""

    def __init__(self, name: str, value: object, valid: str) -> None:
        self.name, self.value, self.valid = name, value, valid
        super().__init__(f"{name} = {value} is not allowed; valid is {valid}")


class InvalidTrajectory(PlannerError, ValueError):
    """Stored data that do not make a trajectory."""


class InvalidViaPoints(PlannerError, ValueError):
    """Via points that no motion can be planned through."""


class InvalidPlanFile(PlannerError, ValueError):
    """A stored plan that cannot be read, or is not the plan of the moves it lists."""


class PlanningError(PlannerError):
    """A motion was planned but does not keep what a plan promises; it is not returned."""


class LimitExceeded(PlanningError):
    """The planned motion would break a limit of one joint (SI units)."""

    def __init__(self, quantity: str, joint: int, value: float, bound: float) -> None:
        self.quantity, self.joint, self.value, self.bound = quantity, joint, value, bound
        super().__init__(
            f"planned {quantity} of joint {joint} reaches {value:.9g}, its limit is {bound:.9g}"
        )


class NotSmooth(PlanningError):
    """The planned motion would jump between two of its pieces (SI units)."""

    def __init__(self, quantity: str, joint: int, time: float, jump: float) -> None:
        self.quantity, self.joint, self.time, self.jump = quantity, joint, time, jump
        super().__init__(
            f"planned {quantity} of joint {joint} jumps by {jump:.3g} at {time:.6g} s; "
            "it must be continuous"
        )


class UnsupportedSolver(PlannerError, RuntimeError):
    """The installed corner solver is not of the series whose margins were measured."""


class StartMismatch(PlannerError):
    """The arm is too far from where the motion begins, or goes on [rad]."""

    def __init__(self, joint: int, value: float, expected: float, tolerance: float) -> None:
        self.joint, self.value, self.expected, self.tolerance = joint, value, expected, tolerance
        super().__init__(
            f"joint {joint} is at {value:.6g} rad, the motion at {expected:.6g} rad; "
            f"at most {tolerance:.3g} rad of difference is carried along"
        )


class NotBegun(PlannerError, RuntimeError):
    """A player gives set-points only after `begin` was given where the arm is."""


class PlannerCrashed(PlannerError, RuntimeError):
    """The process that planned died; nothing was planned, and this process lives on."""

    def __init__(self, status: int) -> None:
        self.status = status
        super().__init__(
            "the planning process "
            + (f"was killed by signal {-status}" if status < 0 else f"ended with status {status}")
        )


class PlannerNotStarted(PlannerError, RuntimeError):
    """A planning process died before it could be asked anything; it writes why to stderr."""

    def __init__(self, status: int) -> None:
        super().__init__(f"a planning process could not be started (status {status})")


class PlanningTimedOut(PlannerError, TimeoutError):
    """Planning took longer than allowed [s]; its process was ended."""

    def __init__(self, timeout: float) -> None:
        super().__init__(f"no plan within {timeout:g} s; the planning process was ended")


class NoCallPending(PlannerError, RuntimeError):
    """The result of the planning process is that of another call, or none was begun here."""
