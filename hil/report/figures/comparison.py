"""Friction of each axis in the campaigns that are compared."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes

from hil.compare.comparison import AxisChange, Comparison
from hil.report import numbers
from hil.report.figures.canvas import headed, plot_panel, ruled
from hil.report.figures.palette import FIRST, MUTED, OUTSIDE_3, WIDE
from hil.report.figures.svg import Panel, drawing, label, to_panel

_SPREAD = 0.24
_LEAST_REACH = 0.1  # of the friction: a scale that makes nothing look like much is none


def friction_panels(found: Comparison, letters: list[str]) -> list[Panel]:
    """Each axis that has friction: single repetitions, and each campaign with its interval."""
    return [
        _panel(axis, j, letters)
        for j, axis in enumerate(found.axes)
        if any(np.isfinite(one.value) for one in axis.known)
    ]


def _panel(axis: AxisChange, j: int, letters: list[str]) -> Panel:
    changes = [
        f"{letters[k]} {100.0 * axis.relative(k)[0]:+.1f} %".replace("-", "−")
        for k in range(1, len(axis.known))
        if axis.differences[k] is not None and np.isfinite(axis.p_values[k])
    ]
    values = ", ".join(
        f"{letter} {numbers.significant(one.value)}"
        for letter, one in zip(letters, axis.known, strict=True)
    )
    alt = f"{axis.joint}: friction in {axis.unit} by campaign: {values}."
    with drawing():
        figure, axes = plot_panel(200.0, left=50.0, right=12.0, bottom=28.0)
        for k, one in enumerate(axis.known):
            own = axis.repetitions[k]
            if len(own) > 1:
                at = k + _SPREAD * np.linspace(-1.0, 1.0, len(own))
                axes.scatter(at, own, s=9.0, color=WIDE, linewidths=0.0)
            colour, shape = (OUTSIDE_3, "s") if axis.changed[k] else (FIRST, "o")
            half = 1.96 * one.std
            axes.errorbar(
                [k], [one.value], yerr=[half], color=colour, marker=shape, markersize=6.0,
                elinewidth=1.6, capsize=3.0, zorder=4,
            )  # fmt: skip
        axes.axhline(axis.known[0].value, color=MUTED, linewidth=0.9, linestyle=(0, (4, 3)))
        _framed(axes, axis, letters)
        note = ", ".join(changes)
        return to_panel(figure, key=f"f{j}", title=label(axis.joint), note=note, alt=alt)


def _framed(axes: Axes, axis: AxisChange, letters: list[str]) -> None:
    ruled(axes, "y")
    axes.set_xlim(-0.6, len(letters) - 0.4)
    axes.set_xticks(range(len(letters)))
    axes.set_xticklabels(letters)
    low, high = axes.get_ylim()
    least = _LEAST_REACH * abs(axis.known[0].value)
    if np.isfinite(least) and high - low < least:
        middle = 0.5 * (low + high)
        axes.set_ylim(middle - 0.5 * least, middle + 0.5 * least)
    headed(axes, f"friction [{axis.unit}]")
