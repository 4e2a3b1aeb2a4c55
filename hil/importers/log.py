"""Import of logs of numbers: text in columns, text matrices, files of arrays."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from decimal import Decimal
from os import PathLike
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple, NoReturn

import numpy as np
from numpy.typing import NDArray

from hil.archive import ImportedSamples
from hil.archive.imported import COPIED_COMMANDS, ROW_COUNTER
from hil.base.arrays import Array
from hil.base.errors import SourceError, UnrecordedJointError
from hil.importers.array_files import ArrayFile
from hil.importers.channel_groups import grouped
from hil.importers.channels import named_channels
from hil.importers.clock_offset import clock_offset
from hil.importers.column_map import HOLE, KINEMATIC, ColumnMap, Quantity, TimeColumn
from hil.importers.command_copies import copied_commands
from hil.importers.conclusions import (
    ConcludedUnit,
    Conclusion,
    CopiedCommands,
    EncoderTicks,
    JointOrder,
    LeftOut,
    MappedUnit,
    MissingNumbers,
    Omitted,
    OtherClock,
    RowCounter,
    StatedUnit,
)
from hil.importers.imported_robot import NOT_RECORDED, Robot
from hil.importers.log_files import LogFiles
from hil.importers.plausibility import are_degrees, command_size, has_degrees_per_second
from hil.importers.publishers import second_publisher
from hil.importers.recording_content import RecordingContent, Use
from hil.importers.resampling import Timed, are_interleaved, on_one_base
from hil.importers.row_names import row_names
from hil.importers.servo_numbers import (
    are_per_mille,
    encoder_of,
    sign_bit_of,
    signed,
)
from hil.importers.stamps import (
    YEAR_NS,
    concluded_unit,
    is_row_counter,
    sorted_neighbours,
    without_restarts,
    without_wraps,
)
from hil.importers.stated_units import other_unit
from hil.importers.text_table import TextTable
from hil.importers.units import RATED, TIMES, UNITS, factor_of, kind_named, unit_of

_EXTRA_COLUMNS: Final = 64  # columns or files beyond the joints that are tried
_ALIKE: Final = 1.5  # factor between the travels of a joint and of its command
_MAX_STAMP_NS: Final = 2**31 * 10**9  # ns, largest stamp of an archive
_MAX_SPAN_NS: Final = 2**62  # ns between two times, 146 years


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

    Angles and torques always use the coupling of joints.

    Args:
        source: the log; with quantities in several files, one of them or their folder.
        output: path of the archive.
        robot: that was recorded.
        columns: map of the log.
        held_joints: joints that were clamped.
        use: of the recording: fitted, or held out.
        coupled: whether the model gets the inertias and the friction of the motors that the map
            couples, unless its cell states otherwise.
        force: replace an existing archive.
        outside_limits: accept positions of which no row is within the limits of the URDF.

    Raises:
        SourceError: a file cannot be read, a column is missing, a cell is not a number, or the map
            does not fit the robot.
        ArchiveWriteError: the archive exists or cannot be written.
    """
    content = read_log(source, robot=robot, columns=columns, coupled=coupled)
    content.write(
        output,
        held_joints=held_joints,
        use=use,
        force=force,
        outside_limits=outside_limits or columns.outside_limits,
    )
    return Path(output)


def read_log(
    source: str | PathLike[str],
    *,
    robot: Robot,
    columns: ColumnMap,
    coupled: bool = True,
    files: LogFiles | None = None,
) -> RecordingContent:
    """Read a log; see :func:`import_log`.

    Args:
        source: the log; with quantities in several files, one of them or their folder.
        robot: that was recorded.
        columns: map of the log.
        coupled: whether the model gets coupled motors.
        files: that were parsed before.

    Raises:
        SourceError: a file cannot be read, a column is missing, a cell is not a number, or the map
            does not fit the robot.
    """
    log = _Log(Path(source), columns, robot, files or LogFiles())
    with np.errstate(over="ignore", invalid="ignore"):  # such numbers are refused later
        values = {name: log.read(name) for name in columns.quantities()}
    clock = log.clock(len(values["position"]))
    clock, values = log.on_one_clock(clock, values)
    _check_lengths({**values, "time": clock.stamp}, log.path, "quantities")
    metadata = {"importer": "log", "clock_origin_ns": str(clock.origin)}
    complete = log.complete_rows(clock, values)
    if columns.format.missing == "drop":
        metadata["dropped_rows"] = str(np.count_nonzero(~complete))
    samples = log.samples(clock, values, complete, robot)
    if columns.drive.geared:
        matrix = log.matrix[np.ix_(log.order, log.order)]
        metadata["motor_from_joint"] = json.dumps(matrix.tolist())
        if coupled and np.any(matrix != np.diag(np.diag(matrix))):
            robot = robot.with_coupling(matrix)
    copied = log.copied_commands()
    if copied is not None:
        log.concluded.append(copied)
        metadata[COPIED_COMMANDS] = copied.commands
    counters = [each for each in log.concluded if isinstance(each, RowCounter)]
    if counters:
        metadata[ROW_COUNTER] = counters[0].unit
    if (uncertainty := columns.drive.torque_uncertainty) is not None:
        each = np.broadcast_to(uncertainty, len(log.joints))[log.order]
        metadata["torque_uncertainty"] = json.dumps(each.tolist())
    left_out = (omitted for file in log.files.values() for omitted in file.left_out)
    return RecordingContent(
        samples,
        robot,
        source=tuple(log.files),
        metadata=metadata,
        concluded=(*log.concluded, *left_out),
        period=None if columns.sample_rate is None else 1.0 / columns.sample_rate,
        clock=clock.path,
    )


def are_in_rows_of_their_own(
    source: Path, *, robot: Robot, columns: ColumnMap, files: LogFiles
) -> bool:
    """Return whether a table has its quantities in different rows, as of two topics.

    Args:
        source: the table.
        robot: that was recorded.
        columns: a map that interpolates.
        files: that were parsed before.

    Raises:
        SourceError: the map does not fit the log.
    """
    log = _Log(source, columns, robot, files)
    finite = [np.asarray(np.isfinite(log.read(name)).all(axis=1)) for name in columns.quantities()]
    return len(set(map(len, finite))) == 1 and are_interleaved(finite)


class _Clock(NamedTuple):
    """Stamps of a log."""

    stamp: NDArray[np.int64]  #: (m,) [ns], after the origin
    valid: NDArray[np.bool_]  #: (m,) rows whose time is known
    origin: int  #: [ns], was subtracted
    path: Path  #: of the file that has them

    @property
    def times(self) -> list[int]:
        """Times [ns] with the origin."""
        return [int(stamp) + self.origin for stamp in self.stamp]


class _Log:
    """The files of a log with their map.

    Attributes:
        path: the log itself.
        files: those that were read, by path, the log first.
        joints: of the log, in its order.
        order: the log's column of each joint of the robot.
        matrix: motor angles per joint angle (k, k), in the log's order.
        concluded: where neither map nor file states it.
    """

    def __init__(self, path: Path, columns: ColumnMap, robot: Robot, parsed: LogFiles) -> None:
        self.path = path
        self._parsed = parsed
        self._folder = path if path.is_dir() else path.parent
        self._map = columns
        self.files: dict[Path, TextTable | ArrayFile] = {}
        self.concluded: list[Conclusion] = []
        self.joints = columns.joints or self._row_names(robot.joint_names)
        self.order = self._joint_order(robot)
        self.matrix = self._motor_from_joint()
        self._unstated: set[str] = set()  # quantities whose unit nothing states

    def read(self, name: str) -> Array:
        """Return a quantity in SI units, (m, k), columns in the log's joint order."""
        quantity = self._map.quantities()[name]
        values, units = self._numbers(name, quantity)
        if len(values) and values.shape[1] == len(self.joints):
            self._require_any(name, values)
        scales = {"scale": quantity.scale, "offset": quantity.offset, "rated": quantity.rated}
        for key, value in scales.items():
            if isinstance(value, tuple):
                self._check_count(value, f"{name}.{key}")
        factor = self._factor(name, quantity, units)
        if quantity.sign_bit is not None:
            values = signed(values, quantity.sign_bit)
        elif quantity.unit is None and name in ("torque", "motor_current"):
            self._refuse_encoded(name, quantity, values)
        return np.asarray((values + quantity.offset) * np.multiply(factor, quantity.scale))

    def _refuse_encoded(self, name: str, quantity: Quantity, values: Array) -> None:
        """Refuse torques or currents (m, k) in numbers of servos or drives, of no stated unit."""
        columns = quantity.columns
        names = [columns] if isinstance(columns, str) else [*map(str, columns or ())]
        bit = sign_bit_of(values)
        if bit is None and not are_per_mille(names, values):
            return
        problem = "has whole numbers and the name of object 6077h: per mille of a rated value"
        if bit is not None:
            problem = f"is a magnitude with the sign in bit {bit}, as servos write their load"
        entries = [] if columns is None else [f"columns = {json.dumps(columns)}"]
        entries += [] if bit is None else [f"sign_bit = {bit}"]
        unit = next(iter(UNITS[name]))
        entries += [f'unit = "{RATED[1]}"', f"rated = [...], the {unit} of each joint at 1000"]
        remedy = f"state it in a map (--map): [{name}] {', '.join(entries)}"
        raise SourceError(self.path, problem, field=name, remedy=remedy)

    def _require_any(self, name: str, values: Array) -> None:
        """Refuse a quantity (m, k) that some joints have and others have in no row."""
        has = np.isfinite(values).any(axis=0)
        if has.all() or not has.any():
            return
        joint = self.joints[int(np.argmin(has))]
        problem = f"joint {joint} has no number in any row, the others have"
        remedy = f"give the column that has it, or leave out [{name}]"
        if name == "position":
            remedy = f"give the column that has it, or lock the joint: --locked {joint}=POSITION"
        raise SourceError(self.path, problem, field=name, remedy=remedy)

    def _factor(self, name: str, quantity: Quantity, stated: Sequence[str | None]) -> float | Array:
        """Return the factors to SI units: of the map's unit, or of the units in the file.

        Raises:
            SourceError: the file states another unit, or parts of a rated value are of none.
        """
        mapped = None if quantity.unit is None else unit_of(quantity.unit, name)
        if mapped is None:
            stated = [self._known_unit(name, quantity, unit) for unit in stated]
        others = [unit for unit in stated if unit not in (None, mapped)]
        if mapped is None and len(others) < len(stated):
            self._unstated.add(name)
            if not others:
                return 1.0
        if mapped is not None and others:
            self.concluded.append(MappedUnit(kind_named(name), mapped, str(others[0])))
        elif mapped is None:
            self.concluded.append(StatedUnit(kind_named(name), str(others[0])))
        units = [mapped or unit or next(iter(UNITS[name])) for unit in stated]
        if quantity.rated is None and (parts := next((u for u in units if u in RATED), None)):
            parts_of = "per cent" if parts == RATED[0] else "per mille"
            problem = f"is in {parts_of} of a rated value that the map does not state"
            remedy = (
                f"add to [{name}]: rated = [...], the value of each joint that is "
                f"{100 if parts == RATED[0] else 1000} {parts} (--map)"
            )
            raise SourceError(self.path, problem, field=name, remedy=remedy)
        factors = np.array([factor_of(unit, name) for unit in units])
        rated = 1.0 if quantity.rated is None else np.asarray(quantity.rated)
        return np.where(np.isin(units, RATED), factors * rated, factors)

    def _known_unit(self, name: str, quantity: Quantity, unit: str | None) -> str | None:
        """Return a unit that the file states, of a quantity; None if it states none."""
        if unit is None:
            return None
        known = unit_of(unit, name)
        if known is None:
            columns = quantity.columns
            names = columns if isinstance(columns, str) else ", ".join(map(str, columns or ()))
            raise other_unit(self.path, kind_named(name), names or name, unit)
        return known

    def clock(self, count: int) -> _Clock:
        """Return the stamps of a log with this number of rows."""
        time = self._map.time
        rate = self._map.sample_rate
        position = self._map.position
        if time is None:
            assert rate is not None
            self._refuse_interrupted()
            stamps = np.rint(self._row_numbers(count) * (1e9 / rate)).astype(np.int64)
            return _Clock(stamps, np.ones(count, np.bool_), 0, self.path)
        return self._clock_of(time, position, "position")

    def _refuse_interrupted(self) -> None:
        """Raise SourceError for an empty line in a log that has no times: rows may be missing."""
        for file in self.files.values():
            line = file.interrupted if isinstance(file, TextTable) else None
            if line is None:
                continue
            problem = f"line {line} is empty, and no time tells whether rows are missing there"
            remedy = (
                "cut the log there; where empty lines mean nothing: --drop-missing, or with a map "
                "[format] skip_empty = true; to skip lines of a header: [format] skip_rows"
            )
            raise SourceError(file.path, problem, field="time", remedy=remedy)

    def _row_numbers(self, count: int) -> NDArray[np.intp]:
        """Return the place of each row of the positions in their file (m,), from 0."""
        position = self._map.position
        if position.files is not None:
            file, *_ = self._file_per_joint(position.files, "position.files")
        else:
            file = self._file(position.file, "position.file")
        return file.row_numbers if isinstance(file, TextTable) else np.arange(count)

    def _clock_of(self, time: TimeColumn, quantity: Quantity, name: str) -> _Clock:
        """Return the stamps of a quantity by its column of times."""
        if time.file is None and quantity.files is not None:
            first, *others = self._file_per_joint(quantity.files, f"{name}.files")
        else:
            first, *others = (self._file(time.file or quantity.file, "time.file"),)
        times = self._times(first, time)
        for other in others:
            if self._times(other, time) != times:
                problem = f"has other times than {first.path.name}"
                remedy = "give one file of times for all joints: [time] file"
                raise SourceError(other.path, problem, field="time", remedy=remedy)
        valid = np.array([time is not None for time in times])
        if not valid.any() or (not valid.all() and self._map.format.missing == "refuse"):
            problem = f"has no time in sample {times.index(None)}"
            raise SourceError(first.path, problem, field="time", remedy=HOLE)
        return self._within_archive(times, valid, first.path)

    def on_one_clock(
        self, clock: _Clock, values: dict[str, Array]
    ) -> tuple[_Clock, dict[str, Array]]:
        """Return quantities at common times, interpolated if they have their own.

        Raises:
            SourceError: they have no common time.
        """
        quantities = self._map.quantities()
        clocks = {
            name: self._clock_of(quantity.time, quantity, name)
            for name, quantity in quantities.items()
            if quantity.time is not None
        }
        differ = any(own.times != clock.times for own in clocks.values())
        if not differ and self._map.format.missing != "interpolate":
            return clock, values
        parts = {}
        for name, array in values.items():
            own = clocks.get(name, clock)
            _check_lengths({name: array, "time": own.stamp}, self.path, "quantities")
            stamp = own.stamp[own.valid] + (own.origin - clock.origin)
            parts[name] = Timed(stamp, array[own.valid])
        if "commanded_position" in clocks:
            parts = self._with_commands_moved(parts)
        joined = on_one_base(parts, self.path)
        self.concluded.append(joined.conclusion)
        valid = np.ones(len(joined.stamp), np.bool_)
        return _Clock(joined.stamp, valid, clock.origin, clock.path), joined.values

    def _with_commands_moved(self, parts: dict[str, Timed]) -> dict[str, Timed]:
        """Return quantities with commands on the clock of the positions."""
        command = parts["commanded_position"]
        offset = clock_offset(parts["position"], command)
        if offset is None:
            return parts
        self.concluded.append(OtherClock(1e-9 * offset))
        return {**parts, "commanded_position": Timed(command.stamp + offset, command.values)}

    def _times(self, file: TextTable | ArrayFile, time: TimeColumn) -> Sequence[int | None]:
        """Return the times of a file [ns], None where one is missing."""
        if time.nanoseconds is None:
            unit = time.unit or self._unit_of_time(file, time)
            if time.unit is not None and is_row_counter(_unbroken(file, time, 0)):
                counter = RowCounter(str(time.column), time.unit)
                if counter not in self.concluded:
                    self.concluded.append(counter)
            return file.times(time.column, TIMES[unit], time.array)
        whole = file.times(time.column, TIMES["s"], time.array)
        parts = file.times(time.nanoseconds, TIMES["ns"], time.array)
        return [
            None if second is None or part is None else second + part
            for second, part in zip(whole, parts, strict=True)
        ]

    def _unit_of_time(self, file: TextTable | ArrayFile, time: TimeColumn) -> str:
        """Return the unit of a time column where the map states none."""
        written = file.unit(time.column) or ""
        stated = unit_of(written, "time")
        if stated is not None:
            return stated
        if unit_of(written) is not None:
            raise other_unit(file.path, "time", str(time.column), written)
        times = _unbroken(file, time, TIMES["s"])
        if is_row_counter(times):
            problem = f"column {time.column} counts the rows from {int((times[0] or 0) / 1e9)}"
            remedy = (
                "state the rate of the controller: --sample-rate HZ, or with a map sample_rate and "
                "no [time]"
            )
            raise SourceError(file.path, problem, field="time", remedy=remedy)
        unit = concluded_unit(times)
        if unit != "s":
            self.concluded.append(ConcludedUnit("time", unit))
        return unit

    def _within_archive(
        self, times: Sequence[int | None], valid: NDArray[np.bool_], path: Path
    ) -> _Clock:
        """Return times [ns] as stamps that an archive can hold, wraps continued."""
        zeros = next((row for row, time in enumerate(times) if time), 0)
        if zeros and abs(times[zeros] or 0) > YEAR_NS:
            self.concluded.append(LeftOut(Omitted.ZERO_TIMES, zeros))
            valid = valid & (np.arange(len(times)) >= zeros)
        base = times[int(np.argmax(valid))] or 0
        # Differences are taken before numbers of any size become 64-bit ones.
        shifted = [
            time - base if time is not None and row else 0
            for time, row in zip(times, valid, strict=True)
        ]
        if max(map(abs, shifted)) >= _MAX_SPAN_NS:
            self._raise_span(max(map(abs, shifted)), path)
        stamp = np.array(shifted, np.int64)
        continued = without_wraps(stamp[valid])
        if continued.wrapped is not None:
            self.concluded.append(continued.wrapped)
        low = base + int(continued.stamp.min())
        high = base + int(continued.stamp.max())
        origin = 0 if low >= 0 and high < _MAX_STAMP_NS else low
        if high - origin >= _MAX_STAMP_NS:
            self._raise_span(high - low, path)
        stamp[valid] = continued.stamp + (base - origin)
        return _Clock(stamp, valid, origin, path)

    @staticmethod
    def _raise_span(span: int, path: Path) -> NoReturn:
        problem = f"spans {Decimal(span).scaleb(-9):.3g} s"
        remedy = 'give the unit of its time: [time] unit = "s", "ms", "us" or "ns"'
        raise SourceError(path, problem, field="time", remedy=remedy)

    def complete_rows(self, clock: _Clock, values: Mapping[str, Array]) -> NDArray[np.bool_]:
        """Return the rows with a time, and where the map drops others with all numbers (m,).

        Raises:
            SourceError: no row has all.
        """
        if self._map.format.missing != "drop":
            return clock.valid
        finite = [np.isfinite(array).all(axis=1) for array in values.values()]
        complete = np.all([clock.valid, *finite], axis=0)
        dropped = np.flatnonzero(~complete)
        if len(dropped) == len(complete):
            problem = "has a missing number in every row"
            remedy = (
                "check the columns of the map, delimiter and decimal mark ([format]); quantities "
                'in rows of their own need [format] missing = "interpolate" instead'
            )
            raise SourceError(self.path, problem, remedy=remedy)
        if dropped.size:
            missing = MissingNumbers(len(dropped), len(complete), int(dropped[0]))
            self.concluded.append(missing)
        return np.asarray(complete)

    def samples(
        self,
        clock: _Clock,
        values: Mapping[str, Array],
        complete: NDArray[np.bool_],
        robot: Robot,
    ) -> ImportedSamples:
        """Return the complete rows (m,) on the joint side, sorted, of the first publisher."""
        rows = np.flatnonzero(complete)
        swapped = sorted_neighbours(clock.stamp[rows], "row")
        if swapped.swapped is not None:
            self.concluded.append(swapped.swapped)
        rows = rows[swapped.order]
        restarted = without_restarts(clock.stamp[rows])
        if restarted.restarted is not None:
            self.concluded.append(restarted.restarted)
        stamp = restarted.stamp
        joint = self.in_concluded_units(
            stamp, {name: array[rows] for name, array in values.items()}, robot
        )
        silent = second_publisher(joint["position"], "row")
        if silent.publisher is not None:
            self.concluded.append(silent.publisher)
            stamp = stamp[~silent.rows]
            joint = {name: array[~silent.rows] for name, array in joint.items()}
        return ImportedSamples(stamp, **joint)

    @np.errstate(over="ignore", invalid="ignore")  # such numbers are refused later
    def in_concluded_units(
        self, stamp: NDArray[np.int64], values: dict[str, Array], robot: Robot
    ) -> dict[str, Array]:
        """Return quantities of the joint side, in degrees or ticks where no unit is stated.

        Positions are taken as degrees, or as ticks of an encoder, if as radians they leave the
        limits of the URDF by far and in this unit none does; velocities, if they are 57.3 times the
        slope of the positions; commands, if they move 57.3 times as far as the positions, or as
        positions in degrees that were converted.
        """
        joint = _joint_side(values, self._map, self)
        names = robot.joint_names
        degree = UNITS["position"]["deg"]
        for unit, offset, factor in self._other_units(values["position"]):
            others = {
                name: (array - offset) * factor
                if name in ("position", "commanded_position") and name in self._unstated
                else array
                for name, array in values.items()
            }
            converted = _joint_side(others, self._map, self)
            if are_degrees(joint["position"], converted["position"], names, robot.urdf):
                joint = converted
                values = others
                self.concluded.append(unit)
                break
        if "commanded_position" in self._unstated:
            values = self._commands_as_positions(values, joint)
            joint = _joint_side(values, self._map, self)
        if "velocity" in self._unstated and len(stamp) > 1:
            time = (stamp - stamp[0]) * 1e-9
            if has_degrees_per_second(time, joint["position"], joint["velocity"]):
                degrees = {**values, "velocity": values["velocity"] * degree}
                joint = _joint_side(degrees, self._map, self)
                self.concluded.append(ConcludedUnit("velocity", "deg/s"))
        return joint

    def _commands_as_positions(
        self, values: dict[str, Array], joint: Mapping[str, Array]
    ) -> dict[str, Array]:
        """Return quantities with commands in the unit of the positions, if they are in the other.

        Args:
            values: as in the file.
            joint: of the joint side.
        """
        size = command_size(joint["position"], joint["commanded_position"])
        for unit, factor in (("deg", math.radians(1.0)), ("rad", math.degrees(1.0))):
            if size is not None and 1.0 / _ALIKE < size * factor < _ALIKE:
                self.concluded.append(ConcludedUnit("commanded_position", unit))
                commanded = values["commanded_position"] * factor
                return {**values, "commanded_position": commanded}
        return values

    def _other_units(self, position: Array) -> Iterator[tuple[ConcludedUnit, float, float]]:
        """Yield units of positions (m, k) where none is stated: zero, and factor to rad."""
        if "position" not in self._unstated:
            return
        yield ConcludedUnit("position", "deg"), 0.0, UNITS["position"]["deg"]
        quantity = self._map.position
        is_raw = not np.any(quantity.offset) and np.all(np.asarray(quantity.scale) == 1.0)
        encoder = encoder_of(position) if is_raw else None
        if encoder is not None:
            ticks = EncoderTicks("position", "ticks", encoder.ticks, encoder.middle)
            yield ticks, encoder.middle, encoder.turn / encoder.ticks

    def copied_commands(self) -> CopiedCommands | None:
        """Return which commands of the log its positions copy bit for bit, None if they do not."""
        quantity = self._map.position
        if quantity.files is not None or self.path.is_dir():
            return None
        file = self._file(quantity.file, "position.file")
        groups = grouped(named_channels(file), self.joints)
        columns = quantity.columns
        if isinstance(columns, str) and "{}" in columns:
            used = self._numbered(columns, file.names, "columns", "position.columns", file.has)
        else:
            used = [columns] if isinstance(columns, str) else [*map(str, columns or ())]
        return copied_commands(self._numbers("position", quantity)[0], file, groups, used)

    def _numbers(self, name: str, quantity: Quantity) -> tuple[Array, list[str | None]]:
        """Return the numbers of a quantity as in the file, (m, k), and the units it states."""
        field = f"{name}.columns"
        columns = quantity.columns
        array = quantity.array
        if quantity.files is not None:
            return self._joint_by_joint(name, quantity, quantity.files)
        file = self._file(quantity.file, f"{name}.file")
        if isinstance(columns, str) and "{}" in columns:
            columns = tuple(self._numbered(columns, file.names, "columns", field, file.has))
        if columns is None or (isinstance(columns, str) and isinstance(file, ArrayFile)):
            matrix = file.matrix(columns or array, field)
            units = [file.unit(column) for column in range(matrix.shape[1])]
            upright = self._upright(matrix, quantity, file.path, name)
            return upright, units if upright is matrix else [None] * upright.shape[1]
        columns = (columns,) if isinstance(columns, str) else columns
        if len(columns) < len(self.joints):
            problem = f"has {len(columns)} entries"
            remedy = f"one for each of the joints {', '.join(self.joints)}; or {NOT_RECORDED}"
            raise UnrecordedJointError(
                self.path, problem, field=field, remedy=remedy, count=len(columns)
            )
        self._check_count(columns, field)
        units = [file.unit(column) for column in columns]
        if isinstance(file, ArrayFile):
            by_row = quantity.joints_along == "rows"
            return file.numbers(columns, field, array, rows=by_row), units
        return file.numbers(columns, field, array), units

    def _joint_by_joint(
        self, name: str, quantity: Quantity, names: str | Sequence[str]
    ) -> tuple[Array, list[str | None]]:
        """Return the numbers of a quantity that has a file per joint, (m, k), and their units."""
        files = self._file_per_joint(names, f"{name}.files")
        columns = quantity.columns
        field = f"{name}.columns"
        columns_of_files = []
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
                remedy = "choose one of each file, by name or by index from 0: columns = [1]"
                raise SourceError(file.path, problem, field=field, remedy=remedy)
            columns_of_files.append(values.ravel())
        places = [os.path.relpath(file.path, self._folder) for file in files]
        lengths = dict(zip(places, columns_of_files, strict=True))
        _check_lengths(lengths, self.path, "files", f"{name}.files")
        units = [
            file.unit(0 if columns is None else columns[joint]) for joint, file in enumerate(files)
        ]
        return np.column_stack(columns_of_files), units

    def _file_per_joint(
        self, names: str | Sequence[str], field: str
    ) -> list[TextTable | ArrayFile]:
        if isinstance(names, str):
            numbers = range(len(self.joints) + _EXTRA_COLUMNS)
            possible = [names.replace("{}", str(number)) for number in [*numbers, *self.joints]]
            file_names = [name for name in possible if (self._folder / name).is_file()]
            names = self._numbered(names, file_names, "files", field, file_names.__contains__)
        self._check_count(names, field)
        return [self._file(name, field) for name in names]

    def _numbered(
        self,
        pattern: str,
        available: Collection[str],
        what: Literal["columns", "files"],
        field: str,
        has: Callable[[str], bool],
    ) -> list[str]:
        """Return names of columns or files from a pattern: numbered from 1 or 0, or of joints."""
        by_joint = [pattern.replace("{}", joint) for joint in self.joints]
        if all(map(has, by_joint)):
            return by_joint
        count = len(self.joints)
        names = [pattern.replace("{}", str(number)) for number in range(count + _EXTRA_COLUMNS)]
        first = 0 if has(names[0]) and not has(names[count]) else 1
        chosen = names[first : first + count]
        missing = [name for name in chosen if not has(name)]
        if missing:
            joint = chosen.index(missing[0])
            named = [joint for joint, name in zip(self.joints, by_joint, strict=True) if has(name)]
            raise UnrecordedJointError(
                self.path,
                f"there is no {what[:-1]} {missing[0]!r} for {self.joints[joint]}, joint "
                f"{joint + 1} of {count}; there are {', '.join(available) or 'none'}",
                field=field,
                remedy=f"{NOT_RECORDED}, list the joints of the log in joints, or list its {what}",
                count=len(named) or sum(map(has, names)),
                joints=named,
                channels=filter(has, names),
            )
        present = [name for name in names if has(name)]
        if len(present) > count:
            raise SourceError(
                self.path,
                f"{len(present)} {what} are called {pattern!r} ({present[0]} to {present[-1]}), "
                f"and there are {count} joints: {', '.join(self.joints)}",
                field=field,
                remedy=f"give the URDF's joint of each in joints, or list {count} {what}",
            )
        return chosen

    def _upright(self, matrix: Array, quantity: Quantity, path: Path, name: str) -> Array:
        """Return a whole matrix with time along its rows."""
        count = len(self.joints)
        along = quantity.joints_along
        if along is None:
            if matrix.shape == (count, count):
                problem = f"{name} is a square matrix"
                remedy = 'state whether joints are along "columns" or "rows"'
                raise SourceError(path, problem, field=f"{name}.joints_along", remedy=remedy)
            along = "rows" if matrix.shape[0] < matrix.shape[1] else "columns"
        upright = matrix.T if along == "rows" else matrix
        if upright.shape[1] != count:
            recorded = upright.shape[1]
            problem = (
                f"{name} has the shape {matrix.shape}, joints along its {along}, and there are "
                f"{count} joints: {', '.join(self.joints)}"
            )
            remedy = (
                f"{NOT_RECORDED}, list the joints of the log in joints, or give the columns of the "
                "joints"
            )
            if recorded < count:
                raise UnrecordedJointError(path, problem, field=name, remedy=remedy, count=recorded)
            raise SourceError(path, problem, field=name, remedy=remedy)
        return upright

    def _file(self, name: str | None, field: str) -> TextTable | ArrayFile:
        if name is None and self.path.is_dir():
            problem = "is a folder"
            remedy = 'give a file in it: file = "q.txt", or one per joint: files = "q_{}.txt"'
            raise SourceError(self.path, problem, field=field, remedy=remedy)
        path = self.path if name is None else self._folder / name
        if path not in self.files:
            self.files[path] = self._parsed.file(path, self._map.format)
        return self.files[path]

    def _row_names(self, joints: tuple[str, ...]) -> tuple[str, ...]:
        """Return the joints that the rows name, for columns in their order; else the given ones."""
        quantities = self._map.quantities().values()
        numbered = all("{}" in str(quantity.columns) for quantity in quantities)
        if not numbered or any(quantity.file or quantity.files for quantity in quantities):
            return joints
        file = self._file(None, "position.file")
        names = row_names(file.texts, joints) if isinstance(file, TextTable) else None
        if names is None or names.joints in ((), joints):
            return joints
        self.concluded.append(JointOrder(names.joints))
        return names.joints

    def _joint_order(self, robot: Robot) -> list[int]:
        """Return the column of the log of each joint of the robot."""
        missing = [name for name in robot.joint_names if name not in self.joints]
        if missing or len(set(self.joints)) < len(self.joints):
            problem = f"the map names the joints {', '.join(self.joints)}"
            remedy = (
                f"the robot's joints are {', '.join(robot.joint_names)}; name each once, or "
                f"{NOT_RECORDED}"
            )
            if not missing:
                raise SourceError(self.path, problem, field="joints", remedy=remedy)
            raise UnrecordedJointError(
                self.path,
                problem,
                field="joints",
                remedy=remedy,
                count=len(self.joints),
                joints=self.joints,
            )
        return [self.joints.index(name) for name in robot.joint_names]

    def _motor_from_joint(self) -> Array:
        """Return motor angles per joint angle (k, k), in the log's order."""
        drive = self._map.drive
        n = len(self.joints)
        for name in ("gear_ratio", "joint_offset", "torque_constant", "motor_from_joint"):
            if (values := getattr(drive, name)) is not None:
                self._check_count(values, f"drive.{name}")
        if isinstance(drive.torque_uncertainty, tuple):
            self._check_count(drive.torque_uncertainty, "drive.torque_uncertainty")
        for row in drive.motor_from_joint or ():
            self._check_count(row, "drive.motor_from_joint")
        diagonal = np.diag(drive.gear_ratio or np.ones(n))
        matrix = np.array(drive.motor_from_joint or diagonal.tolist(), np.float64)
        self._set_terms(matrix, drive.coupling, "drive.coupling")
        if np.linalg.matrix_rank(matrix) < n:
            problem = "one of the joints is moved by no motor"
            remedy = "give each joint a ratio that is not zero, by which one motor turns it"
            raise SourceError(self.path, problem, field="drive.gear_ratio", remedy=remedy)
        return matrix

    def coupling_of(self, name: str) -> Array:
        """Return recorded angles per joint angle (k, k) of a quantity, in the log's order."""
        field = f"{name}.coupled"
        matrix = np.eye(len(self.joints))
        self._set_terms(matrix, self._map.quantities()[name].coupled, field)
        if np.linalg.matrix_rank(matrix) < len(matrix):
            problem = "with these factors the angles do not determine the joints"
            remedy = "of two angles only one can contain the other: state which one does"
            raise SourceError(self.path, problem, field=field, remedy=remedy)
        return matrix

    def _set_terms(
        self, matrix: Array, terms: Sequence[tuple[int, int, float]], field: str
    ) -> None:
        """Set entries of a matrix (k, k), by row and column from 1."""
        n = len(matrix)
        for row, column, factor in terms:
            if max(row, column) > n:
                problem = f"there are {n} joints, not {max(row, column)}"
                remedy = (
                    f"number them from 1, in the order of the columns: {', '.join(self.joints)}"
                )
                raise SourceError(self.path, problem, field=field, remedy=remedy)
            matrix[row - 1, column - 1] = factor

    def _check_count(self, values: Sequence[object] | Array, field: str) -> None:
        if len(values) != len(self.joints):
            problem = f"has {len(values)} entries"
            remedy = f"one for each of the joints {', '.join(self.joints)}"
            raise SourceError(self.path, problem, field=field, remedy=remedy)


def _unbroken(file: TextTable | ArrayFile, time: TimeColumn, decimals: int) -> Sequence[int | None]:
    """Return the times of the first rows, up to the first row that was left out."""
    times = file.times(time.column, decimals, time.array)
    return times[: file.unbroken] if isinstance(file, TextTable) else times


def _check_lengths(
    arrays: Mapping[str, NDArray[Any]], path: Path, what: str, field: str = ""
) -> None:
    if len({len(array) for array in arrays.values()}) > 1:
        listing = ", ".join(f"{name} {len(array)}" for name, array in arrays.items())
        problem = f"the {what} differ in length: {listing}"
        raise SourceError(path, problem, field=field, remedy="cut them to the same length")


def _joint_side(values: dict[str, Array], columns: ColumnMap, log: _Log) -> dict[str, Array]:
    """Convert the quantities to the joint side and the robot's order, conserving power.

    With motor angles M q, joint torques are M^T times the motors'. Angles that contain those of
    other joints are of the motion alone.
    """
    matrix = log.matrix
    sides = {name: quantity.side for name, quantity in columns.quantities().items()}
    joint = dict(values)
    quantities = columns.quantities()
    for name in KINEMATIC:
        if sides.get(name) == "motor":
            joint[name] = np.asarray(np.linalg.solve(matrix, values[name].T).T, np.float64)
        if name in quantities and quantities[name].coupled:
            angles = np.linalg.solve(log.coupling_of(name), joint[name].T).T
            joint[name] = np.asarray(angles, np.float64)
    if sides.get("torque") == "motor":
        joint["torque"] = values["torque"] @ matrix
    drive = columns.drive
    if drive.joint_offset is not None:
        for name in ("position", "commanded_position"):
            if name in joint:
                joint[name] = joint[name] + drive.joint_offset
    if "torque" not in joint and "motor_current" in joint and drive.torque_constant is not None:
        joint["torque"] = (joint["motor_current"] * drive.torque_constant) @ matrix
    return {name: array[:, log.order] for name, array in joint.items()}
