"""What happens in time: the identification trajectory, and torque measured against predicted."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from hil.report import numbers
from hil.report.figures.canvas import blank, footed, headed, place, ruled, thinned
from hil.report.figures.palette import FIRST, INK, MUTED, SECOND, WIDE
from hil.report.figures.svg import Panel, drawing, to_panel
from hil.report.figures.traces import Plot, Trace, traces_text
from hil.report.series import ReportSeries

Array = NDArray[np.float64]

_WIDTH, _LEFT, _RIGHT = 370.0, 46.0, 10.0
_SECONDS = "time [s]"
_INNER = _WIDTH - _LEFT - _RIGHT
_POINTS = 1200  # of a planned motion, which is smooth


def excitation_panels(series: ReportSeries, joint_names: Sequence[str]) -> list[Panel]:
    """Position and velocity of each joint (the paper's Fig. 1)."""
    time = _from_zero(series.excitation_time)
    return [
        _excitation(
            j, name, time, series.excitation_position[:, j], series.excitation_velocity[:, j]
        )
        for j, name in enumerate(joint_names)
    ]


def _excitation(j: int, name: str, time: Array, position: Array, velocity: Array) -> Panel:
    low, high = float(np.min(position)), float(np.max(position))
    fastest = float(np.max(np.abs(velocity)))
    degrees = f"{np.degrees(low):.0f}° to {np.degrees(high):.0f}°".replace("-", "−")
    note = f"{degrees}, up to {np.degrees(fastest):.0f} °/s"
    alt = (
        f"{name}: position between {numbers.significant(low)} and {numbers.significant(high)} rad,"
        f" speed up to {numbers.significant(fastest)} rad/s, over {_length(time)} s."
    )
    plots = (
        Plot((_LEFT, 20.0, _INNER, 78.0), "position [rad]", [Trace(position, FIRST, 1.5, "q")]),
        Plot((_LEFT, 122.0, _INNER, 78.0), "velocity [rad/s]", [Trace(velocity, SECOND, 1.5, "v")]),
    )
    traces = traces_text(time, plots, points=_POINTS)
    return _panel(240.0, time, plots, key=f"x{j}", title=name, note=note, alt=alt, traces=traces)


def torque_panels(series: ReportSeries, joint_names: Sequence[str]) -> list[Panel]:
    """Measured and predicted torque of each joint, and their difference (the paper's Fig. 4)."""
    if series.example_time.size == 0:
        return []
    time = _from_zero(series.example_time)
    return [
        _torque(j, name, time, series.example_measured[:, j], series.example_predicted[:, j])
        for j, name in enumerate(joint_names)
    ]


def _torque(j: int, name: str, time: Array, measured: Array, predicted: Array) -> Panel:
    error = measured - predicted
    rms = numbers.significant(float(np.sqrt(np.mean(error**2))))
    size = numbers.significant(float(np.sqrt(np.mean(measured**2))))
    note = f"RMS error {rms} of {size} N·m"
    alt = f"{name}: measured and predicted torque over {_length(time)} s; {note}."
    plots = (
        Plot(
            (_LEFT, 20.0, _INNER, 128.0),
            "torque [N·m]",
            [Trace(measured, WIDE, 4.0, "measured"), Trace(predicted, INK, 1.1, "predicted")],
        ),
        Plot(
            (_LEFT, 172.0, _INNER, 50.0),
            "measured − predicted [N·m]",
            [Trace(error, SECOND, 0.9, "difference")],
        ),
    )
    traces = traces_text(time, plots)
    return _panel(262.0, time, plots, key=f"t{j}", title=name, note=note, alt=alt, traces=traces)


def _panel(height: float, time: Array, plots: tuple[Plot, Plot], **words: str) -> Panel:
    """Two plots over the same time, one above the other."""
    with drawing():
        figure = blank(_WIDTH, height)
        upper, lower = (place(figure, *plot.box) for plot in plots)
        for axes, plot in zip((upper, lower), plots, strict=True):
            for trace in plot.traces:
                _line(axes, time, trace.values, trace.colour, trace.width)
            headed(axes, plot.heading)
        if (
            float(np.min(plots[1].traces[0].values))
            < 0.0
            < float(np.max(plots[1].traces[0].values))
        ):
            lower.axhline(0.0, color=MUTED, linewidth=0.8, zorder=1.5)
        _time_axes(upper, lower, time)
        return to_panel(figure, **words)


def _line(axes: Axes, time: Array, values: Array, color: str, width: float) -> None:
    axes.plot(*thinned(time, values), color=color, linewidth=width, solid_joinstyle="round")


def _time_axes(upper: Axes, lower: Axes, time: Array) -> None:
    ruled(upper, "both", x_ticks=6)
    ruled(lower, "both", x_ticks=6, y_ticks=3)
    for axes in (upper, lower):
        axes.set_xlim(0.0, max(float(time[-1]), 1e-9))
    upper.tick_params(labelbottom=False)
    footed(lower, _SECONDS)


def _from_zero(time: Array) -> Array:
    return np.asarray(time - time[0], dtype=np.float64)


def _length(time: Array) -> str:
    return numbers.significant(float(time[-1]))
