"""What a log says beside its motion: temperatures, and of which robot it is."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from mcap.reader import make_reader

from hil.base.errors import SourceError
from hil.base.safe_input import open_file
from hil.importers.array_files import ArrayFile
from hil.importers.channels import channels_of
from hil.importers.column_map import Format
from hil.importers.log_files import LogFiles
from hil.importers.text_table import TextTable

_TEMPERATURE: Final = re.compile(r"temp(?!late|orary|lat)|celsius|°c", re.IGNORECASE)
_MOST_COLUMNS: Final = 64


class WantedFacts(NamedTuple):
    """What is read of each log beside its motion; temperatures are found by their names.

    Attributes:
        columns: their names.
        entry: of the metadata of an MCAP file, "" for none.
    """

    columns: tuple[str, ...] = ()
    entry: str = ""


def facts_of(source: Path, wanted: WantedFacts, files: LogFiles) -> dict[str, float | str]:
    """Return the means of columns of numbers, and the texts of others, by their names.

    What cannot be read is left out: the motion has been read, and counts without it.
    """
    facts: dict[str, float | str] = {}
    if wanted.entry and source.suffix.lower() == ".mcap":
        facts.update(_entries(source, wanted.entry))
    if source.is_dir():
        return facts
    try:
        channels = channels_of(source, files=files)
        table = files.file(source, Format())
    except SourceError:  # a bag, whose topics have no columns
        return facts
    for channel in channels:
        is_wanted = channel.name in wanted.columns
        if is_wanted and channel.text:
            facts[channel.name] = channel.text
        elif is_wanted or _TEMPERATURE.search(f"{channel.name} {channel.unit or ''}"):
            facts.update(_means(table, channel.name))
    return facts


def _means(table: TextTable | ArrayFile, name: str) -> Iterator[tuple[str, float]]:
    """Yield the mean of a column; of an array with several, that of each, numbered from 1."""
    try:
        if isinstance(table, TextTable):
            values = table.numbers([name], "facts")
        else:
            values = table.matrix(name, "facts")
    except SourceError:
        return
    for number, column in enumerate(values.T[:_MOST_COLUMNS], 1):
        finite = column[np.isfinite(column)]
        if len(finite):
            yield (name if values.shape[1] == 1 else f"{name}{number}"), float(finite.mean())


def _entries(source: Path, entry: str) -> Iterator[tuple[str, str]]:
    """Yield the entry of the metadata of an MCAP file."""
    try:
        with open_file(source) as stream:
            for record in make_reader(stream).iter_metadata():
                if entry in record.metadata:
                    yield entry, record.metadata[entry]
                    return
    except Exception:  # of a damaged file, of which the import has said what is wrong
        return
