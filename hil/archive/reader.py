"""Opens archives: whole ones, and torn ones up to their last whole chunk."""

from __future__ import annotations

import errno
import os
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any, BinaryIO, Final

import numpy as np
from numpy.typing import NDArray

from drivers.record import cycle_dtype
from hil.archive import container, schema
from hil.archive.cdr import LayoutError, MessageLayout, Rows
from hil.archive.chunk import Bytes, Messages
from hil.archive.container import Damage, Record, Summary
from hil.archive.events import ArchivedEvent
from hil.archive.header import FORMAT_VERSION, METADATA, ArchiveHeader, ArchiveOutcome, is_known
from hil.archive.scan import NUMBERS, Expected, Scan
from hil.archive.schema import CYCLE, EVENTS, LATER_FIELDS
from hil.errors import ArchiveError, ArchiveVersionError, NotAnArchiveError
from hil.reading import json_of, opened

_ALWAYS: Final = 1 << 63  # ns, beyond every stamp
_BATCH: Final = (
    1 << 20
)  # bytes of chunks decoded at once: few calls per chunk, and all in the cache
_COLUMN_OF: Final = {"effort": "torque"}  # where a message has another word for it than we
_UNREAD: Final = frozenset((container.MESSAGE_INDEX,))
_REMEDIES: Final = {
    errno.ENOENT: "see whether it was moved or removed",
    errno.EACCES: "make it readable for yourself",
    errno.EIO: "its disk fails: restore it from a copy",
}


@dataclass(frozen=True)
class ArchiveDamage:
    """What an archive lost.

    Attributes:
        offset: byte in the file from which nothing was read.
        reason: what is wrong there.
        bytes_dropped: bytes from there to the end of the file.
        samples: samples that could be read; None where no column was asked for.
        duration: time from the first of them to the last [s].
        outcome_missing: whether the outcome is among the losses.
    """

    offset: int
    reason: str
    bytes_dropped: int
    samples: int | None = 0
    duration: float = 0.0
    outcome_missing: bool = True

    def __str__(self) -> str:
        read = f"; {self.samples} samples ({self.duration:.6g} s) could be read"
        lost = f"the record at byte {self.offset} {self.reason}"
        lost += f" ({self.bytes_dropped} bytes from there on are unused)"
        outcome = "; the outcome is missing" if self.outcome_missing else ""
        return f"{lost}{'' if self.samples is None else read}{outcome}"


@dataclass(frozen=True, eq=False)
class Archive:
    """What an archive holds.

    Attributes:
        path: the file.
        header: what it says of itself.
        outcome: how the recording ended, None when that is missing.
        attachments: content by file name.
        columns: contiguous read-only arrays (m,) or (m, n) by name: the fields of the cycle
            message, or ``position``, ``velocity``, ``torque`` and ``motor_current`` of an imported
            recording as far as it has them; and ``stamp`` (m,), nanoseconds.
        events: what happened, in the order of writing.
        damage: what was lost, None when nothing was.
    """

    path: Path
    header: ArchiveHeader
    outcome: ArchiveOutcome | None
    attachments: Mapping[str, bytes]
    columns: Mapping[str, NDArray[Any]]
    events: tuple[ArchivedEvent, ...]
    damage: ArchiveDamage | None

    @property
    def complete(self) -> bool:
        """Whether the archive is whole: it was closed, and all its content passed its checks."""
        return self.damage is None

    @property
    def missing(self) -> str | None:
        """What is missing, as a sentence; None when the archive is complete."""
        return None if self.damage is None else f"{self.path}: {self.damage}"

    @property
    def kind(self) -> str:
        """Why the arm moved, one of `hil.archive.KINDS`."""
        return self.header.kind

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Joints in the order of the columns."""
        return self.header.joint_names

    @property
    def period(self) -> float | None:
        """Cycle time [s]; None for an imported recording without a fixed one."""
        return self.header.period

    @property
    def n_samples(self) -> int:
        """Number of samples."""
        return len(self.columns["stamp"])

    def recorded(self, *names: str) -> Mapping[str, NDArray[Any]]:
        """The columns, of an archive that has all of these.

        Raises:
            ArchiveError: one is missing, as in one that was imported.
        """
        if missing := [name for name in names if name not in self.columns]:
            raise ArchiveError(
                self.path,
                f"is no recording of a motion of hil's own: it has no {missing[0]}",
                remedy="take it out of the folder",
            )
        return self.columns

    def text(self, name: str) -> str:
        """An attachment that is text.

        Raises:
            ArchiveError: it is not there, or not UTF-8.
        """
        if name not in self.attachments:
            raise ArchiveError(
                self.path,
                f"carries no {name}",
                remedy="import the recording again with a URDF or a cell file",
            )
        try:
            return self.attachments[name].decode()
        except UnicodeDecodeError as error:
            raise ArchiveError(
                self.path,
                f"is no text in UTF-8 ({error.reason} at byte {error.start})",
                field=name,
                remedy="import the recording again with a URDF or a cell file in UTF-8",
            ) from error

    def table(self, name: str) -> dict[str, Any]:
        """An attachment that is a JSON object; empty where it is not there.

        Raises:
            ArchiveError: it is no JSON object.
        """
        try:
            found = json_of(self.attachments.get(name, b"{}"))
        except ValueError:
            found = None
        if not isinstance(found, dict):
            raise ArchiveError(
                self.path,
                "is no JSON object",
                field=name,
                remedy="leave the archive out, or take the attachment from another of its campaign",
            )
        return found

    def cycles(self) -> Rows:
        """The cycle records as the session wrote them, structure of `drivers.cycle_dtype`.

        Raises:
            ArchiveError: the archive was opened without all fields, or holds no cycles.
        """
        dtype = cycle_dtype(len(self.joint_names))
        names = dtype.names or ()
        absent = [name for name in names if name not in self.columns and name not in LATER_FIELDS]
        if absent:
            raise ArchiveError(self.path, f"has no column {absent[0]}", field=CYCLE)
        rows = np.zeros(self.n_samples, dtype)
        for name in names:
            if name in self.columns:
                rows[name] = self.columns[name]
        return rows


@dataclass(frozen=True)
class _Selection:
    """Columns, channels and times wanted; see `open_archive`."""

    fields: Collection[str] | None
    topics: Collection[str] | None
    start: float | None
    stop: float | None

    @property
    def times(self) -> tuple[int, int] | None:
        """First instant and end [ns]; None where all times are wanted."""
        if self.start is None and self.stop is None:
            return None
        start = -_ALWAYS if self.start is None else round(self.start * 1e9)
        return start, _ALWAYS if self.stop is None else round(self.stop * 1e9)

    def numbers(self, recorded: Collection[str]) -> tuple[str, ...]:
        """The channels that give columns, of an archive that has the channels `recorded`."""
        if self.topics is not None:
            return tuple(topic for topic in self.topics if topic != EVENTS)
        return (CYCLE,) if CYCLE in recorded else (schema.MEASURED, schema.MOTOR_CURRENT)

    def all(self, recorded: Collection[str]) -> tuple[str, ...]:
        """The same and, where they are wanted, the events."""
        events = self.topics is None or EVENTS in self.topics
        return (*self.numbers(recorded), *([EVENTS] if events else []))


class _Columns:
    """The fields wanted of the messages of a channel, joined at the end."""

    def __init__(self, layout: MessageLayout, selection: _Selection) -> None:
        self._layout = layout
        self._times = selection.times
        self._stamps = [np.zeros(0, np.int64)]
        self._parts: dict[str, list[Rows]] = {}
        for name in layout.dtype.names or ():
            wanted = selection.fields is None or _COLUMN_OF.get(name, name) in selection.fields
            if wanted and name not in ("sec", "nanosec"):
                self._parts[name] = []

    def verified(self, messages: Messages, offset: int) -> Bytes:
        """The messages as bytes (k, size), which must be like those before."""
        data = messages.matrix(self._layout.size)
        if data is None or not self._layout.holds_in(data):
            raise Damage(offset, "(chunk) has messages that differ from those before")
        return data

    def append(self, messages: Bytes, stamp: NDArray[np.int64]) -> None:
        """Append messages, shape (k, size), and their stamps (k,) [ns]."""
        if self._times is not None:
            wanted = (stamp >= self._times[0]) & (stamp < self._times[1])
            messages, stamp = messages[wanted], stamp[wanted]
        self._stamps.append(stamp)
        for name, parts in self._parts.items():
            dtype, start, *_ = self._layout.dtype.fields[name]  # type: ignore[index]
            raw = np.dtype((np.void, dtype.itemsize))  # copied as bytes, which is faster
            parts.append(messages[:, start : start + dtype.itemsize].view(raw)[:, 0].copy())

    def finished(self) -> dict[str, NDArray[Any]]:
        """The columns by our names, contiguous and read-only."""
        columns: dict[str, NDArray[Any]] = {"stamp": np.concatenate(self._stamps)}
        while self._parts:
            name, parts = self._parts.popitem()
            dtype = self._layout.dtype[name]
            base, shape = dtype.subdtype or (dtype, ())
            joined = np.concatenate([np.zeros(0, f"V{dtype.itemsize}"), *parts])
            columns[_COLUMN_OF.get(name, name)] = joined.view(base).reshape(-1, *shape)
        for column in columns.values():
            column.flags.writeable = False
        return columns


class _Content(Scan):
    """What is selected of a file, up to its first damage.

    Attributes:
        events: what happened, in the order of writing.
    """

    def __init__(self, selection: _Selection, expected: Expected, *, gapless: bool) -> None:
        super().__init__(expected, gapless=gapless, batch=_BATCH)
        self.events: list[ArchivedEvent] = []
        self._selection = selection
        self._columns: dict[str, _Columns] = {}

    @property
    def topics(self) -> Collection[str]:
        """The channels wanted."""
        return self._selection.all(self.parser.known.topics)

    def collect(self, records: Iterable[Record], size: int) -> Damage | None:
        """Take records up to their end or the first damage, which is returned.

        Args:
            records: of the data section, in the order of the file.
            size: length of the file.
        """
        damage = None
        try:
            for record in records:
                self.take(record)
                if record.opcode == container.METADATA:
                    self._check_metadata(record.offset)
        except Damage as found:
            damage = found
        try:
            self.flush()
            if damage is None and self._gapless and self.header is not None:
                for _, text in self.shortfalls():
                    raise Damage(size, f"is not there: {text}")
        except Damage as found:  # in an earlier record
            damage = found
        return damage

    def columns(self) -> dict[str, NDArray[Any]]:
        """The columns read, all of the same length."""
        joined: dict[str, NDArray[Any]] = {"stamp": np.zeros(0, np.int64)}
        for columns in self._columns.values():
            joined |= columns.finished()
        return joined

    def _check_metadata(self, offset: int) -> None:
        """Header and outcome must be of what can be read here, and of one recording."""
        if self.metadata is not None and not is_known(self.metadata):
            raise Damage(offset, "is of another version")
        if self.unusable is not None:
            raise Damage(offset, f"(metadata {METADATA!r}) cannot be used: {self.unusable}")
        if self.outcome is not None and not self.outcome.belongs_to(self.header):
            self.outcome = None
            raise Damage(offset, "(metadata 'hil.outcome') is that of another recording")

    def visit(self, found: Mapping[str, Messages], offset: int) -> None:
        """Decode messages."""
        recorded = self.parser.known.topics
        wanted = [topic for topic in self._selection.numbers(recorded) if topic in found]
        elsewhere = self._selection.topics is None and not found.keys().isdisjoint(NUMBERS)
        if elsewhere and not wanted:
            raise Damage(offset, "(chunk) has samples in other channels than those before")
        columns = {topic: self._columns_of(topic, found[topic], offset) for topic in wanted}
        data = {topic: columns[topic].verified(found[topic], offset) for topic in wanted}
        if EVENTS in self.topics and EVENTS in found:
            self.events += self._events(found[EVENTS], offset)
        self._columns |= columns
        for topic in wanted:
            columns[topic].append(data[topic], found[topic].stamps)

    def _columns_of(self, topic: str, messages: Messages, offset: int) -> _Columns:
        """The columns of a topic, begun by its schema or by its first message."""
        if topic in self._columns:
            return self._columns[topic]
        assert self.header is not None
        record, first = self.parser.known.schema(topic), bytes(messages.data[0][0])
        try:
            layout = schema.message_layout(topic, self.header.joint_names, record, first)
        except LayoutError as error:
            raise Damage(offset, f"(chunk) has messages of {topic}: {error}") from error
        return _Columns(layout, self._selection)

    def _events(self, messages: Messages, offset: int) -> list[ArchivedEvent]:
        """The events of the time that is wanted."""
        try:
            events = [ArchivedEvent.decode(message) for message in messages.all()]
        except LayoutError as error:
            raise Damage(offset, f"(chunk) has an event that cannot be read: {error}") from error
        start, stop = self._selection.times or (-_ALWAYS, _ALWAYS)
        return [event for event in events if start <= event.stamp < stop]


def open_archive(
    path: str | PathLike[str],
    *,
    fields: Collection[str] | None = None,
    topics: Collection[str] | None = None,
    start: float | None = None,
    stop: float | None = None,
) -> Archive:
    """Read an archive.

    A file that was cut off or damaged is read up to its last whole chunk before the damage; what
    is read is what was written, or the archive says what it lost. Where only some channels or
    times are wanted and the index of the file is whole, the rest is not even read, and its damages
    go unnoticed.

    Args:
        path: the file.
        fields: columns wanted, None for all.
        topics: channels wanted, such as ``/joint_states_commanded`` instead of ``/hil/cycle``;
            None for those that hold the numbers and the events.
        start: first instant wanted [s], on the clock of ``stamp`` and of the events.
        stop: end of the time wanted [s]; what happened then is left out.

    Raises:
        NotAnArchiveError: another kind of file, or one torn before it held anything.
        ArchiveVersionError: written by a newer version of the profile.
        ArchiveError: the file cannot be read, or has no such channel.
    """
    path = Path(path)
    alike = {CYCLE, schema.MEASURED, schema.COMMANDED, schema.PACKETS}.intersection(topics or ())
    if len(alike) > 1:
        names = ", ".join(sorted(alike))
        raise ValueError(f"columns of {names} have the same names: open one at a time")
    selection = _Selection(fields, topics, start, stop)
    try:
        with opened(path) as stream:
            size = os.fstat(stream.fileno()).st_size
            summary, damage, content = Summary.read(stream, size), None, None
            expected = Expected.read(stream, size, summary)
            if summary is not None and (selection.times is not None or topics is not None):
                content = _by_index(stream, selection, expected, summary)
            if content is None:
                stream.seek(0)
                content = _Content(selection, expected, gapless=True)
                damage = content.collect(container.records(stream, size, skip=_UNREAD), size)
    except OSError as error:
        remedy = _REMEDIES.get(error.errno or 0, "")
        raise ArchiveError(path, f"cannot be read: {error.strerror}", remedy=remedy) from error
    except MemoryError as error:
        raise ArchiveError(
            path, "does not fit into memory", remedy="read a part of its time, or fewer columns"
        ) from error
    if content.header is None:
        raise _unreadable(path, size, content, damage)
    recorded = sorted(content.parser.known.topics)
    unknown = [topic for topic in topics or () if topic not in recorded]
    if damage is None and recorded and unknown:
        remedy = f"it has {', '.join(recorded)}"
        raise ArchiveError(path, "has no such channel", field=unknown[0], remedy=remedy)
    columns = content.columns()
    stamp = columns["stamp"]
    with_columns = fields is None or bool(fields)
    lost = (
        None
        if damage is None
        else ArchiveDamage(
            offset=damage.offset,
            reason=damage.reason,
            bytes_dropped=size - damage.offset,
            samples=len(stamp) if with_columns else None,
            duration=1e-9 * float(stamp[-1] - stamp[0]) if with_columns and len(stamp) else 0.0,
            outcome_missing=content.outcome is None,
        )
    )
    return Archive(
        path=path,
        header=content.header,
        outcome=content.outcome,
        attachments=content.attachments,
        columns=columns,
        events=tuple(content.events),
        damage=lost,
    )


def _by_index(
    stream: BinaryIO, selection: _Selection, expected: Expected, summary: Summary
) -> _Content | None:
    """What is selected, found through the summary; None where that or what it names is damaged."""
    content = _Content(selection, expected, gapless=False)
    known = content.parser.known
    try:
        for record in summary.definitions:
            known.take(record)
        indexed, others = summary.chunks, summary.others
    except Damage:
        return None
    # A chunk that has other samples than those wanted is to be seen, too.
    topics = {*selection.all(known.topics), *(NUMBERS if selection.topics is None else ())}
    wanted = {channel.id for channel in known.channels.values() if channel.topic in topics}
    start, stop = selection.times or (-_ALWAYS, _ALWAYS)
    chunks = [chunk for chunk in indexed if chunk.message_index_offsets.keys() & wanted]
    within = [
        one for one in chunks if one.message_start_time < stop and one.message_end_time >= start
    ]
    # Where nothing falls into the range, one chunk still tells what columns there are.
    places = [(one.chunk_start_offset, one.chunk_length) for one in within or chunks[:1]]
    records = (container.record_at(stream, *place) for place in sorted([*others, *places]))
    damage = content.collect(records, 0)
    return content if damage is None and content.metadata is not None else None


def _unreadable(path: Path, size: int, content: _Content, damage: Damage | None) -> ArchiveError:
    """Why a file without a header that can be used is refused."""
    if content.unusable is not None:
        field, problem = next(iter(content.unusable.problems.items()))
        remedy = f"what wrote this archive does not keep the profile: its record {METADATA!r} "
        return ArchiveError(path, problem, field=field, remedy=f"{remedy}must be mended there")
    if content.metadata is not None:
        version = content.metadata.get("format_version")
        return ArchiveVersionError(
            path,
            f"is of profile version {version}; this software reads version {FORMAT_VERSION}",
            remedy="install a newer hil",
        )
    remedy = "record it again"
    if size == 0:
        problem = "is empty: the recording ended before anything was written"
    elif damage is None:
        problem = f"is an MCAP file, but not an archive: it has no {METADATA!r} metadata record"
        remedy = "name a file that hil recorded or imported"
    elif damage.offset == 0:
        problem = "is not an MCAP file"
        remedy = "name a file that hil recorded, or import this one first"
    else:
        problem = f"is torn before its first data: the record at byte {damage.offset} {damage}"
    return NotAnArchiveError(path, problem, remedy=remedy)
