"""Errors of a log whose channels leave a quantity open, with the options that decide it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

from hil.base.errors import SourceError, UnrecordedJointError
from hil.importers.channel_candidates import LogChannels
from hil.importers.channel_groups import ChannelGroup, number_in
from hil.importers.channels import CHANNEL_NAMES, Channel, kinds_of_file
from hil.importers.name_words import kinds_said, words_of
from hil.importers.stated_units import other_unit
from hil.importers.units import JOINT_KINDS, Kind, kind_named, unit_of
from hil.importers.unnamed_columns import ColumnBlocks, blocks_of, roughness
from identification.text import joined

MAX_NAMED: Final = 30
"""Channels in a list."""
_MAX_JOINTS: Final = 14  # that a message names
_ERRORS: Final = frozenset({"error", "errors", "err"})
"""Words of the deviations of a controller, which are no quantity of a joint."""
# ratio of roughness of times that do not fit the motion to those that do
_MIN_ROUGHNESS_RATIO: Final = 1.5
_ANY_NAME: Final = "NAME{}"
_SIDE: Final = 'side = "motor" with [drive] gear_ratio'


def refuse_row_for_each_joint(
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


def several_channels(
    channels: LogChannels, kind: Kind, groups: Sequence[ChannelGroup]
) -> SourceError:
    """Return the refusal of several groups, or of several channels of one, for a quantity."""
    names = [name for group in groups for name in (group.pattern, *group.names)]
    patterns = [group.pattern for group in groups]
    if len(groups) == 1:
        patterns = [name for name in names if "{}" not in name]
    listing = " and ".join(group.label for group in groups)
    problem = f"{listing} are all named as {kind}"
    if kind == "time":
        best = _smoothest(channels, [name for name in patterns if "{}" not in name])
        if best is not None:
            patterns = [best, *(name for name in patterns if name != best)]
            problem += f"; {best} fits the motion: at its times the positions are smooth"
    options = " or ".join(f"--columns '{kind}={pattern}'" for pattern in patterns[:MAX_NAMED])
    return SourceError(channels.log, problem, field=kind, remedy=f"choose one: {options}")


def _smoothest(channels: LogChannels, names: Sequence[str]) -> str | None:
    """Return the times at which the positions are clearly smoothest; None if none are."""
    positions = [group for group in channels.candidates("position") if group.size > 1]
    if channels.file is None or len(positions) != 1 or len(names) < 2:
        return None
    try:
        file = channels.file()
        position = positions[0].numbers(file)
        found = {
            name: roughness(file.numbers([name], "time", None)[:, 0], position) for name in names
        }
    except SourceError:  # of dates, or of a cell that is no number
        return None
    known = sorted((value, name) for name, value in found.items() if value is not None)
    if not known or (len(known) > 1 and known[1][0] < _MIN_ROUGHNESS_RATIO * known[0][0]):
        return None
    return known[0][1]


def unit_of_other_quantity(
    channels: LogChannels, kind: Kind, group: ChannelGroup, unit: str
) -> SourceError:
    """Return the refusal of a group that is named as one quantity, with the unit of another.

    Args:
        channels: of the log.
        kind: quantity by its name.
        group: of channels.
        unit: that the log states.
    """
    kinds = [other for other in JOINT_KINDS[:4] if unit_of(unit, other)]
    if not kinds or kind == "time":
        return other_unit(channels.log, kind, group.label, unit)
    problem = f"{group.label} is named as {kind}, and {unit} is not a unit of it"
    options = " or ".join(f"--columns '{name}={group.pattern}'" for name in kinds)
    return SourceError(channels.log, problem, field=kind, remedy=f"choose: {options}")


def other_number_of_channels(channels: LogChannels, kind: Kind, group: ChannelGroup) -> SourceError:
    """Return the refusal of a group with fewer or more channels than the robot has joints."""
    count = group.size
    joints = channels.joints
    problem = (
        f"{count} {'channel is' if count == 1 else 'channels are'} named as {kind} "
        f"({group.label}), and the URDF has {len(joints)} joints: {joined(joints, _MAX_JOINTS)}"
    )
    otherwise = "or give the URDF's joint of each channel in joints of a map (--map map.toml)"
    if count < len(joints) or channels.recorded:
        remedy = _fix_the_others(joints, group)
        recorded = [name for name in channels.recorded if name in joints]
        return UnrecordedJointError(
            channels.log,
            problem,
            field=kind,
            remedy=f"{remedy}; {otherwise}",
            count=len(recorded) or count,
            joints=recorded or group.joints(joints),
            channels=group.names,
        )
    some = ",".join(group.names[: len(joints)])
    remedy = "give the URDF of this arm"
    if len(group.names) == count:
        remedy += f", or the channels of its joints, such as --columns '{kind}={some}'"
    return SourceError(channels.log, problem, field=kind, remedy=f"{remedy}; {otherwise}")


def _fix_the_others(joints: Sequence[str], group: ChannelGroup) -> str:
    """Return how to fix the joints that were not recorded."""
    if len(group.joints(joints)) == group.size:
        return "fix the joints that no channel names with --lock-others"
    absent, which = _absent_joints(joints, group)
    options = " ".join(f"--locked {name}" for name in absent)
    return f"fix the joints that were not recorded, {which} with {options}"


def _absent_joints(joints: Sequence[str], group: ChannelGroup) -> tuple[Sequence[str], str]:
    """Return the joints without a channel by the numbers of the others, else the last ones."""
    numbers = [number_in(name) for name in group.names]
    places = {int(match[0]) for match in numbers if match is not None}
    first = 0 if 0 in places else 1
    expected = range(first, first + len(joints))
    absent = [place for place in expected if place not in places]
    if len(places) == group.size and places < set(expected) and absent[0] < max(places):
        return [joints[place - first] for place in absent], "by the numbers of the channels"
    return joints[group.size :], "for the last ones"


def missing_channels(
    channels: LogChannels, missing: Sequence[str], unused: Sequence[ChannelGroup]
) -> SourceError:
    """Return the refusal of a log without channels of some quantities, and what would name them.

    Args:
        channels: of the log.
        missing: quantities.
        unused: groups of channels that no other quantity uses.
    """
    count = len(channels.joints)
    unnamed = [group for group in unused if group.size == count and len(group.names) > 1]
    listing = ", ".join(group.label for group in channels.groups[:MAX_NAMED])
    examples = [
        f"{kind} ({', '.join(CHANNEL_NAMES[kind_named(kind)][:3])}, ...)" for kind in missing
    ]
    problem = f"no channel is named as {' or '.join(examples)}; its channels are {listing}"
    stated = [kind for kind in kinds_of_file(channels.log) if kind != "time"]
    files = _files_next_to(channels.log)
    if unnamed and stated and len(files) > 1:
        said = stated[0].replace("_", " ")
        problem += f", which name no quantity (the name of the file says {said})"
        remedy = _map_of_files(files, channels.sample_rate)
    else:
        remedy = _columns_to_state(channels, missing, unnamed)
    return SourceError(channels.log, problem, field=", ".join(missing), remedy=remedy)


def _columns_to_state(
    channels: LogChannels, missing: Sequence[str], unnamed: Sequence[ChannelGroup]
) -> str:
    """Return the options that would name the missing quantities, of unnamed groups."""
    blocks = _blocks(channels) if channels.are_nameless else None
    steps = ["--sample-rate HZ or --columns time=NAME"] if "time" in missing else []
    if blocks is not None and steps:
        steps = ["--sample-rate HZ" if blocks.time is None else "--columns time=0"]
    pattern = ""
    for kind in (kind for kind in missing if kind != "time"):
        pattern = _likely_pattern(kind, unnamed)
        unnamed = [group for group in unnamed if group.pattern != pattern]
        if channels.are_nameless:
            block = None if blocks is None else getattr(blocks, kind)
            pattern = "NUMBER,NUMBER,..." if block is None else ",".join(map(str, block))
        steps.append(f"--columns '{kind}={pattern}'")
    if blocks is not None and blocks.velocity is not None:
        steps.append(f"--columns 'velocity={','.join(map(str, blocks.velocity))}'")
    remedy = f"state {'; '.join(steps)}; or write a map (--map map.toml)"
    if list(missing) != ["torque"]:
        return remedy
    remedy += (
        "; without torque, commanded positions (--columns"
        " 'commanded_position=NAME{}') are enough to identify the servos"
    )
    return f"record it, or {remedy}" if pattern == _ANY_NAME else remedy


def _blocks(channels: LogChannels) -> ColumnBlocks | None:
    """Return what the columns of a table without names may be."""
    if channels.file is None:
        return None
    try:
        values = channels.file().matrix(None, "position")
    except SourceError:
        return None
    return blocks_of(values, (len(channels.joints), channels.arm_joints))


def _likely_pattern(kind: str, groups: Sequence[ChannelGroup]) -> str:
    """Return the pattern of the group that may contain a quantity: by its words, else the first."""
    said = {
        group.pattern: kinds_said(group.pattern)
        for group in groups
        if group.kind in (None, kind) and _ERRORS.isdisjoint(words_of(group.pattern))
    }
    patterns = [pattern for pattern, kinds in said.items() if kind in kinds]
    patterns += [pattern for pattern, kinds in said.items() if not kinds]
    return patterns[0] if patterns else _ANY_NAME


def _files_next_to(log: Path) -> dict[Kind, str]:
    """Return the files next to the log whose names say a quantity."""
    files: dict[Kind, str] = {}
    for path in sorted(log.parent.glob(f"*{log.suffix}")):
        for kind in kinds_of_file(path):
            files.setdefault(kind, path.name)
    return files


def _map_of_files(files: Mapping[Kind, str], sample_rate: float | None) -> str:
    """Return the lines of a map for quantities in files of their own."""
    lines = ["sample_rate = HZ" if sample_rate is None else f"sample_rate = {sample_rate:g}"]
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
