"""Limits that a connected controller announces, where they are narrower than the cell's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from drivers.init_check import AnnouncedLimits, narrower, shown
from hil.cell import Cell
from hil.motion_checks import MotionChecks

from .motion_link import Connection, drives_in_force

Array = NDArray[np.float64]


def controller_limits(cell: Cell, connection: Connection) -> AnnouncedLimits | None:
    """The limits of the cell's arm in the controller's init packet; None before there is one."""
    if connection.init is None:
        return None
    return AnnouncedLimits.of(connection.init, cell.controller.arm, len(cell.joint_names))


def checks_in_force(
    cell: Cell, connection: Connection, checks: MotionChecks | None = None
) -> MotionChecks:
    """What a motion to a connected controller is checked against.

    The narrower of the cell's and the controller's current limits count, and gears that were
    accepted from the controller; the very `checks` where both are the cell's.

    Args:
        cell: whose arm moves.
        connection: to its controller.
        checks: those of the cell, where they are at hand.
    """
    checks = MotionChecks.of(cell) if checks is None else checks
    if connection.adopted:
        gears = drives_in_force(cell, connection).motor_from_joint
        checks = replace(checks, currents=replace(checks.currents, motor_from_joint=gears))
    limits = controller_limits(cell, connection)
    return checks if limits is None else checks.within(limits.current)


def narrower_currents(cell: Cell, connection: Connection) -> tuple[str, ...]:
    """Current limits of the controller below the cell's, in words joint by joint."""
    limits = controller_limits(cell, connection)
    if limits is None:
        return ()
    ours = np.array(cell.drive_table.current_limit)
    return _below(cell, limits.current, ours, "A")


def narrower_thresholds(cell: Cell, connection: Connection) -> tuple[str, ...]:
    """Following-error thresholds of the controller below the cell's, in words joint by joint.

    No model tells how far a servo lags behind, so that no motion can be checked against them.
    """
    limits = controller_limits(cell, connection)
    if limits is None:
        return ()
    ours = np.array(cell.drive_table.following_error)
    return _below(cell, limits.following_error, ours, "motor revolutions")


def _below(cell: Cell, theirs: Array, ours: Array, unit: str) -> tuple[str, ...]:
    return tuple(
        f"{cell.joint_names[joint]}: {shown(theirs[joint])} {unit} in the controller, "
        f"{ours[joint]:.9g} in the cell file"
        for joint in np.flatnonzero(narrower(theirs, ours))
    )
