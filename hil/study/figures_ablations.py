"""The ablations as small multiples."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Final

from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, NullLocator

from hil.report.figures.canvas import blank, footed, headed, place, ruled
from hil.report.figures.palette import BAND, FIRST, INK, ROUTES, SECOND
from hil.report.figures.svg import Panel, drawing, to_panel

from .figures import marker_of
from .results import AblationBand, AblationResult

CLASS_COLOURS: Final = {"fly-by": SECOND, "stop-to-stop": ROUTES[3], "sinusoid": FIRST}
CLASS_MARKERS: Final = {"fly-by": "D", "stop-to-stop": "^", "sinusoid": "o"}

LOG_DET: Final = "log det"
_BESIDE: Final = 4  # names that have room in one line
_DECADES: Final = 20.0  # between smallest and largest: beyond that a scale from zero hides most


def ablation_panels(ablation: AblationResult, labels: Mapping[str, str]) -> list[Panel]:
    """Criteria, distance to the planted values, and prediction errors over one setting.

    `labels` are those of the methods, in the order of the tables.
    """
    methods = list(dict.fromkeys(point.method for point in ablation.points))
    panels = []
    if len(ablation.points) > 1 and ablation.key not in ("repetitions", "noise", "effects"):
        panels.append(
            _lines(
                ablation, list(labels), "coupling index I_c", _by_method(ablation, "coupling_index")
            )
        )
        panels.append(_lines(ablation, list(labels), LOG_DET, _by_method(ablation, "log10_det")))
    known = _by_method(ablation, "parameter_error")
    if any(y is not None for _, points in known for _, y in points):
        chance = [
            (method, [band for band in ablation.bands if _is(band, method, "parameter_error")])
            for method in methods
        ]
        panels.append(
            _lines(ablation, list(labels), "distance to planted values, B = 1", known, dict(chance))
        )
    for method in methods:
        points = [point for point in ablation.points if point.method == method]
        # The noise that every estimate leaves would cover what differs, where it can be told apart.
        own = all(point.own for point in points)
        series = [
            (name, [(p.value, 100.0 * (p.own if own else p.error)[name]) for p in points])
            for name in CLASS_COLOURS
            if all(name in (point.own if own else point.error) for point in points)
        ]
        quantity = "own" if own else "error"
        bands = {
            name: [band for band in ablation.bands if _is(band, method, quantity, name)]
            for name, _ in series
        }
        title = f"{'own' if own else 'torque'} error [%]"
        title = title if len(methods) == 1 else f"{labels[method]}: {title}"
        panels.append(
            _lines(ablation, list(labels), title, series, bands, method=method, scale=100.0)
        )
    return panels


def _is(band: AblationBand, method: str, quantity: str, motion_class: str | None = None) -> bool:
    return (band.method, band.quantity, band.motion_class) == (method, quantity, motion_class)


Series = Sequence[tuple[str, Sequence[tuple[float, float | None]]]]


def _by_method(ablation: AblationResult, field: str) -> Series:
    return [
        (method, [(p.value, getattr(p, field)) for p in ablation.points if p.method == method])
        for method in dict.fromkeys(point.method for point in ablation.points)
    ]


def _lines(
    ablation: AblationResult,
    order: Sequence[str],
    title: str,
    series: Series,
    bands: Mapping[str, Sequence[AblationBand]] = MappingProxyType({}),
    *,
    method: str = "",
    scale: float = 1.0,
) -> Panel:
    """One panel: each series by its name, and behind its points what chance alone gives."""
    told, labelled = [], any(point.label for point in ablation.points)
    with drawing():
        figure = blank(270.0, 196.0)
        axes = place(figure, 46.0, 22.0, 212.0, 130.0)
        values = sorted({point.value for point in ablation.points})
        at = {value: k for k, value in enumerate(values)}
        for name, points in series:
            known = [(at[x], y) for x, y in points if y is not None and math.isfinite(y)]
            if not known:
                continue
            axes.plot(
                *zip(*known, strict=True),
                color=_named_colour(name),
                marker=_named_marker(name, order),
                markersize=5.0,
                linewidth=0.0 if labelled else 1.2,  # what is no number has nothing in between
            )
            for band in bands.get(name, ()):
                _chance(axes, ablation, band, at, _named_colour(name), scale)
            told.append(f"{name} {known[0][1]:.3g} to {known[-1][1]:.3g}")
        _base(axes, ablation, at)
        axes.set_xlim(-0.4, len(values) - 0.6)
        ruled(axes, "y", y_ticks=4)
        # Settings are few and unevenly spaced: each has a place of its own.
        axes.set_xticks(range(len(values)))
        names = {point.value: point.name for point in ablation.points}
        crowded = labelled and len(values) > _BESIDE
        axes.set_xticklabels(
            [
                "\n" * (crowded and k % 2) + names[value].replace(", ", "\n")
                for k, value in enumerate(values)
            ]
        )
        shown = [y for _, points in series for _, y in points if y is not None and y > 0.0]
        shown += [scale * band.high for some in bands.values() for band in some]
        if shown and max(shown) > _DECADES * min(shown):
            axes.set_yscale("log")
            axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            axes.yaxis.set_minor_locator(NullLocator())
        elif shown and title != LOG_DET:  # a logarithm has no zero to begin at
            axes.set_ylim(0.0, 1.12 * max(shown))
        headed(axes, title)
        if not labelled:
            footed(axes, ablation.variable)
        key = (
            f"a{ablation.key}-{title[:3].strip().replace(' ', '')}{f'-{method}' if method else ''}"
        )
        alt = f"{ablation.title}, {title}: {'; '.join(told)}."
        return to_panel(figure, key=key, title="", note="", alt=alt)


def _chance(
    axes: Axes,
    ablation: AblationResult,
    band: AblationBand,
    at: Mapping[float, int],
    colour: str,
    scale: float,
) -> None:
    """A pale bar behind each point that has as many repetitions of that method."""
    there = {
        at[point.value]
        for point in ablation.points
        if (point.method, point.repetitions) == (band.method, band.repetitions)
    }
    if there:
        axes.bar(
            sorted(there),
            scale * (band.high - band.low),
            bottom=scale * band.low,
            width=0.42,
            color=colour,
            alpha=0.22,
            linewidth=0.0,
            zorder=1,
        )


def _base(axes: Axes, ablation: AblationResult, at: dict[float, int]) -> None:
    """A band about the setting of the study itself."""
    for value in {point.value for point in ablation.points if point.base}:
        axes.axvspan(at[value] - 0.3, at[value] + 0.3, color=BAND, linewidth=0.0, zorder=0.5)


def _named_colour(name: str) -> str:
    return CLASS_COLOURS.get(name, INK)  # the colours of this figure mean classes of motion


def _named_marker(name: str, order: Sequence[str]) -> str:
    """A class has its own; a method that of its place among them."""
    if name in CLASS_MARKERS:
        return CLASS_MARKERS[name]
    return marker_of(order.index(name) if name in order else 0)
