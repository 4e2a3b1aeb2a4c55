"""How well the scale of recorded torques is known, with the source."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum, auto

import numpy as np

from hil.base.arrays import Array
from hil.cell import Cell
from identification.estimators.torque_scale import TORQUE_CONSTANT_STD
from identification.signals.recording import Recording
from planner.arrays import numbers


class ScaleSource(Enum):
    """Source of the uncertainty of a scale."""

    COLUMN_MAP = auto()
    ROBOT_TABLE = auto()  #: of the cell file
    DRIVE_TRAIN_TABLE = auto()  #: likewise
    SIMULATED = auto()
    DATA_SHEET = auto()  #: nothing states it


@dataclass(frozen=True, eq=False)
class TorqueScale:
    """Uncertainty of the scale of torques, common to all recordings of an arm."""

    std: Array  #: relative standard deviation of each joint (n,)
    by_currents: bool  #: whether the torques are of currents, by torque constants
    source: ScaleSource  #: where it is from


def torque_scale(cell: Cell, recordings: Sequence[Recording], *, simulated: bool) -> TorqueScale:
    """Return the uncertainty of the torques of recordings, of the worst where they differ.

    The column map takes precedence over the cell. The torques of a simulated arm
    (`simulated`: only one can have moved) are exact: its currents are made with the torque
    constants of the cell. A controller's own currents and imported ones have torque constants of a
    data sheet unless something else is stated, and joint torque sensors are no better
    (`identification.estimators.torque_scale.TORQUE_CONSTANT_STD`).
    """
    n = len(cell.joint_names)
    drives = cell.file.drive_train
    with_currents = any(recording.motor_current is not None for recording in recordings)
    mapped = [recording.provenance.get("torque_uncertainty") for recording in recordings]
    in_cell = cell.file.robot.torque_uncertainty
    source = ScaleSource.ROBOT_TABLE
    if drives is not None and drives.torque_uncertainty is not None:
        in_cell = drives.torque_uncertainty
        source = ScaleSource.DRIVE_TRAIN_TABLE
    if in_cell is not None:
        base = np.broadcast_to(np.asarray(in_cell, dtype=np.float64), n)
    elif simulated:
        base = np.zeros(n)
        source = ScaleSource.SIMULATED
    else:
        base = np.full(n, TORQUE_CONSTANT_STD)
        source = ScaleSource.DATA_SHEET
    if any(entry is not None for entry in mapped):
        stds = [base if text is None else numbers(json.loads(text), 1) for text in mapped]
        return TorqueScale(np.max(stds, axis=0), with_currents, ScaleSource.COLUMN_MAP)
    return TorqueScale(np.array(base), with_currents, source)
