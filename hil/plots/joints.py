"""Position, velocity and acceleration of every joint against their limits."""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from hil.cell import AngleFrame
from hil.plots import style
from hil.report.drawing import thinned
from planner import JointLimits, Trajectory
from planner.moves import MotionPlan

Array = NDArray[np.float64]

_SAMPLES = 4000
_LINES = {"flown": "-", "reduced": "--", "stopped": ":"}
_LETTERS = 12
"""As many as a line along a row's height takes."""


def draw_motion(
    rows: Sequence[Sequence[Axes]],
    trajectory: Trajectory,
    limits: JointLimits,
    joint_names: Sequence[str],
    frame: AngleFrame,
    postures: Sequence[float] | Array = (),
) -> None:
    """Draw one row per joint: position, velocity and, in a third column, acceleration.

    Args:
        rows: two or three axes per joint.
        trajectory: what to draw.
        limits: its limits, URDF angles.
        joint_names: one per joint.
        frame: which angles to show.
        postures: times that are numbered (k,) [s].
    """
    time = np.linspace(0.0, trajectory.duration, _SAMPLES)
    q, *rates = trajectory.sample(time)
    ends = np.sort([frame.shown(limits.lower), frame.shown(limits.upper)], axis=0)
    fastest, most = np.degrees(limits.velocity), np.degrees(limits.acceleration)
    columns = (
        (f"position [deg, {frame.name} angles]", frame.shown(q), *ends, style.POSITION),
        ("velocity [deg/s]", frame.shown_rate(rates[0]), -fastest, fastest, style.VELOCITY),
        ("acceleration [deg/s²]", frame.shown_rate(rates[1]), -most, most, style.ACCELERATION),
    )
    for joint, (name, row) in enumerate(zip(joint_names, rows, strict=True)):
        for axes, (_, values, low, high, colour) in zip(row, columns, strict=False):
            _against_limits(axes, float(low[joint]), float(high[joint]), values[:, joint])
            for at in postures:
                axes.axvline(at, color=style.RULE, linewidth=0.8)
            axes.plot(*thinned(time, values[:, joint], 400), color=colour, linewidth=1.1)
            axes.set_xlim(0.0, max(trajectory.duration, 1e-9))
            axes.tick_params(labelbottom=joint == len(rows) - 1, length=2.0, pad=2.0)
            style.bare(axes)
            axes.grid(False, axis="x")
        name = broken(name)
        size = style.TEXT - (1.0 if "\n" in name else 0.0)
        row[0].set_ylabel(name, color=style.INK, fontsize=size)
    for axes, (title, *_) in zip(rows[0], columns, strict=False):
        axes.set_title(title, loc="left", color=style.MUTED, pad=13.0)
        for number, at in enumerate(postures, 1):
            _number(axes, number, at, fontweight="bold", annotation_clip=False)
    for axes in rows[-1]:
        axes.set_xlabel("time [s]")


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


def _against_limits(axes: Axes, low: float, high: float, values: Array) -> None:
    """Show both limits and all values, with some room about them.

    Zero, or the middle where it lies outside, has a tick too, if that lies apart from both limits.
    """
    for bound in (low, high):
        axes.axhline(bound, color=style.LIMIT, linewidth=0.9, linestyle=(0, (5, 2)))
    least, most = min(low, float(values.min())), max(high, float(values.max()))
    room = 0.1 * (most - least)
    axes.set_ylim(least - room, most + room)
    middle = 0.0 if low < 0.0 < high else (low + high) / 2.0
    inside = min(abs(middle - low), abs(high - middle)) > 2.0 * room
    axes.set_yticks([low, middle, high] if inside else [low, high])
    axes.yaxis.set_major_formatter("{x:.4g}")


def _number(axes: Axes, number: int, at: float, **words: Any) -> None:
    """Write a number above the axes."""
    axes.annotate(
        str(number),
        (at, 1.0),
        xycoords=("data", "axes fraction"),
        xytext=(0.0, 2.0),
        textcoords="offset points",
        ha="center",
        fontsize=style.SMALL,
        color=style.INK,
        **words,
    )


def draw_joints(
    rows: Sequence[Sequence[Axes]], plan: MotionPlan, joint_names: Sequence[str], frame: AngleFrame
) -> None:
    """Draw a plan into one row of three axes per joint, with its targets and corners."""
    draw_motion(rows, plan.trajectory, plan.limits, joint_names, frame)
    targets = np.array([frame.shown(move.target) for move in plan.moves])
    for joint, row in enumerate(rows):
        for axes in row:
            _corners(axes, plan)
        row[0].plot(
            [target.time for target in plan.targets],
            targets[:, joint],
            linestyle="none",
            marker="o",
            markersize=3.2,
            markerfacecolor="white",
            markeredgecolor=style.INK,
            markeredgewidth=0.8,
            clip_on=False,
            zorder=4.0,
        )
    for axes in rows[0]:
        _numbers(axes, plan)


def corner_times(plan: MotionPlan) -> list[tuple[float, float]]:
    """Return from when to when each target but the last is rounded [s]; both alike for a stop."""
    times = []
    end = 0.0
    entered = 0.0
    for duration, corner in zip(plan.durations, plan.corners, strict=False):
        begin = end + max(duration - entered - corner.leave, 0.0)
        end = begin + (0.0 if corner.join is None else corner.join.duration)
        times.append((begin, end))
        entered = corner.enter
    return times


def _corners(axes: Axes, plan: MotionPlan) -> None:
    for (begin, end), target in zip(corner_times(plan), plan.targets, strict=False):
        axes.axvspan(begin, end, color=style.SHADE, linewidth=0.0, zorder=0.5)
        axes.axvline(target.time, color=style.MUTED, linewidth=0.7, linestyle=_LINES[target.how])


def _numbers(axes: Axes, plan: MotionPlan) -> None:
    """Number the targets above the axes, but not where one would lie upon another."""
    apart = 0.03 * plan.trajectory.duration
    times = [target.time for target in plan.targets]
    shown = [True, *(b - a >= apart for a, b in pairwise(times))]
    for number, (time, show) in enumerate(zip(times, shown, strict=True), 1):
        if show:
            _number(axes, number, time)
