"""Conclusions of a look, their evidence, and how to decide them; `messages` words them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum, auto
from typing import Any, Literal

from hil.importers.conclusions import (
    ChannelMeaning,
    ConcludedUnit,
    Conclusion,
    CopiedCommands,
    EpisodeUnits,
    FixedFingers,
    JointOrder,
    OutsideLimits,
    RecordedArm,
    StatedUnit,
)
from identification.estimators.delay import DelayEstimate
from identification.hypotheses.explanation import Explanation
from identification.hypotheses.joint_changes import Change
from identification.signals.position_steps import PositionJump
from identification.signals.row_faults import RowFault
from identification.signals.sample_times import SampleTimes, TimeBase

Vector = tuple[float, ...]


class Fact(Enum):
    """Conclusions without a figure."""

    EVERY_JOINT_MOVES = auto()
    CONTINUOUS = auto()
    WITHIN_LIMITS = auto()
    COMMANDED = auto()
    TIMES_UNSEEN = auto()
    BACKWARDS = auto()  #: the rows run backwards in time
    MEASURED = auto()
    SLOPE = auto()  #: the velocity is the slope of the position
    SCALED_SLOPE = auto()
    SLOPE_IN_DEGREES = auto()
    SLOPE_OF_DEGREES = auto()
    NEGATED_SLOPE = auto()
    SLOPE_IN_REVOLUTIONS = auto()
    NOT_EXAMINED = auto()
    ORDER_OF_URDF = auto()
    SIGNS_OF_URDF = auto()
    UNIT_AS_READ = auto()
    ZERO_OF_URDF = auto()
    ZERO_STATED = auto()  #: by a column map, where the torque does not show it
    UNCOUPLED = auto()
    WITH_GRAVITY = auto()
    WITHOUT_GRAVITY = auto()
    STATED_MOUNTING = auto()
    JOINT_SIDE = auto()  #: untested
    JOINT_TORQUE = auto()
    LARGE_TORQUE = auto()
    MOTOR_SIDE = auto()
    SMALL_TORQUE = auto()
    PAYLOAD_UNDETERMINED = auto()
    PAYLOAD_IN_LAST_BODY = auto()
    NO_TORQUE = auto()
    SERVO_LOAD = auto()  #: in a channel that is named as a torque
    MOTOR_CURRENT = auto()
    TORQUE_UNEXAMINED = auto()
    DELAY_UNDETERMINED = auto()
    NO_DELAY = auto()
    DELAY_OF_LOW_PASS = auto()
    NO_DELAY_SEEN = auto()
    NO_LOW_PASS = auto()
    OTHER_ARM = auto()
    NO_BODIES = auto()
    RATE_OF_TORQUE = auto()
    NONE_FITS = auto()  #: only the nearest of what was tested


@dataclass(frozen=True)
class OtherTimes:
    """Recorded times over true ones."""

    factor: float


@dataclass(frozen=True)
class ClockReading:
    """Time base, with the unit of a log's time, or the stamps of messages."""

    base: TimeBase
    unit: str | None = None
    of_messages: bool = False


@dataclass(frozen=True)
class RowsReading:
    """Rows outside the motion, times other than stamps, and steps that no arm makes."""

    faults: tuple[RowFault, ...]
    times: SampleTimes | None
    jumps: tuple[PositionJump, ...] = ()


@dataclass(frozen=True)
class Channels:
    """Channels, with the unit that was concluded."""

    channels: str
    unit: str | None = None


@dataclass(frozen=True)
class ZeroTorques:
    """Joints that move, and whose torque is zero throughout."""

    joints: tuple[str, ...]


@dataclass(frozen=True)
class NotSlopes:
    """Joints whose velocity is not the slope of their position."""

    joints: tuple[str, ...]


@dataclass(frozen=True)
class StillJoints:
    """Joints that never move."""

    joints: tuple[str, ...]


@dataclass(frozen=True)
class Wrapped:
    """Joints, as the recording lists them, that were continued over a turn."""

    joints: str


@dataclass(frozen=True)
class CoarsePositions:
    """Positions rounded to a step [rad], which hides whether a sensor's noise is in them."""

    step: float


@dataclass(frozen=True)
class SmoothPositions:
    """Positions without noise above a frequency [Hz]."""

    above: float


@dataclass(frozen=True)
class ArmChange:
    """A change of what was recorded, of an arm with these joints."""

    change: Change
    joints: tuple[str, ...]


@dataclass(frozen=True)
class Changes:
    """Changes that were found."""

    changes: tuple[ArmChange, ...]


@dataclass(frozen=True)
class FoundChange:
    """What explains the error of the torque, of an arm with these joints."""

    explanation: Explanation
    joints: tuple[str, ...]


@dataclass(frozen=True)
class ColumnOrder:
    """Joints of the columns of torque and position, where they differ from the URDF."""

    torque: tuple[str, ...] | None
    position: tuple[str, ...] | None


@dataclass(frozen=True)
class AngleUnit:
    """The unit of the angles."""

    unit: Literal["deg", "rad"]


@dataclass(frozen=True)
class Mounting:
    """How the arm is mounted."""

    name: str


@dataclass(frozen=True)
class Either:
    """What was recorded, or a change that fits equally well."""

    recorded: Fact
    change: ArmChange


@dataclass(frozen=True)
class UnseenZeros:
    """Joints whose zero the torque does not show."""

    joints: tuple[str, ...]


@dataclass(frozen=True)
class TorqueUnit:
    """The unit of the torque, by its size."""

    unit: Literal["mN.m", "kN.m"]


@dataclass(frozen=True)
class StatedPayload:
    """Mass of the payload of the cell [kg]."""

    mass: float


@dataclass(frozen=True)
class ErrorAsRead:
    """Relative error of the torque as read."""

    error: float


@dataclass(frozen=True)
class TorqueDelay:
    """Delay of the torque behind the position [s], negative before it."""

    delay: float
    confirmed: bool


@dataclass(frozen=True)
class LowPassedTorque:
    """Bandwidth of the torque [Hz]; `confirmed` if nothing that resembles it predicts as well."""

    bandwidth: float
    confirmed: bool = True


Reading = (
    Fact
    | ClockReading
    | RowsReading
    | Channels
    | JointOrder
    | NotSlopes
    | ZeroTorques
    | StillJoints
    | Wrapped
    | OutsideLimits
    | CoarsePositions
    | SmoothPositions
    | Changes
    | FoundChange
    | ColumnOrder
    | AngleUnit
    | Mounting
    | Either
    | UnseenZeros
    | TorqueUnit
    | StatedPayload
    | ErrorAsRead
    | TorqueDelay
    | LowPassedTorque
    | OtherTimes
)
"""What a row concludes."""


class Basis(Enum):
    """Evidence without a figure."""

    GIVEN_RATE = auto()
    ESTIMATED_TIMES = auto()
    MAP = auto()
    DATA_SET = auto()
    MESSAGE_TYPE = auto()
    USUAL_RATE = auto()
    STATED_UNIT = auto()
    NAME_AND_RATE = auto()
    ROW_NAMES = auto()
    NO_TURN = auto()
    TURNS = auto()
    EVERY_ROW = auto()
    POSITIONS_ALONE = auto()
    LIMITS = auto()
    NAME = auto()
    NAME_OR_UNIT = auto()
    CHANNELS = auto()
    ENCODER_NOISE = auto()
    SMALL_NOISE = auto()
    NO_NOISE = auto()
    HIDDEN_BY_ROUNDING = auto()
    NO_MOTION = auto()
    DRIVING_FRICTION = auto()  #: of the reading as recorded
    DISSIPATION = auto()  #: in every joint
    NOT_EXAMINED = auto()
    SIZE_UNTESTED = auto()
    CELL = auto()
    LAST_BODY_UNDETERMINED = auto()
    NO_GEOMETRY = auto()
    NO_ROW = auto()
    NO_FILTER_BETTER = auto()
    FREE_PARAMETERS = auto()
    NO_BODIES = auto()
    NO_GRAVITY = auto()
    LITTLE_INERTIA = auto()
    RATE = auto()
    INTEGRAL = auto()  #: of the torque follows the arm
    INERTIA = auto()  #: is that for other times, with the weight of the URDF


@dataclass(frozen=True)
class Travel:
    """The shortest travel of a joint, or the longest of the joints at rest [rad or m]."""

    travel: float
    at_least: bool


@dataclass(frozen=True)
class Correlation:
    """The smallest correlation of a velocity with the slope of its position."""

    correlation: float


@dataclass(frozen=True)
class SlopeRatio:
    """Slope of the positions over velocity, the mean of all joints."""

    ratio: float


@dataclass(frozen=True)
class SlopeFactors:
    """Velocity over slope of the position, by joint."""

    factors: Mapping[str, float]


@dataclass(frozen=True)
class LateVelocity:
    """Lag of the velocity behind the slope of the positions [s]."""

    lag: float


@dataclass(frozen=True)
class ErrorRatio:
    """Ratio of the torque error to the error as recorded; difference in standard errors."""

    ratio: float
    sigmas: float


@dataclass(frozen=True)
class NextBest:
    """The change that comes nearest, with the ratio of its error."""

    change: ArmChange
    ratio: float


@dataclass(frozen=True)
class NearestZero:
    """The zero that comes nearest, with the ratio of its error."""

    change: ArmChange
    ratio: float


@dataclass(frozen=True)
class MirrorImage:
    """A mirror image of the arm (positions and torques negated) that explains the torque too."""

    change: ArmChange


@dataclass(frozen=True)
class UnseenFriction:
    """Joints whose friction is not visible."""

    joints: tuple[str, ...]


@dataclass(frozen=True)
class RigidShare:
    """Torque of bodies over friction at most, and over the torque of the URDF's masses."""

    over_friction: float
    scale: float


@dataclass(frozen=True)
class OtherScales:
    """Factors of positions with which the torque fits better; empty where it shows no scale."""

    factors: tuple[tuple[str, float], ...]


@dataclass(frozen=True)
class SpringsAlike:
    """Springs of some joints, and the error with them over that with a change that was found."""

    joints: tuple[str, ...]
    ratio: float


@dataclass(frozen=True)
class NoBetter:
    """Changes that fit best, but not better than by chance."""

    changes: tuple[ArmChange, ...]


@dataclass(frozen=True)
class FreeFit:
    """Error over the error of a fit with free masses, zeros and scales."""

    ratio: float


@dataclass(frozen=True)
class ErrorExplained:
    """Relative error of the torque as read, with what explains it: a low-pass, rotors, springs."""

    error: float
    how: ExplainedTorque


@dataclass(frozen=True)
class CorrectedError:
    """Ratio of the error of predicted parts with a change corrected to the error without."""

    ratio: float


@dataclass(frozen=True)
class RivalChanges:
    """Sets of changes that explain a part equally well, the best first."""

    changes: tuple[tuple[Change, ...], ...]
    joints: tuple[str, ...]


@dataclass(frozen=True)
class PartError:
    """Ratio of the error of a part, corrected, to the error of the rest."""

    ratio: float


@dataclass(frozen=True)
class StillUnexplained:
    """Share of the torque that the arm does not explain, for which no row is certain."""

    error: float


@dataclass(frozen=True)
class SizeRatio:
    """Measured torque over the torque that the arm needs, by its masses or by its reach."""

    ratio: float
    by_masses: bool


@dataclass(frozen=True)
class LastBody:
    """Parameters of the last body that the motion determines."""

    determined: int
    total: int
    joint: str


@dataclass(frozen=True)
class DelayInterval:
    """Half a 95 % interval [s], with the delay if the interval contains it.

    `unconfirmed` says that other parts of the recording are not predicted better with the delay.
    """

    half: float
    delay: float | None = None
    unconfirmed: bool = False


@dataclass(frozen=True)
class LowPassLag:
    """Delay of a slow motion by a low-pass of the torque, and the total lag [s]."""

    lag: float
    delay: float


@dataclass(frozen=True)
class DelayProblem:
    """Why no delay is known: the estimate that does not determine it."""

    estimate: DelayEstimate


@dataclass(frozen=True)
class FilterShape:
    """The shape of the low-pass that fits better; `confirmed` as in `LowPassedTorque`."""

    order: int
    causal: bool
    confirmed: bool = True


@dataclass(frozen=True)
class BeyondRange:
    """How far a joint moves beyond its range [rad or m]."""

    joint: str
    excess: float
    turns: bool


@dataclass(frozen=True)
class BeyondSpeed:
    """Speed of a joint over its largest."""

    joint: str
    ratio: float


@dataclass(frozen=True)
class BeyondEffort:
    """Torque of a joint over its limit."""

    joint: str
    ratio: float


@dataclass(frozen=True)
class BeyondMasses:
    """Torque over the torque that the arm needs, by its masses or by its reach."""

    ratio: float
    by_masses: bool


@dataclass(frozen=True)
class OtherLengths:
    """Lengths of the links over the URDF's, with the errors of both."""

    factor: float
    error: float
    stated: float


@dataclass(frozen=True)
class UnexplainedTorque:
    """Share of the torque that no masses explain."""

    error: float


@dataclass(frozen=True)
class OtherAxes:
    """Aspects of the axes that had to be changed."""

    aspects: tuple[str, ...]


Contradiction = (
    BeyondRange
    | BeyondSpeed
    | BeyondEffort
    | BeyondMasses
    | OtherLengths
    | UnexplainedTorque
    | OtherAxes
)
"""What contradicts the arm of the URDF."""


@dataclass(frozen=True)
class NoJointTorque(Conclusion):
    """A channel named as a torque that is not one, such as the load or duty cycle of a servo.

    Attributes:
        unexplained: share of it that no masses of the arm explain; None where that is not why.
        is_load: whether its name says so. Without both it has no sign, although joints move in both
            directions.
        ratio: of a load to the torque that the URDF's masses need; None where it is not known.
    """

    unexplained: float | None = None
    is_load: bool = False
    ratio: float | None = None


Evidence = (
    CopiedCommands
    | Basis
    | ChannelMeaning
    | EpisodeUnits
    | ConcludedUnit
    | StatedUnit
    | FixedFingers
    | RecordedArm
    | Travel
    | Correlation
    | SlopeRatio
    | SlopeFactors
    | LateVelocity
    | ErrorRatio
    | NextBest
    | NearestZero
    | MirrorImage
    | UnseenFriction
    | StillUnexplained
    | CorrectedError
    | RivalChanges
    | PartError
    | ErrorExplained
    | NoBetter
    | SpringsAlike
    | OtherScales
    | FreeFit
    | RigidShare
    | SizeRatio
    | LastBody
    | DelayInterval
    | LowPassLag
    | DelayProblem
    | FilterShape
    | Contradiction
    | NoJointTorque
    | SampleTimes
    | TimeBase
)
"""From what a row concludes."""


class NextStep(Enum):
    """How a person decides a row: state an option or a key, measure, or find out."""

    STATE_UNIT_OR_GEARS = auto()
    STATE_GRAVITY = auto()
    STATE_UNITS = auto()
    STATE_DRIVE = auto()
    STATE_TORQUE_CONSTANT = auto()
    NAME_JOINTS = auto()
    ESTIMATE_DELAY = auto()
    GIVE_URDF = auto()
    GIVE_URDF_OF_THIS_ARM = auto()
    CHECK_COLUMNS = auto()
    MOVE_ALL_OR_LOCK = auto()
    MOVE_EACH_JOINT = auto()
    PUSH_A_JOINT = auto()
    REVERSE_THE_ROWS = auto()
    STATE_RATE = auto()
    COMPARE_A_POSTURE = auto()
    WEIGH_A_LOAD = auto()
    RECORD_ALL_TORQUE = auto()
    TURN_ONE_JOINT = auto()
    HOLD_STILL = auto()
    RECORD_MEASURED = auto()
    RECORD_MEASURED_IF_ANY = auto()
    RECORD_TORQUE = auto()
    RECORD_FASTER = auto()
    RECORD_PAYLOAD = auto()
    IMPORT_COMMANDS = auto()
    CHECK_ENCODER = auto()
    CHECK_ENCODER_MOUNTING = auto()
    DESCRIBE_SPRING = auto()
    CUT_THE_RECORDING = auto()
    RECORD_COMMANDS = auto()
    ASK_FOR_POSITIONS = auto()
    ASK_FOR_UNIT = auto()
    ASK_FOR_FILTER = auto()


@dataclass(frozen=True)
class MapKey:
    """A dotted key of a column map, whose value the user knows."""

    key: str


@dataclass(frozen=True)
class MapEntries:
    """Entries of a column map, by dotted key."""

    entries: tuple[tuple[str, Any], ...]


@dataclass(frozen=True)
class TorqueFactor:
    """A factor that brings a torque to the size that the arm needs."""

    factor: float


@dataclass(frozen=True)
class GravityOption:
    """``--gravity`` [m/s²]."""

    gravity: Vector


@dataclass(frozen=True)
class MotorTorque:
    """Torques of motors, behind gears of about this ratio for each joint.

    Of the joints `unseen` it is that of the others.
    """

    ratios: tuple[float, ...]
    unseen: tuple[str, ...]


@dataclass(frozen=True)
class MotorCurrents:
    """Currents of motors, of about this torque constant [N·m/A, with gears] for each joint.

    Of the joints `unseen` it is that of the others.
    """

    ratios: tuple[float, ...]
    unseen: tuple[str, ...]


Decider = (
    NextStep | MapKey | MapEntries | GravityOption | OutsideLimits | TorqueFactor | MotorTorque
)
"""What decides a row; positions outside the limits say by what they would be within them."""

Setting = MapEntries | GravityOption | MotorTorque | MotorCurrents
"""What states one of the readings that fit alike."""


@dataclass(frozen=True)
class ExplainedTorque(Conclusion):
    """A torque that follows the arm through a low-pass [Hz], or with heavy rotors or springs."""

    low_pass: float | None
    heavy_rotors: bool
    springs: tuple[str, ...] = ()  # joints


@dataclass(frozen=True)
class ReadAsGiven(Conclusion):
    """A torque read as recorded: this share stays unexplained, and no change explains more."""

    error: float
    no_better: NoBetter


@dataclass(frozen=True)
class DoubtfulArm(Conclusion):
    """What contradicts the arm of the URDF."""

    found: tuple[Contradiction, ...]


@dataclass(frozen=True)
class DoubtfulTime(Conclusion):
    """Recorded times that differ from the motion's by this factor."""

    factor: float
