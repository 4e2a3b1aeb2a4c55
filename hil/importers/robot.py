"""Whose recording it is: the URDF and the model settings that travel in an imported archive."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from xml.etree import ElementTree

from hil.cell import Cell
from hil.errors import InputError, SourceError
from identification import FrictionLaw

STANDARD_GRAVITY = (0.0, 0.0, -9.81)
_MOVING_ONLY = ("axis", "limit", "mimic", "dynamics", "safety_controller", "calibration")


@dataclass(frozen=True, eq=False)
class Robot:
    """The robot of a recording, as two texts that an archive carries.

    Attributes:
        cell: text of a cell file; the robot's table is all that identification needs of it.
        urdf: text of the robot description.
        joint_names: its moving joints, in the order of the model.
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
        fixed_joints: Sequence[str] = (),
    ) -> Robot:
        """Describe a robot by its URDF and the settings of its model.

        Args:
            path: the URDF file.
            friction: friction law of every joint, None for the default one.
            gravity: in the base frame [m/s²].
            rotor_inertia: give every joint a rotor inertia.
            fixed_joints: joints to hold at zero, such as those of a gripper that was not recorded.

        Raises:
            InputError: the file cannot be read, is no usable URDF, or has no such joint.
        """
        path = Path(path)
        try:
            urdf = path.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise SourceError(
                path, f"cannot be read ({error})", remedy="name a URDF file"
            ) from error
        text = _cell_text(path.stem, friction or FrictionLaw(), gravity, rotor_inertia)
        return cls._checked(text, _held(urdf, fixed_joints, path), path)

    @classmethod
    def from_cell(cls, path: str | PathLike[str], *, fixed_joints: Sequence[str] = ()) -> Robot:
        """Describe a robot by a cell file; see `from_urdf` for `fixed_joints`.

        Raises:
            InputError: the cell file or its URDF cannot be used, or has no such joint.
        """
        cell = Cell.load(Path(path))
        if not fixed_joints:
            return cls(cell.text, cell.urdf, cell.joint_names)
        return cls._checked(cell.text, _held(cell.urdf, fixed_joints, Path(path)), Path(path))

    @classmethod
    def _checked(cls, text: str, urdf: str, path: Path) -> Robot:
        return cls(text, urdf, Cell.from_texts(text, urdf, path).joint_names)

    def attachments(self) -> dict[str, bytes]:
        """The texts as files of an archive."""
        return {"cell.toml": self.cell.encode(), "robot.urdf": self.urdf.encode()}


def _cell_text(
    name: str, friction: FrictionLaw, gravity: Sequence[float], rotor_inertia: bool
) -> str:
    """The smallest cell file: the robot alone, without limits, drive train or controller."""
    law = {
        "coulomb": friction.coulomb,
        "viscous": friction.viscous,
        "third": friction.third or "none",
        "offset": friction.offset,
        "standstill": friction.standstill,
    }
    # JSON strings, numbers and booleans are TOML as well.
    lines = [
        "[cell]",
        f"name = {json.dumps(name[:80] or 'robot')}",
        'urdf = "robot.urdf"',
        "",
        "[robot]",
        f"gravity = {json.dumps([float(g) for g in gravity])}",
        f"rotor_inertia = {json.dumps(rotor_inertia)}",
        "",
        "[robot.friction]",
        *(f"{key} = {json.dumps(value)}" for key, value in law.items()),
    ]
    return "\n".join(lines) + "\n"


def _held(urdf: str, joints: Sequence[str], path: Path) -> str:
    """The description with these joints fixed at zero."""
    if not joints:
        return urdf
    try:
        root = ElementTree.fromstring(urdf)
    except ElementTree.ParseError as error:
        raise SourceError(path, f"is not a readable URDF: {error}") from error
    found = {joint.get("name", ""): joint for joint in root.findall("joint")}
    for name in joints:
        if name not in found:
            raise InputError(
                path,
                f"has no joint {name!r} to hold",
                field="fixed joints",
                remedy=f"its joints are {', '.join(found)}",
            )
        joint = found[name]
        joint.set("type", "fixed")
        for tag in _MOVING_ONLY:
            for child in joint.findall(tag):
                joint.remove(child)
    return ElementTree.tostring(root, encoding="unicode")
