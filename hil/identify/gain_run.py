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
from identification.estimators.gains import Gains, identify_gains
from identification.factor.phases import PhaseFactor, gain_factor, joined
from identification.model.payload import Payload
from identification.model.robot import RobotModel
from identification.signals.recording import RecordingError

from .options import FIXED
from .prepared import motor_from_joint
from .settings import samples_of, stated_settings
from .sources import Source, cell_of, source_of

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
    delay: float | None = None,
) -> GainsFound:
    """Identify the gain of every motor.

    An archive whose cell has a payload was recorded with it.

    Args:
        archives: recordings as their cells say.
        loaded: further recordings, each with what the robot carried.
        reporter: receives the progress.
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
    options = replace(FIXED, delay="stated" if delay is None else delay)
    factors: list[PhaseFactor] = []
    loads: dict[str, Payload | None] = {}
    first: tuple[Cell, RobotModel, Array] | None = None
    with reporter.task("reading recordings", len(paths)) as task:
        for path in paths:
            archive = open_archive(path)
            cell = cell_of(archive)
            payload = loaded.get(path, cell.model.payload)
            source, current = _source(archive, cell)
            turns = motor_from_joint(source.recording)
            if cell.file.drive_train is not None:
                turns = np.asarray(cell.drive_train.motor_from_joint)
            if first is None:
                first = cell, replace(cell.model, payload=None), turns
            _refuse_other_arm(path, cell, turns, first)
            settings = stated_settings(cell, options)
            try:
                samples = samples_of(source, cell, settings, first[1])
            except RecordingError as error:
                raise ArchiveError(path, str(error), remedy="leave it out") from error
            factors.append(
                gain_factor(first[1], samples, current, payload=payload, transmission=turns)
            )
            loads[path.name] = payload
            task.advance(1, path.name)
    assert first is not None
    cell, model, turns = first
    gains = identify_gains(joined(factors), model.joint_names)
    return GainsFound(gains, cell, loads, not np.array_equal(turns, np.eye(len(turns))))


def _source(archive: Archive, cell: Cell) -> tuple[Source, Array]:
    """Motion and currents of an archive, and no torque: one in the log may be of other gains."""
    source = source_of(archive, cell)
    current = source.recording.motor_current
    if current is None:
        raise ArchiveError(
            archive.path, "holds no motor currents", remedy="import them as motor_current"
        )
    without = replace(source.recording, torque=np.zeros_like(current))
    return replace(source, recording=without), current


def _refuse_other_arm(
    path: Path, cell: Cell, turns: Array, first: tuple[Cell, RobotModel, Array]
) -> None:
    """One robot with one drive train; only what it carries may differ."""
    same = cell.urdf == first[0].urdf and np.array_equal(turns, first[2])
    if not same or cell.model.parameter_names != first[1].parameter_names:
        raise ArchiveError(
            path,
            f"is of another robot, friction law or drive train than {first[0].path}",
            remedy="identify the gains of each robot by themselves",
        )
