"""Spectrum of the residual beside that of the torque."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.ticker import FixedLocator, LogLocator
from numpy.typing import NDArray

from hil.report import numbers
from hil.report.figures.canvas import footed, headed, log_ticks, plot_panel
from hil.report.figures.palette import GRID, MUTED, SECOND, WIDE
from hil.report.figures.svg import Panel, drawing, to_panel
from hil.report.series import ReportSeries
from hil.report.validation import TorqueError

Array = NDArray[np.float64]

_TICKS = [m * 10.0**e for e in range(-2, 5) for m in (1, 3)]
_DEEPEST = 1e-5  # of the highest: below it lies rounding


def spectrum_panels(series: ReportSeries, joints: Sequence[TorqueError]) -> list[Panel]:
    """Amplitude spectra of measured torque and residual of each joint on the example."""
    if series.spectrum_frequency.size < 2:
        return []
    return [
        _joint(j, series, one)
        for j, one in enumerate(joints)
        if series.spectrum_torque[:, j].max() > 0.0
    ]


def _joint(j: int, series: ReportSeries, joint: TorqueError) -> Panel:
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
        ticks = [tick for tick in _TICKS if frequency[0] <= tick <= frequency[-1]]
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
