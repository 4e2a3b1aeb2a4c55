"""How far models stray in a replay."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hil.report import numbers
from hil.report.figures.canvas import footed, headed, plot_panel, ruled, thinned
from hil.report.figures.palette import BAND, INK, SECOND
from hil.report.figures.svg import Panel, drawing, to_panel
from hil.report.series import ReportSeries
from hil.report.validation import TorqueError

_BAND_POINTS = 400


def replay_panels(series: ReportSeries, joints: Sequence[TorqueError]) -> list[Panel]:
    """Position error of each joint over time; none where nothing was simulated."""
    if series.replay_time.size < 2:
        return []
    return [_joint(j, series, one) for j, one in enumerate(joints)]


def _joint(j: int, series: ReportSeries, joint: TorqueError) -> Panel:
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
        footed(axes, "time [s]")
        alt = f"{joint.joint}: simulated less recorded position, {rms} {unit} rms."
        return to_panel(figure, key=f"q{j}r", title=joint.joint, note=f"{rms} {unit} rms", alt=alt)
