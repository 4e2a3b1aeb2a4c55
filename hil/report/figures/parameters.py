"""Parameters: how far from the truth and how certain, their correlations, and elimination."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator
from numpy.typing import NDArray

from hil.report import numbers
from hil.report.figures.canvas import (
    BAND,
    FIRST,
    GRID,
    INK,
    INSIDE,
    MUTED,
    OUTSIDE_2,
    OUTSIDE_3,
    PAPER,
    ROUTES,
    SECOND,
    TICK_SIZE,
    blank,
    footed,
    headed,
    log_ticks,
    place,
    plot_panel,
    ruled,
)
from hil.report.figures.svg import Panel, drawing, label, to_panel
from hil.report.parameters import Route
from hil.results import ConsistencyResult, EliminationStepResult, EssentialResult, Results

_WIDTH, _LEFT, _RIGHT, _TOP, _BOTTOM = 370.0, 92.0, 14.0, 8.0, 40.0
_ROW = 14.5
_MOST_ROWS = 20
_FURTHEST = 6.5
_MOVED = 3.0
"""Standard deviations from which consistency is at odds with the data."""
_ROUTE_MARKERS = ("o", "D", "^", "s")


def groups(results: Results) -> list[tuple[str, list[int]]]:
    """Parameters in stretches of at most twenty; base parameters and friction never mixed."""
    found = []
    base, more = range(results.n_base), range(results.n_base, len(results.parameters))
    friction = [i for i in more if results.parameters[i].of_this_run] or [*more]
    for name, members in (
        ("Base parameters", [*base]),
        ("Friction", friction),
        ("Elements", [i for i in more if i not in friction]),
    ):
        count = math.ceil(len(members) / _MOST_ROWS)
        parts = [part.tolist() for part in np.array_split(members, count)] if count else []
        for k, part in enumerate(parts):
            title = name if count == 1 else f"{name}, {k + 1} of {count}"
            found.append((title, [int(i) for i in part]))
    return found


def deviation_panels(results: Results) -> list[Panel]:
    """(estimate - truth) / std of every parameter that has a planted truth."""
    values = [p.deviation for p in results.parameters]
    known = [z for z in values if z is not None]
    if not known:
        return []
    reach = min(_FURTHEST, max(4.0, max(abs(z) for z in known) + 0.5))
    return [
        _deviation_panel(results, k, title, members, values, reach)
        for k, (title, members) in enumerate(groups(results))
        if any(values[i] is not None for i in members)
    ]


def _deviation_panel(
    results: Results,
    k: int,
    title: str,
    members: list[int],
    values: Sequence[float | None],
    reach: float,
) -> Panel:
    shown = [(row, z) for row, i in enumerate(members) if (z := values[i]) is not None]
    outside = sum(abs(z) > 2.0 for _, z in shown)
    alt = (
        f"{title}: deviation of {len(shown)} estimates from the truth in standard deviations;"
        f" {outside} outside 2, {sum(abs(z) > 3.0 for _, z in shown)} outside 3."
    )
    with drawing():
        figure, axes = parameter_rows(results, members)
        axes.axvspan(-2.0, 2.0, color=BAND, linewidth=0.0)
        for limit in (-3.0, 3.0):
            axes.axvline(limit, color=MUTED, linewidth=0.8, linestyle=(0, (3, 3)))
        axes.axvline(0.0, color=MUTED, linewidth=0.9)
        for row, z in shown:
            _deviation(axes, row, z, reach)
        axes.set_xlim(-reach, reach)
        axes.xaxis.set_major_locator(FixedLocator([-6, -4, -3, -2, 0, 2, 3, 4, 6]))
        axes.set_xlim(-reach, reach)
        footed(axes, "(estimate − truth) / std")
        note = f"{outside} of {len(shown)} outside 2σ"
        return to_panel(figure, key=f"d{k}", title=title, note=note, alt=alt)


def _deviation(axes: Axes, row: int, z: float, reach: float) -> None:
    size = abs(z)
    marker, color, area = ("o", INSIDE, 26.0)
    if size > 2.0:
        marker, color, area = ("^", OUTSIDE_2, 38.0)
    if size > 3.0:
        marker, color, area = ("s", OUTSIDE_3, 34.0)
    edge = math.copysign(min(size, reach - 0.25), z)
    axes.scatter([edge], [row], s=area, marker=marker, color=color, linewidths=0.0, zorder=3)
    if size > 2.0:
        inward = z > 0
        axes.annotate(
            numbers.fixed(z, 1, sign=True).replace("-", "−"),
            (edge, row),
            xytext=(-7.0 if inward else 7.0, 0.0),
            textcoords="offset points",
            ha="right" if inward else "left",
            va="center",
            fontsize=TICK_SIZE,
            color=INK,
        )


def uncertainty_panels(results: Results, routes: Sequence[Route]) -> list[Panel]:
    """Standard deviation by each route over the reported one, on a logarithmic scale."""
    ratios = [r for route in routes for r in route.ratio if math.isfinite(r) and r > 0.0]
    if len(routes) < 2 or not ratios:
        return []
    low = max(min(*ratios, 0.5) / 1.25, 1e-3)
    high = min(max(*ratios, 2.0) * 1.25, 1e3)
    return [
        _uncertainty_panel(results, k, title, members, routes, (low, high))
        for k, (title, members) in enumerate(groups(results))
    ]


def _uncertainty_panel(
    results: Results,
    k: int,
    title: str,
    members: list[int],
    routes: Sequence[Route],
    limits: tuple[float, float],
) -> Panel:
    alt = (
        f"{title}: standard deviation of {len(members)} parameters by each route over the reported."
    )
    with drawing():
        figure, axes = parameter_rows(results, members)
        axes.set_xscale("log")
        axes.axvline(1.0, color=MUTED, linewidth=0.9)
        for route in routes:
            _route_dots(axes, route, members)
        axes.set_xlim(*limits)
        ticks = [t for t in _LOG_TICKS if limits[0] <= t <= limits[1]]
        log_ticks(axes.xaxis, FixedLocator(ticks if len(ticks) < 9 else ticks[::3]))
        axes.grid(True, axis="x", color=GRID, linewidth=0.8)
        footed(axes, "std / reported std")
        return to_panel(figure, key=f"u{k}", title=title, note="", alt=alt)


_LOG_TICKS = [m * 10.0**e for e in range(-3, 4) for m in (1, 2, 5)]


def _route_dots(axes: Axes, route: Route, members: list[int]) -> None:
    # A ring for the reported route: it is 1 by definition, and the others may lie on it.
    color = ROUTES[route.slot]
    axes.scatter(
        [route.ratio[i] for i in members],
        list(range(len(members))),
        s=34.0 if route.reported else 24.0,
        marker=_ROUTE_MARKERS[route.slot],
        facecolor=PAPER if route.reported else color,
        edgecolor=color,
        linewidths=1.3 if route.reported else 0.0,
        alpha=0.95,
        zorder=3 if route.reported else 4,
    )


def parameter_rows(results: Results, members: list[int]) -> tuple[Figure, Axes]:
    """A figure whose axes have one ruled, labelled row per parameter, the first on top."""
    height = _ROW * len(members)
    figure = blank(_WIDTH, _TOP + height + _BOTTOM)
    axes = place(figure, _LEFT, _TOP, _WIDTH - _LEFT - _RIGHT, height)
    axes.set_ylim(len(members) - 0.5, -0.5)
    axes.set_yticks(range(len(members)))
    axes.set_yticklabels([label(results.parameters[i].label) for i in members])
    axes.tick_params(axis="y", length=0.0)
    axes.grid(True, axis="y", color=GRID, linewidth=0.8)
    axes.spines["left"].set_visible(False)
    return figure, axes


def shift_panels(results: Results, consistency: ConsistencyResult) -> list[Panel]:
    """(consistent - estimate) / std of every parameter."""
    largest = max((abs(z) for z in consistency.shift), default=0.0)
    reach = min(12.0, max(4.0, 1.1 * largest))
    return [
        _shift_panel(results, consistency, k, title, members, reach)
        for k, (title, members) in enumerate(groups(results))
    ]


def _shift_panel(
    results: Results,
    consistency: ConsistencyResult,
    k: int,
    title: str,
    members: list[int],
    reach: float,
) -> Panel:
    values = [consistency.shift[i] for i in members]
    moved = sum(abs(z) > _MOVED for z in values)
    alt = (
        f"{title}: how far consistency moves {len(members)} parameters, in standard deviations;"
        f" {moved} by more than {_MOVED:g}."
    )
    with drawing():
        figure, axes = parameter_rows(results, members)
        axes.axvspan(-_MOVED, _MOVED, color=BAND, linewidth=0.0)
        axes.axvline(0.0, color=MUTED, linewidth=0.9)
        for row, z in enumerate(values):
            far = abs(z) > _MOVED
            color = OUTSIDE_3 if far else FIRST
            end = math.copysign(min(abs(z), reach - 0.2), z)
            axes.plot([0.0, end], [row, row], color=color, linewidth=2.2 if far else 1.6)
            axes.scatter(
                [end], [row], s=30.0, marker="s" if far else "o", color=color, linewidths=0.0
            )
            if far:
                _shift_number(axes, end, row, z)
        axes.set_xlim(-reach, reach)
        footed(axes, "(consistent − estimate) / std")
        return to_panel(figure, key=f"co{k}", title=title, note="", alt=alt)


def _shift_number(axes: Axes, end: float, row: int, z: float) -> None:
    """The number beside a bar, towards the middle, where there is room."""
    axes.annotate(
        numbers.fixed(z, 1, sign=True).replace("-", "−"),
        (0.0, row),
        xytext=(-5.0 if end > 0.0 else 5.0, 0.0),
        textcoords="offset points",
        ha="right" if end > 0.0 else "left",
        va="center",
        fontsize=TICK_SIZE,
        color=INK,
    )


_LABELS, _SCALE = 84.0, 78.0
_SIDE = 560.0
_SMALLEST_CELL, _LARGEST_CELL = 11.0, 26.0


def correlation_matrix(results: Results) -> Panel | None:
    """|Ψ_ij| / sqrt(Ψ_ii Ψ_jj): 0 white, 1 black; friction left out, as in the paper."""
    n = results.n_base
    if n == 0:
        return None
    matrix = np.array(results.correlation, dtype=np.float64)[:n, :n]
    return matrix_panel(matrix, [p.label for p in results.parameters[:n]], key="c")


def matrix_panel(
    matrix: NDArray[np.float64], labels: Sequence[str], *, key: str, title: str = ""
) -> Panel:
    """|ρ| of a normalised matrix (n, n), one label for each row; `key` is the panel's own."""
    n, matrix = len(labels), np.abs(matrix)
    names = [label(text) for text in labels]
    above = int(np.sum(np.triu(matrix, 1) > 0.9))
    alt = (
        f"Absolute correlation between {n} base parameters, white for 0 and black for 1;"
        f" {above} of {n * (n - 1) // 2} pairs exceed 0.9."
    )
    side = n * min(max(_SIDE / n, _SMALLEST_CELL), _LARGEST_CELL)
    with drawing():
        figure = blank(_LABELS + side + _SCALE, _LABELS + side + 6.0)
        axes = place(figure, _LABELS, _LABELS, side, side)
        axes.imshow(matrix, cmap="gray_r", vmin=0.0, vmax=1.0, interpolation="none", aspect="auto")
        _label_cells(axes, names, side / n)
        scale = place(figure, _LABELS + side + 22.0, _LABELS, 14.0, min(side, 200.0))
        shade_scale(scale)
        scale.set_title("|ρ|", fontsize=TICK_SIZE, color=MUTED, pad=6.0)
        note = f"{above} of {n * (n - 1) // 2} pairs above 0.9" if title else ""
        return to_panel(figure, key=key, title=title, note=note, alt=alt)


def _label_cells(axes: Axes, names: list[str], cell: float) -> None:
    size = min(TICK_SIZE, 0.76 * cell)
    axes.xaxis.tick_top()
    axes.set_xticks(range(len(names)))
    axes.set_xticklabels(
        names, rotation=90, rotation_mode="anchor", ha="left", va="center", fontsize=size
    )
    axes.set_yticks(range(len(names)))
    axes.set_yticklabels(names, fontsize=size)
    axes.tick_params(length=0.0, pad=4.0)
    for spine in axes.spines.values():
        spine.set_visible(True)
        spine.set_color(MUTED)


def shade_scale(axes: Axes, ink: str = INK, muted: str = MUTED) -> None:
    """The shade scale, as an image of its own (a colour bar would be 256 rectangles)."""
    shades = np.linspace(1.0, 0.0, 64)[:, None]
    axes.imshow(
        shades, cmap="gray_r", vmin=0.0, vmax=1.0, aspect="auto", extent=(0.0, 1.0, 0.0, 1.0)
    )
    axes.set_xticks([])
    axes.yaxis.tick_right()
    axes.set_yticks([0.0, 0.5, 1.0])
    axes.set_yticklabels(["0", "0.5", "1"], color=ink)
    for spine in axes.spines.values():
        spine.set_visible(True)
        spine.set_color(muted)


_ELIMINATION_HEIGHT = 250.0
# The last few parameters leave errors of 100 %, beside which nothing else could be distinguished.
_HIGHEST_ERROR = 4.0  # times the lowest


def elimination_panels(essential: EssentialResult) -> list[Panel]:
    """Torque error, and largest relative standard deviation, over the number of parameters."""
    steps = essential.steps
    if len(steps) < 2:
        return []
    return [_errors(essential, steps), _deviations(essential, steps)]


def _errors(essential: EssentialResult, steps: list[EliminationStepResult]) -> Panel:
    left = np.array([step.left for step in steps])
    held_out = 100.0 * np.array([step.held_out for step in steps])
    in_sample = 100.0 * np.array([step.in_sample for step in steps])
    chosen = steps[essential.cut]
    top = _HIGHEST_ERROR * max(float(np.nanmin(held_out)), 1e-9)
    top = max(top, 1.15 * float(held_out[0]), 1.15 * 100.0 * essential.by_spread_held_out)
    alt = (
        f"Torque error over the number of parameters: on held-out motion {held_out[0]:.2f} % with"
        f" all {left[0]}, {100.0 * chosen.held_out:.2f} % with the {chosen.left} at the cut,"
        f" {100.0 * essential.by_spread_held_out:.2f} % with the {essential.by_spread_left} that"
        " relative standard deviations alone leave."
    )
    with drawing():
        figure, axes = _elimination_axes(left)
        axes.plot(left, in_sample, color=SECOND, linewidth=1.4, linestyle=(0, (5, 3)))
        axes.plot(left, held_out, color=FIRST, linewidth=1.8)
        axes.set_ylim(0.0, top)
        ruled(axes, "y", x_ticks=6, y_ticks=5)
        _cut(axes, chosen.left, 100.0 * chosen.held_out, top)
        axes.scatter(
            [essential.by_spread_left],
            [100.0 * essential.by_spread_held_out],
            s=40.0,
            marker="D",
            facecolor=PAPER,
            edgecolor=FIRST,
            linewidths=1.5,
            zorder=5,
        )
        headed(axes, "torque error [%]")
        note = f"cut at {chosen.left} of {left[0]}"
        return to_panel(figure, key="el0", title="Torque error", note=note, alt=alt)


def _deviations(essential: EssentialResult, steps: list[EliminationStepResult]) -> Panel:
    left = np.array([step.left for step in steps])
    largest = 100.0 * np.array([step.largest_relative_std for step in steps])
    usable = np.isfinite(largest) & (largest > 0.0)
    chosen = steps[essential.cut]
    worst = 100.0 * chosen.largest_relative_std
    alt = (
        "Largest relative standard deviation over the number of parameters,"
        f" {worst:.3g} % with the {chosen.left} at the cut."
    )
    with drawing():
        figure, axes = _elimination_axes(left)
        axes.set_yscale("log")
        axes.plot(left[usable], largest[usable], color=FIRST, linewidth=1.8)
        low = float(largest[usable].min(initial=1.0)) / 2.0
        high = 2.0 * min(float(largest[usable].max(initial=1.0)), 1e5)
        axes.set_ylim(low, high)
        decades = range(math.ceil(math.log10(low)), math.floor(math.log10(high)) + 1)
        log_ticks(axes.yaxis, FixedLocator([10.0**k for k in decades]))
        axes.grid(True, axis="y", color=GRID, linewidth=0.8)
        _cut(axes, chosen.left, worst if math.isfinite(worst) else high, high)
        headed(axes, "largest std / |estimate| [%]")
        note = f"{worst:.3g} % at the cut" if math.isfinite(worst) else ""
        return to_panel(figure, key="el1", title="Worst known parameter", note=note, alt=alt)


def _elimination_axes(left: NDArray[np.intp]) -> tuple[Figure, Axes]:
    """Axes on which parameters go from all of them on the left to one on the right."""
    figure, axes = plot_panel(_ELIMINATION_HEIGHT, right=12.0, bottom=42.0)
    axes.set_xlim(float(left[0]) + 0.5, 0.0)
    footed(axes, "parameters left")
    return figure, axes


def _cut(axes: Axes, left: int, value: float, top: float) -> None:
    """A line at the cut, and the point on the curve there."""
    axes.axvline(left, color=MUTED, linewidth=1.0, linestyle=(0, (3, 3)))
    axes.scatter([left], [min(value, top)], s=44.0, color=FIRST, linewidths=0.0, zorder=5)
    axes.annotate(
        "cut",
        (left, 1.0),
        xycoords=("data", "axes fraction"),
        xytext=(4.0, -9.0),
        textcoords="offset points",
        fontsize=TICK_SIZE,
        color=INK,
    )
