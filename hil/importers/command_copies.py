"""Positions of a log that equal its commands bit for bit: they were not measured."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Final

import numpy as np

from hil.base.arrays import Array
from hil.base.errors import SourceError
from hil.importers.array_files import ArrayFile
from hil.importers.channel_groups import ChannelGroup
from hil.importers.commands import COMMANDED
from hil.importers.conclusions import CopiedCommands
from hil.importers.name_words import kinds_said
from hil.importers.text_table import TextTable

_MIN_EQUAL_ROWS_SHARE: Final = 0.999  # of the rows


def copied_commands(
    position: Array,
    file: TextTable | ArrayFile,
    groups: Sequence[ChannelGroup],
    used: Collection[str],
) -> CopiedCommands | None:
    """Return which commands positions (m, n) copy, and which channels may hold measured ones.

    Args:
        position: numbers of the file, not converted.
        file: of the log.
        groups: of its channels.
        used: names of the channels of the positions.

    Returns:
        what was found; None where positions differ from every command, or nothing moves.
    """
    if not len(position) or not np.ptp(position, axis=0).any():
        return None
    others = [
        group
        for group in groups
        if group.size == position.shape[1] and not set(group.names) & set(used)
    ]
    commands = [group for group in others if COMMANDED.search(group.pattern)]
    for group in commands:
        try:
            values = group.numbers(file)
        except SourceError:  # of a cell that is no number
            continue
        if values.shape != position.shape:
            continue
        if np.mean((values == position).all(axis=1)) >= _MIN_EQUAL_ROWS_SHARE:
            measured = [
                other.pattern
                for other in others
                if other not in commands and "position" in kinds_said(other.pattern)
            ]
            return CopiedCommands(group.label, tuple(measured))
    return None
