"""The channels of a log that hold a quantity: given, or the only ones that are named so."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from hil.importers.channel_candidates import LogChannels, is_load
from hil.importers.channel_groups import ChannelGroup
from hil.importers.channel_refusals import (
    other_number_of_channels,
    several_channels,
    unit_of_other_quantity,
)
from hil.importers.channels import kind_of
from hil.importers.conclusions import ChannelMeaning, NameBasis, UnitBasis
from hil.importers.name_words import is_measured
from hil.importers.units import Kind, unit_of


@dataclass(frozen=True)
class ChannelChoice:
    """Channels of a quantity.

    Attributes:
        columns: a name, with ``{}`` for the joint, or a list of names or of indices.
        meaning: quantity and unit, and from what they follow.
        used: names of the channels.
        nanoseconds: column to add to the time.
    """

    columns: str | Sequence[str | int]
    meaning: ChannelMeaning
    used: frozenset[str]
    nanoseconds: str | int | None = None


def choose_channels(channels: LogChannels, kind: Kind) -> ChannelChoice | None:
    """Return the channels of a quantity; None if the log has none.

    Raises:
        SourceError: several may be meant, or their number or unit is another.
    """
    if kind in channels.chosen:
        return _given(channels, kind)
    group = _only_group(channels, kind)
    if group is None:
        return None
    count = len(channels.column_joints)
    if kind == "torque" and is_load(group.pattern) and not channels.have_commands:
        return None
    if kind == "commanded_position" and group.size != count:
        return None  # actions of something else
    unit = None if kind in channels.with_unit else group.unit
    if unit is not None and unit_of(unit, kind) is None:
        raise unit_of_other_quantity(channels, kind, group, unit)
    if kind == "time":
        if group.size > 1:
            raise several_channels(channels, kind, [group])
    elif group.size != count or not set(channels.joints) <= set(channels.column_joints):
        raise other_number_of_channels(channels, kind, group)
    nanoseconds = channels.nanoseconds_of_time() if kind == "time" else None
    used = {group.pattern, *group.names}
    return ChannelChoice(
        group.columns(channels.column_joints),
        _meaning(kind, group),
        frozenset(used if nanoseconds is None else used | {nanoseconds.pattern}),
        None if nanoseconds is None else nanoseconds.names[0],
    )


def unused_groups(channels: LogChannels, choices: Iterable[ChannelChoice]) -> list[ChannelGroup]:
    """Return the groups of channels that no quantity uses."""
    used = frozenset[str]().union(*(choice.used for choice in choices))
    return [
        group
        for group in channels.groups
        if group.pattern not in used and not used.issuperset(group.names)
    ]


def _given(channels: LogChannels, kind: Kind) -> ChannelChoice:
    """Return names or, where the log has none, indices that were given for a quantity."""
    text = channels.chosen[kind]
    names = [name.strip() for name in text.split(",")]
    columns: str | Sequence[str | int] = names if len(names) > 1 else text
    if channels.are_nameless and all(map(str.isdigit, names)):
        columns = [int(name) for name in names]
    meaning = ChannelMeaning(text, kind, NameBasis.OPTION, None, UnitBasis.OPTION)
    nanoseconds = channels.nanoseconds if kind == "time" else None
    return ChannelChoice(columns, meaning, frozenset({text, *names}), nanoseconds)


def _only_group(channels: LogChannels, kind: Kind) -> ChannelGroup | None:
    """Return the candidate for a quantity: measured rather than others, a torque than a load."""
    groups = channels.candidates(kind)
    measured = [group for group in groups if is_measured(group.pattern)]
    if len(measured) == 1:
        groups = measured
    if kind == "torque":
        groups = [group for group in groups if not is_load(group.pattern)] or groups
    if len(groups) > 1:
        groups = _joined(kind, groups, channels.column_joints)
    if len(groups) > 1:
        raise several_channels(channels, kind, groups)
    return groups[0] if groups else None


def _joined(
    kind: Kind, groups: Sequence[ChannelGroup], joints: Sequence[str]
) -> list[ChannelGroup]:
    """Return groups of different joints as one, such as torques of some and a force of one."""
    named = [
        (joint, name)
        for group in groups
        for joint, name in zip(group.joints(joints), group.names, strict=False)
    ]
    names = dict(named)
    if len(names) < len(named) or set(names) != set(joints):
        return [*groups]
    ordered = tuple(names[joint] for joint in joints)
    unit = next(group.unit for group in groups if ordered[0] in group.names)
    return [ChannelGroup(",".join(ordered), kind, ordered, len(ordered), unit, by_joint=True)]


def _meaning(kind: Kind, group: ChannelGroup) -> ChannelMeaning:
    unit_basis = UnitBasis.LOG
    if group.unit is None:
        by_custom = kind in ("torque", "motor_current")
        unit_basis = UnitBasis.CUSTOM if by_custom else UnitBasis.NUMBERS
    basis = NameBasis.JOINT if group.by_joint else NameBasis.NAME
    if group.unit is not None and kind_of(group.names[0])[0] is None and not group.by_joint:
        basis = NameBasis.UNIT
    return ChannelMeaning(group.label, kind, group.by_words or basis, group.unit, unit_basis)
