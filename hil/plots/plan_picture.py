"""A plan on one page: every joint against its limits, and one corner at several percentages."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from hil.cell import AngleFrame
from hil.errors import InputError
from hil.files import write_atomically
from hil.plots import style
from hil.plots.joints import corner_times, draw_joints
from planner.moves import FlyPercent, MotionPlan, TargetPassage, plan_moves
from planner.worker import in_child

Array = NDArray[np.float64]

PERCENTAGES = (0.0, 25.0, 50.0, 100.0)
_SAMPLES = 600
_MARGIN = 0.12
_TICK = 0.02
"""s between two dots on the path."""


@dataclass(frozen=True, eq=False)
class FlownCorner:
    """The corner at one target of a plan, at one percentage of fly.

    Attributes:
        percent: What was asked.
        plan: The whole plan with it.
        passage: How the target is passed.
        begin, end: From when to when the corner is rounded [s].
    """

    percent: float
    plan: MotionPlan
    passage: TargetPassage
    begin: float
    end: float


def flown_corners(plan: MotionPlan, target: int) -> list[FlownCorner]:
    """Plan again with the corner at one target (from 0, not the last) at each percentage.

    Raises:
        PlannerCrashed, PlanningTimedOut: the solver crashed, or found no end.
    """
    corners = []
    for percent in PERCENTAGES:
        moves = list(plan.moves)
        moves[target] = replace(moves[target], fly=FlyPercent(percent))
        again = in_child(plan_moves, plan.start, moves, plan.limits, plan.overrides)
        corners.append(
            FlownCorner(percent, again, again.targets[target], *corner_times(again)[target])
        )
    return corners


def sharpest_corner(plan: MotionPlan) -> int | None:
    """Return the target at which the path turns most, of those it can fly by; None if none."""
    points = np.array([plan.start, *(move.target for move in plan.moves)])
    steps = np.diff(points, axis=0)
    areas = [float(np.max(np.abs(_turn(a, b)))) for a, b in pairwise(steps)]
    return int(np.argmax(areas)) if areas and max(areas) > 0.0 else None


def draw_corner(
    path: Axes,
    speed: Axes,
    corners: Sequence[FlownCorner],
    joint_names: Sequence[str],
    frame: AngleFrame,
) -> None:
    """Draw the path in the plane of the two joints that turn most, and the speed along it."""
    widest = corners[-1]
    index = widest.passage.index
    points = [widest.plan.start, *(move.target for move in widest.plan.moves)]
    before, target, after = (np.asarray(points[index + k]) for k in range(3))
    turn = np.abs(_turn(target - before, after - target))
    first, second = divmod(int(np.argmax(turn)), target.size)
    for corner, (colour, dashes) in zip(corners, style.FLIES, strict=True):
        look = {"color": colour, "linestyle": dashes, "linewidth": 1.6}
        _path(path, corner, widest, (first, second), frame, look)
        _speed(speed, corner, widest, look)
    _zoom(path, widest, (first, second), frame)
    goal = frame.shown(target)
    path.plot(goal[first], goal[second], "+", color=style.INK, markersize=11, markeredgewidth=1.4)
    path.set_xlabel(f"{joint_names[first]} [deg]")
    path.set_ylabel(f"{joint_names[second]} [deg]")
    path.set_title(
        f"path at target {index + 1}, a dot each {_TICK * 1000:.0f} ms",
        loc="left",
        color=style.MUTED,
    )
    speed.set_xlabel("time from where the target is nearest [s]")
    speed.set_title("joint-space speed [deg/s]", loc="left", color=style.MUTED)
    speed.legend(loc="upper left", bbox_to_anchor=(1.02, 1.0), frameon=False, fontsize=style.TEXT)
    for axes in (path, speed):
        style.bare(axes)


def _turn(before: Array, after: Array) -> Array:
    """Return by how much a path turns in the plane of each two joints, (n, n) [rad²]."""
    return np.asarray(np.outer(before, after) - np.outer(after, before), dtype=np.float64)


def _window(corner: FlownCorner, widest: FlownCorner) -> Array:
    """Return the times of a plan while it runs where the widest corner is rounded."""
    around = 0.6 * max(widest.end - widest.begin, 0.1)
    middle = corner.passage.time
    duration = corner.plan.trajectory.duration
    return np.linspace(max(middle - around, 0.0), min(middle + around, duration), _SAMPLES)


def _path(
    axes: Axes,
    corner: FlownCorner,
    widest: FlownCorner,
    joints: tuple[int, int],
    frame: AngleFrame,
    look: dict[str, Any],
) -> None:
    time = _window(corner, widest)
    q = frame.shown(corner.plan.trajectory.sample(time)[0])[:, joints]
    axes.plot(*q.T, **look)
    middle = corner.passage.time
    dots = middle + _TICK * np.arange(
        np.ceil((time[0] - middle) / _TICK), np.floor((time[-1] - middle) / _TICK) + 1
    )
    at = frame.shown(corner.plan.trajectory.sample(dots)[0])[:, joints]
    axes.plot(*at.T, linestyle="none", marker="o", markersize=2.6, color=look["color"])


def _zoom(axes: Axes, widest: FlownCorner, joints: tuple[int, int], frame: AngleFrame) -> None:
    """Show the widest corner but for its ends, where the paths hardly differ."""
    edge = 0.15 * (widest.end - widest.begin)
    time = np.linspace(widest.begin + edge, widest.end - edge, _SAMPLES)
    seen = np.vstack(
        (
            frame.shown(widest.plan.trajectory.sample(time)[0]),
            frame.shown(widest.plan.moves[widest.passage.index].target),
        )
    )[:, joints]
    low, high = seen.min(axis=0), seen.max(axis=0)
    room = _MARGIN * np.maximum(high - low, 1e-9)
    axes.set_xlim(low[0] - room[0], high[0] + room[0])
    axes.set_ylim(low[1] - room[1], high[1] + room[1])


def _speed(axes: Axes, corner: FlownCorner, widest: FlownCorner, look: dict[str, Any]) -> None:
    time = _window(corner, widest)
    speed = np.degrees(np.linalg.norm(corner.plan.trajectory.sample(time)[1], axis=1))
    passed = corner.passage
    label = (
        f"fly {corner.percent:.0f} %: passes at {np.degrees(passed.distance):.2f}°,\n"
        f"motion {corner.plan.trajectory.duration:.3f} s"
    )
    if corner.percent > 0.0 and passed.how != "flown":
        label += f" ({passed.how})"
    axes.plot(time - passed.time, speed, label=label, **look)


FORMATS = (".png", ".svg", ".pdf")
_WIDTH, _ROW, _CORNER = 11.0, 1.25, 3.0
_TOP, _BOTTOM, _GAP = 0.95, 0.55, 0.95
_DOTS_PER_INCH = 110


def draw_plan(
    plan: MotionPlan,
    joint_names: Sequence[str],
    frame: AngleFrame,
    *,
    title: str = "",
    corner: int | None = None,
) -> Figure:
    """Draw a plan.

    Args:
        plan: What to draw.
        joint_names: One name per joint.
        frame: Which angles to show.
        title: Stands above the page.
        corner: Target (from 0) to draw the corner of; the sharpest if None.
    """
    corner = sharpest_corner(plan) if corner is None else corner
    n = len(joint_names)
    below = 0.0 if corner is None else _CORNER + _GAP
    height = _TOP + n * _ROW + below + _BOTTOM
    with style.page():
        figure = Figure(figsize=(_WIDTH, height))
        grid = figure.add_gridspec(
            n,
            3,
            left=0.08,
            right=0.985,
            top=1.0 - _TOP / height,
            bottom=(below + _BOTTOM) / height,
            hspace=0.16,
            wspace=0.2,
        )
        rows = [[figure.add_subplot(grid[j, k]) for k in range(3)] for j in range(n)]
        draw_joints(rows, plan, joint_names, frame)
        figure.align_ylabels([row[0] for row in rows])
        if corner is not None:
            lower = figure.add_gridspec(
                1, 2, left=0.08, right=0.76, top=(_BOTTOM + _CORNER) / height,
                bottom=_BOTTOM / height, wspace=0.22,
            )  # fmt: skip
            path, speed = (figure.add_subplot(lower[0, k]) for k in range(2))
            draw_corner(path, speed, flown_corners(plan, corner), joint_names, frame)
        figure.text(
            0.08, 1.0 - 0.3 / height, _headline(plan, title), fontsize=style.TITLE, color=style.INK
        )
        figure.text(
            0.08,
            1.0 - 0.52 / height,
            "red dashes: limits; shaded: corners; line at each numbered target: solid flown by as "
            "asked, dashed less than asked, dotted stop; circles: targets",
            fontsize=style.SMALL + 0.5,
            color=style.MUTED,
        )
    return figure


def check_format(path: Path) -> None:
    """Refuse a name that tells no format in which pictures are written.

    Raises:
        InputError: it does not.
    """
    if path.suffix.lower() not in FORMATS:
        raise InputError(
            path, f"{path.suffix!r} is no format for pictures", remedy=f"use {', '.join(FORMATS)}"
        )


def save(figure: Figure, path: Path) -> None:
    """Write a picture in the format of its name, the whole of it or nothing.

    Raises:
        InputError: the format is unknown, or the file cannot be written.
    """
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


def _headline(plan: MotionPlan, title: str) -> str:
    duration, stopping = plan.duration, plan.duration_with_stops
    share = f" ({duration / stopping:.1%} of the time with stops)" if stopping > 0.0 else ""
    count = np.unique([target.how for target in plan.targets[:-1]], return_counts=True)
    passed = ", ".join(f"{number} {how}" for how, number in zip(*count, strict=True))
    parts = [title, f"{duration:.3f} s{share}", passed]
    return " · ".join(part for part in parts if part)
