"""What a cell file is checked for beyond its single fields."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from drivers.errors import DriverError

from .errors import CellError
from .urdf import urdf_limits

if TYPE_CHECKING:
    from .cell import Cell

URDF_ROUNDING = 1e-5
"""Relative; a data sheet's degrees and a URDF's radians are rounded differently."""

_NOT_PER_JOINT = {"gravity", "assumed", "elasticity"}


def check_lengths(cell: Cell) -> None:
    """Every list that has one entry per joint has as many as the URDF has joints."""
    n_joints = cell.model.n_joints
    simulation = cell.file.simulation
    if simulation is not None and len(simulation.elasticity) not in (0, n_joints):
        raise CellError(
            cell.path,
            "simulation.elasticity",
            simulation.elasticity,
            f"has {len(simulation.elasticity)} entries, the URDF {n_joints} joints",
            "give one for each joint, or none",
        )
    for name in cell.file.cell.assumed:
        table, _, field = name.partition(".")
        if field not in getattr(type(getattr(cell.file, table, None)), "model_fields", {}):
            raise CellError(
                cell.path,
                "cell.assumed",
                name,
                "names no field of this file",
                'name fields as "table.field"',
            )
    for table_name in ("nominal", "limits", "drive_train", "campaign", "simulation"):
        table = getattr(cell.file, table_name)
        for name, value in table or ():
            if isinstance(value, list) and name not in _NOT_PER_JOINT and len(value) != n_joints:
                raise CellError(
                    cell.path,
                    f"{table_name}.{name}",
                    value,
                    f"has {len(value)} entries but the URDF has {n_joints} joints",
                    f"give one entry for each of {', '.join(cell.joint_names)}",
                )


def check_built(cell: Cell) -> None:
    """What is built from the file later can be built: whatever that refuses is a bad field."""
    file = cell.file
    _build(cell, "workspace", "workspace")
    if file.drive_train is not None:
        _build(cell, "drive_train", "drive_train")
    if file.drive_train is not None and file.limits is not None:
        _build(cell, "limits", "joint_limits")
        _check_against_urdf(cell)
        _check_postures(cell)
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
                    "name a posture that the arm can take",
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
