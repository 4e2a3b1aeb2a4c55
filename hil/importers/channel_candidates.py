"""Channels of a log that may hold a quantity, by their names."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final, NamedTuple

from hil.importers.array_files import ArrayFile
from hil.importers.channel_groups import ChannelGroup
from hil.importers.conclusions import NameBasis
from hil.importers.name_words import is_commanded_position, kind_by_words, kinds_said, words_of
from hil.importers.text_table import TextTable
from hil.importers.units import Kind

_NANO: Final = frozenset({"nano", "nanosec", "nanosecs", "nanoseconds", "nsec", "nsecs"})
"""Words of the nanoseconds of a time whose seconds are in another column."""


@dataclass(frozen=True, eq=False)
class LogChannels:
    """The channels of a log, and what the user or the log states about them.

    Attributes:
        log: its path.
        groups: of channels that differ by the joint only.
        joints: of the robot.
        recorded: joints that the log names, in its order; empty if it names the robot's.
        arm_joints: number of joints, a gripper's excluded.
        chosen: channels that are given, by quantity.
        nanoseconds: column to be added to a given time.
        sample_rate: replaces the time [Hz].
        with_unit: quantities whose unit a map states.
        file: parses the log; None for a folder.
    """

    log: Path
    groups: Sequence[ChannelGroup]
    joints: Sequence[str]
    recorded: Sequence[str] = ()
    arm_joints: int = 0
    chosen: Mapping[str, str] = field(default_factory=dict)
    nanoseconds: int | None = None
    sample_rate: float | None = None
    with_unit: Collection[str] = ()
    file: Callable[[], TextTable | ArrayFile] | None = None

    @property
    def column_joints(self) -> Sequence[str]:
        """Joints in the order of the columns."""
        return self.recorded or self.joints

    @property
    def are_nameless(self) -> bool:
        """Whether the channels have no names, but indices."""
        return all(group.pattern in ("{}", "0") for group in self.groups)

    @property
    def have_commands(self) -> bool:
        """Whether commanded positions are given or named."""
        kind: Kind = "commanded_position"
        return kind in self.chosen or bool(self.candidates(kind))

    def candidates(self, kind: Kind) -> list[ChannelGroup]:
        """Return the groups that may hold a quantity: by whole names, else by words in them."""
        if kind == "time":
            return self._times().seconds
        named = self._named(kind)
        if not named and kind == "commanded_position":
            return self._commands_by_words()
        return named

    def nanoseconds_of_time(self) -> ChannelGroup | None:
        """Return the nanoseconds of a time whose seconds are in another column."""
        return self._times().nanoseconds

    def _named(self, kind: Kind) -> list[ChannelGroup]:
        groups = self._not_given()
        named = [group for group in groups if group.kind == kind]
        if named or kind == "commanded_position":
            return named
        said = [g for g in groups if g.kind is None and kind_by_words(g.pattern) == kind]
        return _by_words(kind, said, len(self.column_joints))

    def _not_given(self) -> list[ChannelGroup]:
        given = set(self.chosen.values())
        return [group for group in self.groups if group.pattern not in given]

    def _times(self) -> _Times:
        named = self._named("time")
        single = [group for group in named if group.size == 1]
        single = [g for g in single if {"header", "stamp"} <= set(words_of(g.pattern))] or single
        if len(single) > 1:  # a time of day with its date, and without the date where it wraps
            single = [g for g in single if "date" not in words_of(g.pattern)] or single
        parts = [group for group in single if _NANO & set(words_of(group.pattern))]
        if len(single) == 2 and len(parts) == 1:
            return _Times([group for group in single if group is not parts[0]], parts[0])
        return _Times(single or named, None)

    def _commands_by_words(self) -> list[ChannelGroup]:
        """Return the groups that a word calls commands, of a log without torque and current.

        A log with a torque needs no commands: there they are used only where they are named.
        """
        motors: list[Kind] = ["torque", "motor_current"]
        measured = [group for kind in motors for group in self.candidates(kind)]
        if not all(is_load(group.pattern) for group in measured):
            return []
        count = len(self.column_joints)
        said = [g for g in self._not_given() if g.size == count]
        said = [g for g in said if is_commanded_position(g.pattern)]
        positions = [group for group in said if "position" in kinds_said(group.pattern)]
        return [replace(group, by_words=NameBasis.WORD) for group in positions or said]


class _Times(NamedTuple):
    seconds: list[ChannelGroup]  # or the whole time
    nanoseconds: ChannelGroup | None


def is_load(name: str) -> bool:
    """Return whether a channel is named as the load of a servo, which may be a torque."""
    return "load" in words_of(name)


def _by_words(kind: Kind, said: Sequence[ChannelGroup], count: int) -> list[ChannelGroup]:
    """Return the groups with one channel for each of `count` joints, of groups with its words."""
    said = [replace(group, by_words=NameBasis.WORD) for group in said]
    single = [group for group in said if group.size == 1]
    if kind == "time":
        return single
    several = [group for group in said if group.size > 1]
    exact = [group for group in several if group.size == count]
    if exact or several or len(single) != count:
        return exact or several
    names = tuple(group.names[0] for group in single)
    unit = single[0].unit
    return [ChannelGroup(",".join(names), kind, names, count, unit, by_words=NameBasis.WORDS)]
