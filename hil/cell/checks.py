"""What a cell file is checked for beyond its single fields."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from drivers.errors import DriverError

from .errors import CellError
from .text import urdf_limits

if TYPE_CHECKING:
    from .cell import Cell

URDF_ROUNDING = 1e-5
"""Relative; a data sheet's degrees and a URDF's radians are rounded differently."""

_SAME_NUMBER = 0.01  # relative
_FULL_TURN = 6.3  # degrees; as radians it is one turn

_MAY_BE_EMPTY = {
    "nominal.third",
    "limits.torque",
    "simulation.elasticity",
    "simulation.inertia_scale",
}
_PER_JOINT = ("nominal", "limits", "drive_train", "campaign", "simulation")
_TURNING_ONLY = ("limits", "drive_train", "campaign", "simulation")


def check_lengths(cell: Cell) -> None:
    """Every list that has one entry per joint has as many as the URDF has joints."""
    n_joints = cell.model.n_joints
    for table_name in (*_PER_JOINT, "simulation.drive_train"):
        for name, value in _table(cell, table_name) or ():
            field = f"{table_name}.{name}"
            if not isinstance(value, list) or len(value) == n_joints:
                continue
            if value or field not in _MAY_BE_EMPTY:
                or_none = " or none" if field in _MAY_BE_EMPTY else ""
                raise CellError(
                    cell.path,
                    field,
                    value,
                    f"has {len(value)} entries but the URDF has {n_joints} joints",
                    f"give one entry for each of {', '.join(cell.joint_names)}{or_none}",
                )


def _table(cell: Cell, dotted: str) -> Any:
    """A table, or one within it, by its name; None where there is none."""
    found: Any = cell.file
    for name in dotted.split("."):
        found = None if found is None else getattr(found, name)
    return found


def check_assumed(cell: Cell) -> None:
    """What is called assumed stands in the file."""
    for name in cell.file.cell.assumed:
        table, _, field = name.partition(".")
        known = table in type(cell.file).model_fields
        if known and getattr(cell.file, table) is None:
            raise CellError(
                cell.path,
                table,
                None,
                f"is missing, though cell.assumed names {name}",
                f"add a table [{table}], or take that name out",
            )
        if not known or field not in type(getattr(cell.file, table)).model_fields:
            raise CellError(
                cell.path,
                "cell.assumed",
                name,
                "names no field of this file",
                'name fields as "table.field"',
            )


def check_turning(cell: Cell) -> None:
    """What is given in degrees and revolutions is given for joints that turn."""
    tables = [name for name in _TURNING_ONLY if getattr(cell.file, name) is not None]
    revolute = cell.model.chain.revolute
    for name, turns in zip(cell.joint_names, revolute, strict=True):
        if tables and not turns:
            raise CellError(
                cell.path,
                tables[0],
                None,
                f"is in degrees and revolutions, but joint {name} slides",
                'fix it in the URDF (type = "fixed"); an arm with sliding joints can be '
                "identified from recordings, but not moved",
            )


def check_locked(cell: Cell) -> None:
    """Joints are locked for identification only: a motion is checked with the whole URDF."""
    tables = [name for name in _TURNING_ONLY if getattr(cell.file, name) is not None]
    if tables and cell.file.robot.locked:
        raise CellError(
            cell.path,
            "robot.locked",
            ", ".join(cell.file.robot.locked),
            f"is for arms that are identified from recordings, but there is a table [{tables[0]}]",
            'fix these joints in the URDF (type = "fixed")',
        )


def check_built(cell: Cell) -> None:
    """What is built from the file later can be built: whatever that refuses is a bad field."""
    file = cell.file
    _build(cell, "workspace", "workspace")
    if file.drive_train is not None:
        _build(cell, "drive_train", "drive_train")
    if file.limits is None:
        return
    if file.drive_train is not None or file.limits.frame == "urdf":
        _build(cell, "limits", "joint_limits")
        _check_degrees(cell)
        _check_against_urdf(cell)
        _check_postures(cell)
    if file.drive_train is not None:
        _build(cell, "bounds", "guard_limits")


def _build(cell: Cell, table: str, attribute: str) -> None:
    try:
        getattr(cell, attribute)
    except CellError:
        raise
    except (ValueError, DriverError) as error:
        raise CellError(cell.path, table, None, str(error), "correct that table") from error


def _check_postures(cell: Cell) -> None:
    """Postures named in the file lie inside its limits."""
    limits, file = cell.joint_limits, cell.file
    table = file.limits
    assert table is not None
    remedy = "name a posture that the arm can take"
    if np.abs([table.lower_deg, table.upper_deg]).max() < _FULL_TURN:
        remedy += (
            ", or correct the limits: no joint may go further than "
            f"{np.abs([table.lower_deg, table.upper_deg]).max():.4g}°; are they in rad? "
            "1 rad is 57.2958°"
        )
    postures = {}
    if file.campaign is not None:
        postures["campaign.home_deg"] = cell.home
    if file.simulation is not None:
        postures["simulation.initial_deg"] = cell.initial
    for field, posture in postures.items():
        for joint, name in enumerate(cell.joint_names):
            if not limits.lower[joint] <= posture[joint] <= limits.upper[joint]:
                raise CellError(
                    cell.path,
                    field,
                    None,
                    f"{name} stands outside [limits]",
                    remedy,
                )


def _check_degrees(cell: Cell) -> None:
    """No list in degrees holds what the URDF states in radians."""
    table, allowed = cell.file.limits, urdf_limits(cell.urdf, cell.joint_names)
    assert table is not None
    ranges = np.subtract(table.upper_deg, table.lower_deg)
    for field, given, radians, unit in (
        ("lower_deg", ranges, allowed.upper - allowed.lower, "rad"),
        ("velocity_deg", np.array(table.velocity_deg), allowed.velocity, "rad/s"),
    ):
        stated = np.isfinite(radians)
        if stated.any() and np.allclose(given[stated], radians[stated], rtol=_SAME_NUMBER):
            raise CellError(
                cell.path,
                f"limits.{field}",
                getattr(table, field),
                f"is in degrees, and the URDF has these numbers in {unit}",
                "multiply them by 57.2958"
                + (" (those of upper_deg too)" if field == "lower_deg" else ""),
            )


def _check_against_urdf(cell: Cell) -> None:
    """The cell may narrow what the URDF allows, never widen it."""
    limits, allowed = cell.joint_limits, urdf_limits(cell.urdf, cell.joint_names)
    for joint, name in enumerate(cell.joint_names):
        for field, value, bound, beyond in (
            ("lower_deg", limits.lower[joint], allowed.lower[joint], -1.0),
            ("upper_deg", limits.upper[joint], allowed.upper[joint], 1.0),
            ("velocity_deg", limits.velocity[joint], allowed.velocity[joint], 1.0),
        ):
            if beyond * (value - bound) > URDF_ROUNDING * max(1.0, abs(bound)):
                raise CellError(
                    cell.path,
                    f"limits.{field}",
                    None,
                    f"{name} may go to {np.degrees(value):.6g}° (URDF angle or speed), beyond the "
                    f"URDF's {np.degrees(bound):.6g}°",
                    "narrow it, or correct the URDF",
                )
