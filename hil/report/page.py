"""Identification report: results and series to one self-contained HTML file."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final, get_args

import numpy as np

from hil.archive.header import ArchiveName
from hil.report import figures
from hil.report.rendering import environment, page_bytes
from hil.report.series import ReportSeries
from hil.results import ChoiceResult, RecordedResult, Results, UncertaintyResult, outside_mark

_MOST_CANDIDATES: Final = 6
"""Candidates shown of one choice: the first, and the best of the others."""


def report_bytes(results: Results, series: ReportSeries) -> bytes:
    """Return the report as one HTML file; the same input gives the same bytes.

    Raises:
        SeriesError: series and results have different numbers of joints.
    """
    series = series.checked_for(len(results.joint_names))
    joints, runs = figures.joints_of(results), results.validation
    recorded = [] if results.conduct is None else results.conduct.recorded
    errors = np.array([[r.overall_relative_error, r.all_rows_relative_error] for r in runs])
    context = {
        "results": results,
        "series": series,
        "shown_candidates": shown_candidates,
        "routes": routes(results),
        "has_truth": any(p.truth is not None for p in results.parameters),
        "has_ids": any(p.table2_id is not None for p in results.parameters),
        "has_repetitions": any(p.repetition_std is not None for p in results.parameters),
        "by_name": {parameter.name: parameter for parameter in results.parameters},
        "outside_mark": outside_mark,
        "unseen": np.median(errors, axis=0).tolist() if runs else None,
        "worst": max(runs, key=lambda run: run.overall_relative_error) if runs else None,
        "every_row_errors": every_row_errors(results),
        "when": when(recorded),
        "motion_name": motion_name,
        "warm_up_panels": figures.warm_up_panels(results),
        "excitation_panels": figures.excitation_panels(series, results.joint_names),
        "has_reversals": bool(np.isfinite(series.reversal_travel).any()),
        "correlation": figures.correlation_matrix(results),
        "box_panels": figures.error_boxes(results),
        "torque_panels": figures.torque_panels(series, joints),
        "split_panels": figures.split_panels(series, joints),
        "spectrum_panels": figures.spectrum_panels(series, joints),
        "curve_panels": figures.friction_curve_panels(series, joints),
        **figures.residual_panels(results),
    }
    return page_bytes(environment().get_template("report.html.j2").render(**context))


def every_row_errors(results: Results) -> list[float]:
    """Return the median error of each joint over all rows; [] for older results."""
    known = [run.all_rows_joint_errors for run in results.validation]
    if not known and results.fitted is not None:
        known = [results.fitted.all_rows_joint_errors]
    return np.median(np.array(known), axis=0).tolist() if known and all(known) else []


def routes(results: Results) -> dict[str, dict[str, Any]]:
    """Return the computed methods for the standard deviation, compared with the reported one."""
    uncertainty, reported = results.uncertainty, np.array([p.std for p in results.parameters])
    far = np.array(
        [abs(p.estimate - p.truth) if p.truth is not None else np.nan for p in results.parameters]
    )
    found = {}
    for key in get_args(UncertaintyResult.model_fields["reported"].annotation):
        if getattr(uncertainty, key) is None:
            continue
        std = np.array(getattr(uncertainty, key), dtype=np.float64)
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio, z = std / reported, far / std
        ratio, z = ratio[np.isfinite(ratio)], z[~np.isnan(far)]
        low, median, high = np.quantile(ratio, (0.0, 0.5, 1.0)) if ratio.size else [None] * 3
        within = [f"{np.sum(z <= most)} of {z.size}" for most in (2.0, 3.0)]
        found[key] = {"ratios": (median, low, high), "within": within}
    return found


def shown_candidates(choice: ChoiceResult) -> list[int]:
    """Return the indices of the candidates to show, the first one first."""
    errors = [math.inf if error is None else error for error in choice.errors]
    shown = list(range(len(errors)))
    if len(shown) <= _MOST_CANDIDATES:
        return shown
    # The first is the default, with which the others were compared.
    best = sorted(shown[1:], key=lambda k: (k != choice.chosen, errors[k]))
    return [0, *best[: _MOST_CANDIDATES - 1]]


def when(recorded: Sequence[RecordedResult]) -> str:
    """Format the time from the start of the first archive to that of the last."""
    begins = sorted(one.when for one in recorded if one.when is not None)
    if not begins:
        return "No date: virtual time." if recorded else "Nothing was recorded."
    first, last = (one[:16].replace("T", " ") for one in (begins[0], begins[-1]))
    if first[:10] == last[:10]:
        last = last[11:]
    return f"{first} to {last} (UTC, start of the first and the last motion)."


def motion_name(one: RecordedResult) -> str:
    """Return the motion of an archive, such as "repetition 2"."""
    name = ArchiveName.parse(one.archive)
    return one.kind if name is None else name.motion
