"""What no simulation of a cell file can detect, as the simulated arm is made from it."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, auto

from hil.cell import Cell
from hil.control.motion_checks import collision_checker
from identification.excitation.collision import PairExceptions


class CopiedFigures(Enum):
    """Errors of figures that the simulated arm has as well, whatever the cell file states."""

    SCALES = auto()  #: torque constants and current limits
    SHAPES = auto()  #: floor, walls and shapes


@dataclass(frozen=True)
class UncheckedPairs:
    """Collisions of pairs of bodies that are not checked, or with a smaller margin."""

    exceptions: PairExceptions


@dataclass(frozen=True)
class CopiedDrives:
    """Errors of these fields of `[drive_train]`: the simulated arm has them."""

    fields: tuple[str, ...]


Undetected = CopiedFigures | UncheckedPairs | CopiedDrives


def undetected_of(cell: Cell) -> list[Undetected]:
    """Return what no simulation of this cell file can detect."""
    found: list[Undetected] = [*CopiedFigures]
    exceptions = collision_checker(cell).exceptions
    if any(exceptions):
        found.append(UncheckedPairs(exceptions))
    simulation = cell.file.simulation
    stated = set() if simulation is None else simulation.drive_train.model_fields_set
    copied = ("gear_ratio", "joint_sign", "joint_offset_deg")
    if unknown := tuple(name for name in copied if name not in stated):
        found.append(CopiedDrives(unknown))
    return found
