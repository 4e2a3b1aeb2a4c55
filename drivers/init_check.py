"""Whether the controller and the cell speak of the same arm, and whose word counts."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.drive_train import DriveTrain
from drivers.errors import DriveTrainError, PacketError
from drivers.packets import InitPacket

Array = NDArray[np.float64]

_RELATIVE: Final = 1e-6
"""The wire rounds to float32, by 6e-8 at most; a cell file has six digits or more."""
_WRITTEN: Final = 1e-5
"""Of a limit: six digits written by a person may be rounded by half of this."""
_FACTOR: Final = 2.0
"""Gear ratios further apart are not of the same kind of arm."""
_COUPLING: Final = 1.0
"""Magnitude of a wrist coupling beyond which it is none."""
_FLOOR: Final = float(np.spacing(np.float32(1.0)))
"""Motor revolutions: what float32 resolves within one, far below an encoder's increment."""


@dataclass(frozen=True, eq=False)
class InitCheck:
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


@dataclass(frozen=True, eq=False)
class ControllerLimits:
    """Limits of an arm's motors in an init packet, (n,) each; NaN where it has none.

    Attributes:
        current: A.
        following_error: thresholds in motor revolutions.
    """

    current: Array
    following_error: Array

    @classmethod
    def of(cls, init: InitPacket, arm: int, n_joints: int) -> ControllerLimits:
        """Those of the first axes of an arm, which counts from 1."""
        row, axes = arm - 1, slice(0, n_joints)
        return cls(
            init.current_limit[row, axes].astype(np.float64),
            init.following_error[row, axes].astype(np.float64),
        )


def is_narrower(theirs: Array, ours: Array) -> NDArray[np.bool_]:
    """Where a limit (n,) of the controller is below the cell's by more than six digits round."""
    return np.asarray(theirs < ours * (1.0 - _WRITTEN))


def float32_text(value: float) -> str:
    """A figure of the wire in the fewest digits that are that float32 again."""
    return str(np.float32(value)).removesuffix(".0")


def compare(
    drive_train: DriveTrain,
    period: float,
    init: InitPacket,
    arm: int,
    accept: bool,
    other_axes: frozenset[tuple[int, int]] = frozenset(),
) -> InitCheck:
    """Hold an init packet against what the cell says of the arm.

    Motor positions made with a wrong ratio, calibration or coupling send the arm elsewhere, so
    any difference refuses the session, unless the controller's values are accepted on purpose.
    So does an axis that is open, of whichever arm, and no joint of the cell: it would be held at
    targets that nobody watches. What the controller leaves undefined (NaN, or 0 for a ratio) or
    what is far off, another cycle and a joint that is not open cannot be accepted.

    Args:
        drive_train: the cell's.
        period: s, the cell's cycle.
        init: the controller's init packet.
        arm: the arm that is moved, from 1.
        accept: take the controller's word where it may be taken.
        other_axes: (arm, axis), both from 1, that may be open as well.
    """
    fixed = _timing(period, init) + _axis_map(drive_train.n_joints, init, arm)
    unknown = _unknown_axes(drive_train.n_joints, init, arm, other_axes)
    values = _values(drive_train, init, arm)
    differences = (*fixed, *unknown, *values)
    refused = InitCheck(drive_train, differences, "; ".join(differences) or None, False)
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
    return InitCheck(theirs, differences, None, True)


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


def _unknown_axes(
    n_joints: int, init: InitPacket, arm: int, other_axes: frozenset[tuple[int, int]]
) -> tuple[str, ...]:
    try:
        is_open = [(axis.arm, axis.axis + 1) for axis in init.open_axes()]
    except PacketError:
        return ()
    known = other_axes | {(arm, joint + 1) for joint in range(n_joints)}
    return tuple(
        f"axis {axis} of arm {of} is open in the controller; the cell does not know it"
        for of, axis in sorted(is_open)
        if (of, axis) not in known
    )


def _too_far_off(ours: DriveTrain, theirs: DriveTrain) -> tuple[str, ...]:
    """What nobody means to accept: the guard's bounds are on the joint side of these values.

    A calibration more than one turn of the joint away is that of another arm, or none.
    """
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
