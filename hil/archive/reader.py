"""Opens archives: whole ones, and torn ones up to their last whole chunk."""

from __future__ import annotations

import errno
import math
import os
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Any, BinaryIO, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.record import cycle_dtype
from hil.archive import container, schema
from hil.archive.cdr import LayoutError, MessageLayout, Rows
from hil.archive.chunk import Bytes, Messages
from hil.archive.container import Damage, Record, Summary
from hil.archive.events import ArchivedEvent
from hil.archive.header import (
    FORMAT_VERSION,
    METADATA,
    OUTCOME,
    ArchiveHeader,
    ArchiveOutcome,
    is_known,
)
from hil.archive.scan import NUMBERS, Order, Scan
from hil.archive.schema import CYCLE, EVENTS, LATER_FIELDS
from hil.errors import ArchiveError, ArchiveVersionError, NotAnArchiveError
from hil.reading import json_of, opened

_NANOSECONDS = 1_000_000_000
_ALWAYS = 1 << 63  # ns, beyond every stamp


@dataclass(frozen=True)
class Selection:
    """Columns, channels and times wanted.

    Attributes:
        fields: columns, None for all.
        topics: channels, None for those that hold the numbers and the events.
        start: first instant [s] on the archive's own clock, None for its beginning.
        stop: end [s], itself left out; None for the archive's end.
    """

    fields: Collection[str] | None = None
    topics: Collection[str] | None = None
    start: float | None = None
    stop: float | None = None

    def __post_init__(self) -> None:
        alike = {schema.CYCLE, schema.MEASURED, schema.COMMANDED, schema.PACKETS}
        named_alike = alike.intersection(self.topics or ())
        if len(named_alike) > 1:
            names = ", ".join(sorted(named_alike))
            raise ValueError(f"columns of {names} have the same names: open one at a time")

    @property
    def times(self) -> tuple[int, int]:
        """First instant and end [ns]."""
        start = -_ALWAYS if self.start is None else round(self.start * _NANOSECONDS)
        stop = _ALWAYS if self.stop is None else round(self.stop * _NANOSECONDS)
        return start, stop

    @property
    def bounded(self) -> bool:
        """Whether only a range of times is wanted."""
        return self.start is not None or self.stop is not None

    @property
    def partial(self) -> bool:
        """Whether some chunks may not be needed."""
        return self.bounded or self.topics is not None

    def numbers(self, recorded: Collection[str]) -> tuple[str, ...]:
        """The channels that give columns, of an archive that has the channels `recorded`."""
        if self.topics is not None:
            return tuple(topic for topic in self.topics if topic != schema.EVENTS)
        if schema.CYCLE in recorded:
            return (schema.CYCLE,)
        return (schema.MEASURED, schema.MOTOR_CURRENT)

    @property
    def events(self) -> bool:
        """Whether events are wanted."""
        return self.topics is None or schema.EVENTS in self.topics


_FIRST_ROOM = 4096  # samples
_MOST_ROOM = 1 << 20  # samples that room is made for on the word of the outcome
_BATCH = 1 << 20  # bytes of chunks decoded at once: few calls per chunk, and all in the cache
_COLUMN_OF = {"effort": "torque"}  # where a message has another word for it than we
_STAMP_FIELDS = ("sec", "nanosec")


class _Block(NamedTuple):
    """Fields of one type that lie side by side in a message: copied together, as bytes."""

    names: list[str]
    start: int
    dtype: np.dtype[Any]
    shape: tuple[int, ...]
    raw: np.dtype[np.void]

    @property
    def end(self) -> int:
        return self.start + len(self.names) * self.raw.itemsize


class _Columns:
    """Contiguous arrays, one per field of a message, appended to chunk by chunk.

    Args:
        layout: the messages; their time stamp becomes the column ``stamp`` in nanoseconds.
        selection: fields and times wanted.
        room: for so many at first, where all times are wanted.
    """

    def __init__(self, layout: MessageLayout, selection: Selection, room: int) -> None:
        self._layout = layout
        self._times = selection.times if selection.bounded else None
        self._blocks = _blocks(layout, selection.fields)
        self._stamps = np.empty(0, np.int64)
        self._arrays = [np.empty((len(block.names), 0), block.raw) for block in self._blocks]
        self._count = 0
        if self._times is None:
            self._grow(room)

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
        now = slice(self._count, self._count + len(messages))
        if now.stop > len(self._stamps):
            self._grow(max(_FIRST_ROOM, 2 * now.stop))
        self._stamps[now] = stamp
        for block, array in zip(self._blocks, self._arrays, strict=True):
            array[:, now] = messages[:, block.start : block.end].view(block.raw).T
        self._count = now.stop

    def finished(self) -> dict[str, NDArray[Any]]:
        """The columns by our names, contiguous and read-only."""
        columns: dict[str, NDArray[Any]] = {"stamp": self._stamps[: self._count]}
        for block, array in zip(self._blocks, self._arrays, strict=True):
            fields = array.view(block.dtype).reshape(*array.shape, *block.shape)
            for name, values in zip(block.names, fields, strict=True):
                columns[_COLUMN_OF.get(name, name)] = values[: self._count]
        for column in columns.values():
            column.flags.writeable = False
        return columns

    def _grow(self, room: int) -> None:
        filled = slice(self._count)
        stamps, self._stamps = self._stamps, np.empty(room, np.int64)
        self._stamps[filled] = stamps[filled]
        for index, array in enumerate(self._arrays):
            self._arrays[index] = np.empty((len(array), room), array.dtype)
            self._arrays[index][:, filled] = array[:, filled]


def _blocks(layout: MessageLayout, fields: Collection[str] | None) -> list[_Block]:
    """Gather the wanted fields into blocks of neighbours."""
    blocks: list[_Block] = []
    places: Mapping[str, Any] = layout.dtype.fields or {}
    for name, (dtype, start, *_) in places.items():
        unwanted = fields is not None and _COLUMN_OF.get(name, name) not in fields
        if name in _STAMP_FIELDS or unwanted:
            continue
        base, shape = dtype.subdtype or (dtype, ())
        last = blocks[-1] if blocks else None
        if last and (last.end, last.dtype, last.shape) == (start, base, shape):
            last.names.append(name)
        else:
            raw = np.dtype((np.void, base.itemsize * math.prod(shape)))
            blocks.append(_Block([name], start, base, shape, raw))
    return blocks


class _Content(Scan):
    """What is selected of a file, up to its first damage.

    Args:
        selection: what is wanted of it.
        order: the chunks that must come.

    Attributes:
        events: what happened, in the order of writing.
    """

    def __init__(self, selection: Selection, order: Order) -> None:
        super().__init__(order, topics=())
        self.events: list[ArchivedEvent] = []
        self._selection = selection
        self._columns: dict[str, _Columns] = {}
        self._waiting: list[tuple[int, bytes]] = []  # chunks that are decoded with others
        self._waiting_size = 0

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
        except Damage as found:
            damage = found
        try:
            self._take_waiting()
            if damage is None:
                self._check_end(size)
        except Damage as found:  # in an earlier record
            damage = found
        return damage

    def columns(self) -> dict[str, NDArray[Any]]:
        """The columns read, all of the same length."""
        joined: dict[str, NDArray[Any]] = {"stamp": np.zeros(0, np.int64)}
        for columns in self._columns.values():
            joined |= columns.finished()
        return joined

    def take_metadata(self, record: Record, name: str, entries: dict[str, str]) -> None:
        """Take header or outcome, which must be of what can be read here."""
        super().take_metadata(record, name, entries)
        if self.metadata is not None and not is_known(self.metadata):
            raise Damage(record.offset, "is of another version")
        if self.unusable is not None:
            raise Damage(record.offset, f"(metadata {name!r}) cannot be used: {self.unusable}")
        if self.outcome is not None and not self.outcome.belongs_to(self.header):
            self.outcome = None
            raise Damage(record.offset, f"(metadata {name!r}) is that of another recording")

    def take_chunk(self, record: Record) -> None:
        """Take a chunk, or leave it to be decoded with others."""
        data = self.opened(record)
        if not self.parser.repeats(data):
            self._take_waiting()
            self._decode(self.parser.messages(data, record.offset), record.offset)
            return
        self._waiting.append((record.offset, data))
        self._waiting_size += len(data)
        if self._waiting_size >= _BATCH:
            self._take_waiting()

    def _take_waiting(self) -> None:
        """Decode the chunks that wait: all at once, or one by one where that fails."""
        waiting, self._waiting, self._waiting_size = self._waiting, [], 0
        if not waiting:
            return
        try:
            found = self.parser.repeated([data for _, data in waiting])
            if found is not None:
                self._decode(found, waiting[0][0])
                return
        except Damage:
            pass  # in one of them
        for offset, data in waiting:
            self._decode(self.parser.messages(data, offset), offset)

    def _decode(self, numbered: dict[int, Messages], offset: int) -> None:
        """Decode messages, if they are what must follow now; else nothing of them counts."""
        found = self.parser.by_topic(numbered, offset)
        recorded = self.parser.known.topics
        wanted = tuple(topic for topic in self._selection.numbers(recorded) if topic in recorded)
        counts = {len(found[topic]) if topic in found else 0 for topic in wanted}
        if len(counts) > 1:
            raise Damage(offset, "(chunk) has channels of different length")
        elsewhere = self._selection.topics is None and not found.keys().isdisjoint(NUMBERS)
        if elsewhere and not any(counts):
            raise Damage(offset, "(chunk) has samples in other channels than those before")
        self._topics = (*wanted, EVENTS) if self._selection.events else wanted
        decoded = []
        for topic in wanted:
            if topic in found:
                columns = self._columns.get(topic) or self._begun(topic, found[topic], offset)
                decoded.append((topic, columns, columns.verified(found[topic], offset)))
        events = self._decoded_events(found.get(EVENTS), offset)
        self.continued(found, offset)
        for topic, columns, messages in decoded:
            stamp = found[topic].stamps
            self._columns[topic] = columns
            columns.append(messages, stamp)
        self.events += events

    def missing(self, gaps: Mapping[str, int], offset: int) -> None:
        """Messages may be missing where chunks were left out, or were lost before a repair."""
        if self._order.gapless and not self._order.repaired:
            super().missing(gaps, offset)

    def _begun(self, topic: str, messages: Messages, offset: int) -> _Columns:
        """The columns of a topic, from its schema or from its first message."""
        assert self.header is not None
        try:
            layout = schema.message_layout(
                topic, self.header.joint_names, self.parser.known.schema(topic), messages.first()
            )
        except LayoutError as error:
            raise Damage(offset, f"(chunk) has messages of {topic}: {error}") from error
        return _Columns(layout, self._selection, min(self._order.samples, _MOST_ROOM))

    def _decoded_events(self, messages: Messages | None, offset: int) -> list[ArchivedEvent]:
        """The events of the time that is wanted."""
        if messages is None or not self._selection.events:
            return []
        try:
            events = [ArchivedEvent.decode(message) for message in messages.all()]
        except LayoutError as error:
            raise Damage(offset, f"(chunk) has an event that cannot be read: {error}") from error
        start, stop = self._selection.times
        return [event for event in events if start <= event.stamp < stop]

    def _check_end(self, size: int) -> None:
        """Compare what was read with what the writer says it wrote."""
        if self.header is None:
            return
        absent = sorted(set(self.header.attachments) - set(self.attachments))
        if absent:
            raise Damage(size, f"(attachment {absent[0]!r}) is missing")
        if self.outcome is None:
            raise Damage(size, f"(metadata {OUTCOME!r}) is missing")
        if not self._order.gapless:
            return
        counts = {}
        if numbers := self._selection.numbers(self.parser.known.topics):
            samples = "packets" if schema.PACKETS in numbers else "samples"
            counts[samples] = max(self.counts.get(topic, 0) for topic in numbers)
        if self._selection.events:
            counts["events"] = self.counts.get(EVENTS, 0)
        for key, count in counts.items():
            stated = getattr(self.outcome, key)
            if stated != count:
                raise Damage(size, f"is missing: {stated} {key} were written")


_UNREAD = frozenset((container.MESSAGE_INDEX,))
"""Records that only other programs need."""
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
    selection = Selection(fields, topics, start, stop)
    try:
        with opened(path) as stream:
            size = os.fstat(stream.fileno()).st_size
            summary, damage, content = Summary.read(stream, size), None, None
            order = Order.read(stream, size, summary)
            if selection.partial and summary is not None:
                content = _by_index(stream, selection, order, summary)
            if content is None:
                content, damage = _from_the_beginning(stream, size, selection, order)
    except OSError as error:
        remedy = _REMEDIES.get(error.errno or 0, "")
        raise ArchiveError(path, f"cannot be read: {error.strerror}", remedy=remedy) from error
    except MemoryError as error:
        raise ArchiveError(
            path, "does not fit into memory", remedy="read a part of its time, or fewer columns"
        ) from error
    header = _checked_header(path, size, content, damage)
    if damage is None:
        _check_topics(path, content, selection)
    columns = content.columns()
    stamp = columns["stamp"] if fields is None or fields else None
    return Archive(
        path=path,
        header=header,
        outcome=content.outcome,
        attachments=content.attachments,
        columns=columns,
        events=tuple(content.events),
        damage=None if damage is None else _damage(damage, size, content, stamp),
    )


def _from_the_beginning(
    stream: BinaryIO,
    size: int,
    selection: Selection,
    order: Order,
) -> tuple[_Content, Damage | None]:
    """What is selected of the whole chunks before the first damage, and that."""
    stream.seek(0)
    content = _Content(selection, order)
    damage = content.collect(container.records(stream, size, skip=_UNREAD), size)
    return content, damage


def _by_index(
    stream: BinaryIO, selection: Selection, order: Order, summary: Summary
) -> _Content | None:
    """What is selected, found through the summary; None where that or what it names is damaged."""
    content = _Content(selection, replace(order, gapless=False))
    try:
        for record in summary.definitions:
            content.parser.known.take(record)
        indexed, others = summary.chunks, summary.others
    except Damage:
        return None
    known = content.parser.known
    topics = {*selection.numbers(known.topics)}
    if selection.events:
        topics.add(EVENTS)
    if selection.topics is None:
        topics.update(NUMBERS)  # a chunk that has others than those wanted is to be seen, too
    wanted = {channel.id for channel in known.channels.values() if channel.topic in topics}
    start, stop = selection.times
    chunks = [chunk for chunk in indexed if chunk.message_index_offsets.keys() & wanted]
    within = [
        one for one in chunks if one.message_start_time < stop and one.message_end_time >= start
    ]
    # Where nothing falls into the range, one chunk still tells what columns there are.
    places = [(one.chunk_start_offset, one.chunk_length) for one in within or chunks[:1]]
    records = (container.record_at(stream, *place) for place in sorted([*others, *places]))
    damage = content.collect(records, 0)
    return content if damage is None and content.metadata is not None else None


def _check_topics(path: Path, content: _Content, selection: Selection) -> None:
    """Check that the archive has the channels wanted."""
    recorded = sorted(content.parser.known.topics)
    for topic in selection.topics or ():
        if recorded and topic not in recorded:
            raise ArchiveError(
                path, "has no such channel", field=topic, remedy=f"it has {', '.join(recorded)}"
            )


def _checked_header(
    path: Path, size: int, content: _Content, damage: Damage | None
) -> ArchiveHeader:
    """The header, whose version we know."""
    if content.header is not None:
        return content.header
    if content.unusable is not None:
        field, problem = next(iter(content.unusable.problems.items()))
        remedy = f"what wrote this archive does not keep the profile: its record {METADATA!r} "
        raise ArchiveError(path, problem, field=field, remedy=f"{remedy}must be mended there")
    if content.metadata is not None:
        version = content.metadata.get("format_version")
        raise ArchiveVersionError(
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
    raise NotAnArchiveError(path, problem, remedy=remedy)


def _damage(
    damage: Damage, size: int, content: _Content, stamp: NDArray[np.int64] | None
) -> ArchiveDamage:
    return ArchiveDamage(
        offset=damage.offset,
        reason=damage.reason,
        bytes_dropped=size - damage.offset,
        samples=None if stamp is None else len(stamp),
        duration=0.0 if stamp is None or not len(stamp) else 1e-9 * float(stamp[-1] - stamp[0]),
        outcome_missing=content.outcome is None,
    )
