"""Commanded positions in a file of their own, with times of its own (``--commands``)."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from hil.base.errors import SourceError
from hil.importers.channel_groups import ChannelGroup, grouped
from hil.importers.channels import channels_of
from hil.importers.column_map import Format
from hil.importers.log_files import LogFiles
from hil.importers.name_words import kind_by_words

_OPTION = "--commands"


@dataclass(frozen=True)
class CommandFile:
    """Location of the commands in a file.

    Attributes:
        columns: of the joints, in their order.
        entries: of the column map, by dotted names.
    """

    columns: tuple[str, ...]
    entries: dict[str, str]

    @classmethod
    def of(
        cls, path: Path, log: Path, joints: Sequence[str], form: Format | None, files: LogFiles
    ) -> CommandFile:
        """Return the commands in a file that belongs to a log.

        Args:
            path: of the file.
            log: whose column map gets the entries.
            joints: of the robot.
            form: how texts are written, None to detect it.
            files: parsed before.

        Raises:
            SourceError: it has no times, or not one channel for each joint.
        """
        channels = [each for each in channels_of(path, form, files) if not each.is_repeated]
        groups = grouped(channels, joints)
        times = [g for g in groups if g.size == 1 and _kind(g) == "time"]
        if len(times) != 1:
            names = ", ".join(group.label for group in times) or "none"
            problem = f"needs one column of times, and has {names}"
            remedy = "name it time or timestamp"
            raise SourceError(path, problem, field=_OPTION, remedy=remedy)
        columns = _columns(groups, joints)
        if columns is None:
            problem = f"has no {len(joints)} channels for {', '.join(joints)}"
            remedy = "name its columns as the joints, or position_{} with the joint or its number"
            raise SourceError(path, problem, field=_OPTION, remedy=remedy)
        entries = {
            "commanded_position.file": os.path.relpath(path, log.parent),
            "commanded_position.time.column": times[0].names[0],
        }
        return cls(tuple(columns), entries)


def _columns(groups: Sequence[ChannelGroup], joints: Sequence[str]) -> Sequence[str] | None:
    """Return the channels of the joints: by their names, else the only group of as many."""
    names = {name for group in groups for name in group.names}
    if names.issuperset(joints):
        return joints
    whole = [group for group in groups if group.size == len(joints)]
    commands = [g for g in whole if _kind(g) in ("commanded_position", "position")] or whole
    return commands[0].names if len(commands) == 1 else None


def _kind(group: ChannelGroup) -> str | None:
    return group.kind or kind_by_words(group.pattern)
