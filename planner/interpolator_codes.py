"""Codes, events and steps of the services of RRS-1.

The numbers are as in public clients of RRS-1 and in COMAU's ORL, unless stated otherwise.
"""

from __future__ import annotations

from enum import Enum, IntEnum
from typing import NamedTuple

from planner.arrays import Array


class Status(IntEnum):
    """Return code of a service: success if not negative; a refused service changed nothing."""

    OK = 0
    NEED_MORE_DATA = 1
    FINAL_STEP = 2
    OUTPUT_FORMAT = -13
    TIME_TOO_SHORT = -25
    NO_TARGET = -42
    FATAL = -68
    INCONSISTENT = -76


class MotionType(IntEnum):
    """Kind of path to a target."""

    JOINT = 1
    LINEAR = 2
    CIRCULAR = 4


class OutputFormat(IntEnum):
    """Format of the positions of a step."""

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
    """Criterion for the size of a fly-by corner (the numbers are not from ORL).

    A distance is one of the tool, which a joint interpolator does not know.
    """

    PERCENT = 1
    DISTANCE = 2


class AccelerationKind(IntEnum):
    """Ramps that an acceleration override scales."""

    BOTH = 0
    ACCELERATION = 1
    DECELERATION = 2


class SpeedCorrection(IntEnum):
    """Speed override of the controller.

    GENERAL (GEN_OVR) acts at once and does not change the path; PROGRAM (PROG_SPD_OVR) scales the
    speed of later targets, whose corners may change with it.
    """

    GENERAL = 0
    PROGRAM = 1


class EventKind(Enum):
    """Kind of an `Event`."""

    VIA_POINT_PASSED = "via point passed"
    MOTION_ENDED = "motion ended"
    MOTION_STOPPED = "motion stopped"


class Event(NamedTuple):
    """Event during a step, with its target.

    A via point is passed where the path is nearest to it. A motion ends at its last target;
    a requested stop names the next target.
    """

    kind: EventKind
    target_id: int


class InterpolationStep(NamedTuple):
    """One interpolation step.

    `position` is the set-point (n,) [rad], read-only, the last one after an error and NaN before
    the first; `elapsed_time` [s] counts since the last motion ended, to a fraction of a step; bit j
    of `joint_limits` is set while joint j is at an end of its range.
    """

    status: Status
    position: Array
    elapsed_time: float
    joint_limits: int
    events: tuple[Event, ...]
