"""Position and velocity of every joint of a designed motion against their limits."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from hil.cell import AngleFrame
from hil.plots import style
from hil.report.figures.canvas import thinned
from planner import JointLimits, Trajectory

Array = NDArray[np.float64]

_SAMPLES = 4000
_MARGIN = 0.1
_LETTERS = 12
"""As many as a line along a row's height takes."""
_NAME = 0.4
"""inch from the axes to the name, which leaves room for the limits' numbers."""


def draw_motion(
    rows: Sequence[Sequence[Axes]],
    trajectory: Trajectory,
    limits: JointLimits,
    joint_names: Sequence[str],
    frame: AngleFrame,
    postures: Array,
) -> None:
    """Draw one row per joint: position and velocity over a time axis that all share.

    Args:
        rows: two axes per joint.
        trajectory: what to draw.
        limits: its limits, URDF angles.
        joint_names: one per joint.
        frame: which angles to show.
        postures: times that are numbered (k,) [s].
    """
    time = np.linspace(0.0, trajectory.duration, _SAMPLES)
    q, qd, _ = trajectory.sample(time)
    ends = np.sort([frame.shown(limits.lower), frame.shown(limits.upper)], axis=0)
    fastest = np.degrees(limits.velocity)
    for joint, (name, (position, velocity)) in enumerate(zip(joint_names, rows, strict=True)):
        for axes, values, low, high, colour in (
            (position, frame.shown(q), ends[0], ends[1], style.POSITION),
            (velocity, frame.shown_rate(qd), -fastest, fastest, style.VELOCITY),
        ):
            _against_limits(axes, values[:, joint], float(low[joint]), float(high[joint]))
            for at in postures:
                axes.axvline(at, color=style.RULE, linewidth=0.8)
            axes.plot(*thinned(time, values[:, joint], 400), color=colour, linewidth=1.1)
            axes.set_xlim(0.0, trajectory.duration)
            axes.tick_params(labelbottom=joint == len(rows) - 1, length=2.0, pad=2.0)
            style.bare(axes)
            axes.grid(False, axis="x")
        _name(position, broken(name))
    titles = (f"position [deg, {frame.name} angles]", "velocity [deg/s]")
    for axes, title in zip(rows[0], titles, strict=True):
        axes.set_title(title, loc="left", color=style.MUTED, pad=13.0)
        _number(axes, postures)
    for axes in rows[-1]:
        axes.set_xlabel("time [s]")


def _name(axes: Axes, name: str) -> None:
    """Write a name as far from the axes as all others, whatever their width."""
    size = style.TEXT if "\n" not in name else style.TEXT - 1.0
    axes.set_ylabel(name, color=style.INK, fontsize=size)
    width = axes.bbox.width / axes.figure.dpi
    axes.yaxis.set_label_coords(-_NAME / width, 0.5)


def broken(name: str) -> str:
    """Return a joint's name in at most two lines, none longer than a row of the page is high.

    What does not fit is left out of the middle: beginnings and ends tell joints apart.
    """
    name = "".join(c if c.isprintable() else " " for c in name).strip()
    if len(name) <= _LETTERS:
        return name
    ends = [match.end() for match in re.finditer(r"[_\W]+", name)]
    fitting = [end for end in ends if end <= _LETTERS and end < len(name)]
    if not fitting:
        return _shortened(name)
    at = fitting[-1]
    return f"{name[:at].rstrip()}\n{_shortened(name[at:])}"


def _shortened(text: str) -> str:
    half = (_LETTERS - 1) // 2
    return text if len(text) <= _LETTERS else f"{text[:half]}…{text[half + 1 - _LETTERS :]}"


def _against_limits(axes: Axes, values: Array, low: float, high: float) -> None:
    """Show both limits, and all of the values even where they go beyond."""
    for bound in (low, high):
        axes.axhline(bound, color=style.LIMIT, linewidth=0.9, linestyle=(0, (5, 2)))
    bottom, top = min(low, float(values.min())), max(high, float(values.max()))
    room = _MARGIN * (top - bottom)
    axes.set_ylim(bottom - room, top + room)
    middle = 0.0 if low < 0.0 < high else (low + high) / 2.0
    apart = min(abs(middle - low), abs(high - middle)) > 2.0 * room
    axes.set_yticks([low, middle, high] if apart else [low, high])
    axes.yaxis.set_major_formatter("{x:.4g}")


def _number(axes: Axes, postures: Array) -> None:
    for number, at in enumerate(postures, 1):
        axes.annotate(
            str(number),
            (at, 1.0),
            xycoords=("data", "axes fraction"),
            xytext=(0.0, 2.0),
            textcoords="offset points",
            ha="center",
            fontsize=style.SMALL,
            fontweight="bold",
            color=style.INK,
            annotation_clip=False,
        )
