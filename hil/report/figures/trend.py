"""Figures of an arm from campaign to campaign."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import matplotlib.dates as mdates
import numpy as np
from markupsafe import Markup, escape
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from hil.compare.trend import ArmTrend, AxisTrend, ParameterTrend, Watched
from hil.reading import instant
from hil.report import numbers
from hil.report.figures.canvas import TICK_SIZE, headed, plot_panel, ruled
from hil.report.figures.palette import BAND, FIRST, MUTED, OUTSIDE_3, SECOND
from hil.report.figures.svg import Panel, drawing, label, to_panel

Array = NDArray[np.float64]

_WIDTH, _HEIGHT, _LEFT, _RIGHT, _TOP, _BOTTOM = 200.0, 84.0, 8.0, 8.0, 8.0, 18.0
_TEXT: Final = 10.5


def sparkline(
    at: Array, values: Array, half: Array, *, colour: str, ends: Sequence[str], alt: str
) -> Markup:
    """Points with bars as inline SVG, their median, and both ends in words.

    Args:
        at: horizontal place (c,), rising.
        values: (c,), NaN where there is none; one at least is finite.
        half: half length of the bars (c,).
        colour: variable of the style sheet.
        ends: what stands below the first and the last place.
        alt: what it shows.
    """
    known = np.isfinite(values)
    low, high = float((values - half)[known].min()), float((values + half)[known].max())
    if not high > low:
        low, high = low - 0.5, high + 0.5
    span = float(at[-1] - at[0]) or 1.0
    inner, tall = _WIDTH - _LEFT - _RIGHT, _HEIGHT - _TOP - _BOTTOM
    x = _LEFT + inner * ((at - at[0]) / span if at[-1] > at[0] else np.full(len(at), 0.5))
    y, top, bottom = (
        _TOP + tall * (high - line) / (high - low)
        for line in (values, values + half, values - half)
    )
    bars = "".join(f"M{x[k]:.1f} {top[k]:.1f}V{bottom[k]:.1f}" for k in np.flatnonzero(known))
    dots = "".join(
        f'<circle cx="{x[k]:.1f}" cy="{y[k]:.1f}" r="2.4"/>' for k in np.flatnonzero(known)
    )
    middle = float(np.median(values[known]))
    level = _TOP + tall * (high - middle) / (high - low)
    words = "".join(
        f'<text x="{place:g}" y="{_HEIGHT - 4:g}" text-anchor="{anchor}" font-size="{_TEXT}"'
        f' style="fill:var(--muted)">{escape(text)}</text>'
        for place, anchor, text in ((_LEFT, "start", ends[0]), (_WIDTH - _RIGHT, "end", ends[-1]))
    )
    reach = f"{numbers.significant(low)} and {numbers.significant(high)}"
    described = f"{alt} Intervals lie within {reach}."
    median = f"M{_LEFT:g} {level:.1f}H{_WIDTH - _RIGHT:g}"
    return Markup(
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH:g} {_HEIGHT:g}" role="img"'
        f' aria-label="{escape(described)}">'
        f'<path d="{median}" style="stroke:var(--line);fill:none"/>'
        f'<path d="{bars}" style="stroke:var({colour});stroke-width:1.1;fill:none"/>'
        f'<g style="fill:var({colour})">{dots}</g>{words}</svg>'
    )


_TICKS = 4
_DAY = 86400.0
# Half a 95 % interval, in standard deviations.
_INTERVAL: Final = 1.96


def friction_trend_panels(arm: ArmTrend, key: str) -> list[Panel]:
    """Friction of each axis with intervals, and where the campaigns before let expect it."""
    return [
        _axis_panel(arm, axis, axis.friction, f"{key}f{j}", "friction", SECOND)
        for j, axis in enumerate(arm.axes)
        if np.isfinite(axis.friction.values).any()
    ]


def error_trend_panels(arm: ArmTrend, key: str) -> list[Panel]:
    """Torque error of each axis, and the highest that the campaigns before let expect."""
    return [
        _axis_panel(arm, axis, axis.error, f"{key}e{j}", "torque error", FIRST)
        for j, axis in enumerate(arm.axes)
        if np.isfinite(axis.error.values).any()
    ]


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


def parameter_trend_panels(arm: ArmTrend, parameters: Sequence[ParameterTrend]) -> list[Panel]:
    """Each parameter with its 95 % intervals."""
    panels = []
    ends = [arm.when[k][:10] if arm.dated else f"{arm.time[k]:g}" for k in (0, -1)]
    for parameter in parameters:
        known = np.isfinite(parameter.half)
        if not known.any():
            continue
        values = np.where(known, parameter.values, np.nan)
        last = int(np.flatnonzero(known)[-1])
        std = float(parameter.half[last]) / _INTERVAL
        note = f"{numbers.beside(float(values[last]), std)} ± {numbers.significant(std, 2)}"
        alt = f"{parameter.name} over {len(values)} campaigns; last {note} {parameter.unit}."
        svg = sparkline(
            arm.time,
            values,
            np.where(known, parameter.half, 0.0),
            colour="--second" if parameter.is_friction else "--first",
            ends=ends,
            alt=alt,
        )
        title = f"{label(parameter.name)} [{parameter.unit.replace(' ', '·')}]"
        panels.append(Panel(title=title, note=note, svg=svg, width=200.0))
    return panels


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
    first = instant(arm.when[0]) if arm.dated else None
    if first is None:
        return [float(t) for t in arm.time]
    start = first.timestamp() / _DAY
    return [start + float(t) for t in arm.time]
