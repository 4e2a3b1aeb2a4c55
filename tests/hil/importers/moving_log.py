"""A log of three joints that move, and what an import of it is."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hil.archive import Archive, open_archive
from hil.importers.column_map import ColumnMap
from hil.importers.imported_robot import Robot
from hil.importers.log import import_log
from tests.near import near

Floats = NDArray[np.float64]
RATE = 250
COUNT = 400
TIME = np.arange(COUNT) / RATE
JOINTS = ("hip", "knee", "ankle")
POSITION = np.column_stack([0.9 * np.sin(2.0 * TIME + k) for k in range(3)])
SLOPE = np.column_stack([1.8 * np.cos(2.0 * TIME + k) for k in range(3)])
TORQUE = np.column_stack([20.0 * np.cos(2.0 * TIME + k) for k in range(3)])
URDF = (
    "<robot name='three'><link name='base'/>"
    + "".join(
        f"<link name='l{name}'><inertial><mass value='{mass}'/><origin xyz='0 0 0.2'/>"
        "<inertia ixx='0.1' iyy='0.1' izz='0.1' ixy='0' ixz='0' iyz='0'/></inertial></link>"
        f"<joint name='{name}' type='revolute'><parent link='{parent}'/><child link='l{name}'/>"
        "<origin xyz='0 0 0.4'/><axis xyz='0 1 0'/>"
        "<limit lower='-3' upper='3' effort='99' velocity='9'/></joint>"
        for name, parent, mass in zip(JOINTS, ("base", "lhip", "lknee"), (3, 2, 1), strict=True)
    )
    + "</robot>"
)


def rows(
    *,
    time: Sequence[object] = tuple(f"{t:.6f}" for t in TIME),
    position: Floats = POSITION,
    torque: Floats = TORQUE,
    cell: Callable[[float], str] = lambda value: f"{value:.6f}",
) -> list[list[str]]:
    numbers = np.column_stack([position, torque])
    return [[str(t), *map(cell, row)] for t, row in zip(time, numbers.tolist(), strict=True)]


NAMES = ["t", "q1", "q2", "q3", "tau1", "tau2", "tau3"]


def text(
    body: Sequence[Sequence[str]] | None = None,
    *,
    head: Sequence[Sequence[str]] = (NAMES,),
    delimiter: str = ",",
) -> str:
    lines = [*head, *(rows() if body is None else body)]
    return "\n".join(delimiter.join(line) for line in lines) + "\n"


MAP: dict[str, Any] = {
    "time": {"column": "t"},
    "position": {"columns": "q{}"},
    "torque": {"columns": "tau{}"},
}


def imported(path: Path, content: str | bytes, urdf: Path, **changes: Any) -> Archive:
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    columns = ColumnMap.model_validate({**MAP, **changes})
    output = path.with_suffix(".mcap")
    return open_archive(
        import_log(path, output, robot=Robot.from_urdf(urdf), columns=columns, force=True)
    )


def assert_right(archive: Archive, *, without: Sequence[int] = ()) -> None:
    """The samples are those of the file, to its six digits."""
    columns = archive.columns
    elapsed = (columns["stamp"] - columns["stamp"][0]) * 1e-9
    keep = np.delete(np.arange(COUNT), list(without))
    assert elapsed == near(TIME[keep] - TIME[keep[0]], abs=1e-6)
    assert columns["position"] == near(POSITION[keep], abs=1e-6)
    assert columns["torque"] == near(TORQUE[keep], abs=1e-6)
