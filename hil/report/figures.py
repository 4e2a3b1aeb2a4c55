"""Figures of the report: panels, one for each joint or stretch of parameters."""

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
    boxed,
    dots,
    drawing,
    footed,
    headed,
    label,
    log_ticks,
    panel,
    place,
    ruled,
    thinned,
    to_panel,
    traces_text,
)
from hil.report.numbers import fixed, percent, significant
from hil.report.series import ReportSeries
from hil.results import (
    FittedResult,
    JointJudgement,
    JudgementResult,
    ProfileResult,
    Results,
    ValidationResult,
)

Array = NDArray[np.float64]

_LEFT, _RIGHT = 46.0, 10.0
_INNER: Final = PANEL_WIDTH - _LEFT - _RIGHT
_POINTS: Final = 1200  # of lines that are smooth
_BAND_POINTS: Final = 400
_INTERVAL: Final = 1.96
"""Half a 95 % interval, in standard errors."""


class Joint(NamedTuple):
    """A joint in figures of the example: its number from 0, name, unit of torque, and its error."""

    number: int
    name: str
    unit: str
    error: str

    @property
    def angle(self) -> str:
        """Unit of its position."""
        return "rad" if self.unit == "N·m" else "m"


def joints_of(results: Results) -> list[Joint]:
    """Joints with their errors on the example: the first run, or what was fitted."""
    units = [joint.unit for joint in results.judgement.joints] if results.judgement else []
    example: ValidationResult | FittedResult | None = None
    if results.validation:
        example = results.validation[0]
    elif len(results.repetitions) == 1:
        example = results.fitted

    def error(j: int) -> str:
        if example is None:
            return ""
        words = f"error {percent(example.relative_error[j])} %"
        if example.all_rows_joint_errors:
            words += f", every row {percent(example.all_rows_joint_errors[j])} %"
        return words

    return [
        Joint(j, name, units[j] if units else "N·m", error(j))
        for j, name in enumerate(results.joint_names)
    ]


# Over time


def excitation_panels(series: ReportSeries, joint_names: Sequence[str]) -> list[Panel]:
    """Position and velocity of each joint (the paper's Fig. 1)."""
    time = series.excitation_time - series.excitation_time[0]
    panels = []
    for j, name in enumerate(joint_names):
        position, velocity = series.excitation_position[:, j], series.excitation_velocity[:, j]
        low, high = float(np.min(position)), float(np.max(position))
        fastest = float(np.max(np.abs(velocity)))
        ends = (fixed(float(np.degrees(end)), 0) for end in (low, high))
        degrees = "{}° to {}°".format(*ends).replace("-", "−")
        alt = (
            f"{name}: position between {significant(low)} and {significant(high)} rad,"
            f" speed up to {significant(fastest)} rad/s, over {significant(float(time[-1]))} s."
        )
        shaded = _left_out(time, series.excitation_fitted, j)
        plots = (
            _plot(20.0, 78.0, "position [rad]", [Trace(position, FIRST, 1.5, "q")], shaded),
            _plot(122.0, 78.0, "velocity [rad/s]", [Trace(velocity, SECOND, 1.5, "v")], shaded),
        )
        note = f"{degrees}, up to {np.degrees(fastest):.0f} °/s"
        words = {"key": f"x{j}", "title": name, "note": note, "alt": alt}
        panels.append(time_panel(240.0, time, plots, _POINTS, **words))
    return panels


def torque_panels(series: ReportSeries, joints: Sequence[Joint]) -> list[Panel]:
    """Measured and predicted torque of each joint, and their difference (the paper's Fig. 4)."""
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
        length = significant(float(time[-1]))
        alt = f"{name}: measured and predicted torque over {length} s; {error}."
        words = {"key": f"t{j}", "title": name, "note": error, "alt": alt}
        panels.append(time_panel(262.0, time, plots, MOST_POINTS, **words))
    return panels


PARTS: Final = (
    ("gravity", ROUTES[0], 1.6),
    ("inertia", FIRST, 1.2),
    ("coriolis", ROUTES[3], 1.2),
    ("friction", SECOND, 1.2),
)
"""Parts of a predicted torque with their colours and widths, the lowest line first."""


def split_panels(series: ReportSeries, joints: Sequence[Joint]) -> list[Panel]:
    """Predicted torque of each joint split, and the measured one behind it."""
    if series.example_time.size == 0 or series.example_gravity.size == 0:
        return []
    time = series.example_time - series.example_time[0]
    panels = []
    for j, name, unit, _ in joints:
        parts = {part: getattr(series, f"example_{part}")[:, j] for part, _, _ in PARTS}
        sizes = {part: float(np.sqrt(np.mean(one**2))) for part, one in parts.items()}
        rms = ", ".join(f"{part} {significant(size, 2)}" for part, size in sizes.items())
        largest = max(sizes, key=lambda part: sizes[part])
        lines = [Trace(series.example_measured[:, j], WIDE, 4.0, "measured")]
        lines += [Trace(parts[part], colour, width, part) for part, colour, width in PARTS]
        shaded = _left_out(time, series.example_used, j)
        plot = _plot(20.0, 140.0, f"torque [{unit}]", lines, shaded)
        words = {
            "note": f"largest: {largest}, RMS {significant(sizes[largest])} {unit}",
            "alt": f"{name}: parts of the predicted torque; RMS of {rms} {unit}.",
        }
        panels.append(time_panel(200.0, time, (plot,), _POINTS, key=f"g{j}", title=name, **words))
    return panels


def _plot(
    top: float,
    height: float,
    heading: str,
    traces: Sequence[Trace],
    shaded: Sequence[tuple[float, float]],
) -> Plot:
    """A plot of the panels' width at its place below their upper edge [px]."""
    return Plot((_LEFT, top, _INNER, height), heading, traces, shaded=shaded)


def time_panel(
    height: float, time: Array, plots: Sequence[Plot], points: int, **words: str
) -> Panel:
    """Plots over the same time, one above the other, with their samples to zoom into."""
    with drawing():
        figure = blank(PANEL_WIDTH, height)
        for k, plot in enumerate(plots):
            axes = place(figure, *plot.box)
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
            values = np.array([(np.min(one.values), np.max(one.values)) for one in plot.traces])
            if values.min() < 0.0 < values.max():
                axes.axhline(0.0, color=MUTED, linewidth=0.8, zorder=1.5)
            ruled(axes, "both", x_ticks=6, y_ticks=3 if k else 4)
            axes.set_xlim(0.0, max(float(time[-1]), 1e-9))
            axes.tick_params(labelbottom=plot is plots[-1])
        footed(axes, "time [s]")
        return to_panel(figure, traces=traces_text(time, plots, points=points), **words)


def _left_out(time: Array, used: Array, joint: int) -> Sequence[tuple[float, float]]:
    """Stretches of time (m,) in which rows (m, n) of a joint are zero, to midway to the next."""
    if used.size == 0:
        return ()
    out = np.concatenate([[False], used[:, joint] < 0.5, [False]])
    edges = np.concatenate([time[:1], 0.5 * (time[1:] + time[:-1]), time[-1:]])
    changes = edges[np.flatnonzero(np.diff(out.astype(np.int8)))].tolist()
    return tuple(zip(changes[::2], changes[1::2], strict=True))


def replay_panels(series: ReportSeries, joints: Sequence[Joint]) -> list[Panel]:
    """Position error of each joint over time; none where nothing was simulated."""
    time = series.replay_time
    if time.size < 2:
        return []
    panels: list[Panel] = []
    for j, name, torque, _ in joints:
        error, unit = np.nan_to_num(series.replay_error[:, j]), "°" if torque == "N·m" else "mm"
        rms = f"{significant(float(np.sqrt(np.mean(error**2))), 2)} {unit} rms"
        caption = Caption(f"q{j}r", name, rms, f"{name}: simulated less recorded position, {rms}.")
        with panel(panels, 170.0, caption, f"position error [{unit}]", "time [s]") as axes:
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
    return panels


# Friction

_HEIGHT, _TOP, _BOTTOM = 210.0, 20.0, 40.0
_TURN, _GAP = 74.0, 22.0
_ROOM: Final = 0.08
# Points far beyond all others (a stop, a knock) may leave the axes.
_SHOWN: Final = (0.5, 99.5)


def friction_curve_panels(series: ReportSeries, joints: Sequence[Joint]) -> list[Panel]:
    """Friction law of each joint through zero, with the data behind it."""
    if series.law_speed.size == 0:
        return []
    return [_curve(series, one) for one in joints if np.ptp(series.law_speed[:, one.number])]


def _curve(series: ReportSeries, joint: Joint) -> Panel:
    j, per = joint.number, joint.angle
    law_speed, law = series.law_speed[:, j], series.law_torque[:, j]
    speed, torque = _known(series.friction_speed, series.friction_torque, j)
    travel, turning = _known(series.reversal_travel, series.reversal_torque, j)
    fast = [significant(float(end)) for end in law[[0, -1]]]
    note = f"{fast[0]} to {fast[1]} {joint.unit}".replace("-", "−")
    ends = [
        f"{end} {joint.unit} at {significant(float(at))} {per}/s"
        for end, at in zip(fast, law_speed[[0, -1]], strict=True)
    ]
    alt = f"{joint.name}: friction from {' to '.join(ends)}"
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
        if travel.size:  # dry friction that turns round, to the scale of the curve over speed
            turn = place(figure, _LEFT + wide + _GAP, _TOP, _TURN, height)
            turn.axhline(0.0, color=MUTED, linewidth=0.8)
            turn.plot(1e3 * travel, turning, color=SECOND, linewidth=1.8)
            turn.set_xlim(0.0, 1e3 * float(travel[-1]))
            turn.set_ylim(axes.get_ylim())
            ruled(turn, "both", x_ticks=2)
            turn.tick_params(labelleft=False)
            headed(turn, "at reversal")
            footed(turn, f"travel [m{per}]")
            alt += f"; at a reversal over {significant(float(travel[-1]), 2)} {per}"
        return to_panel(figure, key=f"k{j}", title=joint.name, note=note, alt=f"{alt}.")


def _known(horizontal: Array, vertical: Array, j: int) -> tuple[Array, Array]:
    """Column j of both, without what is not there."""
    if horizontal.size == 0:
        return np.empty(0), np.empty(0)
    there = np.isfinite(horizontal[:, j]) & np.isfinite(vertical[:, j])
    return horizontal[there, j], vertical[there, j]


_LEAST_SPAN: Final = 0.05  # of the last value: a scale that makes nothing look like much is none


def warm_up_panels(results: Results) -> list[Panel]:
    """Friction of each joint motion by motion, and the change that it was judged by."""
    warm = None if results.conduct is None else results.conduct.warm_up
    if warm is None or len(warm.friction) < 2:
        return []
    panels: list[Panel] = []
    friction = np.array(warm.friction, dtype=np.float64)
    for j, name in enumerate(results.joint_names[: friction.shape[1]]):
        known = friction[np.isfinite(friction[:, j]), j]
        if not known.size:
            continue
        share = known[-1] / known[0] - 1.0 if known[0] else 0.0
        note = f"{significant(float(known[-1]))} N·m, {100.0 * share:+.1f} %"
        alt = f"{name}: friction over {len(friction)} motions of the warm-up; at last {note}."
        caption = Caption(f"wu{j}", label(name), note.replace("-", "−"), alt)
        with _warm_up(panels, friction[:, j], caption, "friction [N·m]") as axes:
            low, high = axes.get_ylim()
            least = _LEAST_SPAN * abs(float(known[-1]))
            if high - low < least:
                axes.set_ylim(0.5 * (low + high - least), 0.5 * (low + high + least))
    change = np.array(warm.change, dtype=np.float64)
    known = change[np.isfinite(change)]
    last = f"{100.0 * float(known[-1]):.2g} %" if known.size else "unknown"
    note = f"{last}, at most {100.0 * warm.threshold:.2g} % wanted"
    alt = f"Largest change of friction per motion over the warm-up; at last {note}."
    caption = Caption("wu", "Change per motion", note, alt)
    with _warm_up(panels, 100.0 * change, caption, "largest change per motion [%]") as axes:
        axes.axhline(100.0 * warm.threshold, color=SECOND, linewidth=1.3, linestyle=DASHED)
        axes.set_ylim(0.0, 115.0 * max(warm.threshold, known.max(initial=0.0)))
    return panels


@contextmanager
def _warm_up(panels: list[Panel], values: Array, caption: Caption, heading: str) -> Iterator[Axes]:
    """Values motion by motion."""
    room, foot = {"left": 50.0, "right": 12.0, "bottom": 42.0}, "motion of the warm-up"
    with panel(panels, 180.0, caption, heading, foot, **room) as axes:
        axes.plot(np.arange(1, len(values) + 1), values, color=FIRST, marker="o", markersize=3.6)
        yield axes
        ruled(axes, "both")
        axes.xaxis.set_major_locator(MaxNLocator(6, integer=True))


# What the residual follows


def speed_panels(judgement: JudgementResult) -> list[Panel]:
    """Mean residual of each joint over its own speed."""
    return _profile_panels(judgement.joints, judgement.speed, "s", "speed", "/s")


def position_panels(judgement: JudgementResult) -> list[Panel]:
    """Mean residual of each joint over its own position."""
    return _profile_panels(judgement.joints, judgement.position, "p", "position", "")


def _profile_panels(
    joints: Sequence[JointJudgement],
    profiles: Sequence[ProfileResult],
    key: str,
    what: str,
    per: str,
) -> list[Panel]:
    panels: list[Panel] = []
    for j, (profile, joint) in enumerate(zip(profiles, joints, strict=True)):
        mean, std = np.array(profile.mean, np.float64), np.array(profile.std, np.float64)
        if not np.isfinite(mean + std).any():
            continue
        unit = ("rad" if joint.unit == "N·m" else "m") + per
        worst = int(np.nanargmax(np.abs(np.where(np.isfinite(std), mean, np.nan))))
        note = f"RMS error {significant(joint.rms)} {joint.unit}"
        alt = (
            f"{joint.joint}: mean residual over {what}, at most {significant(float(mean[worst]))}"
            f" {joint.unit} at {significant(profile.centre[worst])} {unit}; {note}."
        )
        caption = Caption(f"{key}{j}", joint.joint, note, alt)
        heading, foot = f"mean residual [{joint.unit}]", f"{what} [{unit}]"
        with panel(panels, 170.0, caption, heading, foot) as axes:
            # The joint's RMS error, so that a pattern is seen beside all that is left over.
            axes.axhspan(-joint.rms, joint.rms, color=BAND, linewidth=0.0)
            axes.axhline(0.0, color=MUTED, linewidth=0.9)
            # No line across a bin that was not seen.
            axes.errorbar(
                profile.centre, mean, yerr=_INTERVAL * std, color=FIRST, marker="o",
                markersize=4.5, linewidth=1.2, elinewidth=1.2, capsize=2.5,
            )  # fmt: skip
            ruled(axes, "both", x_ticks=6)
    return panels


def autocorrelation_panels(judgement: JudgementResult) -> list[Panel]:
    """Autocorrelation of each joint's residual."""
    panels: list[Panel] = []
    lag = [1e3 * one for one in judgement.lag]
    rows = zip(judgement.joints, judgement.autocorrelation, judgement.effective_rows, strict=True)
    for j, (joint, column, worth) in enumerate(rows):
        values = [value for value in column if value is not None]
        if len(values) < len(column):
            continue
        note = f"worth {worth:.0f} independent samples"
        alt = f"{joint.joint}: autocorrelation of the residual up to {lag[-1]:.0f} ms; {note}."
        caption = Caption(f"w{j}", joint.joint, note, alt)
        with panel(panels, 170.0, caption, "autocorrelation of the residual", "lag [ms]") as axes:
            axes.axhline(0.0, color=MUTED, linewidth=0.9)
            axes.plot(lag, values, color=FIRST, linewidth=1.4)
            axes.set_xlim(0.0, lag[-1])
            axes.set_ylim(min(-0.25, *values), 1.05)
            ruled(axes, "both", x_ticks=6)
    return panels


def friction_panels(judgement: JudgementResult) -> list[Panel]:
    """Friction of each joint beside the estimate, recording by recording."""
    panels: list[Panel] = []
    shares = 100.0 * np.array(judgement.friction_over_time or [], dtype=np.float64)
    # The same scale for all, and never one that makes a change of nothing look like much.
    reach = max(2.0, 1.15 * np.abs(shares[np.isfinite(shares)]).max(initial=0.0))
    for j, (row, joint) in enumerate(zip(shares, judgement.joints, strict=False)):
        there = np.flatnonzero(np.isfinite(row))
        if not there.size:
            continue
        first, last = row[there[[0, -1]]]
        alt = f"{joint.joint}: friction, from {first:+.1f} % to {last:+.1f} % of the estimate."
        axis = "friction beside the estimate [%]", "recording, or equal part of one, in order"
        with panel(panels, 150.0, Caption(f"f{j}", joint.joint, "", alt), *axis) as axes:
            axes.axhline(0.0, color=MUTED, linewidth=0.9)
            axes.plot(
                there + 1, row[there], color=SECOND, marker="s", markersize=4.0, linewidth=1.2
            )
            axes.set_xlim(0.5, len(row) + 0.5)
            axes.set_ylim(-reach, reach)
            ruled(axes, "both", x_ticks=min(6, max(2, len(row))))
    return panels


_FREQUENCY_TICKS: Final = [m * 10.0**e for e in range(-2, 5) for m in (1, 3)]
_DEEPEST: Final = 1e-5  # of the highest: below it lies rounding


def spectrum_panels(series: ReportSeries, joints: Sequence[Joint]) -> list[Panel]:
    """Amplitude spectra of measured torque and residual of each joint on the example."""
    panels: list[Panel] = []
    frequency = series.spectrum_frequency
    for j, name, unit, _ in joints if frequency.size > 1 else ():
        torque, residual = series.spectrum_torque[:, j], series.spectrum_residual[:, j]
        if torque.max() <= 0.0:
            continue
        bandwidth = float(series.motion_bandwidth[j]) if series.motion_bandwidth.size else np.nan
        limited = frequency[0] < bandwidth < frequency[-1]
        note = ""
        if limited:
            above, power = frequency > bandwidth, residual**2
            whole = float(np.trapezoid(power, frequency)) or 1.0
            share = float(np.trapezoid(power[above], frequency[above])) / whole
            limit = significant(bandwidth, 2)
            note = f"{100.0 * share:.0f} % of the residual’s power above {limit} Hz"
        alt = f"{name}: spectra of torque and residual up to {frequency[-1]:.0f} Hz"
        alt += f"; {note}." if note else "."
        highest = float(max(torque.max(), residual.max()))
        lowest = max(float(min(torque.min(), residual.min())), _DEEPEST * highest)
        caption = Caption(f"w{j}s", name, note, alt)
        with panel(panels, 190.0, caption, f"amplitude [{unit}/√Hz]", "frequency [Hz]") as axes:
            axes.set_xscale("log")
            axes.set_yscale("log")
            axes.plot(frequency, torque, color=WIDE, linewidth=3.0, solid_joinstyle="round")
            axes.plot(frequency, residual, color=SECOND, linewidth=1.2)
            if limited:
                axes.axvline(bandwidth, color=MUTED, linewidth=1.1, linestyle=DASHED)
            axes.set_xlim(float(frequency[0]), float(frequency[-1]))
            axes.set_ylim(lowest / 1.5, highest * 1.5)
            ticks = [tick for tick in _FREQUENCY_TICKS if frequency[0] <= tick <= frequency[-1]]
            log_ticks(axes.xaxis, FixedLocator(ticks))
            log_ticks(axes.yaxis, LogLocator(numticks=6))
            axes.grid(True, color=GRID, linewidth=0.8)
    return panels


_BOX_WIDTH, _BOX_HEIGHT = 190.0, 226.0
_FEWEST_FOR_A_BOX: Final = 5  # quartiles of fewer are nearly the runs themselves
MEAN_ABS_OF_NORMAL: Final = math.sqrt(2.0 / math.pi)
"""Mean |e| of normal residuals of standard deviation 1."""


def error_boxes(results: Results) -> list[Panel]:
    """Mean |e| of every validation run, one panel and scale per joint; one run has no spread."""
    every = np.array([run.mean_abs_error for run in results.validation])
    if len(every) < 2 or not np.isfinite(every).any(axis=0).all():
        return []
    panels = []
    for j, name in enumerate(results.joint_names):
        errors = every[np.isfinite(every[:, j]), j]
        expected = MEAN_ABS_OF_NORMAL * results.noise_std[j]
        low, middle, high, most = (
            significant(float(v)) for v in np.percentile(errors, (25.0, 50.0, 75.0, 100.0))
        )
        alt = (
            f"{name}: mean absolute torque error of {errors.size} runs, median {middle} N·m,"
            f" quartiles {low} and {high}, largest {most}."
        )
        with drawing():
            figure = blank(_BOX_WIDTH, _BOX_HEIGHT)
            axes = place(figure, 46.0, 24.0, _BOX_WIDTH - 54.0, _BOX_HEIGHT - 34.0)
            top = max(float(errors.max()), 1e-12)
            if errors.size >= _FEWEST_FOR_A_BOX:  # every run is a dot of its own
                boxed(axes, [errors], 0.55, showfliers=False)
            # Side steps that keep neighbours in value apart; the golden ratio never lines up.
            rank = np.argsort(np.argsort(errors, kind="stable"), kind="stable")
            side = 1.0 + 0.34 * ((rank * 0.6180339887498949) % 1.0 - 0.5)
            axes.scatter(side, errors, s=16.0, color=FIRST, alpha=0.85, linewidths=0.0, zorder=3)
            if math.isfinite(expected):
                top = max(top, expected)
                axes.axhline(expected, color=SECOND, linewidth=1.3, linestyle=DASHED, zorder=4)
            ruled(axes, "y", y_ticks=5)
            axes.set_xlim(0.4, 1.6)
            axes.set_xticks([])
            axes.set_ylim(0.0, 1.12 * top)
            axes.spines["bottom"].set_visible(False)
            headed(axes, "mean |e| [N·m]")
            note = f"median {middle} N·m"
            panels.append(to_panel(figure, key=f"b{j}", title=name, note=note, alt=alt))
    return panels


# Correlation

_LABELS, _SCALE = 84.0, 78.0
_SIDE: Final = 560.0
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
    above = f"{int(np.sum(np.triu(matrix, 1) > 0.9))} of {n * (n - 1) // 2} pairs"
    alt = (
        f"Absolute correlation between {n} base parameters, white for 0 and black for 1;"
        f" {above} exceed 0.9."
    )
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
        note = f"{above} above 0.9" if title else ""
        return to_panel(figure, key=key, title=title, note=note, alt=alt)


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
    _bordered(axes, muted)


def _bordered(axes: Axes, colour: str) -> None:
    for spine in axes.spines.values():
        spine.set_visible(True)
        spine.set_color(colour)
