"""What planning and playing a motion can refuse.

::

    PlannerError
     ├─ InvalidLimits           limits of the wrong shape, not finite, empty or reversed
     ├─ InvalidSetting          speed, fly, period or a stop factor outside its range
     ├─ InvalidTrajectory       a stored trajectory that is not one
     ├─ InvalidViaPoints
     │   ├─ WrongShape          not (n_points, n_joints)
     │   ├─ TooFewViaPoints
     │   ├─ NonFiniteViaPoint
     │   └─ ViaPointOutOfLimits
     ├─ PlanningError
     │   ├─ LimitExceeded       the finished plan would break a limit
     │   └─ NotSmooth           the finished plan would jump
     ├─ UnsupportedSolver       the installed ruckig is not of the series measured
     ├─ InvalidPlanFile         a plan file or motion table that cannot be what it says
     ├─ PlannerCrashed          the process that planned died on this input
     ├─ PlannerNotStarted       it died before it could be asked
     ├─ PlanningTimedOut        it gave no answer in time
     ├─ PlannerOutOfStep        its answer is not to what was asked
     ├─ StartMismatch           the arm is not where the motion begins
     └─ NotBegun                a player was asked to advance before it was begun

Every error carries the numbers that caused it; joints are counted from 0, as arrays are.
"""

# ruff: noqa: N818  the leaves are named for what is wrong; their root ends in Error

from __future__ import annotations


class PlannerError(Exception):
    """Base of every error of this package."""


class InvalidLimits(PlannerError, ValueError):
    """Joint limits that describe no robot."""

    def __init__(self, name: str, reason: str) -> None:
        self.name = name
        self.reason = reason
        super().__init__(f"joint limits: {name} {reason}")


class InvalidSetting(PlannerError, ValueError):
    """A number that steers planning or playing lies outside its range."""

    def __init__(self, name: str, value: object, valid: str) -> None:
        self.name = name
        self.value = value
        self.valid = valid
        super().__init__(f"{name} = {value} is not allowed; valid is {valid}")


class InvalidTrajectory(PlannerError, ValueError):
    """Stored data that do not make a trajectory."""


class InvalidViaPoints(PlannerError, ValueError):
    """Via points that no motion can be planned through."""


class WrongShape(InvalidViaPoints):
    """Via points that are not one row per point and one column per joint."""

    def __init__(self, shape: tuple[int, ...], n_joints: int) -> None:
        self.shape = shape
        self.n_joints = n_joints
        super().__init__(f"via points have shape {shape}; expected (n_points, {n_joints})")


class TooFewViaPoints(InvalidViaPoints):
    """A motion needs a start and an end."""

    def __init__(self, count: int) -> None:
        self.count = count
        super().__init__(f"{count} via point(s) given; a motion needs at least 2")


class NonFiniteViaPoint(InvalidViaPoints):
    """A via point holds NaN or an infinity."""

    def __init__(self, index: int, joint: int, value: float) -> None:
        self.index = index
        self.joint = joint
        self.value = value
        super().__init__(f"via point {index}, joint {joint}: {value} is not a finite position")


class ViaPointOutOfLimits(InvalidViaPoints):
    """A via point lies outside the joint's range [rad]."""

    def __init__(self, index: int, joint: int, value: float, lower: float, upper: float) -> None:
        self.index = index
        self.joint = joint
        self.value = value
        self.lower = lower
        self.upper = upper
        super().__init__(
            f"via point {index}, joint {joint}: {value:.6g} rad is outside "
            f"[{lower:.6g}, {upper:.6g}] rad"
        )


class PlanningError(PlannerError):
    """A motion was planned but does not keep what a plan promises; it is not returned."""


class LimitExceeded(PlanningError):
    """The planned motion would break a limit of one joint (SI units)."""

    def __init__(self, quantity: str, joint: int, value: float, bound: float) -> None:
        self.quantity = quantity
        self.joint = joint
        self.value = value
        self.bound = bound
        super().__init__(
            f"planned {quantity} of joint {joint} reaches {value:.9g}, its limit is {bound:.9g}"
        )


class NotSmooth(PlanningError):
    """The planned motion would jump between two of its pieces (SI units)."""

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
    """The installed corner solver is not of the series whose margins were measured."""

    def __init__(self, version: str, series: str) -> None:
        self.version = version
        self.series = series
        super().__init__(
            f"ruckig {version} is installed; corners are planned with {series}.x only, whose "
            "behaviour near its limits is known"
        )


class StartMismatch(PlannerError):
    """The arm is too far from where the motion begins, or goes on [rad]."""

    def __init__(self, joint: int, value: float, expected: float, tolerance: float) -> None:
        self.joint = joint
        self.value = value
        self.expected = expected
        self.tolerance = tolerance
        super().__init__(
            f"joint {joint} is at {value:.6g} rad, the motion at {expected:.6g} rad; "
            f"at most {tolerance:.3g} rad of difference is carried along"
        )


class NotBegun(PlannerError, RuntimeError):
    """A player gives set-points only after `begin` was given where the arm is."""

    def __init__(self) -> None:
        super().__init__("advance() before begin(): the motion does not know where the arm is")


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
        self.status = status
        super().__init__(f"a planning process could not be started (status {status})")


class PlanningTimedOut(PlannerError, TimeoutError):
    """Planning took longer than allowed [s]; its process was ended."""

    def __init__(self, timeout: float) -> None:
        self.timeout = timeout
        super().__init__(f"no plan within {timeout:g} s; the planning process was ended")


class PlannerOutOfStep(PlannerError, RuntimeError):
    """An answer of the process that plans belongs to another call, or none was begun here."""

    def __init__(self) -> None:
        super().__init__("the planning process was asked something else, or nothing, from here")


class InvalidPlanFile(PlannerError, ValueError):
    """A stored plan that cannot be read, or is not the plan of the moves it lists."""
