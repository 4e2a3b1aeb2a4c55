"""Comparison of the controller's init packet with the cell."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.arrays import Array
from drivers.c4g_packets import InitPacket
from drivers.drive_train import DriveTrain
from drivers.errors import PacketError
from drivers.events import InitReceived

_RELATIVE_TOLERANCE: Final = 1e-6
"""Relative tolerance: float32 rounds by 6e-8 at most; a cell file has six digits or more."""
_LIMIT_TOLERANCE: Final = 1e-5
"""Relative tolerance of a limit: twice the rounding of six digits."""
_ABSOLUTE_TOLERANCE: Final = float(np.spacing(np.float32(1.0)))
"""Resolution of float32 within one motor revolution, far below an encoder's increment."""


def is_narrower(theirs: Array, ours: Array) -> NDArray[np.bool_]:
    """Return where a limit (n,) of the controller is below the cell's by more than rounding."""
    return np.asarray(theirs < ours * (1.0 - _LIMIT_TOLERANCE))


def float32_text(value: float) -> str:
    """Return the shortest text of a float32 value."""
    return str(np.float32(value)).removesuffix(".0")


def verify_controller(
    drive_train: DriveTrain,
    period: float,
    init: InitPacket,
    arm: int,
    other_axes: frozenset[tuple[int, int]] = frozenset(),
) -> InitReceived:
    """Compare an init packet with the cell.

    Any difference makes the session unusable: with a wrong gear ratio, calibration or coupling the
    arm moves elsewhere.

    Args:
        drive_train: of the cell.
        period: of a cycle of the cell [s].
        init: packet of the controller, in which every joint must be open.
        arm: of the cell, from 1.
        other_axes: (arm, axis), from 1, that may be open besides; no other may, because its targets
            are not checked.
    """
    differences = _axes(drive_train.n_joints, init, arm, other_axes)
    if not math.isclose(init.period, period):
        ours = f"{1e3 * period:g} ms in the cell"
        cycle = f"cycle is {init.sample_time} ms in the controller, {ours}"
        differences = (cycle, *differences)
    differences += _values(drive_train, init, arm)
    return InitReceived(init, "; ".join(differences) or None, differences)


def _axes(
    n_joints: int, init: InitPacket, arm: int, other_axes: frozenset[tuple[int, int]]
) -> tuple[str, ...]:
    """Return joints that are not open and open axes that are unknown, or why that is unknown."""
    try:
        is_open = {(axis.arm, axis.axis + 1) for axis in init.open_axes()}
    except PacketError as error:
        return (str(error),)
    joints = {(arm, joint + 1) for joint in range(n_joints)}
    missing = tuple(
        f"axis {axis} of arm {arm} is not open in the controller, joint {axis} in the cell"
        for _, axis in sorted(joints - is_open)
    )
    unknown = tuple(
        f"axis {axis} of arm {of} is open in the controller; the cell does not know it"
        for of, axis in sorted(is_open - joints - other_axes)
    )
    return missing + unknown


def _values(drive_train: DriveTrain, init: InitPacket, arm: int) -> tuple[str, ...]:
    n = drive_train.n_joints
    row = arm - 1
    pairs = [
        (f"gear ratio of axis {axis + 1}", init.gear_ratio[row, axis], ratio, 0.0)
        for axis, ratio in enumerate(drive_train.gear_ratio)
    ]
    pairs += [
        (
            f"calibration of axis {axis + 1}",
            init.calibration[row, axis],
            calibration,
            _ABSOLUTE_TOLERANCE,
        )
        for axis, calibration in enumerate(drive_train.calibration)
    ]
    ours = (drive_train.k54, drive_train.k64, drive_train.k65)
    wrist = (("k54", 5), ("k64", 6), ("k65", 6))
    for (name, axis), theirs, our in zip(wrist, init.wrist_coupling(arm), ours, strict=True):
        if axis <= n:
            pairs.append((f"{name} of axis {axis}", theirs, our, 0.0))
    return tuple(
        f"{name} is {float(theirs):.9g} in the controller, {float(our):.9g} in the cell"
        for name, theirs, our, floor in pairs
        # Written so that NaN differs.
        if not abs(float(theirs) - float(our)) <= _RELATIVE_TOLERANCE * abs(float(our)) + floor
    )
