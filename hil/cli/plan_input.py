"""What `hil plan` is asked to plan: a plan file, or a table of via points."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from math import isfinite
from pathlib import Path
from typing import ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray

from hil.cell import AngleFrame, Cell
from hil.errors import InputError
from hil.reading import remedy_of, text_of
from planner.errors import (
    InvalidPlanFile,
    InvalidViaPoints,
    PlannerCrashed,
    PlanningError,
    PlanningTimedOut,
)
from planner.isolation import in_child
from planner.moves import Fly, MotionPlan, Move
from planner.plan_file import PlanFile

Array = NDArray[np.float64]
P = ParamSpec("P")
T = TypeVar("T")

PLAN_FILES = (".toml", ".json")


def read_plan_file(path: Path) -> PlanFile:
    """Read a plan file, TOML or JSON.

    Raises:
        InputError: it cannot be read, or is not a plan.
    """
    text = _text(path)
    try:
        if path.suffix.lower() == ".toml":
            return PlanFile.from_toml(text)
        return PlanFile.from_dict(json.loads(text))
    except (ValueError, AttributeError) as error:
        raise InputError(path, str(error)) from error
    except RecursionError as error:
        raise InputError(path, "is nested too deeply", remedy="name a plan file") from error


def planned_again(path: Path, cell: Cell) -> MotionPlan:
    """Plan the moves of a file for the limits of a cell.

    A motion that the file holds is first checked against its own moves and limits, so that
    moves which were edited never stand beside a motion that is not theirs.

    Raises:
        InputError: the file cannot be read, is for another arm, or holds a motion that breaks
            its limits or is not what its moves plan to.
        PlannerError: the moves cannot be planned for this cell.
    """
    file = read_plan_file(path)
    if file.joint_names != cell.joint_names:
        raise InputError(
            path,
            f"is for the joints {', '.join(file.joint_names)}",
            field="joints",
            remedy=f"those of the cell are {', '.join(cell.joint_names)}",
        )
    if file.trajectory is not None:
        own = file if file.limits is not None else replace(file, limits=cell.joint_limits)
        try:
            isolated(own.plan)
        except (InvalidPlanFile, InvalidViaPoints, PlanningError) as error:
            raise InputError(path, str(error)) from error
    return isolated(file.plan, cell.joint_limits)


def isolated(function: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> T:
    """Return what a planning function returns, called where the solver may crash.

    Raises:
        InputError: it crashed, or did not come to an end.
        Exception: whatever the function itself raised.
    """
    try:
        return in_child(function, *args, **kwargs)
    except (PlannerCrashed, PlanningTimedOut) as error:
        raise InputError(
            None,
            f"this motion cannot be planned: {error}",
            remedy="move a via point a little, plan fewer, or ask for another fly or speed",
        ) from error


def read_via_points(path: Path, frame: AngleFrame) -> Array:
    """Read via points (m, n) [rad] from a table of degrees.

    One row per point, values apart by commas, semicolons or blanks; what follows a # is a
    comment; a first row without a single number is taken for names of columns and skipped.

    Raises:
        InputError: a row is not one finite number per joint.
    """
    points: list[list[float]] = []
    first = True
    for number, line in enumerate(_text(path).splitlines(), 1):
        cells = line.split("#")[0].replace(",", " ").replace(";", " ").split()
        if not cells:
            continue
        numbers = [_number(cell) for cell in cells]
        names, first = first and not any(value is not None for value in numbers), False
        if names:
            continue
        row = [value for value in numbers if value is not None and isfinite(value)]
        for place, value in enumerate(numbers, 1):
            if value is None or not isfinite(value):
                raise InputError(
                    path,
                    f"{cells[place - 1]!r} is no finite number",
                    field=f"line {number}, cell {place}",
                    remedy="write an angle in degrees",
                )
        if len(row) != frame.sign.size:
            raise InputError(
                path,
                f"{len(row)} values",
                field=f"line {number}",
                remedy=f"write one angle in degrees for each of the {frame.sign.size} joints",
            )
        points.append(row)
    if len(points) < 2:
        raise InputError(
            path, f"{len(points)} via points", remedy="a motion needs a start and a target"
        )
    return frame.urdf(np.array(points))


def moves_through(
    points: Sequence[Array] | Array, *, fly: Fly, speed: float, acceleration: float
) -> tuple[Move, ...]:
    """Return one move to each point but the first."""
    return tuple(
        Move(target=point, speed=speed, acceleration=acceleration, fly=fly) for point in points[1:]
    )


def _number(cell: str) -> float | None:
    """Return the number in a cell, or None; Python's own `1_000` is no number of a table."""
    try:
        return None if "_" in cell else float(cell)
    except ValueError:
        return None


def _text(path: Path) -> str:
    try:
        # Spreadsheets and editors begin a file with a byte order mark; it is no part of a cell.
        return text_of(path).removeprefix("\ufeff")
    except (OSError, UnicodeDecodeError) as error:
        remedy = remedy_of(error, "name another file")
        why = error.strerror if isinstance(error, OSError) else error
        raise InputError(path, f"cannot be read ({why})", remedy=remedy) from error
