"""Verified content of an archive: of a truncated or damaged one all that is whole.

Each record is verified by its length and checksum. Where the length of one does not lead to the
next, those behind it are found by the index in the summary, if the file has one. Messages are
numbered, and cycles must increase.
"""

from __future__ import annotations

import os
from bisect import bisect_left
from collections.abc import Callable, Collection, Iterator, Mapping
from functools import cached_property
from typing import Any, BinaryIO, Final

import numpy as np
from mcap.records import Channel, Metadata, Schema
from numpy.typing import NDArray

from hil.archive import schema, verified_records
from hil.archive.cdr import LayoutError, MessageLayout, Rows
from hil.archive.chunk_messages import ChunkMessages, ChunkParser, Content
from hil.archive.header import (
    METADATA,
    OUTCOME,
    SEQUENCE_MODULUS,
    ArchiveHeader,
    ArchiveOutcome,
    HeaderError,
    checksum,
    is_supported,
)
from hil.archive.schema import ArchivedEvent
from hil.archive.verified_records import Damage, Head, Record

NUMERIC_TOPICS = (
    *(schema.CYCLE, schema.MEASURED, schema.COMMANDED),
    *schema.STATE_TOPICS,
    *schema.OTHERS.values(),
)
"""Channels with one message per sample."""
ALL_TIMES: Final = -(1 << 63), 1 << 63  # ns, before and after every stamp
_BATCH_BYTES: Final = 1 << 20  # bytes of chunks decoded at once: few calls, and all in the cache
_MAX_DAMAGES = 1000  # of one file; what follows is not read
_MIN_BYTES_PER_SAMPLE = 8  # bytes of a file for one sample, of an arm at rest
_COLUMN_OF: Final = {"effort": "torque"}  # names of message fields that differ from the column's
_DEFINITION_OPCODES = (verified_records.SCHEMA, verified_records.CHANNEL)
_CONTENT_OPCODES = frozenset(
    {
        verified_records.HEADER,
        verified_records.CHUNK,
        verified_records.ATTACHMENT,
        verified_records.METADATA,
        *_DEFINITION_OPCODES,
    }
)


class Scan:
    """The verified content of an archive.

    Args:
        fields: columns wanted, None for all.
        times: range of the stamps wanted [ns]; chunks outside, by the index, are not read.
        all_channels: whether to verify also the channels that only viewers read.

    Attributes:
        heads: of the records with content that were not left out.
        metadata, header: the ``hil`` record as read, and parsed: None where invalid
            (`header_error`) or of another version.
        outcome: the ``hil.outcome`` record, None if it is lost or of another recording.
        mixed: whether begin and end are of two recordings; the samples may be of either.
        events: within the times wanted.
        counts: verified messages by topic.
        chunks: number of valid chunks.
        damages: what is wrong, by the place of the record.
        shortfalls: a sentence for what the file states to contain and does not.
        lost: whether content is missing.
    """

    def __init__(
        self,
        stream: BinaryIO,
        *,
        fields: Collection[str] | None = (),
        times: tuple[int, int] = ALL_TIMES,
        all_channels: bool = False,
    ) -> None:
        self.size = os.fstat(stream.fileno()).st_size
        self.heads: list[Head] = []
        self.metadata: dict[str, str] | None = None
        self.header: ArchiveHeader | None = None
        self.header_error: HeaderError | None = None
        self.outcome: ArchiveOutcome | None = None
        self.mixed = False
        self.attachments: dict[str, bytes] = {}
        self.events: list[ArchivedEvent] = []
        self.parser = ChunkParser()
        self.counts: dict[str, int] = {}
        self.chunks = 0
        self.damages: dict[int, str] = {}
        self.shortfalls: list[str] = []
        self.lost = False
        self._stream = stream
        self._data_end: int | None = None  # None where a length does not lead to it
        self._fields = fields
        self._times = times
        self._all_channels = all_channels
        self._left_out: set[int] = set()
        self._gap = False  # whether something was left out behind the last chunk
        self._skipped = False  # whether chunks were left out: channels continue at any number
        self._buffer = memoryview(bytearray(_BATCH_BYTES))
        self._pending: list[tuple[int, slice]] = []  # offset of each chunk, its place in the buffer
        self._next: dict[str, int] = {}
        self._numbers: set[str] = set()
        self._newest = -1  # stamp of a cycle [ns]
        self._layouts: dict[str, MessageLayout] = {}
        self._raw: dict[tuple[str, str], Rows] = {}  # columns as bytes, which are copied faster
        self._stamps = np.zeros(0, np.int64)
        self._count = 0
        self._find_heads()
        for head in self.heads:
            if head.opcode == verified_records.METADATA:
                self._try(self._add_metadata, head)
        stated = self.outcome or ArchiveOutcome()
        self._repaired = stated.repaired
        expected = min(stated.samples or 0, self.size // _MIN_BYTES_PER_SAMPLE)
        self._room = expected if times == ALL_TIMES and fields != () else 0
        self._read()

    @property
    def topics(self) -> Collection[str]:
        """The channels of the samples and the events."""
        recorded = schema.CYCLE in self.parser.topics
        cycles = (schema.CYCLE, *schema.STATE_TOPICS)
        samples = cycles if recorded else (schema.MEASURED, *schema.OTHERS.values())
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
    def samples(self) -> int:
        """Number of valid samples."""
        return max(self.counts.get(topic, 0) for topic in NUMERIC_TOPICS)

    @property
    def faults(self) -> list[str]:
        """What is wrong, a sentence each: damages in the order of the file, then shortfalls."""
        sentences = []
        used = [*(head.offset for head in self.heads), self.size]
        for offset, reason in sorted(self.damages.items()):
            end = used[bisect_left(used, offset)]
            left_out = f" (bytes {offset} to {end} are skipped)" if end > offset else ""
            sentences.append(f"the record at byte {offset} {reason}{left_out}")
        return [*sentences, *self.shortfalls]

    @cached_property
    def definitions(self) -> list[Schema | Channel]:
        """Schemas and channels of the summary, for chunks that follow a lost one."""
        start = self._data_end
        return verified_records.read_summary(
            self._stream, self.size, *_DEFINITION_OPCODES, start=start
        )

    def _find_shortfalls(self) -> Iterator[str]:
        """Yield a sentence for what the file states to contain and does not."""
        for name in self.header.attachments if self.header else ():
            if name not in self.attachments:
                yield f"attachment {name!r} is missing"
        outcome = self.outcome
        if outcome is None:
            yield "the outcome is missing"
            return
        totals = {
            "samples": (outcome.samples, self.samples),
            "events": (outcome.events, self.counts.get(schema.EVENTS, 0)),
        }
        for key, (stated, count) in totals.items():
            if stated != count:
                yield f"{stated} {key} were written, {count} are there"

    def _find_heads(self) -> None:
        """Find the records with content, behind damage by the index of the summary."""
        stream = self._stream
        heads = self.heads
        try:
            heads += verified_records.heads(stream, self.size, _CONTENT_OPCODES)
            self._data_end = heads.pop().end
            verified_records.check_end(stream, self.size, self._data_end)
            return
        except Damage as damage:
            lost = damage
        if self._data_end is not None:
            self.damages[lost.offset] = lost.reason
            return
        while heads:  # lengths are right up to the last record that is whole
            try:
                verify(verified_records.read_record(stream, heads[-1]))
                break
            except Damage as damage:
                lost = damage
                heads.pop()
        self.damages[lost.offset] = lost.reason
        begin = heads[-1].end if heads else len(verified_records.MAGIC)
        heads += (
            head for head in verified_records.indexed(stream, self.size) if head.offset >= begin
        )

    def _add_metadata(self, record: Record) -> None:
        """Add header or outcome: one each, of this version and of the same recording."""
        offset = record.offset
        name, entries = verified_metadata(record)
        if name == METADATA and self.metadata is None:
            self.metadata = entries
            if not is_supported(entries):
                raise Damage(offset, "is of another version")
            try:
                self.header = ArchiveHeader.of(entries)
            except HeaderError as error:
                self.header_error = error
                problem = f"(metadata {METADATA!r}) cannot be used: {error}"
                raise Damage(offset, problem) from error
        elif name == OUTCOME and self.outcome is None:
            outcome = ArchiveOutcome.of(entries)
            self.mixed = not outcome.belongs_to(self.header)
            if self.mixed:
                raise Damage(offset, "(metadata 'hil.outcome') belongs to another recording")
            self.outcome = outcome
        elif name in (METADATA, OUTCOME):
            raise Damage(offset, f"(metadata {name!r}) occurs twice")

    def _read(self) -> None:
        """Read the wanted records in order."""
        outside, inside = _chunks_by_time(self._stream, self.size, self._times)
        if inside - {head.offset for head in self.heads}:
            self.shortfalls = ["a chunk is missing"]
        for index, head in enumerate(self.heads):
            if head.opcode == verified_records.CHUNK and head.offset in outside:
                self._flush()
                self._skipped = True
                self._next.clear()
                continue
            self._try(self._add, head)
            if len(self.damages) >= _MAX_DAMAGES:
                del self.heads[index + 1 :]
                break
        self._flush()
        self.heads = [head for head in self.heads if head.offset not in self._left_out]
        if not outside and self.header is not None:  # else some other MCAP file
            self.shortfalls = [*self._find_shortfalls()]
        self.lost |= bool(self.shortfalls)

    def _try(self, add: Callable[[Record], None], head: Head) -> None:
        """Add a record, or leave it out if it is damaged."""
        try:
            add(verified_records.read_record(self._stream, head))
        except Damage as damage:
            self._flush()  # pending chunks precede it
            self._leave_out(damage)

    def _leave_out(self, damage: Damage) -> None:
        """Leave out the record at the place of the damage."""
        self.damages.setdefault(damage.offset, damage.reason)
        self._left_out.add(damage.offset)
        self._gap = True

    def _note_gap(self, offset: int) -> None:
        """Note that a chunk is missing in front of that at `offset`, unless damage explains it."""
        if not self._gap:
            reason = "(chunk) does not continue the previous chunk: a chunk is missing"
            self.damages.setdefault(offset, reason)
        self.lost = True

    def _add(self, record: Record) -> None:
        """Verify the next record, and add its content; `Damage` if it is not the next one."""
        offset = record.offset
        if record.opcode == verified_records.CHUNK:
            if self.header is None or self.mixed:
                return  # some other MCAP file, or of either of two recordings
            head = verified_records.parse_chunk(record)
            data = verified_records.chunk_data(head, offset)
            self._add_chunk(data, offset)
        elif record.opcode == verified_records.ATTACHMENT:
            attachment = verified_records.parse_attachment(record)
            if attachment.name in self.attachments:
                raise Damage(offset, f"(attachment {attachment.name!r}) occurs twice")
            self.attachments[attachment.name] = attachment.data
        elif record.opcode in _DEFINITION_OPCODES:
            self.parser.define(record)

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
        pending = self._pending
        self._pending = []
        if len(pending) > 1:
            try:
                self._decode(self._buffer[: pending[-1][1].stop], pending[0][0], several=True)
                self.chunks += len(pending)
                return
            except Damage:
                pass  # in one of them
        for offset, place in pending:
            try:
                self._decode(self._buffer[place], offset)
                self.chunks += 1
            except Damage as damage:
                self._leave_out(damage)

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
                    parser.add(definition, offset)
            if unknown := by_number.keys() - parser.channels.keys():
                raise Damage(offset, f"(chunk) has messages of an unknown channel {min(unknown)}")
            by_topic = {
                parser.channels[number].topic: channel_messages
                for number, channel_messages in by_number.items()
            }
            read = [topic for topic in self.topics if topic in by_topic]
            numbers = by_topic.keys() & set(NUMERIC_TOPICS)
            new = self._numbers not in (set(), numbers) or numbers.isdisjoint(read)
            if numbers and new:
                raise Damage(
                    offset, "(chunk) has samples in other channels than the previous chunks"
                )
            verified = (
                by_topic if self._all_channels else {topic: by_topic[topic] for topic in read}
            )
            missing = self._missing_messages(verified, offset)
            newest = self._check_times(verified, offset)
            layouts = self._check_layouts(verified, offset)
            events = self._decode_events(verified, offset)
        except Damage:
            parser.schemas, parser.channels = before
            raise
        if missing and not self._repaired:
            self._note_gap(offset)
        self._gap = False
        self._newest = max(self._newest, newest)
        self._numbers = self._numbers or numbers
        for topic, messages in verified.items():
            self._next[topic] = int(messages.of_heads("sequence")[-1]) + 1
            self.counts[topic] = self.counts.get(topic, 0) + len(messages)
        self._layouts |= layouts
        self.events += [event for event in events if self._times[0] <= event.stamp < self._times[1]]
        self._append({topic: by_topic[topic] for topic in read if topic != schema.EVENTS})

    def _check_layouts(
        self, by_topic: Mapping[str, ChunkMessages], offset: int
    ) -> dict[str, MessageLayout]:
        """Return the layouts of messages of numbers; `Damage` if messages of one differ."""
        assert self.header is not None
        layouts = {}
        for topic in by_topic.keys() & set(NUMERIC_TOPICS):
            messages = by_topic[topic]
            layout = self._layouts.get(topic)
            if layout is None:
                record = self.parser.schema(topic)
                first = bytes(messages.data[0][0])
                try:
                    layout = schema.message_layout(topic, self.header.joint_names, record, first)
                except LayoutError as error:
                    raise Damage(offset, f"(chunk) has messages of {topic}: {error}") from error
            if not all(map(layout.matches, messages.data)):
                raise Damage(offset, "(chunk) has messages that differ from the previous ones")
            layouts[topic] = layout
        return layouts

    @staticmethod
    def _decode_events(by_topic: Mapping[str, ChunkMessages], offset: int) -> list[ArchivedEvent]:
        if schema.EVENTS not in by_topic:
            return []
        try:
            return [ArchivedEvent.decode(message) for message in by_topic[schema.EVENTS].all()]
        except LayoutError as error:
            problem = f"(chunk) has an event that cannot be read: {error}"
            raise Damage(offset, problem) from error

    def _append(self, by_topic: Mapping[str, ChunkMessages]) -> None:
        """Copy verified messages of the wanted channels and times into the columns."""
        if not by_topic:
            return
        stamps = next(iter(by_topic.values())).stamps
        chosen = None
        if self._times != ALL_TIMES:
            chosen = (stamps >= self._times[0]) & (stamps < self._times[1])
            stamps = stamps[chosen]
        begin = self._count
        self._count = self._count + len(stamps)
        capacity = max(self._room, len(self._stamps))
        if self._count > capacity:
            capacity = 2 * self._count
        if capacity > len(self._stamps):
            self._stamps = np.resize(self._stamps, capacity)
            self._raw = {key: np.resize(raw, capacity) for key, raw in self._raw.items()}
        self._stamps[begin : self._count] = stamps
        for topic, messages in by_topic.items():
            fields: Mapping[str, Any] = self._layouts[topic].dtype.fields or {}
            columns = []
            for name, (dtype, start, *_) in fields.items():
                wanted = self._fields is None or _COLUMN_OF.get(name, name) in self._fields
                if wanted and name not in ("sec", "nanosec"):
                    if (topic, name) not in self._raw:
                        self._raw[topic, name] = np.empty(capacity, f"V{dtype.itemsize}")
                    columns.append((self._raw[topic, name], start))
            first = 0
            at = begin
            for data in messages.data:
                part = slice(first, first + len(data))
                first = part.stop
                rows = data if chosen is None else data[chosen[part]]
                added = slice(at, at + len(rows))
                at = added.stop
                for raw, start in columns:
                    raw[added] = rows[:, start : start + raw.itemsize].view(raw.dtype)[:, 0]

    def _missing_messages(
        self, by_topic: Mapping[str, ChunkMessages], offset: int
    ) -> dict[str, int]:
        """Return how many messages of topics are missing before these; `Damage` if some repeat."""
        missing = {}
        for topic, messages in by_topic.items():
            sequence = messages.of_heads("sequence")
            if (np.diff(sequence) != 1).any():
                raise Damage(offset, "(chunk) has messages out of order")
            first = int(sequence[0])
            gap = first - self._next.get(topic, first if self._skipped else 0)
            gap %= SEQUENCE_MODULUS
            if gap > SEQUENCE_MODULUS // 2:
                raise Damage(offset, "(chunk) repeats messages of previous chunks")
            if gap:
                missing[topic] = gap
        return missing

    def _check_times(self, by_topic: Mapping[str, ChunkMessages], offset: int) -> int:
        """Check that cycles increase, and that all channels have the same times without cycles.

        Returns:
            The newest stamp [ns], -1 without cycles.
        """
        samples = [topic for topic in by_topic if topic in NUMERIC_TOPICS]
        # Channels for viewers are not read, and need no check.
        cycles = (schema.CYCLE, *schema.STATE_TOPICS)
        timed = [t for t in cycles if t in samples] if schema.CYCLE in samples else samples
        if not timed:
            return -1
        stamps = [by_topic[topic].stamps for topic in timed]
        stamp = stamps[0]
        if not all(map(len, stamps)):
            raise Damage(offset, "(chunk) has messages without a stamp")
        if not all(np.array_equal(other_stamp, stamp) for other_stamp in stamps):
            raise Damage(offset, "(chunk) has channels of different times")
        if timed[0] != schema.CYCLE:
            return -1
        if (np.diff(stamp) <= 0).any():
            raise Damage(offset, "(chunk) has cycles that do not increase")
        if stamp[0] <= self._newest:
            raise Damage(offset, "(chunk) has cycles that do not follow the previous ones")
        return int(stamp[-1])


def verified_metadata(record: Record) -> tuple[str, dict[str, str]]:
    """Return name and entries, without the checksum that they must have if they are ours."""
    metadata = verified_records.parse(Metadata, record)
    entries = metadata.metadata
    is_ours = metadata.name in (METADATA, OUTCOME)
    if is_ours and entries.pop("checksum", None) != checksum(entries):
        raise Damage(record.offset, f"(metadata {metadata.name!r}) fails its checksum")
    return metadata.name, entries


def verify(record: Record) -> None:
    """Raise `Damage` if a record with content fails its checksum, or cannot be parsed."""
    if record.opcode == verified_records.CHUNK:
        verified_records.chunk_data(verified_records.parse_chunk(record), record.offset)
    elif record.opcode == verified_records.METADATA:
        verified_metadata(record)
    else:
        verified_records.parse_item(record)


def _chunks_by_time(
    stream: BinaryIO, size: int, times: tuple[int, int]
) -> tuple[set[int], set[int]]:
    """Return the places of chunks without and with messages of these times, by the index.

    The first is read anyway: it defines the channels. Both are empty where all times are wanted.
    """
    if times == ALL_TIMES:
        return set(), set()
    chunks = verified_records.read_summary(stream, size, verified_records.CHUNK_INDEX)
    first = min((chunk.chunk_start_offset for chunk in chunks), default=0)
    outside = {
        chunk.chunk_start_offset
        for chunk in chunks
        if chunk.chunk_start_offset != first
        and not (chunk.message_start_time < times[1] and chunk.message_end_time >= times[0])
    }
    return outside, {chunk.chunk_start_offset for chunk in chunks} - outside
