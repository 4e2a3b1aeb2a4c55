"""Channels of a log besides its motion: temperatures, and the name of its robot."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from mcap.reader import make_reader

from hil.base.arrays import Array
from hil.base.errors import SourceError
from hil.base.safe_input import open_file
from hil.fleet.covariates import may_explain
from hil.importers.array_files import ArrayFile
from hil.importers.bags import SUFFIXES as BAGS
from hil.importers.bags import BagMessage, open_bag
from hil.importers.channels import channels_of
from hil.importers.column_map import Format
from hil.importers.log_files import LogFiles
from hil.importers.mcap_messages import Topic
from hil.importers.text_table import TextTable

_MAX_COLUMNS: Final = 64
_JOINTS: Final = ("name", "joint_names")  # fields of a message that name joints
_NO_FACTS: Final = (*_JOINTS, "header", "layout", "variance")


class ExtraChannels(NamedTuple):
    """Channels read from each log besides its motion; some columns are found by name.

    These are temperatures and the time since the start.

    Attributes:
        columns: their names.
        entry: of the metadata of an MCAP file, "" for none.
    """

    columns: tuple[str, ...] = ()
    entry: str = ""


def facts_of(source: Path, extra: ExtraChannels, files: LogFiles) -> dict[str, float | str]:
    """Return the means of columns of numbers, and the texts of others, by their names.

    What cannot be read is left out: the motion has been read, and counts without it.
    """
    facts: dict[str, float | str] = {}
    if extra.entry and source.suffix.lower() == ".mcap":
        facts.update(_entries(source, extra.entry))
    if source.is_dir() or source.suffix.lower() in (*BAGS, ".zst", ".zstd"):
        facts.update(_of_topics(source, extra.columns))
        return facts
    try:
        channels = channels_of(source, files=files)
        table = files.file(source, Format())
    except SourceError:
        return facts
    for channel in channels:
        is_named = channel.name in extra.columns
        if is_named and channel.text:
            facts[channel.name] = channel.text
        elif is_named or may_explain(f"{channel.name} {channel.unit or ''}"):
            facts.update(_means(table, channel.name))
    return facts


def _of_topics(source: Path, columns: Collection[str]) -> Iterator[tuple[str, float]]:
    """Yield the means of what may explain a change in a bag, and of what `columns` name.

    A name joins topic and field, such as ``/motor/temperature``. Fields of several values end with
    the joint where the message names joints, else with a number from 1.
    """
    try:
        with open_bag(source) as bag:
            for topic, kind in bag.topics.items():
                if kind.is_ros and (_may_explain(topic, kind) or _is_named(topic, columns)):
                    yield from _of_messages(topic, bag.messages(topic), columns)
    except SourceError:
        return


def _may_explain(topic: str, kind: Topic) -> bool:
    definition = kind.definition.decode(errors="replace")
    return may_explain(f"{topic} {kind.kind} {definition}")


def _is_named(topic: str, columns: Collection[str]) -> bool:
    return any(name == topic or name.startswith(f"{topic}/") for name in columns)


def _of_messages(
    topic: str, messages: Iterable[BagMessage], columns: Collection[str]
) -> Iterator[tuple[str, float]]:
    found: dict[str, list[float]] = {}
    for message in messages:
        content = vars(message.content)
        joints = next((content[name] for name in _JOINTS if name in content), ())
        for field, value in content.items():
            alone = field == "data" or topic.endswith(f"/{field}")
            name = topic if alone else f"{topic}/{field}"
            if field in _NO_FACTS or not (name in columns or may_explain(name)):
                continue
            values = _numbers(value)
            ends = [str(k) for k in range(1, len(values) + 1)] if len(values) > 1 else [""]
            if len(joints) == len(values):
                ends = [f"/{joint}" for joint in joints]
            for end, number in zip(ends, values.tolist(), strict=False):
                if np.isfinite(number):
                    found.setdefault(f"{name}{end}", []).append(number)
    for name, numbers in found.items():
        yield name, float(np.mean(numbers))


def _numbers(value: object) -> Array:
    """Return the numbers of a field (k,), none of a field of another kind."""
    try:
        numbers = np.atleast_1d(np.asarray(value, dtype=np.float64))
    except (TypeError, ValueError):
        return np.empty(0)
    return numbers if numbers.ndim == 1 and len(numbers) <= _MAX_COLUMNS else np.empty(0)


def _means(table: TextTable | ArrayFile, name: str) -> Iterator[tuple[str, float]]:
    """Yield the mean of a column, or of each column of an array, numbered from 1."""
    try:
        if isinstance(table, TextTable):
            values = table.numbers([name], "facts")
        else:
            values = table.matrix(name, "facts")
    except SourceError:
        return
    for number, column in enumerate(values.T[:_MAX_COLUMNS], 1):
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
