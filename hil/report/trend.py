"""The trend report: one self-contained page on what changed from campaign to campaign."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from hil.compare.findings import Finding, findings, summary
from hil.compare.payload import LEAST_EFFECT, Statement, Verdict
from hil.compare.trend import (
    FALSE_ALARMS,
    FEWEST,
    LEAST_ERROR,
    LEAST_FRICTION,
    ArmTrend,
    AxisTrend,
    ParameterTrend,
    Trends,
    Watched,
)
from hil.files import write_atomically
from hil.report import numbers
from hil.report.figures.svg import Panel
from hil.report.figures.trend import (
    error_trend_panels,
    friction_trend_panels,
    parameter_trend_panels,
    payload_panels,
)
from hil.report.rendering import Numbering, environment, page_bytes

FILE_NAME: Final = "trend.html"

_NORMAL_INTERVAL = 1.96
_VERDICTS: Final[dict[Verdict, str]] = {
    "agrees": "torques agree",
    "statement only": "carried before as well",
    "either": "torques cannot tell",
    "differs": "torques do not agree",
    "untested": "not tested",
}


@dataclass(frozen=True)
class CampaignRow:
    """One campaign of an arm, every number already text."""

    name: str
    when: str
    mass: str
    p_value: str
    payload: str
    stated: str
    axes: str
    departs: bool


@dataclass(frozen=True)
class AxisRow:
    """The last campaign of an axis beside those before it, every number already text."""

    joint: str
    unit: str
    speed: str
    friction: str
    friction_limits: str
    error: str
    error_limit: str
    drift: str
    drift_p: str
    departs: bool


@dataclass(frozen=True)
class ParameterRow:
    """One parameter over all campaigns, every number already text."""

    name: str
    unit: str
    first: str
    last: str
    half: str
    lowest: str
    highest: str


@dataclass(frozen=True)
class ArmPart:
    """What the page shows of an arm."""

    key: str
    name: str
    good: bool
    line: str
    findings: list[Finding]
    warnings: tuple[str, ...]
    campaigns: int
    span: str
    untested: str
    campaign_rows: list[CampaignRow]
    axis_rows: list[AxisRow]
    parameter_rows: list[ParameterRow]
    friction: list[Panel]
    error: list[Panel]
    payload: list[Panel]
    inertial: list[Panel]
    coefficients: list[Panel]


def write_trend_report(path: Path, trends: Trends) -> None:
    """Write the page as one HTML file; the same input gives the same bytes."""
    write_atomically(path, page_bytes(render_trend_report(trends)))


def render_trend_report(trends: Trends) -> str:
    """The page as text."""
    parts = [_arm_part(arm, f"t{k}") for k, arm in enumerate(trends.arms)]
    template = environment().get_template("trend.html.j2")
    return template.render(
        numbering=Numbering(),
        trends=trends,
        parts=parts,
        title=_title(parts),
        rules={
            "alarms": f"{100.0 * FALSE_ALARMS:g} %",
            "friction": f"{100.0 * LEAST_FRICTION:g} %",
            "error": f"{100.0 * LEAST_ERROR:g} %",
            "effect": f"{100.0 * LEAST_EFFECT:g} %",
            "fewest": FEWEST,
        },
    )


def _title(parts: list[ArmPart]) -> str:
    if len(parts) == 1:
        return parts[0].name
    return f"{len(parts)} arms"


def _arm_part(arm: ArmTrend, key: str) -> ArmPart:
    found = list(findings(arm))
    return ArmPart(
        key=key,
        name=arm.name,
        good=all(one.level != "alarm" for one in found),
        line=summary(arm),
        findings=found,
        warnings=arm.warnings,
        campaigns=len(arm.campaigns),
        span=_span(arm),
        untested=arm.payload.untested,
        campaign_rows=[_campaign_row(arm, k) for k in range(len(arm.campaigns))],
        axis_rows=[_axis_row(axis) for axis in arm.axes],
        parameter_rows=[_parameter_row(one) for one in arm.parameters],
        friction=friction_trend_panels(arm, key),
        error=error_trend_panels(arm, key),
        payload=payload_panels(arm, key),
        inertial=parameter_trend_panels(arm, [p for p in arm.parameters if not p.is_friction]),
        coefficients=parameter_trend_panels(arm, [p for p in arm.parameters if p.is_friction]),
    )


def _span(arm: ArmTrend) -> str:
    if not arm.dated:
        return "in the order of their names, since no time of recording is known"
    first, last = arm.when[0][:10], arm.when[-1][:10]
    return first if first == last else f"{first} to {last}"


def _campaign_row(arm: ArmTrend, k: int) -> CampaignRow:
    payload = arm.payload
    change = payload.changes[k]
    departing = [
        f"{axis.joint} ({' and '.join(what)})" for axis in arm.axes if (what := _what(axis, k))
    ]
    return CampaignRow(
        name=arm.labels[k],
        when=arm.when[k][:16].replace("T", " ") if arm.dated else numbers.MISSING,
        mass=_with_std(float(payload.mass[k]), float(payload.mass_std[k])),
        p_value=numbers.MISSING if change is None else numbers.significant(change.p_value, 2),
        payload="changed" if payload.changed[k] else "other" if payload.other[k] else "",
        stated=_stated(payload.statements[k]),
        axes=", ".join(departing),
        departs=bool(departing) or payload.changed[k] or payload.other[k],
    )


def _stated(statement: Statement | None) -> str:
    """Another payload than the campaign before states, and what the torques say of it."""
    if statement is None:
        return ""
    mass = 0.0 if statement.after is None else statement.after.mass
    return f"{mass:g} kg from here on ({_VERDICTS[statement.verdict]})"


def _what(axis: AxisTrend, k: int) -> list[str]:
    named = (("friction", axis.friction), ("torque error", axis.error))
    return [name for name, watched in named if watched.departs[k]]


def _axis_row(axis: AxisTrend) -> AxisRow:
    drift = axis.drift
    size = abs(float(np.nanmedian(axis.friction.values))) if _any(axis.friction) else 0.0
    total = None if drift is None or not size else drift.slope * drift.span / size
    return AxisRow(
        joint=axis.joint,
        unit=axis.unit,
        speed=f"{axis.speed:.2g} {axis.speed_unit}" if math.isfinite(axis.speed) else "any speed",
        friction=_with_std(float(axis.friction.values[-1]), float(axis.friction.stds[-1])),
        friction_limits=_limits(axis.friction),
        error=numbers.significant(_known(float(axis.error.values[-1]))),
        error_limit=_limits(axis.error),
        drift=numbers.MISSING if total is None else f"{100.0 * total:+.1f}",
        drift_p=numbers.MISSING if drift is None else numbers.significant(drift.p_value, 2),
        departs=axis.friction.departs[-1] or axis.error.departs[-1] or axis.drifts,
    )


def _any(watched: Watched) -> bool:
    return bool(np.isfinite(watched.values).any())


def _limits(watched: Watched) -> str:
    band = watched.limits[-1]
    if band is None:
        return numbers.MISSING
    if band.low <= 0.0:
        return f"below {numbers.significant(band.high)}"
    return f"{numbers.significant(band.low)} to {numbers.significant(band.high)}"


def _parameter_row(one: ParameterTrend) -> ParameterRow:
    known = np.isfinite(one.half)
    values = one.values[known]
    if not len(values):
        return ParameterRow(one.name, one.unit.replace(" ", "·"), *("–",) * 5)
    half = float(one.half[known][-1])
    std = half / _NORMAL_INTERVAL
    first, last, lowest, highest = (
        numbers.beside(float(value), std)
        for value in (values[0], values[-1], values.min(), values.max())
    )
    return ParameterRow(
        one.name,
        one.unit.replace(" ", "·"),
        first,
        last,
        numbers.significant(half, 2),
        lowest,
        highest,
    )


def _with_std(value: float, std: float) -> str:
    if not math.isfinite(value):
        return numbers.MISSING
    if not std > 0.0:
        return numbers.significant(value)
    return f"{numbers.beside(value, std)} ± {numbers.significant(std, 2)}"


def _known(value: float) -> float | None:
    return value if math.isfinite(value) else None
