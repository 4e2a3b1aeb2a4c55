"""Current-to-torque gains from archives: some of them with a payload whose mass is known."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from hil.archive import open_archive
from hil.cell import Cell
from hil.errors import ArchiveError, InputError
from hil.progress import Reporter
from identification.estimators.gains import Gains, identify_gains
from identification.factor.phases import PhaseFactor, gain_factor, joined
from identification.model.payload import Payload
from identification.signals.recording import RecordingError

from .options import FIXED
from .prepared import motor_from_joint
from .settings import samples_of, stated_settings
from .sources import cell_of, source_of


@dataclass(frozen=True, eq=False)
class GainsFound:
    """Gains and what they are for."""

    gains: Gains  #: torque per current of each motor
    #: by archive name (path of those with one name), what it carried; None for nothing
    loads: dict[str, Payload | None]
    motor_side: bool  #: whether gears are known; without, gains include them


def find_gains(
    archives: Sequence[Path],
    loaded: Mapping[Path, Payload],
    reporter: Reporter,
    *,
    delay: float | Literal["stated"] | None = "stated",
) -> GainsFound:
    """Identify the gain of every motor.

    An archive whose cell has a payload was recorded with it.

    The `loaded` recordings carried what is named with each. Currents lag positions by `delay` [s];
    "stated" takes it from the cell.

    Raises:
        InputError: an archive cannot be used, or not together with the others; none has a payload.
        IdentificationError: there is not one usable row.
    """
    factors: list[PhaseFactor] = []
    loads: dict[str, Payload | None] = {}
    first: Cell | None = None
    names = [path.name for path in (*archives, *loaded)]
    with reporter.task("reading recordings", len(names)) as task:
        for path in (*archives, *loaded):
            archive = open_archive(path)
            cell = cell_of(archive)
            source = source_of(archive, cell)
            current = source.recording.motor_current
            if current is None:
                problem, remedy = "holds no motor currents", "import them as motor_current"
                raise ArchiveError(path, problem, remedy=remedy)
            own = motor_from_joint(source.recording)
            if cell.file.drive_train is not None:
                own = np.asarray(cell.drive_train.motor_from_joint)
            if first is None:
                first, turns, model = cell, own, replace(cell.model, payload=None)
            # One robot with one drive train; only what it carries may differ.
            same = cell.urdf == first.urdf and np.array_equal(turns, own)
            if not same or cell.model.parameter_names != model.parameter_names:
                problem = f"is of another robot, friction law or drive train than {first.path}"
                remedy = "identify the gains of each robot by themselves"
                raise ArchiveError(path, problem, remedy=remedy)
            # A torque in the log may be of other gains.
            without = replace(source.recording, torque=np.zeros_like(current))
            settings = stated_settings(cell, replace(FIXED, delay=delay))
            try:
                samples = samples_of(replace(source, recording=without), cell, settings, model)
            except RecordingError as error:
                raise ArchiveError(path, str(error), remedy="leave it out") from error
            load = loaded.get(path, cell.model.payload)
            loads[path.name if names.count(path.name) == 1 else str(path)] = load
            factors.append(gain_factor(model, samples, current, payload=load, transmission=turns))
            task.advance(1, path.name)
    assert first is not None, "the command line asks for an archive"
    _require_load(loads.values())
    gains = identify_gains(joined(factors), model.joint_names)
    return GainsFound(gains, loads, not np.array_equal(turns, np.eye(len(turns))))


def _require_load(loads: Iterable[Payload | None]) -> None:
    if not any(load is not None and load.parameters.any() for load in loads):
        problem = "no recording has a known payload: gains and parameters can be scaled together"
        remedy = "record the arm with a known load as well: --loaded ARCHIVE --mass KG"
        raise InputError(None, problem, field="--loaded", remedy=remedy)
