"""Picture of a motion or plan: each joint with its limits."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hil.base.arrays import Array
from hil.base.errors import InputError
from hil.base.files import write_atomically
from hil.cell import AngleFrame
from hil.report import picture_style as style
from hil.report.chart import label, thinned
from identification.text import percentage
from planner import JointLimits, Trajectory
from planner.moves import MotionPlan

FORMATS = (".png", ".svg", ".pdf")
_PLOT_SAMPLES = 4000
_LINES = {"flown": "-", "reduced": "--", "stopped": ":"}
_LABEL_LETTERS = 12  # Characters that fit the height of a row
# inch
_FIGURE_WIDTH = 11.0
_ROW_HEIGHT = 1.25
_TOP_MARGIN = 0.95
_BOTTOM_MARGIN = 0.55
_DOTS_PER_INCH = 110


def draw_motion(
    rows: Sequence[Sequence[Axes]],
    trajectory: Trajectory,
    limits: JointLimits,
    joint_names: Sequence[str],
    frame: AngleFrame,
) -> None:
    """Draw a row per joint: position, velocity and, if there is a third column, acceleration.

    Args:
        rows: of axes.
        trajectory: that is drawn.
        limits: URDF angles.
        joint_names: of the rows.
        frame: of the angles that are shown.
    """
    time = np.linspace(0.0, trajectory.duration, _PLOT_SAMPLES)
    q, *rates = trajectory.sample(time)
    ends = np.sort([frame.shown(limits.lower), frame.shown(limits.upper)], axis=0)
    fastest = np.degrees(limits.velocity)
    most = np.degrees(limits.acceleration)
    columns = (
        (f"position [deg, {frame.name} angles]", frame.shown(q), *ends, style.POSITION),
        ("velocity [deg/s]", frame.shown_rate(rates[0]), -fastest, fastest, style.VELOCITY),
        ("acceleration [deg/s²]", frame.shown_rate(rates[1]), -most, most, style.ACCELERATION),
    )
    for joint, (name, row) in enumerate(zip(joint_names, rows, strict=True)):
        for axes, (_, values, low, high, colour) in zip(row, columns, strict=False):
            _against_limits(axes, float(low[joint]), float(high[joint]), values[:, joint])
            axes.plot(*thinned(time, values[:, joint], 400), color=colour, linewidth=1.1)
            axes.set_xlim(0.0, max(trajectory.duration, 1e-9))
            axes.tick_params(labelbottom=joint == len(rows) - 1, length=2.0, pad=2.0)
            axes.grid(False, axis="x")
        row[0].set_ylabel(wrapped(name), color=style.INK)
    for axes, (title, *_) in zip(rows[0], columns, strict=False):
        axes.set_title(title, loc="left", color=style.MUTED, pad=13.0)
    for axes in rows[-1]:
        axes.set_xlabel("time [s]")


def wrapped(name: str) -> str:
    """Return a joint's name in lines that fit the height of a row, broken after underscores."""
    return textwrap.fill(label(name).replace("_", "_ "), _LABEL_LETTERS).replace("_ ", "_")


def _against_limits(axes: Axes, low: float, high: float, values: Array) -> None:
    """Draw limits, set the range of the axis, and ticks at limits and zero."""
    for bound in (low, high):
        axes.axhline(bound, color=style.LIMIT, linewidth=0.9, linestyle=(0, (5, 2)))
    least = min(low, float(values.min()))
    most = max(high, float(values.max()))
    margin = 0.1 * (most - least)
    axes.set_ylim(least - margin, most + margin)
    axes.set_yticks([low, *([0.0] if low < 0.0 < high else []), high])
    axes.yaxis.set_major_formatter("{x:.4g}")


def draw_plan(
    plan: MotionPlan, joint_names: Sequence[str], frame: AngleFrame, *, title: str = ""
) -> Figure:
    """Draw a plan with its targets, one row per joint.

    Args:
        plan: of the motion.
        joint_names: of the rows.
        frame: of the angles that are shown.
        title: of the figure.
    """
    n = len(joint_names)
    height = _TOP_MARGIN + n * _ROW_HEIGHT + _BOTTOM_MARGIN
    targets = np.array([frame.shown(move.target) for move in plan.moves])
    times = [target.time for target in plan.targets]
    with style.page():
        figure = Figure(figsize=(_FIGURE_WIDTH, height))
        grid = figure.add_gridspec(
            n, 3, left=0.08, right=0.985, top=1.0 - _TOP_MARGIN / height,
            bottom=_BOTTOM_MARGIN / height,
            hspace=0.16, wspace=0.2,
        )  # fmt: skip
        rows = [[figure.add_subplot(grid[j, k]) for k in range(3)] for j in range(n)]
        draw_motion(rows, plan.trajectory, plan.limits, joint_names, frame)
        for joint, row in enumerate(rows):
            for axes in row:
                for target in plan.targets[:-1]:
                    line = _LINES[target.how]
                    axes.axvline(target.time, color=style.MUTED, linewidth=0.7, linestyle=line)
            row[0].plot(
                times, targets[:, joint], linestyle="none", marker="o", markersize=3.2,
                markerfacecolor="white", markeredgecolor=style.INK, markeredgewidth=0.8,
                clip_on=False, zorder=4.0,
            )  # fmt: skip
        for axes in rows[0]:
            for number, time in enumerate(times, 1):
                axes.annotate(
                    str(number), (time, 1.0), xycoords=("data", "axes fraction"),
                    xytext=(0.0, 2.0), textcoords="offset points", ha="center",
                    fontsize=style.SMALL_FONT_SIZE, color=style.INK,
                )  # fmt: skip
        figure.align_ylabels([row[0] for row in rows])
        duration = plan.duration
        stopping = plan.duration_with_stops
        share = (
            f" ({percentage(duration / stopping, 1)} of the time with stops)"
            if stopping > 0.0
            else ""
        )
        count = np.unique([target.how for target in plan.targets[:-1]], return_counts=True)
        passed = ", ".join(f"{number} {how}" for how, number in zip(*count, strict=True))
        headline = " · ".join(filter(None, (title, f"{duration:.3f} s{share}", passed)))
        legend = (
            "red dashes: limits; line at each numbered target: solid fly-by as requested, dashed "
            "reduced, dotted stop; circles: targets"
        )
        for text, at, size, colour in (
            (headline, 0.3, style.TITLE_FONT_SIZE, style.INK),
            (legend, 0.52, style.SMALL_FONT_SIZE + 0.5, style.MUTED),
        ):
            figure.text(0.08, 1.0 - at / height, text, fontsize=size, color=colour)
    return figure


def check_format(path: Path) -> None:
    """Raise InputError unless a path has the suffix of a picture."""
    if path.suffix.lower() not in FORMATS:
        problem = f"{path.suffix!r} is not a picture format"
        raise InputError(path, problem, remedy=f"use {', '.join(FORMATS)}")


def save(figure: Figure, path: Path) -> None:
    """Write a picture atomically, in the format of its suffix, or raise InputError."""
    check_format(path)
    metadata = {"Date": None} if path.suffix.lower() == ".svg" else {}
    try:
        with style.page():
            content = BytesIO()
            kind = path.suffix.lower().removeprefix(".")
            figure.savefig(content, format=kind, dpi=_DOTS_PER_INCH, metadata=metadata)
        write_atomically(path, content.getvalue())
    except OSError as error:
        raise InputError(path, f"cannot be written ({error.strerror})") from error
