"""What happens in time: the identification motion, torque measured, predicted, split; replays."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from hil.report import numbers
from hil.report.figures.canvas import (
    BAND,
    FIRST,
    INK,
    MUTED,
    ROUTES,
    SECOND,
    WIDE,
    blank,
    footed,
    headed,
    place,
    plot_panel,
    ruled,
    thinned,
)
from hil.report.figures.svg import MOST_POINTS, Panel, Plot, Trace, drawing, to_panel, traces_text
from hil.report.series import ReportSeries
from hil.report.validation import TorqueError

Array = NDArray[np.float64]

_WIDTH, _LEFT, _RIGHT = 370.0, 46.0, 10.0
_SECONDS = "time [s]"
_INNER = _WIDTH - _LEFT - _RIGHT
_POINTS = 1200  # of lines that are smooth
_BAND_POINTS = 400

Stretches = Sequence[tuple[float, float]]
"""Begin and end [s]."""


def excitation_panels(series: ReportSeries, joint_names: Sequence[str]) -> list[Panel]:
    """Position and velocity of each joint (the paper's Fig. 1)."""
    time = _from_zero(series.excitation_time)
    return [_excitation(series, time, j, name) for j, name in enumerate(joint_names)]


def _excitation(series: ReportSeries, time: Array, j: int, name: str) -> Panel:
    position, velocity = series.excitation_position[:, j], series.excitation_velocity[:, j]
    low, high = float(np.min(position)), float(np.max(position))
    fastest = float(np.max(np.abs(velocity)))
    ends = (numbers.fixed(float(np.degrees(end)), 0) for end in (low, high))
    degrees = "{}° to {}°".format(*ends).replace("-", "−")
    note = f"{degrees}, up to {np.degrees(fastest):.0f} °/s"
    alt = (
        f"{name}: position between {numbers.significant(low)} and {numbers.significant(high)} rad,"
        f" speed up to {numbers.significant(fastest)} rad/s, over {_length(time)} s."
    )
    shaded = _left_out(time, series.excitation_fitted, j)
    plots = (
        _plot(20.0, 78.0, "position [rad]", [Trace(position, FIRST, 1.5, "q")], shaded),
        _plot(122.0, 78.0, "velocity [rad/s]", [Trace(velocity, SECOND, 1.5, "v")], shaded),
    )
    words = {"key": f"x{j}", "title": name, "note": note, "alt": alt}
    return time_panel(240.0, time, plots, _POINTS, **words)


def torque_panels(series: ReportSeries, errors: Sequence[TorqueError]) -> list[Panel]:
    """Measured and predicted torque of each joint, and their difference (the paper's Fig. 4)."""
    if series.example_time.size == 0:
        return []
    time = _from_zero(series.example_time)
    return [_torque(series, time, j, joint) for j, joint in enumerate(errors)]


def _torque(series: ReportSeries, time: Array, j: int, joint: TorqueError) -> Panel:
    measured, predicted = series.example_measured[:, j], series.example_predicted[:, j]
    alt = f"{joint.joint}: measured and predicted torque over {_length(time)} s; {joint.words}."
    both = [Trace(measured, WIDE, 4.0, "measured"), Trace(predicted, INK, 1.1, "predicted")]
    error = [Trace(measured - predicted, SECOND, 0.9, "difference")]
    shaded = _left_out(time, series.example_used, j)
    plots = (
        _plot(20.0, 128.0, f"torque [{joint.unit}]", both, shaded),
        _plot(172.0, 50.0, f"measured − predicted [{joint.unit}]", error, shaded),
    )
    words = {"key": f"t{j}", "title": joint.joint, "note": joint.words, "alt": alt}
    return time_panel(262.0, time, plots, MOST_POINTS, **words)


PARTS: Final = (
    ("gravity", ROUTES[0], 1.6),
    ("inertia", FIRST, 1.2),
    ("coriolis", ROUTES[3], 1.2),
    ("friction", SECOND, 1.2),
)
"""Parts of a predicted torque with their colours and widths, the lowest line first."""


def split_panels(series: ReportSeries, errors: Sequence[TorqueError]) -> list[Panel]:
    """Predicted torque of each joint split, and the measured one behind it."""
    if series.example_time.size == 0 or series.example_gravity.size == 0:
        return []
    time = _from_zero(series.example_time)
    return [_split(series, time, j, joint) for j, joint in enumerate(errors)]


def _split(series: ReportSeries, time: Array, j: int, joint: TorqueError) -> Panel:
    parts = {name: getattr(series, f"example_{name}")[:, j] for name, _, _ in PARTS}
    sizes = {name: float(np.sqrt(np.mean(part**2))) for name, part in parts.items()}
    rms = ", ".join(f"{name} {numbers.significant(size, 2)}" for name, size in sizes.items())
    alt = f"{joint.joint}: parts of the predicted torque; RMS of {rms} {joint.unit}."
    largest = max(sizes, key=lambda name: sizes[name])
    note = f"largest: {largest}, RMS {numbers.significant(sizes[largest])} {joint.unit}"
    lines = [Trace(series.example_measured[:, j], WIDE, 4.0, "measured")]
    lines += [Trace(parts[name], colour, width, name) for name, colour, width in PARTS]
    shaded = _left_out(time, series.example_used, j)
    plot = _plot(20.0, 140.0, f"torque [{joint.unit}]", lines, shaded)
    words = {"key": f"g{j}", "title": joint.joint, "note": note, "alt": alt}
    return time_panel(200.0, time, (plot,), _POINTS, **words)


def _plot(
    top: float, height: float, heading: str, traces: Sequence[Trace], shaded: Stretches
) -> Plot:
    """A plot of the panels' width at its place below their upper edge [px]."""
    return Plot((_LEFT, top, _INNER, height), heading, traces, shaded=shaded)


def time_panel(
    height: float, time: Array, plots: Sequence[Plot], points: int, **words: str
) -> Panel:
    """Plots over the same time, one above the other, with their samples to zoom into."""
    with drawing():
        figure = blank(_WIDTH, height)
        all_axes = [place(figure, *plot.box) for plot in plots]
        for axes, plot in zip(all_axes, plots, strict=True):
            for stretch in plot.shaded:
                axes.axvspan(*stretch, color=BAND, linewidth=0.0, zorder=0.5)
            for trace in plot.traces:
                axes.plot(
                    *thinned(time, trace.values),
                    color=trace.colour,
                    linewidth=trace.width,
                    linestyle=(0, (4, 2)) if trace.dashed else "-",
                    solid_joinstyle="round",
                )
            if plot.reach is not None:
                axes.set_ylim(-plot.reach, plot.reach)
            headed(axes, plot.heading)
            _zero_line(axes, plot)
        _time_axes(all_axes, time)
        traces = traces_text(time, plots, points=points)
        return to_panel(figure, traces=traces, **words)


def _zero_line(axes: Axes, plot: Plot) -> None:
    lowest = min(float(np.min(trace.values)) for trace in plot.traces)
    highest = max(float(np.max(trace.values)) for trace in plot.traces)
    if lowest < 0.0 < highest:
        axes.axhline(0.0, color=MUTED, linewidth=0.8, zorder=1.5)


def _time_axes(all_axes: Sequence[Axes], time: Array) -> None:
    for k, axes in enumerate(all_axes):
        ruled(axes, "both", x_ticks=6, y_ticks=3 if k else 4)
        axes.set_xlim(0.0, max(float(time[-1]), 1e-9))
        axes.tick_params(labelbottom=axes is all_axes[-1])
    footed(all_axes[-1], _SECONDS)


def _left_out(time: Array, used: Array, joint: int) -> Stretches:
    """Stretches of time (m,) in which rows (m, n) of a joint are zero, to midway to the next."""
    if used.size == 0:
        return ()
    out = np.concatenate([[False], used[:, joint] < 0.5, [False]])
    edges = np.concatenate([time[:1], 0.5 * (time[1:] + time[:-1]), time[-1:]])
    changes = edges[np.flatnonzero(np.diff(out.astype(np.int8)))].tolist()
    return tuple(zip(changes[::2], changes[1::2], strict=True))


def _from_zero(time: Array) -> Array:
    return np.asarray(time - time[0], dtype=np.float64)


def _length(time: Array) -> str:
    return numbers.significant(float(time[-1]))


def replay_panels(series: ReportSeries, joints: Sequence[TorqueError]) -> list[Panel]:
    """Position error of each joint over time; none where nothing was simulated."""
    if series.replay_time.size < 2:
        return []
    return [_replay_panel(j, series, one) for j, one in enumerate(joints)]


def _replay_panel(j: int, series: ReportSeries, joint: TorqueError) -> Panel:
    time, error = series.replay_time, np.nan_to_num(series.replay_error[:, j])
    unit = "°" if joint.unit == "N·m" else "mm"
    rms = numbers.significant(float(np.sqrt(np.mean(error**2))), 2)
    with drawing():
        figure, axes = plot_panel(170.0)
        if series.replay_spread.size:
            some = slice(None, None, 1 + len(time) // _BAND_POINTS)
            width = 2.0 * np.nan_to_num(series.replay_spread[some, j])
            edges = error[some] - width, error[some] + width
            axes.fill_between(time[some], *edges, color=BAND, linewidth=0.0)
        if series.replay_nominal.size:
            nominal = np.nan_to_num(series.replay_nominal[:, j])
            axes.plot(*thinned(time, nominal), color=SECOND, linewidth=1.0)
        axes.plot(*thinned(time, error), color=INK, linewidth=1.2)
        axes.set_xlim(float(time[0]), float(time[-1]))
        ruled(axes, "y")
        headed(axes, f"position error [{unit}]")
        footed(axes, _SECONDS)
        alt = f"{joint.joint}: simulated less recorded position, {rms} {unit} rms."
        return to_panel(figure, key=f"q{j}r", title=joint.joint, note=f"{rms} {unit} rms", alt=alt)
