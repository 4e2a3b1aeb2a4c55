"""Whose recording it is: the URDF and the model settings that travel in an imported archive."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hil.cell import Cell
from hil.cell.text import replaced_value
from hil.errors import SourceError
from hil.reading import remedy_of, text_of
from identification import FrictionLaw
from identification.errors import ModelError
from identification.kinematics import pinocchio_model
from planner.toml_value import toml_value

STANDARD_GRAVITY = (0.0, 0.0, -9.81)


@dataclass(frozen=True, eq=False)
class Robot:
    """The robot of a recording, as two texts that an archive carries.

    Attributes:
        cell: text of a cell file; the robot's table is all that identification needs of it.
        urdf: text of the robot description.
        joint_names: its joints that move and are not locked, in the order of the model.
    """

    cell: str
    urdf: str
    joint_names: tuple[str, ...]

    @classmethod
    def from_urdf(
        cls,
        path: str | PathLike[str],
        *,
        friction: FrictionLaw | None = None,
        gravity: Sequence[float] = STANDARD_GRAVITY,
        rotor_inertia: bool = True,
        locked: Mapping[str, float] | None = None,
    ) -> Robot:
        """Describe a robot by its URDF and the settings of its model.

        Args:
            path: the URDF file.
            friction: friction law of every joint, None for the default one.
            gravity: in the base frame [m/s²].
            rotor_inertia: give every joint a rotor inertia.
            locked: position [rad or m] of joints that are none of the model, such as those of a
                gripper that was not recorded.

        Raises:
            InputError: the file cannot be read, is no usable URDF, or has no such joint.
        """
        path = Path(path)
        try:
            urdf = text_of(path)
        except (OSError, UnicodeDecodeError) as error:
            why = error.strerror if isinstance(error, OSError) else error
            remedy = remedy_of(error, "name a URDF file")
            raise SourceError(path, f"cannot be read ({why})", remedy=remedy) from error
        try:
            pinocchio_model(urdf)
        except ModelError as error:  # told of this file, and not of a cell that nobody wrote
            raise SourceError(path, str(error), remedy="name a URDF file") from error
        law = friction or FrictionLaw()
        text = _cell_text(path.stem, law, gravity, rotor_inertia, locked or {})
        return cls._checked(text, urdf, path)

    @classmethod
    def from_cell(
        cls, path: str | PathLike[str], *, locked: Mapping[str, float] | None = None
    ) -> Robot:
        """Describe a robot by a cell file; see `from_urdf` for `locked`.

        Raises:
            InputError: the cell file or its URDF cannot be used, or has no such joint.
        """
        cell = Cell.load(Path(path))
        if not locked:
            return cls(cell.text, cell.urdf, cell.joint_names)
        text = _with_robot_entry(cell.text, "locked", {**cell.file.robot.locked, **locked})
        return cls._checked(text, cell.urdf, Path(path))

    def with_coupling(self, motor_from_joint: NDArray[np.float64]) -> Robot:
        """This robot with motors that turn with several joints, unless it says so itself.

        Args:
            motor_from_joint: motor angles per joint angle (n, n), in the order of its joints.

        Raises:
            InputError: the matrix does not fit.
        """
        path = Path("cell.toml")
        if Cell.from_texts(self.cell, self.urdf, path).file.robot.coupling is not None:
            return self
        rows = toml_value(motor_from_joint.tolist())
        text = f"{self.cell}\n[robot.coupling]\nmotor_from_joint = {rows}\n"
        return self._checked(text, self.urdf, path)

    @classmethod
    def _checked(cls, text: str, urdf: str, path: Path) -> Robot:
        return cls(text, urdf, Cell.from_texts(text, urdf, path).joint_names)

    def attachments(self) -> dict[str, bytes]:
        """The texts as files of an archive."""
        return {"cell.toml": self.cell.encode(), "robot.urdf": self.urdf.encode()}


def _cell_text(
    name: str,
    friction: FrictionLaw,
    gravity: Sequence[float],
    rotor_inertia: bool,
    locked: Mapping[str, float],
) -> str:
    """The smallest cell file: the robot alone, without limits, drive train or controller."""
    law = {
        "coulomb": friction.coulomb,
        "viscous": friction.viscous,
        "third": friction.third or "none",
        "offset": friction.offset,
        "standstill": friction.standstill,
        "stribeck": friction.stribeck or 0.0,
        "asymmetric": friction.asymmetric,
        "zone": friction.zone,
    }
    lines = [
        "[cell]",
        f"name = {toml_value(_writable(name)[:80] or 'robot')}",
        'urdf = "robot.urdf"',
        "",
        "[robot]",
        f"gravity = {toml_value([float(g) for g in gravity])}",
        f"rotor_inertia = {toml_value(rotor_inertia)}",
        *([f"locked = {_inline(locked)}"] if locked else []),
        "",
        "[robot.friction]",
        *(f"{key} = {toml_value(value)}" for key, value in law.items()),
    ]
    return "\n".join(lines) + "\n"


def _inline(table: Mapping[str, float]) -> str:
    return toml_value({_writable(name): float(position) for name, position in table.items()})


def _writable(name: str) -> str:
    """Return a name without what UTF-8 cannot hold, as names of files can."""
    return name.encode("utf-8", "replace").decode("utf-8")


def _with_robot_entry(text: str, key: str, table: Mapping[str, float]) -> str:
    try:
        return replaced_value(text, "robot", key, _inline(table))
    except ValueError:
        return f"{text}\n[robot]\n{key} = {_inline(table)}\n"
