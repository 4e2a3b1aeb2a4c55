"""Torque constants from archives, some of them recorded with a known payload."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Literal, NamedTuple

import numpy as np

from hil.archive import open_archive
from hil.base.arrays import Array
from hil.base.errors import ArchiveError, InputError
from hil.base.progress import Reporter
from hil.cell import Cell
from identification.estimators.current_gains import MAX_BLOCKS, Gains, identify_gains
from identification.factor.blocks import FINE_BLOCK
from identification.factor.columns import gain_factor
from identification.factor.factor import Factor
from identification.hypotheses.diagnosis import diagnose
from identification.model.known_payload import Payload
from identification.model.robot import RobotModel
from identification.selection.settings import Settings
from identification.signals.recording import RecordingError
from identification.signals.samples import Samples
from identification.validation.finding import Finding

from .options import FIXED
from .other_meanings import other_meanings
from .prepared import motor_from_joint, samples_of, stated_settings
from .sources import Source, aligned, cell_of, source_of

_MIN_REACH: Final = 0.1  # m, of a body whose centre is at the flange


@dataclass(frozen=True, eq=False)
class GainsFound:
    """Identified torque constants."""

    gains: Gains
    loads: dict[str, Payload | None]  #: payload by archive name (by path if names are not unique)
    motor_side: bool  #: whether gear ratios are known; otherwise gains include them
    joints: tuple[str, ...]  #: names of the arm's
    otherwise: tuple[Finding, ...]  #: what the recordings are other than described


def find_gains(
    archives: Sequence[Path],
    loaded: Mapping[Path, Payload],
    reporter: Reporter,
    *,
    delay: float | Literal["stated"] | None = "stated",
    unknown_inertia: bool = False,
) -> GainsFound:
    """Identify the torque constant of every motor.

    Args:
        archives: with and without a known payload.
        loaded: archives whose payload differs from their cell's.
        reporter: of progress.
        delay: of currents behind positions [s]; "stated" uses the cell's.
        unknown_inertia: whether the moments of inertia of `loaded` are estimated too; not if a
            cell states another payload.

    Raises:
        InputError: an archive cannot be used, or not with the others; no archive has a payload.
        IdentificationError: no usable row.
    """
    carried: list[Payload | None] = []
    sources: list[Source] = []
    cells: list[Cell] = []
    lags: list[Settings] = []
    loads: dict[str, Payload | None] = {}
    first: Cell | None = None
    paths = (*archives, *loaded)
    with reporter.task("reading recordings", len(paths)) as task:
        for path in paths:
            archive = open_archive(path)
            cell = cell_of(archive)
            source = source_of(archive, cell)
            current = source.recording.motor_current
            if current is None:
                problem = "holds no motor currents"
                remedy = "import them as motor_current"
                raise ArchiveError(path, problem, remedy=remedy)
            source_turns = motor_from_joint(source.recording)
            if cell.file.drive_train is not None:
                source_turns = np.asarray(cell.drive_train.motor_from_joint)
            if first is None:
                first = cell
                turns = source_turns
                model = replace(cell.model, payload=None)
            # One robot with one drive train; only the payload may differ.
            same = cell.urdf == first.urdf and np.array_equal(turns, source_turns)
            if not same or cell.model.parameter_names != model.parameter_names:
                problem = f"has another robot, friction law or drive train than {first.path}"
                remedy = "identify the gains of each robot separately"
                raise ArchiveError(path, problem, remedy=remedy)
            # A recorded torque may have been computed with other gains.
            without = replace(source.recording, torque=np.zeros_like(current))
            load = loaded.get(path, cell.model.payload)
            loads[_name_in(path, paths)] = load
            carried.append(load)
            lags.append(stated_settings(cell, replace(FIXED, delay=delay)))
            sources.append(replace(source, recording=without))
            cells.append(cell)
            task.advance(1, path.name)
    _require_load(loads.values())
    prepared = _prepared([*zip(sources, cells, lags, carried, strict=True)], model)
    unknown = [load for load in loaded.values() if load is not None]
    if not unknown_inertia or any(cell.model.payload is not None for cell in cells):
        unknown = []
    factors = _reduced(prepared, model, turns, reporter, unknown_inertia=bool(unknown))
    gains = identify_gains(model, factors, max(map(_inertia_std, unknown), default=np.inf))
    has_gears = not np.array_equal(turns, np.eye(len(turns)))
    otherwise = _otherwise(prepared, model, turns, gains, sources)
    return GainsFound(gains, loads, has_gears, tuple(model.joint_names), otherwise)


class _Prepared(NamedTuple):
    """A recording, prepared."""

    samples: Samples  # without torque
    current: Array  # of the motors (m, n) [A]
    load: Payload | None
    name: str


def _prepared(
    recorded: Sequence[tuple[Source, Cell, Settings, Payload | None]], model: RobotModel
) -> list[_Prepared]:
    """Prepare recordings; recordings of the same motion share an origin."""
    # Repetitions of a motion begin together: errors of the model repeat at equal times.
    together, _ = aligned(tuple(source for source, *_ in recorded))
    prepared = []
    for source, (_, cell, settings, load) in zip(together, recorded, strict=True):
        try:
            samples = samples_of(source, cell, settings, model)
        except RecordingError as error:
            raise ArchiveError(source.path, str(error), remedy="leave it out") from error
        current = source.recording.motor_current
        assert current is not None, "checked above"
        prepared.append(_Prepared(samples, current, load, source.name))
    return prepared


def _inertia_std(load: Payload) -> float:
    """Return the prior standard deviation of each moment of inertia of a load [kg·m²].

    A body seldom extends further about its centre than from there to the flange.
    """
    reach = max(math.hypot(*load.centre), _MIN_REACH)
    return load.mass * reach**2


def _reduced(
    prepared: Sequence[_Prepared],
    model: RobotModel,
    turns: Array,
    reporter: Reporter,
    *,
    unknown_inertia: bool,
) -> list[Factor]:
    """Return the factor of each recording, in equal blocks of time."""
    longest = max(float(np.ptp(each.samples.motion.time)) for each in prepared)
    block = max(FINE_BLOCK, longest / MAX_BLOCKS)
    factors: list[Factor] = []
    with reporter.task("reducing recordings", len(prepared)) as task:
        for samples, current, load, name in prepared:
            factors.append(
                gain_factor(
                    model,
                    samples,
                    current,
                    payload=load,
                    unknown_inertia=unknown_inertia,
                    transmission=turns,
                    block=block,
                )
            )
            task.advance(1, name)
    return factors


def _otherwise(
    prepared: Sequence[_Prepared],
    model: RobotModel,
    turns: Array,
    gains: Gains,
    sources: Sequence[Source],
) -> tuple[Finding, ...]:
    """Return what recordings without a load are other than described, by the torque found."""
    bare = [each for each in prepared if each.load is None]
    known = gains.determined
    if not known.any() or not bare:
        return ()
    torques = [(each.current * np.where(known, gains.values, 0.0)) @ turns for each in bare]
    has_torque = ~turns[~known].any(axis=0)  # of joints that no motor without a constant turns
    samples = [
        replace(each.samples, torque=torque, usable=each.samples.usable & has_torque)
        for each, torque in zip(bare, torques, strict=True)
    ]
    return other_meanings(diagnose(model, samples), sources)


def _name_in(path: Path, paths: Sequence[Path]) -> str:
    """Return the name of a path, or the whole path if others have this name."""
    return path.name if sum(each.name == path.name for each in paths) == 1 else str(path)


def _require_load(loads: Iterable[Payload | None]) -> None:
    if not any(load is not None and load.parameters.any() for load in loads):
        problem = "without a known payload, gains and inertias are only known up to a factor"
        remedy = "add a recording with a known load: --loaded ARCHIVE --mass KG"
        raise InputError(None, problem, field="--loaded", remedy=remedy)
