"""Conclusions of an import, as values; :mod:`hil.importers.messages` words them.

Nothing reads the words back: what follows from a conclusion follows from its fields.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import Enum, StrEnum, auto
from typing import Literal, Self

from hil.cell.arms import Links
from hil.importers.units import Kind
from identification.signals.sample_times import TimeBase

Sample = Literal["row", "message"]
"""What one sample of a recording is called: a row of a log, a message of a bag."""


class Certainty(StrEnum):
    """How certain a conclusion is; persons and programs read the value."""

    CERTAIN = "certain"  #: nothing else fits
    LIKELY = "likely"  #: by names or custom
    UNDETERMINED = "undetermined"  #: the recording does not say


class NameBasis(Enum):
    """Source of a channel's quantity."""

    NAME = auto()
    JOINT = auto()  #: a name that contains the name of a URDF joint
    UNIT = auto()  #: the unit alone: the name says nothing
    WORD = auto()  #: a word in the name
    WORDS = auto()  #: a word in each of several names, one for each joint
    READY_MAP = auto()
    OPTION = auto()  #: ``--columns``
    FILE = auto()  #: the name of the file
    MESSAGE = auto()  #: the field of a message
    COMMANDS = auto()  #: a topic of commands that the positions follow


class UnitBasis(Enum):
    """Source of a channel's unit."""

    LOG = auto()  #: the log states it
    MAP = auto()  #: a ready map states it
    MESSAGE = auto()  #: the type of the message has it
    CUSTOM = auto()  #: nothing states it; most logs have it
    NUMBERS = auto()  #: nothing states it: concluded from the numbers
    OPTION = auto()  #: the user named the channel


@dataclass(frozen=True)
class Conclusion:
    """One thing that was concluded of a recording, or found in it."""


@dataclass(frozen=True)
class ChannelMeaning(Conclusion):
    """The quantity of a group of channels.

    Attributes:
        channels: their name, or the first and the last.
        unit: None where neither log nor map states one.
        origin: of the ready map its name, of commands what their messages are.
    """

    channels: str
    kind: Kind
    basis: NameBasis
    unit: str | None
    unit_basis: UnitBasis
    origin: str = ""

    @property
    def certainty(self) -> Certainty:
        """Names are custom; a unit that the log states belongs to one quantity."""
        return Certainty.CERTAIN if self.unit_basis is UnitBasis.LOG else Certainty.LIKELY


@dataclass(frozen=True)
class UnusedChannels(Conclusion):
    """Channels of no quantity."""

    channels: tuple[str, ...]


@dataclass(frozen=True)
class JointOrder(Conclusion):
    """Joints that the rows of a log name, in their order."""

    joints: tuple[str, ...]


@dataclass(frozen=True)
class FixedFingers(Conclusion):
    """Joints of a gripper that was not recorded, where they are held, and in which unit."""

    positions: Mapping[str, float]
    units: Mapping[str, str]


class UnitsFrom(Enum):
    """Source of the units of a LeRobot data set."""

    OPTION = auto()
    ENCODER = auto()  #: the numbers are in steps of an encoder
    CALIBRATION = auto()  #: a number would be outside the calibrated range in degrees
    BEYOND_RANGE = auto()  #: a number is above 100
    BEYOND_LIMITS = auto()  #: a number would be outside the limits of the URDF in degrees


@dataclass(frozen=True)
class EpisodeUnits(Conclusion):
    """Units of the joints of a data set of LeRobot.

    Attributes:
        unit: degrees, radians, or -100 to 100 of the calibrated range.
        basis: from what that is known.
    """

    unit: Literal["deg", "rad", "range"]
    basis: UnitsFrom


@dataclass(frozen=True)
class RecordedArm(Conclusion):
    """The arm that was recorded, of several: its first and last joint.

    Attributes:
        by_names: whether the names of the recorded joints say so, else their number.
    """

    arm: str
    links: Links
    by_names: bool


@dataclass(frozen=True)
class MappedUnit(Conclusion):
    """The unit of a map that differs from the one that the file states; the map's is used."""

    kind: Kind
    unit: str
    stated: str


@dataclass(frozen=True)
class StatedUnit(Conclusion):
    """The unit that the file states and the map does not."""

    kind: Kind
    unit: str

    @property
    def certainty(self) -> Certainty:
        """It is stated."""
        return Certainty.CERTAIN


@dataclass(frozen=True)
class ConcludedUnit(Conclusion):
    """The unit that the numbers have, where nothing states one.

    Of a time it gives a usual rate; positions are within the limits of the URDF in it, which they
    leave by far in radians; velocities are then the slopes of the positions.
    """

    kind: Kind
    unit: str

    @property
    def certainty(self) -> Certainty:
        """Two units of time may give usual rates; limits and slopes exclude all others."""
        return Certainty.LIKELY if self.kind == "time" else Certainty.CERTAIN

    @property
    def decided_by(self) -> str:
        """The key of a column map that states it."""
        return f"{self.kind}.unit"


@dataclass(frozen=True)
class EncoderTicks(ConcludedUnit):
    """Positions that are ticks of an encoder, as servos write them.

    Attributes:
        ticks: of one turn, or of what the servo turns.
        middle: the tick that is read as zero.
    """

    ticks: int
    middle: int

    @property
    def certainty(self) -> Certainty:
        """Within limits as ticks; the zero of the URDF may be at another one."""
        return Certainty.LIKELY

    @property
    def decided_by(self) -> str:
        """The key of a column map that states the zero."""
        return f"{self.kind}.offset"


class Omitted(Enum):
    """What an import leaves out."""

    ZERO_TIMES = auto()  #: rows before the clock was there
    NO_STAMPS = auto()  #: the same of messages
    HEADERS = auto()  #: lines of a header that was written again
    EMPTY_LINES = auto()  #: between the rows
    CUT_ROW = auto()  #: the last, of a log that was cut off in it
    SOME_JOINTS = auto()  #: messages with some of the joints only


@dataclass(frozen=True)
class LeftOut(Conclusion):
    """Rows, lines or messages that were left out."""

    what: Omitted
    count: int


@dataclass(frozen=True)
class Excerpt(Conclusion):
    """Rows of a long recording that were read, and of how many."""

    count: int
    total: int
    stretches: int


@dataclass(frozen=True)
class MissingNumbers(Conclusion):
    """Rows left out because a number is missing."""

    count: int
    total: int
    before: int  #: rows before the first of them


@dataclass(frozen=True)
class CounterContinued(Conclusion):
    """A clock of limited range that was continued where it began again."""

    clock: str
    times: int


@dataclass(frozen=True)
class ClockRestarted(Conclusion):
    """Motions in one log, each with a clock that begins again."""

    parts: int


@dataclass(frozen=True)
class RowCounter(Conclusion):
    """A column of times that counts the rows, and the unit that a map states for it."""

    column: str
    unit: str


@dataclass(frozen=True)
class CopiedCommands(Conclusion):
    """Positions that are commands bit for bit; `measured` are channels that may be measured."""

    commands: str
    measured: tuple[str, ...]


@dataclass(frozen=True)
class SortedSamples(Conclusion):
    """Samples that came before an older one, and were sorted."""

    count: int
    sample: Sample


@dataclass(frozen=True)
class SecondPublisher(Conclusion):
    """Samples of one pose between others that move, left out; `pose` is empty where all are 0."""

    count: int
    total: int
    pose: tuple[float, ...]  #: [rad or m]
    sample: Sample


@dataclass(frozen=True)
class MergedMessages(Conclusion):
    """Joints whose states come in messages of their own."""

    groups: tuple[tuple[str, ...], ...]
    same_stamps: bool  #: else interpolated to the stamps of the first


@dataclass(frozen=True)
class OneTimeBase(Conclusion):
    """Quantities with times of their own, interpolated to the times of one of them.

    Attributes:
        counts: samples of each quantity.
        base: the one whose stamps were kept.
        left_out: of its samples, where another was not recorded.
    """

    counts: Mapping[str, int]
    base: str
    left_out: int


@dataclass(frozen=True)
class OtherClock(Conclusion):
    """Commands on another clock than the positions, to which the motion moved them.

    Attributes:
        offset: that was added to their times [s].
    """

    offset: float


@dataclass(frozen=True)
class PartialVelocity(Conclusion):
    """Joints without velocity, for which it was left out of all."""

    joints: tuple[str, ...]


@dataclass(frozen=True)
class NotCommands(Conclusion):
    """A topic of commands that was not used; `problem` says what is wrong with its messages."""

    topic: str
    problem: str


@dataclass(frozen=True)
class DifferentCommands(Conclusion):
    """Two topics that command different positions; neither is used."""

    topics: tuple[str, str]


@dataclass(frozen=True)
class KnownCommands(Conclusion):
    """The share of the samples at which a command is known."""

    count: int
    total: int


@dataclass(frozen=True)
class TooFewSamples(Conclusion):
    """A recording that is too short to be examined."""

    count: int


@dataclass(frozen=True)
class LockedJoints(Conclusion):
    """Joints that are no part of the model, where they are held, and in which unit."""

    positions: Mapping[str, float]
    units: Mapping[str, str]


@dataclass(frozen=True)
class RecordedClock(Conclusion):
    """The time base of a recording."""

    base: TimeBase


@dataclass(frozen=True)
class JointRange(Conclusion):
    """Range of the positions of a joint and its limits in the URDF [rad or m]."""

    joint: str
    low: float
    high: float
    turns: bool
    limits: tuple[float, float] | None


@dataclass(frozen=True)
class UnusualRate(Conclusion):
    """A rate at which no robot is sampled [Hz]."""

    rate: float


@dataclass(frozen=True)
class SameStamp(Conclusion):
    """Samples of one stamp that are far apart [unit], and how many stamps have such."""

    apart: float
    count: int
    unit: str


@dataclass(frozen=True)
class Alternation(Conclusion):
    """Samples that go to and fro between two sequences, and how far apart they are [unit]."""

    apart: float
    count: int
    unit: str


class Within(Enum):
    """How positions that leave the limits of the URDF would be within them."""

    DEGREES = auto()  #: as degrees that are read as radians
    ORDER = auto()  #: in another order of the joints
    NOTHING = auto()


@dataclass(frozen=True)
class OutsideLimits(Conclusion):
    """Positions that leave the limits of the URDF.

    Attributes:
        fraction: of the rows, 1 for all.
        ranges: of the joints that leave them [rad or m].
        within: how none would.
        order: of the joints in that case.
    """

    fraction: float
    ranges: Mapping[str, tuple[float, float]]
    within: Within
    order: tuple[str, ...] = ()


@dataclass(frozen=True)
class LittleMotion(Conclusion):
    """The farthest that any joint moves [rad or m], and whether that joint is revolute."""

    travel: float
    turns: bool


@dataclass(frozen=True)
class FastJoint(Conclusion):
    """The speed of a joint, and its limit in the URDF [rad/s or m/s]."""

    joint: str
    speed: float
    limit: float


@dataclass(frozen=True)
class VelocityOrder(Conclusion):
    """Another order in which the velocities are the slopes of the positions.

    `deviation` is that of the velocities as mapped [%], `least` that in this order.
    """

    order: tuple[str, ...]
    deviation: float
    least: float


@dataclass(frozen=True)
class UnrelatedVelocity(Conclusion):
    """A velocity that does not follow the position of its joint."""

    joint: str
    correlation: float


@dataclass(frozen=True)
class ScaledVelocity(Conclusion):
    """Velocities that are a multiple of the slope of their position."""

    factors: Mapping[str, float]


@dataclass(frozen=True)
class NoTorque(Conclusion):
    """A recording without torque and motor current."""

    is_commanded: bool  #: whether it has commanded positions


@dataclass(frozen=True)
class ZeroTorque(Conclusion):
    """A joint whose torque is zero throughout."""

    joint: str


@dataclass(frozen=True)
class ConstantTorque(Conclusion):
    """A joint that moved under one and the same torque [N·m or N], which was not measured."""

    joint: str
    torque: float


@dataclass(frozen=True)
class LargeTorque(Conclusion):
    """The largest torque of a joint, and its limit in the URDF, in its unit (N·m or N)."""

    joint: str
    torque: float
    limit: float
    unit: str


@dataclass(frozen=True)
class TorqueSize(Conclusion):
    """Torques of another order of magnitude than the arm needs.

    Attributes:
        ratios: of the measured torque, by joint.
        by_masses: whether over that of the URDF's masses, else over its effort limits.
        too_large: whether they are too large, else too small.
    """

    ratios: Mapping[str, float]
    by_masses: bool
    too_large: bool


@dataclass(frozen=True)
class ConstantPositions(Conclusion):
    """Joints with one and the same position in all samples while others move."""

    joints: tuple[str, ...]
    samples: int


@dataclass(frozen=True)
class StoppedJoint(Conclusion):
    """A joint whose position stays the same to the end while its command moves.

    Attributes:
        joint: name.
        time: from which on, after the start [s].
        travel: of the command after that.
        unit: of the travel, rad or m.
    """

    joint: str
    time: float
    travel: float
    unit: str


@dataclass(frozen=True)
class Examined:
    """Results of the examination of an imported recording.

    Attributes:
        found: what was concluded and left out, then time base and ranges.
        warnings: probable errors of the column map, or of the recording.
    """

    found: tuple[Conclusion, ...]
    warnings: tuple[Conclusion, ...]

    def without(self, kind: type[Conclusion]) -> Self:
        """Return the results without the warnings of one kind."""
        warnings = tuple(each for each in self.warnings if not isinstance(each, kind))
        return replace(self, warnings=warnings)
