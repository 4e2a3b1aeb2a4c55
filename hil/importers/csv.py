"""Imports logs of numbers in columns (CSV and the like)."""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hil.archive import Samples
from hil.errors import SourceError
from hil.importers.column_map import TIMES, UNITS, Column, ColumnMap, Quantity
from hil.importers.output import write_imported
from hil.importers.robot import Robot
from hil.importers.table import Table

Array = NDArray[np.float64]


def import_csv(
    source: str | PathLike[str],
    output: str | PathLike[str],
    *,
    robot: Robot,
    columns: ColumnMap,
    held_joints: Sequence[str] = (),
) -> Path:
    """Turn a log into an archive of kind ``imported``.

    Args:
        source: the log; with quantities in several files, the one the others lie beside.
        output: the archive to write.
        robot: whose joints these are.
        columns: which columns hold what.
        held_joints: joints known to have been held still.

    Returns:
        The archive's path.

    Raises:
        SourceError: a file cannot be read, a column is missing, a cell is no number, or the map
            does not fit the robot.
        ArchiveWriteError: the archive cannot be written.
    """
    log = _Log(Path(source), columns, robot)
    values = {name: log.read(name) for name in columns.quantities()}
    lengths = {name: len(array) for name, array in values.items()}
    if len(set(lengths.values())) > 1:
        listing = ", ".join(f"{name} {length}" for name, length in lengths.items())
        raise SourceError(
            log.path, f"the quantities differ in length: {listing}", remedy="cut them alike"
        )
    stamp, origin = log.stamps(lengths["position"])
    return write_imported(
        output,
        Samples(stamp, **_joint_side(values, columns, log)),
        source=log.files,
        robot=robot,
        metadata={"importer": "csv", "clock_origin_ns": str(origin)},
        held_joints=held_joints,
        period=None if columns.sample_rate is None else 1.0 / columns.sample_rate,
    )


class _Log:
    """The files of a log, and the map that says where things stand in them.

    Attributes:
        path: the log itself.
        order: the log's column of each joint of the robot.
        matrix: motor angles per joint angle (n, n), in the log's order.
    """

    def __init__(self, path: Path, columns: ColumnMap, robot: Robot) -> None:
        self.path = path
        self._map = columns
        self._robot = robot
        self._tables: dict[Path, Table] = {}
        self.order = self._joint_order()
        self.matrix = self._motor_from_joint()

    @property
    def files(self) -> list[Path]:
        """The files read, the log itself first."""
        return list(self._tables)

    def read(self, name: str) -> Array:
        """A quantity in SI units, (m, n), columns as in the log's joint order."""
        quantity = self._map.quantities()[name]
        table = self._table(quantity)
        values = table.numbers(self._columns(name, quantity), f"{name}.columns")
        factor = UNITS[name][quantity.unit] if quantity.unit else 1.0
        scale = np.asarray(quantity.scale, np.float64)
        if scale.ndim:
            self._check_length(scale, f"{name}.scale")
        return np.asarray(values * (factor * scale))

    def stamps(self, count: int) -> tuple[NDArray[np.int64], int]:
        """The samples' stamps [ns], and what was taken off them to make them positive."""
        if self._map.sample_rate is not None:
            return np.rint(np.arange(count) * (1e9 / self._map.sample_rate)).astype(np.int64), 0
        assert self._map.time is not None
        table = self._table(self._map.position)
        stamp = table.stamps(self._map.time.column, TIMES[self._map.time.unit])
        origin = min(0, int(stamp.min()))
        return stamp - origin, origin

    def _table(self, quantity: Quantity) -> Table:
        path = self.path if quantity.file is None else self.path.parent / quantity.file
        if path not in self._tables:
            self._tables[path] = Table.read(path, self._map.format)
        return self._tables[path]

    def _columns(self, name: str, quantity: Quantity) -> list[Column]:
        """One column per joint of the log."""
        count = len(self._robot.joint_names)
        if isinstance(quantity.columns, str):
            if "{}" not in quantity.columns:
                raise SourceError(
                    self.path,
                    f"the pattern {quantity.columns!r} has no place for the joint's number",
                    field=f"{name}.columns",
                    remedy='write {} there, as in "q{}"',
                )
            return [quantity.columns.replace("{}", str(joint + 1)) for joint in range(count)]
        self._check_length(quantity.columns, f"{name}.columns")
        return list(quantity.columns)

    def _joint_order(self) -> list[int]:
        """Which column of the log each joint of the robot has."""
        wanted, given = self._robot.joint_names, self._map.joints
        if given is None:
            return list(range(len(wanted)))
        if sorted(given) != sorted(wanted):
            raise SourceError(
                self.path,
                f"the map names the joints {', '.join(given)}",
                field="joints",
                remedy=f"the robot's joints are {', '.join(wanted)}",
            )
        return [given.index(name) for name in wanted]

    def _motor_from_joint(self) -> Array:
        """Motor angles per joint angle (n, n), in the log's order."""
        drive, n = self._map.drive, len(self._robot.joint_names)
        for name in ("gear_ratio", "joint_offset", "torque_constant"):
            values = getattr(drive, name)
            if values is not None:
                self._check_length(values, f"drive.{name}")
        matrix = np.diag(drive.gear_ratio or np.ones(n)).astype(np.float64)
        for motor, joint, ratio in drive.coupling:
            if max(motor, joint) > n:
                raise SourceError(
                    self.path,
                    f"there are {n} joints, not {max(motor, joint)}",
                    field="drive.coupling",
                )
            matrix[motor - 1, joint - 1] = ratio
        if np.linalg.matrix_rank(matrix) < n:
            raise SourceError(
                self.path, "a joint would not be moved by any motor", field="drive.gear_ratio"
            )
        return matrix

    def _check_length(self, values: Sequence[object] | Array, field: str) -> None:
        names = self._robot.joint_names
        if len(values) != len(names):
            raise SourceError(
                self.path,
                f"has {len(values)} entries",
                field=field,
                remedy=f"one for each of the joints {', '.join(names)}",
            )


def _joint_side(values: dict[str, Array], columns: ColumnMap, log: _Log) -> dict[str, Array]:
    """Bring the quantities to the joint side and into the robot's order; power stays the same.

    With motor angles M q, joint torques are M^T times the motors'.
    """
    matrix = log.matrix
    sides = {name: quantity.side for name, quantity in columns.quantities().items()}
    joint = dict(values)
    for name in ("position", "velocity"):
        if sides.get(name) == "motor":
            joint[name] = np.asarray(np.linalg.solve(matrix, values[name].T).T, np.float64)
    if sides.get("torque") == "motor":
        joint["torque"] = values["torque"] @ matrix
    drive = columns.drive
    if drive.joint_offset is not None:
        joint["position"] = joint["position"] + np.asarray(drive.joint_offset)
    if "torque" not in joint and "motor_current" in joint and drive.torque_constant is not None:
        motor_torque = joint["motor_current"] * np.asarray(drive.torque_constant, np.float64)
        joint["torque"] = motor_torque @ matrix
    return {name: array[:, log.order] for name, array in joint.items()}
