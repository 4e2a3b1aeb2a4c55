"""Import of logs of numbers: text in columns, text matrices, files of arrays."""

from __future__ import annotations

import json
import os
from collections.abc import Collection, Mapping, Sequence
from decimal import Decimal
from os import PathLike
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from hil.archive import Samples
from hil.errors import SourceError
from hil.importers.arrays import READERS, ArrayFile
from hil.importers.column_map import HOLE, TIMES, UNITS, ColumnMap, Quantity
from hil.importers.robot import NOT_RECORDED, Robot, Use, write_imported
from hil.importers.table import Table

Array = NDArray[np.float64]

_MORE: Final = 64  # columns or files beyond the joints that are tried
_LATEST = 2**31 * 10**9  # ns, largest stamp of an archive


def import_log(
    source: str | PathLike[str],
    output: str | PathLike[str],
    *,
    robot: Robot,
    columns: ColumnMap,
    held_joints: Sequence[str] = (),
    use: Use = "excitation",
    coupled: bool = True,
    force: bool = False,
    outside_limits: bool = False,
) -> Path:
    """Convert a log to an archive of kind ``imported``, and return its path.

    The source is the log; with quantities in several files, one of them or their folder. Where the
    map couples joints, the model gets the inertias and the friction of the coupled motors, unless
    its cell states otherwise or `coupled` is false. Angles and torques always use the coupling.

    With `force` an existing archive is replaced; `outside_limits` accepts positions of which no row
    is within the limits of the URDF.

    Raises:
        SourceError: a file cannot be read, a column is missing, a cell is not a number, or the map
            does not fit the robot.
        ArchiveWriteError: the archive exists or cannot be written.
    """
    log = _Log(Path(source), columns, robot)
    with np.errstate(over="ignore", invalid="ignore"):  # such numbers are refused later
        values = {name: log.read(name) for name in columns.quantities()}
    stamp, timed, origin, clock = log.stamps(len(values["position"]))
    _check_lengths({**values, "time": stamp}, log.path, "quantities")
    metadata = {"importer": "log", "clock_origin_ns": str(origin)}
    if columns.format.missing == "drop":
        known = [timed, *(np.isfinite(array).all(axis=1) for array in values.values())]
        complete = np.all(known, axis=0)
        metadata["dropped_rows"] = str(np.count_nonzero(~complete))
        stamp, values = stamp[complete], {name: array[complete] for name, array in values.items()}
    if columns.drive.geared:
        matrix = log.matrix[np.ix_(log.order, log.order)]
        metadata["motor_from_joint"] = json.dumps(matrix.tolist())
        if coupled and np.any(matrix != np.diag(np.diag(matrix))):
            robot = robot.with_coupling(matrix)
    if (uncertainty := columns.drive.torque_uncertainty) is not None:
        each = np.broadcast_to(uncertainty, len(log.joints))[log.order]
        metadata["torque_uncertainty"] = json.dumps(each.tolist())
    with np.errstate(over="ignore", invalid="ignore"):
        joint_side = _joint_side(values, columns, log)
    return write_imported(
        output,
        Samples(stamp, **joint_side),
        source=[*log.files],
        robot=robot,
        metadata=metadata,
        held_joints=held_joints,
        period=None if columns.sample_rate is None else 1.0 / columns.sample_rate,
        use=use,
        clock=clock,
        force=force,
        outside_limits=outside_limits,
    )


class _Log:
    """The files of a log with their map.

    Attributes:
        path: the log itself.
        files: those that were read, by path, the log first.
        joints: of the log, in its order.
        order: the log's column of each joint of the robot.
        matrix: motor angles per joint angle (k, k), in the log's order.
    """

    def __init__(self, path: Path, columns: ColumnMap, robot: Robot) -> None:
        self.path = path
        self._folder = path if path.is_dir() else path.parent
        self._map = columns
        self.files: dict[Path, Table | ArrayFile] = {}
        self.joints = columns.joints or robot.joint_names
        self.order = self._joint_order(robot)
        self.matrix = self._motor_from_joint()

    def read(self, name: str) -> Array:
        """Return a quantity in SI units, (m, k), columns in the log's joint order."""
        quantity = self._map.quantities()[name]
        values = self._numbers(name, quantity)
        factor = UNITS[name][quantity.unit] if quantity.unit else 1.0
        for key, value in (("scale", quantity.scale), ("offset", quantity.offset)):
            if isinstance(value, tuple):
                self._check_count(value, f"{name}.{key}")
        return np.asarray((values + quantity.offset) * np.multiply(factor, quantity.scale))

    def stamps(self, count: int) -> tuple[NDArray[np.int64], NDArray[np.bool_], int, Path]:
        """Return stamps [ns], which are known, the origin that was subtracted, and their file."""
        time, rate, position = self._map.time, self._map.sample_rate, self._map.position
        if time is None:
            assert rate is not None
            stamps = np.rint(np.arange(count) * (1e9 / rate)).astype(np.int64)
            return stamps, np.ones(count, np.bool_), 0, self.path
        if time.file is None and position.files is not None:
            first, *others = self._file_per_joint(position.files, "position.files")
        else:
            first, *others = (self._file(time.file or position.file, "time.file"),)
        times = first.times(time.column, TIMES[time.unit], time.array)
        for other in others:
            if other.times(time.column, TIMES[time.unit], time.array) != times:
                problem = f"has other times than {first.path.name}"
                remedy = "name one file of times for all joints: [time] file"
                raise SourceError(other.path, problem, field="time", remedy=remedy)
        known = [one for one in times if one is not None]
        if not known or (len(known) < len(times) and self._map.format.missing == "refuse"):
            problem = f"has no time in sample {times.index(None)}"
            raise SourceError(first.path, problem, field="time", remedy=HOLE)
        origin = 0 if min(known) >= 0 and max(known) < _LATEST else min(known)
        if max(known) - origin >= _LATEST:
            problem = f"spans {Decimal(max(known) - min(known)).scaleb(-9):.3g} s"
            remedy = "give the unit of its time: s, ms, us or ns"
            raise SourceError(first.path, problem, field="time", remedy=remedy)
        stamps = np.array([0 if one is None else one - origin for one in times], np.int64)
        return stamps, np.array([one is not None for one in times]), origin, first.path

    def _numbers(self, name: str, quantity: Quantity) -> Array:
        """Return the numbers of a quantity as in the file, (m, k)."""
        field, columns, array = f"{name}.columns", quantity.columns, quantity.array
        if quantity.files is not None:
            return self._joint_by_joint(name, quantity, quantity.files)
        file = self._file(quantity.file, f"{name}.file")
        if isinstance(columns, str) and "{}" in columns:
            columns = tuple(self._numbered(columns, file.names, "columns", field))
        if columns is None or (isinstance(columns, str) and isinstance(file, ArrayFile)):
            return self._upright(file.matrix(columns or array, field), quantity, file.path, name)
        columns = (columns,) if isinstance(columns, str) else columns
        self._check_count(columns, field)
        if isinstance(file, ArrayFile):
            return file.numbers(columns, field, array, rows=quantity.joints_along == "rows")
        return file.numbers(columns, field, array)

    def _joint_by_joint(self, name: str, quantity: Quantity, names: str | Sequence[str]) -> Array:
        """Return the numbers of a quantity that has a file per joint, (m, k)."""
        files, columns = self._file_per_joint(names, f"{name}.files"), quantity.columns
        field, found = f"{name}.columns", []
        if isinstance(columns, str):
            columns = tuple(columns.replace("{}", str(k)) for k in range(1, len(files) + 1))
        elif columns is not None and len(columns) == 1:
            columns *= len(files)
        if columns is not None:
            self._check_count(columns, field)
        for joint, file in enumerate(files):
            if columns is not None:
                values = file.numbers([columns[joint]], field, quantity.array)
            else:
                values = file.matrix(quantity.array, field)
            if 1 not in values.shape:
                problem = f"has the shape {values.shape}, expected one column"
                remedy = "name one of each file, by name or by index from 0: columns = [1]"
                raise SourceError(file.path, problem, field=field, remedy=remedy)
            found.append(values.ravel())
        places = [os.path.relpath(file.path, self._folder) for file in files]
        lengths = dict(zip(places, found, strict=True))
        _check_lengths(lengths, self.path, "files", f"{name}.files")
        return np.column_stack(found)

    def _file_per_joint(self, names: str | Sequence[str], field: str) -> list[Table | ArrayFile]:
        if isinstance(names, str):
            numbers = range(len(self.joints) + _MORE)
            possible = [names.replace("{}", str(number)) for number in numbers]
            found = [name for name in possible if (self._folder / name).is_file()]
            names = self._numbered(names, found, "files", field)
        self._check_count(names, field)
        return [self._file(name, field) for name in names]

    def _numbered(
        self, pattern: str, known: Collection[str], what: Literal["columns", "files"], field: str
    ) -> list[str]:
        """Return names of columns or files from a pattern, numbered from 1, or else from 0."""
        count = len(self.joints)
        names = [pattern.replace("{}", str(number)) for number in range(count + _MORE)]
        first = 0 if names[0] in known and names[count] not in known else 1
        found = names[first : first + count]
        missing = [name for name in found if name not in known]
        if missing:
            joint = found.index(missing[0])
            raise SourceError(
                self.path,
                f"there is no {what[:-1]} {missing[0]!r} for {self.joints[joint]}, joint "
                f"{joint + 1} of {count}; there are {', '.join(known) or 'none'}",
                field=field,
                remedy=f"{NOT_RECORDED}, name the joints of the log in joints, or list its {what}",
            )
        present = [name for name in names if name in known]
        if len(present) > count:
            raise SourceError(
                self.path,
                f"{len(present)} {what} are called {pattern!r} ({present[0]} to {present[-1]}), "
                f"and there are {count} joints: {', '.join(self.joints)}",
                field=field,
                remedy=f"name the URDF's joint of each in joints, or list {count} {what}",
            )
        return found

    def _upright(self, matrix: Array, quantity: Quantity, path: Path, name: str) -> Array:
        """Return a whole matrix with time along its rows."""
        count, along = len(self.joints), quantity.joints_along
        if along is None:
            if matrix.shape == (count, count):
                problem = f"{name} is a square matrix"
                remedy = 'state whether joints are along "columns" or "rows"'
                raise SourceError(path, problem, field=f"{name}.joints_along", remedy=remedy)
            along = "rows" if matrix.shape[0] < matrix.shape[1] else "columns"
        upright = matrix.T if along == "rows" else matrix
        if upright.shape[1] != count:
            raise SourceError(
                path,
                f"{name} has the shape {matrix.shape}, joints along its {along}, and there are "
                f"{count} joints: {', '.join(self.joints)}",
                field=name,
                remedy=f"{NOT_RECORDED}, name the joints of the log in joints, or give the columns "
                "of the joints",
            )
        return upright

    def _file(self, name: str | None, field: str) -> Table | ArrayFile:
        if name is None and self.path.is_dir():
            problem = "is a folder"
            remedy = 'name a file in it: file = "q.txt", or one per joint: files = "q_{}.txt"'
            raise SourceError(self.path, problem, field=field, remedy=remedy)
        path = self.path if name is None else self._folder / name
        if path not in self.files:
            arrays = path.suffix.lower() in READERS
            read = ArrayFile(path) if arrays else Table.read(path, self._map.format)
            self.files[path] = read
        return self.files[path]

    def _joint_order(self, robot: Robot) -> list[int]:
        """Return the column of the log of each joint of the robot."""
        missing = [name for name in robot.joint_names if name not in self.joints]
        if missing or len(set(self.joints)) < len(self.joints):
            raise SourceError(
                self.path,
                f"the map names the joints {', '.join(self.joints)}",
                field="joints",
                remedy=f"the robot's joints are {', '.join(robot.joint_names)}; name each once, or "
                f"{NOT_RECORDED}",
            )
        return [self.joints.index(name) for name in robot.joint_names]

    def _motor_from_joint(self) -> Array:
        """Return motor angles per joint angle (k, k), in the log's order."""
        drive, n = self._map.drive, len(self.joints)
        for name in ("gear_ratio", "joint_offset", "torque_constant", "motor_from_joint"):
            if (values := getattr(drive, name)) is not None:
                self._check_count(values, f"drive.{name}")
        if isinstance(drive.torque_uncertainty, tuple):
            self._check_count(drive.torque_uncertainty, "drive.torque_uncertainty")
        for row in drive.motor_from_joint or ():
            self._check_count(row, "drive.motor_from_joint")
        diagonal = np.diag(drive.gear_ratio or np.ones(n))
        matrix = np.array(drive.motor_from_joint or diagonal.tolist(), np.float64)
        for motor, joint, ratio in drive.coupling:
            if max(motor, joint) > n:
                problem = f"there are {n} joints, not {max(motor, joint)}"
                raise SourceError(self.path, problem, field="drive.coupling")
            matrix[motor - 1, joint - 1] = ratio
        if np.linalg.matrix_rank(matrix) < n:
            problem = "no motor would move one of the joints"
            raise SourceError(self.path, problem, field="drive.gear_ratio")
        return matrix

    def _check_count(self, values: Sequence[object] | Array, field: str) -> None:
        if len(values) != len(self.joints):
            problem = f"has {len(values)} entries"
            remedy = f"one for each of the joints {', '.join(self.joints)}"
            raise SourceError(self.path, problem, field=field, remedy=remedy)


def _check_lengths(
    arrays: Mapping[str, NDArray[Any]], path: Path, what: str, field: str = ""
) -> None:
    if len({len(array) for array in arrays.values()}) > 1:
        listing = ", ".join(f"{name} {len(array)}" for name, array in arrays.items())
        problem = f"the {what} differ in length: {listing}"
        raise SourceError(path, problem, field=field, remedy="cut them alike")


def _joint_side(values: dict[str, Array], columns: ColumnMap, log: _Log) -> dict[str, Array]:
    """Convert the quantities to the joint side and the robot's order, conserving power.

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
        joint["position"] = joint["position"] + drive.joint_offset
    if "torque" not in joint and "motor_current" in joint and drive.torque_constant is not None:
        joint["torque"] = (joint["motor_current"] * drive.torque_constant) @ matrix
    return {name: array[:, log.order] for name, array in joint.items()}
