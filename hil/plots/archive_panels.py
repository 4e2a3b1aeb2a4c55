"""An archive joint by joint, for a page: its quantities one above the other, to be zoomed into."""

from __future__ import annotations

from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from hil.plots.archive_view import ArchiveView, runs
from hil.plots.archive_view import Trace as Recorded
from hil.report.drawing import (
    FIRST,
    INK,
    MUTED,
    OUTSIDE_3,
    ROUTES,
    SECOND,
    Panel,
    Plot,
    Trace,
    blank,
    drawing,
    even_traces_text,
    footed,
    headed,
    label,
    place,
    ruled,
    to_panel,
)
from hil.report.rendering import environment, page_bytes
from hil.terminal_text import plural

Array = NDArray[np.float64]

BINS: Final = 4000
"""Stretches of the time shown whose lowest and highest sample go into the page: every sample of
16 s at 500 Hz."""
_BINS_SHOWN: Final = 300
_WIDTH, _LEFT, _RIGHT, _TOP, _PLOT, _STEP, _BOTTOM = 440.0, 56.0, 10.0, 20.0, 66.0, 90.0, 22.0
_COLOURS: Final = {
    "position": FIRST,
    "speed": SECOND,
    "motor current": ROUTES[3],
    "torque at the joint": INK,
    "following error": ROUTES[0],
}
_SHORT: Final = {name: name.split()[0] for name in _COLOURS} | {"motor current": "current"}


def archive_panels(view: ArchiveView) -> list[Panel]:
    """One panel for each joint; `view` was read with `BINS`."""
    return [_panel(view, j) for j in range(len(view.joint_names))]


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
    grid = np.linspace(view.start, view.start + length, 2 * max(1, min(BINS, most // 2)))
    plots = [
        Plot(
            (_LEFT, _TOP + k * _STEP, _WIDTH - _LEFT - _RIGHT, _PLOT),
            quantity.title,
            [Trace(even(quantity.traces[j], grid), _colour(quantity.title), 1.0, quantity.title)],
            [b for b in (quantity.traces[j].low, quantity.traces[j].high) if b is not None],
        )
        for k, quantity in enumerate(view.quantities)
    ]
    marks = [time for time, _, _, _ in view.events]
    name = label(view.joint_names[j])
    shares = [
        f"{_SHORT[_name(quantity.title)]} {f'{100.0 * share:.0f}' if share >= 0.01 else '< 1'}"
        for quantity in view.quantities
        if (share := quantity.traces[j].peak_share) is not None
    ]
    note = f"peaks in % of limits: {', '.join(shares)}" if shares else ""
    with drawing():
        return to_panel(
            _figure(grid, plots, marks),
            key=f"a{j}",
            title=name,
            note=note,
            alt=f"{name}: {', '.join(plot.heading for plot in plots)} over {length:.3g} s.",
            traces=even_traces_text(view.start, length, plots, marks),
        )


def _colour(title: str) -> str:
    return _COLOURS[_name(title)]


def _name(title: str) -> str:
    return title.partition(" [")[0]


def _figure(grid: Array, plots: list[Plot], marks: list[float]) -> Figure:
    figure = blank(_WIDTH, _TOP + max(1, len(plots)) * _STEP + _BOTTOM)
    for k, plot in enumerate(plots):
        axes = place(figure, *plot.box)
        last = k == len(plots) - 1
        _draw(axes, grid, plot)
        for mark in marks:
            axes.axvline(mark, color=MUTED, linewidth=0.8, linestyle=(0, (1, 2)))
        axes.set_xlim(grid[0], grid[-1])
        axes.tick_params(labelbottom=last)
        if last:
            footed(axes, "time since the first sample [s]")
    return figure


def _draw(axes: Axes, grid: Array, plot: Plot) -> None:
    (trace,) = plot.traces
    for times, values in runs(grid, trace.values, _BINS_SHOWN):
        axes.plot(times, values, color=trace.colour, linewidth=trace.width)
    low, high = axes.get_ylim()
    for limit in plot.limits:
        if low <= limit <= high:
            axes.axhline(limit, color=OUTSIDE_3, linewidth=0.9, linestyle=(0, (5, 2)))
    axes.set_ylim(low, high)
    ruled(axes, "both", x_ticks=6, y_ticks=3)
    axes.ticklabel_format(axis="y", useOffset=False)
    headed(axes, plot.heading)


def archive_page(view: ArchiveView) -> bytes:
    """The page; the same archive gives the same bytes.

    Args:
        view: read with `BINS`, so that there is something to zoom into.
    """
    facts = view.facts
    # Also where none were missed, for a person looks for it; not where they were not counted.
    missed = f"at {plural(len(view.gaps), 'place')}" if len(view.gaps) else "none"
    shown = f"{view.start:.3f} s to {view.stop:.3f} s of {facts.duration:.3f} s"
    rows = [
        ("shown", shown),
        ("frame", view.frame),
        ("joints", ", ".join(facts.joint_names)),
        ("cycle", "not fixed" if facts.period is None else f"{1e3 * facts.period:g} ms"),
        ("samples", str(facts.samples)),
        *([("packets missed", missed)] if view.states else []),
        ("lost", facts.lost or "nothing"),
        ("damage", facts.damage or "none"),
        ("attachments", ", ".join(facts.attachments)),
        *facts.metadata.items(),
    ]
    text = (
        environment()
        .get_template("archive.html.j2")
        .render(
            facts=facts,
            joints=archive_panels(view),
            events=view.events,
            states=view.states,
            simulated=facts.metadata.get("simulated") == "yes",
            rows=rows,
        )
    )
    return page_bytes(text)
