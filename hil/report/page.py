"""The page: results and series in, one self-contained HTML file out.

Templates read the results themselves; here is what has to be computed for them.
"""

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
"""Candidates of one choice that are shown: the first, and the best of the others."""


def report_bytes(results: Results, series: ReportSeries) -> bytes:
    """The report as one HTML file; the same input gives the same bytes.

    Raises:
        SeriesError: the series belong to another number of joints than the results.
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
        "replay_panels": figures.replay_panels(series, joints),
        "curve_panels": figures.friction_curve_panels(series, joints),
        **figures.residual_panels(results),
    }
    return page_bytes(environment().get_template("report.html.j2").render(**context))


def every_row_errors(results: Results) -> list[float]:
    """Error of each joint over every row, as a share; empty where no file says it.

    The median of the runs on unseen motion, or the error on what was fitted.
    """
    known = [run.all_rows_joint_errors for run in results.validation]
    if not known and results.fitted is not None:
        known = [results.fitted.all_rows_joint_errors]
    return np.median(np.array(known), axis=0).tolist() if known and all(known) else []


def routes(results: Results) -> dict[str, dict[str, Any]]:
    """The routes to a standard deviation that were computed, compared with the reported one."""
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
    """Indices of the candidates of a choice that the page shows, the first one first."""
    errors = [math.inf if error is None else error for error in choice.errors]
    shown = list(range(len(errors)))
    if len(shown) <= _MOST_CANDIDATES:
        return shown
    # The first is the simplest, against which the others had to pay: least squares.
    best = sorted(shown[1:], key=lambda k: (k != choice.chosen, errors[k]))
    return [0, *best[: _MOST_CANDIDATES - 1]]


def when(recorded: Sequence[RecordedResult]) -> str:
    """From the first archive's begin to the last one's, in a sentence."""
    begins = sorted(one.when for one in recorded if one.when is not None)
    if not begins:
        return (
            "No date is on record; virtual time has none." if recorded else "Nothing was recorded."
        )
    first, last = (one[:16].replace("T", " ") for one in (begins[0], begins[-1]))
    if first[:10] == last[:10]:
        last = last[11:]
    return f"{first} to {last}, where the last motion began (UTC)."


def motion_name(one: RecordedResult) -> str:
    """The motion of an archive as a person calls it."""
    name = ArchiveName.parse(one.archive)
    return one.kind if name is None else name.motion
