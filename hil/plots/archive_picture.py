"""An archive on one page: every joint, quantity by quantity, and what happened meanwhile."""

from __future__ import annotations

import textwrap
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from hil.plots import style
from hil.plots.archive_view import ArchiveView, Trace
from hil.report.drawing import label

_COLUMN, _ROW = 3.1, 1.15
_LEFT, _RIGHT, _TOP, _STRIP, _BOTTOM, _LINE = 0.95, 0.15, 0.75, 0.32, 0.5, 0.155
_NAME: Final = 12
"""Letters of a joint's name that a row has room for."""
_MOST_EVENTS: Final = 14
"""Events described below the picture; more are only counted."""
_SHADES: Final = {
    "open": "#cfe3d6",
    "closed": "#eeeeee",
    "opening": "#e8dcb5",
    "exiting": "#e8dcb5",
    "driving on": "#e8dcb5",
    "faulted": "#f0b8b4",
    "freezing": "#f0b8b4",
}


def draw_archive(view: ArchiveView) -> Figure:
    """Draw it: one row per joint, one column per quantity; states above, events below."""
    events_text = _event_lines(view)
    rows, columns = len(view.joint_names), max(1, len(view.quantities))
    width = _LEFT + columns * _COLUMN + _RIGHT
    strip = _STRIP + 0.18 if view.states else 0.0
    below = _BOTTOM + _LINE * (len(events_text) + 1)
    height = _TOP + 0.12 + strip + rows * _ROW + below
    with style.page():
        figure = Figure(figsize=(width, height))
        grid = figure.add_gridspec(
            rows,
            columns,
            left=_LEFT / width,
            right=1.0 - _RIGHT / width,
            top=1.0 - (_TOP + strip + 0.22) / height,
            bottom=below / height,
            hspace=0.26,
            wspace=0.24,
        )
        for k, quantity in enumerate(view.quantities):
            for j, trace in enumerate(quantity.traces):
                axes = figure.add_subplot(grid[j, k])
                _draw(axes, trace, quantity.colour, view, limits=quantity.limits_shown)
                axes.tick_params(labelbottom=j == rows - 1)
                if k == 0:
                    axes.set_ylabel(_lines(label(view.joint_names[j])), color=style.INK)
                if j == 0:
                    axes.set_title(quantity.title, loc="left", color=style.MUTED, pad=14.0)
                if j == rows - 1:
                    axes.set_xlabel("time since the first sample [s]")
        if view.states:
            across = (_LEFT / width, 1.0 - (_TOP + _STRIP) / height)
            size = ((width - _LEFT - _RIGHT) / width, _STRIP / height)
            _draw_states(figure.add_axes((*across, *size)), view)
        _headline(figure, view, height)
        for k, line in enumerate(events_text):
            y = (below - _BOTTOM - 0.05 - _LINE * (k + 1)) / height
            figure.text(_LEFT / width, y, line, fontsize=style.SMALL, color=style.INK, va="bottom")
    return figure


def _draw(axes: Axes, trace: Trace, colour: str, view: ArchiveView, *, limits: bool) -> None:
    axes.plot(trace.time, trace.value, color=colour, linewidth=0.9)
    axes.set_xlim(view.start, max(view.stop, view.start + 1e-9))
    bounds = [bound for bound in (trace.low, trace.high) if bound is not None]
    if limits and bounds:
        room = 0.08 * (bounds[-1] - bounds[0])
        reach = [*bounds, *(_ends(trace) or ())]
        axes.set_ylim(min(reach) - room, max(reach) + room)
    else:
        _own_range(axes, trace)
    low, high = axes.get_ylim()
    for bound in bounds:
        if low <= bound <= high:
            axes.axhline(bound, color=style.LIMIT, linewidth=0.9, linestyle=(0, (5, 2)))
    for time, _, _, warns in view.events:
        if warns:
            axes.axvline(time, color=style.LIMIT, linewidth=0.8, linestyle=(0, (1, 1.5)))
    for gap in view.gaps[:200]:
        axes.axvline(gap, color="#d98200", linewidth=0.6, alpha=0.7)
    if trace.peak_share is not None:
        share = "< 1 %" if trace.peak_share < 0.01 else f"{100.0 * trace.peak_share:.0f} %"
        axes.text(
            1.0, 1.02, f"{share} of limit", transform=axes.transAxes,
            ha="right", va="bottom", fontsize=style.SMALL - 0.5, color=style.MUTED,
        )  # fmt: skip
    axes.ticklabel_format(axis="y", useOffset=False)
    axes.yaxis.set_major_locator(MaxNLocator(4, steps=[1, 2, 5, 10]))
    axes.xaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]))
    style.bare(axes)


def _lines(name: str) -> str:
    """A long name in two or three lines, broken behind its underscores."""
    if len(name) <= _NAME:
        return name
    return "\n".join(textwrap.wrap(name.replace("_", "_ "), _NAME)).replace("_ ", "_")


def _ends(trace: Trace) -> tuple[float, float] | None:
    finite = trace.value[np.isfinite(trace.value)]
    return (float(finite.min()), float(finite.max())) if finite.size else None


def _own_range(axes: Axes, trace: Trace) -> None:
    """As high as the line, but never so that noise at rest fills the page."""
    ends = _ends(trace)
    if ends is None:
        return
    least = 1e-3 * max(abs(ends[0]), abs(ends[1]), 1e-6)
    size = max(ends[1] - ends[0], least)
    middle = (ends[0] + ends[1]) / 2.0
    axes.set_ylim(middle - 0.58 * size, middle + 0.58 * size)


def _draw_states(axes: Axes, view: ArchiveView) -> None:
    for begin, end, name in view.states:
        axes.axvspan(begin, end, color=_SHADES.get(name, "#dddddd"), linewidth=0.0)
        if end - begin > 0.06 * (view.stop - view.start):
            axes.text(
                (begin + end) / 2.0, 0.5, name, ha="center", va="center",
                fontsize=style.SMALL, color=style.INK,
            )  # fmt: skip
    for number, (time, _, _, warns) in enumerate(view.events[:_MOST_EVENTS], 1):
        axes.axvline(time, color=style.LIMIT if warns else style.INK, linewidth=0.8)
        if _apart(view, number - 1):
            axes.annotate(
                str(number), (time, 1.0), xycoords=("data", "axes fraction"), xytext=(0.0, 2.0),
                textcoords="offset points", ha="center", fontsize=style.SMALL,
                color=style.LIMIT if warns else style.INK,
            )  # fmt: skip
    axes.set_xlim(view.start, max(view.stop, view.start + 1e-9))
    axes.set_yticks([])
    axes.set_xticks([])
    for spine in axes.spines.values():
        spine.set_visible(False)


def _apart(view: ArchiveView, k: int) -> bool:
    """Whether the number of event `k` has room beside that of the one before."""
    if k == 0:
        return True
    return view.events[k][0] - view.events[k - 1][0] > 0.015 * (view.stop - view.start)


def _headline(figure: Figure, view: ArchiveView, height: float) -> None:
    width = figure.get_size_inches()[0]
    facts = view.facts
    title = f"{facts.path.name} · {facts.title} · {facts.outcome}"
    figure.text(_LEFT / width, 1.0 - 0.3 / height, title, fontsize=style.TITLE, color=style.INK)
    cell = facts.metadata.get("cell", "")
    simulated = "SIMULATED" if facts.metadata.get("simulated") == "yes" else ""
    shown = view.stop - view.start
    part = "" if shown > 0.999 * facts.duration else f"of {facts.duration:.2f} s "
    parts = [
        simulated,
        cell,
        f"{shown:.2f} s {part}",
        f"{facts.samples} samples",
        view.frame,
        _missed(view),
        facts.lost,
        facts.damage or "",
        "red dashes: limits" if _has_limits(view) else "",
    ]
    line = " · ".join(part.strip() for part in parts if part.strip())
    figure.text(
        _LEFT / width,
        1.0 - 0.52 / height,
        textwrap.shorten(line, int(15 * width), placeholder=" …"),
        fontsize=style.SMALL + 0.5,
        color=style.MUTED,
    )


def _missed(view: ArchiveView) -> str:
    """Also where none were missed, for a person looks for it; "" where they were not counted."""
    if not view.states:
        return ""
    if not len(view.gaps):
        return "no packet missed"
    return f"packets missed at {len(view.gaps)} place{'s' * (len(view.gaps) > 1)}"


def _has_limits(view: ArchiveView) -> bool:
    return any(trace.high is not None for q in view.quantities for trace in q.traces)


def _event_lines(view: ArchiveView) -> list[str]:
    lines = [
        f"{number}  {time:.3f} s  {name}: {textwrap.shorten(text, 150, placeholder=' …')}"
        for number, (time, name, text, _) in enumerate(view.events[:_MOST_EVENTS], 1)
    ]
    if len(view.events) > _MOST_EVENTS:
        lines.append(f"and {len(view.events) - _MOST_EVENTS} more events")
    return lines
