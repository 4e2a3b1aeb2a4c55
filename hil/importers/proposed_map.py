"""A column map proposed from the names and units of a log's channels.

The map goes through the ordinary import, which concludes units that nothing states and checks
positions, velocities and torques against the URDF.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Final, NoReturn

from hil.base.arrays import Array
from hil.base.errors import SourceError, UnrecordedJointError
from hil.base.safe_input import parse_toml
from hil.base.toml_text import to_text
from hil.importers.array_files import ArrayFile
from hil.importers.channel_groups import ChannelGroup, grouped, number_in
from hil.importers.channels import CHANNEL_NAMES, Channel, channels_of, kind_of, kinds_of_file
from hil.importers.column_map import ColumnMap, Format, ready_map, ready_maps
from hil.importers.conclusions import (
    ChannelMeaning,
    Conclusion,
    JointOrder,
    NameBasis,
    UnitBasis,
    UnusedChannels,
)
from hil.importers.imported_robot import Robot
from hil.importers.log_files import LogFiles
from hil.importers.name_words import (
    is_commanded_position,
    is_measured,
    kind_by_words,
    kinds_said,
    words_of,
)
from hil.importers.row_names import row_names
from hil.importers.stated_units import other_unit
from hil.importers.text_table import TextTable
from hil.importers.units import JOINT_KINDS, UNITS, Kind, kind_named, unit_of
from hil.importers.unnamed_columns import ColumnBlocks, blocks_of, roughness

_MAX_NAMED: Final = 30
_ERRORS: Final = frozenset({"error", "errors", "err"})
"""Words of the deviations of a controller, which are no quantity of a joint."""
# ratio of roughness of times that do not fit the motion to those that do
_MIN_ROUGHNESS_RATIO: Final = 1.5
_NANO: Final = frozenset({"nano", "nanosec", "nanosecs", "nanoseconds", "nsec", "nsecs"})
"""Words of the nanoseconds of a time whose seconds are in another column."""
_Columns = str | Sequence[str | int]
"""A name, with ``{}`` for the joint, or a list of names or of indices."""
_SIDE: Final = 'side = "motor" with [drive] gear_ratio'


@dataclass(frozen=True)
class Proposal:
    """A proposed column map.

    Attributes:
        text: the map, TOML.
        columns: the same, parsed.
        concluded: the meaning of each group of channels, and which are not used.
    """

    text: str
    columns: ColumnMap
    concluded: tuple[Conclusion, ...]

    @property
    def has_torque(self) -> bool:
        """Whether the map names joint torques."""
        return self.columns.torque is not None


def proposed_map(
    log: Path,
    robot: Robot,
    chosen: Mapping[str, str] | None = None,
    *,
    sample_rate: float | None = None,
    form: Format | None = None,
    with_unit: Collection[str] = (),
    files: LogFiles | None = None,
) -> Proposal:
    """Return the column map that the channels of a log suggest for a robot.

    A ready map whose columns the log has comes first, then the names of
    :data:`hil.importers.channels.CHANNEL_NAMES`.

    Args:
        log: its path.
        robot: that was recorded.
        chosen: channels by quantity that are given: a name with ``{}`` for the joint, or names
            separated by commas.
        sample_rate: replaces the time [Hz].
        form: how texts are written, where that is stated.
        with_unit: quantities of which a map states the unit.
        files: that were parsed before.

    Raises:
        SourceError: the log cannot be read, or its channels leave a quantity open.
    """
    chosen = dict(chosen or {})
    joints = robot.joint_names
    channels = channels_of(log, form, files)
    _refuse_row_for_each_joint(log, channels, joints)
    groups = grouped([channel for channel in channels if not channel.is_repeated], joints)
    names = row_names([channel.text for channel in channels], joints)
    recorded = () if names.joints == tuple(joints) else names.joints
    nanoseconds = None
    if not chosen and sample_rate is None and names.joints and not channels[0].name.strip("0"):
        chosen = names.columns_of_messages(len(channels))
        nanoseconds = 1 if chosen else None
    if not chosen and sample_rate is None and form is None:
        ready = _matching_ready_map(groups, len(recorded or joints))
        if ready is not None and set(joints) <= set(recorded or joints):
            return _of_ready_map(ready, recorded)
    search = _Search(log, joints, groups, chosen, sample_rate, recorded)
    search.nanoseconds = nanoseconds
    search.with_unit = with_unit
    search.of_arm = len(robot.without_gripper().joint_names)
    search.file = (
        None if log.is_dir() else partial((files or LogFiles()).file, log, form or Format())
    )
    return search.proposal(form)


def _refuse_row_for_each_joint(
    log: Path, channels: Sequence[Channel], joints: Sequence[str]
) -> None:
    """Raise SourceError for a table that names the joint of each row."""
    column = next((each for each in channels if each.first in joints and not each.text), None)
    time = next((each.name for each in channels if each.kind == "time"), "time")
    if column is None or len(joints) < 2:
        return
    problem = f"has a row for each joint, named in column {column.name}, not one for each time"
    remedy = (
        f"make columns of the joints, in pandas: wide = df.pivot(index={time!r}, "
        f"columns={column.name!r}); wide.columns = ['_'.join(name) for name in wide.columns]; "
        "wide.to_csv('wide.csv')"
    )
    raise SourceError(log, problem, field=column.name, remedy=remedy)


def _matching_ready_map(groups: Sequence[ChannelGroup], count: int) -> str | None:
    """Return the ready map whose columns are all in the log, one for each of `count` joints."""
    sizes = {group.pattern: group.size for group in groups}
    has_torque = any(group.kind == "torque" for group in groups)
    for name in ready_maps():
        columns = ColumnMap.load(name)
        quantities = columns.quantities()
        if has_torque and "torque" not in quantities:
            continue
        time = columns.time is not None and columns.time.column in sizes
        if time and all(sizes.get(str(q.columns)) == count for q in quantities.values()):
            return name
    return None


def _of_ready_map(name: str, joints: Sequence[str]) -> Proposal:
    columns = ColumnMap.load(name)
    text = ready_map(name)
    if joints:
        text = f"{to_text({'joints': list(joints)})}\n{text}"
        columns = columns.model_copy(update={"joints": tuple(joints)})
    basis = NameBasis.READY_MAP, UnitBasis.MAP
    named = {kind: (str(each.columns), each.unit) for kind, each in columns.quantities().items()}
    if columns.time is not None:
        named = {"time": (str(columns.time.column), columns.time.unit), **named}
    meanings = [
        ChannelMeaning(channels, kind_named(kind), basis[0], unit, basis[1], name)
        for kind, (channels, unit) in named.items()
    ]
    order = (JointOrder(tuple(joints)),) if joints else ()
    return Proposal(text, columns, (*meanings, *order))


class _Search:
    """The search for the channels of each quantity."""

    def __init__(
        self,
        log: Path,
        joints: Sequence[str],
        groups: Sequence[ChannelGroup],
        chosen: Mapping[str, str],
        sample_rate: float | None,
        recorded: Sequence[str],
    ) -> None:
        self._log = log
        self._joints = joints
        self._recorded = recorded
        self._columns_of = recorded or joints
        self.nanoseconds: str | int | None = None  #: column that is added to that of the time
        self.of_arm = len(joints)  #: joints except a gripper's
        self.file: Callable[[], TextTable | ArrayFile] | None = None  #: the log, parsed
        self.with_unit: Collection[str] = ()  #: quantities whose unit a map states
        self._groups = groups
        self._chosen = chosen
        self._rate = sample_rate
        self._concluded: list[Conclusion] = []
        self._used: set[str] = set()

    def proposal(self, form: Format | None) -> Proposal:
        """Return the map, or raise SourceError with what is missing; it states `form`."""
        columns: dict[str, _Columns] = {}
        kinds: list[Kind] = [*(("time",) if self._rate is None else ()), *JOINT_KINDS]
        for kind in kinds:
            names = self._channels(kind)
            if names is not None:
                columns[kind] = names
        missing = [kind for kind in ("time", "position") if kind not in columns]
        if self._rate is not None:
            missing.remove("time")
        if not columns.keys() & {"torque", "motor_current", "commanded_position"}:
            missing.append("torque")
        if missing:
            self._refuse_missing(missing)
        others = [group.label for group in self._groups if not self._is_used(group)]
        if others and not self._nameless:
            self._concluded.append(UnusedChannels(tuple(others[:_MAX_NAMED])))
        table: dict[str, object] = {kind: {"columns": names} for kind, names in columns.items()}
        if (
            "torque" in columns
            and "torque" not in self._chosen
            and self._is_load(columns["torque"])
        ):
            # Whether it is a torque is judged by its numbers, however a servo encodes them.
            table["torque"] = {"columns": columns["torque"], "unit": next(iter(UNITS["torque"]))}
        if self._rate is not None:
            table = {"sample_rate": self._rate, **table}
        else:
            time = columns["time"]
            parts = {} if self.nanoseconds is None else {"nanoseconds": self.nanoseconds}
            table["time"] = {"column": time if isinstance(time, str) else time[0], **parts}
        if self._recorded:
            table = {"joints": list(self._recorded), **table}
            self._concluded.append(JointOrder(tuple(self._recorded)))
        if form is not None:
            table["format"] = form.model_dump(exclude_defaults=True)
        comment = "Proposed by hil from the names and units of the channels"
        text = to_text(table, {"": comment})
        return Proposal(text, ColumnMap.model_validate(parse_toml(text)), tuple(self._concluded))

    def _channels(self, kind: Kind) -> _Columns | None:
        """Return the channels of a quantity; None if the log has none."""
        if kind in self._chosen:
            names = self._chosen[kind]
            given = NameBasis.OPTION, UnitBasis.OPTION
            self._concluded.append(ChannelMeaning(names, kind, given[0], None, given[1]))
            self._used.update([names, *map(str.strip, names.split(","))])
            return self._given(names)
        groups = self._groups_of(kind)
        if not groups:
            return None
        measured = [group for group in groups if is_measured(group.pattern)]
        if len(measured) == 1:
            groups = measured
        if kind == "torque":
            groups = [g for g in groups if not self._is_load(g.pattern)] or groups
        if len(groups) > 1:
            groups = self._of_all_joints(kind, groups)
        if len(groups) > 1:
            self._refuse_several(kind, groups)
        (group,) = groups
        if kind == "torque" and self._is_load(group.pattern) and not self._has_commands:
            return None
        if kind == "commanded_position" and group.size != len(self._columns_of):
            return None  # actions of something else
        is_open = group.unit is not None and kind not in self.with_unit
        if is_open and unit_of(group.unit or "", kind) is None:
            self._refuse_unit(kind, group)
        if kind == "time":
            if group.size > 1:
                self._refuse_several(kind, [group])
        elif group.size != len(self._columns_of) or not set(self._joints) <= set(self._columns_of):
            self._refuse_count(kind, group)
        self._used.update([group.pattern, *group.names])
        self._concluded.append(self._meaning(kind, group))
        return group.columns(self._columns_of)

    def _of_all_joints(self, kind: Kind, groups: Sequence[ChannelGroup]) -> list[ChannelGroup]:
        """Return groups of different joints as one, such as torques of some and a force of one."""
        named = [
            (joint, name)
            for group in groups
            for joint, name in zip(group.joints(self._columns_of), group.names, strict=False)
        ]
        names = dict(named)
        if len(names) < len(named) or set(names) != set(self._columns_of):
            return [*groups]
        ordered = tuple(names[joint] for joint in self._columns_of)
        unit = next(group.unit for group in groups if ordered[0] in group.names)
        return [ChannelGroup(",".join(ordered), kind, ordered, len(ordered), unit, by_joint=True)]

    @staticmethod
    def _is_load(columns: _Columns) -> bool:
        """Return whether channels are named as the load of a servo, which is a torque or none."""
        names = [columns] if isinstance(columns, str) else map(str, columns)
        return any("load" in words_of(name) for name in names)

    @property
    def _has_commands(self) -> bool:
        kind: Kind = "commanded_position"
        return kind in self._chosen or bool(self._groups_of(kind))

    def _groups_of(self, kind: Kind) -> list[ChannelGroup]:
        """Return the groups of a quantity: by whole names, else by words in them."""
        given = set(self._chosen.values())
        groups = [g for g in self._groups if g.pattern not in given]
        named = [g for g in groups if g.kind == kind]
        if not named and kind == "commanded_position":
            return self._commands_by_words(groups)
        if not named:
            named = self._by_words(kind, [g for g in groups if g.kind is None])
        if kind != "time":
            return named
        single = [g for g in named if g.size == 1]
        stamps = [g for g in single if {"header", "stamp"} <= set(words_of(g.pattern))]
        single = stamps or single
        if len(single) > 1:  # a time of day with its date, and without the date where it wraps
            single = [g for g in single if "date" not in words_of(g.pattern)] or single
        parts = [g for g in single if _NANO & set(words_of(g.pattern))]
        if len(single) == 2 and len(parts) == 1:
            single.remove(parts[0])
            self.nanoseconds = parts[0].names[0]
            self._used.add(parts[0].pattern)
        return single or named

    def _commands_by_words(self, groups: Sequence[ChannelGroup]) -> list[ChannelGroup]:
        """Return the groups that a word calls commands, of a log without torque and current.

        Where there is a torque, commands are not needed, and are used only where they are named.
        """
        motors: list[Kind] = ["torque", "motor_current"]
        measured = [g for kind in motors for g in self._groups_of(kind)]
        if not all(self._is_load(g.pattern) for g in measured):
            return []
        count = len(self._columns_of)
        said = [g for g in groups if g.size == count and is_commanded_position(g.pattern)]
        positions = [g for g in said if "position" in kinds_said(g.pattern)]
        return [replace(g, by_words=NameBasis.WORD) for g in positions or said]

    def _by_words(self, kind: Kind, groups: Sequence[ChannelGroup]) -> list[ChannelGroup]:
        """Return the groups whose names say a quantity by a word in them."""
        said = [g for g in groups if kind_by_words(g.pattern) == kind]
        said = [replace(g, by_words=NameBasis.WORD) for g in said]
        if kind == "time":
            return [g for g in said if g.size == 1]
        count = len(self._columns_of)
        several = [g for g in said if g.size > 1]
        exact = [g for g in several if g.size == count]
        single = [g for g in said if g.size == 1]
        if exact or several or len(single) != count:
            return exact or several
        names = tuple(g.names[0] for g in single)
        by_words = NameBasis.WORDS
        return [
            ChannelGroup(",".join(names), kind, names, count, single[0].unit, by_words=by_words)
        ]

    def _is_used(self, group: ChannelGroup) -> bool:
        return group.pattern in self._used or self._used.issuperset(group.names)

    def _given(self, text: str) -> _Columns:
        """Return names or, where the log has none, indices that were given for a quantity."""
        names: _Columns = [name.strip() for name in text.split(",")]
        if self._nameless and all(str(name).isdigit() for name in names):
            names = [int(name) for name in names]
        return names if len(names) > 1 or isinstance(names[0], int) else text

    @property
    def _nameless(self) -> bool:
        """Whether the log has no names, but indices."""
        return all(group.pattern in ("{}", "0") for group in self._groups)

    @staticmethod
    def _meaning(kind: Kind, group: ChannelGroup) -> ChannelMeaning:
        """Return quantity and unit, and from what."""
        unit_basis = UnitBasis.LOG
        if group.unit is None:
            by_custom = kind in ("torque", "motor_current")
            unit_basis = UnitBasis.CUSTOM if by_custom else UnitBasis.NUMBERS
        basis = NameBasis.JOINT if group.by_joint else NameBasis.NAME
        if group.unit is not None and kind_of(group.names[0])[0] is None and not group.by_joint:
            basis = NameBasis.UNIT
        basis = group.by_words or basis
        return ChannelMeaning(group.label, kind, basis, group.unit, unit_basis)

    def _refuse_several(self, kind: Kind, groups: Sequence[ChannelGroup]) -> NoReturn:
        names = [name for group in groups for name in (group.pattern, *group.names)]
        patterns = [group.pattern for group in groups]
        if len(groups) == 1:
            patterns = [name for name in names if "{}" not in name]
        listing = " and ".join(group.label for group in groups)
        problem = f"{listing} are all named as {kind}"
        if kind == "time":
            best = self._smoothest([name for name in patterns if "{}" not in name])
            if best is not None:
                patterns = [best, *(name for name in patterns if name != best)]
                problem += f"; {best} fits the motion: at its times the positions are smooth"
        options = " or ".join(f"--columns '{kind}={pattern}'" for pattern in patterns[:_MAX_NAMED])
        raise SourceError(self._log, problem, field=kind, remedy=f"choose one: {options}")

    def _smoothest(self, names: Sequence[str]) -> str | None:
        """Return the times at which the positions are clearly smoothest; None if none are."""
        positions = [group for group in self._groups_of("position") if group.size > 1]
        if self.file is None or len(positions) != 1 or len(names) < 2:
            return None
        try:
            file = self.file()
            position = self._numbers(file, positions[0])
            found = {
                name: roughness(file.numbers([name], "time", None)[:, 0], position)
                for name in names
            }
        except SourceError:  # of dates, or of a cell that is no number
            return None
        known = sorted((value, name) for name, value in found.items() if value is not None)
        if not known or (len(known) > 1 and known[1][0] < _MIN_ROUGHNESS_RATIO * known[0][0]):
            return None
        return known[0][1]

    @staticmethod
    def _numbers(file: TextTable | ArrayFile, group: ChannelGroup) -> Array:
        if isinstance(file, ArrayFile) and len(group.names) == 1:
            return file.matrix(group.names[0], "position")
        return file.numbers(group.names, "position", None)

    def _blocks(self) -> ColumnBlocks | None:
        """Return what the columns of a table without names may be."""
        if self.file is None:
            return None
        try:
            file = self.file()
            values = file.matrix(None, "position")
        except SourceError:
            return None
        return blocks_of(values, (len(self._joints), self.of_arm))

    def _refuse_unit(self, kind: Kind, group: ChannelGroup) -> NoReturn:
        assert group.unit is not None
        problem = f"{group.label} is named as {kind}, and {group.unit} is not a unit of it"
        kinds = [other for other in JOINT_KINDS[:4] if unit_of(group.unit, other)]
        if not kinds or kind == "time":
            raise other_unit(self._log, kind, group.label, group.unit)
        options = " or ".join(f"--columns '{name}={group.pattern}'" for name in kinds)
        raise SourceError(self._log, problem, field=kind, remedy=f"choose: {options}")

    def _refuse_count(self, kind: Kind, group: ChannelGroup) -> NoReturn:
        count = group.size
        joints = ", ".join(self._joints)
        problem = (
            f"{count} {'channel is' if count == 1 else 'channels are'} named as {kind} "
            f"({group.label}), and the URDF has {len(self._joints)} joints: {joints}"
        )
        otherwise = "or give the URDF's joint of each channel in joints of a map (--map map.toml)"
        if count < len(self._joints) or self._recorded:
            absent, which = self._absent(group)
            options = " ".join(f"--locked {name}" for name in absent)
            remedy = f"fix the joints that were not recorded, {which} with {options}"
            recorded = [name for name in self._recorded if name in self._joints]
            raise UnrecordedJointError(
                self._log,
                problem,
                field=kind,
                remedy=f"{remedy}; {otherwise}",
                count=len(recorded) or count,
                joints=recorded or group.joints(self._joints),
                channels=group.names,
            )
        some = ",".join(group.names[: len(self._joints)])
        remedy = "give the URDF of this arm"
        if len(group.names) == count:
            remedy += f", or the channels of its joints, such as --columns '{kind}={some}'"
        raise SourceError(self._log, problem, field=kind, remedy=f"{remedy}; {otherwise}")

    def _absent(self, group: ChannelGroup) -> tuple[Sequence[str], str]:
        """Return the joints without a channel by the numbers of the others, else the last ones."""
        numbers = [number_in(name) for name in group.names]
        places = {int(match[0]) for match in numbers if match is not None}
        first = 0 if 0 in places else 1
        expected = range(first, first + len(self._joints))
        absent = [place for place in expected if place not in places]
        if len(places) == group.size and places < set(expected) and absent[0] < max(places):
            names = [self._joints[place - first] for place in absent]
            return names, "by the numbers of the channels"
        return self._joints[group.size :], "for the last ones"

    def _refuse_missing(self, missing: Sequence[str]) -> NoReturn:
        """Raise SourceError with the quantities without a channel, and what would name them."""
        unnamed = [
            group
            for group in self._groups
            if not self._is_used(group) and group.size == len(self._joints) and len(group.names) > 1
        ]
        listing = ", ".join(group.label for group in self._groups[:_MAX_NAMED])
        examples = [
            f"{kind} ({', '.join(CHANNEL_NAMES[kind_named(kind)][:3])}, ...)" for kind in missing
        ]
        problem = f"no channel is named as {' or '.join(examples)}; its channels are {listing}"
        stated = [kind for kind in kinds_of_file(self._log) if kind != "time"]
        files = self._files()
        if unnamed and stated and len(files) > 1:
            problem += f", which name no quantity (the name of the file says {_named(stated[0])})"
            remedy = self._remedy_for_files(files)
        else:
            blocks = self._blocks() if self._nameless else None
            steps = ["--sample-rate HZ or --columns time=NAME"] if "time" in missing else []
            if blocks is not None and steps:
                steps = ["--sample-rate HZ" if blocks.time is None else "--columns time=0"]
            for kind in (kind for kind in missing if kind != "time"):
                pattern = _likely(kind, unnamed)
                unnamed = [group for group in unnamed if group.pattern != pattern]
                if self._nameless:
                    block = None if blocks is None else getattr(blocks, kind)
                    pattern = "NUMBER,NUMBER,..." if block is None else ",".join(map(str, block))
                steps.append(f"--columns '{kind}={pattern}'")
            if blocks is not None and blocks.velocity is not None:
                steps.append(f"--columns 'velocity={','.join(map(str, blocks.velocity))}'")
            remedy = f"state {'; '.join(steps)}; or write a map (--map map.toml)"
            if missing == ["torque"]:
                remedy += (
                    "; without torque, commanded positions (--columns"
                    " 'commanded_position=NAME{}') are enough to identify the servos"
                )
                if pattern == "NAME{}":
                    remedy = f"record it, or {remedy}"
        raise SourceError(self._log, problem, field=", ".join(missing), remedy=remedy)

    def _files(self) -> dict[Kind, str]:
        """Return the files next to the log whose names say a quantity."""
        files: dict[Kind, str] = {}
        for path in sorted(self._log.parent.glob(f"*{self._log.suffix}")):
            for kind in kinds_of_file(path):
                files.setdefault(kind, path.name)
        return files

    def _remedy_for_files(self, files: Mapping[Kind, str]) -> str:
        """Return the lines of a map for quantities in files of their own."""
        lines = ["sample_rate = HZ" if self._rate is None else f"sample_rate = {self._rate:g}"]
        lines += [f'[{kind}] file = "{files[kind]}"' for kind in JOINT_KINDS[:3] if kind in files]
        if "torque" not in files:
            current = files.get("motor_current")
            lines.append(
                '[torque] file = "FILE"'
                if current is None
                else f'[torque] file = "{current}" if it has N·m, or [motor_current] file = '
                f'"{current}" with [drive] torque_constant if it has A'
            )
        return (
            f"write a map of the files (--map map.toml): {'; '.join(lines)}; and {_SIDE} where a "
            "quantity was measured before the gears"
        )


def _likely(kind: str, groups: Sequence[ChannelGroup]) -> str:
    """Return the pattern of the group that may contain a quantity: by its words, else the first."""
    said = {
        group.pattern: kinds_said(group.pattern)
        for group in groups
        if group.kind in (None, kind) and _ERRORS.isdisjoint(words_of(group.pattern))
    }
    patterns = [pattern for pattern, kinds in said.items() if kind in kinds]
    patterns += [pattern for pattern, kinds in said.items() if not kinds]
    return patterns[0] if patterns else "NAME{}"


def _named(kind: str) -> str:
    return kind.replace("_", " ")
