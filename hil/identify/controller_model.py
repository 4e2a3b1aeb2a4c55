"""What the controller's own dynamic model says, where the archives hold it.

A controller of the C4G kind sends, beside the target current, the share of it that its dynamic
model has asked for (extra 1). Both are of the same cycle, so that no delay stands between them.
Beside them it may send the diagonal of its inertia matrix (extra 2), which is read as being on the
joint side, rotors included; no torque constant stands between that and the identified one.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hil.archive import open_archive
from hil.cell import Cell
from identification.factor.factor import Estimate
from identification.signals.samples import Samples
from identification.validation.inertia_ratio import InertiaRatio, inertia_ratio
from identification.validation.prediction import PredictionError, over_all

from .sources import Source

Array = NDArray[np.float64]

_POSTURES = 500
# The same instant on two readings of one clock.
_SAME_TIME = 1e-6  # s


def controller_error(
    paths: Sequence[Path], cell: Cell, sources: Sequence[Source], samples: Sequence[Samples]
) -> PredictionError | None:
    """Error of the controller's model on the rows that a verdict counts.

    Args:
        paths: the archives, by whose names the sources are called.
        cell: whose drive train turns currents into torques.
        sources: what is predicted.
        samples: the same, prepared.

    Returns:
        None where the controller sent no such current, or something else than a current in it
        (zeros), in any of the archives.
    """
    if cell.file.drive_train is None:
        return None
    by_name = {path.name: path for path in paths}
    errors = []
    for source, prepared in zip(sources, samples, strict=True):
        if source.name not in by_name:  # a part of an archive
            return None
        torque = _model_torque(by_name[source.name], cell, prepared.motion.time)
        if torque is None:
            return None
        errors.append(PredictionError.between(prepared.torque, torque, prepared.usable))
    return over_all(errors) if errors else None


def _model_torque(path: Path, cell: Cell, time: Array) -> Array | None:
    """Joint torques (m, n) of the controller's model at these times of the archive."""
    current = _column_at(path, "model_current", time)
    return None if current is None else cell.drive_train.joint_torque(current)


def controller_inertia(
    paths: Sequence[Path], cell: Cell, estimate: Estimate, sources: Sequence[Source]
) -> InertiaRatio | None:
    """The controller's diagonal inertia beside the identified one, over the recorded postures.

    Args:
        paths: the archives, by whose names the sources are called.
        cell: whose model was identified.
        estimate: of its parameters.
        sources: what was recorded.

    Returns:
        None where the controller sent none (zeros), or the data leave parameters open.
    """
    by_name = {path.name: path for path in paths}
    if cell.file.drive_train is None or estimate.undetermined:
        return None
    positions, theirs = [], []
    for source in sources:
        if source.name not in by_name:  # a part of an archive
            continue
        recording = source.recording
        few = slice(None, None, max(1, recording.n_samples // _POSTURES))
        inertia = _column_at(by_name[source.name], "diagonal_inertia", recording.time[few])
        if inertia is not None:
            positions.append(recording.position[few])
            theirs.append(inertia)
    if not theirs:
        return None
    return inertia_ratio(
        cell.model, estimate.values, np.concatenate(positions), np.concatenate(theirs)
    )


def _column_at(path: Path, field: str, time: Array) -> Array | None:
    """A channel (m, n) of the archive at these of its times; None where it says nothing."""
    archive = open_archive(path, fields=("cycle", field))
    column, cycle = archive.columns.get(field), archive.columns.get("cycle")
    if column is None or cycle is None or archive.period is None:
        return None
    if not np.isfinite(column).all() or not np.any(column):
        return None
    at = (cycle - cycle[0]) * archive.period
    rows = np.clip(np.searchsorted(at, time - _SAME_TIME), 0, len(at) - 1)
    if np.abs(at[rows] - time).max() > _SAME_TIME:
        return None
    return np.asarray(column[rows])
