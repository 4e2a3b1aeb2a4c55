"""Pages on what changed from campaign to campaign: campaigns compared, and the trend of a batch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import matplotlib.dates as mdates
import numpy as np
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from hil.batch.types import LevelEstimate
from hil.compare import spread
from hil.compare.comparison import Comparison
from hil.compare.payload import LEAST_EFFECT, PayloadTrend
from hil.compare.trend import (
    FALSE_ALARMS,
    FEWEST,
    LEAST_ERROR,
    LEAST_FRICTION,
    ArmTrend,
    Trends,
    findings,
    summary,
)
from hil.reading import instant
from hil.report.drawing import (
    BAND,
    DASHED,
    FIRST,
    MUTED,
    OUTSIDE_3,
    SECOND,
    TICK_SIZE,
    WIDE,
    Caption,
    Panel,
    label,
    panel,
    ruled,
)
from hil.report.numbers import significant
from hil.report.rendering import environment, page_bytes
from hil.version import software

Array = NDArray[np.float64]

_TICKS: Final = 4
_DAY: Final = 86400.0
_INTERVAL: Final = 1.96
"""Half a 95 % interval, in standard deviations."""
_SPREAD: Final = 0.24
_RULES: Final = {
    "alarms": f"{100.0 * FALSE_ALARMS:g} %",
    "half": f"{50.0 * FALSE_ALARMS:g} %",
    "friction": f"{100.0 * LEAST_FRICTION:g} %",
    "error": f"{100.0 * LEAST_ERROR:g} %",
    "effect": f"{100.0 * LEAST_EFFECT:g} %",
    "fewest": FEWEST,
    "repetitions": spread.FEWEST,
}


class _Order(NamedTuple):
    """Where campaigns stand on the horizontal axis (c,): days of matplotlib, or their numbers."""

    at: Array
    dated: bool = False


def comparison_page(found: Comparison) -> bytes:
    """The page as one HTML file; the same input gives the same bytes."""
    order = _Order(np.arange(1.0, len(found.names) + 1.0))
    friction, panels = found.friction, list[Panel]()
    for j, axis in enumerate(found.axes):
        value, std = friction.value[j], friction.std[j]
        if not np.isfinite(value).any():
            continue
        shares = 100.0 * friction.shares[j, 1:, 0]
        note = ", ".join(f"{one:+.1f} %" for one in shares if np.isfinite(one)).replace("-", "−")
        texts = ", ".join(significant(float(one)) for one in value)
        what = f"friction in {axis.unit} by campaign, {texts}"
        caption = Caption(f"f{j}", label(axis.joint), note, what)
        dots = [
            np.column_stack([k + _SPREAD * np.linspace(-1.0, 1.0, len(own)), own[:, j]])
            for k, own in enumerate(found.repetitions, 1)
            if len(own) > 1
        ]
        line = order.at[[0, -1]], value[[0, 0]]
        _panel(
            panels, caption, axis.unit, order, value, std, friction.changed[j], dots=dots, line=line
        )
    differ = [
        ", ".join(found.axes[j].joint for j in np.flatnonzero(own)) for own in friction.changed.T
    ]
    part = {
        "good": not found.changed,
        "line": found.verdict,
        "findings": found.findings,
        "warnings": found.warnings,
        "dated": found.dated,
        "friction": panels,
    }
    shared = _part("t0", found.arm, order, found.campaigns, found.names, found.payload, differ)
    return _page(
        title=found.arm, kind="Comparison of campaigns", comparison=found, parts=[shared | part]
    )


def trend_page(trends: Trends) -> bytes:
    """The page as one HTML file; the same input gives the same bytes."""
    names = [arm.name for arm in trends.arms]
    return _page(
        title=names[0] if len(names) == 1 else f"{len(names)} arms",
        kind=f"Trend report: {trends.archives} archives, estimator {trends.estimator}",
        trends=trends,
        parts=[_trend(arm, f"t{k}") for k, arm in enumerate(trends.arms)],
    )


def _trend(arm: ArmTrend, key: str) -> dict[str, Any]:
    first = instant(arm.campaigns[0].when) if arm.dated else None
    order = _Order(arm.time + (0.0 if first is None else first.timestamp() / _DAY), arm.dated)
    found, friction, error = findings(arm), list[Panel](), list[Panel]()
    for j, axis in enumerate(arm.axes):
        line = None
        if axis.drifts and axis.drift is not None:
            here = axis.friction.at_last_level
            middle, centre = np.median(arm.time[here]), np.median(axis.friction.values[here])
            line = order.at[here], centre + axis.drift.slope * (arm.time[here] - middle)
        for panels, what, watched in (
            (friction, "friction", axis.friction),
            (error, "torque error", axis.error),
        ):
            known = watched.values[np.isfinite(watched.values)]
            if not known.size:
                continue
            judged = np.isfinite(watched.limits[:, 0]).sum()
            note = f"{sum(watched.departs)} of {judged} outside" if judged else "too few to judge"
            ends = " to ".join(significant(float(one)) for one in known[[0, -1]])
            _panel(
                panels,
                Caption(
                    f"{key}{what[0]}{j}", label(axis.joint), note, f"{what}, {ends} {axis.unit}"
                ),
                axis.unit,
                order,
                watched.values,
                watched.stds,
                np.array(watched.departs),
                limits=watched.limits,
                line=line if what == "friction" else None,
            )
    differ = [_departing(arm, k) for k in range(len(arm.campaigns))]
    return _part(key, arm.name, order, arm.campaigns, arm.names, arm.payload, differ) | {
        "good": all(one.level != "alarm" for one in found),
        "line": summary(arm),
        "findings": found,
        "warnings": arm.warnings,
        "friction": friction,
        "error": error,
        "axes": arm.axes,
    }


def _departing(arm: ArmTrend, k: int) -> str:
    """Axes that depart from their history in campaign k, and in which figure."""
    found = []
    for axis in arm.axes:
        figures = (("friction", axis.friction), ("torque error", axis.error))
        if what := [name for name, watched in figures if watched.departs[k]]:
            found.append(f"{axis.joint} ({' and '.join(what)})")
    return ", ".join(found)


def _page(**context: Any) -> bytes:
    template = environment().get_template("changes.html.j2")
    none = {"comparison": None, "trends": None}
    return page_bytes(template.render(rules=_RULES, software=software(), **(none | context)))


def _part(
    key: str,
    arm: str,
    order: _Order,
    campaigns: Sequence[LevelEstimate],
    names: Sequence[str],
    payload: PayloadTrend,
    differ: Sequence[str],
) -> dict[str, Any]:
    """What both pages show of an arm; `key` makes the ids of its figures unique."""
    mass: list[Panel] = []
    if np.isfinite(payload.mass[1:]).any():
        note = f"{significant(float(payload.mass[-1]), 2)} kg in the last campaign"
        caption = Caption(f"{key}p", "Mass put on", note, "on top of the first campaign's")
        changed = np.array(payload.changed)
        line = order.at[[0, -1]], np.zeros(2)
        _panel(mass, caption, "kg", order, payload.mass, payload.mass_std, changed, line=line)
    return {
        "key": key,
        "arm": arm,
        "campaigns": list(zip(names, campaigns, differ, strict=True)),
        "payload": payload,
        "mass": mass,
        "error": [],
        "dated": order.dated,
    }


def _panel(
    panels: list[Panel],
    caption: Caption,
    unit: str,
    order: _Order,
    values: Array,
    stds: Array,
    marked: NDArray[np.bool_],
    *,
    limits: Array | None = None,
    dots: Sequence[Array] = (),
    line: tuple[Array, Array] | None = None,
) -> None:
    """Values of the campaigns (c,) with their 95 % intervals, those that are marked as squares.

    Behind them may lie limits (c, 3), clouds of dots (m, 2), and a line.
    """
    at, known, half = order.at, np.isfinite(values), _INTERVAL * np.nan_to_num(stds)
    low, high = float((values - half)[known].min()), float((values + half)[known].max())
    # Never a scale that makes a change of nothing look like much; limits far away may leave it.
    room = max(0.2 * (high - low), 0.06 * float(np.median(np.abs(values[known]))), 1e-9)
    low, high = low - room, high + room
    with panel(panels, 180.0, caption, f"[{unit}]", left=50.0, right=12.0, bottom=32.0) as axes:
        if limits is not None and (judged := np.isfinite(limits[:, 0])).any():
            centre, lower, upper = limits[judged].T
            edges = np.maximum(lower, low), np.minimum(upper, high)
            axes.fill_between(at[judged], *edges, color=BAND, linewidth=2.0)
            axes.plot(at[judged], centre, color=MUTED, linewidth=1.0, linestyle=DASHED)
        for cloud in dots:
            axes.scatter(cloud[:, 0], cloud[:, 1], s=9.0, color=WIDE, linewidths=0.0)
        if line is not None:
            axes.plot(*line, color=SECOND, linewidth=1.2)
        for which, colour, shape in (
            (known & ~marked, FIRST, "o"),
            (known & marked, OUTSIDE_3, "s"),
        ):
            axes.errorbar(
                at[which], values[which], yerr=half[which], color=colour, marker=shape,
                markersize=5.0, linestyle="none", elinewidth=1.1, zorder=3,
            )  # fmt: skip
        ruled(axes, "both", x_ticks=_TICKS, y_ticks=_TICKS)
        if order.dated:
            dates: Any = mdates  # without types
            locator = dates.AutoDateLocator(minticks=2, maxticks=_TICKS + 1)
            axes.xaxis.set_major_locator(locator)
            axes.xaxis.set_major_formatter(dates.ConciseDateFormatter(locator))
            axes.xaxis.get_offset_text().set_fontsize(TICK_SIZE)
        else:
            axes.xaxis.set_major_locator(MaxNLocator(_TICKS, integer=True))
        margin = 0.04 * float(np.ptp(at)) or 0.5
        margin = margin if order.dated else max(margin, 0.4)
        axes.set_xlim(at.min() - margin, at.max() + margin)
        axes.set_ylim(low, high)
