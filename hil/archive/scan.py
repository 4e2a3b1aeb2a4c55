"""Verification of an archive, record by record: the one judge of what is whole in a file.

A reader stops at the first damage, checks and repairs continue behind it. The checksum of a chunk
does not show that it belongs to this recording: a file system may put a chunk of another archive in
its place. The outcome therefore lists the checksums of all chunks in order; where this list is
missing, cycle numbers must increase.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import suppress
from typing import Any, BinaryIO, Final

import numpy as np
from mcap.records import Header
from numpy.typing import NDArray

from hil.archive import container, schema
from hil.archive.cdr import LayoutError, MessageLayout, Rows
from hil.archive.chunk import ChunkParser, Content, Messages
from hil.archive.container import Damage, Record, Summary
from hil.archive.events import ArchivedEvent
from hil.archive.header import (
    METADATA,
    OUTCOME,
    ArchiveHeader,
    ArchiveOutcome,
    HeaderError,
    checksum,
    is_supported,
)

NUMBERS = (schema.CYCLE, schema.MEASURED, schema.COMMANDED, schema.MOTOR_CURRENT)
"""Channels with one message per sample."""
ALWAYS: Final = -(1 << 63), 1 << 63  # ns, before and after every stamp

_BATCH: Final = 1 << 20  # bytes of chunks decoded at once: few calls, and all in the cache
_SEQUENCES = 1 << 32  # message numbers are modulo this
_LEAST = 8  # bytes of a file for one sample, of an arm at rest
_COLUMN_OF: Final = {"effort": "torque"}  # names of message fields that differ from the column's


class Scan:
    """The verified content of an archive.

    Args:
        fields: columns wanted, None for all.
        times: range of the stamps wanted [ns]; chunks outside, by the index, are not read.
        past_damage: whether to continue behind damage, listed in `faults`, or to stop at the first,
            `damage`.

    Attributes:
        metadata, header: the ``hil`` record as read, and parsed: None where invalid
            (`header_error`) or of another version.
        outcome: the ``hil.outcome`` record, None until it was read.
        events: those of the times wanted.
        definitions: schema and channel records of the summary.
        counts: messages by topic.
        chunks: number of valid chunks.
        pieces: opcode, offset and length of the valid records except header and outcome.
        faults: what is wrong, a sentence each, except message indexes and summary.
    """

    def __init__(
        self,
        stream: BinaryIO,
        *,
        fields: Collection[str] | None = (),
        times: tuple[int, int] = ALWAYS,
        past_damage: bool = False,
    ) -> None:
        self.size = os.fstat(stream.fileno()).st_size
        self.metadata: dict[str, str] | None = None
        self.header: ArchiveHeader | None = None
        self.header_error: HeaderError | None = None
        self.outcome: ArchiveOutcome | None = None
        self.attachments: dict[str, bytes] = {}
        self.events: list[ArchivedEvent] = []
        self.parser = ChunkParser()
        self.counts: dict[str, int] = {}
        self.chunks = 0
        self.pieces: list[tuple[int, int, int]] = []
        self.damage: Damage | None = None
        self.faults: list[str] = []
        self._fields, self._times = fields, times
        self._past_damage = past_damage
        self._lost = False
        self._gap = False  # whether something was lost behind the last valid chunk
        self._skipped = False  # whether chunks were left out: channels continue at any number
        self._buffer = memoryview(bytearray(0 if past_damage else _BATCH))
        self._pending: list[tuple[int, slice]] = []  # offset of each chunk, its place in the buffer
        self._place = 0  # of the next chunk in the list of checksums
        self._next: dict[str, int] = {}
        self._numbers: set[str] = set()
        self._newest = -1  # stamp of a cycle [ns]
        self._layouts: dict[str, MessageLayout] = {}
        self._raw: dict[tuple[str, str], Rows] = {}  # columns as bytes, which are copied faster
        self._stamps = np.zeros(0, np.int64)
        self._count = 0
        start = _data_end(stream, self.size) if past_damage else None
        summary = Summary.read(stream, self.size, start=start)
        self._written_by = _written_by(stream, self.size)
        stated, self._mixed_ends = _stated_outcome(stream, self.size, summary)
        self._repaired = stated.repaired
        self._chunk_list: NDArray[np.uint32] | None = None
        # Another program that copies a file may divide it into other chunks, and writes its name.
        if self._written_by[1] == schema.LIBRARY and stated.chunks is not None:
            self._chunk_list = np.array(stated.chunks, np.uint32)
        expected = min(stated.samples or 0, self.size // _LEAST)
        self._room = expected if times == ALWAYS and fields != () else 0
        self.definitions = summary.definitions if summary else []
        stream.seek(0)
        if past_damage:
            self._read_all(stream, summary)
        else:
            self._read(stream, _chunks_outside(summary, times))

    @property
    def topics(self) -> Collection[str]:
        """The channels of the samples and the events; others are verified with `past_damage`."""
        recorded = schema.CYCLE in self.parser.topics
        samples = (schema.CYCLE,) if recorded else (schema.MEASURED, schema.MOTOR_CURRENT)
        return (*samples, schema.EVENTS)

    @property
    def columns(self) -> dict[str, NDArray[Any]]:
        """The columns wanted and ``stamp``, contiguous and read-only, all of the same length."""
        columns: dict[str, NDArray[Any]] = {"stamp": self._stamps[: self._count]}
        for (topic, name), raw in self._raw.items():
            dtype = self._layouts[topic].dtype[name]
            base, shape = dtype.subdtype or (dtype, ())
            columns[_COLUMN_OF.get(name, name)] = raw[: self._count].view(base).reshape(-1, *shape)
        for column in columns.values():
            column.flags.writeable = False
        return columns

    @property
    def mixed(self) -> bool:
        """Whether begin and end are of two recordings; the samples may be of either."""
        return self.outcome is not None and not self.outcome.belongs_to(self.header)

    @property
    def samples(self) -> int:
        """Number of valid samples."""
        return max(self.counts.get(topic, 0) for topic in NUMBERS)

    @property
    def losses(self) -> list[str]:
        """What is lost, and where; empty if all that was written is there."""
        return self.faults if self._lost else []

    @property
    def samples_lost(self) -> int | None:
        """Number of lost samples, None where unknown."""
        if not self._lost:
            return 0
        stated = self.outcome.samples if self.outcome else None
        return None if stated is None else max(0, stated - self.samples)

    def _read(self, stream: BinaryIO, outside: Collection[int]) -> None:
        """Read records up to their end or the first damage."""
        try:
            try:
                for record in container.records(stream, self.size, skip=outside):
                    if record.offset in outside:
                        self._flush()
                        self._place, self._skipped = self._place + 1, True
                        self._next.clear()
                        continue
                    self._add(record)
                    if record.opcode == container.METADATA:
                        self._check_metadata(record.offset)
            finally:
                self._flush()  # pending chunks precede any damage found so far
            chunks = self._chunk_list
            if outside and chunks is not None and self._place < len(chunks):
                raise Damage(self.size, "is not there: a chunk is missing")
            if not outside and self.header is not None:
                for text in self._shortfalls():
                    raise Damage(self.size, f"is not there: {text}")
        except Damage as damage:
            self.damage = damage

    def _check_metadata(self, offset: int) -> None:
        """Require a header of this version and an outcome of the same recording."""
        if self.metadata is not None and not is_supported(self.metadata):
            raise Damage(offset, "is of another version")
        if self.header_error is not None:
            raise Damage(offset, f"(metadata {METADATA!r}) cannot be used: {self.header_error}")
        if self.mixed:
            self.outcome = None
            raise Damage(offset, "(metadata 'hil.outcome') is that of another recording")

    def _read_all(self, stream: BinaryIO, summary: Summary | None) -> None:
        """Read all valid records, also those that only the index leads to."""
        seen: set[int] = set()
        try:
            for record in container.records(stream, self.size, check_end=False):
                seen.add(record.offset)
                self._try_add(record)
        except Damage as damage:
            self._gap = True  # counts and outcome show what is lost
            self._add_fault(damage, loss=False)
        for place in summary.places if summary else ():
            if place[0] not in seen:
                seen.add(place[0])
                try:
                    self._try_add(container.record_at(stream, *place))
                except Damage as damage:
                    self._add_fault(damage)
        if self.metadata is not None:
            if self._written_by != (schema.PROFILE, schema.LIBRARY):
                self._add_fault("the header is not that of the profile", loss=False)
            if self.mixed:
                self._add_fault("the outcome is that of another recording")
            for text in self._shortfalls():
                self._add_fault(text)

    def _try_add(self, record: Record) -> None:
        try:
            self._add(record)
        except Damage as damage:
            self._add_fault(damage)

    def _add_fault(self, problem: Damage | str, *, loss: bool = True) -> None:
        """Add a fault, which does not lose content unless `loss`."""
        self._gap |= loss
        self._lost |= loss
        if isinstance(problem, Damage):
            problem = f"the record at byte {problem.offset} {problem.reason}"
        if problem not in self.faults:
            self.faults.append(problem)

    def _add(self, record: Record) -> None:
        """Verify the next record, and add its content; `Damage` if it is not the next one."""
        offset = record.offset
        if record.opcode == container.CHUNK:
            if self.metadata is None:
                return  # some other MCAP file
            head = container.parse_chunk(record)
            data = container.chunk_data(head, offset)
            self._check_order(head.uncompressed_crc, offset)
            self._add_chunk(data, offset)
        elif record.opcode == container.ATTACHMENT:
            attachment = container.parse_attachment(record)
            if attachment.name in self.attachments:
                raise Damage(offset, f"(attachment {attachment.name!r}) is there a second time")
            self.attachments[attachment.name] = attachment.data
        elif record.opcode == container.METADATA:
            if self._add_metadata(record):
                return
        elif record.opcode in (container.SCHEMA, container.CHANNEL):
            self.parser.define(record)
        else:
            return
        if self.metadata is not None:
            self.pieces.append((record.opcode, offset, record.size))

    def _add_metadata(self, record: Record) -> bool:
        """Add header or outcome; return whether the record is one of them."""
        name, entries = container.parse_metadata(record)
        if name not in (METADATA, OUTCOME):
            return False
        if entries.pop("checksum", None) != checksum(entries):
            raise Damage(record.offset, f"(metadata {name!r}) fails its checksum")
        if (self.metadata if name == METADATA else self.outcome) is not None:
            raise Damage(record.offset, f"(metadata {name!r}) is there a second time")
        if name == OUTCOME:
            self.outcome = ArchiveOutcome.of(entries)
            return True
        self.metadata = entries
        try:
            self.header = ArchiveHeader.of(entries) if is_supported(entries) else None
        except HeaderError as error:
            self.header_error = error
        return True

    def _add_chunk(self, data: bytes, offset: int) -> None:
        """Decode the content of a chunk, or buffer it to decode several at once."""
        begin = self._pending[-1][1].stop if self._pending else 0
        if begin + len(data) >= len(self._buffer):
            self._flush()
            begin = 0
        if len(data) >= len(self._buffer):
            self._decode(data, offset)
            self.chunks += 1
        else:
            self._pending.append((offset, slice(begin, begin + len(data))))
            self._buffer[begin : begin + len(data)] = data
            if not self.parser.channels:  # they are in the first
                self._flush()

    def _flush(self) -> None:
        """Decode the buffered chunks: all at once, or one by one where that fails."""
        pending, self._pending = self._pending, []
        if len(pending) > 1:
            try:
                self._decode(self._buffer[: pending[-1][1].stop], pending[0][0], several=True)
                self.chunks += len(pending)
                return
            except Damage:
                pass  # in one of them
        for offset, place in pending:
            self._decode(self._buffer[place], offset)
            self.chunks += 1

    def _shortfalls(self) -> Iterator[str]:
        """Yield a sentence for what the file states to contain and does not."""
        for name in self.header.attachments if self.header else ():
            if name not in self.attachments:
                yield f"attachment {name!r} is missing"
        outcome = self.outcome
        if outcome is None:
            yield "the outcome is missing"
            return
        found = {
            "samples": (outcome.samples, self.samples),
            "events": (outcome.events, self.counts.get(schema.EVENTS, 0)),
        }
        if self._chunk_list is not None:
            found["chunks"] = len(self._chunk_list), self.chunks
        for key, (stated, count) in found.items():
            if stated != count:
                yield f"{stated} {key} were written, {count} are there"

    def _check_order(self, crc: int, offset: int) -> None:
        """Check that the chunk with this checksum is the next of those that were written."""
        if self._mixed_ends and not self._past_damage:
            reason = "(chunk) may be of either of two: the outcome is that of another recording"
            raise Damage(offset, reason)
        chunks = self._chunk_list
        if chunks is None:
            return
        if self._place < len(chunks) and chunks[self._place] == crc:
            self._place += 1
            return
        places = np.flatnonzero(chunks == crc)
        if not len(places) or places[-1] < self._place:
            why = "is out of order" if len(places) else "is of another recording"
            raise Damage(offset, f"(chunk) {why}, by the outcome's list of checksums")
        if not self._past_damage:
            raise Damage(offset, "(chunk) does not continue the one before")
        self._place = int(places[-1]) + 1

    def _decode(self, data: Content, offset: int, *, several: bool = False) -> None:
        """Add messages that must be the next of their channels; else none of them.

        Several chunks at once must not define channels.
        """
        parser = self.parser
        before = dict(parser.schemas), dict(parser.channels)
        try:
            by_number = parser.messages(data, offset)
            if several and parser.channels.keys() != before[1].keys():
                raise Damage(offset, "(chunk) defines a channel")
            if not by_number.keys() <= parser.channels.keys():
                for definition in self.definitions:
                    parser.define(definition)
            if unknown := by_number.keys() - parser.channels.keys():
                raise Damage(offset, f"(chunk) has messages of an unknown channel {min(unknown)}")
            found = {parser.channels[number].topic: one for number, one in by_number.items()}
            wanted = [topic for topic in self.topics if topic in found]
            numbers = found.keys() & set(NUMBERS)
            new = self._numbers not in (set(), numbers) or numbers.isdisjoint(wanted)
            if numbers and new:
                raise Damage(offset, "(chunk) has samples in other channels than those before")
            verified = found if self._past_damage else {topic: found[topic] for topic in wanted}
            missing = self._check_sequences(verified, offset)
            newest = self._check_times(verified, offset)
            if missing:
                self._check_gap(missing, offset)
            layouts = self._check_layouts(verified, offset)
            events = self._decode_events(verified, offset)
        except Damage:
            parser.schemas, parser.channels = before
            raise
        self._gap = False
        self._newest = max(self._newest, newest)
        self._numbers = self._numbers or numbers
        for topic, messages in verified.items():
            self._next[topic] = int(messages.of_heads("sequence")[-1]) + 1
            self.counts[topic] = self.counts.get(topic, 0) + len(messages)
        self._layouts |= layouts
        self.events += [one for one in events if self._times[0] <= one.stamp < self._times[1]]
        if self.header is not None:
            self._append({topic: found[topic] for topic in wanted if topic != schema.EVENTS})

    def _check_layouts(
        self, found: Mapping[str, Messages], offset: int
    ) -> dict[str, MessageLayout]:
        """Return the layouts of messages of numbers; `Damage` if messages of one differ."""
        layouts = {}
        for topic in found.keys() & set(NUMBERS) if self.header else ():
            messages, layout = found[topic], self._layouts.get(topic)
            if layout is None:
                assert self.header is not None
                record, first = self.parser.schema(topic), bytes(messages.data[0][0])
                try:
                    layout = schema.message_layout(topic, self.header.joint_names, record, first)
                except LayoutError as error:
                    raise Damage(offset, f"(chunk) has messages of {topic}: {error}") from error
            if not all(map(layout.matches, messages.data)):
                raise Damage(offset, "(chunk) has messages that differ from those before")
            layouts[topic] = layout
        return layouts

    @staticmethod
    def _decode_events(found: Mapping[str, Messages], offset: int) -> list[ArchivedEvent]:
        if schema.EVENTS not in found:
            return []
        try:
            return [ArchivedEvent.decode(message) for message in found[schema.EVENTS].all()]
        except LayoutError as error:
            problem = f"(chunk) has an event that cannot be read: {error}"
            raise Damage(offset, problem) from error

    def _append(self, found: Mapping[str, Messages]) -> None:
        """Copy verified messages of the wanted channels and times into the columns."""
        if not found:
            return
        stamps, chosen = next(iter(found.values())).stamps, None
        if self._times != ALWAYS:
            chosen = (stamps >= self._times[0]) & (stamps < self._times[1])
            stamps = stamps[chosen]
        begin, self._count = self._count, self._count + len(stamps)
        room = max(self._room, len(self._stamps))
        if self._count > room:
            room = 2 * self._count
        if room > len(self._stamps):
            self._stamps = np.resize(self._stamps, room)
            self._raw = {key: np.resize(raw, room) for key, raw in self._raw.items()}
        self._stamps[begin : self._count] = stamps
        for topic, messages in found.items():
            fields: Mapping[str, Any] = self._layouts[topic].dtype.fields or {}
            columns = []
            for name, (dtype, start, *_) in fields.items():
                wanted = self._fields is None or _COLUMN_OF.get(name, name) in self._fields
                if wanted and name not in ("sec", "nanosec"):
                    if (topic, name) not in self._raw:
                        self._raw[topic, name] = np.empty(room, f"V{dtype.itemsize}")
                    columns.append((self._raw[topic, name], start))
            first, at = 0, begin
            for data in messages.data:
                part = slice(first, first + len(data))
                first = part.stop
                rows = data if chosen is None else data[chosen[part]]
                now = slice(at, at + len(rows))
                at = now.stop
                for raw, start in columns:
                    raw[now] = rows[:, start : start + raw.itemsize].view(raw.dtype)[:, 0]

    def _check_sequences(self, found: Mapping[str, Messages], offset: int) -> list[str]:
        """Check that no message is repeated; return the topics of which some are missing."""
        gaps = {}
        for topic, messages in found.items():
            sequence = messages.of_heads("sequence")
            if (np.diff(sequence) != 1).any():
                raise Damage(offset, "(chunk) has messages out of order")
            first = int(sequence[0])
            gaps[topic] = first - self._next.get(topic, first if self._skipped else 0)
            gaps[topic] %= _SEQUENCES
            if gaps[topic] > _SEQUENCES // 2:
                raise Damage(offset, "(chunk) repeats messages of those before")
        if len({(len(found[topic]), gaps[topic]) for topic in found if topic in NUMBERS}) > 1:
            raise Damage(offset, "(chunk) has channels of different length")
        return [topic for topic, gap in gaps.items() if gap]

    def _check_gap(self, topics: Collection[str], offset: int) -> None:
        """Handle missing messages of these topics in front of the chunk at `offset`."""
        if not self._past_damage:
            if not self._repaired:
                reason = "(chunk) does not continue the one before it: a chunk is missing"
                raise Damage(offset, reason)
            return
        if schema.CYCLE not in self.parser.topics and not set(NUMBERS).isdisjoint(topics):
            raise Damage(offset, "(chunk) follows a gap that no cycle number would show")
        if not self._gap and not self._repaired:
            damage = Damage(offset, "(chunk) does not continue the one before")
            self._add_fault(damage)

    def _check_times(self, found: Mapping[str, Messages], offset: int) -> int:
        """Check that cycles increase, and that all channels have the same times without cycles.

        Returns:
            The newest stamp [ns], -1 without cycles.
        """
        samples = [topic for topic in found if topic in NUMBERS]
        timed = [schema.CYCLE] if schema.CYCLE in samples else samples
        if not timed:
            return -1
        stamps = [found[topic].stamps for topic in timed]
        stamp = stamps[0]
        if not all(map(len, stamps)):
            raise Damage(offset, "(chunk) has messages without a stamp")
        if not all(np.array_equal(one, stamp) for one in stamps):
            raise Damage(offset, "(chunk) has channels of different times")
        if timed[0] not in schema.PER_CYCLE or schema.CYCLE not in self.parser.topics:
            return -1
        if (np.diff(stamp) <= 0).any():
            raise Damage(offset, "(chunk) has cycles that do not increase")
        if stamp[0] <= self._newest:
            raise Damage(offset, "(chunk) has cycles that do not follow those before")
        return int(stamp[-1])


def _written_by(stream: BinaryIO, size: int) -> tuple[str, str]:
    """Return profile and library of a file, empty where its first record is damaged."""
    stream.seek(0)
    with suppress(Damage):
        record = next(container.records(stream, size, check_end=False))
        if record.opcode == container.HEADER:
            head = container.parse(Header, record)
            return head.profile, head.library
    return "", ""


def _stated_outcome(
    stream: BinaryIO, size: int, summary: Summary | None
) -> tuple[ArchiveOutcome, bool]:
    """Return the outcome, found by the summary or from head to head; empty if it is damaged.

    And whether it is of another recording than the header; then it is empty as well.
    """
    found: dict[str, dict[str, str]] = {}

    def add(records: Iterable[Record]) -> None:
        with suppress(Damage):
            for record in records:
                name, entries = container.parse_metadata(record)
                claimed = entries.pop("checksum", None)
                if name in (METADATA, OUTCOME) and claimed == checksum(entries):
                    found.setdefault(name, entries)

    if summary is not None:
        places = summary.entries(container.METADATA_INDEX)
        add(container.record_at(stream, one.offset, one.length) for one in places)
    if found.keys() != {METADATA, OUTCOME}:
        found.clear()
        stream.seek(0)
        add(container.records(stream, size, only=(container.METADATA,), check_end=False))
    try:
        header, outcome = ArchiveHeader.of(found[METADATA]), ArchiveOutcome.of(found[OUTCOME])
    except (HeaderError, KeyError):
        return ArchiveOutcome(), False
    mixed = not outcome.belongs_to(header)
    return (ArchiveOutcome() if mixed else outcome), mixed


def _data_end(stream: BinaryIO, size: int) -> int | None:
    """Return where the data section ends, from head to head: records may have moved."""
    walk = container.records(stream, size, only=(container.DATA_END,), check_end=False)
    try:
        return next(walk).end
    except Damage:
        return None


def _chunks_outside(summary: Summary | None, times: tuple[int, int]) -> Collection[int]:
    """Return the places of chunks without messages of these times, by the index.

    If all are outside, the first is read anyway: it defines the columns.
    """
    if summary is None or times == ALWAYS:
        return ()
    chunks = summary.entries(container.CHUNK_INDEX)
    start, stop = times
    within = {
        one.chunk_start_offset
        for one in chunks
        if one.message_start_time < stop and one.message_end_time >= start
    }
    known = {one.chunk_start_offset for one in chunks}
    return known - (within or {min(known, default=0)})
