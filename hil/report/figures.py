"""Figures of the report: one panel for each joint."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Final, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FixedLocator, LogLocator, MaxNLocator
from numpy.typing import NDArray

from hil.report.drawing import (
    BAND,
    DASHED,
    FIRST,
    GRID,
    INK,
    MOST_POINTS,
    MUTED,
    PANEL_WIDTH,
    ROUTES,
    SECOND,
    TICK_SIZE,
    WIDE,
    Caption,
    Panel,
    Plot,
    Trace,
    blank,
    box_panel,
    dots,
    drawing,
    footed,
    headed,
    label,
    log_ticks,
    panel,
    place,
    ruled,
    time_panel,
    to_panel,
)
from hil.report.numbers import fixed, percent, significant
from hil.report.series import ReportSeries
from hil.results import FittedResult, Results, ValidationResult

Array = NDArray[np.float64]

_LEFT, _RIGHT = 46.0, 10.0
_INNER: Final = PANEL_WIDTH - _LEFT - _RIGHT
_POINTS: Final = 1200  # of lines that are smooth
_INTERVAL: Final = 1.96  # Half a 95 % interval, in standard errors
MEAN_ABS_OF_NORMAL: Final = math.sqrt(2.0 / math.pi)
"""Mean |e| of normal residuals of standard deviation 1."""
PARTS: Final = (
    ("gravity", ROUTES[0], 1.6),
    ("inertia", FIRST, 1.2),
    ("coriolis", ROUTES[3], 1.2),
    ("friction", SECOND, 1.2),
)
"""Contributions to the predicted torque with colours and line widths, in order of drawing."""


class Joint(NamedTuple):
    """A joint with its number from 0, name, unit of torque, and error on the example."""

    number: int
    name: str
    unit: str
    error: str

    @property
    def angle(self) -> str:
        """Unit of its position."""
        return "rad" if self.unit == "N·m" else "m"


def joints_of(results: Results) -> list[Joint]:
    """Return the joints with their errors on the first run, or else on the fitted recording."""
    units = [joint.unit for joint in results.judgement.joints] if results.judgement else []
    example: ValidationResult | FittedResult | None = None
    if results.validation:
        example = results.validation[0]
    elif len(results.repetitions) == 1:
        example = results.fitted

    def error(j: int) -> str:
        if example is None:
            return ""
        text = f"error {percent(example.relative_error[j])} %"
        if example.all_rows_joint_errors:
            text += f", all rows {percent(example.all_rows_joint_errors[j])} %"
        return text

    return [
        Joint(j, name, units[j] if units else "N·m", error(j))
        for j, name in enumerate(results.joint_names)
    ]


# Over time


def excitation_panels(series: ReportSeries, joint_names: Sequence[str]) -> list[Panel]:
    """Draw position and velocity of each joint (paper, Fig. 1)."""
    time = series.excitation_time - series.excitation_time[0]
    panels = []
    for j, name in enumerate(joint_names):
        position, velocity = series.excitation_position[:, j], series.excitation_velocity[:, j]
        low, high, fastest = np.degrees([position.min(), position.max(), np.abs(velocity).max()])
        note = f"{fixed(low, 0)}° to {fixed(high, 0)}°, up to {fastest:.0f} °/s".replace("-", "−")
        shaded = _left_out(time, series.excitation_fitted, j)
        plots = (
            _plot(20.0, 78.0, "position [rad]", [Trace(position, FIRST, 1.5, "q")], shaded),
            _plot(122.0, 78.0, "velocity [rad/s]", [Trace(velocity, SECOND, 1.5, "v")], shaded),
        )
        caption = Caption(f"x{j}", name, note, "position and velocity over time")
        panels.append(time_panel(240.0, time, plots, caption, _POINTS))
    return panels


def torque_panels(series: ReportSeries, joints: Sequence[Joint]) -> list[Panel]:
    """Draw measured and predicted torque of each joint, and their difference (paper, Fig. 4)."""
    if series.example_time.size == 0:
        return []
    time = series.example_time - series.example_time[0]
    panels = []
    for j, name, unit, error in joints:
        measured, predicted = series.example_measured[:, j], series.example_predicted[:, j]
        both = [Trace(measured, WIDE, 4.0, "measured"), Trace(predicted, INK, 1.1, "predicted")]
        difference = [Trace(measured - predicted, SECOND, 0.9, "difference")]
        shaded = _left_out(time, series.example_used, j)
        plots = (
            _plot(20.0, 128.0, f"torque [{unit}]", both, shaded),
            _plot(172.0, 50.0, f"measured − predicted [{unit}]", difference, shaded),
        )
        caption = Caption(f"t{j}", name, error, "measured and predicted torque over time")
        panels.append(time_panel(262.0, time, plots, caption, MOST_POINTS))
    return panels


def split_panels(series: ReportSeries, joints: Sequence[Joint]) -> list[Panel]:
    """Draw the contributions to the predicted torque of each joint, and the measured torque."""
    if series.example_time.size == 0 or series.example_gravity.size == 0:
        return []
    time = series.example_time - series.example_time[0]
    panels = []
    for j, name, unit, _ in joints:
        parts = {part: getattr(series, f"example_{part}")[:, j] for part, _, _ in PARTS}
        sizes = {part: float(np.sqrt(np.mean(one**2))) for part, one in parts.items()}
        rms = ", ".join(f"{part} {significant(size, 2)}" for part, size in sizes.items())
        lines = [Trace(series.example_measured[:, j], WIDE, 4.0, "measured")]
        lines += [Trace(parts[part], colour, width, part) for part, colour, width in PARTS]
        shaded = _left_out(time, series.example_used, j)
        plot = _plot(20.0, 140.0, f"torque [{unit}]", lines, shaded)
        caption = Caption(f"g{j}", name, f"RMS [{unit}]: {rms}", "parts of the predicted torque")
        panels.append(time_panel(200.0, time, (plot,), caption, _POINTS))
    return panels


def _plot(
    top: float,
    height: float,
    heading: str,
    traces: Sequence[Trace],
    shaded: Sequence[tuple[float, float]],
) -> Plot:
    """Return a plot of the panel width, `top` below the upper edge [px]."""
    return Plot((_LEFT, top, _INNER, height), heading, traces, shaded=shaded)


def _left_out(time: Array, used: Array, joint: int) -> Sequence[tuple[float, float]]:
    """Return intervals of time (m,) in which rows (m, n) of a joint are zero."""
    if used.size == 0:
        return ()
    out = np.concatenate([[False], used[:, joint] < 0.5, [False]])
    edges = np.concatenate([time[:1], 0.5 * (time[1:] + time[:-1]), time[-1:]])
    changes = edges[np.flatnonzero(np.diff(out.astype(np.int8)))].tolist()
    return tuple(zip(changes[::2], changes[1::2], strict=True))


# Friction

_HEIGHT, _TOP, _BOTTOM = 210.0, 20.0, 40.0
_TURN, _GAP = 74.0, 22.0
_ROOM: Final = 0.08
# Percentiles of the torque inside the axes; outliers may lie outside.
_SHOWN: Final = (0.5, 99.5)


def friction_curve_panels(series: ReportSeries, joints: Sequence[Joint]) -> list[Panel]:
    """Draw the friction law of each joint with the fitted rows."""
    known = joints if series.law_speed.size else ()
    return [_curve(series, one) for one in known if np.ptp(series.law_speed[:, one.number])]


def _curve(series: ReportSeries, joint: Joint) -> Panel:
    j, per = joint.number, joint.angle
    law_speed, law = series.law_speed[:, j], series.law_torque[:, j]
    speed, torque = _known(series.friction_speed, series.friction_torque, j)
    travel, turning = _known(series.reversal_travel, series.reversal_torque, j)
    ends = " to ".join(significant(float(end)) for end in law[[0, -1]])
    with drawing():
        figure = blank(PANEL_WIDTH, _HEIGHT)
        height = _HEIGHT - _TOP - _BOTTOM
        wide = _INNER - (_TURN + _GAP if travel.size else 0.0)
        axes = place(figure, _LEFT, _TOP, wide, height)
        axes.axhline(0.0, color=MUTED, linewidth=0.8)
        axes.axvline(0.0, color=MUTED, linewidth=0.8)
        dots(axes, speed, torque, WIDE)
        axes.plot(law_speed, law, color=SECOND, linewidth=1.8)
        shown = [np.percentile(torque, _SHOWN)] if torque.size else []
        values = np.concatenate([*shown, law, turning, [0.0]])
        room = _ROOM * float(np.ptp(values)) or 1.0
        axes.set_ylim(float(values.min()) - room, float(values.max()) + room)
        ruled(axes, "both")
        headed(axes, f"friction [{joint.unit}]")
        footed(axes, f"speed [{per}/s]")
        if travel.size:  # presliding, to the scale of the curve over speed
            turn = place(figure, _LEFT + wide + _GAP, _TOP, _TURN, height)
            turn.axhline(0.0, color=MUTED, linewidth=0.8)
            turn.plot(1e3 * travel, turning, color=SECOND, linewidth=1.8)
            turn.set_xlim(0.0, 1e3 * float(travel[-1]))
            turn.set_ylim(axes.get_ylim())
            ruled(turn, "both", x_ticks=2)
            turn.tick_params(labelleft=False)
            headed(turn, "at reversal")
            footed(turn, f"travel [m{per}]")
        note = f"{ends} {joint.unit}".replace("-", "−")
        return to_panel(figure, Caption(f"k{j}", joint.name, note, "friction over velocity"))


def _known(horizontal: Array, vertical: Array, j: int) -> tuple[Array, Array]:
    """Return column j of both without missing values."""
    if horizontal.size == 0:
        return np.empty(0), np.empty(0)
    there = np.isfinite(horizontal[:, j]) & np.isfinite(vertical[:, j])
    return horizontal[there, j], vertical[there, j]


def warm_up_panels(results: Results) -> list[Panel]:
    """Draw friction of each joint motion by motion, and the largest change."""
    warm = None if results.conduct is None else results.conduct.warm_up
    if warm is None or len(warm.friction) < 2:
        return []
    panels: list[Panel] = []
    friction, foot = np.array(warm.friction, dtype=np.float64), "motion of the warm-up"
    for name, column in zip(results.joint_names, friction.T, strict=False):
        known = column[np.isfinite(column)]
        if known.size:
            share = 100.0 * (known[-1] / known[0] - 1.0) if known[0] else 0.0
            note = f"last {significant(float(known[-1]))} N·m, {share:+.1f} %".replace("-", "−")
            caption = Caption(f"wu{len(panels)}", label(name), note, "friction in the warm-up")
            with _in_order(panels, column, caption, "friction [N·m]", foot):
                pass
    change = 100.0 * np.array(warm.change, dtype=np.float64)
    known, most = change[np.isfinite(change)], 100.0 * warm.threshold
    last = f"{known[-1]:.2g} %" if known.size else "unknown"
    note = f"last {last}, threshold {most:.2g} %"
    caption = Caption("wu", "Change per motion", note, "largest change of friction")
    with _in_order(panels, change, caption, "largest change per motion [%]", foot) as axes:
        axes.axhline(most, color=SECOND, linewidth=1.3, linestyle=DASHED)
        axes.set_ylim(0.0, 1.15 * max(most, known.max(initial=0.0)))
    return panels


@contextmanager
def _in_order(
    panels: list[Panel], values: Array, caption: Caption, heading: str, foot: str
) -> Iterator[Axes]:
    """Draw values motion by motion, on a scale that does not exaggerate small changes."""
    known = values[np.isfinite(values)]
    room = max(0.1 * np.ptp(known), 0.025 * abs(float(known[-1]))) if known.size else 1.0
    with panel(panels, 180.0, caption, heading, foot, left=50.0, right=12.0, bottom=42.0) as axes:
        axes.plot(np.arange(1, len(values) + 1), values, color=FIRST, marker="o", markersize=3.6)
        if known.size:
            axes.set_ylim(known.min() - room, known.max() + room)
        yield axes
        ruled(axes, "both")
        axes.xaxis.set_major_locator(MaxNLocator(6, integer=True))


# Residuals


def residual_panels(results: Results) -> dict[str, list[Panel]]:
    """Draw the residual of each joint over speed, position, lag and time; {} without judgement."""
    judgement = results.judgement
    if judgement is None:
        return {}
    speed, position, autocorrelation, friction = (list[Panel]() for _ in range(4))
    lag = [1e3 * one for one in judgement.lag]
    shares = 100.0 * np.array(judgement.friction_over_time or [], dtype=np.float64)
    # One scale for all joints, which does not exaggerate small changes.
    reach = max(2.0, 1.15 * np.abs(shares[np.isfinite(shares)]).max(initial=0.0))
    for j, joint in enumerate(judgement.joints):
        angle = "rad" if joint.unit == "N·m" else "m"
        for panels, what, unit, profile in (
            (speed, "speed", f"{angle}/s", judgement.speed[j]),
            (position, "position", angle, judgement.position[j]),
        ):
            mean, std = np.array(profile.mean, np.float64), np.array(profile.std, np.float64)
            if not np.isfinite(mean + std).any():
                continue
            note = f"RMS error {significant(joint.rms)} {joint.unit}"
            caption = Caption(f"{what[0]}{j}", joint.joint, note, f"mean residual over {what}")
            heading, foot = f"mean residual [{joint.unit}]", f"{what} [{unit}]"
            with panel(panels, 170.0, caption, heading, foot) as axes:
                axes.axhspan(-joint.rms, joint.rms, color=BAND, linewidth=0.0)
                axes.axhline(0.0, color=MUTED, linewidth=0.9)
                # NaN interrupts the line at empty bins.
                axes.errorbar(
                    profile.centre, mean, yerr=_INTERVAL * std, color=FIRST, marker="o",
                    markersize=4.5, linewidth=1.2, elinewidth=1.2, capsize=2.5,
                )  # fmt: skip
                ruled(axes, "both", x_ticks=6)
        column = judgement.autocorrelation[j]
        values = [value for value in column if value is not None]
        if len(values) == len(column):
            note = f"equivalent to {judgement.effective_rows[j]:.0f} independent samples"
            caption = Caption(f"w{j}", joint.joint, note, "autocorrelation of the residual")
            heading = "autocorrelation of the residual"
            with panel(autocorrelation, 170.0, caption, heading, "lag [ms]") as axes:
                axes.axhline(0.0, color=MUTED, linewidth=0.9)
                axes.plot(lag, values, color=FIRST, linewidth=1.4)
                axes.set_xlim(0.0, lag[-1])
                axes.set_ylim(min(-0.25, *values), 1.05)
                ruled(axes, "both", x_ticks=6)
        there = np.flatnonzero(np.isfinite(shares[j])) if j < len(shares) else np.empty(0, np.intp)
        if there.size:
            axis = "friction minus estimate [%]", "recording, or equal part of one, in order"
            caption = Caption(f"f{j}", joint.joint, "", "friction over the recordings")
            with panel(friction, 150.0, caption, *axis) as axes:
                axes.axhline(0.0, color=MUTED, linewidth=0.9)
                axes.plot(there + 1, shares[j, there], color=SECOND, marker="s", markersize=4.0)
                axes.set_xlim(0.5, shares.shape[1] + 0.5)
                axes.set_ylim(-reach, reach)
                ruled(axes, "both", x_ticks=min(6, max(2, shares.shape[1])))
    return {
        "speed_panels": speed,
        "position_panels": position,
        "autocorrelation_panels": autocorrelation,
        "friction_panels": friction,
    }


_FREQUENCY_TICKS: Final = [m * 10.0**e for e in range(-2, 5) for m in (1, 3)]
_DEEPEST: Final = 1e-5  # of the highest, below which is rounding noise


def spectrum_panels(series: ReportSeries, joints: Sequence[Joint]) -> list[Panel]:
    """Draw amplitude spectra of measured torque and residual of each joint on the example."""
    panels: list[Panel] = []
    frequency = series.spectrum_frequency
    for j, name, unit, _ in joints if frequency.size > 1 else ():
        torque, residual = series.spectrum_torque[:, j], series.spectrum_residual[:, j]
        if torque.max() <= 0.0:
            continue
        bandwidth = float(series.motion_bandwidth[j]) if series.motion_bandwidth.size else np.nan
        highest = float(max(torque.max(), residual.max()))
        lowest = max(float(min(torque.min(), residual.min())), _DEEPEST * highest)
        caption = Caption(f"w{j}s", name, "", "amplitude spectra of torque and residual")
        with panel(panels, 190.0, caption, f"amplitude [{unit}/√Hz]", "frequency [Hz]") as axes:
            axes.set_xscale("log")
            axes.set_yscale("log")
            axes.plot(frequency, torque, color=WIDE, linewidth=3.0, solid_joinstyle="round")
            axes.plot(frequency, residual, color=SECOND, linewidth=1.2)
            if frequency[0] < bandwidth < frequency[-1]:
                axes.axvline(bandwidth, color=MUTED, linewidth=1.1, linestyle=DASHED)
            axes.set_xlim(float(frequency[0]), float(frequency[-1]))
            axes.set_ylim(lowest / 1.5, highest * 1.5)
            ticks = [tick for tick in _FREQUENCY_TICKS if frequency[0] <= tick <= frequency[-1]]
            log_ticks(axes.xaxis, FixedLocator(ticks))
            log_ticks(axes.yaxis, LogLocator(numticks=6))
            axes.grid(True, color=GRID, linewidth=0.8)
    return panels


def error_boxes(results: Results) -> list[Panel]:
    """Draw mean |e| of the validation runs of each joint; [] for fewer than two runs."""
    every = np.array([run.mean_abs_error for run in results.validation])
    if len(every) < 2 or not np.isfinite(every).any(axis=0).all():
        return []
    panels = []
    for j, name in enumerate(results.joint_names):
        errors = every[np.isfinite(every[:, j]), j]
        middle, most = (significant(float(one)) for one in (np.median(errors), errors.max()))
        note = f"median {middle} N·m, largest {most} N·m"
        caption = Caption(f"b{j}", name, note, f"mean |e| of {errors.size} runs")
        expected = MEAN_ABS_OF_NORMAL * results.noise_std[j]
        panels.append(box_panel(caption, [errors], [FIRST], "mean |e| [N·m]", level=expected))
    return panels


# Correlation

_LABELS, _SCALE = 84.0, 78.0
_SIDE: Final = 560.0
_SMALLEST_CELL, _LARGEST_CELL = 11.0, 26.0


def correlation_matrix(results: Results) -> Panel | None:
    """Draw |Ψ_ij| / sqrt(Ψ_ii Ψ_jj) of the base parameters, 0 white, 1 black (paper, Fig. 2)."""
    n = results.n_base
    if n == 0:
        return None
    matrix = np.array(results.correlation, dtype=np.float64)[:n, :n]
    return matrix_panel(matrix, [p.label for p in results.parameters[:n]], "c", "Base parameters")


def matrix_panel(matrix: Array, labels: Sequence[str], key: str, title: str) -> Panel:
    """Draw |ρ| of a normalised matrix (n, n), one label for each row."""
    n, matrix = len(labels), np.abs(matrix)
    names = [label(text) for text in labels]
    note = f"{int(np.sum(np.triu(matrix, 1) > 0.9))} of {n * (n - 1) // 2} pairs above 0.9"
    cell = min(max(_SIDE / n, _SMALLEST_CELL), _LARGEST_CELL)
    side, size = n * cell, min(TICK_SIZE, 0.76 * cell)
    with drawing():
        figure = blank(_LABELS + side + _SCALE, _LABELS + side + 6.0)
        axes = place(figure, _LABELS, _LABELS, side, side)
        axes.imshow(matrix, cmap="gray_r", vmin=0.0, vmax=1.0, interpolation="none", aspect="auto")
        axes.xaxis.tick_top()
        axes.set_xticks(range(n))
        axes.set_xticklabels(
            names, rotation=90, rotation_mode="anchor", ha="left", va="center", fontsize=size
        )
        axes.set_yticks(range(n))
        axes.set_yticklabels(names, fontsize=size)
        axes.tick_params(length=0.0, pad=4.0)
        _bordered(axes, MUTED)
        scale = place(figure, _LABELS + side + 22.0, _LABELS, 14.0, min(side, 200.0))
        shade_scale(scale)
        scale.set_title("|ρ|", fontsize=TICK_SIZE, color=MUTED, pad=6.0)
        what = f"absolute correlation between {n} base parameters, white for 0 and black for 1"
        return to_panel(figure, Caption(key, title, note, what))


def shade_scale(axes: Axes, ink: str = INK, muted: str = MUTED) -> None:
    """Draw the grey scale as one image; a colour bar would be 256 rectangles."""
    shades = np.linspace(1.0, 0.0, 64)[:, None]
    axes.imshow(
        shades, cmap="gray_r", vmin=0.0, vmax=1.0, aspect="auto", extent=(0.0, 1.0, 0.0, 1.0)
    )
    axes.set_xticks([])
    axes.yaxis.tick_right()
    axes.set_yticks([0.0, 0.5, 1.0])
    axes.set_yticklabels(["0", "0.5", "1"], color=ink)
    _bordered(axes, muted)


def _bordered(axes: Axes, colour: str) -> None:
    for spine in axes.spines.values():
        spine.set_visible(True)
        spine.set_color(colour)
