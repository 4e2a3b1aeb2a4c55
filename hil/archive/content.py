"""Collects the content of an archive record by record, and knows when something is missing.

A chunk counts whole or not at all. MCAP numbers the messages of each channel, so a chunk that
vanished (a damaged opcode makes a reader skip it) is noticed by the next one; one that vanished at
the end by the counts in the outcome. Whether a whole chunk, numbered as ours was, is ours at all,
`hil.archive.order` knows.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from typing import Any, NamedTuple

import numpy as np
import zstandard
from numpy.typing import NDArray

from hil.archive import container, schema
from hil.archive.cdr import LayoutError, MessageLayout, fixed_layout
from hil.archive.chunk import Bytes, ChunkParser, Messages
from hil.archive.columns import Columns
from hil.archive.container import Damage, Record
from hil.archive.description import Description, DescriptionError
from hil.archive.events import ArchivedEvent
from hil.archive.messages import check_joints, decode_log, joint_state_of
from hil.archive.order import Order
from hil.archive.selection import Selection
from hil.archive.standing import NUMBERS

_NEEDED = ("kind", "joint_names", "attachments")
_MOST_EXPECTED = 1 << 20  # samples that room is made for on the word of one chunk
_MARGIN = 1.3  # room for chunks that are smaller than the one the count is guessed from
_BATCH = 1 << 20  # bytes of chunks decoded at once: few calls per chunk, and all in the cache
_COLUMN_OF = {"effort": "torque"}  # where a message has another word for it than we


class _Waiting(NamedTuple):
    """A chunk that passed its checksum and is decoded with others."""

    offset: int
    data: bytes


class Content:
    """What has been read from a file so far.

    Args:
        selection: what is wanted of it.
        order: the chunks that must come.
        gapless: whether all chunks are read, so that the messages of a channel must count on from
            chunk to chunk; otherwise their numbers need only grow.
    """

    def __init__(self, selection: Selection, order: Order, *, gapless: bool = True) -> None:
        self.metadata: dict[str, str] | None = None
        self.description: Description | None = None
        self.outcome: dict[str, str] | None = None
        self.attachments: dict[str, bytes] = {}
        self.events: list[ArchivedEvent] = []
        self.parser = ChunkParser()
        self._selection = selection
        self._order = order
        self._gapless = gapless
        self._size = 0
        self._decompressor = zstandard.ZstdDecompressor()
        self._channels: dict[str, _Channel] = {}
        self._wanted: tuple[str, ...] = ()
        self._n_events = 0
        self._waiting: list[_Waiting] = []
        self._waiting_size = 0

    def collect(self, records: Iterable[Record], size: int) -> Damage | None:
        """Take records up to their end or the first damage, which is returned.

        Args:
            records: of the data section, in the order of the file.
            size: length of the file, or of the part of it that is read.
        """
        self._size = size
        damage = None
        try:
            for record in records:
                self._take(record)
        except Damage as found:
            damage = found
        try:
            self._take_waiting()
            if damage is None:
                self._check_counts(size)
        except Damage as found:  # in an earlier record
            damage = found
        return damage

    def columns(self) -> dict[str, NDArray[Any]]:
        """The columns read, all of the same length."""
        joined: dict[str, NDArray[Any]] = {"stamp": np.zeros(0, np.int64)}
        for channel in self._channels.values():
            joined |= channel.finished()
        return joined

    def _take(self, record: Record) -> None:
        if record.opcode == container.CHUNK:
            self._take_chunk(record)
        elif record.opcode == container.ATTACHMENT:
            name, data = container.attachment(record)
            self.attachments[name] = data
        elif record.opcode == container.METADATA:
            self._take_metadata(record)
        elif record.opcode in (container.SCHEMA, container.CHANNEL):
            self.parser.announced.take(record.opcode, record.body, record.offset)

    def _take_metadata(self, record: Record) -> None:
        name, entries = container.metadata(record)
        if name not in (schema.METADATA, schema.OUTCOME):
            return
        claimed = entries.pop("checksum", None)
        if claimed != schema.checksum(entries):
            raise Damage(record.offset, f"(metadata {name!r}) fails its checksum")
        if name == schema.OUTCOME:
            if not schema.belong_together(self.metadata, entries):
                reason = f"(metadata {name!r}) is that of another recording"
                raise Damage(record.offset, reason)
            self.outcome = {key: entries[key] for key in entries if key not in schema.SEALS}
            return
        if self.metadata is not None:
            raise Damage(record.offset, f"(metadata {name!r}) is there a second time")
        if entries.get("format_version") != str(schema.FORMAT_VERSION):
            self.metadata = entries
            raise Damage(record.offset, "is of another version")
        absent = [key for key in _NEEDED if key not in entries]
        if absent:
            raise Damage(record.offset, f"(metadata {name!r}) has no entry {absent[0]!r}")
        self.metadata = entries
        try:
            self.description = Description.of(entries)
        except DescriptionError as error:
            raise Damage(record.offset, f"(metadata {name!r}) cannot be used: {error}") from error

    def _take_chunk(self, record: Record) -> None:
        if self.description is None:
            return  # some other MCAP file, which will be refused as such
        data = container.chunk_data(record, decompressor=self._decompressor)
        self._order.check_chunk(container.chunk(record).crc, record.offset)
        if not self.parser.repeats(data):
            self._take_waiting()
            self._decode(self.parser.messages(data, record.offset), record.offset, len(record.body))
            return
        self._waiting.append(_Waiting(record.offset, data))
        self._waiting_size += len(data)
        if self._waiting_size >= _BATCH:
            self._take_waiting()

    def _take_waiting(self) -> None:
        """Decode the chunks that wait: all at once, or one by one where that fails."""
        waiting, self._waiting, self._waiting_size = self._waiting, [], 0
        if not waiting:
            return
        try:
            found = self.parser.repeated([chunk.data for chunk in waiting])
            if found is not None:
                self._decode(found, waiting[0].offset, 0)
                return
        except Damage:
            pass  # in one of them
        for chunk in waiting:
            self._decode(self.parser.messages(chunk.data, chunk.offset), chunk.offset, 0)

    def _decode(self, found: dict[str, Messages], offset: int, compressed: int) -> None:
        """Decode messages, if they are what must follow now; else nothing of them counts."""
        recorded = self.parser.announced.topics
        wanted = tuple(topic for topic in self._selection.numbers(recorded) if topic in recorded)
        counts = {len(found[topic]) if topic in found else 0 for topic in wanted}
        if len(counts) > 1:
            raise Damage(offset, "(chunk) has channels of different length")
        if any(counts):
            self._wanted = self._wanted or wanted
            elsewhere = wanted != self._wanted
        else:
            elsewhere = self._selection.topics is None and not found.keys().isdisjoint(NUMBERS)
        if elsewhere:
            raise Damage(offset, "(chunk) has samples in other channels than those before")
        decoded = []
        for topic in wanted:
            if topic in found:
                channel = self._channel(topic, found[topic], offset)
                decoded.append((channel, channel.verified(found[topic], offset)))
        if len(decoded) > 1:
            times = [channel.stamps(messages) for channel, messages in decoded]
            if not all(np.array_equal(one, times[0]) for one in times):
                raise Damage(offset, "(chunk) has channels of different times")
        logs = found.get(schema.EVENTS) if self._selection.events else None
        events = self._decoded_events(logs, offset)
        for channel, messages in decoded:
            share = self._size / compressed if compressed else 0.0
            expected = min(_MOST_EXPECTED, int(_MARGIN * len(messages) * share))
            channel.append(messages, expected)
        self._n_events += len(events)
        start, stop = self._selection.times
        self.events += [event for stamp, event in events if start <= stamp < stop]

    def _channel(self, topic: str, messages: Messages, offset: int) -> _Channel:
        """The decoder of a topic, made from its schema or from its first message."""
        if topic not in self._channels:
            try:
                layout = self._layout(topic, messages)
            except LayoutError as error:
                raise Damage(offset, f"(chunk) has messages of {topic}: {error}") from error
            self._channels[topic] = _Channel(
                layout,
                self._selection,
                gapless=self._gapless,
                order=self._order if self._grows(topic) else None,
            )
        return self._channels[topic]

    def _grows(self, topic: str) -> bool:
        """Whether the messages of a topic are of cycles, one each."""
        return topic in schema.PER_CYCLE and schema.CYCLE in self.parser.announced.topics

    def _layout(self, topic: str, messages: Messages) -> MessageLayout:
        assert self.description is not None
        joints = self.description.joint_names
        if topic in (schema.MEASURED, schema.COMMANDED):
            names, layout = joint_state_of(messages.first())
            check_joints(names, layout, joints)
            return layout
        known = self.parser.announced.schema(topic)
        if known is None:
            raise LayoutError("their schema is missing")
        layout = fixed_layout(known.definition)
        schema.check_fields(topic, layout, len(joints))
        return layout

    def _decoded_events(
        self, messages: Messages | None, offset: int
    ) -> list[tuple[int, ArchivedEvent]]:
        """The events with their stamps [ns]."""
        if messages is None:
            return []
        _check_sequence(messages, self._n_events if self._gapless else None, offset)
        try:
            logs = [decode_log(message) for message in messages.all()]
        except LayoutError as error:
            raise Damage(offset, f"(chunk) has an event that cannot be read: {error}") from error
        return [(log.stamp, ArchivedEvent.from_log(log)) for log in logs]

    def _check_counts(self, size: int) -> None:
        """Compare what was read with what the writer says it wrote."""
        if self.description is None:
            return
        absent = sorted(set(self.description.attachments) - set(self.attachments))
        if absent:
            raise Damage(size, f"(attachment {absent[0]!r}) is missing")
        if self.outcome is None:
            raise Damage(size, f"(metadata {schema.OUTCOME!r}) is missing")
        if not self._gapless:
            return
        counts = {"samples": max([channel.read for channel in self._channels.values()], default=0)}
        if self._selection.events:
            counts["events"] = self._n_events
        if not self._selection.numbers(self.parser.announced.topics):
            del counts["samples"]
        elif schema.PACKETS in (self._selection.topics or ()):
            counts["packets"] = counts.pop("samples")
        for key, count in counts.items():
            if self.outcome.get(key) != str(count):
                raise Damage(size, f"is missing: {self.outcome.get(key)} {key} were written")
        self._order.check_end(size)


class _Channel:
    """Decodes the messages of one topic into columns.

    Attributes:
        read: messages read so far, whether their time is wanted or not.
    """

    def __init__(
        self, layout: MessageLayout, selection: Selection, *, gapless: bool, order: Order | None
    ) -> None:
        self.read = 0
        self._order = order
        self._layout = layout
        self._times = selection.times if selection.bounded else None
        self._gapless = gapless
        self._next = 0
        self._columns = Columns(layout, _wanted(layout, selection.fields))

    def verified(self, messages: Messages, offset: int) -> Bytes:
        """The messages as bytes (k, size): the next of this topic, and like those before."""
        expected = self.read if self._gapless else None
        _check_sequence(messages, expected, offset)
        data = messages.matrix(self._layout.size)
        if data is None or not self._layout.is_kept_by(data):
            raise Damage(offset, "(chunk) has messages that differ from those before")
        if self._order is not None and len(data):
            begins = self._gapless and not self.read
            self._order.check_cycles(self._columns.stamps(data), offset, begins=begins)
        return data

    def stamps(self, data: Bytes) -> NDArray[np.int64]:
        """Time stamps of messages, shape (k,) [ns]."""
        return self._columns.stamps(data)

    def append(self, data: Bytes, expected: int) -> None:
        """Append verified messages; `expected` is a guess at the final count."""
        if self._order is not None and len(data):
            self._order.take(int(self._columns.stamps(data[-1:])[0]))
        self.read += len(data)
        if self._times is not None:
            stamp = self._columns.stamps(data)
            data = data[(stamp >= self._times[0]) & (stamp < self._times[1])]
        self._columns.append(data, expected)

    def finished(self) -> dict[str, NDArray[Any]]:
        """The columns by our names."""
        columns = self._columns.finished()
        return {_COLUMN_OF.get(name, name): column for name, column in columns.items()}


def _wanted(layout: MessageLayout, fields: Collection[str] | None) -> list[str]:
    names = layout.dtype.names or ()
    return [name for name in names if fields is None or _COLUMN_OF.get(name, name) in fields]


def _check_sequence(messages: Messages, expected: int | None, offset: int) -> None:
    """Check that messages are numbered one by one, from `expected` on where it is known."""
    sequence = messages.sequence
    first = int(sequence[0]) if expected is None else expected
    wanted = np.arange(first, first + len(sequence), dtype=np.int64) & 0xFFFFFFFF
    if not np.array_equal(sequence, wanted):
        raise Damage(offset, "(chunk) does not continue the one before it: a chunk is missing")
