"""From the archives of a campaign to estimates, and from held-out archives to prediction errors.

Both methods are treated alike: the same smoothing, the same delay, the same weights (eq. 4).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from hil.identify.options import FIXED
from hil.identify.prepared import Prepared, prepare_sources
from hil.identify.sources import gather_sources
from hil.identify.summary import executed_rows, moving_rows
from hil.progress import Silent
from identification import Factor, RobotModel
from identification.excitation import correlation, coupling_index, information, log10_det
from identification.preprocessing import Samples
from identification.repetitions import estimate_repetitions
from identification.validation import PredictionError, for_figure

from .records import (
    PLANTED,
    ExampleRecord,
    FitRecord,
    ScoreRecord,
    low_passed,
    motion_form,
)

Array = NDArray[np.float64]

SHOWN: Final = 1200
"""Rows of a series that a figure is drawn from, at most."""
FIGURE_DIGITS: Final = 5
_MOVES: Final = 1e-3
"""rad/s or m/s: a joint that is faster moves."""


@dataclass(frozen=True)
class Reading:
    """Archives to be read together.

    Attributes:
        archives: excitations, or held-out motions.
        standstill: of the same campaign, for the noise of the positions.
    """

    archives: tuple[Path, ...]
    standstill: tuple[Path, ...] = ()


def fit(reading: Reading, inputs: str) -> FitRecord:
    """Estimate from each repetition and from all (eq. 4)."""
    prepared = _prepared(reading)
    model, recordings = prepared.sources.cell.model, prepared.fitted
    found = estimate_repetitions(model, recordings)
    first, source = recordings[0], prepared.sources.training[0]
    rows = executed_rows(source, first)
    executed = Factor.zero(model)
    for one, own in zip(recordings, prepared.sources.training, strict=True):
        part = executed_rows(own, one)
        motion = one.motion.rows(part)
        executed = executed + Factor.from_samples(model, motion, one.torque[part])
    gram, count = information(executed), rows.stop - rows.start
    shown = _thinned(rows)
    return FitRecord(
        inputs=inputs,
        repetitions=[one.name for one in prepared.sources.training],
        values=[one.values.tolist() for one in found.repetitions],
        pooled=found.pooled.values.tolist(),
        pooled_std=found.pooled.std.tolist(),
        undetermined=list(found.pooled.undetermined),
        noise_std=found.pooled.noise_std.tolist(),
        log10_det=log10_det(gram, count * len(recordings)),
        coupling_index=coupling_index(gram),
        n_samples=count,
        correlation=correlation(gram).tolist(),
        duration=float(first.motion.time[rows.stop - 1] - first.motion.time[rows.start]),
        time=_listed(first.motion.time[shown] - first.motion.time[rows.start]),
        position=[_listed(column) for column in first.motion.position[shown].T],
        velocity=[_listed(column) for column in first.motion.velocity[shown].T],
    )


def score(
    reading: Reading, inputs: str, estimates: Mapping[str, Sequence[float]], shown: Sequence[str]
) -> ScoreRecord:
    """Predict held-out motions by several estimates.

    Args:
        reading: the held-out archives.
        inputs: digest of all this rests on.
        estimates: parameters (p,) by name.
        shown: estimates of the example in time, drawn on the motion of median error.
    """
    prepared = _prepared(reading)
    model, runs = prepared.sources.cell.model, prepared.fitted
    table = np.array(list(estimates.values()), dtype=np.float64)
    truth = list(estimates).index(PLANTED) if PLANTED in estimates else None
    by_motion = [_scored(model, table, run, truth) for run in runs]
    usable = [run.usable[_motion_rows(run)] for run in runs]
    errors = {
        quantity: {
            name: [some[k][quantity] for some in by_motion]
            for k, name in enumerate(estimates)
            if quantity in by_motion[0][k]
        }
        for quantity in ("overall", "unfiltered", "all_rows", "own", "mean_abs")
    }
    examples = []
    if shown:
        every = np.mean([errors["overall"][name] for name in shown], axis=0)
        typical = int(np.argsort(every, kind="stable")[(len(every) - 1) // 2])
        series = {name: np.asarray(estimates[name]) for name in shown}
        examples.append(_example(prepared, runs[typical], typical, series))
    return ScoreRecord(
        inputs=inputs,
        durations=[float(run.motion.time[-1] - run.motion.time[0]) for run in runs],
        samples=[len(rows) for rows in usable],
        left_out=[np.count_nonzero(~rows, axis=0).tolist() for rows in usable],
        forms=[
            motion_form(model, source.name, run)
            for source, run in zip(prepared.sources.training, runs, strict=True)
        ],
        examples=examples,
        **errors,
    )


def _scored(
    model: RobotModel, table: Array, run: Samples, truth: int | None
) -> list[dict[str, Any]]:
    """Errors of every row of a table of estimates (k, p) on one motion; one may be the truth.

    The regressor and the low-pass, which cost most, are made once for all of them.
    """
    left = np.zeros((*run.torque.shape, len(table)))
    blocks, columns = run.regressor(model)
    for j, (block, used) in enumerate(zip(blocks, columns, strict=True)):
        left[:, j] = run.torque[:, j, None] - block @ table[:, used].T
    everywhere = low_passed(run, left.reshape(len(left), -1)).reshape(left.shape)
    left[~run.usable] = 0.0
    slow = low_passed(run, left.reshape(len(left), -1)).reshape(left.shape)
    best = None if truth is None else left[..., truth]
    return [
        _errors(run, left[..., k], slow[..., k], everywhere[..., k], None if k == truth else best)
        for k in range(len(table))
    ]


def _errors(
    run: Samples, left: Array, slow: Array, everywhere: Array, best: Array | None
) -> dict[str, Any]:
    """Errors of what an estimate leaves of the torque (m, n), as it is and low-passed.

    `everywhere` is low-passed with the rows that are not usable, `best` is what the planted values
    leave: the noise, and what the model leaves out.
    """
    whole = _motion_rows(run)
    error = PredictionError.between(run.torque, run.torque - slow, run.usable)
    raw = PredictionError.between(run.torque, run.torque - left, run.usable)
    all_rows = PredictionError.between(run.torque[whole], run.torque[whole] - everywhere[whole])
    found = {
        "overall": error.overall,
        "unfiltered": raw.overall,
        "all_rows": all_rows.overall,
        "mean_abs": error.mean_absolute.tolist(),
    }
    if best is not None:
        own = PredictionError.between(run.torque, run.torque - (left - best), run.usable)
        found["own"] = own.overall
    return found


def _motion_rows(run: Samples) -> slice:
    """Samples from the first to the last at which a joint moves."""
    moving = np.flatnonzero((np.abs(run.motion.velocity) > _MOVES).any(axis=1))
    return slice(int(moving[0]), int(moving[-1]) + 1) if moving.size else slice(0, 0)


def _prepared(reading: Reading) -> Prepared:
    """All archives as they are fitted; nothing is held out of what is asked for."""
    paths = [*reading.archives, *reading.standstill]
    options = replace(FIXED, in_sample=True)
    sources = gather_sources(paths, options.split, in_sample=True)
    return prepare_sources(sources, options, Silent())


def _example(
    prepared: Prepared, run: Samples, index: int, estimates: Mapping[str, Array]
) -> ExampleRecord:
    model, time = prepared.sources.cell.model, run.motion.time
    shown = _thinned(moving_rows(run))

    def joints(torque: Array) -> list[list[float]]:
        return [_listed(column) for column in for_figure(time, torque)[shown].T]

    return ExampleRecord(
        archive=prepared.sources.training[index].name,
        time=_listed(time[shown] - time[shown.start]),
        measured=joints(run.torque),
        predicted={
            name: joints(run.predicted_torque(model, values)) for name, values in estimates.items()
        },
    )


def _thinned(rows: slice) -> slice:
    return slice(rows.start, rows.stop, max(1, (rows.stop - rows.start) // SHOWN))


def _listed(values: Array) -> list[float]:
    """Numbers of a figure, to as many digits as an eye could want."""
    return [float(f"{value:.{FIGURE_DIGITS}g}") for value in values.tolist()]
