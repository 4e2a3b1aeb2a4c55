"""Torque prediction on unseen motion, gathered for the page's tables."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from hil.report import numbers
from hil.results import FittedResult, Results, ValidationResult


@dataclass(frozen=True)
class JointError:
    """One joint over all validation runs, every number already text."""

    joint: str
    median: str
    quartiles: str
    rms: str
    mean: str
    relative_median: str
    relative_worst: str
    fit_std: str


@dataclass(frozen=True)
class ErrorRow:
    """Torque error over all joints on some motion, in per cent, as text."""

    motion: str
    counted: str
    every_row: str


@dataclass(frozen=True)
class TorqueError:
    """Error of one joint on the example of the figures, in words that stand beside them."""

    joint: str
    unit: str
    words: str


@dataclass(frozen=True)
class RunTable:
    """One error measure of every run and joint, every number already text.

    A row begins with the archive and ends with the error over all joints if `has_overall`;
    otherwise the duration of the run stands after the archive.
    """

    title: str
    unit: str
    rows: list[list[str]]
    has_overall: bool


def joint_errors(results: Results) -> list[JointError]:
    """Summary per joint; RMS and signed mean over all runs, each counting by its duration."""
    runs = results.validation
    seconds = np.array([run.duration for run in runs])
    mean_abs = np.array([run.mean_abs_error for run in runs])
    squares = np.array([run.rms_error for run in runs]) ** 2
    signed = np.array([run.mean_error for run in runs])
    relative = np.array([run.relative_error for run in runs])
    found = []
    for j, name in enumerate(results.joint_names):
        low, middle, high = np.percentile(mean_abs[:, j], (25.0, 50.0, 75.0))
        rms = math.sqrt(float(np.average(squares[:, j], weights=seconds)))
        found.append(
            JointError(
                joint=name,
                median=numbers.significant(float(middle)),
                quartiles=f"{numbers.significant(float(low))} to "
                f"{numbers.significant(float(high))}",
                rms=numbers.significant(rms),
                # To the same decimals as the RMS: a bias is small or not beside that.
                mean=numbers.beside(float(np.average(signed[:, j], weights=seconds)), rms / 10.0),
                relative_median=numbers.percent(float(np.median(relative[:, j]))),
                relative_worst=numbers.percent(float(np.max(relative[:, j]))),
                fit_std=numbers.significant(results.noise_std[j]),
            )
        )
    return found


def error_rows(results: Results) -> list[ErrorRow]:
    """Errors of the verdict and those of every row: on unseen motion, and on what was fitted."""
    runs, fitted, found = results.validation, results.fitted, []
    if runs:
        both = np.array([[r.overall_relative_error, r.all_rows_relative_error] for r in runs])
        many = len(runs) > 1
        title = f"unseen, median of {len(runs)} runs" if many else "unseen"
        found.append(_error_row(title, *np.median(both, axis=0).tolist()))
        if many:
            found.append(_error_row("unseen, worst run", *both.max(axis=0).tolist()))
    if fitted is not None:
        found.append(
            _error_row(
                "fitted" if runs else "fitted (in-sample: nothing was held out)",
                fitted.overall_relative_error,
                fitted.all_rows_relative_error,
            )
        )
        smoothed = fitted.smoothed_overall_relative_error
        if smoothed is not None:
            found.append(_error_row("fitted, torque smoothed as it was fitted", None, smoothed))
    return found


def _error_row(motion: str, counted: float | None, every_row: float) -> ErrorRow:
    return ErrorRow(motion, numbers.percent(counted), numbers.percent(every_row))


def every_row_errors(results: Results) -> list[str]:
    """Error of each joint over every row, in per cent; empty where no file says it.

    The median of the runs on unseen motion, or the error on what was fitted.
    """
    if results.validation:
        known = [run.all_rows_joint_errors for run in results.validation]
    else:
        known = [] if results.fitted is None else [results.fitted.all_rows_joint_errors]
    if not known or not all(known):
        return []
    return [numbers.percent(value) for value in np.median(np.array(known), axis=0).tolist()]


def example_errors(results: Results) -> list[TorqueError]:
    """Errors of each joint on the example of the figures: the first run, or what was fitted."""
    judgement = results.judgement
    units = [joint.unit for joint in judgement.joints] if judgement else []
    example: ValidationResult | FittedResult | None = None
    if results.validation:
        example = results.validation[0]
    elif len(results.repetitions) == 1:
        example = results.fitted
    return [
        TorqueError(name, units[j] if units else "N·m", _error_words(example, j))
        for j, name in enumerate(results.joint_names)
    ]


def _error_words(example: ValidationResult | FittedResult | None, joint: int) -> str:
    if example is None:
        return ""
    words = f"error {numbers.percent(example.relative_error[joint])} %"
    if example.all_rows_joint_errors:
        words += f", every row {numbers.percent(example.all_rows_joint_errors[joint])} %"
    return words


def run_tables(results: Results) -> list[RunTable]:
    """Mean |e|, RMS, signed mean and relative error of each run, per joint."""
    runs = results.validation
    return [
        RunTable("Mean |e|", "N·m", _rows(runs, lambda r: r.mean_abs_error), False),
        RunTable("RMS error", "N·m", _rows(runs, lambda r: r.rms_error), False),
        RunTable("Signed mean error", "N·m", _signed_rows(runs), False),
        RunTable("Relative error", "%", _relative_rows(runs), True),
        *_every_row_table(runs),
    ]


def _rows(
    runs: Sequence[ValidationResult], pick: Callable[[ValidationResult], Sequence[float]]
) -> list[list[str]]:
    return [[*_head(run), *(numbers.significant(v) for v in pick(run))] for run in runs]


def _signed_rows(runs: Sequence[ValidationResult]) -> list[list[str]]:
    # One number of decimals per joint, so that a column can be read down.
    usual = np.median([run.rms_error for run in runs], axis=0)
    return [
        [
            *_head(run),
            *(
                numbers.beside(mean, rms / 10.0)
                for mean, rms in zip(run.mean_error, usual.tolist(), strict=True)
            ),
        ]
        for run in runs
    ]


def _relative_rows(runs: Sequence[ValidationResult]) -> list[list[str]]:
    return [
        [
            run.archive,
            *(numbers.percent(v) for v in run.relative_error),
            numbers.percent(run.overall_relative_error),
        ]
        for run in runs
    ]


def _every_row_table(runs: Sequence[ValidationResult]) -> list[RunTable]:
    if not all(run.all_rows_joint_errors for run in runs):
        return []
    rows = [
        [
            run.archive,
            *(numbers.percent(v) for v in run.all_rows_joint_errors),
            numbers.percent(run.all_rows_relative_error),
        ]
        for run in runs
    ]
    return [RunTable("Relative error over every row", "%", rows, True)]


def _head(run: ValidationResult) -> list[str]:
    return [run.archive, numbers.fixed(run.duration, 1)]


@dataclass(frozen=True)
class Overall:
    """Relative torque error over all joints: median and worst of the runs, in per cent."""

    runs: int
    seconds: str
    median: str
    worst: str
    worst_archive: str
    every_row: str


def overall(results: Results) -> Overall | None:
    """The headline figures; None where nothing was validated."""
    runs = results.validation
    if not runs:
        return None
    errors = [run.overall_relative_error for run in runs]
    worst = int(np.argmax(errors))
    return Overall(
        runs=len(runs),
        seconds=numbers.significant(sum(run.duration for run in runs)),
        median=numbers.percent(float(np.median(errors))),
        worst=numbers.percent(errors[worst]),
        worst_archive=runs[worst].archive,
        every_row=numbers.percent(float(np.median([run.all_rows_relative_error for run in runs]))),
    )
