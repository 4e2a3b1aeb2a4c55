"""The page of a study: results in, one self-contained HTML file with the figures out."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from hil.files import write_together
from hil.progress import Reporter
from hil.report import numbers
from hil.report.figures.canvas import TICK_SIZE, blank, footed, headed, log_ticks, place, ruled
from hil.report.figures.correlation import matrix_panel
from hil.report.figures.palette import BAND, FIRST, INK, MUTED, ROUTES, SECOND, WIDE
from hil.report.figures.svg import Panel, drawing, to_panel
from hil.report.figures.traces import Plot, Trace, traces_text
from hil.report.rendering import environment, page_bytes

from .records import ExampleRecord
from .results import AblationBand, AblationResult, ComparisonResult, ConditionResult, StudyResults

Array = NDArray[np.float64]
Points = Sequence[tuple[float, float | None]]

COLOURS: Final = (FIRST, SECOND, ROUTES[3], ROUTES[0])
MARKERS: Final = ("o", "D", "^", "s")
CLASS_STYLES: Final = {
    "fly-by": (SECOND, "D"),
    "stop-to-stop": (ROUTES[3], "^"),
    "sinusoid": (FIRST, "o"),
}
_LEGEND: Final = tuple(zip(("--first", "--second", "--route-3", "--route-0"), "●◆▲■", strict=True))
_WIDTH, _LEFT, _RIGHT = 370.0, 46.0, 10.0
_BESIDE: Final = 4  # names that have room in one line
_DECADES: Final = 20.0  # between smallest and largest: beyond that a scale from zero hides most


def write_outcome(root: Path, results: StudyResults, reporter: Reporter) -> None:
    """Write `results.json` and `report.html` together, and say where they are.

    Raises:
        OutputError: they cannot be written.
    """
    write_together(root, {"results.json": results.to_json(), "report.html": study_page(results)})
    reporter.say(f"report: {root / 'report.html'}")


def study_page(results: StudyResults) -> bytes:
    """The page as one HTML file; the same results give the same bytes."""
    first, joints = results.conditions[0], results.joint_names
    template = environment().get_template("study.html.j2")
    text = template.render(
        results=results,
        labels=first.labels,
        paragraphs={one.key: one for one in results.reading},
        legend=[(one.label, *_LEGEND[k % 4]) for k, one in enumerate(first.methods)],
        parameters=sorted(
            enumerate(results.parameters), key=lambda one: one[1].printed_id or math.inf
        ),
        trajectories=[_trajectory(first, j, name) for j, name in enumerate(joints)],
        correlations=_correlations(results, first),
        ratios=_ratio_panels(results.conditions),
        boxes={one.key: _error_panels(one, joints) for one in results.conditions},
        examples={one.key: _example_panels(one, joints) for one in results.conditions},
        ablation_panels={one.key: _ablation_panels(one, first.labels) for one in results.ablations},
    )
    return page_bytes(text)


def _trajectory(condition: ConditionResult, j: int, name: str) -> Panel:
    """Position of a joint in each excitation, on scales of time and angle in common (Fig. 1)."""
    methods = condition.methods
    every = np.concatenate([one.position[j] for one in methods])
    margin = 0.06 * float(np.ptp(every)) or 0.1
    with drawing():
        figure = blank(_WIDTH, 40.0 + len(methods) * 84.0)
        for k, one in enumerate(methods):
            axes = place(figure, _LEFT, 20.0 + 84.0 * k, _WIDTH - _LEFT - _RIGHT, 58.0)
            axes.plot(one.time, one.position[j], color=COLOURS[k % 4], linewidth=1.5)
            axes.set_xlim(0.0, max(method.time[-1] for method in methods))
            axes.set_ylim(float(every.min()) - margin, float(every.max()) + margin)
            ruled(axes, "both", x_ticks=6, y_ticks=3)
            headed(axes, f"{one.label}: position [rad]")
            axes.tick_params(labelbottom=k == len(methods) - 1)
        footed(axes, "time [s]")
        spans = [
            f"{one.label} {math.degrees(min(one.position[j])):.0f}° to"
            f" {math.degrees(max(one.position[j])):.0f}°"
            for one in methods
        ]
        alt = f"{name}: position in the excitations; {'; '.join(spans)}."
        return to_panel(figure, key=f"x{j}", title=name, note="", alt=alt)


def _correlations(results: StudyResults, condition: ConditionResult) -> list[Panel]:
    """|ρ| of the base parameters for each excitation, friction left out (Fig. 2)."""
    n = results.n_base
    labels = [f"{one.printed_id or ''} {one.name}".strip() for one in results.parameters[:n]]
    return [
        matrix_panel(np.array(one.correlation)[:n, :n], labels, key=f"c{k}", title=one.label)
        for k, one in enumerate(condition.methods)
    ]


def _error_panels(condition: ConditionResult, joint_names: Sequence[str]) -> list[Panel]:
    """Mean |e| on fly-by motions, a box for each estimate and a panel for each joint (Fig. 3)."""
    found = next((one for one in condition.classes if one.motion_class == "fly-by"), None)
    if found is None:
        return []
    errors = [np.array(found.mean_abs[one.key]) for one in condition.methods]
    return [
        _boxes(condition, j, name, [one[:, j] for one in errors])
        for j, name in enumerate(joint_names)
    ]


def _boxes(condition: ConditionResult, j: int, name: str, columns: Sequence[Array]) -> Panel:
    labels = [one.label.replace(" ", "\n") for one in condition.methods]
    medians = [float(np.median(column)) for column in columns]
    thin = {"color": MUTED, "linewidth": 1.1}
    places = range(1, len(columns) + 1)
    with drawing():
        figure = blank(220.0, 226.0 + 11.0 * max(label.count("\n") for label in labels))
        axes = place(figure, 46.0, 24.0, 164.0, 172.0)
        axes.boxplot(
            columns,
            positions=places,
            widths=0.6,
            patch_artist=True,
            boxprops={"facecolor": BAND, "edgecolor": MUTED, "linewidth": 1.1},
            medianprops={"color": INK, "linewidth": 2.2},
            whiskerprops=thin,
            capprops=thin,
            flierprops={"marker": "+", "markeredgecolor": MUTED, "markersize": 6.0},
        )
        for k, middle in enumerate(medians):
            colour, marker = COLOURS[k % 4], MARKERS[k % 4]
            axes.scatter([k + 1], [middle], s=34.0, marker=marker, color=colour, zorder=4)
        ruled(axes, "y", y_ticks=5)
        axes.set_xticks(places, labels, fontsize=TICK_SIZE)
        axes.tick_params(axis="x", length=0.0)
        # A scale that shows every motion, and never makes a small change look large.
        every = np.concatenate(columns)
        low = min(float(every.min()), 0.9 * float(np.median(every)))
        high = max(float(every.max()), 1.1 * float(np.median(every)))
        axes.set_ylim(max(0.0, low - 0.06 * (high - low)), high + 0.06 * (high - low))
        headed(axes, "mean |e| [N·m]")
        shown = ", ".join(
            f"{one.label} {numbers.significant(value)}"
            for one, value in zip(condition.methods, medians, strict=True)
        )
        alt = f"{name}: mean absolute error on {len(columns[0])} motions; medians {shown} N·m."
        return to_panel(figure, key=f"b{condition.key}{j}", title=name, note="", alt=alt)


def _example_panels(condition: ConditionResult, joint_names: Sequence[str]) -> list[Panel]:
    """One held-out motion in time: measured, predicted by each, and the errors (Fig. 4)."""
    return [
        _example(condition, example, j, name)
        for example in condition.examples[:1]
        for j, name in enumerate(joint_names)
    ]


def _example(condition: ConditionResult, example: ExampleRecord, j: int, name: str) -> Panel:
    labels, time = condition.labels, np.array(example.time)
    measured = np.array(example.measured[j])
    predicted = {k: np.array(series[j]) for k, series in example.predicted.items()}
    errors = {k: measured - series for k, series in predicted.items()}
    colours = {k: COLOURS[list(labels).index(k) % 4] for k in predicted}
    width = _WIDTH - _LEFT - _RIGHT
    # A row for each error: where there is noise, one line over another would hide it.
    traces = [Trace(measured, WIDE, 4.0, "measured")]
    traces += [Trace(series, colours[k], 1.1, labels[k]) for k, series in predicted.items()]
    plots = [Plot((_LEFT, 20.0, width, 128.0), "torque [N·m]", traces)] + [
        Plot(
            (_LEFT, 172.0 + 72.0 * row, width, 48.0),
            f"measured − {labels[k]} [N·m]",
            [Trace(error, colours[k], 1.0, labels[k])],
        )
        for row, (k, error) in enumerate(errors.items())
    ]
    reach = 1.05 * max(float(np.abs(error).max()) for error in errors.values()) or 1.0
    with drawing():
        figure = blank(_WIDTH, 188.0 + 72.0 * len(errors))
        for row, plot in enumerate(plots):
            axes = place(figure, *plot.box)
            for one in plot.traces:
                dashed = row == 0 and one.colour == COLOURS[1]
                style = (0, (4, 2)) if dashed else "-"
                axes.plot(time, one.values, color=one.colour, linewidth=one.width, linestyle=style)
            axes.set_xlim(0.0, float(time[-1]))
            headed(axes, plot.heading)
            if row:
                axes.axhline(0.0, color=MUTED, linewidth=0.8)
                axes.set_ylim(-reach, reach)
            ruled(axes, "both", x_ticks=6, y_ticks=3 if row else 4)
            axes.tick_params(labelbottom=row == len(plots) - 1)
        footed(axes, "time [s]")
        rms = ", ".join(
            f"{labels[k]} {numbers.significant(float(np.sqrt(np.mean(error**2))))}"
            for k, error in errors.items()
        )
        note = f"RMS error {rms} N·m"
        alt = f"{name}: measured and predicted torque over {time[-1]:.1f} s; {note}."
        key, text = f"e{condition.key}{j}", traces_text(time, plots)
        return to_panel(figure, key=key, title=name, note=note, alt=alt, traces=text)


def _ratio_panels(conditions: Sequence[ConditionResult]) -> list[Panel]:
    """Ratio of errors with its interval, every pair of estimates on every class."""
    every = [one for condition in conditions for one in condition.comparisons]
    ends = [end for one in every for end in (one.ratio, one.low, one.high) if end is not None]
    low, high = min(0.9, *ends, 0.9) / 1.03, max(1.1, *ends, 1.1) * 1.03
    return [_ratios(condition, (low, high)) for condition in conditions] if every else []


def _ratios(condition: ConditionResult, limits: tuple[float, float]) -> Panel:
    rows, labels = condition.comparisons, condition.labels
    names = [f"{one.motion_class}: {labels[one.second]} over {labels[one.first]}" for one in rows]
    height = 17.0 * len(rows)
    with drawing():
        figure = blank(520.0, 10.0 + height + 42.0)
        axes = place(figure, 220.0, 8.0, 286.0, height)
        axes.set_xscale("log")
        axes.axvline(1.0, color=MUTED, linewidth=1.0)
        for row, one in enumerate(rows):
            _ratio(axes, row, one)
        axes.set_xlim(*limits)
        axes.set_ylim(len(rows) - 0.5, -0.5)
        axes.set_yticks(range(len(rows)), names)
        axes.tick_params(axis="y", length=0.0)
        axes.spines["left"].set_visible(False)
        log_ticks(axes.xaxis, MaxNLocator(6, steps=[1, 2, 5, 10]))
        axes.grid(True, axis="x", color=BAND, linewidth=0.8)
        footed(axes, "ratio of errors, geometric mean over the motions")
        shown = [f"{name} {one.ratio:.3f}" for name, one in zip(names, rows, strict=True)]
        alt = f"{condition.words}: {'; '.join(shown)}."
        return to_panel(figure, key=f"r{condition.key}", title=condition.words, note="", alt=alt)


def _ratio(axes: Axes, row: int, one: ComparisonResult) -> None:
    dark = INK if one.differs else MUTED
    if one.low is not None and one.high is not None:
        axes.plot([one.low, one.high], [row, row], color=dark, linewidth=1.6)
    marker, face = ("o", INK) if one.differs else ("s", BAND)
    axes.scatter(
        [one.ratio], [row], s=38.0, marker=marker, facecolor=face, edgecolor=dark, zorder=3
    )


def _ablation_panels(ablation: AblationResult, labels: Mapping[str, str]) -> list[Panel]:
    """Criteria, distance to the planted values, and prediction errors over one setting."""
    methods = list(dict.fromkeys(point.method for point in ablation.points))
    of = {method: [p for p in ablation.points if p.method == method] for method in methods}
    styles = {method: (INK, MARKERS[list(labels).index(method) % 4]) for method in methods}
    panels = []
    figures = {"parameter_error": "distance to planted values, B = 1"}
    if len(ablation.points) > 1 and ablation.key not in ("repetitions", "noise", "effects"):
        figures = {"coupling_index": "coupling index I_c", "log10_det": "log det"} | figures
    for name, title in figures.items():
        series: dict[str, Points] = {
            method: [(p.value, getattr(p, name)) for p in points] for method, points in of.items()
        }
        if any(y is not None for points in series.values() for _, y in points):
            bands = {method: _bands(ablation, method, name) for method in methods}
            panels.append(_lines(ablation, title, series, styles, bands, key=name))
    for method, points in of.items():
        # The noise that every estimate leaves would cover what differs, where it can be separated.
        quantity = "own" if all(point.own for point in points) else "error"
        errors = [(point.value, getattr(point, quantity)) for point in points]
        series = {
            name: [(value, 100.0 * some[name]) for value, some in errors]
            for name in CLASS_STYLES
            if all(name in some for _, some in errors)
        }
        bands = {name: _bands(ablation, method, quantity, name, 100.0) for name in series}
        title = f"{'own' if quantity == 'own' else 'torque'} error [%]"
        title = title if len(methods) == 1 else f"{labels[method]}: {title}"
        panels.append(_lines(ablation, title, series, CLASS_STYLES, bands, key=f"error-{method}"))
    return panels


def _bands(
    ablation: AblationResult,
    method: str,
    quantity: str,
    motion_class: str | None = None,
    scale: float = 1.0,
) -> list[AblationBand]:
    wanted = (method, quantity, motion_class)
    return [
        band.model_copy(update={"low": scale * band.low, "high": scale * band.high})
        for band in ablation.bands
        if (band.method, band.quantity, band.motion_class) == wanted
    ]


def _lines(
    ablation: AblationResult,
    title: str,
    series: Mapping[str, Points],
    styles: Mapping[str, tuple[str, str]],
    bands: Mapping[str, Sequence[AblationBand]],
    *,
    key: str,
) -> Panel:
    """One panel: each series by its name, and behind its points the range of chance."""
    labelled = any(point.label for point in ablation.points)
    names = {point.value: point.name for point in sorted(ablation.points, key=lambda p: p.value)}
    # Settings are few and unevenly spaced: each has a place of its own.
    at = {value: k for k, value in enumerate(names)}
    known = {
        name: [(at[x], y) for x, y in points if y is not None and math.isfinite(y)]
        for name, points in series.items()
    }
    known = {name: points for name, points in known.items() if points}
    with drawing():
        figure = blank(270.0, 196.0)
        axes = place(figure, 46.0, 22.0, 212.0, 130.0)
        for value in {point.value for point in ablation.points if point.base}:
            axes.axvspan(at[value] - 0.3, at[value] + 0.3, color=BAND, linewidth=0.0, zorder=0.5)
        for name, points in known.items():
            colour, marker = styles[name]
            axes.plot(
                *zip(*points, strict=True),
                color=colour,
                marker=marker,
                markersize=5.0,
                linewidth=0.0 if labelled else 1.2,  # names have nothing in between
            )
            for band in bands[name]:
                alike = (band.method, band.repetitions)
                some = {at[p.value] for p in ablation.points if (p.method, p.repetitions) == alike}
                axes.bar(
                    sorted(some),
                    band.high - band.low,
                    bottom=band.low,
                    width=0.42,
                    color=colour,
                    alpha=0.22,
                    linewidth=0.0,
                    zorder=1,
                )
        axes.set_xlim(-0.4, len(at) - 0.6)
        ruled(axes, "y", y_ticks=4)
        lower = labelled and len(at) > _BESIDE  # every second name a line lower
        texts = [name.replace(", ", "\n") for name in names.values()]
        axes.set_xticks(range(len(at)), ["\n" * (lower and k % 2) + t for k, t in enumerate(texts)])
        shown = [y for points in known.values() for _, y in points if y > 0.0]
        shown += [band.high for some in bands.values() for band in some]
        if shown and max(shown) > _DECADES * min(shown):
            axes.set_yscale("log")
            log_ticks(axes.yaxis, axes.yaxis.get_major_locator())
        elif shown and key != "log10_det":  # a logarithm has no zero to begin at
            axes.set_ylim(0.0, 1.12 * max(shown))
        headed(axes, title)
        if not labelled:
            footed(axes, ablation.variable)
        ends = [f"{name} {some[0][1]:.3g} to {some[-1][1]:.3g}" for name, some in known.items()]
        alt = f"{ablation.title}, {title}: {'; '.join(ends)}."
        return to_panel(figure, key=f"a{ablation.key}-{key}", title="", note="", alt=alt)
