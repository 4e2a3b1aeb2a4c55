"""A folder with a file for each quantity, such as ``q.txt``, ``dq.txt`` and ``tau.txt``.

The names of its columns, or else its own name, say what a file holds; its times are a
column of its own, or in a file that holds nothing else.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NoReturn

from hil.base.errors import SourceError, UnrecordedJointError
from hil.base.safe_input import parse_toml
from hil.base.toml_text import to_text
from hil.importers.array_files import ArrayFile
from hil.importers.channel_groups import ChannelGroup, grouped, number_in
from hil.importers.channels import channels_of, kind_in_file, kinds_of_file
from hil.importers.column_map import ColumnMap, Format
from hil.importers.conclusions import ChannelMeaning, NameBasis, UnitBasis, UnusedChannels
from hil.importers.imported_robot import NOT_RECORDED, Robot
from hil.importers.log_files import LogFiles, files_in
from hil.importers.name_words import kind_by_words
from hil.importers.proposed_map import Proposal
from hil.importers.stamps import is_clock
from hil.importers.text_table import TextTable
from hil.importers.units import JOINT_KINDS, Kind, kind_named

_ARM: Final = ("torque", "motor_current", "commanded_position")


@dataclass(frozen=True)
class _Held:
    """A quantity in a file.

    Attributes:
        file: its name.
        columns: entry of the map, None for all columns of the file.
        size: numbers in a sample.
        names: of the channels.
        unit: that the file states.
        time: column of the file's own times, None without one.
        by_file: whether the file's name says the quantity.
    """

    file: str
    columns: str | Sequence[str | int] | None
    size: int
    names: tuple[str, ...]
    unit: str | None
    time: str | int | None
    by_file: bool


def proposed_map_of_folder(
    folder: Path,
    robot: Robot,
    chosen: Mapping[str, str],
    *,
    sample_rate: float | None,
    form: Format | None,
    files: LogFiles,
) -> Proposal:
    """Return the column map that the files of a folder suggest for a robot.

    Args:
        folder: with the files.
        robot: whose joints they hold.
        chosen: files by quantity that are given, where several hold it.
        sample_rate: of files without times [Hz].
        form: how texts are written, None to detect it.
        files: parsed before.

    Raises:
        SourceError: the files leave a quantity open, or hold none.
    """
    search = _Search(folder, robot.joint_names, dict(chosen), form, files)
    table = search.table(sample_rate)
    if form is not None:
        table["format"] = form.model_dump(exclude_defaults=True)
    comment = "Proposed by hil from the names of the files and their columns"
    text = to_text(table, {"": comment})
    columns = ColumnMap.model_validate(parse_toml(text))
    return Proposal(text, columns, search.concluded)


class _Search:
    """The search for the file of each quantity."""

    def __init__(
        self,
        folder: Path,
        joints: Sequence[str],
        chosen: Mapping[str, str],
        form: Format | None,
        files: LogFiles,
    ) -> None:
        self._folder = folder
        self._joints = joints
        self._chosen = chosen
        self._form = form or Format()
        self._files = files
        self._clocks: list[str] = []  # files that hold times only
        self._unread: list[tuple[str, str]] = []  # files that are no tables, and why
        self._held: dict[Kind, list[_Held]] = {}
        for path in files_in(folder):
            self._read(path)
        self.concluded: tuple[ChannelMeaning | UnusedChannels, ...] = ()

    def table(self, sample_rate: float | None) -> dict[str, Any]:
        """Return the entries of the map, or raise SourceError with what is open."""
        entries: dict[str, Any] = {}
        times: dict[Kind, tuple[str, str | int]] = {}  # by quantity: file and column
        meanings: list[ChannelMeaning] = []
        for kind in JOINT_KINDS:
            held = self._of(kind)
            if not held:
                continue
            entries[kind] = self._entry(held)
            meanings.append(_meaning(kind, held))
            if held[0].time is not None:
                times[kind] = (held[0].file, held[0].time)
        missing: list[Kind] = [] if "position" in entries else ["position"]
        missing += [] if entries.keys() & {*_ARM} else ["torque"]
        if missing:
            self._refuse_missing(missing)
        if sample_rate is not None:
            return {"sample_rate": sample_rate, **self._finished(entries, meanings)}
        time = self._time(times)
        for kind, (file, column) in times.items():
            if kind != "position" and file != time["file"]:
                entries[kind]["time"] = {"column": column}
        return {"time": time, **self._finished(entries, meanings)}

    def _finished(
        self, entries: dict[str, Any], meanings: Sequence[ChannelMeaning]
    ) -> dict[str, Any]:
        used = {held.file for each in self._held.values() for held in each} | {*self._clocks}
        others = [path.name for path in files_in(self._folder) if path.name not in used]
        unused = (UnusedChannels(tuple(others)),) if others else ()
        self.concluded = (*meanings, *unused)
        return entries

    def _time(self, times: Mapping[Kind, tuple[str, str | int]]) -> dict[str, Any]:
        """Return the table of the times of the positions."""
        clocks = self._clocks
        if "time" in self._chosen:
            clocks = [self._chosen["time"]]
        if "position" in times and "time" not in self._chosen:
            file, column = times["position"]
            return {"file": file, "column": column}
        if len(clocks) == 1:
            return {"file": clocks[0], "column": 0}
        if len(clocks) > 1:
            self._refuse_several("time", clocks)
        if times:
            file, column = next(iter(times.values()))
            return {"file": file, "column": column}
        problem = "none of its files contains a time"
        remedy = "state --sample-rate HZ"
        raise SourceError(self._folder, problem, field="time", remedy=remedy)

    def _of(self, kind: Kind) -> list[_Held]:
        """Return the file of a quantity, or one for each joint; none where no file has it."""
        held = self._held.get(kind, [])
        if kind in self._chosen:
            return self._given(kind, self._chosen[kind])
        if len(held) < 2:
            return self._of_all_joints(kind, held)
        single = sorted((each for each in held if each.size == 1), key=_number)
        if len(single) == len(held) == len(self._joints):
            return single
        whole = [each for each in held if each.size == len(self._joints)]
        if len(whole) == 1:
            return whole
        return self._refuse_several(kind, [each.file for each in held])

    def _of_all_joints(self, kind: Kind, held: list[_Held]) -> list[_Held]:
        """Return the file of a quantity, or raise the error that joints were not recorded."""
        if not held or held[0].size == len(self._joints):
            return held
        (each,) = held
        problem = (
            f"{each.file} has {each.size} columns of {kind.replace('_', ' ')}, and the URDF has "
            f"{len(self._joints)} joints: {', '.join(self._joints)}"
        )
        if each.size > len(self._joints):
            remedy = (
                "give the URDF of this arm, or a map (--map map.toml) with joints, the URDF's "
                "joint of each column"
            )
            raise SourceError(self._folder, problem, field=kind, remedy=remedy)
        raise UnrecordedJointError(
            self._folder,
            problem,
            field=kind,
            remedy=NOT_RECORDED,
            count=each.size,
            joints=[joint for joint in self._joints if any(joint in name for name in each.names)],
            channels=each.names,
        )

    def _given(self, kind: Kind, name: str) -> list[_Held]:
        """Return the file that an option names for a quantity."""
        path = self._folder / name
        if not path.is_file():
            names = ", ".join(file.name for file in files_in(self._folder))
            problem = f"there is no file {name!r} for {kind.replace('_', ' ')}"
            remedy = f"choose one of its files: {names}"
            raise SourceError(self._folder, problem, field=kind, remedy=remedy)
        for candidates in self._held.values():
            for each in candidates:
                if each.file == name:
                    return self._of_all_joints(kind, [each])
        file = self._files.file(path, self._form)
        return self._of_all_joints(kind, [self._nameless(file, _width(file))])

    def _read(self, path: Path) -> None:
        """Note the quantities of a file."""
        try:
            channels = channels_of(path, self._form, self._files)
            file = self._files.file(path, self._form)
        except SourceError as error:  # such as notes, or a list of joints
            self._unread.append((path.name, error.problem))
            return
        stem = next(iter(kinds_of_file(path)), None)
        if stem == "time" and sum(channel.size for channel in channels) == 1:
            self._clocks.append(path.name)
            return
        is_nameless = len(file.names) == 1 if isinstance(file, ArrayFile) else not file.names
        if is_nameless and stem is not None and stem != "time":
            held = self._nameless(file, _width(file))
            self._held.setdefault(kind_in_file(stem, path), []).append(held)
            return
        self._read_columns(path, grouped(channels, self._joints), stem)

    def _read_columns(self, path: Path, groups: Sequence[ChannelGroup], stem: Kind | None) -> None:
        """Note the quantities of a file whose columns or arrays have names."""
        times = [
            group
            for group in groups
            if group.size == 1 and (group.kind or kind_by_words(group.pattern)) == "time"
        ]
        time = times[0].names[0] if times else None
        for group in groups:
            kind = group.kind or kind_by_words(group.pattern)
            if group in times or (kind is None and group.size < len(self._joints)):
                continue
            by_file = kind is None or kind == "time"
            kind = stem if by_file else kind
            if kind is None or kind == "time":
                continue
            held = _Held(
                path.name, group.columns(self._joints), group.size, group.names, group.unit, time,
                by_file,
            )  # fmt: skip
            self._held.setdefault(kind_in_file(kind, path), []).append(held)

    def _nameless(self, file: TextTable | ArrayFile, count: int) -> _Held:
        """Return the columns of a file without names; the first may be its times."""
        name = file.path.name
        has_times = isinstance(file, TextTable) and count == len(self._joints) + 1
        if has_times and is_clock(file.numbers([0], "time", None)[:, 0]):
            return _Held(name, list(range(1, count)), count - 1, (), None, 0, by_file=True)
        return _Held(name, None, count, (), None, None, by_file=True)

    def _entry(self, held: Sequence[_Held]) -> dict[str, Any]:
        first = held[0]
        if len(held) == 1:
            return {"file": first.file, "columns": first.columns}
        columns = None if all(each.columns is None for each in held) else first.columns
        columns = [columns] if isinstance(columns, str) else columns
        return {"files": [each.file for each in held], "columns": columns}

    def _refuse_several(self, kind: Kind, held: Sequence[str]) -> NoReturn:
        names = list(dict.fromkeys(held))
        problem = f"{' and '.join(names)} all hold {kind.replace('_', ' ')}"
        options = " or ".join(f"--columns '{kind}={name}'" for name in names)
        raise SourceError(self._folder, problem, field=kind, remedy=f"choose one: {options}")

    def _refuse_missing(self, missing: Sequence[str]) -> NoReturn:
        names = ", ".join(path.name for path in files_in(self._folder))
        problem = f"none of its files is named as {' or '.join(missing)}; they are {names}"
        unread = [f"{name} {why}" for name, why in self._unread if Path(name).suffix != ".txt"]
        if unread:
            problem = f"{problem}; {', '.join(unread)}"
        options = " ".join(f"--columns '{kind}=FILE'" for kind in missing)
        remedy = f"name them: {options}"
        if [*missing] == ["torque"]:
            remedy += (
                "; without torque, commanded positions (--columns 'commanded_position=FILE') are"
                " enough to identify the servos"
            )
        raise SourceError(self._folder, problem, field=", ".join(missing), remedy=remedy)


def _meaning(kind: Kind, held: Sequence[_Held]) -> ChannelMeaning:
    """Return what the files of a quantity were read as, and from what."""
    files = " .. ".join(dict.fromkeys((held[0].file, held[-1].file)))
    first = held[0]
    if first.unit is not None:
        unit_basis = UnitBasis.LOG
    else:
        by_custom = kind in ("torque", "motor_current")
        unit_basis = UnitBasis.CUSTOM if by_custom else UnitBasis.NUMBERS
    basis = NameBasis.FILE if first.by_file else NameBasis.NAME
    return ChannelMeaning(files, kind_named(kind), basis, first.unit, unit_basis)


def _number(held: _Held) -> tuple[int, str]:
    match = number_in(Path(held.file).stem)
    return (int(match[0]) if match else 0, held.file)


def _width(file: TextTable | ArrayFile) -> int:
    """Return how many numbers a sample of a file without names has."""
    if isinstance(file, TextTable):
        return file.width
    shape = file.shape(file.names[0])
    return 1 if len(shape) == 1 else min(shape)
