"""The page: results and series in, one self-contained HTML file out."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from hil.report import (
    consistency,
    essential,
    estimation,
    figures,
    overview,
    parameters,
    validation,
    verdict,
)
from hil.report.series import ReportSeries
from hil.results import Results

_TEMPLATES = Path(__file__).parent / "templates"


class _Numbering:
    """Numbers figures and tables in the order in which the page shows them."""

    def __init__(self) -> None:
        self._figures, self._tables = itertools.count(1), itertools.count(1)

    def figure(self) -> int:
        return next(self._figures)

    def table(self) -> int:
        return next(self._tables)


def report_bytes(results: Results, series: ReportSeries) -> bytes:
    """The report as one HTML file; the same input gives the same bytes.

    Raises:
        SeriesError: the series belong to another number of joints than the results.
    """
    # A name read from an archive may hold what UTF-8 cannot; the page must come out all the same.
    return render_report(results, series).encode("utf-8", errors="replace")


def render_report(results: Results, series: ReportSeries) -> str:
    """The page as text.

    Raises:
        SeriesError: the series belong to another number of joints than the results.
    """
    series = series.checked_for(len(results.joint_names))
    template = _environment().get_template("report.html.j2")
    return template.render(**_context(results, series))


def _environment() -> Environment:
    # Autoescape without conditions: names come out of archives, and archives out of anywhere.
    environment = Environment(
        loader=FileSystemLoader(_TEMPLATES),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.globals["style"] = Markup((_TEMPLATES / "report.css").read_text(encoding="utf-8"))
    return environment


def _context(results: Results, series: ReportSeries) -> dict[str, Any]:
    labels = [parameters.short_label(p) for p in results.parameters]
    base, friction = parameters.table_rows(results)
    routes = parameters.routes(results)
    return {
        "numbering": _Numbering(),
        "results": results,
        "series": series,
        "facts": overview.facts(results),
        "estimation_facts": estimation.facts(results),
        "criteria": overview.criteria(results),
        "overall": validation.overall(results),
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
        "deviation_panels": figures.deviation_panels(results),
        "uncertainty_panels": figures.uncertainty_panels(results, routes),
        "correlation": figures.correlation_matrix(results),
        "box_panels": figures.error_boxes(results),
        "torque_panels": figures.torque_panels(series, results.joint_names),
        **verdict.verdict_context(results),
        **essential.context(results),
        **consistency.context(results),
    }
