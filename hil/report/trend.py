"""The trend report: one page on what changed from campaign to campaign, with its figures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import matplotlib.dates as mdates
import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from hil.compare.payload import LEAST_EFFECT, Verdict
from hil.compare.trend import (
    FALSE_ALARMS,
    FEWEST,
    LEAST_ERROR,
    LEAST_FRICTION,
    ArmTrend,
    AxisTrend,
    Trends,
    Watched,
    findings,
    summary,
)
from hil.files import write_atomically
from hil.reading import instant
from hil.report import numbers
from hil.report.drawing import (
    BAND,
    FIRST,
    MUTED,
    OUTSIDE_3,
    SECOND,
    TICK_SIZE,
    Panel,
    drawing,
    headed,
    label,
    plot_panel,
    ruled,
    to_panel,
)
from hil.report.rendering import environment, page_bytes

FILE_NAME: Final = "trend.html"


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
        "friction": [
            _axis_panel(arm, axis, axis.friction, f"{key}f{j}", "friction", SECOND)
            for j, axis in enumerate(arm.axes)
            if np.isfinite(axis.friction.values).any()
        ],
        "error": [
            _axis_panel(arm, axis, axis.error, f"{key}e{j}", "torque error", FIRST)
            for j, axis in enumerate(arm.axes)
            if np.isfinite(axis.error.values).any()
        ],
        "payload": payload_panels(arm, key),
        "parameters": _parameters(arm),
    }


def _span(arm: ArmTrend) -> str:
    if not arm.dated:
        return "in the order of their names, since no time of recording is known"
    first, last = (arm.campaigns[k].when[:10] for k in (0, -1))
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


def _parameters(arm: ArmTrend) -> list[tuple[str, str, Sequence[str]]]:
    """Name, unit, and first, last, half interval, lowest and highest value of each parameter."""
    first = arm.campaigns[0]
    values = np.array([one.values for one in arm.campaigns]).T
    half = np.array([one.interval_factor * one.std for one in arm.campaigns]).T
    rows: list[tuple[str, str, Sequence[str]]] = []
    for name, unit, own, width in zip(first.names, first.units, values, half, strict=True):
        known, texts = np.isfinite(width), [numbers.MISSING] * 5
        if known.any():
            some, last = own[known], float(width[known][-1])
            ends = (some[0], some[-1], some.min(), some.max())
            shown = [numbers.beside(float(value), last / _INTERVAL) for value in ends]
            texts = [*shown[:2], numbers.significant(last, 2), *shown[2:]]
        rows.append((name, unit, texts))
    return rows


Array = NDArray[np.float64]

_TICKS = 4
_DAY = 86400.0
# Half a 95 % interval, in standard deviations.
_INTERVAL: Final = 1.96


def payload_panels(arm: ArmTrend, key: str) -> list[Panel]:
    """Mass that the last link carries on top of that of the first campaign."""
    payload = arm.payload
    if not np.isfinite(payload.mass[1:]).any():
        return []
    changed = np.asarray(payload.changed)
    with drawing():
        figure, axes = plot_panel(180.0, left=50.0, right=12.0, bottom=32.0)
        axes.axhline(0.0, color=MUTED, linewidth=0.9)
        _points(axes, arm, payload.mass, _INTERVAL * payload.mass_std, FIRST, changed)
        _framed(axes, arm, "kg")
        count = int(changed.sum())
        note = f"{count} {'change' if count == 1 else 'changes'}"
        alt = (
            "Mass on the last link on top of the first campaign's: "
            f"{numbers.significant(float(payload.mass[-1]), 2)} kg in the last; {note}."
        )
        return [to_panel(figure, key=f"{key}p", title="Mass put on", note=note, alt=alt)]


def _axis_panel(
    arm: ArmTrend, axis: AxisTrend, watched: Watched, key: str, what: str, colour: str
) -> Panel:
    outside = [k for k, departs in enumerate(watched.departs) if departs]
    judged = sum(one is not None for one in watched.limits)
    note = f"{len(outside)} of {judged} outside" if judged else "too few to judge"
    first, last = (
        numbers.significant(float(watched.values[k]))
        for k in np.flatnonzero(np.isfinite(watched.values))[[0, -1]]
    )
    with drawing():
        figure, axes = plot_panel(180.0, left=50.0, right=12.0, bottom=32.0)
        low, high = _reach(watched)
        axes.set_ylim(low, high)
        _band(axes, arm, watched, low, high)
        marks = np.asarray(watched.departs)
        _points(axes, arm, watched.values, _INTERVAL * watched.stds, colour, marks)
        if axis.drifts and axis.drift is not None and watched is axis.friction:
            _slope(axes, arm, axis)
        axes.set_ylim(low, high)
        _framed(axes, arm, axis.unit)
        alt = f"{axis.joint}: {what}, from {first} to {last} {axis.unit}; {note}."
        return to_panel(figure, key=key, title=label(axis.joint), note=note, alt=alt)


def _reach(watched: Watched) -> tuple[float, float]:
    """A scale that shows all values with their intervals; limits far away may leave it."""
    known = np.isfinite(watched.values)
    half = _INTERVAL * np.where(np.isfinite(watched.stds), watched.stds, 0.0)
    low = float((watched.values - half)[known].min())
    high = float((watched.values + half)[known].max())
    size = float(np.median(np.abs(watched.values[known])))
    # Never one that makes a change of nothing look like much.
    room = max(0.2 * (high - low), 0.06 * size, 1e-9)
    return low - room, high + room


def _band(axes: Axes, arm: ArmTrend, watched: Watched, low: float, high: float) -> None:
    at = _when(arm)
    judged = [(k, one) for k, one in enumerate(watched.limits) if one is not None]
    if not judged:
        return
    x = [at[k] for k, _ in judged]
    lower = [max(one.low, low) for _, one in judged]
    upper = [min(one.high, high) for _, one in judged]
    if len(x) == 1:
        width = 0.02 * (max(at) - min(at)) or 0.5
        x, lower, upper = [x[0] - width, x[0] + width], lower * 2, upper * 2
    axes.fill_between(x, lower, upper, color=BAND, linewidth=0.0)
    axes.plot(
        [at[k] for k, _ in judged],
        [one.centre for _, one in judged],
        color=MUTED,
        linewidth=1.0,
        linestyle=(0, (3, 3)),
    )


def _slope(axes: Axes, arm: ArmTrend, axis: AxisTrend) -> None:
    assert axis.drift is not None
    known = np.flatnonzero(axis.friction.at_last_level)
    middle = float(np.median(arm.time[known]))
    centre = float(np.median(axis.friction.values[known]))
    ends = arm.time[known[[0, -1]]]
    at = _when(arm)
    axes.plot(
        [at[known[0]], at[known[-1]]],
        centre + axis.drift.slope * (ends - middle),
        color=SECOND,
        lw=1.2,
    )


def _points(
    axes: Axes,
    arm: ArmTrend,
    values: Array,
    half: Array,
    colour: str,
    marked: NDArray[np.bool_],
) -> None:
    at = np.asarray(_when(arm))
    known = np.isfinite(values)
    errors = np.where(np.isfinite(half), half, 0.0)
    for which, own, shape in (
        (known & ~marked, colour, "o"),
        (known & marked, OUTSIDE_3, "s"),
    ):
        if which.any():
            axes.errorbar(
                at[which],
                values[which],
                yerr=errors[which],
                color=own,
                marker=shape,
                markersize=5.8 if shape == "s" else 4.2,
                linestyle="none",
                elinewidth=1.1,
                zorder=3,
            )


def _framed(axes: Axes, arm: ArmTrend, unit: str) -> None:
    ruled(axes, "both", x_ticks=_TICKS, y_ticks=_TICKS)
    if arm.dated:
        dates: Any = mdates  # without types
        locator = dates.AutoDateLocator(minticks=2, maxticks=_TICKS + 1)
        axes.xaxis.set_major_locator(locator)
        axes.xaxis.set_major_formatter(dates.ConciseDateFormatter(locator))
        axes.xaxis.get_offset_text().set_fontsize(TICK_SIZE)
    else:
        axes.xaxis.set_major_locator(MaxNLocator(_TICKS, integer=True))
    span = float(np.ptp(_when(arm)))
    margin = 0.04 * span or 0.5
    axes.set_xlim(min(_when(arm)) - margin, max(_when(arm)) + margin)
    headed(axes, f"[{unit}]")


def _when(arm: ArmTrend) -> list[float]:
    """Where campaigns stand: days of matplotlib, or their numbers."""
    first = instant(arm.campaigns[0].when) if arm.dated else None
    if first is None:
        return [float(t) for t in arm.time]
    start = first.timestamp() / _DAY
    return [start + float(t) for t in arm.time]
