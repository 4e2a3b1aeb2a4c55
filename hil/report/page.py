"""Identification report: results and series to one self-contained HTML file."""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import partial
from typing import Final, NamedTuple

import numpy as np

from hil import report  # its pictures load matplotlib, on first use
from hil.report import figures
from hil.report.finding_pictures import found_rows
from hil.report.interactive import chart_data, library
from hil.report.numbers import capitalised
from hil.report.rendering import environment, page_bytes, template_text
from hil.report.rollout_section import ROLLOUT_LEGENDS, rollout_charts
from hil.results.error_columns import RMS_TITLE, error_columns
from hil.results.provenance import RESULTS
from hil.results.results import ChoiceResult, ParameterResult, Results, by_id, outside_mark
from hil.results.rollout_result import RolloutResult
from hil.results.series import ReportSeries
from identification.excitation.criteria import CRITERIA
from identification.excitation.searches.methods import METHODS
from identification.validation.purpose_messages import TITLES, figure, requirement

_MAX_CANDIDATES: Final = 6
"""Candidates shown of one choice: the first, and the best of the others."""

_TOTAL_BINS: Final = 1500
"""Intervals of all pictured lines of one kind, with two points in each."""
_MIN_BINS = 80  # of one line
_MAX_BINS = 300

_OFFSET: Final = re.compile(r"fo_\d+")  # constant part of a torque, which may be a sensor's
_USES: Final = {
    "identified.urdf": "the arm for pinocchio, MuJoCo, Gazebo and controllers; other formats:"
    " `hil export FOLDER --to mjcf`",
    "parameters.json": "parameters with covariance and the bodies of the links, for programs",
    "parameters.csv": "a row for each parameter, for spreadsheets, MATLAB and R",
    "parameters_covariance.csv": "their covariance",
    RESULTS: "every number of this page",
}


def report_bytes(
    results: Results, series: ReportSeries, rollout: RolloutResult | None = None
) -> bytes:
    """Return the report as one HTML file; the same input gives the same bytes.

    With a rollout it has a section about it.

    Raises:
        SeriesError: series and results have different numbers of joints.
    """
    series = series.checked_for(len(results.joint_names))
    joints = figures.joints_of(results)
    runs = results.validation
    bins = min(_MAX_BINS, max(_MIN_BINS, _TOTAL_BINS // len(joints)))
    draw = partial(report.chart_panel, bins=bins)
    charts = {
        "torques": figures.torque_charts(series, joints),
        "parts": figures.part_charts(series, joints),
        "spectra": figures.spectrum_charts(series, joints),
        "friction": figures.friction_charts(series, joints),
        "excitation": figures.excitation_charts(series, joints),
        "rollout_errors": [] if rollout is None else rollout_charts(rollout),
        "precision": figures.precision_charts(results),
        **figures.residual_charts(results),
    }
    correlation = figures.correlation_matrix(results)
    errors = np.array([[r.overall_relative_error, r.all_rows_relative_error] for r in runs])
    context = {
        "results": results,
        "rollout": rollout,
        "rollout_legends": ROLLOUT_LEGENDS,
        "series": series,
        "shown_candidates": shown_candidates,
        **_columns_of_parameters(results),
        "found": found_rows(results, series, joints, charts, draw),
        "passed": [
            finding
            for finding in results.judgement.worst_first
            if finding.level in ("information", "good")
        ],
        "by_id": by_id,
        "purposes": purpose_rows(results),
        "error_columns": error_columns(results.judgement),
        "rms_title": RMS_TITLE,
        "files": files_of(results),
        "other_reasons": other_reasons(results),
        "offset_parameters": [p for p in results.parameters if _OFFSET.fullmatch(p.name)],
        "of_paper": partial(of_paper, is_of_paper=any(p.table2_id for p in results.parameters)),
        "joint_of": lambda parameter: joint_of(parameter, results.joint_names),
        "by_name": {parameter.name: parameter for parameter in results.parameters},
        "outside_mark": outside_mark,
        "criteria": CRITERIA,
        "methods": METHODS,
        "unseen": np.median(errors, axis=0).tolist() if runs else None,
        "worst": max(runs, key=lambda run: run.overall_relative_error) if runs else None,
        "every_row_errors": every_row_errors(results),
        "correlation": None if correlation is None else report.matrix_panel(correlation),
        "legend": figures.LEGENDS,
        "part_legends": figures.known_parts(series),
        **{name: [draw(chart) for chart in group] for name, group in charts.items()},
        "chart_data": chart_data(charts, results.joint_names),
    }
    scripts = (*library(), template_text("charts.js"))
    return page_bytes(environment(*scripts).get_template("report.html.j2").render(**context))


def _columns_of_parameters(results: Results) -> dict[str, bool]:
    """Return which columns the table of parameters has."""
    parameters = results.parameters
    return {
        "has_truth": any(p.truth is not None for p in parameters),
        "has_ids": any(p.table2_id is not None for p in parameters),
        "has_prior": any(p.data_share is not None for p in parameters),
        "has_absolute": any(p.absolute_std not in (None, p.std) for p in parameters),
        "has_repetitions": any(p.repetition_std is not None for p in parameters),
    }


class PurposeRow(NamedTuple):
    """A purpose in words."""

    title: str
    good: bool | None
    figure: str
    requirement: str


def purpose_rows(results: Results) -> list[PurposeRow]:
    """Return what the model is good for, a row for each purpose."""
    names = results.joint_names
    return [
        PurposeRow(
            capitalised(TITLES[purpose.name]),
            purpose.good,
            figure(purpose, names),
            requirement(purpose),
        )
        for purpose in results.verdict.purposes
    ]


def files_of(results: Results) -> list[tuple[str, str]]:
    """Return the files that were written, and what each is for."""
    written = () if results.exports is None else results.exports.written
    return [(name, use) for name, use in _USES.items() if name in written or name == RESULTS]


def of_paper(place: str, *, is_of_paper: bool) -> str:
    """Return a reference to the paper, for the arm of the paper only."""
    return f" (paper, {place})" if is_of_paper else ""


def other_reasons(results: Results) -> list[str]:
    """Return why a model is not good, in addition to what the verdict's sentence says."""
    wrong = [finding for finding in results.judgement.findings if finding.level == "wrong"]
    if len(wrong) != len(results.verdict.reasons):  # files of earlier versions
        return list(results.verdict.reasons)
    headline = results.judgement.at(results.verdict.headline)
    return [finding.words for finding in wrong if finding is not headline]


def joint_of(parameter: ParameterResult, joint_names: Sequence[str]) -> str:
    """Return the joint of a friction parameter, from the number at the end of its name."""
    number = re.fullmatch(r"f\w*_(\d+)", parameter.name)
    if number is None or not 1 <= int(number[1]) <= len(joint_names):
        return ""
    return joint_names[int(number[1]) - 1]


def every_row_errors(results: Results) -> list[float]:
    """Return the median error of each joint over all rows."""
    runs = results.validation
    joint_errors = [run.all_rows_joint_errors for run in runs] or [
        results.fitted.all_rows_joint_errors
    ]
    return list(np.median(np.array(joint_errors), axis=0).tolist())


def shown_candidates(choice: ChoiceResult) -> list[int]:
    """Return the indices of the candidates to show, the first one first."""
    shown = list(range(len(choice.errors)))
    if len(shown) <= _MAX_CANDIDATES:
        return shown
    # The first is the default, with which the others were compared.
    best = sorted(shown[1:], key=lambda k: (k != choice.chosen, choice.errors[k]))
    return [0, *best[: _MAX_CANDIDATES - 1]]
