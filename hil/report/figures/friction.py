"""Friction of each joint: over speed, at reversals, and while the arm warmed up."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from hil.report import numbers
from hil.report.figures.canvas import (
    FIRST,
    GRID,
    MUTED,
    SECOND,
    WIDE,
    blank,
    dots,
    footed,
    headed,
    place,
    plot_panel,
    ruled,
)
from hil.report.figures.svg import Panel, drawing, label, to_panel
from hil.report.series import ReportSeries
from hil.report.validation import TorqueError
from hil.results import Results

Array = NDArray[np.float64]

_WIDTH, _HEIGHT = 370.0, 210.0
_LEFT, _TOP, _RIGHT, _BOTTOM = 46.0, 20.0, 10.0, 40.0
_TURN, _GAP = 74.0, 22.0
_ROOM = 0.08
# Points far beyond all others (a stop, a knock) may leave the axes.
_SHOWN = (0.5, 99.5)


def friction_curve_panels(series: ReportSeries, joints: Sequence[TorqueError]) -> list[Panel]:
    """Friction law of each joint through zero, with the data behind it."""
    if series.law_speed.size == 0:
        return []
    return [
        _joint(j, series, one) for j, one in enumerate(joints) if np.ptp(series.law_speed[:, j])
    ]


def _joint(j: int, series: ReportSeries, joint: TorqueError) -> Panel:
    per = "rad" if joint.unit == "N·m" else "m"
    law_speed, law = series.law_speed[:, j], series.law_torque[:, j]
    speed, torque = _known(series.friction_speed, series.friction_torque, j)
    travel, turning = _known(series.reversal_travel, series.reversal_torque, j)
    fast = [numbers.significant(float(end)) for end in law[[0, -1]]]
    note = f"{fast[0]} to {fast[1]} {joint.unit}".replace("-", "−")
    alt = (
        f"{joint.joint}: friction from {fast[0]} {joint.unit} at"
        f" {numbers.significant(float(law_speed[0]))} {per}/s to {fast[1]} {joint.unit} at"
        f" {numbers.significant(float(law_speed[-1]))} {per}/s"
    )
    height = _HEIGHT - _TOP - _BOTTOM
    with drawing():
        figure = blank(_WIDTH, _HEIGHT)
        wide = _WIDTH - _LEFT - _RIGHT - (_TURN + _GAP if travel.size else 0.0)
        axes = place(figure, _LEFT, _TOP, wide, height)
        axes.axhline(0.0, color=MUTED, linewidth=0.8)
        axes.axvline(0.0, color=MUTED, linewidth=0.8)
        dots(axes, speed, torque, WIDE)
        axes.plot(law_speed, law, color=SECOND, linewidth=1.8)
        limits = _limits(torque, law, turning)
        axes.set_ylim(limits)
        ruled(axes, "both")
        headed(axes, f"friction [{joint.unit}]")
        footed(axes, f"speed [{per}/s]")
        if travel.size:
            turn = place(figure, _LEFT + wide + _GAP, _TOP, _TURN, height)
            _turn(turn, 1e3 * travel, turning, limits, f"m{per}" if per == "rad" else "mm")
            alt += f"; at a reversal over {numbers.significant(float(travel[-1]), 2)} {per}"
        return to_panel(figure, key=f"k{j}", title=joint.joint, note=note, alt=f"{alt}.")


def _turn(
    axes: Axes, travel: Array, turning: Array, limits: tuple[float, float], unit: str
) -> None:
    """Dry friction that turns round, beside the curve over speed and to its scale."""
    axes.axhline(0.0, color=MUTED, linewidth=0.8)
    axes.plot(travel, turning, color=SECOND, linewidth=1.8)
    axes.set_xlim(0.0, float(travel[-1]))
    axes.set_ylim(limits)
    axes.grid(True, axis="both", color=GRID, linewidth=0.8)
    axes.xaxis.set_major_locator(MaxNLocator(2, steps=[1, 2, 5, 10]))
    axes.yaxis.set_major_locator(MaxNLocator(4, steps=[1, 2, 5, 10]))
    axes.tick_params(labelleft=False)
    headed(axes, "at reversal")
    footed(axes, f"travel [{unit}]")


def _known(horizontal: Array, vertical: Array, j: int) -> tuple[Array, Array]:
    """Column j of both, without what is not there."""
    if horizontal.size == 0:
        return np.empty(0), np.empty(0)
    there = np.isfinite(horizontal[:, j]) & np.isfinite(vertical[:, j])
    return horizontal[there, j], vertical[there, j]


def _limits(torque: Array, *curves: Array) -> tuple[float, float]:
    ends = [np.percentile(torque, _SHOWN)] if torque.size else []
    all_values = np.concatenate([*ends, *curves, [0.0]])
    low, high = float(all_values.min()), float(all_values.max())
    room = _ROOM * (high - low) or 1.0
    return low - room, high + room


_LEAST_SPAN = 0.05  # of the last value: a scale that makes nothing look like much is none


def warm_up_panels(results: Results) -> list[Panel]:
    """Friction of each joint motion by motion, and the change that it was judged by."""
    warm = None if results.conduct is None else results.conduct.warm_up
    if warm is None or len(warm.friction) < 2:
        return []
    friction = np.array(warm.friction, dtype=np.float64)
    panels = [
        _warm_up_panel(j, name, friction[:, j])
        for j, name in enumerate(results.joint_names[: friction.shape[1]])
        if np.isfinite(friction[:, j]).any()
    ]
    return [*panels, _change(np.array(warm.change, dtype=np.float64), warm.threshold)]


def _warm_up_panel(j: int, name: str, values: Array) -> Panel:
    known = values[np.isfinite(values)]
    share = known[-1] / known[0] - 1.0 if known[0] else 0.0
    note = f"{numbers.significant(float(known[-1]))} N·m, {100.0 * share:+.1f} %"
    alt = f"{name}: friction over {len(values)} motions of the warm-up; at last {note}."
    with drawing():
        figure, axes = plot_panel(180.0, left=50.0, right=12.0, bottom=42.0)
        axes.plot(np.arange(1, len(values) + 1), values, color=FIRST, marker="o", markersize=3.6)
        low, high = axes.get_ylim()
        least = _LEAST_SPAN * abs(float(known[-1]))
        if high - low < least:
            axes.set_ylim(0.5 * (low + high - least), 0.5 * (low + high + least))
        _framed(axes, "friction [N·m]")
        return to_panel(
            figure, key=f"wu{j}", title=label(name), note=note.replace("-", "−"), alt=alt
        )


def _change(change: Array, threshold: float) -> Panel:
    known = change[np.isfinite(change)]
    last = f"{100.0 * float(known[-1]):.2g} %" if known.size else "unknown"
    note = f"{last}, at most {100.0 * threshold:.2g} % wanted"
    alt = f"Largest change of friction per motion over the warm-up; at last {note}."
    with drawing():
        figure, axes = plot_panel(180.0, left=50.0, right=12.0, bottom=42.0)
        axes.plot(
            np.arange(1, len(change) + 1), 100.0 * change, color=FIRST, marker="o", markersize=3.6
        )
        axes.axhline(100.0 * threshold, color=SECOND, linewidth=1.3, linestyle=(0, (4, 3)))
        top = max(threshold, float(known.max()) if known.size else 0.0)
        axes.set_ylim(0.0, 115.0 * top)
        _framed(axes, "largest change per motion [%]")
        return to_panel(figure, key="wu", title="Change per motion", note=note, alt=alt)


def _framed(axes: Axes, heading: str) -> None:
    ruled(axes, "both")
    axes.xaxis.set_major_locator(MaxNLocator(6, integer=True))
    headed(axes, heading)
    footed(axes, "motion of the warm-up")
