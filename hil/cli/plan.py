"""`hil plan`: plan a motion as the controller's interpolator would run it, and draw it."""

from __future__ import annotations

import json as json_format
from math import isfinite, radians
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from hil.cell import AngleFrame, Cell
from hil.cli.plan_input import (
    PLAN_FILES,
    isolated,
    moves_through,
    planned_again,
    read_via_points,
)
from hil.errors import InputError
from hil.files import write_atomically
from hil.plots import check_format, draw_plan, save
from hil.random_motion import random_via_points
from hil.terminal_text import printable
from planner.motion_csv import to_csv
from planner.moves import Fly, FlyDistance, FlyPercent, MotionPlan, plan_moves
from planner.plan_file import PlanFile

_RATES = ("velocity", "acceleration", "jerk")
_MOST_ROWS = 1_000_000
"""of a table; it is made in memory."""


def plan(
    cell: Annotated[Path, typer.Argument(help="The cell file.", show_default=False)],
    via: Annotated[
        Path | None,
        typer.Option(
            help="Via points: a table in degrees, one row per point, the first is the start; or a "
            "plan file (*.toml, *.json).",
            show_default=False,
        ),
    ] = None,
    random: Annotated[
        int | None,
        typer.Option(min=1, help="So many random via points instead.", show_default=False),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of the random via points.")] = 0,
    speed: Annotated[
        float, typer.Option(min=0.01, max=100.0, help="Percent of the joints' speeds.")
    ] = 100.0,
    acceleration: Annotated[
        float, typer.Option(min=0.01, max=100.0, help="Percent of the joints' accelerations.")
    ] = 100.0,
    fly: Annotated[
        float, typer.Option(min=0.0, max=100.0, help="Fly in percent (FLY_NORM); 0 stops.")
    ] = 50.0,
    fly_distance: Annotated[
        float | None,
        typer.Option(
            min=0.0,
            help="Instead of --fly: degrees of joint space by which a via point may be missed.",
            show_default=False,
        ),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="Write a plan file (*.toml, *.json)."),
    ] = None,
    csv: Annotated[
        Path | None, typer.Option(help="Write a table of time, position, velocity, acceleration.")
    ] = None,
    rate: Annotated[
        float | None,
        typer.Option(help="Rows a second of that table; those of the cell's cycle if left out."),
    ] = None,
    picture: Annotated[
        Path | None, typer.Option(help="Draw the plan (*.png, *.svg, *.pdf).")
    ] = None,
    corner: Annotated[
        int | None,
        typer.Option(min=1, help="Target to draw the corner of; else where the path turns most."),
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print the table as JSON.")] = False,
) -> None:
    """Plan a motion through via points and say how each of them is passed. Nothing moves.

    Angles are those in which the cell's limits are written: the teach pendant's where their
    frame is "controller". A plan file keeps its own speeds and flies, and is planned for the
    limits of CELL. Only joint limits are checked here: not floor, walls, currents, nor the arm
    against itself.

    **Example:** `hil plan cell.toml --random 6 --fly 50 --picture plan.png`
    """
    _check_requests(output, picture, rate)
    loaded = Cell.load(cell)
    frame = AngleFrame.of(loaded)
    if (via is None) == (random is None):
        raise InputError(None, "what is to be planned?", remedy="give either --via or --random")
    if via is not None and via.suffix.lower() in PLAN_FILES:
        planned = planned_again(via, loaded)
    else:
        points = (
            random_via_points(loaded, frame, random or 1, seed)
            if via is None
            else read_via_points(via, frame)
        )
        asked: Fly = FlyPercent(fly) if fly_distance is None else FlyDistance(radians(fly_distance))
        moves = moves_through(points, fly=asked, speed=speed / 100, acceleration=acceleration / 100)
        planned = isolated(plan_moves, points[0], moves, loaded.joint_limits)
    if corner is not None and corner >= len(planned.moves):
        raise InputError(
            None,
            f"target {corner} is no corner",
            field="--corner",
            remedy=f"there are {len(planned.moves)} targets, the last one is a stop",
        )
    names = loaded.joint_names
    rows_a_second = _cycles_a_second(loaded) if rate is None else rate
    if csv is not None:
        _check_rows(planned.duration, rows_a_second)
    typer.echo(
        json_format.dumps(_summary(planned, loaded, frame))
        if json
        else printable(_table(planned, loaded, frame))
    )
    if output is not None:
        _write_plan(output, PlanFile.of(planned, names))
    if csv is not None:
        _write(csv, to_csv(planned.trajectory, rows_a_second, names))
    if picture is not None:
        figure = draw_plan(
            planned,
            names,
            frame,
            title=loaded.name,
            corner=None if corner is None else corner - 1,
        )
        save(figure, picture)


def _check_requests(output: Path | None, picture: Path | None, rate: float | None) -> None:
    """Refuse what could be written in no case before time is spent on planning."""
    if output is not None and output.suffix.lower() not in PLAN_FILES:
        raise InputError(
            output,
            f"{output.suffix!r} is no plan file",
            field="--output",
            remedy=f"use {' or '.join(PLAN_FILES)}",
        )
    if picture is not None:
        check_format(picture)
    if rate is not None and not (isfinite(rate) and rate > 0.0):
        raise InputError(
            None, f"{rate} rows a second make no table", field="--rate", remedy="give more than 0"
        )


def _check_rows(duration: float, rate: float) -> None:
    if duration * rate > _MOST_ROWS:
        raise InputError(
            None,
            f"{rate:g} rows a second of a motion of {duration:.3f} s are too many for a table",
            field="--rate",
            remedy=f"give a lower rate; at most {_MOST_ROWS} rows are written",
        )


def _cycles_a_second(cell: Cell) -> float:
    return 1000.0 if cell.file.controller is None else 1.0 / cell.period


def _summary(plan: MotionPlan, cell: Cell, frame: AngleFrame) -> dict[str, Any]:
    ratio, quantity, joint = _worst(plan)
    return {
        "duration": plan.duration,
        "duration_with_stops": plan.duration_with_stops,
        "worst_limit_ratio": ratio,
        "worst_limit": f"{quantity} of {cell.joint_names[joint]}",
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


def _table(plan: MotionPlan, cell: Cell, frame: AngleFrame) -> str:
    width = max(9, *(len(name) + 1 for name in cell.joint_names))
    heads = "".join(f"{name:>{width}}" for name in cell.joint_names)
    lines = [
        f"{'target':>6}{heads}{'time':>9}{'distance':>10}  passed",
        f"{'':6}{''.join(f'{unit:>{width}}' for unit in ['deg'] * len(cell.joint_names))}"
        f"{'s':>9}{'deg':>10}",
    ]
    rows = [(plan.start, 0.0, 0.0, "start")] + [
        (
            move.target,
            target.time,
            float(np.degrees(target.distance)),
            target.how if target.how == "stopped" else f"{target.how}, fly {target.fly:.0%}",
        )
        for move, target in zip(plan.moves, plan.targets, strict=True)
    ]
    for number, (q, time, distance, how) in enumerate(rows):
        angles = "".join(f"{angle:{width}.2f}" for angle in frame.shown(np.asarray(q)))
        lines.append(f"{number:6d}{angles}{time:9.3f}{distance:10.3f}  {how}")
    ratio, quantity, joint = _worst(plan)
    saved = f"; {plan.duration_with_stops:.3f} s with a stop at every target"
    lines += [
        f"{plan.duration:.3f} s{saved}; {plan.reduced_corners} corners rounded less than asked, "
        f"{plan.stopped_corners} not at all",
        f"nearest to its limit: {quantity} of {cell.joint_names[joint]}, {ratio:.6f} of it "
        f"({frame.name} angles; floor, walls, currents and the arm itself were not checked)",
    ]
    return "\n".join(lines)


def _worst(plan: MotionPlan) -> tuple[float, str, int]:
    """Return the largest share of a limit of rate that is used, of which quantity and joint."""
    extrema = plan.trajectory.extrema()
    ratios = np.array([getattr(extrema, q) / getattr(plan.limits, q) for q in _RATES])
    quantity, joint = divmod(int(np.argmax(ratios)), ratios.shape[1])
    return float(ratios.max()), _RATES[quantity], joint


def _write_plan(path: Path, file: PlanFile) -> None:
    if path.suffix.lower() == ".toml":
        _write(path, file.to_toml())
    else:
        _write(path, json_format.dumps(file.to_dict()) + "\n")


def _write(path: Path, text: str) -> None:
    try:
        write_atomically(path, text)
    except OSError as error:
        raise InputError(path, f"cannot be written ({error.strerror})") from error
