"""The trend report: one self-contained page on what changed from campaign to campaign."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from hil.compare.findings import findings, summary
from hil.compare.payload import LEAST_EFFECT, Verdict
from hil.compare.trend import (
    FALSE_ALARMS,
    FEWEST,
    LEAST_ERROR,
    LEAST_FRICTION,
    ArmTrend,
    ParameterTrend,
    Trends,
    Watched,
)
from hil.files import write_atomically
from hil.report import numbers
from hil.report.figures.trend import (
    error_trend_panels,
    friction_trend_panels,
    parameter_trend_panels,
    payload_panels,
)
from hil.report.rendering import environment, page_bytes

FILE_NAME: Final = "trend.html"

_NORMAL_INTERVAL = 1.96
_VERDICTS: Final[dict[Verdict, str]] = {
    "agrees": "torques agree",
    "statement only": "carried before as well",
    "either": "torques cannot tell",
    "differs": "torques do not agree",
    "untested": "not tested",
}


def write_trend_report(path: Path, trends: Trends) -> None:
    """Write the page as one HTML file; the same input gives the same bytes."""
    write_atomically(path, page_bytes(render_trend_report(trends)))


def render_trend_report(trends: Trends) -> str:
    """The page as text."""
    parts = [_part(arm, f"t{k}") for k, arm in enumerate(trends.arms)]
    template = environment().get_template("trend.html.j2")
    return template.render(
        trends=trends,
        parts=parts,
        title=trends.arms[0].name if len(parts) == 1 else f"{len(parts)} arms",
        departing_axes=departing_axes,
        expected=expected,
        statement_verdicts=_VERDICTS,
        rules={
            "alarms": f"{100.0 * FALSE_ALARMS:g} %",
            "friction": f"{100.0 * LEAST_FRICTION:g} %",
            "error": f"{100.0 * LEAST_ERROR:g} %",
            "effect": f"{100.0 * LEAST_EFFECT:g} %",
            "fewest": FEWEST,
        },
    )


def _part(arm: ArmTrend, key: str) -> dict[str, Any]:
    """What the page shows of an arm; `key` makes the ids of its figures unique."""
    found = list(findings(arm))
    return {
        "key": key,
        "arm": arm,
        "good": all(one.level != "alarm" for one in found),
        "line": summary(arm),
        "findings": found,
        "span": _span(arm),
        "friction": friction_trend_panels(arm, key),
        "error": error_trend_panels(arm, key),
        "payload": payload_panels(arm, key),
        "inertial": parameter_trend_panels(arm, [p for p in arm.parameters if not p.is_friction]),
        "coefficients": parameter_trend_panels(arm, [p for p in arm.parameters if p.is_friction]),
        "parameters": [_parameter(one) for one in arm.parameters],
    }


def _span(arm: ArmTrend) -> str:
    if not arm.dated:
        return "in the order of their names, since no time of recording is known"
    first, last = arm.when[0][:10], arm.when[-1][:10]
    return first if first == last else f"{first} to {last}"


def departing_axes(arm: ArmTrend, k: int) -> str:
    """Axes that depart from their history in campaign k, and in which figure."""
    found = []
    for axis in arm.axes:
        figures = (("friction", axis.friction), ("torque error", axis.error))
        what = [name for name, watched in figures if watched.departs[k]]
        if what:
            found.append(f"{axis.joint} ({' and '.join(what)})")
    return ", ".join(found)


def expected(watched: Watched) -> str:
    """Limits of the last campaign."""
    band = watched.limits[-1]
    if band is None:
        return numbers.MISSING
    if band.low <= 0.0:
        return f"below {numbers.significant(band.high)}"
    return f"{numbers.significant(band.low)} to {numbers.significant(band.high)}"


def _parameter(one: ParameterTrend) -> tuple[str, str, Sequence[str]]:
    """Name, unit, and first, last, half interval, lowest and highest value."""
    known = np.isfinite(one.half)
    values = one.values[known]
    if not len(values):
        return one.name, one.unit, [numbers.MISSING] * 5
    half = float(one.half[known][-1])
    first, last, lowest, highest = (
        numbers.beside(float(value), half / _NORMAL_INTERVAL)
        for value in (values[0], values[-1], values.min(), values.max())
    )
    return one.name, one.unit, [first, last, numbers.significant(half, 2), lowest, highest]
