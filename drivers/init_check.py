"""Comparison of the controller's init packet with the cell."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.drive_train import DriveTrain
from drivers.errors import DriveTrainError, PacketError
from drivers.events import InitReceived
from drivers.packets import InitPacket

Array = NDArray[np.float64]

_RELATIVE: Final = 1e-6
"""Relative tolerance: float32 rounds by 6e-8 at most; a cell file has six digits or more."""
_WRITTEN: Final = 1e-5
"""Relative tolerance of a limit: twice the rounding of six digits."""
_FACTOR: Final = 2.0
"""Largest factor between gear ratios of the same type of arm."""
_COUPLING: Final = 1.0
"""Largest magnitude of a wrist coupling."""
_FLOOR: Final = float(np.spacing(np.float32(1.0)))
"""Resolution of float32 within one motor revolution, far below an encoder's increment."""


def is_narrower(theirs: Array, ours: Array) -> NDArray[np.bool_]:
    """Return where a limit (n,) of the controller is below the cell's by more than rounding."""
    return np.asarray(theirs < ours * (1.0 - _WRITTEN))


def float32_text(value: float) -> str:
    """Return the shortest text of a float32 value."""
    return str(np.float32(value)).removesuffix(".0")


def compare(
    drive_train: DriveTrain,
    period: float,
    init: InitPacket,
    arm: int,
    accept: bool,
    other_axes: frozenset[tuple[int, int]] = frozenset(),
) -> InitReceived:
    """Compare an init packet with the cell, for an arm from 1.

    With a wrong gear ratio, calibration or coupling the arm moves elsewhere, so any difference
    makes the session unusable unless the controller's values are accepted. So does an open axis of
    any arm that is neither a joint of the cell nor one of `other_axes` (arm, axis, from 1), because
    its targets are not checked. Undefined values (NaN, or 0 for a ratio), values far off, another
    cycle than `period` (s) and a joint that is not open cannot be accepted.
    """
    fixed, unknown = _axes(drive_train.n_joints, init, arm, other_axes)
    if not math.isclose(init.period, period, rel_tol=1e-9):
        ours = f"{1e3 * period:g} ms in the cell"
        fixed = (f"cycle is {init.sample_time} ms in the controller, {ours}", *fixed)
    values = _values(drive_train, init, arm)
    differences = (*fixed, *unknown, *values)
    refused = InitReceived(init, drive_train, "; ".join(differences) or None, differences)
    if not (unknown or values) or not accept:
        return refused
    theirs = drive_train
    try:
        if values:
            theirs = _adopted(drive_train, init, arm)
            fixed += _too_far_off(drive_train, theirs)
    except DriveTrainError as error:
        fixed = (*fixed, f"the controller's values cannot be accepted: {error}")
    if fixed:
        return replace(refused, unusable="; ".join(fixed))
    return InitReceived(init, theirs, None, differences, True)


def _axes(
    n_joints: int, init: InitPacket, arm: int, other_axes: frozenset[tuple[int, int]]
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return joints that are not open, or why that is unknown, and open axes that are unknown."""
    try:
        is_open = {(axis.arm, axis.axis + 1) for axis in init.open_axes()}
    except PacketError as error:
        return (str(error),), ()
    joints = {(arm, joint + 1) for joint in range(n_joints)}
    missing = tuple(
        f"axis {axis} of arm {arm} is not open in the controller, joint {axis} in the cell"
        for _, axis in sorted(joints - is_open)
    )
    unknown = tuple(
        f"axis {axis} of arm {of} is open in the controller; the cell does not know it"
        for of, axis in sorted(is_open - joints - other_axes)
    )
    return missing, unknown


def _too_far_off(ours: DriveTrain, theirs: DriveTrain) -> tuple[str, ...]:
    """Return values that cannot be accepted, because the guard's bounds depend on them."""
    share = theirs.gear_ratio / ours.gear_ratio
    found = [
        f"gear ratio of axis {axis + 1} is {share[axis]:.4g} times the cell's, and a factor of "
        f"{_FACTOR:g} is the most"
        for axis in np.flatnonzero(~((share >= 1.0 / _FACTOR) & (share <= _FACTOR)))
    ]
    moved = np.abs(theirs.calibration - ours.calibration)
    found += [
        f"calibration of axis {axis + 1} is {moved[axis]:.4g} motor revolutions from the cell's, "
        f"and {abs(ours.gear_ratio[axis]):.4g}, one turn of the joint, are the most"
        for axis in np.flatnonzero(~(moved <= np.abs(ours.gear_ratio)))
    ]
    couplings = (("k54", theirs.k54), ("k64", theirs.k64), ("k65", theirs.k65))
    found += [
        f"{name} is {value:.4g}, and {_COUPLING:g} is the most"
        for name, value in couplings
        if not abs(value) <= _COUPLING
    ]
    return tuple(f"{text}: too far off to be accepted; correct the cell file" for text in found)


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
    """Return the drive train with the controller's values; raises DriveTrainError."""
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
