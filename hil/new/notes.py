"""What the reader of a new cell file must know, as values; `hil.new.messages` words them."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, auto

from hil.cell.arms import Links
from identification.excitation.collision import PairExceptions


class PlainNote(Enum):
    """Notes without figures."""

    GEOMETRY_OF_TABLE = auto()  #: a URDF with the geometry of a table of DH parameters alone
    GEOMETRY_OF_ARM = auto()  #: a URDF with the calibrated geometry that an arm states alone
    NO_COLLISION_SHAPES = auto()  #: in the URDF
    NO_FLOOR = auto()  #: none is assumed, as no posture that was tried is clear of it
    EVERY_POSTURE_IN_CONTACT = auto()  #: no posture that was tried is clear
    UNKNOWN_TORQUE_CONSTANTS = auto()  #: the arm at rest does not show them
    TORQUE_CONSTANTS_OF_ARM = auto()  #: by the arm's own model


@dataclass(frozen=True)
class FixedOutside:
    """Joints that are fixed as they are not part of the chosen arm."""

    links: Links  #: between which the arm is
    joints: tuple[str, ...]


@dataclass(frozen=True)
class FixedPrismatic:
    """A prismatic joint that is fixed."""

    joint: str
    position: float  #: [m]


@dataclass(frozen=True)
class FixedMimic:
    """A joint that follows another one, and is fixed as the model does not support that."""

    joint: str
    leader: str
    position: float  #: [rad]


@dataclass(frozen=True)
class LiftingJoints:
    """Prismatic joints along gravity, which have no tables for motion."""

    joints: tuple[str, ...]


@dataclass(frozen=True)
class GripperJoints:
    """Joints of a gripper or hand, by name."""

    joints: tuple[str, ...]
    tip: str | None  #: last link of the arm, if there is one


@dataclass(frozen=True)
class SeveralBranches:
    """Joints that form more than one arm."""

    ends: tuple[str, ...]  #: last moving link of each


@dataclass(frozen=True)
class HomeNotChecked:
    """A home posture that could not be checked for collisions."""

    problem: str  #: as its error states it


@dataclass(frozen=True)
class CollisionExceptions:
    """Pairs of bodies that are not checked for collisions, or with a smaller margin."""

    exceptions: PairExceptions


@dataclass(frozen=True)
class ShapesNotFound:
    """Links whose collision shapes were not found, so that only their height was checked."""

    links: tuple[str, ...]


@dataclass(frozen=True)
class UnsupportedCycle:
    """A cycle of the controller that is not supported."""

    milliseconds: int


@dataclass(frozen=True)
class ClosedAxes:
    """Axes that are not open in the controller."""

    axes: tuple[int, ...]  #: from 1
    arm: int  #: from 1


@dataclass(frozen=True)
class FromSimulation:
    """An archive that a simulated controller made."""

    archive: str


@dataclass(frozen=True)
class NotAsked:
    """What could not be asked of an arm."""

    problem: str  #: as its error states it


@dataclass(frozen=True)
class PayloadWithoutFrame:
    """A payload of the controller whose frame is not in the URDF."""

    mass: float  #: [kg]


CellNote = (
    PlainNote
    | FixedOutside
    | FixedPrismatic
    | FixedMimic
    | LiftingJoints
    | GripperJoints
    | SeveralBranches
    | HomeNotChecked
    | CollisionExceptions
    | ShapesNotFound
    | UnsupportedCycle
    | ClosedAxes
    | FromSimulation
    | NotAsked
    | PayloadWithoutFrame
)
