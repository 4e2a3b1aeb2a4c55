"""Pages on changes between campaigns: comparison of campaigns, and trend of a batch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import matplotlib.dates as mdates
import numpy as np
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from hil.batch.types import BatchResult
from hil.compare.comparison import MIN_REPETITIONS, Comparison
from hil.compare.payload import LEAST_EFFECT
from hil.compare.trend import (
    FALSE_ALARMS,
    LEAST_ERROR,
    LEAST_FRICTION,
    MIN_CAMPAIGNS,
    ArmTrend,
    AxisTrend,
    ControlChart,
    findings,
    summary,
)
from hil.reading import parse_time
from hil.report.drawing import (
    BAND,
    DASHED,
    FIRST,
    MUTED,
    OUTSIDE_3,
    SECOND,
    TICK_SIZE,
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
_INTERVAL: Final = 1.96  # Half a 95 % interval, in standard deviations
_RULES: Final = {
    "alarms": f"{100.0 * FALSE_ALARMS:g} %",
    "half": f"{50.0 * FALSE_ALARMS:g} %",
    "friction": f"{100.0 * LEAST_FRICTION:g} %",
    "error": f"{100.0 * LEAST_ERROR:g} %",
    "effect": f"{100.0 * LEAST_EFFECT:g} %",
    "fewest": MIN_CAMPAIGNS,
    "repetitions": MIN_REPETITIONS,
}


def comparison_page(found: Comparison) -> bytes:
    """Return the comparison as one HTML file; the same input gives the same bytes."""
    differ = [
        ", ".join(found.axes[j].joint for j in np.flatnonzero(own))
        for own in found.friction.changed.T
    ]
    part = vars(found) | {
        "key": "t0",
        "good": not found.changed,
        "line": found.verdict,
        "campaigns": list(zip(found.names, found.campaigns, differ, strict=True)),
    }
    return _page(title=found.arm, kind="Comparison of campaigns", comparison=found, parts=[part])


def trend_page(batch: BatchResult, arms: Sequence[ArmTrend]) -> bytes:
    """Return the trend report as one HTML file; the same input gives the same bytes."""
    return _page(
        title=", ".join(arm.name for arm in arms) or "no campaign",
        kind=f"Trend report: {len(batch.repetitions)} archives, estimator {batch.estimator}",
        batch=batch,
        parts=[_trend(arm, f"t{k}") for k, arm in enumerate(arms)],
    )


def _page(**context: Any) -> bytes:
    template = environment().get_template("changes.html.j2")
    none = {"comparison": None, "batch": None}
    return page_bytes(template.render(rules=_RULES, software=software(), **(none | context)))


def _trend(arm: ArmTrend, key: str) -> dict[str, Any]:
    found, friction, error = findings(arm), list[Panel](), list[Panel]()
    departing = [list[str]() for _ in arm.campaigns]
    for j, axis in enumerate(arm.axes):
        _panel(friction, arm, axis, axis.friction, f"{key}f{j}", "friction")
        _panel(error, arm, axis, axis.error, f"{key}t{j}", "torque error")
        for k, names in enumerate(departing):
            which = {"friction": axis.friction.departs[k], "torque error": axis.error.departs[k]}
            if any(which.values()):
                what = " and ".join(name for name, departs in which.items() if departs)
                names.append(f"{axis.joint} ({what})")
    differ = [", ".join(names) for names in departing]
    return vars(arm) | {
        "key": key,
        "arm": arm.name,
        "good": all(one.level != "alarm" for one in found),
        "line": summary(arm),
        "findings": found,
        "campaigns": list(zip(arm.names, arm.campaigns, differ, strict=True)),
        "friction": friction,
        "error": error,
    }


def _panel(
    panels: list[Panel], arm: ArmTrend, axis: AxisTrend, watched: ControlChart, key: str, what: str
) -> None:
    """Draw an axis over the campaigns: 95 % intervals, limits, drift; departures as squares."""
    values, half = watched.values, _INTERVAL * np.nan_to_num(watched.stds)
    known, judged = np.isfinite(values), np.isfinite(watched.limits[:, 0])
    if not known.any():
        return
    # Matplotlib days, or campaign numbers.
    first = parse_time(arm.campaigns[0].when) if arm.dated else None
    at = arm.time + (0.0 if first is None else first.timestamp() / _DAY)
    low, high = float((values - half)[known].min()), float((values + half)[known].max())
    # A scale that does not exaggerate small changes; distant limits may lie outside.
    room = max(0.2 * (high - low), 0.06 * float(np.median(np.abs(values[known]))), 1e-9)
    low, high = low - room, high + room
    note = f"{sum(watched.departs)} of {judged.sum()} outside" if judged.any() else ""
    ends = " to ".join(significant(float(one)) for one in values[known][[0, -1]])
    caption = Caption(
        key, label(axis.joint), note or "too few for limits", f"{what}, {ends} {axis.unit}"
    )
    with panel(
        panels, 180.0, caption, f"[{axis.unit}]", left=50.0, right=12.0, bottom=32.0
    ) as axes:
        if judged.any():
            centre, lower, upper = watched.limits[judged].T
            edges = np.maximum(lower, low), np.minimum(upper, high)
            axes.fill_between(at[judged], *edges, color=BAND, linewidth=2.0)
            axes.plot(at[judged], centre, color=MUTED, linewidth=1.0, linestyle=DASHED)
        if what == "friction" and axis.drifts and axis.drift is not None:
            here = watched.at_last_level
            line = axis.drift.slope * (arm.time[here] - np.median(arm.time[here]))
            axes.plot(at[here], np.median(values[here]) + line, color=SECOND, linewidth=1.2)
        marked = np.array(watched.departs)
        for which, colour, shape in (
            (known & ~marked, FIRST, "o"),
            (known & marked, OUTSIDE_3, "s"),
        ):
            axes.errorbar(
                at[which], values[which], yerr=half[which], color=colour, marker=shape,
                markersize=5.0, linestyle="none", elinewidth=1.1, zorder=3,
            )  # fmt: skip
        ruled(axes, "both", x_ticks=_TICKS, y_ticks=_TICKS)
        if arm.dated:
            dates: Any = mdates  # without types
            locator = dates.AutoDateLocator(minticks=2, maxticks=_TICKS + 1)
            axes.xaxis.set_major_locator(locator)
            axes.xaxis.set_major_formatter(dates.ConciseDateFormatter(locator))
            axes.xaxis.get_offset_text().set_fontsize(TICK_SIZE)
        else:
            axes.xaxis.set_major_locator(MaxNLocator(_TICKS, integer=True))
        margin = 0.04 * float(np.ptp(at)) or 0.5
        axes.set_xlim(at.min() - margin, at.max() + margin)
        axes.set_ylim(low, high)
