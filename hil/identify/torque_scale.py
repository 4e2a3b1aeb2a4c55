"""How well the torques of recordings are known: relative standard deviation of their scale."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hil.cell import Cell
from identification.estimators.torque_scale import DATA_SHEET, described
from identification.signals.recording import Recording
from planner.arrays import numbers

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class TorqueScale:
    """Uncertainty of the scale of torques, common to all recordings of an arm."""

    std: Array  #: relative standard deviation of each joint (n,)
    of: str  #: what has it: "torque constants", or "the scale of the recorded torques"
    source: str  #: where it is from

    @property
    def message(self) -> str:
        """What is assumed, such as "assuming torque constants to 3 %"."""
        if not self.std.any():
            return f"assuming exact torques ({self.source})"
        return f"assuming {described(self.std, self.of)} (standard deviation; {self.source})"


def torque_scale(cell: Cell, recordings: Sequence[Recording], *, simulated: bool) -> TorqueScale:
    """Return the uncertainty of the torques of recordings, of the worst where they differ.

    That of the column map comes first, then that of the cell. The torques of a simulated arm
    (`simulated`: only one can have moved) are exact: its currents are made with the torque
    constants of the cell. A controller's own currents and imported ones have torque constants of a
    data sheet unless something else is stated, and joint torque sensors are no better
    (`identification.estimators.torque_scale.DATA_SHEET`).
    """
    n = len(cell.joint_names)
    drives = cell.file.drive_train
    with_currents = any(one.motor_current is not None for one in recordings)
    of = "torque constants" if with_currents else "the scale of the recorded torques"
    mapped = [one.provenance.get("torque_uncertainty") for one in recordings]
    in_cell = cell.file.robot.torque_uncertainty
    table = "[robot]"
    if drives is not None and drives.torque_uncertainty is not None:
        in_cell = drives.torque_uncertainty
        table = "[drive_train]"
    if in_cell is not None:
        base = np.broadcast_to(np.asarray(in_cell, dtype=np.float64), n)
        source = f"torque_uncertainty of {table} in the cell file"
    elif simulated:
        base = np.zeros(n)
        source = "a simulated arm"
    else:
        base = np.full(n, DATA_SHEET)
        source = "of a data sheet, as no torque_uncertainty is stated"
    if any(entry is not None for entry in mapped):
        stds = [base if text is None else numbers(json.loads(text), 1) for text in mapped]
        return TorqueScale(np.max(stds, axis=0), of, "torque_uncertainty of the column map")
    return TorqueScale(np.array(base), of, source)
