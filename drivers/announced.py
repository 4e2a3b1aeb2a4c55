"""Whether the controller and the cell speak of the same arm."""

from __future__ import annotations

from typing import Final

import numpy as np

from drivers.drive_train import DriveTrain
from drivers.packets import InitPacket

_RELATIVE: Final = 1e-6
"""The wire rounds to float32, by 6e-8 at most; a cell file has six digits or more."""
_FLOOR: Final = float(np.spacing(np.float32(1.0)))
"""Motor revolutions: what float32 resolves within one, far below an encoder's increment."""


def contradiction(drive_train: DriveTrain, init: InitPacket, arm: int) -> str | None:
    """Say where the init packet contradicts the drive train, axis by axis, or None.

    Motor positions made with a wrong ratio, calibration or coupling send the arm elsewhere. What
    the controller leaves undefined (NaN, or 0 for a ratio) contradicts too.
    """
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
    different = [
        f"{name} is {float(theirs):.9g} in the controller, {float(our):.9g} in the cell"
        for name, theirs, our, floor in pairs
        # Written so that NaN differs.
        if not abs(float(theirs) - float(our)) <= _RELATIVE * abs(float(our)) + floor
    ]
    return "; ".join(different) or None
