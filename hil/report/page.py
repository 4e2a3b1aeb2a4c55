"""The page: results and series in, one self-contained HTML file out."""

from __future__ import annotations

from typing import Any

import numpy as np

from hil.report import (
    choices,
    conduct,
    consistency,
    essential,
    estimation,
    figures,
    overview,
    parameters,
    validation,
    verdict,
)
from hil.report.rendering import Numbering, environment, page_bytes
from hil.report.series import ReportSeries
from hil.results import Results


def report_bytes(results: Results, series: ReportSeries) -> bytes:
    """The report as one HTML file; the same input gives the same bytes.

    Raises:
        SeriesError: the series belong to another number of joints than the results.
    """
    return page_bytes(render_report(results, series))


def render_report(results: Results, series: ReportSeries) -> str:
    """The page as text.

    Raises:
        SeriesError: the series belong to another number of joints than the results.
    """
    series = series.checked_for(len(results.joint_names))
    template = environment().get_template("report.html.j2")
    return template.render(**_context(results, series))


def _context(results: Results, series: ReportSeries) -> dict[str, Any]:
    labels = [parameters.short_label(p) for p in results.parameters]
    base, friction = parameters.table_rows(results)
    routes = parameters.routes(results)
    errors = validation.example_errors(results)
    return {
        "numbering": Numbering(),
        "results": results,
        "series": series,
        "facts": overview.facts(results),
        "estimation_facts": estimation.facts(results),
        "criteria": overview.criteria(results),
        "questions": choices.questions(results),
        "overall": validation.overall(results),
        "error_rows": validation.error_rows(results),
        "joint_errors": validation.joint_errors(results) if results.validation else [],
        "run_tables": validation.run_tables(results) if len(results.validation) > 1 else [],
        "base_rows": base,
        "friction_rows": friction,
        "tally": parameters.tally(results),
        "routes": routes,
        "reported_title": parameters.reported_title(results),
        "pairs": overview.strongest_pairs(results, labels),
        "pairs_above": overview.pairs_above(results, 0.9),
        "has_truth": any(p.truth is not None for p in results.parameters),
        "has_ids": any(p.table2_id is not None for p in results.parameters),
        "has_repetitions": any(p.repetition_std is not None for p in results.parameters),
        "excitation_panels": figures.excitation_panels(series, results.joint_names),
        "has_reversals": bool(np.isfinite(series.reversal_travel).any()),
        "deviation_panels": figures.deviation_panels(results),
        "uncertainty_panels": figures.uncertainty_panels(results, routes),
        "correlation": figures.correlation_matrix(results),
        "box_panels": figures.error_boxes(results),
        "torque_panels": figures.torque_panels(series, errors),
        "split_panels": figures.split_panels(series, errors),
        "spectrum_panels": figures.spectrum_panels(series, errors),
        "curve_panels": figures.friction_curve_panels(series, errors),
        **verdict.verdict_context(results),
        **essential.context(results),
        **consistency.context(results),
        **conduct.context(results),
    }
