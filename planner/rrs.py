"""Words of the RRS-1 robot controller interface, with the status codes of COMAU's ORL.

RRS-1 (Realistic Robot Simulation, 1993) is how simulators call a controller's own motion
software; `planner.Interpolator` offers its services. Codes and numbers are those that public
clients of ORL and RRS-1 use. Speeds, accelerations and jerks are percentages here, and only here.
"""

from __future__ import annotations

from enum import Enum, IntEnum
from math import nan
from numbers import Integral, Real
from typing import Any, NamedTuple, TypeVar

import numpy as np

from planner.arrays import Array, read_only


class Status(IntEnum):
    """What a service answers: 0 or more is success, less is a refusal that changed nothing."""

    OK = 0
    NEED_MORE_DATA = 1
    FINAL_STEP = 2
    OUTPUT_FORMAT = -13
    TIME_TOO_SHORT = -25
    NO_TARGET = -42
    FATAL = -68
    INCONSISTENT = -76

    @property
    def meaning(self) -> str:
        """The status in words."""
        return _MEANINGS[self]


_MEANINGS = {
    Status.OK: "done; the motion goes on",
    Status.NEED_MORE_DATA: "done; the next target may be set, or the motion ends at the last one",
    Status.FINAL_STEP: "the last step of the motion: speed is zero",
    Status.OUTPUT_FORMAT: "the output format is not available: joint positions only",
    Status.TIME_TOO_SHORT: "the motion is not possible in the given time",
    Status.NO_TARGET: "no target is set; the arm stands",
    Status.FATAL: "no motion to the target could be planned",
    Status.INCONSISTENT: "the motion is specified incompletely or inconsistently",
}


class MotionType(IntEnum):
    """How the arm gets to a target."""

    JOINT = 1
    LINEAR = 2
    CIRCULAR = 4


class OutputFormat(IntEnum):
    """What a step reports."""

    JOINT = 0
    CARTESIAN = 1


class PointAccuracy(IntEnum):
    """When a target at which the arm stops counts as reached (ORL's termination kinds)."""

    FINE = 0
    COARSE = 1
    NOSETTLE = 2
    JNT_FINE = 3
    JNT_COARSE = 4


class FlybyCriterion(IntEnum):
    """What rules the size of a fly-by corner (the numbers are ours; ORL only names them)."""

    PERCENT = 1
    DISTANCE = 2


class AccelerationKind(IntEnum):
    """Which of its ramps an acceleration override scales."""

    BOTH = 0
    ACCELERATION = 1
    DECELERATION = 2


class SpeedCorrection(IntEnum):
    """Which of the controller's speed overrides is meant.

    GENERAL (GEN_OVR) acts at once and leaves the path as it is; PROGRAM (PROG_SPD_OVR) scales the
    speed of the targets set from then on, whose corners may change with it.
    """

    GENERAL = 0
    PROGRAM = 1


class EventKind(Enum):
    """What can happen during a step."""

    VIA_POINT_PASSED = "via point passed"
    MOTION_ENDED = "motion ended"
    MOTION_STOPPED = "motion stopped"


class Event(NamedTuple):
    """Something that happened during a step, and at which target.

    A via point counts as passed where the path is nearest to it. An end is that of the motion to
    the last target; a stop is one asked for, on the way to the target named.
    """

    kind: EventKind
    target_id: int


class Step(NamedTuple):
    """One interpolation step.

    Attributes:
        status: OK, NEED_MORE_DATA, FINAL_STEP, or why there is no step.
        position: Set-point (n,) [rad], read-only; the last one where there is no step, NaN where
            there never was one.
        elapsed_time: Time since the arm last stood at the end of a motion [s]; the end of a
            motion is known to a fraction of a step.
        joint_limits: Bit j is set while joint j stands at an end of its range.
        events: What happened since the step before, in order.
    """

    status: Status
    position: Array
    elapsed_time: float
    joint_limits: int
    events: tuple[Event, ...]


E = TypeVar("E", bound=IntEnum)


def real(value: Any) -> float:
    """Return a number as a float; NaN, which no range holds, for what is none, as True or "1"."""
    if isinstance(value, bool) or not isinstance(value, Real):
        return nan
    try:
        return float(value)
    except OverflowError:
        return nan


def whole(value: Any) -> int | None:
    """Return a whole number, of Python's or numpy's types; None for what is none."""
    return int(value) if isinstance(value, Integral) and not isinstance(value, bool) else None


def member(kind: type[E], value: Any) -> E | None:
    """Return the member of an enumeration with this number; None where there is none."""
    number = whole(value)
    return kind(number) if number is not None and number in kind._value2member_map_ else None


def reals(values: Any) -> Array:
    """Return numbers, one or rows of them, as a read-only array.

    Raises:
        ValueError: an entry is no number, as True or "1", is too large for one, or rows differ
            in length.
    """
    raw = np.asarray(values)
    if raw.dtype == object:  # whole numbers beyond 64 bits, or what is none
        raw = np.array([real(value) for value in raw.flat]).reshape(raw.shape)
        if np.any(np.isnan(raw)):
            raise ValueError(f"{values!r:.80} holds what is no number")
    if raw.dtype.kind not in "iuf" or _holds_truth(values):
        raise ValueError(f"{values!r:.80} is not made of numbers")
    return read_only(raw)


def _holds_truth(values: Any) -> bool:
    """Whether True or False is among numbers, which an array would make 1 and 0 of."""
    if isinstance(values, list | tuple):
        return any(_holds_truth(value) for value in values)
    return isinstance(values, bool | np.bool_)
