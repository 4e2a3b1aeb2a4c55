"""`hil plan`: plan a motion as the controller's interpolator would execute it."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from hil.base.arrays import Array
from hil.base.errors import InputError
from hil.base.one_screen import wrapped
from hil.base.safe_input import read_input
from hil.base.terminal_text import printable
from hil.cell import AngleFrame, Cell
from hil.cli.arguments import JsonOption, exactly_one, print_json
from hil.control.move import random_via_points
from hil.plots import check_format, draw_plan, save
from planner.moves import MotionPlan, Move, plan_moves
from planner.worker import in_child

ANGLE_TOLERANCE = 1e-9
"""Degrees by which an angle may pass a limit that was converted to radians and back."""


def read_via_points(path: Path, cell: Cell) -> Array:
    """Read via points (m, n) [rad] from a table of degrees, one row per point.

    Commas, semicolons or blanks separate values; # begins a comment; a first row without numbers is
    a header.

    Raises:
        InputError: the file cannot be read, or has no two postures within the limits of the cell.
    """
    frame = AngleFrame.of(cell)
    ends = frame.shown(np.array([cell.joint_limits.lower, cell.joint_limits.upper]))
    bounds = [*zip(cell.joint_names, map(sorted, ends.T.tolist()), strict=True)]
    lines = enumerate(read_input(path).removeprefix("\ufeff").splitlines(), 1)
    rows = [(k, re.findall(r"[^\s,;]+", line.split("#")[0])) for k, line in lines]
    rows = [(number, cells) for number, cells in rows if cells]
    if rows and all(_number(cell) is None for cell in rows[0][1]):  # names
        del rows[0]
    points = []
    for number, cells in rows:
        point = [value for cell in cells if (value := _number(cell)) is not None]
        if not len(cells) == len(point) == frame.sign.size or not np.isfinite(point).all():
            problem = f"{' '.join(cells)!r} is not a posture"
            remedy = f"write one finite angle in degrees for each of the {frame.sign.size} joints"
            raise InputError(path, problem, field=f"line {number}", remedy=remedy)
        for angle, (name, (lower, upper)) in zip(point, bounds, strict=True):
            if not lower - ANGLE_TOLERANCE <= angle <= upper + ANGLE_TOLERANCE:
                problem = f"{name} = {angle:g}° is outside [limits] of {cell.path}"
                remedy = f"write an angle from {lower:g}° to {upper:g}°"
                raise InputError(path, problem, field=f"line {number}", remedy=remedy)
        points.append(point)
    if len(points) < 2:
        remedy = "a motion needs a start and a target"
        raise InputError(path, f"{len(points)} via points", remedy=remedy)
    return frame.urdf(np.array(points))


def _number(cell: str) -> float | None:
    """Parse a number; None for other text."""
    try:
        return float(cell)
    except ValueError:
        return None


_RATES = ("velocity", "acceleration", "jerk")


def plan(
    cell: Path,
    via: Path | None = None,
    random: Annotated[int | None, typer.Option(min=1)] = None,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    speed: Annotated[float, typer.Option(min=0.01, max=100.0)] = 100.0,
    fly: Annotated[float, typer.Option(min=0.0, max=100.0)] = 50.0,
    picture: Path | None = None,
    json: JsonOption = False,
) -> None:
    """Plan a motion through via points and report how each of them is passed. Nothing moves.

    Angles are in the frame of the cell's limits: teach pendant angles if it is "controller". Only
    joint limits are checked, not floor, walls, currents or self-collision.

    **Example:** `hil plan cell.toml --random 6 --fly 50 --picture plan.png`

    Options:
        cell: The cell file.
        via: Via points: a table in degrees, one row per point, first the start.
        random: Number of random via points, in place of --via.
        seed: Seed of the random via points.
        speed: Percent of the joint speed limits.
        fly: Fly in percent (FLY_NORM); 0 stops at each point.
        picture: Plot the plan (*.png, *.svg, *.pdf).
    """
    if picture is not None:
        check_format(picture)
    exactly_one(
        "there are no via points",
        "add --via FILE with a table of them, or --random 6 for six random ones",
        via=via,
        random=random,
    )
    loaded = Cell.load(cell)
    frame = AngleFrame.of(loaded)
    points = (
        random_via_points(loaded, frame, random or 1, seed)
        if via is None
        else read_via_points(via, loaded)
    )
    moves = [Move(target=point, speed=speed / 100, fly_percent=fly) for point in points[1:]]
    # The solver can crash its process.
    planned = in_child(plan_moves, points[0], moves, loaded.joint_limits)
    names = loaded.joint_names
    summary = _summary(planned, loaded, frame)
    if json:
        print_json(summary)
    else:
        typer.echo(printable(_table(summary, frame.shown(planned.start), names)))
    if picture is not None:
        save(draw_plan(planned, names, frame, title=loaded.name), picture)


def _summary(plan: MotionPlan, cell: Cell, frame: AngleFrame) -> dict[str, Any]:
    extrema = plan.trajectory.extrema()
    ratios = np.array([getattr(extrema, q) / getattr(plan.limits, q) for q in _RATES])
    quantity, joint = divmod(int(np.argmax(ratios)), ratios.shape[1])
    return {
        "duration": plan.duration,
        "duration_with_stops": plan.duration_with_stops,
        "worst_limit_ratio": float(ratios.max()),
        "worst_limit": f"{_RATES[quantity]} of {cell.joint_names[joint]}",
        "reduced": plan.reduced_corners,
        "stopped": plan.stopped_corners,
        "angles": frame.name,
        "targets": [
            {
                "target_deg": frame.shown(move.target).tolist(),
                "time": target.time,
                "distance_deg": float(np.degrees(target.distance)),
                "how": target.how,
                "fly_percent": 100.0 * target.fly,
            }
            for move, target in zip(plan.moves, plan.targets, strict=True)
        ],
    }


def _table(summary: Mapping[str, Any], start: Array, joint_names: Sequence[str]) -> str:
    width = max(9, *(len(name) + 1 for name in joint_names))
    heads = "".join(f"{name:>{width}}" for name in joint_names)
    degrees = f"{'deg':>{width}}" * len(joint_names)
    lines = [
        f"{'target':>6}{heads}{'time':>9}{'distance':>10}  passed",
        f"{'':6}{degrees}{'s':>9}{'deg':>10}",
    ]
    at_start = {"target_deg": start, "time": 0.0, "distance_deg": 0.0, "how": "start"}
    for number, target in enumerate([at_start, *summary["targets"]]):
        angles = "".join(f"{angle:{width}.2f}" for angle in target["target_deg"])
        how = target["how"]
        fly = f", fly {target['fly_percent']:.0f} %" if how not in ("start", "stopped") else ""
        lines.append(
            f"{number:6d}{angles}{target['time']:9.3f}{target['distance_deg']:10.3f}  {how}{fly}"
        )
    closing = (
        "{duration:.3f} s; {duration_with_stops:.3f} s with a stop at every target; {reduced} "
        "corners rounded less than requested, {stopped} not at all\n"
        "closest to its limit: {worst_limit}, {closest:.1f} % of it ({angles} angles; "
        "floor, walls, currents and self-collision were not checked)"
    )
    return "\n".join(
        [*lines, wrapped(closing.format(closest=100.0 * summary["worst_limit_ratio"], **summary))]
    )
