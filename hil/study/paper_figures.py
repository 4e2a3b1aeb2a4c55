"""The best excitation of each method as the paper shows its two: Table 2, Fig. 1 to 4."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import pi
from typing import Any, Final, NamedTuple

import numpy as np

from hil.base.arrays import Array
from hil.cell import Cell
from hil.pipeline.prepared import executed_rows, moving_rows
from identification import Factor, RobotModel
from identification.estimators.least_squares import estimate_repetitions
from identification.excitation import Method, correlation, coupling_index, information, log10_det
from identification.signals.samples import Samples
from identification.validation.prediction import for_figure
from sim_fixtures.ns16 import N_ESSENTIAL, TABLE2, URDF_PATH

from .campaigns import StudyExecution
from .estimates import CAMPAIGN_TIME, low_passed, prepared_archives, repetition_elapsed
from .model_errors import Condition, ModelErrors, PlannedTorque
from .results import (
    TRUE_VALUES,
    HeldOut,
    MethodResult,
    MotionRow,
    ShownCondition,
    StudyParameter,
)
from .searches import LABELS, Search

TABLE1: Final = (
    ("a", 2000, 90.5, 127.9, "W = 3, own frequencies; 100 individuals"),
    ("b", 15996, 30.9, 101.2, "K = 6, λ1 = 0.7, λ2 = 0.3; 150 individuals"),
)
"""The paper's Table 1: method, N, log det (units not stated), I_c, notes."""
_MAX_ROWS: Final = 1200  # maximum number of rows of a series in a figure
_MIN_MOVING_SPEED: Final = 1e-3  # speed above which a joint moves, rad/s or m/s


def best_of(searches: Sequence[Search]) -> dict[Method, Search]:
    """Return the search of each method whose motion has the largest determinant.

    Of B that of largest fitness (eq. 7): each by what the paper chooses it by.
    """

    def score(search: Search) -> float:
        criteria = search.excitation.criteria
        return criteria.fitness if search.method == "b" else criteria.log10_det

    return {
        method: max((one for one in searches if one.method == method), key=score)
        for method in LABELS
    }


# The paper's numbers


def is_printed(cell: Cell) -> bool:
    """Return whether a cell has the arm of the paper, the NS 16."""
    return cell.urdf == URDF_PATH.read_text(encoding="utf-8")


def printed_rows(cell: Cell) -> list[MotionRow]:
    """Return the printed rows of Table 1; none for another arm than the NS 16."""
    names = ("key", "n_samples", "log10_det", "coupling_index", "words")
    return [
        MotionRow.model_validate(dict(zip(names, row, strict=True)) | {"printed": True})
        for row in (TABLE1 if is_printed(cell) else ())
    ]


def parameters_of(cell: Cell, truth: Array) -> list[StudyParameter]:
    """Return the parameters with true values (p,) and the printed values of Table 2.

    Rows 41 to 52 are interleaved. Viscous and third friction terms are assumed to be per degree and
    per degree²: per radian the viscous friction would be negligible.
    """
    model = cell.model
    printed = dict[str, dict[str, Any]]()
    for row in TABLE2 if is_printed(cell) else ():
        order = {"f1": 1, "f2": 2}.get(row.parameter[:2], 0) if row.id > N_ESSENTIAL else 0
        printed[row.pivot or row.parameter] = {
            "printed_id": row.id,
            "printed_symbol": row.parameter,
            "printed_factor": row.sign * (pi / 180.0) ** order,
            "printed_a": row.pi_a,
            "printed_b": row.pi_b,
            "printed_c": row.pi_c,
        }
    return [
        StudyParameter(name=name, unit=unit, truth=float(value), **printed.get(name, {}))
        for name, unit, value in zip(model.parameter_names, model.units, truth, strict=True)
    ]


# Estimates and predictions


def shown_condition(
    condition: Condition,
    errors: ModelErrors,
    best: Mapping[Method, StudyExecution],
    fly_by: StudyExecution,
    truth: Array,
) -> ShownCondition:
    """Estimate from the best campaign of each method, and predict the held-out fly-by motions.

    Args:
        condition: the error of the model.
        errors: of the simulated arm.
        best: campaigns by method.
        fly_by: the campaign with the held-out motions.
        truth: the true parameters (p,).
    """
    model = errors.fitted(condition).model
    methods = [
        _method(method, condition, errors, model, execution) for method, execution in best.items()
    ]
    of_methods: dict[str, Array] = {method.key: np.array(method.mean) for method in methods}
    prepared = prepared_archives(fly_by.root, "validation")
    runs = {}
    for source, samples, motion in zip(
        prepared.sources.training, prepared.fitted, fly_by.plan.validation, strict=True
    ):
        plan = PlannedTorque.of(fly_by.cell, motion.trajectory)
        runs[source.name] = _measured(condition, errors, samples, plan, CAMPAIGN_TIME)
    return ShownCondition(
        condition=condition.key,
        methods=methods,
        held_out=_held_out(model, runs, of_methods | {TRUE_VALUES: truth}),
    )


def _measured(
    condition: Condition,
    errors: ModelErrors,
    samples: Samples,
    plan: PlannedTorque,
    elapsed: float,
) -> Samples:
    """Return samples with the torque that is measured under a condition."""
    time = samples.motion.time - samples.origin
    torque = errors.measured(condition, samples.torque, plan, time, elapsed)
    return replace(samples, torque=torque)


def _method(
    key: Method,
    condition: Condition,
    errors: ModelErrors,
    model: RobotModel,
    execution: StudyExecution,
) -> MethodResult:
    """Estimate from each repetition and from all."""
    prepared = prepared_archives(execution.root, "excitation")
    sources = prepared.sources.training
    plan = PlannedTorque.of(execution.cell, execution.plan.excitation.trajectory)
    count = len(prepared.fitted)
    fitted = [
        _measured(condition, errors, samples, plan, repetition_elapsed(number, count))
        for number, samples in enumerate(prepared.fitted)
    ]
    estimates = estimate_repetitions(model, fitted)
    executed = Factor.zero(model)
    parts = [
        executed_rows(source, samples) for source, samples in zip(sources, fitted, strict=True)
    ]
    for samples, part in zip(fitted, parts, strict=True):
        executed = executed + Factor.from_samples(
            model, samples.motion.rows(part), samples.torque[part]
        )
    gram = information(executed)
    motion = fitted[0].motion
    rows = parts[0]
    shown = motion.rows(_thinned(rows))
    return MethodResult(
        key=key,
        label=LABELS[key],
        values=estimates.values.tolist(),
        mean=estimates.mean.tolist(),
        std=estimates.values.std(axis=0, ddof=1).tolist(),
        pooled=estimates.pooled.values.tolist(),
        pooled_std=estimates.pooled.std.tolist(),
        undetermined=list(estimates.pooled.undetermined),
        log10_det=log10_det(gram, (rows.stop - rows.start) * len(sources)),
        coupling_index=coupling_index(gram),
        correlation=correlation(gram).tolist(),
        duration=float(motion.time[rows.stop - 1] - motion.time[rows.start]),
        time=_rounded(shown.time - shown.time[0]),
        position=[_rounded(column) for column in shown.position.T],
    )


def _held_out(
    model: RobotModel, runs: Mapping[str, Samples], estimates: Mapping[str, Array]
) -> HeldOut:
    """Predict motions by several estimates (p,); the series are of the motion of median error."""
    table = np.array(list(estimates.values()))
    errors = [_errors(model, table, run) for run in runs.values()]
    overall = {name: [error.usable[k] for error in errors] for k, name in enumerate(estimates)}
    usable = [run.usable[_motion_rows(run)] for run in runs.values()]
    every = np.sum([overall[name] for name in LABELS], axis=0)
    typical = list(runs)[int(np.argsort(every, kind="stable")[(len(every) - 1) // 2])]
    run = runs[typical]
    time = run.motion.time
    shown = _thinned(moving_rows(run))

    def joints(torque: Array) -> list[list[float]]:
        return [_rounded(column) for column in for_figure(time, torque)[shown].T]

    return HeldOut(
        archives=list(runs),
        overall={name: [float(one) for one in values] for name, values in overall.items()},
        all_rows={
            n: [float(error.all_rows[k]) for error in errors] for k, n in enumerate(estimates)
        },
        mean_abs={
            n: [error.mean_abs[k].tolist() for error in errors] for k, n in enumerate(estimates)
        },
        left_out=(1.0 - np.mean(np.concatenate(usable), axis=0)).tolist(),
        example=typical,
        time=_rounded(time[shown] - time[shown.start]),
        measured=joints(run.torque),
        predicted={n: joints(run.predicted_torque(model, estimates[n])) for n in LABELS},
    )


class _MotionErrors(NamedTuple):
    """Low-passed errors of k estimates on one motion."""

    mean_abs: Array  # mean |e| per joint over usable rows (k, n) [N·m]
    usable: Array  # relative error over usable rows (k,)
    all_rows: Array  # relative error over all rows (k,)


def _errors(model: RobotModel, table: Array, run: Samples) -> _MotionErrors:
    """Return low-passed errors of estimates (k, p) on one motion."""
    residual = np.zeros((*run.torque.shape, len(table)))
    for j, (block, used) in enumerate(zip(*run.regressor(model), strict=True)):
        residual[:, j] = run.torque[:, j, None] - block @ table[:, used].T

    def filtered(error: Array) -> Array:
        return low_passed(run, error.reshape(len(error), -1)).reshape(error.shape)

    whole = _motion_rows(run)
    squared = (filtered(residual)[whole] ** 2).sum(axis=(0, 1)) / (run.torque[whole] ** 2).sum()
    residual[~run.usable] = 0.0
    slow = np.where(run.usable[..., None], filtered(residual), 0.0)
    rows = np.maximum(np.count_nonzero(run.usable, axis=0), 1)
    torque = np.where(run.usable, run.torque, 0.0)
    relative = np.sqrt((slow**2).sum(axis=(0, 1)) / (torque**2).sum())
    return _MotionErrors((np.abs(slow).sum(axis=0) / rows[:, None]).T, relative, np.sqrt(squared))


def _motion_rows(run: Samples) -> slice:
    """Return the samples from the first to the last at which a joint moves."""
    moving = np.flatnonzero((np.abs(run.motion.velocity) > _MIN_MOVING_SPEED).any(axis=1))
    return slice(int(moving[0]), int(moving[-1]) + 1) if moving.size else slice(0, 0)


def _thinned(rows: slice) -> slice:
    return slice(rows.start, rows.stop, max(1, (rows.stop - rows.start) // _MAX_ROWS))


def _rounded(values: Array) -> list[float]:
    return [float(f"{value:.5g}") for value in values.tolist()]
