"""Words of the RRS-1 robot controller interface, with the status codes of COMAU's ORL.

RRS-1 (Realistic Robot Simulation, 1993) is how simulators call a controller's own motion
software; `planner.Interpolator` offers its services. Codes and numbers are those that public
clients of ORL and RRS-1 use. Speeds, accelerations and jerks are percentages here, and only here.
"""

from __future__ import annotations

from enum import Enum, IntEnum
from typing import NamedTuple

from planner.arrays import Array


class Status(IntEnum):
    """What a service returns: 0 or more is success, less is a refusal that changed nothing."""

    OK = 0
    NEED_MORE_DATA = 1
    FINAL_STEP = 2
    OUTPUT_FORMAT = -13
    TIME_TOO_SHORT = -25
    NO_TARGET = -42
    FATAL = -68
    INCONSISTENT = -76


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
