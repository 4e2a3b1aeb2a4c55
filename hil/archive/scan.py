"""Goes through an archive record by record, and verifies that each is one that was written.

The one walker of archives: the reader stops at the first damage (`hil.archive.reader`), checks and
repairs go on behind it (`hil.archive.survey`).

The checksum of a chunk says that it is whole, not that it is of this recording: a file system may
put a chunk of another archive in its place. The outcome lists the checksums of all chunks in order,
so that each is known by its own. Archives of earlier versions have no such list, torn ones no
outcome: there the cycles must do, which grow from the first to the last that the outcome names.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import BinaryIO, Self

import numpy as np
import zstandard
from mcap.records import Header
from numpy.typing import NDArray

from hil.archive import container, schema
from hil.archive.chunk import ChunkParser, Messages
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

_SEQUENCES = 1 << 32  # message numbers are counted modulo this
_BUT_METADATA = frozenset(range(256)) - {container.METADATA}


@dataclass(eq=False)
class Order:
    """The chunks that a file must have, as its end says, and how far they have come.

    Attributes:
        chunks: their checksums in order, shape (k,); None where nothing says so.
        ends: stamps of the first and the last cycle [ns].
        samples: how many were written, 0 where nothing says so.
        strange: whether that end is of another recording than the beginning.
        gapless: whether every chunk comes; otherwise some are left out.
        repaired: whether messages were lost before the file was written as it is.
    """

    chunks: NDArray[np.uint32] | None = None
    ends: tuple[int, int] | None = None
    samples: int = 0
    strange: bool = False
    gapless: bool = True
    repaired: bool = False
    _at: int = field(default=0, init=False)
    _newest: int = field(default=-1, init=False)

    @classmethod
    def read(cls, stream: BinaryIO, size: int, summary: Summary | None) -> Self:
        """Find it, where the summary says or from head to head; the stream is left anywhere."""
        found = _records_of_ours(_indexed(stream, summary)) if summary else {}
        if found.keys() != {METADATA, OUTCOME}:
            found = _records_of_ours(_walked(stream, size))
        if found.keys() != {METADATA, OUTCOME}:
            return cls()
        try:
            header, outcome = ArchiveHeader.of(found[METADATA]), ArchiveOutcome.of(found[OUTCOME])
        except HeaderError:
            return cls()
        if not outcome.belongs_to(header):
            return cls(strange=True)
        chunks = None
        # Another program that copies a file may cut its chunks anew, and then names itself.
        if outcome.chunks is not None and _is_ours(stream, size):
            chunks = np.array(outcome.chunks, np.uint32)
        return cls(chunks, _ends(header, outcome), outcome.samples or 0, repaired=outcome.repaired)

    def check_chunk(self, crc: int, offset: int) -> None:
        """Check that the chunk with this checksum, its own, is the next.

        Raises:
            Damage: it is not.
        """
        if self.strange:
            reason = "(chunk) may be of either of two: the outcome is that of another recording"
            raise Damage(offset, reason)
        chunks = self.chunks
        if chunks is None:
            return
        if self._at < len(chunks) and chunks[self._at] == crc:
            self._at += 1
            return
        places = np.flatnonzero(chunks == crc)
        if not len(places) or places[-1] < self._at:
            why = "stands behind one that followed it" if len(places) else "is of another recording"
            raise Damage(offset, f"(chunk) {why}, by the outcome's list of checksums")
        if self.gapless:
            raise Damage(offset, "(chunk) does not continue the one before")
        self._at = int(places[-1]) + 1

    def check_cycles(self, stamps: NDArray[np.int64], offset: int, *, begins: bool) -> None:
        """Check that cycles follow those before, and that they are of this recording.

        Args:
            stamps: theirs, shape (k,) [ns], k > 0.
            offset: where their chunk stands.
            begins: whether they are the first that were written.

        Raises:
            Damage: they are not.
        """
        if (np.diff(stamps) <= 0).any():
            raise Damage(offset, "(chunk) has cycles that do not grow")
        first, last = self.ends or (int(stamps[0]), int(stamps[-1]))
        if stamps[0] < first or stamps[-1] > last or (begins and stamps[0] != first):
            reason = "(chunk) has cycles of another recording: the outcome names others"
            raise Damage(offset, reason)
        if stamps[0] <= self._newest:
            raise Damage(offset, "(chunk) has cycles that do not follow those before")

    def take(self, newest: int) -> None:
        """Note that cycles up to the stamp `newest` [ns] were taken."""
        self._newest = newest


class Scan(ABC):
    """What has been verified of an archive so far.

    Args:
        order: the chunks that must come.
        topics: channels whose messages are verified, None for all.

    Attributes:
        metadata: entries of the ``hil`` record, None before it came.
        header: the same, parsed; None where they cannot be used, or are of another version.
        unusable: why not.
        outcome: the ``hil.outcome`` record, None before it came.
        attachments: content by file name.
        parser: of the chunks.
        counts: messages by topic.
    """

    def __init__(self, order: Order, topics: Collection[str] | None = None) -> None:
        self.metadata: dict[str, str] | None = None
        self.header: ArchiveHeader | None = None
        self.unusable: HeaderError | None = None
        self.outcome: ArchiveOutcome | None = None
        self.attachments: dict[str, bytes] = {}
        self.parser = ChunkParser()
        self.counts: dict[str, int] = {}
        self._order = order
        self._topics = topics
        self._next: dict[str, int] = {}
        self._numbers: frozenset[str] = frozenset()
        self._decompressor = zstandard.ZstdDecompressor()

    def take(self, record: Record) -> None:
        """Verify the next record, and take what it holds.

        Raises:
            Damage: it is not one that was written, or not the next.
        """
        if record.opcode == container.CHUNK:
            if self.metadata is not None:  # else some other MCAP file
                self.take_chunk(record)
        elif record.opcode == container.ATTACHMENT:
            self.take_attachment(record)
        elif record.opcode == container.METADATA:
            self.take_metadata(record, *container.metadata(record))
        elif record.opcode in (container.SCHEMA, container.CHANNEL):
            self.parser.known.take(record)

    @abstractmethod
    def take_chunk(self, record: Record) -> None:
        """Take a chunk."""

    def take_attachment(self, record: Record) -> None:
        """Take an attachment."""
        attachment = container.attachment(record)
        self.attachments[attachment.name] = attachment.data

    def take_metadata(self, record: Record, name: str, entries: dict[str, str]) -> None:
        """Take header or outcome; another record's name is passed over."""
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

    def opened(self, record: Record) -> bytes:
        """The records of a chunk that is one of those written, and whose turn it is.

        Raises:
            Damage: it is none of them, or damaged.
        """
        head = container.chunk(record)
        data = container.chunk_data(record, decompressor=self._decompressor, head=head)
        self._order.check_chunk(head.uncompressed_crc, record.offset)
        return data

    def continued(self, found: Mapping[str, Messages], offset: int) -> None:
        """Take messages by topic, which must be the next of their channels.

        Raises:
            Damage: they are not; then nothing of them is taken.
        """
        verified = {
            topic: messages
            for topic, messages in found.items()
            if self._topics is None or topic in self._topics
        }
        numbers = frozenset(topic for topic in found if topic in NUMBERS)
        if numbers and self._numbers not in (frozenset(), numbers):
            raise Damage(offset, "(chunk) has samples in other channels than those before")
        ends, gaps = {}, {}
        for topic, messages in verified.items():
            sequence = messages.of_heads("sequence")
            if (np.diff(sequence) != 1).any():
                raise Damage(offset, "(chunk) has messages out of order")
            gaps[topic] = (int(sequence[0]) - self._next.get(topic, 0)) % _SEQUENCES
            if gaps[topic] > _SEQUENCES // 2:
                raise Damage(offset, "(chunk) repeats messages that were before")
            ends[topic] = (int(sequence[-1]) + 1) % _SEQUENCES
        samples = [topic for topic in verified if topic in NUMBERS]
        if len({(len(verified[topic]), gaps[topic]) for topic in samples}) > 1:
            raise Damage(offset, "(chunk) has channels of different length")
        newest = self._check_times(verified, samples, offset)
        if any(gaps.values()):
            self.missing(gaps, offset)
        if newest is not None:
            self._order.take(newest)
        self._numbers = self._numbers or numbers
        self._next |= ends
        for topic, messages in verified.items():
            self.counts[topic] = self.counts.get(topic, 0) + len(messages)

    def missing(self, gaps: Mapping[str, int], offset: int) -> None:  # noqa: ARG002
        """So many messages are missing before those of the chunk at `offset`, by topic.

        Raises:
            Damage: that is the end.
        """
        raise Damage(offset, "(chunk) does not continue the one before it: a chunk is missing")

    def _check_times(
        self, found: Mapping[str, Messages], samples: list[str], offset: int
    ) -> int | None:
        """Check that cycles follow those before; the newest stamp [ns], None without cycles.

        Where there are no cycles, all channels must have the same times.
        """
        timed = [schema.CYCLE] if schema.CYCLE in samples else samples
        if not timed:
            return None
        stamps = [found[topic].stamps for topic in timed]
        if not all(map(len, stamps)):
            raise Damage(offset, "(chunk) has messages without a stamp")
        first = stamps[0]
        if not all(np.array_equal(one, first) for one in stamps):
            raise Damage(offset, "(chunk) has channels of different times")
        if timed[0] not in schema.PER_CYCLE or schema.CYCLE not in self.parser.known.topics:
            return None
        begins = int(found[timed[0]].of_heads("sequence")[0]) == 0
        self._order.check_cycles(first, offset, begins=begins)
        return int(first[-1])


def _ends(header: ArchiveHeader, outcome: ArchiveOutcome) -> tuple[int, int] | None:
    """Stamps of the first and the last cycle; None of what was repaired or has no cycles."""
    step, first, last = header.period, outcome.first_cycle, outcome.last_cycle
    if step is None or outcome.repaired or first is None or last is None:
        return None
    if first > last:  # earlier versions took two sessions
        return None
    return round(first * (step * 1e9)), round(last * (step * 1e9))


def _is_ours(stream: BinaryIO, size: int) -> bool:
    """Whether the header says that the file was written by us."""
    stream.seek(0)
    try:
        header = next(container.records(stream, size, check_end=False))
        if header.opcode != container.HEADER:
            return False
        return container.parsed(Header, header.body, 0).library == schema.LIBRARY
    except Damage:
        return False


def _records_of_ours(records: Iterable[Record]) -> dict[str, dict[str, str]]:
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


def _indexed(stream: BinaryIO, summary: Summary) -> Iterator[Record]:
    """Metadata records where the summary says that they are."""
    for place in summary.metadata:
        record = container.record_at(stream, *place)
        if record.opcode == container.METADATA:
            yield record


def _walked(stream: BinaryIO, size: int) -> Iterator[Record]:
    """Metadata records, found from head to head."""
    stream.seek(0)
    yield from container.records(stream, size, skip=_BUT_METADATA, check_end=False)
