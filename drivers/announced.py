"""Whether the controller and the cell speak of the same arm, and whose word counts."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from drivers.drive_train import DriveTrain
from drivers.errors import DriveTrainError, PacketError
from drivers.packets import InitPacket

_RELATIVE: Final = 1e-6
"""The wire rounds to float32, by 6e-8 at most; a cell file has six digits or more."""
_FLOOR: Final = float(np.spacing(np.float32(1.0)))
"""Motor revolutions: what float32 resolves within one, far below an encoder's increment."""


@dataclass(frozen=True, eq=False)
class Announced:
    """An init packet held against the cell.

    Attributes:
        drive_train: in force: the cell's, or that with the controller's values adopted.
        differences: each names the axis and both values.
        unusable: why the arm cannot be moved, or None.
        adopted: the controller's values are in force.
    """

    drive_train: DriveTrain
    differences: tuple[str, ...]
    unusable: str | None
    adopted: bool


def compare(
    drive_train: DriveTrain, period: float, init: InitPacket, arm: int, accept: bool
) -> Announced:
    """Hold an init packet against what the cell says of the arm.

    Motor positions made with a wrong ratio, calibration or coupling send the arm elsewhere, so
    any difference refuses the session, unless the controller's values are accepted on purpose.
    What it leaves undefined (NaN, or 0 for a ratio), another cycle and an axis that is not open
    cannot be accepted.
    """
    fixed = _timing(period, init) + _axis_map(drive_train.n_joints, init, arm)
    values = _values(drive_train, init, arm)
    differences = (*fixed, *values)
    refused = Announced(drive_train, differences, "; ".join(differences) or None, False)
    if not values or not accept:
        return refused
    try:
        theirs = _adopted(drive_train, init, arm)
    except DriveTrainError as error:
        fixed = (*fixed, f"the controller's values cannot be accepted: {error}")
    if fixed:
        return replace(refused, unusable="; ".join(fixed))
    return Announced(theirs, differences, None, True)


def _timing(period: float, init: InitPacket) -> tuple[str, ...]:
    if math.isclose(init.period, period, rel_tol=1e-9):
        return ()
    ours = f"{1e3 * period:g}"
    return (f"cycle is {init.sample_time} ms in the controller, {ours} ms in the cell",)


def _axis_map(n_joints: int, init: InitPacket, arm: int) -> tuple[str, ...]:
    try:
        is_open = {axis.axis for axis in init.open_axes() if axis.arm == arm}
    except PacketError as error:
        return (str(error),)
    return tuple(
        f"axis {axis + 1} of arm {arm} is not open in the controller, joint {axis + 1} in the cell"
        for axis in range(n_joints)
        if axis not in is_open
    )


def _values(drive_train: DriveTrain, init: InitPacket, arm: int) -> tuple[str, ...]:
    n, row = drive_train.n_joints, arm - 1
    pairs = [
        (f"gear ratio of axis {axis + 1}", init.gear_ratio[row, axis], ratio, 0.0)
        for axis, ratio in enumerate(drive_train.gear_ratio)
    ]
    pairs += [
        (f"calibration of axis {axis + 1}", init.calibration[row, axis], calibration, _FLOOR)
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
        if not abs(float(theirs) - float(our)) <= _RELATIVE * abs(float(our)) + floor
    )


def _adopted(drive_train: DriveTrain, init: InitPacket, arm: int) -> DriveTrain:
    """The cell's drive train with the controller's gear ratios, calibration and coupling.

    Raises:
        DriveTrainError: one of them is no number, or a ratio is zero.
    """
    n, row = drive_train.n_joints, arm - 1
    k54, k64, k65 = init.wrist_coupling(arm)
    return replace(
        drive_train,
        gear_ratio=init.gear_ratio[row, :n].astype(np.float64),
        calibration=init.calibration[row, :n].astype(np.float64),
        k54=k54 if n >= 5 else 0.0,
        k64=k64 if n >= 6 else 0.0,
        k65=k65 if n >= 6 else 0.0,
    )
