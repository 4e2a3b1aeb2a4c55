"""Position, velocity and acceleration of every joint against their limits."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from hil.cell import AngleFrame
from hil.plots import style
from hil.report.figures.canvas import thinned
from planner.moves import MotionPlan

Array = NDArray[np.float64]

_SAMPLES = 4000
_MARGIN = 0.08
_LINES = {"flown": "-", "reduced": "--", "stopped": ":"}


def draw_joints(
    rows: Sequence[Sequence[Axes]], plan: MotionPlan, joint_names: Sequence[str], frame: AngleFrame
) -> None:
    """Draw a plan into one row of three axes per joint."""
    time = np.linspace(0.0, plan.trajectory.duration, _SAMPLES)
    q, qd, qdd = plan.trajectory.sample(time)
    ends = np.sort([frame.shown(plan.limits.lower), frame.shown(plan.limits.upper)], axis=0)
    quantities = (
        (frame.shown(q), ends[0], ends[1], style.POSITION),
        *(
            (frame.shown_rate(rate), -np.degrees(limit), np.degrees(limit), colour)
            for rate, limit, colour in (
                (qd, plan.limits.velocity, style.VELOCITY),
                (qdd, plan.limits.acceleration, style.ACCELERATION),
            )
        ),
    )
    targets = np.array([frame.shown(move.target) for move in plan.moves])
    for joint, (name, row) in enumerate(zip(joint_names, rows, strict=True)):
        for axes, (values, low, high, colour) in zip(row, quantities, strict=True):
            _limits(axes, float(low[joint]), float(high[joint]))
            _corners(axes, plan)
            axes.plot(*thinned(time, values[:, joint], 250), color=colour, linewidth=1.2)
            axes.set_xlim(0.0, max(float(time[-1]), 1e-9))
            axes.tick_params(labelbottom=joint == len(rows) - 1)
            style.bare(axes)
        row[0].set_ylabel(name, color=style.INK)
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
    titles = (f"position [deg, {frame.name} angles]", "velocity [deg/s]", "acceleration [deg/s²]")
    for axes, title in zip(rows[0], titles, strict=True):
        axes.set_title(title, loc="left", color=style.MUTED, pad=14.0)
        _numbers(axes, plan)
    for axes in rows[-1]:
        axes.set_xlabel("time [s]")


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


def _limits(axes: Axes, low: float, high: float) -> None:
    for bound in (low, high):
        axes.axhline(bound, color=style.LIMIT, linewidth=0.9, linestyle=(0, (5, 2)))
    room = _MARGIN * (high - low)
    axes.set_ylim(low - room, high + room)
    # The limits' own figures stand at the axis; zero too, or the middle where it lies outside.
    middle = 0.0 if low < 0.0 < high else (low + high) / 2.0
    apart = min(abs(middle - low), abs(high - middle)) > _MARGIN * (high - low)
    axes.set_yticks([low, middle, high] if apart else [low, high])
    axes.yaxis.set_major_formatter("{x:.4g}")


def _corners(axes: Axes, plan: MotionPlan) -> None:
    for (begin, end), target in zip(corner_times(plan), plan.targets, strict=False):
        axes.axvspan(begin, end, color=style.SHADE, linewidth=0.0)
        axes.axvline(target.time, color=style.MUTED, linewidth=0.7, linestyle=_LINES[target.how])


def _numbers(axes: Axes, plan: MotionPlan) -> None:
    """Number the targets above the axes, but not where one would lie upon another."""
    apart = 0.03 * plan.trajectory.duration
    times = [target.time for target in plan.targets]
    shown = [True, *(b - a >= apart for a, b in pairwise(times))]
    for number, (time, show) in enumerate(zip(times, shown, strict=True), 1):
        if show:
            axes.annotate(
                str(number),
                (time, 1.0),
                xycoords=("data", "axes fraction"),
                xytext=(0.0, 2.0),
                textcoords="offset points",
                ha="center",
                fontsize=style.SMALL,
                color=style.INK,
            )
