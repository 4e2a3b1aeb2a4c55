"""Goes through an archive record by record, and verifies that each is one that was written.

The reader stops at the first damage (`hil.archive.reader`), checks and repairs go on behind it
(`hil.archive.repair`).

The checksum of a chunk says that it is whole, not that it is of this recording: a file system may
put a chunk of another archive in its place. The outcome has the checksums of all chunks in order,
so that each is known by its own. Archives of earlier versions have no such list, torn ones no
outcome: there the cycles must do, which grow from the first to the last that the outcome names.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import BinaryIO

import numpy as np
from mcap.records import Header
from numpy.typing import NDArray

from hil.archive import container, schema
from hil.archive.chunk import ChunkParser, Content, Messages
from hil.archive.container import Damage, Record, Summary
from hil.archive.header import (
    METADATA,
    OUTCOME,
    ArchiveHeader,
    ArchiveOutcome,
    HeaderError,
    checksum,
    is_known,
)

NUMBERS = (schema.CYCLE, schema.MEASURED, schema.COMMANDED, schema.MOTOR_CURRENT)
"""Channels that have one message of each sample."""

_SEQUENCES = 1 << 32  # message numbers are modulo this
_LEAST = 8  # bytes of a file for one sample, of an arm at rest


@dataclass(frozen=True, eq=False)
class Expected:
    """What a file must hold, as its end says.

    Attributes:
        chunks: their checksums in order, shape (k,); None where nothing says so.
        ends: stamps of the first and the last cycle [ns].
        mixed: whether that end is of another recording than the beginning.
        repaired: whether messages were lost before the file was written as it is.
        samples: how many were written, but no more than fit into the file.
    """

    chunks: NDArray[np.uint32] | None = None
    ends: tuple[int, int] | None = None
    mixed: bool = False
    repaired: bool = False
    samples: int = 0

    @classmethod
    def read(cls, stream: BinaryIO, size: int, summary: Summary | None) -> Expected:
        """Find it, where the summary says or from head to head; the stream is left anywhere."""
        found = {}
        if summary is not None:
            entries = summary.entries(container.METADATA_INDEX)
            found = _ours(container.record_at(stream, one.offset, one.length) for one in entries)
        if found.keys() != {METADATA, OUTCOME}:
            stream.seek(0)
            only = (container.METADATA,)
            found = _ours(container.records(stream, size, only=only, check_end=False))
        try:
            header, outcome = ArchiveHeader.of(found[METADATA]), ArchiveOutcome.of(found[OUTCOME])
        except (HeaderError, KeyError):
            return cls()
        if not outcome.belongs_to(header):
            return cls(mixed=True)
        # Another program that copies a file may cut its chunks anew, and then names itself.
        has_list = outcome.chunks is not None and _library(stream, size) == schema.LIBRARY
        chunks = np.array(outcome.chunks, np.uint32) if has_list else None
        first, last, ends = outcome.first_cycle, outcome.last_cycle, None
        # What was repaired may lack either end; earlier versions took two sessions.
        step = (header.period or 0.0) * 1e9
        if step and first is not None and last is not None and not outcome.repaired:
            ends = (round(first * step), round(last * step)) if first <= last else None
        samples = min(outcome.samples or 0, size // _LEAST)
        return cls(chunks, ends, repaired=outcome.repaired, samples=samples)


def _library(stream: BinaryIO, size: int) -> str | None:
    """The program that the header of a file names."""
    stream.seek(0)
    try:
        record = next(container.records(stream, size, check_end=False))
        found = container.parsed(Header, record).library
    except Damage:
        return None
    return found if record.opcode == container.HEADER else None


def _ours(records: Iterable[Record]) -> dict[str, dict[str, str]]:
    """The first of each of our two metadata records that passes its checksum."""
    found: dict[str, dict[str, str]] = {}
    try:
        for record in records:
            name, entries = container.metadata(record)
            claimed = entries.pop("checksum", None)
            if name in (METADATA, OUTCOME) and claimed == checksum(entries):
                found.setdefault(name, entries)
    except Damage:
        pass  # what comes behind it cannot be found this way
    return found


class Scan(ABC):
    """What has been verified of an archive so far.

    Args:
        expected: what must come.
        gapless: whether every chunk comes; otherwise some are left out.
        batch: bytes of chunks that are decoded at once; 0 to decode each by itself.
        definitions: schemas and channels for chunks with messages of unknown channels.

    Attributes:
        metadata: entries of the ``hil`` record, None before it came.
        header: the same, parsed; None where they cannot be used, or are of another version.
        unusable: why not.
        outcome: the ``hil.outcome`` record, None before it came.
        attachments: content by file name.
        parser: of the chunks.
        counts: messages by topic.
        chunks: how many chunks were taken.
    """

    def __init__(
        self,
        expected: Expected,
        *,
        gapless: bool,
        batch: int = 0,
        definitions: Sequence[Record] = (),
    ) -> None:
        self.expected = expected
        self.definitions = definitions
        self.metadata: dict[str, str] | None = None
        self.header: ArchiveHeader | None = None
        self.unusable: HeaderError | None = None
        self.outcome: ArchiveOutcome | None = None
        self.attachments: dict[str, bytes] = {}
        self.parser = ChunkParser()
        self.counts: dict[str, int] = {}
        self.chunks = 0
        self._gapless = gapless
        self._buffer = memoryview(bytearray(batch))  # content of the chunks that wait
        self._waiting: list[tuple[int, slice]] = []  # offset of each, and its place in the buffer
        self._place = 0  # place in the list of the chunk that comes next
        self._next: dict[str, int] = {}
        self._numbers: set[str] = set()
        self._newest = -1  # stamp of a cycle [ns]

    @property
    def topics(self) -> Collection[str] | None:
        """Channels whose messages are verified, None for all."""
        return None

    @abstractmethod
    def visit(self, found: Mapping[str, Messages], offset: int) -> None:
        """Use verified messages by topic, of the chunk at `offset` and maybe of some behind it.

        Raises:
            Damage: they cannot be used; then nothing of them counts.
        """

    def missing(self, topics: Collection[str], offset: int) -> None:  # noqa: ARG002
        """Messages of these topics are missing before those of the chunk at `offset`.

        Raises:
            Damage: that is the end.
        """
        if self._gapless and not self.expected.repaired:
            reason = "(chunk) does not continue the one before it: a chunk is missing"
            raise Damage(offset, reason)

    def take(self, record: Record) -> None:
        """Verify the next record, and take what it holds.

        Raises:
            Damage: it is not one that was written, or not the next.
        """
        offset = record.offset
        if record.opcode == container.CHUNK:
            if self.metadata is not None:  # else some other MCAP file
                head = container.chunk(record)
                data = container.chunk_data(head, offset)
                self._check_order(head.uncompressed_crc, offset)
                self._take_chunk(data, offset)
        elif record.opcode == container.ATTACHMENT:
            attachment = container.attachment(record)
            if attachment.name in self.attachments:
                raise Damage(offset, f"(attachment {attachment.name!r}) is there a second time")
            self.attachments[attachment.name] = attachment.data
        elif record.opcode == container.METADATA:
            self._take_metadata(record)
        else:
            self.parser.define(record)

    def flush(self) -> None:
        """Decode the chunks that wait: all at once, or one by one where that fails.

        Raises:
            Damage: one of them does not follow those before.
        """
        waiting, self._waiting = self._waiting, []
        if len(waiting) > 1:
            try:
                self._decode(self._buffer[: waiting[-1][1].stop], waiting[0][0])
                self.chunks += len(waiting)
                return
            except Damage:
                pass  # in one of them
        for offset, place in waiting:
            self._decode(self._buffer[place], offset)
            self.chunks += 1

    def _take_chunk(self, data: bytes, offset: int) -> None:
        """Decode the content of a chunk, or have it wait for others."""
        begin = self._waiting[-1][1].stop if self._waiting else 0
        if begin + len(data) >= len(self._buffer):
            self.flush()
            begin = 0
        if len(data) >= len(self._buffer):
            self._decode(data, offset)
            self.chunks += 1
        else:
            self._waiting.append((offset, slice(begin, begin + len(data))))
            self._buffer[begin : begin + len(data)] = data

    def shortfalls(self) -> Iterator[tuple[str, str]]:
        """What the file says that it holds and does not: aspect of the profile, and sentence."""
        for name in self.header.attachments if self.header else ():
            if name not in self.attachments:
                yield "attachments", f"attachment {name!r} is missing"
        outcome = self.outcome
        if outcome is None:
            yield "outcome", "the outcome is missing"
            return
        found: dict[str, tuple[int | None, int]] = {}
        counts = {"samples": NUMBERS, "events": (schema.EVENTS,), "packets": (schema.PACKETS,)}
        for key, topics in counts.items():
            known = key != "packets" or key in outcome.record
            if known and (self.topics is None or not set(topics).isdisjoint(self.topics)):
                count = max(self.counts.get(topic, 0) for topic in topics)
                found[key] = getattr(outcome, key), count
        if self.expected.chunks is not None:
            found["chunks"] = len(self.expected.chunks), self.chunks
        for key, (stated, count) in found.items():
            if stated != count:
                yield "outcome", f"{stated} {key} were written, {count} are there"

    def _take_metadata(self, record: Record) -> None:
        """Take header or outcome; another record's name is passed over."""
        name, entries = container.metadata(record)
        if name not in (METADATA, OUTCOME):
            return
        if entries.pop("checksum", None) != checksum(entries):
            raise Damage(record.offset, f"(metadata {name!r}) fails its checksum")
        if (self.metadata if name == METADATA else self.outcome) is not None:
            raise Damage(record.offset, f"(metadata {name!r}) is there a second time")
        if name == OUTCOME:
            self.outcome = ArchiveOutcome.of(entries)
            return
        self.metadata = entries
        try:
            self.header = ArchiveHeader.of(entries) if is_known(entries) else None
        except HeaderError as error:
            self.unusable = error

    def _check_order(self, crc: int, offset: int) -> None:
        """Check that the chunk with this checksum is the next of those that were written."""
        if self.expected.mixed and self._gapless:
            reason = "(chunk) may be of either of two: the outcome is that of another recording"
            raise Damage(offset, reason)
        chunks = self.expected.chunks
        if chunks is None:
            return
        if self._place < len(chunks) and chunks[self._place] == crc:
            self._place += 1
            return
        places = np.flatnonzero(chunks == crc)
        if not len(places) or places[-1] < self._place:
            why = "comes after one that followed it" if len(places) else "is of another recording"
            raise Damage(offset, f"(chunk) {why}, by the outcome's list of checksums")
        if self._gapless:
            raise Damage(offset, "(chunk) does not continue the one before")
        self._place = int(places[-1]) + 1

    def _decode(self, data: Content, offset: int) -> None:
        """Take messages that must be the next of their channels; else nothing of them counts."""
        parser = self.parser
        before = dict(parser.schemas), dict(parser.channels)
        try:
            by_number = parser.messages(data, offset)
            if not by_number.keys() <= parser.channels.keys():
                for definition in self.definitions:
                    parser.define(definition)
            if unknown := by_number.keys() - parser.channels.keys():
                raise Damage(offset, f"(chunk) has messages of an unknown channel {min(unknown)}")
            found = {parser.channels[number].topic: one for number, one in by_number.items()}
            wanted = found.keys() if self.topics is None else self.topics
            numbers = found.keys() & set(NUMBERS)
            if numbers and self._numbers not in (set(), numbers):
                reason = "(chunk) has samples in other channels than those before"
                raise Damage(offset, reason)
            verified = {topic: one for topic, one in found.items() if topic in wanted}
            missing = self._check_sequences(verified, offset)
            newest = self._check_times(verified, offset)
            if missing:
                self.missing(missing, offset)
            self.visit(found, offset)
        except Damage:
            parser.schemas, parser.channels = before  # what it says goes with it
            raise
        self._newest = max(self._newest, newest)
        self._numbers = self._numbers or numbers
        for topic, messages in verified.items():
            self._next[topic] = int(messages.of_heads("sequence")[-1]) + 1
            self.counts[topic] = self.counts.get(topic, 0) + len(messages)

    def _check_sequences(self, found: Mapping[str, Messages], offset: int) -> list[str]:
        """Check that messages do not repeat those before; topics of which some are missing."""
        gaps = {}
        for topic, messages in found.items():
            sequence = messages.of_heads("sequence")
            if (np.diff(sequence) != 1).any():
                raise Damage(offset, "(chunk) has messages out of order")
            gaps[topic] = (int(sequence[0]) - self._next.get(topic, 0)) % _SEQUENCES
            if gaps[topic] > _SEQUENCES // 2:
                raise Damage(offset, "(chunk) repeats messages that were before")
        if len({(len(found[topic]), gaps[topic]) for topic in found if topic in NUMBERS}) > 1:
            raise Damage(offset, "(chunk) has channels of different length")
        return [topic for topic, gap in gaps.items() if gap]

    def _check_times(self, found: Mapping[str, Messages], offset: int) -> int:
        """Check that cycles follow those before and are of this recording.

        Where there are no cycles, all channels must have the same times. Returns the newest stamp
        [ns], -1 without cycles.
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
            raise Damage(offset, "(chunk) has cycles that do not grow")
        first, last = self.expected.ends or (int(stamp[0]), int(stamp[-1]))
        begins = int(found[timed[0]].of_heads("sequence")[0]) == 0
        if stamp[0] < first or stamp[-1] > last or (begins and stamp[0] != first):
            reason = "(chunk) has cycles of another recording: the outcome names others"
            raise Damage(offset, reason)
        if stamp[0] <= self._newest:
            raise Damage(offset, "(chunk) has cycles that do not follow those before")
        return int(stamp[-1])
