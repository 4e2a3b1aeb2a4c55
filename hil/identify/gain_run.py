"""Current-to-torque gains from archives: some of them with a payload whose mass is known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hil.archive import Archive, open_archive
from hil.cell import Cell
from hil.errors import ArchiveError, InputError
from hil.progress import Reporter
from hil.recordings import recording_of
from identification.gain_factor import GainFactor
from identification.gains import GainMethod, Gains, identify_gains
from identification.model import RobotModel
from identification.payload import Payload
from identification.preprocessing import Preprocessing, prepare
from identification.recording import Recording, RecordingError
from identification.resampling import without_repeats

from .currents import motor_from_joint
from .prepared import current_limit
from .sources import cell_of, useful_part

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class GainsFound:
    """Gains and what they are for.

    Attributes:
        gains: torque per current of each motor.
        cell: of the first archive.
        loads: by archive name, what it carried; None for nothing.
        motor_side: whether gears are known; without, gains include them.
    """

    gains: Gains
    cell: Cell
    loads: dict[str, Payload | None]
    motor_side: bool


def find_gains(
    archives: Sequence[Path],
    loaded: Mapping[Path, Payload],
    reporter: Reporter,
    *,
    method: GainMethod = "weighted",
    delay: float | None = None,
) -> GainsFound:
    """Identify the gain of every motor.

    An archive whose cell has a payload was recorded with it.

    Args:
        archives: recordings as their cells say.
        loaded: further recordings, each with what the robot carried.
        reporter: told of the progress.
        method: see :mod:`identification.gains`.
        delay: time by which currents lag positions [s]; None takes it from the cell.

    Raises:
        InputError: an archive cannot be used, or not together with the others.
        IdentificationError: no recording has a payload, or there is not one usable row.
    """
    paths = [*archives, *loaded]
    if not paths:
        raise InputError(
            None, "there is no archive", remedy="name recordings with and without load"
        )
    total: GainFactor | None = None
    loads: dict[str, Payload | None] = {}
    first: tuple[Cell, RobotModel, Array] | None = None
    with reporter.task("reading recordings", len(paths)) as task:
        for path in paths:
            archive = open_archive(path)
            cell = cell_of(archive)
            payload = loaded.get(path, cell.model.payload)
            recording = _recording(archive)
            turns = _turns(cell, recording)
            if first is None:
                first = cell, replace(cell.model, payload=None), turns
            _refuse_stranger(archive, cell, turns, first)
            factor = _factor(
                archive,
                first[1],
                recording,
                payload,
                turns,
                delay=_delay(cell, delay),
                limit=current_limit(cell),
            )
            total = factor if total is None else total + factor
            loads[path.name] = payload
            task.advance(1, path.name)
    assert first is not None and total is not None
    cell, model, turns = first
    gains = identify_gains(total, model.joint_names, method=method)
    return GainsFound(gains, cell, loads, not np.array_equal(turns, np.eye(len(turns))))


def _recording(archive: Archive) -> Recording:
    recording = recording_of(archive)
    if recording.motor_current is None:
        raise ArchiveError(
            archive.path, "holds no motor currents", remedy="import them as motor_current"
        )
    part = useful_part(archive, recording)
    return recording if part is None else recording.between(part.start, part.stop)


def _turns(cell: Cell, recording: Recording) -> Array:
    """Motor angles per joint angle (n, n)."""
    if cell.file.drive_train is not None:
        return np.asarray(cell.drive_train.motor_from_joint)
    return motor_from_joint(recording)


def _delay(cell: Cell, delay: float | None) -> float:
    if delay is not None:
        return delay
    controller = cell.file.controller
    return controller.current_delay_cycles * cell.period if controller else 0.0


def _refuse_stranger(
    archive: Archive, cell: Cell, turns: Array, first: tuple[Cell, RobotModel, Array]
) -> None:
    """One robot with one drive train; only what it carries may differ."""
    same = cell.urdf == first[0].urdf and np.array_equal(turns, first[2])
    if not same or cell.model.parameter_names != first[1].parameter_names:
        raise ArchiveError(
            archive.path,
            f"is of another robot, friction law or drive train than {first[0].path}",
            remedy="identify the gains of each robot by themselves",
        )


def _factor(
    archive: Archive,
    model: RobotModel,
    recording: Recording,
    payload: Payload | None,
    turns: Array,
    *,
    delay: float,
    limit: Array | None,
) -> GainFactor:
    current = recording.motor_current
    assert current is not None
    # Only the motion and its rows are wanted: a torque in the log may be of other gains.
    bare = replace(recording, torque=np.zeros_like(current))
    try:
        single = without_repeats(bare)
        samples = prepare(
            single, model, options=Preprocessing(torque_delay=delay), current_limit=limit
        )
    except RecordingError as error:
        raise ArchiveError(archive.path, str(error), remedy="leave it out") from error
    assert single.motor_current is not None
    return GainFactor.from_samples(
        model, samples, single.motor_current, payload=payload, transmission=turns
    )
