"""Torque prediction on unseen motion, gathered for the page's tables and figures."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from hil.report import numbers
from hil.results import FittedResult, Results, ValidationResult


@dataclass(frozen=True)
class JointError:
    """One joint over all validation runs, N·m or N, and as shares of the measured torque."""

    joint: str
    lower: float
    median: float
    upper: float
    """Quartiles of the mean absolute error over the runs."""
    rms: float
    mean: float
    relative_median: float
    relative_worst: float
    fit_std: float


@dataclass(frozen=True)
class TorqueError:
    """Error of one joint on the example of the figures, in words that stand beside them."""

    joint: str
    unit: str
    words: str


def joint_errors(results: Results) -> list[JointError]:
    """Summary per joint; RMS and signed mean over all runs, each counting by its duration."""
    runs = results.validation
    if not runs:
        return []
    seconds = np.array([run.duration for run in runs])
    mean_abs = np.array([run.mean_abs_error for run in runs])
    squares = np.array([run.rms_error for run in runs]) ** 2
    signed = np.array([run.mean_error for run in runs])
    relative = np.array([run.relative_error for run in runs])
    lower, median, upper = np.percentile(mean_abs, (25.0, 50.0, 75.0), axis=0).tolist()
    return [
        JointError(
            joint=name,
            lower=lower[j],
            median=median[j],
            upper=upper[j],
            rms=math.sqrt(float(np.average(squares[:, j], weights=seconds))),
            mean=float(np.average(signed[:, j], weights=seconds)),
            relative_median=float(np.median(relative[:, j])),
            relative_worst=float(np.max(relative[:, j])),
            fit_std=results.noise_std[j],
        )
        for j, name in enumerate(results.joint_names)
    ]


def error_rows(results: Results) -> list[tuple[str, float | None, float]]:
    """Motion, error of the verdict and error over every row, all joints, as shares."""
    runs, fitted = results.validation, results.fitted
    found: list[tuple[str, float | None, float]] = []
    if runs:
        both = np.array([[r.overall_relative_error, r.all_rows_relative_error] for r in runs])
        many = len(runs) > 1
        title = f"unseen, median of {len(runs)} runs" if many else "unseen"
        found.append((title, *np.median(both, axis=0).tolist()))
        if many:
            found.append(("unseen, worst run", *both.max(axis=0).tolist()))
    if fitted is not None:
        title = "fitted" if runs else "fitted (in-sample: nothing was held out)"
        found.append((title, fitted.overall_relative_error, fitted.all_rows_relative_error))
        smoothed = fitted.smoothed_overall_relative_error
        if smoothed is not None:
            found.append(("fitted, torque smoothed as it was fitted", None, smoothed))
    return found


def every_row_errors(results: Results) -> list[float]:
    """Error of each joint over every row, as a share; empty where no file says it.

    The median of the runs on unseen motion, or the error on what was fitted.
    """
    known = [run.all_rows_joint_errors for run in results.validation]
    if not known and results.fitted is not None:
        known = [results.fitted.all_rows_joint_errors]
    if not known or not all(known):
        return []
    return [float(value) for value in np.median(np.array(known), axis=0)]


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


def validation_context(results: Results) -> dict[str, Any]:
    """What `verdict.html.j2` and `validation.html.j2` need; `unseen` is None without runs."""
    runs, unseen = results.validation, None
    measures = [
        ("Mean |e|", "mean_abs_error", ""),
        ("RMS error", "rms_error", ""),
        ("Signed mean error", "mean_error", ""),
        ("Relative error", "relative_error", "overall_relative_error"),
    ]
    if all(run.all_rows_joint_errors for run in runs):
        every = ("Relative error over every row", "all_rows_joint_errors")
        measures.append((*every, "all_rows_relative_error"))
    if runs:
        worst = max(runs, key=lambda run: run.overall_relative_error)
        unseen = {
            "seconds": sum(run.duration for run in runs),
            "median": float(np.median([run.overall_relative_error for run in runs])),
            "worst": worst.overall_relative_error,
            "worst_archive": worst.archive,
            "every_row": float(np.median([run.all_rows_relative_error for run in runs])),
        }
    return {
        "unseen": unseen,
        "error_rows": error_rows(results),
        "joint_errors": joint_errors(results),
        "run_measures": measures,
        # One number of decimals per joint, so that a column of signed means can be read down.
        "usual_rms": [float(x) for x in np.median([r.rms_error for r in runs] or [[]], axis=0)],
    }
