"""What `hil plan` is asked to plan: a plan file, a table of via points, or random ones."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hil.cell import Cell
from hil.errors import InputError
from hil.plots import AngleFrame
from planner.errors import InvalidPlanFile
from planner.moves import Fly, Move
from planner.plan_file import PlanFile

Array = NDArray[np.float64]

_STEP = 0.1
"""deg; random via points are as round as those a person teaches."""


def read_plan_file(path: Path) -> PlanFile:
    """Read a plan file, TOML or JSON.

    Raises:
        InputError: it cannot be read, or is not a plan.
    """
    text = _text(path)
    try:
        if path.suffix == ".toml":
            return PlanFile.from_toml(text)
        return PlanFile.from_dict(json.loads(text))
    except (InvalidPlanFile, json.JSONDecodeError, AttributeError) as error:
        raise InputError(path, str(error)) from error


def read_via_points(path: Path, frame: AngleFrame) -> Array:
    """Read via points (m, n) [rad] from a table of degrees.

    One row per point, values apart by commas, semicolons or blanks; what follows a # is a
    comment; a first row of names is skipped.

    Raises:
        InputError: a row is not one number per joint.
    """
    points: list[list[float]] = []
    for number, line in enumerate(_text(path).splitlines(), 1):
        cells = line.split("#")[0].replace(",", " ").replace(";", " ").split()
        if not cells:
            continue
        try:
            row = [float(cell) for cell in cells]
        except ValueError as error:
            if not points:
                continue  # names of columns
            raise InputError(path, str(error), field=f"line {number}") from error
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


def random_via_points(cell: Cell, frame: AngleFrame, count: int, seed: int) -> Array:
    """Return the home posture, or the middle of the limits, and random points (1 + m, n) [rad]."""
    limits = cell.joint_limits
    ends = np.sort([frame.shown(limits.lower), frame.shown(limits.upper)], axis=0)
    shares = np.random.default_rng(seed).random((count, limits.n_joints))
    shown = ends[0] + shares * (ends[1] - ends[0])
    shown = np.clip(np.round(shown / _STEP) * _STEP, *ends)
    home = cell.home if cell.file.campaign is not None else (limits.lower + limits.upper) / 2.0
    return np.vstack((home, frame.urdf(shown)))


def moves_through(
    points: Sequence[Array] | Array, *, fly: Fly, speed: float, acceleration: float
) -> tuple[Move, ...]:
    """Return one move to each point but the first."""
    return tuple(
        Move(target=point, speed=speed, acceleration=acceleration, fly=fly) for point in points[1:]
    )


def _text(path: Path) -> str:
    try:
        return path.read_text("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(path, f"cannot be read ({error})", remedy="name another file") from error
