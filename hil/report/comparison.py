"""The page that compares campaigns of one arm, and friction by campaign as figures in it."""

from __future__ import annotations

import string

import numpy as np
from matplotlib.axes import Axes

from hil.compare.comparison import AxisChange, Comparison
from hil.compare.payload import LEAST_EFFECT
from hil.compare.spread import FEWEST
from hil.compare.trend import FALSE_ALARMS, LEAST_FRICTION
from hil.report import numbers
from hil.report.drawing import (
    FIRST,
    MUTED,
    OUTSIDE_3,
    WIDE,
    Panel,
    drawing,
    headed,
    label,
    plot_panel,
    ruled,
    to_panel,
)
from hil.report.rendering import environment, page_bytes
from hil.version import software

_SPREAD = 0.24
_LEAST_REACH = 0.1  # of the friction: a scale that makes nothing look like much is none


def comparison_bytes(found: Comparison) -> bytes:
    """The page as one HTML file; the same input gives the same bytes."""
    return page_bytes(render_comparison(found))


def render_comparison(found: Comparison) -> str:
    """The page as text."""
    letters = [_letter(k) for k in range(len(found.campaigns))]
    return (
        environment()
        .get_template("comparison.html.j2")
        .render(
            found=found,
            letters=letters,
            friction_panels=friction_panels(found, letters),
            software=software(),
            rules={
                "fewest": FEWEST,
                "half": f"{50.0 * FALSE_ALARMS:g} %",
                "friction": f"{100.0 * LEAST_FRICTION:g} %",
                "effect": f"{100.0 * LEAST_EFFECT:g} %",
            },
        )
    )


def _letter(k: int) -> str:
    """A, B ... Z, A1, B1 ..."""
    round_, place = divmod(k, len(string.ascii_uppercase))
    return string.ascii_uppercase[place] + (str(round_) if round_ else "")


def friction_panels(found: Comparison, letters: list[str]) -> list[Panel]:
    """Each axis that has friction: single repetitions, and each campaign with its interval."""
    return [
        _panel(axis, j, letters)
        for j, axis in enumerate(found.axes)
        if any(value is not None for value in axis.friction)
    ]


def _panel(axis: AxisChange, j: int, letters: list[str]) -> Panel:
    known = zip(letters, axis.change, axis.p_value, strict=True)
    changes = [
        f"{letter} {100.0 * change:+.1f} %".replace("-", "−")
        for letter, change, p_value in known
        if change is not None and p_value is not None
    ]
    friction, std = (np.array(one, dtype=np.float64) for one in (axis.friction, axis.std))
    values = ", ".join(
        f"{letter} {numbers.significant(value)}"
        for letter, value in zip(letters, friction.tolist(), strict=True)
    )
    alt = f"{axis.joint}: friction in {axis.unit} by campaign: {values}."
    with drawing():
        figure, axes = plot_panel(200.0, left=50.0, right=12.0, bottom=28.0)
        for k, own in enumerate(axis.repetitions):
            if len(own) > 1:
                at = k + _SPREAD * np.linspace(-1.0, 1.0, len(own))
                axes.scatter(at, np.array(own, dtype=float), s=9.0, color=WIDE, linewidths=0.0)
            colour, shape = (OUTSIDE_3, "s") if axis.changed[k] else (FIRST, "o")
            axes.errorbar(
                [k], friction[k], yerr=1.96 * std[k], color=colour, marker=shape, markersize=6.0,
                elinewidth=1.6, capsize=3.0, zorder=4,
            )  # fmt: skip
        axes.axhline(friction[0], color=MUTED, linewidth=0.9, linestyle=(0, (4, 3)))
        _framed(axes, axis, letters, _LEAST_REACH * abs(float(friction[0])))
        note = ", ".join(changes)
        return to_panel(figure, key=f"f{j}", title=label(axis.joint), note=note, alt=alt)


def _framed(axes: Axes, axis: AxisChange, letters: list[str], least: float) -> None:
    ruled(axes, "y")
    axes.set_xlim(-0.6, len(letters) - 0.4)
    axes.set_xticks(range(len(letters)))
    axes.set_xticklabels(letters)
    low, high = axes.get_ylim()
    if np.isfinite(least) and high - low < least:
        middle = 0.5 * (low + high)
        axes.set_ylim(middle - 0.5 * least, middle + 0.5 * least)
    headed(axes, f"friction [{axis.unit}]")
