"""A column map proposed from the names and units of a log's channels.

The map goes through the ordinary import, which concludes units that nothing states and checks
positions, velocities and torques against the URDF.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from hil.base.safe_input import parse_toml
from hil.base.toml_text import to_text
from hil.importers.channel_candidates import LogChannels, is_load
from hil.importers.channel_choice import ChannelChoice, choose_channels, unused_groups
from hil.importers.channel_groups import ChannelGroup, grouped
from hil.importers.channel_refusals import (
    MAX_NAMED,
    missing_channels,
    refuse_row_for_each_joint,
)
from hil.importers.channels import channels_of
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
from hil.importers.row_names import row_names
from hil.importers.units import JOINT_KINDS, UNITS, Kind, kind_named


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
    every_channel = channels_of(log, form, files)
    refuse_row_for_each_joint(log, every_channel, joints)
    groups = grouped([channel for channel in every_channel if not channel.is_repeated], joints)
    names = row_names([channel.text for channel in every_channel], joints)
    recorded = () if names.joints == tuple(joints) else names.joints
    nanoseconds = None
    if not chosen and sample_rate is None and names.joints and not every_channel[0].name.strip("0"):
        chosen = names.columns_of_messages(len(every_channel))
        nanoseconds = 1 if chosen else None
    if not chosen and sample_rate is None and form is None:
        ready = _matching_ready_map(groups, len(recorded or joints))
        if ready is not None and set(joints) <= set(recorded or joints):
            return _of_ready_map(ready, recorded)
    channels = LogChannels(
        log,
        groups,
        joints,
        recorded,
        arm_joints=len(robot.without_gripper().joint_names),
        chosen=chosen,
        nanoseconds=nanoseconds,
        sample_rate=sample_rate,
        with_unit=with_unit,
        file=None if log.is_dir() else partial((files or LogFiles()).file, log, form or Format()),
    )
    return _of_channels(channels, form)


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


def _of_channels(channels: LogChannels, form: Format | None) -> Proposal:
    """Return the map of the channels of each quantity; it states `form`."""
    choices: dict[Kind, ChannelChoice] = {}
    for kind in (*(("time",) if channels.sample_rate is None else ()), *JOINT_KINDS):
        choice = choose_channels(channels, kind)
        if choice is not None:
            choices[kind] = choice
    unused = unused_groups(channels, choices.values())
    missing = [kind for kind in ("time", "position") if kind not in choices]
    if channels.sample_rate is not None:
        missing.remove("time")
    if not choices.keys() & {"torque", "motor_current", "commanded_position"}:
        missing.append("torque")
    if missing:
        raise missing_channels(channels, missing, unused)
    concluded: list[Conclusion] = [choice.meaning for choice in choices.values()]
    if unused and not channels.are_nameless:
        concluded.append(UnusedChannels(tuple(group.label for group in unused[:MAX_NAMED])))
    if channels.recorded:
        concluded.append(JointOrder(tuple(channels.recorded)))
    table = _table(channels, choices)
    if form is not None:
        table["format"] = form.model_dump(exclude_defaults=True)
    comment = "Proposed by hil from the names and units of the channels"
    text = to_text(table, {"": comment})
    return Proposal(text, ColumnMap.model_validate(parse_toml(text)), tuple(concluded))


def _table(channels: LogChannels, choices: Mapping[Kind, ChannelChoice]) -> dict[str, object]:
    """Return the content of a map."""
    table: dict[str, object] = {"joints": list(channels.recorded)} if channels.recorded else {}
    if channels.sample_rate is not None:
        table["sample_rate"] = channels.sample_rate
    for kind, choice in choices.items():
        columns = choice.columns
        if kind == "time":
            time = columns if isinstance(columns, str) else columns[0]
            parts = {} if choice.nanoseconds is None else {"nanoseconds": choice.nanoseconds}
            table[kind] = {"column": time, **parts}
        elif kind == "torque" and kind not in channels.chosen and _names_load(columns):
            # Whether it is a torque is judged by its numbers, however a servo encodes them.
            table[kind] = {"columns": columns, "unit": next(iter(UNITS[kind]))}
        else:
            table[kind] = {"columns": columns}
    return table


def _names_load(columns: str | Sequence[str | int]) -> bool:
    return any(map(is_load, [columns] if isinstance(columns, str) else map(str, columns)))
