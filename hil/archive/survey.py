"""Goes through a whole archive, past its damages, and says what of it stands.

The reader stops at the first damage; a survey goes on, so that what follows can be saved. What it
keeps has passed the same checks: checksums, numbers of messages that count on, and that chunks and
cycles are those that were written (`hil.archive.order`).
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import BinaryIO

import numpy as np
import zstandard
from numpy.typing import NDArray

from hil.archive import container, index, schema
from hil.archive.container import Damage, Record
from hil.archive.header import (
    METADATA,
    OUTCOME,
    ArchiveHeader,
    ArchiveOutcome,
    HeaderError,
    checksum,
)
from hil.archive.index import IndexBuilder, MessageHead, Summary
from hil.archive.intact import NUMBERS, Fault, Piece, Survey
from hil.archive.known_channels import KnownChannels
from hil.archive.order import Contested, Order, Written
from hil.errors import ArchiveError
from hil.reading import opened

_STAMP = struct.Struct("<iI")  # s, ns
_STAMP_AT = 4  # in the data of a message, behind its encapsulation


@dataclass
class Inside:
    """What a chunk holds.

    Attributes:
        data: its records, decompressed.
        offset: where it stands in the file, for errors.
        numbered: sequence numbers of its messages, by channel.
        places: where their data begin, by channel.
        definitions: its other records.
        logged: log times of all messages [ns].
    """

    data: bytes
    offset: int
    numbered: dict[int, list[int]] = field(default_factory=dict)
    places: dict[int, list[int]] = field(default_factory=dict)
    definitions: list[Record] = field(default_factory=list)
    logged: list[int] = field(default_factory=list)

    @classmethod
    def of(cls, data: bytes, offset: int) -> Inside:
        """Go through a chunk.

        Raises:
            Damage: it does not hold whole records.
        """
        found = cls(data, offset)
        for item in index.messages(data, offset):
            if isinstance(item, MessageHead):
                found.numbered.setdefault(item.channel, []).append(item.sequence)
                found.places.setdefault(item.channel, []).append(item.data)
                found.logged.append(item.log_time)
            else:
                found.definitions.append(item)
        return found

    @property
    def times(self) -> tuple[int, int]:
        """First and last log time."""
        return min(self.logged, default=0), max(self.logged, default=0)

    def stamps(self, channel: int) -> NDArray[np.int64]:
        """The stamps in the messages of a channel (k,) [ns].

        Raises:
            Damage: a message is too short for one.
        """
        places = self.places[channel]
        if places[-1] + _STAMP_AT + _STAMP.size > len(self.data):
            raise Damage(self.offset, "(chunk) has messages without a stamp")
        stamps = [_STAMP.unpack_from(self.data, at + _STAMP_AT) for at in places]
        return np.array([s * 10**9 + ns for s, ns in stamps], np.int64)


HEADER = index.record(container.HEADER, index.text(schema.PROFILE) + index.text(schema.LIBRARY))
_BETWEEN = (container.MESSAGE_INDEX, container.HEADER, container.DATA_END)


def survey(path: str | PathLike[str]) -> Survey:
    """Go through a file.

    Raises:
        ArchiveError: it cannot be read.
    """
    path = Path(path)
    try:
        with opened(path) as stream:
            size = os.fstat(stream.fileno()).st_size
            written = Written.read(stream, size)
            if written.strange:
                written = Written()  # told as a fault of the outcome
            try:
                return _Surveyor(stream, Survey(path, size), Order(written, gapless=False)).run()
            except Contested as contested:
                order = Order(written, gapless=False, until=contested)
                return _Surveyor(stream, Survey(path, size), order).run()
    except OSError as error:
        raise ArchiveError(path, f"cannot be read: {error.strerror}") from error


class _Surveyor:
    """Fills a survey from a file."""

    def __init__(self, stream: BinaryIO, survey: Survey, order: Order) -> None:
        self.survey = survey
        self._order = order
        self._stream = stream
        self._summary = Summary.read(stream, survey.size)
        self._decompressor = zstandard.ZstdDecompressor()
        self._known = KnownChannels()
        self._next: dict[int, int] = {}
        self._shift: dict[int, int] = {}
        self._seen: set[int] = set()
        self._lost_since = False
        self._ended = False
        self._index = IndexBuilder()
        self._indexes: list[bytes] = []  # message indexes that must come now
        self._tail: bytes | None = None

    def run(self) -> Survey:
        """Survey the file.

        Raises:
            Contested: two chunks claim the same cycles, and nobody knows which is right.
        """
        self._stream.seek(0)
        try:
            for record in container.records(self._stream, self.survey.size, check_end=False):
                self._visit(record)
        except Contested:
            raise
        except Damage as damage:
            self._lost_since = True  # and what is lost, counts and outcome will tell
            self._fault("container", damage, loss=False)
        for record in self._listed():
            self._visit(record)
        self._finish()
        return self.survey

    def _listed(self) -> Iterator[Record]:
        """Records that the summary knows and the walk did not reach."""
        if self._summary is None:
            return
        chunks = [(chunk.offset, chunk.length) for chunk in self._summary.chunks]
        for place in sorted([*chunks, *self._summary.others]):
            if place[0] not in self._seen:
                try:
                    yield container.record_at(self._stream, *place)
                except Damage as damage:
                    self._fault("container", damage, loss=True)

    def _fault(self, aspect: str, problem: Damage | str, *, loss: bool) -> None:
        self._lost_since |= loss
        text = problem
        if isinstance(problem, Damage):
            text = f"the record at byte {problem.offset} {problem.reason}"
        fault = Fault(aspect, str(text), loss)
        if fault not in self.survey.faults:
            self.survey.faults.append(fault)

    def _visit(self, record: Record) -> None:
        self._seen.add(record.offset)
        self._check_indexes(record)
        try:
            if record.opcode == container.HEADER:
                fields = container.Fields(record.body, record.offset)
                self.survey.written_by = fields.text(), fields.text()
            elif record.opcode == container.METADATA:
                self._metadata(record)
            elif record.opcode == container.ATTACHMENT:
                self._attachment(record)
            elif record.opcode == container.CHUNK:
                self._chunk(record)
            elif record.opcode in (container.SCHEMA, container.CHANNEL):
                self._announce(record.opcode, record.body, record.offset)
                self._keep(record)
            elif record.opcode == container.DATA_END:
                self._data_end(record)
            elif record.opcode not in _BETWEEN:
                self._fault("container", Damage(record.offset, "is of an unknown kind"), loss=False)
        except Contested:
            raise
        except Damage as damage:
            aspect = _ASPECTS.get(record.opcode, "container")
            self._fault(aspect, damage, loss=record.opcode != container.HEADER)

    def _check_indexes(self, record: Record) -> None:
        """Compare the message indexes behind a chunk with those it must have."""
        if record.opcode == container.MESSAGE_INDEX:
            data = index.record(record.opcode, record.body)
            if data in self._indexes:
                self._indexes.remove(data)
            else:
                self._fault("index", Damage(record.offset, "(message index) is wrong"), loss=False)
        elif self._indexes:
            self._indexes = []
            self._fault("index", Damage(record.offset, "lacks a message index before"), loss=False)

    def _keep(self, record: Record, shift: dict[int, int] | None = None) -> None:
        length = record.end - record.offset
        self.survey.pieces.append(Piece(record.offset, length, record.opcode, shift))

    def _metadata(self, record: Record) -> None:
        name, entries = container.metadata(record)
        self._index.add_metadata(record.offset, record.end - record.offset, name)
        if name not in (METADATA, OUTCOME):
            self._keep(record)
            return
        if entries.pop("checksum", None) != checksum(entries):
            raise Damage(record.offset, f"(metadata {name!r}) fails its checksum")
        survey = self.survey
        if (survey.metadata if name == METADATA else survey.outcome) is not None:
            raise Damage(record.offset, f"(metadata {name!r}) is there a second time")
        if name == OUTCOME:
            survey.outcome = ArchiveOutcome.of(entries)
            return
        survey.metadata = entries
        with suppress(HeaderError):
            survey.header = ArchiveHeader.of(entries)

    def _attachment(self, record: Record) -> None:
        name, _ = container.attachment(record)
        if name in self.survey.attachments:
            raise Damage(record.offset, f"(attachment {name!r}) is there a second time")
        self._index.add_attachment(record.offset, record)
        self.survey.attachments.append(name)
        self._keep(record)

    def _announce(self, opcode: int, body: bytes, offset: int) -> None:
        self._known.take(opcode, body, offset)
        self._index.announce(opcode, body)

    def _chunk(self, record: Record) -> None:
        if self.survey.metadata is None:
            return  # some other MCAP file
        if self._ended:
            raise Damage(record.offset, "(chunk) comes after a gap that nothing would show")
        if self._order.closed:
            return  # that nothing behind is believed was said
        data = container.chunk_data(record, decompressor=self._decompressor)
        head = container.chunk(record)
        self._order.check_chunk(head.crc, record.offset)
        inside = Inside.of(data, record.offset)
        known = KnownChannels(self._known), self.survey.definitions
        try:
            for item in inside.definitions:
                if item.opcode in (container.SCHEMA, container.CHANNEL):
                    self._announce(item.opcode, item.body, record.offset)
            shift = self._continued(inside, record.offset)
        except Damage:
            self._known, self.survey.definitions = known  # what it announces goes with it
            raise
        if (head.start_time, head.end_time) != inside.times:
            self._fault("index", Damage(record.offset, "(chunk) states other times"), loss=False)
        indexes = self._index.add_chunk(record.offset, record.end - record.offset, head, data)
        self._indexes = index.split(indexes)
        moved = shift if any(shift.values()) else None
        self._keep(record, moved)
        self.survey.pieces[-1] = self.survey.pieces[-1]._replace(times=inside.times)
        self._lost_since = False

    def _continued(self, inside: Inside, offset: int) -> dict[int, int]:
        """Check that the messages of a chunk count on; by how much they are ahead, by channel."""
        numbered = inside.numbered
        self._recover_channels(numbered, offset)
        shift = {}
        for channel, sequence in numbered.items():
            first = sequence[0]
            if sequence != list(range(first, first + len(sequence))):
                raise Damage(offset, "(chunk) has messages out of order")
            if first < self._next.get(channel, 0):
                raise Damage(offset, "(chunk) repeats messages that were before")
            shift[channel] = first - self._standing(channel)
        numbers = {
            topic: (len(sequence), shift[channel])
            for channel, sequence in numbered.items()
            if (topic := self._known.topic(channel)) in NUMBERS
        }
        if len({*numbers.values()}) > 1:
            raise Damage(offset, "(chunk) has channels of different length")
        before = self.survey.counts.keys() & {*NUMBERS}
        if numbers and before and before != numbers.keys():
            raise Damage(offset, "(chunk) has samples in other channels than those before")
        gaps = {channel: numbered[channel][0] - self._next.get(channel, 0) for channel in numbered}
        stamps = self._cycle_stamps(inside, offset)
        if any(gaps.values()):
            self._gap(gaps, offset)
        if len(stamps):
            self._order.take(int(stamps[-1]))
        for channel, sequence in numbered.items():
            topic = self._known.topic(channel)
            self._next[channel] = sequence[-1] + 1
            self.survey.counts[topic] = self.survey.counts.get(topic, 0) + len(sequence)
            missing = self.survey.missing.get(topic, 0) + gaps[channel]
            self.survey.missing[topic] = missing
        return shift

    def _cycle_stamps(self, inside: Inside, offset: int) -> NDArray[np.int64]:
        """The stamps of the cycles in a chunk, (k,) [ns], which follow those before.

        Where there are no cycles, none; but then all channels must have the same.
        """
        channels = {self._known.topic(channel): channel for channel in inside.places}
        if schema.CYCLE in channels:
            channel = channels[schema.CYCLE]
            found = inside.stamps(channel)
            self._order.check_cycles(found, offset, begins=inside.numbered[channel][0] == 0)
            return found
        stamps = [inside.stamps(channels[topic]) for topic in NUMBERS if topic in channels]
        if not all(np.array_equal(one, stamps[0]) for one in stamps):
            raise Damage(offset, "(chunk) has channels of different times")
        return np.zeros(0, np.int64)

    def _standing(self, channel: int) -> int:
        return self.survey.counts.get(self._known.topic(channel), 0)

    def _recover_channels(self, numbered: dict[int, list[int]], offset: int) -> None:
        """Take channels that no record before announces from the summary."""
        if numbered.keys() <= self._known.channels.keys():
            return
        summary = self._summary or self._moved_summary()
        definitions = summary.definitions if summary else ()
        for item in definitions:
            self._announce(item.opcode, item.body, offset)
        unknown = numbered.keys() - self._known.channels.keys()
        if unknown:
            raise Damage(offset, f"(chunk) has messages of an unknown channel {min(unknown)}")
        self.survey.definitions = definitions

    def _moved_summary(self) -> Summary | None:
        """The summary where a chunk of another length has come before it."""
        here = self._stream.tell()
        start = container.data_end(self._stream, self.survey.size)
        found = start and Summary.read(self._stream, self.survey.size, start=start)
        self._stream.seek(here)
        return found or None

    def _gap(self, gaps: dict[int, int], offset: int) -> None:
        """Note that messages are missing; a gap in samples must show in the samples behind it."""
        topics = {self._known.topic(channel) for channel, gap in gaps.items() if gap}
        if topics & {*NUMBERS} and schema.CYCLE not in self._known.topics:
            self._ended = True
            raise Damage(offset, "(chunk) comes after a gap that nothing would show")
        if not self._lost_since:
            self._fault(
                "sequence", Damage(offset, "(chunk) does not continue the one before"), loss=True
            )

    def _data_end(self, record: Record) -> None:
        if record.body != bytes(4):
            self._fault("index", Damage(record.offset, "(DataEnd) is wrong"), loss=False)
        self._tail = self._index.tail(record.offset)

    def _finish(self) -> None:
        survey = self.survey
        if survey.metadata is None:
            return
        for topic in self._known.topics:
            found = self._known.schema(topic)
            survey.types[topic] = found.name if found else ""
        if survey.written_by != (schema.PROFILE, schema.LIBRARY):
            self._fault("container", "the header is not that of the profile", loss=False)
        for name in survey.header.attachments if survey.header else ():
            if name not in survey.attachments:
                self._fault("attachments", f"attachment {name!r} is missing", loss=True)
        self._check_outcome()
        self._check_summary()

    def _check_outcome(self) -> None:
        outcome = self.survey.outcome
        if outcome is None:
            self._fault("outcome", "the outcome is missing", loss=True)
            return
        if self.survey.mixed:
            self._fault("outcome", "the outcome is that of another recording", loss=True)
        topic = self._known.topic
        cycles = [at for channel, at in self._next.items() if topic(channel) == schema.CYCLE]
        if max(cycles, default=0) == outcome.samples:
            self._order.check_end(self.survey.size)
        counts = {"samples": self.survey.samples, "events": self.survey.events}
        stated = {"samples": outcome.samples, "events": outcome.events}
        if outcome.packets is not None:
            counts["packets"] = self.survey.counts.get(schema.PACKETS, 0)
            stated["packets"] = outcome.packets
        if self._order.listed is not None:
            counts["chunks"] = sum(p.opcode == container.CHUNK for p in self.survey.pieces)
            stated["chunks"] = self._order.listed
        for key, count in counts.items():
            if stated[key] != count:
                text = f"{stated[key]} {key} were written, {count} are there"
                self._fault("outcome", text, loss=True)

    def _check_summary(self) -> None:
        if self._summary is None or self._tail is None:
            self._fault(
                "index", "the index at the end is missing or fails its checksum", loss=False
            )
        elif not self.survey.counts:
            return  # channels without messages stand in the summary alone
        elif self._summary != Summary.of(self._tail):
            self._fault("index", "the index at the end does not fit the file", loss=False)


_ASPECTS = {
    container.METADATA: "metadata",
    container.ATTACHMENT: "attachments",
    container.CHUNK: "chunks",
}
