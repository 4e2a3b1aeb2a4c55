"""A motion as a table of comma-separated values, one row per sample; text in, text out.

The first row names the columns: ``time [s]``, then for each joint ``NAME.position [rad]``,
``NAME.velocity [rad/s]`` and ``NAME.acceleration [rad/s^2]``. Columns in degrees are read too.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from math import ceil
from typing import NamedTuple

import numpy as np

from planner.arrays import Array
from planner.errors import InvalidSetting, InvalidTrajectory
from planner.piecewise_cubic import Trajectory
from planner.sampled import SampledTrajectory

_TIME = "time [s]"
_BOM = "\ufeff"  # spreadsheets begin their tables with it
_QUANTITIES = {"position": "", "velocity": "/s", "acceleration": "/s^2"}
_ANGLES = {"rad": 1.0, "deg": np.pi / 180.0}
# A last period this much shorter than the others is rounding, not motion.
_ROUNDING = 1e-9
# More rows a second than any controller has cycles.
_HIGHEST_RATE = 1e5


class CsvMotion(NamedTuple):
    """What a table holds: the motion and the names of its joints."""

    trajectory: SampledTrajectory
    joint_names: tuple[str, ...]


def to_csv(trajectory: Trajectory, rate: float, joint_names: Sequence[str]) -> str:
    """Return a motion as a table with `rate` rows a second [Hz], its first and last instant in it.

    Numbers are written so that every bit comes back.

    Raises:
        InvalidSetting: a rate not above 0 or above 100 kHz, not one name per joint, each another,
            or a motion of no duration, which no rows can tell.
    """
    if not 0.0 < rate <= _HIGHEST_RATE:
        raise InvalidSetting("rate", rate, f"above 0 Hz, at most {_HIGHEST_RATE:g} Hz")
    if trajectory.duration <= 0.0:
        raise InvalidSetting("duration", trajectory.duration, "a motion of more than 0 s")
    if len({*joint_names}) != trajectory.n_joints or len(joint_names) != trajectory.n_joints:
        raise InvalidSetting(
            "joint_names", list(joint_names), f"{trajectory.n_joints} different names"
        )
    steps = max(1, ceil(trajectory.duration * rate - _ROUNDING))
    time = np.minimum(np.arange(steps + 1) / rate, trajectory.duration)
    time[-1] = trajectory.duration
    columns = np.stack(trajectory.sample(time), axis=2).reshape(len(time), -1)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([_TIME, *_headings(joint_names)])
    writer.writerows(np.column_stack((time, columns)).tolist())
    return text.getvalue()


def from_csv(text: str) -> CsvMotion:
    """Read a table with the columns that `to_csv` writes, in any order, in rad or deg.

    The first row is time 0. Whether the motion keeps limits is for `check_limits` to say.

    Raises:
        InvalidTrajectory: a column missing, double or unknown, a row that is not numbers, or
            rows that make no motion.
    """
    try:
        rows = [row for row in csv.reader(io.StringIO(text.removeprefix(_BOM))) if row]
    except csv.Error as error:
        raise InvalidTrajectory(f"not a table of comma-separated values: {error}") from error
    if len(rows) < 3:
        raise InvalidTrajectory("a table of a motion needs its headings and two rows or more")
    headings = [cell.strip() for cell in rows[0]]
    table = _numbers(rows[1:], len(headings))
    columns: dict[tuple[str, str], Array] = {}
    for heading, column in zip(headings, table.T, strict=True):
        key, factor = ((_TIME, ""), 1.0) if heading == _TIME else _meaning(heading)
        if key in columns:
            raise InvalidTrajectory(f"column {heading!r} stands twice in the table")
        columns[key] = column * factor
    if (_TIME, "") not in columns:
        raise InvalidTrajectory(f"the table has no column {_TIME!r}")
    time = columns.pop((_TIME, ""))
    names = tuple(dict.fromkeys(name for name, _ in columns))
    for name in names:
        for quantity in _QUANTITIES:
            if (name, quantity) not in columns:
                raise InvalidTrajectory(f"the table has no {quantity} of joint {name!r}")
    if not names:
        raise InvalidTrajectory("the table has no joints")
    q, qd, qdd = (
        np.column_stack([columns[name, quantity] for name in names]) for quantity in _QUANTITIES
    )
    return CsvMotion(SampledTrajectory(time - time[0], q, qd, qdd), names)


def _headings(joint_names: Sequence[str]) -> list[str]:
    return [
        f"{name}.{quantity} [rad{per}]"
        for name in joint_names
        for quantity, per in _QUANTITIES.items()
    ]


def _meaning(heading: str) -> tuple[tuple[str, str], float]:
    """Return (joint, quantity) of a column and what its numbers are to be multiplied by."""
    name, _, rest = heading.rpartition(".")
    for quantity, per in _QUANTITIES.items():
        for angle, factor in _ANGLES.items():
            if name and rest == f"{quantity} [{angle}{per}]":
                return (name, quantity), factor
    raise InvalidTrajectory(
        f"column {heading!r} is unknown; expected e.g. {_TIME!r} or {_headings(['joint_1'])[1]!r}"
    )


def _numbers(rows: list[list[str]], width: int) -> Array:
    numbers = []
    for index, row in enumerate(rows, 1):
        if len(row) != width:
            raise InvalidTrajectory(f"row {index} has {len(row)} values, the headings are {width}")
        try:
            numbers.append([float(cell) for cell in row])
        except ValueError as error:
            raise InvalidTrajectory(f"row {index}: {error}") from error
    return np.array(numbers)
