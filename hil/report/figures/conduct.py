"""Friction while the arm warmed up."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from hil.report import numbers
from hil.report.figures.canvas import footed, headed, plot_panel, ruled
from hil.report.figures.palette import FIRST, SECOND
from hil.report.figures.svg import Panel, drawing, label, to_panel
from hil.results import Results

Array = NDArray[np.float64]

_LEAST_SPAN = 0.05  # of the last value: a scale that makes nothing look like much is none


def warm_up_panels(results: Results) -> list[Panel]:
    """Friction of each joint motion by motion, and the change that it was judged by."""
    warm = None if results.conduct is None else results.conduct.warm_up
    if warm is None or len(warm.friction) < 2:
        return []
    friction = np.array(warm.friction, dtype=np.float64)
    panels = [
        _joint(j, name, friction[:, j])
        for j, name in enumerate(results.joint_names[: friction.shape[1]])
        if np.isfinite(friction[:, j]).any()
    ]
    return [*panels, _change(np.array(warm.change, dtype=np.float64), warm.threshold)]


def _joint(j: int, name: str, values: Array) -> Panel:
    known = values[np.isfinite(values)]
    share = known[-1] / known[0] - 1.0 if known[0] else 0.0
    note = f"{numbers.significant(float(known[-1]))} N·m, {100.0 * share:+.1f} %"
    alt = f"{name}: friction over {len(values)} motions of the warm-up; at last {note}."
    with drawing():
        figure, axes = plot_panel(180.0, left=50.0, right=12.0, bottom=42.0)
        axes.plot(np.arange(1, len(values) + 1), values, color=FIRST, marker="o", markersize=3.6)
        low, high = axes.get_ylim()
        least = _LEAST_SPAN * abs(float(known[-1]))
        if high - low < least:
            axes.set_ylim(0.5 * (low + high - least), 0.5 * (low + high + least))
        _framed(axes, "friction [N·m]")
        return to_panel(
            figure, key=f"wu{j}", title=label(name), note=note.replace("-", "−"), alt=alt
        )


def _change(change: Array, threshold: float) -> Panel:
    known = change[np.isfinite(change)]
    last = f"{100.0 * float(known[-1]):.2g} %" if known.size else "unknown"
    note = f"{last}, at most {100.0 * threshold:.2g} % wanted"
    alt = f"Largest change of friction per motion over the warm-up; at last {note}."
    with drawing():
        figure, axes = plot_panel(180.0, left=50.0, right=12.0, bottom=42.0)
        axes.plot(
            np.arange(1, len(change) + 1), 100.0 * change, color=FIRST, marker="o", markersize=3.6
        )
        axes.axhline(100.0 * threshold, color=SECOND, linewidth=1.3, linestyle=(0, (4, 3)))
        top = max(threshold, float(known.max()) if known.size else 0.0)
        axes.set_ylim(0.0, 115.0 * top)
        _framed(axes, "largest change per motion [%]")
        return to_panel(figure, key="wu", title="Change per motion", note=note, alt=alt)


def _framed(axes: Axes, heading: str) -> None:
    ruled(axes, "both")
    axes.xaxis.set_major_locator(MaxNLocator(6, integer=True))
    headed(axes, heading)
    footed(axes, "motion of the warm-up")
