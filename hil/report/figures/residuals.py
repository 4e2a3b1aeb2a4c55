"""What the residual follows: speed, position, time, frequency; and the errors of all runs."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FixedLocator, LogLocator
from numpy.typing import NDArray

from hil.report import numbers
from hil.report.figures.canvas import (
    BAND,
    FIRST,
    GRID,
    MUTED,
    SECOND,
    WIDE,
    blank,
    boxed,
    footed,
    headed,
    log_ticks,
    place,
    plot_panel,
    ruled,
)
from hil.report.figures.svg import Panel, drawing, to_panel
from hil.report.series import ReportSeries
from hil.report.validation import TorqueError
from hil.results import JudgementResult, ProfileResult, Results

_HEIGHT = 170.0
# Half a 95 % interval, in standard errors.
_INTERVAL = 1.96


def speed_panels(judgement: JudgementResult) -> list[Panel]:
    """Mean residual of each joint over its own speed."""
    return _profile_panels(judgement, judgement.speed, "s", "speed", "/s")


def position_panels(judgement: JudgementResult) -> list[Panel]:
    """Mean residual of each joint over its own position."""
    return _profile_panels(judgement, judgement.position, "p", "position", "")


def _profile_panels(
    judgement: JudgementResult,
    profiles: Sequence[ProfileResult],
    key: str,
    what: str,
    per: str,
) -> list[Panel]:
    panels = []
    for j, (profile, joint) in enumerate(zip(profiles, judgement.joints, strict=True)):
        known = [
            (at, mean, std)
            for at, mean, std in zip(profile.centre, profile.mean, profile.std, strict=True)
            if mean is not None and std is not None
        ]
        if not known:
            continue
        unit = ("rad" if joint.unit == "N·m" else "m") + per
        at, worst, _ = max(known, key=lambda one: abs(one[1]))
        note = f"RMS error {numbers.significant(joint.rms)} {joint.unit}"
        alt = (
            f"{joint.joint}: mean residual over {what}, at most {numbers.significant(worst)}"
            f" {joint.unit} at {numbers.significant(at)} {unit}; {note}."
        )
        with drawing():
            figure, axes = plot_panel(_HEIGHT)
            _profile(axes, profile, joint.rms)
            headed(axes, f"mean residual [{joint.unit}]")
            footed(axes, f"{what} [{unit}]")
            panels.append(to_panel(figure, key=f"{key}{j}", title=joint.joint, note=note, alt=alt))
    return panels


def _profile(axes: Axes, profile: ProfileResult, rms: float) -> None:
    # The joint's RMS error, so that a pattern is seen beside all that is left over.
    axes.axhspan(-rms, rms, color=BAND, linewidth=0.0)
    axes.axhline(0.0, color=MUTED, linewidth=0.9)
    # No line across a bin that was not seen.
    means = [math.nan if mean is None else mean for mean in profile.mean]
    errors = [math.nan if std is None else _INTERVAL * std for std in profile.std]
    axes.errorbar(
        profile.centre,
        means,
        yerr=errors,
        color=FIRST,
        marker="o",
        markersize=4.5,
        linewidth=1.2,
        elinewidth=1.2,
        capsize=2.5,
    )
    ruled(axes, "both", x_ticks=6)


def autocorrelation_panels(judgement: JudgementResult) -> list[Panel]:
    """Autocorrelation of each joint's residual."""
    panels = []
    milliseconds = [1e3 * lag for lag in judgement.lag]
    rows = zip(
        judgement.autocorrelation,
        judgement.joints,
        judgement.effective_rows,
        strict=True,
    )
    for j, (column, joint, worth) in enumerate(rows):
        if any(value is None for value in column):
            continue
        values = [value for value in column if value is not None]
        note = f"worth {worth:.0f} independent samples"
        with drawing():
            figure, axes = plot_panel(_HEIGHT)
            axes.axhline(0.0, color=MUTED, linewidth=0.9)
            axes.plot(milliseconds, values, color=FIRST, linewidth=1.4)
            axes.set_xlim(0.0, milliseconds[-1])
            axes.set_ylim(min(-0.25, *values), 1.05)
            ruled(axes, "both", x_ticks=6)
            headed(axes, "autocorrelation of the residual")
            footed(axes, "lag [ms]")
            alt = f"{joint.joint}: autocorrelation of the residual up to {milliseconds[-1]:.0f} ms"
            panels.append(
                to_panel(
                    figure,
                    key=f"w{j}",
                    title=joint.joint,
                    note=note,
                    alt=f"{alt}; {note}.",
                )
            )
    return panels


def friction_panels(judgement: JudgementResult) -> list[Panel]:
    """Friction of each joint beside the estimate, recording by recording."""
    panels: list[Panel] = []
    shares = judgement.friction_over_time
    if shares is None:
        return panels
    known = [abs(value) for row in shares for value in row if value is not None]
    # The same scale for all, and never one that makes a change of nothing look like much.
    reach = 100.0 * max(0.02, 1.15 * max(known, default=0.0))
    for j, (row, joint) in enumerate(zip(shares, judgement.joints, strict=True)):
        points = [(k, 100.0 * v) for k, v in enumerate(row, 1) if v is not None]
        if not points:
            continue
        with drawing():
            figure, axes = plot_panel(150.0)
            _friction(axes, points, len(row), reach)
            first, last = points[0][1], points[-1][1]
            alt = f"{joint.joint}: friction, from {first:+.1f} % to {last:+.1f} % of the estimate."
            panels.append(to_panel(figure, key=f"f{j}", title=joint.joint, note="", alt=alt))
    return panels


def _friction(axes: Axes, points: list[tuple[int, float]], count: int, reach: float) -> None:
    axes.axhline(0.0, color=MUTED, linewidth=0.9)
    axes.plot(
        *zip(*points, strict=True),
        color=SECOND,
        marker="s",
        markersize=4.0,
        linewidth=1.2,
    )
    axes.set_xlim(0.5, count + 0.5)
    axes.set_ylim(-reach, reach)
    ruled(axes, "both", x_ticks=min(6, max(2, math.ceil(count))))
    headed(axes, "friction beside the estimate [%]")
    footed(axes, "recording, or equal part of one, in order")


Array = NDArray[np.float64]

_FREQUENCY_TICKS = [m * 10.0**e for e in range(-2, 5) for m in (1, 3)]
_DEEPEST = 1e-5  # of the highest: below it lies rounding


def spectrum_panels(series: ReportSeries, joints: Sequence[TorqueError]) -> list[Panel]:
    """Amplitude spectra of measured torque and residual of each joint on the example."""
    if series.spectrum_frequency.size < 2:
        return []
    return [
        _spectrum_panel(j, series, one)
        for j, one in enumerate(joints)
        if series.spectrum_torque[:, j].max() > 0.0
    ]


def _spectrum_panel(j: int, series: ReportSeries, joint: TorqueError) -> Panel:
    frequency = series.spectrum_frequency
    torque, residual = series.spectrum_torque[:, j], series.spectrum_residual[:, j]
    bandwidth = float(series.motion_bandwidth[j]) if series.motion_bandwidth.size else np.nan
    note = ""
    if frequency[0] < bandwidth < frequency[-1]:
        share = _above(frequency, residual**2, bandwidth)
        limit = numbers.significant(bandwidth, 2)
        note = f"{100.0 * share:.0f} % of the residual’s power above {limit} Hz"
    alt = f"{joint.joint}: spectra of torque and residual up to {frequency[-1]:.0f} Hz"
    alt += f"; {note}." if note else "."
    highest = float(max(torque.max(), residual.max()))
    lowest = max(float(min(torque.min(), residual.min())), _DEEPEST * highest)
    with drawing():
        figure, axes = plot_panel(190.0)
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.plot(frequency, torque, color=WIDE, linewidth=3.0, solid_joinstyle="round")
        axes.plot(frequency, residual, color=SECOND, linewidth=1.2)
        if frequency[0] < bandwidth < frequency[-1]:
            axes.axvline(bandwidth, color=MUTED, linewidth=1.1, linestyle=(0, (4, 3)))
        axes.set_xlim(float(frequency[0]), float(frequency[-1]))
        axes.set_ylim(lowest / 1.5, highest * 1.5)
        ticks = [tick for tick in _FREQUENCY_TICKS if frequency[0] <= tick <= frequency[-1]]
        log_ticks(axes.xaxis, FixedLocator(ticks))
        log_ticks(axes.yaxis, LogLocator(numticks=6))
        axes.grid(True, color=GRID, linewidth=0.8)
        headed(axes, f"amplitude [{joint.unit}/√Hz]")
        footed(axes, "frequency [Hz]")
        return to_panel(figure, key=f"w{j}s", title=joint.joint, note=note, alt=alt)


def _above(frequency: Array, power: Array, limit: float) -> float:
    """Share of the power (f,) that lies above a frequency."""
    upper = frequency > limit
    whole = float(np.trapezoid(power, frequency))
    return float(np.trapezoid(power[upper], frequency[upper])) / whole if whole else 0.0


_BOX_WIDTH, _BOX_HEIGHT = 190.0, 226.0
_FEWEST_FOR_A_BOX = 5  # quartiles of fewer are nearly the runs themselves

# Mean |e| of normal residuals of standard deviation 1.
MEAN_ABS_OF_NORMAL = math.sqrt(2.0 / math.pi)


def error_boxes(results: Results) -> list[Panel]:
    """Mean |e| of every validation run, one panel and scale per joint; one run has no spread."""
    if len(results.validation) < 2:
        return []
    errors = np.array([run.mean_abs_error for run in results.validation])
    if not np.isfinite(errors).any(axis=0).all():
        return []
    return [
        _box_panel(j, name, errors[:, j], MEAN_ABS_OF_NORMAL * results.noise_std[j])
        for j, name in enumerate(results.joint_names)
    ]


def _box_panel(j: int, name: str, errors: NDArray[np.float64], expected: float) -> Panel:
    errors = errors[np.isfinite(errors)]
    low, middle, high = (float(v) for v in np.percentile(errors, (25.0, 50.0, 75.0)))
    alt = (
        f"{name}: mean absolute torque error of {errors.size} runs, median"
        f" {numbers.significant(middle)} N·m, quartiles {numbers.significant(low)} and"
        f" {numbers.significant(high)}, largest {numbers.significant(float(errors.max()))}."
    )
    with drawing():
        figure = blank(_BOX_WIDTH, _BOX_HEIGHT)
        axes = place(figure, 46.0, 24.0, _BOX_WIDTH - 54.0, _BOX_HEIGHT - 34.0)
        top = max(float(errors.max()), 1e-12)
        if errors.size >= _FEWEST_FOR_A_BOX:
            # Every run is a dot of its own.
            boxed(axes, [errors], 0.55, showfliers=False)
        axes.scatter(
            _spread(errors), errors, s=16.0, color=FIRST, alpha=0.85, linewidths=0.0, zorder=3
        )
        if math.isfinite(expected):
            top = max(top, expected)
            axes.axhline(expected, color=SECOND, linewidth=1.3, linestyle=(0, (4, 3)), zorder=4)
        ruled(axes, "y", y_ticks=5)
        axes.set_xlim(0.4, 1.6)
        axes.set_xticks([])
        axes.set_ylim(0.0, 1.12 * top)
        axes.spines["bottom"].set_visible(False)
        headed(axes, "mean |e| [N·m]")
        note = f"median {numbers.significant(middle)} N·m"
        return to_panel(figure, key=f"b{j}", title=name, note=note, alt=alt)


def _spread(errors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Side steps that keep neighbours in value apart; the golden ratio never lines up."""
    rank = np.argsort(np.argsort(errors, kind="stable"), kind="stable")
    steps = (rank * 0.6180339887498949) % 1.0 - 0.5
    return np.asarray(1.0 + 0.34 * steps, dtype=np.float64)
