"""Servo and friction of each joint, from archives without torque, judged on others."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hil.archive import Archive, place_of
from hil.base.arrays import Array
from hil.base.errors import InputError
from hil.base.progress import Reporter
from hil.base.threads import one_thread
from hil.base.version import software
from hil.cell import Cell
from hil.cell.nominal import nominal_of
from hil.pipeline.note_messages import note_lines
from hil.pipeline.sources import Source, Sources, gather_sources
from hil.results.servo_result import (
    ServoContact,
    ServoFree,
    ServoPosterior,
    ServoPrediction,
    ServoPush,
    ServoResults,
    ServoSpan,
    ServoTermChoice,
    ServoValue,
    ServoVerdict,
    SimulatorServo,
)
from hil.results.servo_series import ServoSeries
from hil.servo.maker_file import maker_parameters
from hil.servo.messages import verdict_of
from identification.servo.choice import FIT_ITERATIONS, fit_servos, steps_of_a_fit
from identification.servo.contacts import contacts_of
from identification.servo.intervals import intervals_of, widened_covariance
from identification.servo.parameters import TERMS, in_units
from identification.servo.prediction import predicted
from identification.servo.pushes import pushes_of
from identification.servo.recorded_motion import Grid, ServoMotion, motions_of
from identification.servo.servo_fit import ServoFit
from identification.servo.simulator_terms import (
    ENGINES,
    Engine,
    fits_in_simulators,
)
from identification.signals.recording import MIN_MOVEMENT

_MIN_RESOLUTION: Final = 1e-5  # rad or m, least resolution of positions
_MILLI: Final = 1e3


@dataclass(frozen=True)
class ServoOptions:
    """Options of an identification without torque.

    Attributes:
        split: fraction of a single recording that is fitted.
        in_sample: fit all recordings and hold out none.
        compare: MJCF whose parameters are compared.
    """

    split: float = 0.7
    in_sample: bool = False
    compare: Path | None = None


@dataclass(frozen=True, eq=False)
class ServoIdentification:
    """An identification without torque."""

    paths: tuple[Path, ...]
    cell: Cell
    fit: ServoFit
    results: ServoResults
    series: tuple[ServoSeries, ...]


@one_thread()
def identify_servos(
    archives: Sequence[Path | Archive],
    reporter: Reporter,
    options: ServoOptions = ServoOptions(),
    *,
    predict: Sequence[Path | Archive] = (),
    name: str = "",
) -> ServoIdentification:
    """Identify servos from positions and commands, with the bodies of the URDF.

    Args:
        archives: to fit.
        reporter: shows the progress.
        options: of the identification.
        predict: archives to hold out.
        name: of the result; by default the first archive's.

    Raises:
        InputError: there are no masses, no commanded positions, or no motion.
    """
    sources = gather_sources(
        archives, options.split, predict, in_sample=options.in_sample, with_torque=False
    )
    cell = sources.cell
    first = place_of(archives[0])
    bodies = bodies_of(cell, first)
    compared = None
    if options.compare is not None:
        compared = maker_parameters(options.compare, cell.joint_names)
    grid = Grid.of(sources.training[0].recording)

    def named_on(on: Grid) -> list[tuple[str, ServoMotion]]:
        return [
            (source.name, each)
            for source in sources.training
            for each in _motions(source, cell, bodies, on)
        ]

    def motions_on(on: Grid) -> list[ServoMotion]:
        return [motion for _, motion in named_on(on)]

    fitted = named_on(grid)
    if not fitted:
        problem = "has no part in which the commanded positions are known"
        remedy = "record the commanded positions, or name them (--columns)"
        raise InputError(first, problem, field="commanded_position", remedy=remedy)
    resolution = _resolution(sources)
    started = time.process_time()
    with reporter.task("servos", steps_of_a_fit() + len(ENGINES) * FIT_ITERATIONS) as task:
        fit = fit_servos(motions_on, grid, resolution, done=lambda: task.advance(1))
        simulators = fits_in_simulators(
            [motion for _, motion in fitted], fit, resolution, done=lambda: task.advance(1)
        )
    stuck = _stuck(sources, resolution)
    found = _Found(fit, simulators, resolution, stuck, time.process_time() - started)
    with reporter.task("held-out motions", len(sources.held_out)) as task:
        series = []
        for source in sources.held_out:
            motions = _motions(source, cell, bodies, grid)
            series += _series(source.name, motions, cell, bodies, found, compared)
            task.advance(1)
    results = _results(name or first.stem, sources, found, series, fitted, options)
    results = results.model_copy(update={"verdict": verdict_of(results)})
    paths = tuple(map(place_of, (*archives, *predict)))
    return ServoIdentification(paths, cell, fit, results, tuple(series))


@dataclass(frozen=True, eq=False)
class _Found:
    """What was fitted: with all terms, and with the terms of each engine.

    Attributes:
        fit: with all terms.
        simulators: with the terms of each engine.
        resolution: standard deviation of the measured positions (n,).
        stuck: joints (n,) that never moved, though their command did.
        seconds: processor time.
    """

    fit: ServoFit
    simulators: Mapping[Engine, ServoFit]
    resolution: Array
    stuck: NDArray[np.bool_]
    seconds: float


def bodies_of(cell: Cell, path: Path) -> Array:
    """Return the parameters (p,) of the URDF's bodies, without friction and rotors."""
    if nominal_of(cell) is None:
        remedy = "give a URDF with masses, which set the scale of gains and friction"
        raise InputError(path, "has no torque, and its URDF no masses", field="urdf", remedy=remedy)
    model = cell.model
    standard = model.nominal.copy()
    if model.layout.rotor_inertia:
        standard[model.layout.rotors] = 0.0
    values = np.zeros(model.n_parameters)
    values[: model.base.rank] = model.base.grouping @ standard
    return values


def _motions(source: Source, cell: Cell, bodies: Array, grid: Grid) -> list[ServoMotion]:
    return motions_of(source.recording, cell.model, bodies, grid)


def _resolution(sources: Sources) -> Array:
    """Return the standard deviation of positions as they are rounded (n,)."""
    steps = []
    for source in sources.training:
        columns = source.recording.position.T
        steps.append([np.diff(np.unique(column)).min(initial=np.inf) for column in columns])
    least = np.min(steps, axis=0)
    return np.asarray(
        np.maximum(np.where(np.isfinite(least), least, 0.0) / np.sqrt(12.0), _MIN_RESOLUTION)
    )


def _stuck(sources: Sources, resolution: Array) -> NDArray[np.bool_]:
    """Return the joints (n,) that stay within a step in all motions, and whose command does not.

    Nothing of their servo is seen, be it broken, switched off or held by friction.
    """
    stuck = np.ones(len(resolution), np.bool_)
    commanded = np.zeros(len(resolution), np.bool_)
    for source in sources.training:
        recording = source.recording
        stuck &= np.ptp(recording.position, axis=0) <= 1.5 * np.sqrt(12.0) * resolution
        commands = recording.commanded_position
        if commands is not None and (known := np.isfinite(commands).all(axis=1)).any():
            commanded |= np.ptp(commands[known], axis=0) > MIN_MOVEMENT
    return stuck & commanded


def _series(
    name: str,
    motions: Sequence[ServoMotion],
    cell: Cell,
    bodies: Array,
    found: _Found,
    compared: Array | None,
) -> list[ServoSeries]:
    """Return the motions of a recording as they were simulated from their commands."""
    fits = [found.fit, *(found.simulators[engine] for engine in ENGINES)]
    sets = [in_units(fit.estimate.values) for fit in fits]
    if compared is not None:
        sets.append(compared)
    series = []
    for motion in motions:
        identified, *others = predicted(cell.model, bodies, motion, sets)
        simulators = dict(zip(ENGINES, others, strict=False))
        series.append(
            ServoSeries(
                name,
                np.asarray(motion.step * np.arange(len(motion.position)), np.float64),
                motion.position,
                motion.command,
                identified,
                simulators,
                others[-1] if compared is not None else None,
                _contacts(motion, found, cell.joint_names),
                found.stuck,
            )
        )
    return series


def _contacts(motion: ServoMotion, found: _Found, names: Sequence[str]) -> tuple[ServoContact, ...]:
    """Return the joints that something held in a motion."""
    return tuple(
        ServoContact(
            joint=names[contact.joint],
            start=contact.start,
            end=contact.end,
            torque=contact.torque,
        )
        for contact in contacts_of(motion, found.fit, found.resolution)
    )


def _fitted_contacts(
    fitted: Sequence[tuple[str, ServoMotion]], found: _Found, names: Sequence[str]
) -> dict[str, list[ServoContact]]:
    """Return the joints that something held in fitted motions, by archive."""
    by_archive: dict[str, list[ServoContact]] = {}
    for archive, motion in fitted:
        if contacts := _contacts(motion, found, names):
            by_archive.setdefault(archive, []).extend(contacts)
    return by_archive


def _left_out(
    fitted: Sequence[tuple[str, ServoMotion]], fit: ServoFit
) -> dict[str, list[ServoSpan]]:
    """Return the stretches that were not fitted, by archive."""
    by_archive: dict[str, list[ServoSpan]] = {}
    for touch in fit.left_out:
        span = ServoSpan(start=touch.start, end=touch.end)
        by_archive.setdefault(fitted[touch.motion][0], []).append(span)
    return by_archive


def _prediction(series: ServoSeries, engine: Engine | None = None) -> ServoPrediction:
    """Return the errors of a simulated motion, or with the terms of an engine."""
    simulated = series.identified if engine is None else series.simulators[engine]
    every = np.ones(len(series.time), np.bool_)
    own = _errors(series, simulated, every)
    command = _errors(series, series.commanded, every)
    compared = None if series.compared is None else _errors(series, series.compared, every)
    return ServoPrediction(
        archive=series.archive,
        duration=float(series.time[-1]),
        position_error_mrad=_overall(own, series),
        joint_errors_mrad=own,
        command_error_mrad=_overall(command, series),
        command_joint_errors_mrad=command,
        motion_mrad=_overall(
            [float(_MILLI * each) for each in series.measured.std(axis=0)], series
        ),
        compared_error_mrad=None if compared is None else _overall(compared, series),
        compared_joint_errors_mrad=compared,
        contacts=series.contacts,
        free=_free(series, simulated),
    )


def _free(series: ServoSeries, simulated: Array) -> ServoFree | None:
    """Return the errors without what something held; None if that is nothing, or all."""
    free = series.free
    if free.all() or not free.any():
        return None
    own = _errors(series, simulated, free)
    other = None if series.compared is None else _errors(series, series.compared, free)
    return ServoFree(
        share=float(free.mean()),
        position_error_mrad=_overall(own, series),
        joint_errors_mrad=own,
        command_error_mrad=_overall(_errors(series, series.commanded, free), series),
        compared_error_mrad=None if other is None else _overall(other, series),
    )


def _errors(series: ServoSeries, positions: Array, rows: NDArray[np.bool_]) -> list[float]:
    """Return the root mean square error of each joint in some rows [mrad or mm]."""
    squares = (positions[rows] - series.measured[rows]) ** 2
    return [float(each) for each in _MILLI * np.sqrt(squares.mean(axis=0))]


def _overall(errors: Sequence[float], series: ServoSeries) -> float:
    """Return the root mean square of the errors of all joints that are not stuck."""
    moving = ~series.stuck if not series.stuck.all() else np.ones(len(errors), np.bool_)
    return float(np.sqrt(np.mean(np.square(errors)[moving])))


def _pushes(series: ServoSeries, names: Sequence[str]) -> tuple[ServoPush, ...]:
    """Return the joints that something touched."""
    step = float(series.time[1] - series.time[0])
    pushes = pushes_of(step, series.commanded, series.measured, series.identified)
    return tuple(
        ServoPush(joint=names[push.joint], time=push.time, change_mrad=_MILLI * push.change)
        for push in pushes
    )


def _results(
    name: str,
    sources: Sources,
    found: _Found,
    series: Sequence[ServoSeries],
    fitted: Sequence[tuple[str, ServoMotion]],
    options: ServoOptions,
) -> ServoResults:
    """Return the results, without a verdict.

    Args:
        name: of the identification.
        sources: its recordings.
        found: what was fitted.
        series: the motions that were predicted.
        fitted: motions that were fitted, with their archives.
        options: of the identification.
    """
    cell = sources.cell
    estimate = found.fit.estimate
    names = cell.joint_names
    fitted_files = _files_of(sources.training)
    placeholder = ServoVerdict(good=False, line="", warnings=[], next_steps=[])
    return ServoResults(
        name=name,
        cell=cell.name,
        simulated=sources.header.only_simulated,
        joint_names=list(names),
        joint_units=[*cell.model.chain.position_units],
        software=software(),
        archives=fitted_files,
        predicted=[name for name in _files_of(sources.held_out) if name not in fitted_files],
        windows=found.fit.windows,
        seconds=found.seconds,
        delay=estimate.bus_delay,
        servo=_values(found.fit, cell, found.stuck),
        validation=[
            _prediction(each).model_copy(update={"pushed": _pushes(each, names)}) for each in series
        ],
        in_sample=sources.in_sample,
        tested_on=sources.tested_on,
        compared=None if options.compare is None else options.compare.name,
        term_choices=[
            ServoTermChoice(
                terms=list(choice.terms),
                joint=names[choice.joint],
                present=choice.present,
                gain=choice.gain,
            )
            for choice in found.fit.choices
        ],
        verdict=placeholder,
        posterior=_posterior(found.fit),
        simulators={
            engine: SimulatorServo(
                servo=_values(fit, cell, found.stuck),
                validation=[_prediction(each, engine) for each in series],
                posterior=_posterior(fit),
            )
            for engine, fit in found.simulators.items()
        },
        stuck=[name for name, is_stuck in zip(names, found.stuck, strict=True) if is_stuck],
        fitted_contacts=_fitted_contacts(fitted, found, names),
        left_out=_left_out(fitted, found.fit),
        split=options.split,
        notes=note_lines(sources.warnings),
    )


def _files_of(sources: Sequence[Source]) -> list[str]:
    return [*dict.fromkeys(source.path.name for source in sources)]


def _values(fit: ServoFit, cell: Cell, stuck: NDArray[np.bool_]) -> list[ServoValue]:
    """Return all parameters of all joints with their intervals."""
    intervals = intervals_of(fit)
    turning = cell.model.chain.revolute
    return [
        ServoValue(
            name=term.name,
            joint=joint,
            unit=term.unit if turning[j] else term.unit_along,
            value=float(intervals.values[j, k]),
            lower=float(intervals.lower[j, k]),
            upper=float(intervals.upper[j, k]),
            determined=bool(intervals.determined[j, k]) and not stuck[j],
            present=bool(fit.estimate.present[j, k]),
        )
        for j, joint in enumerate(cell.joint_names)
        for k, term in enumerate(TERMS)
    ]


def _posterior(fit: ServoFit) -> ServoPosterior:
    estimate = fit.estimate
    return ServoPosterior(
        coordinates=estimate.coordinates.tolist(),
        present=estimate.present.tolist(),
        covariance=widened_covariance(fit).tolist(),
    )
