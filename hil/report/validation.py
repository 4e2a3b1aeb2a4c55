"""Torque prediction on unseen motion, gathered for the page's tables."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from hil.report import numbers
from hil.results import Results, ValidationResult


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


def run_tables(results: Results) -> list[RunTable]:
    """Mean |e|, RMS, signed mean and relative error of each run, per joint."""
    runs = results.validation
    return [
        RunTable("Mean |e|", "N·m", _rows(runs, lambda r: r.mean_abs_error), False),
        RunTable("RMS error", "N·m", _rows(runs, lambda r: r.rms_error), False),
        RunTable("Signed mean error", "N·m", _signed_rows(runs), False),
        RunTable("Relative error", "%", _relative_rows(runs), True),
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
    )
