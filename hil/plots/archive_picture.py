"""An archive, joint by joint: as a picture with all quantities, and as a page to zoom into."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from hil.plots import style
from hil.plots.archive_view import ArchiveView, runs
from hil.plots.archive_view import Trace as Recorded
from hil.report.drawing import (
    FIRST,
    INK,
    MUTED,
    OUTSIDE_3,
    ROUTES,
    SECOND,
    Caption,
    Panel,
    Plot,
    Trace,
    blank,
    drawing,
    footed,
    headed,
    label,
    place,
    ruled,
    to_panel,
    traces_text,
)
from hil.report.rendering import environment, page_bytes

Array = NDArray[np.float64]

PAGE_BINS: Final = 4000
"""Stretches of the time shown whose lowest and highest sample go into the page: every sample of
16 s at 500 Hz."""
_BINS_SHOWN: Final = 300
_SECONDS: Final = "time since the first sample [s]"
_COLOURS: Final = {
    "position": (FIRST, style.POSITION),
    "speed": (SECOND, style.VELOCITY),
    "motor current": (ROUTES[3], style.ACCELERATION),
    "torque at the joint": (INK, "#5b3a8c"),
    "following error": (ROUTES[0], style.INK),
}
"""Of the lines on the page, and in the picture."""
# px, of the page
_WIDTH, _LEFT, _RIGHT, _TOP, _PLOT, _STEP, _BOTTOM = 440.0, 56.0, 10.0, 20.0, 66.0, 90.0, 22.0
# inch, of the picture
_COLUMN, _ROW, _HEAD, _SIDE, _FOOT, _LINE = 3.1, 1.15, 1.1, 0.95, 0.5, 0.155
_NAME: Final = 12
"""Letters of a joint's name that a row has room for."""
_MOST_EVENTS: Final = 14
_MOST_GAPS: Final = 200


def _draw(
    axes: Axes,
    view: ArchiveView,
    recorded: Recorded,
    lines: Iterable[tuple[Array, Array]],
    colours: tuple[str, str, str],
) -> None:
    """A quantity with limits that are within its reach, events, and packets that were missed.

    `colours` are of the lines, of limits and warnings, and of all else.
    """
    colour, limit, mark = colours
    for time, value in lines:
        axes.plot(time, value, color=colour, linewidth=1.0)
    low, high = axes.get_ylim()
    least = 1e-3 * max(abs(low), abs(high), 1e-6)
    if high - low < least:  # noise at rest does not fill the page
        low, high = 0.5 * (low + high - least), 0.5 * (low + high + least)
    for bound in (recorded.low, recorded.high):
        if bound is not None and low <= bound <= high:
            axes.axhline(bound, color=limit, linewidth=0.9, linestyle=(0, (5, 2)))
    for at, _, _, warns in view.events:
        axes.axvline(at, color=limit if warns else mark, linewidth=0.8, linestyle=(0, (1, 2)))
    for gap in view.gaps[:_MOST_GAPS]:
        axes.axvline(gap, color=mark, linewidth=0.6, alpha=0.7)
    axes.set_ylim(low, high)
    axes.set_xlim(view.start, max(view.stop, view.start + 1e-9))
    axes.ticklabel_format(axis="y", useOffset=False)


def _share(recorded: Recorded) -> str:
    share = recorded.peak_share
    return "" if share is None else "< 1" if share < 0.01 else f"{100.0 * share:.0f}"


# The picture


def draw_archive(view: ArchiveView) -> Figure:
    """Draw it: one row per joint, one column per quantity; states and events below."""
    lines, (title, facts) = _lines_below(view), _heading(view)
    rows, columns = len(view.joint_names), max(1, len(view.quantities))
    width, below = _SIDE + columns * _COLUMN + 0.15, _FOOT + _LINE * (len(lines) + 1)
    height = _HEAD + rows * _ROW + below
    facts = textwrap.shorten(facts, int(15 * width), placeholder=" …")
    written = [
        (title, height - 0.3, style.TITLE, style.INK),
        (facts, height - 0.52, style.SMALL + 0.5, style.MUTED),
    ]
    for k, line in enumerate(lines, 1):
        written.append((line, below - _FOOT - 0.05 - _LINE * k, style.SMALL, style.INK))
    with style.page():
        figure = Figure(figsize=(width, height))
        grid = figure.add_gridspec(
            rows, columns, left=_SIDE / width, right=1.0 - 0.15 / width, top=1.0 - _HEAD / height,
            bottom=below / height, hspace=0.26, wspace=0.24,
        )  # fmt: skip
        for k, quantity in enumerate(view.quantities):
            colours = _COLOURS[quantity.title.partition(" [")[0]][1], style.LIMIT, style.MUTED
            for j, trace in enumerate(quantity.traces):
                axes = figure.add_subplot(grid[j, k])
                _draw(axes, view, trace, [(trace.time, trace.value)], colours)
                if share := _share(trace):
                    axes.set_title(
                        f"{share} % of limit", loc="right", pad=2.0,
                        fontsize=style.SMALL - 0.5, color=style.MUTED,
                    )  # fmt: skip
                axes.yaxis.set_major_locator(MaxNLocator(4, steps=[1, 2, 5, 10]))
                axes.xaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]))
                axes.tick_params(labelbottom=j == rows - 1)
                style.bare(axes)
                if k == 0:
                    axes.set_ylabel(_broken(label(view.joint_names[j])), color=style.INK)
                if j == 0:
                    axes.annotate(
                        quantity.title, (0.0, 1.0), xycoords="axes fraction", xytext=(0.0, 14.0),
                        textcoords="offset points", color=style.MUTED, fontsize=style.TEXT,
                    )  # fmt: skip
                if j == rows - 1:
                    axes.set_xlabel(_SECONDS)
        for text, at, size, colour in written:
            figure.text(_SIDE / width, at / height, text, fontsize=size, color=colour)
    return figure


def _heading(view: ArchiveView) -> tuple[str, str]:
    facts, shown = view.facts, view.stop - view.start
    parts = [
        "SIMULATED" if facts.metadata.get("simulated") == "yes" else "",
        facts.metadata.get("cell", ""),
        f"{shown:.2f} s of {facts.duration:.2f} s",
        f"{facts.samples} samples",
        view.frame,
        view.missed and f"packets: {view.missed}",
        facts.lost,
        facts.damage or "",
        "red dashes: limits",
    ]
    title = f"{facts.path.name} · {facts.title} · {facts.outcome}"
    return title, " · ".join(part for part in parts if part)


def _broken(name: str) -> str:
    """A long name in two or three lines, broken behind its underscores."""
    if len(name) <= _NAME:
        return name
    return "\n".join(textwrap.wrap(name.replace("_", "_ "), _NAME)).replace("_ ", "_")


def _lines_below(view: ArchiveView) -> list[str]:
    states = ", ".join(f"{name} from {begin:.3f} s" for begin, _, name in view.states)
    lines = [textwrap.shorten(f"states: {states}", 250, placeholder=" …")] if states else []
    lines += [
        f"{time:.3f} s  {name}: {textwrap.shorten(text, 150, placeholder=' …')}"
        for time, name, text, _ in view.events[:_MOST_EVENTS]
    ]
    more = len(view.events) - _MOST_EVENTS
    return [*lines, f"and {more} more events"] if more > 0 else lines


# The page


def even(recorded: Recorded, grid: Array) -> Array:
    """A line (k,) on an even grid of time (m,), m even; NaN where it is broken.

    Of every two instants one has the lowest and one the highest sample between them, in the order
    in which they came: no peak is lost, and none is moved by more than two steps.
    """
    found = np.full(grid.shape, np.nan)
    step = (grid[-1] - grid[0]) / (len(grid) - 1)
    for times, values in _stretches(recorded):
        inside = (grid >= times[0] - 0.5 * step) & (grid <= times[-1] + 0.5 * step)
        found[inside] = np.interp(grid[inside], times, values)
        pair = np.clip(((times - grid[0]) / step + 0.5).astype(np.intp) // 2, 0, len(grid) // 2 - 1)
        starts = np.flatnonzero(np.diff(pair, prepend=-1))
        counts = np.diff(np.append(starts, len(pair)))
        for start, count in zip(starts[counts > 1], counts[counts > 1], strict=True):
            here = values[start : start + count]
            low, high = int(here.argmin()), int(here.argmax())
            first, last = sorted((low, high))
            place_of = 2 * pair[start]
            found[place_of : place_of + 2] = here[first], here[last]
    return found


def _stretches(recorded: Recorded) -> list[tuple[Array, Array]]:
    """The unbroken parts of a line, those of no length left out."""
    broken = np.flatnonzero(np.isnan(recorded.time))
    parts = zip(np.split(recorded.time, broken), np.split(recorded.value, broken), strict=True)
    finite = [(t[np.isfinite(t)], v[np.isfinite(t)]) for t, v in parts]
    return [(t, v) for t, v in finite if t.size]


def _panel(view: ArchiveView, j: int) -> Panel:
    length = max(view.stop - view.start, 1e-9)
    most = max((q.traces[j].time.size for q in view.quantities), default=0)
    grid = np.linspace(view.start, view.start + length, 2 * max(1, min(PAGE_BINS, most // 2)))
    plots, shares = [], []
    with drawing():
        figure = blank(_WIDTH, _TOP + max(1, len(view.quantities)) * _STEP + _BOTTOM)
        for k, quantity in enumerate(view.quantities):
            recorded, name = quantity.traces[j], quantity.title.partition(" [")[0]
            line = Trace(even(recorded, grid), _COLOURS[name][0], 1.0, quantity.title)
            box = (_LEFT, _TOP + k * _STEP, _WIDTH - _LEFT - _RIGHT, _PLOT)
            limits = [bound for bound in (recorded.low, recorded.high) if bound is not None]
            plots.append(Plot(box, quantity.title, [line], limits))
            shares += [f"{name} {share}"] if (share := _share(recorded)) else []
            axes, last = place(figure, *box), k == len(view.quantities) - 1
            shown = runs(grid, line.values, _BINS_SHOWN)
            _draw(axes, view, recorded, shown, (line.colour, OUTSIDE_3, MUTED))
            ruled(axes, "both", x_ticks=6, y_ticks=3)
            headed(axes, quantity.title)
            axes.tick_params(labelbottom=last)
            if last:
                footed(axes, _SECONDS)
        note = f"peaks in % of limits: {', '.join(shares)}" if shares else ""
        what = ", ".join(plot.heading for plot in plots)
        caption = Caption(f"a{j}", label(view.joint_names[j]), note, what)
        marks = [time for time, _, _, _ in view.events]
        return to_panel(figure, caption, traces_text(grid, plots, points=grid.size, marks=marks))


def archive_page(view: ArchiveView) -> bytes:
    """The page; the same archive gives the same bytes.

    Args:
        view: read with `PAGE_BINS`, so that there is something to zoom into.
    """
    facts = view.facts
    rows = [
        ("shown", f"{view.start:.3f} s to {view.stop:.3f} s of {facts.duration:.3f} s"),
        ("frame", view.frame),
        ("joints", ", ".join(facts.joint_names)),
        ("cycle", "not fixed" if facts.period is None else f"{1e3 * facts.period:g} ms"),
        ("samples", str(facts.samples)),
        ("packets", view.missed),
        ("lost", facts.lost or "nothing"),
        ("damage", facts.damage or "none"),
        ("attachments", ", ".join(facts.attachments)),
        *facts.metadata.items(),
    ]
    template = environment().get_template("archive.html.j2")
    text = template.render(
        facts=facts,
        joints=[_panel(view, j) for j in range(len(view.joint_names))],
        events=view.events,
        states=view.states,
        simulated=facts.metadata.get("simulated") == "yes",
        rows=rows,
    )
    return page_bytes(text)
