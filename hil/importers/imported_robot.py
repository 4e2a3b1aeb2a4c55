"""The robot of an imported recording, from its URDF or a cell file."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hil.base.errors import SourceError
from hil.base.safe_input import read_input
from hil.base.toml_text import to_text
from hil.cell import Cell
from hil.cell.arms import Links, joints_outside
from hil.cell.gripper_names import gripper_joints
from hil.cell.nominal import nominal_of
from hil.cell.toml_edits import with_values
from hil.cell.urdf_unit_problem import unit_problem
from hil.importers.dh import Convention, urdf_of_dh
from hil.importers.plausibility import (
    NominalTorque,
)
from identification.errors import ModelError
from identification.model.friction import FrictionLaw
from identification.model.joint_ranges import urdf_limits
from identification.model.kinematics import pinocchio_model
from identification.model.robot import STANDARD_GRAVITY

IMPORTED_LAW: Final = FrictionLaw(third=None, offset=True)
"""Default friction law of an imported robot. A term in v² or v³ that the motion does not need makes
the prediction of a faster one worse."""
NOT_RECORDED: Final = "lock joints that were not recorded (--locked NAME, or all: --lock-others)"
"""Remedy where the robot has more joints than the recording."""


@dataclass(frozen=True, eq=False)
class Robot:
    """The robot of a recording."""

    cell: str  #: text of a cell file, of which identification needs the robot's table only
    urdf: str  #: text of the robot description
    joint_names: tuple[str, ...]  #: that move and are not locked, in the order of the model
    locked: Mapping[str, float] = field(default_factory=dict)  #: positions [rad or m] by joint
    links: Links = field(default_factory=Links)  #: between which its joints lie, of several arms

    @classmethod
    def from_urdf(
        cls,
        path: str | PathLike[str],
        *,
        convention: Convention | None = None,
        friction: FrictionLaw | None = None,
        gravity: Sequence[float] = STANDARD_GRAVITY,
        locked: Mapping[str, float] | None = None,
        recorded: Collection[str] | None = None,
        links: Links = Links(),  # noqa: B008 - frozen
    ) -> Robot:
        """Return a robot by its URDF and the settings of its model.

        Args:
            path: the URDF file, or a table of Denavit-Hartenberg parameters, which has no masses.
            convention: of such a table, see :func:`hil.importers.dh.urdf_of_dh`; None for a URDF.
            friction: friction law of every joint, None for `IMPORTED_LAW`.
            gravity: in the base frame [m/s²].
            locked: position [rad or m] of joints that are not in the model, such as a gripper's.
            recorded: recorded joints; all others are locked at zero, or at the middle of their
                range if that excludes zero. None: only those in `locked` are.
            links: of a robot with several arms, those between which the recorded one lies; all
                other joints are locked like those that were not recorded.

        Raises:
            InputError: the file cannot be read, is not a valid URDF, or has no such joint.
        """
        path = Path(path)
        otherwise = "give a URDF file"
        urdf = read_input(path, otherwise) if convention is None else urdf_of_dh(path, convention)
        try:
            pinocchio_model(urdf)
        except ModelError as error:  # an error of this file, not of a cell file
            raise SourceError(path, str(error), remedy=otherwise) from error
        if (units := unit_problem(urdf)) is not None:
            raise SourceError(path, units.problem, field=units.field, remedy=units.remedy)
        held = _held(urdf, locked or {}, recorded, path, links)
        text = _cell_text(path.stem, friction or IMPORTED_LAW, gravity, held)
        return cls._checked(text, urdf, path, links)

    @classmethod
    def from_cell(
        cls,
        path: str | PathLike[str],
        *,
        gravity: Sequence[float] | None = None,
        locked: Mapping[str, float] | None = None,
        recorded: Collection[str] | None = None,
        links: Links = Links(),  # noqa: B008 - frozen
    ) -> Robot:
        """Return a robot by a cell file.

        Args:
            path: of the file.
            gravity: (3,) [m/s²] in base axes; default: the cell's.
            locked: positions by name [rad or m] of joints to be fixed in addition to the joints of
                the cell.
            recorded: names of the joints that were recorded; see `from_urdf`.
            links: of a robot with several arms; likewise.

        Raises:
            InputError: the cell file or its URDF is invalid, or has no such joint.
        """
        path = Path(path)
        cell = Cell.load(path)
        text = cell.text
        stated = {**cell.file.robot.locked, **(locked or {})}
        held = _held(cell.urdf, stated, recorded, path, links)
        if held != cell.file.robot.locked:
            text = with_values(text, {"robot.locked": _writable_names(held)})
        if gravity is not None:
            text = with_values(text, {"robot.gravity": [float(value) for value in gravity]})
        return cls._checked(text, cell.urdf, path, links)

    def with_coupling(self, motor_from_joint: NDArray[np.float64]) -> Robot:
        """Return this robot with coupled motors, unless its cell states a coupling.

        `motor_from_joint` are motor angles per joint angle (n, n), in the order of its joints.
        """
        path = Path("cell.toml")
        if Cell.from_texts(self.cell, self.urdf, path).file.robot.coupling is not None:
            return self
        text = with_values(
            self.cell, {"robot.coupling.motor_from_joint": motor_from_joint.tolist()}
        )
        return self._checked(text, self.urdf, path, self.links)

    def with_gravity(self, gravity: Sequence[float]) -> Robot:
        """Return this robot under another gravity in the base frame [m/s²]."""
        values = {"robot.gravity": [float(value) for value in gravity]}
        text = with_values(self.cell, values)
        return self._checked(text, self.urdf, Path("cell.toml"), self.links)

    def without_gripper(self, recorded: Collection[str] = ()) -> Robot:
        """Return this robot with the joints of a gripper fixed, except recorded ones."""
        fingers = [
            name for name in gripper_joints(self.urdf, self.joint_names) if name not in recorded
        ]
        if len(fingers) in (0, len(self.joint_names)):
            return self
        held = {**self.locked, **_places(self.urdf, fingers)}
        text = with_values(self.cell, {"robot.locked": _writable_names(held)})
        return self._checked(text, self.urdf, Path("cell.toml"), self.links)

    def between(self, links: Links, path: Path | None = None) -> Robot:
        """Return this robot with all joints fixed that do not lie between two links.

        Raises:
            InputError: of the file `path`: there are no such links, or no joint between them.
        """
        outside = joints_outside(path, self.urdf, links, self.joint_names)
        held = {**self.locked, **_places(self.urdf, outside)}
        text = with_values(self.cell, {"robot.locked": _writable_names(held)})
        return self._checked(text, self.urdf, Path("cell.toml"), links)

    @classmethod
    def _checked(cls, text: str, urdf: str, path: Path, links: Links) -> Robot:
        cell = Cell.from_texts(text, urdf, path)
        return cls(text, urdf, cell.joint_names, cell.file.robot.locked, links)

    def nominal_torque(self) -> NominalTorque | None:
        """Return the torque of the nominal inertias; None if the URDF has no masses."""
        cell = Cell.from_texts(self.cell, self.urdf, Path("cell.toml"))
        nominal = nominal_of(cell)
        if nominal is None:
            return None
        return partial(cell.model.torque, nominal.values)

    def attachments(self) -> dict[str, bytes]:
        """Return the texts as attachments of an archive."""
        return {"cell.toml": self.cell.encode(), "robot.urdf": self.urdf.encode()}


def _cell_text(
    name: str, friction: FrictionLaw, gravity: Sequence[float], locked: Mapping[str, float]
) -> str:
    """Return a minimal cell file: the robot, without limits, drive train or controller."""
    robot = {
        "gravity": [float(value) for value in gravity],
        "rotor_inertia": True,
        "locked": _writable_names(locked) or None,
        "friction": friction.table(),
    }
    return to_text(
        {"cell": {"name": _writable(name)[:80] or "robot", "urdf": "robot.urdf"}, "robot": robot}
    )


def _held(
    urdf: str,
    locked: Mapping[str, float],
    recorded: Collection[str] | None,
    path: Path,
    links: Links,
) -> dict[str, float]:
    """Return the positions of locked joints: the given ones, and all that were not recorded.

    With `links` also those that do not lie between them.
    """
    if links:
        names = tuple(pinocchio_model(urdf).names)[1:]
        places = _places(urdf, joints_outside(path, urdf, links, names))
        locked = {**places, **locked}
    if recorded is None:
        return dict(locked)
    names = tuple(pinocchio_model(urdf).names)[1:]
    if not set(names) & set(recorded):
        problem = f"none of its joints {', '.join(names)} was recorded"
        remedy = (
            f"recorded are {', '.join(recorded)}; use the names of the URDF (joints in the map of "
            "a log, --rename RECORDED=URDF of a bag)"
        )
        raise SourceError(path, problem, field="--lock-others", remedy=remedy)
    unrecorded = [name for name in names if name not in recorded]
    return _places(urdf, unrecorded) | {**locked}


def _places(urdf: str, names: Sequence[str]) -> dict[str, float]:
    """Return zero for each joint, or the middle of its range if that excludes zero."""
    limits = urdf_limits(urdf, names)
    return {
        name: 0.0 if low <= 0.0 <= high else 0.5 * (low + high)
        for name, low, high in zip(names, limits.lower.tolist(), limits.upper.tolist(), strict=True)
    }


def _writable(name: str) -> str:
    """Return a file name with characters that UTF-8 cannot hold replaced."""
    return name.encode("utf-8", "replace").decode("utf-8")


def _writable_names(positions: Mapping[str, float]) -> dict[str, float]:
    return {_writable(name): float(position) for name, position in positions.items()}
