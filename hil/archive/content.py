"""Collects the content of an archive record by record, and knows when something is missing.

A chunk counts whole or not at all. MCAP numbers the messages of each channel, so a chunk that
vanished (a damaged opcode makes a reader skip it) is noticed by the next one; one that vanished at
the end by the counts in the outcome.
"""

from __future__ import annotations

import json
from collections.abc import Collection
from typing import Any, BinaryIO

import numpy as np
import zstandard
from numpy.typing import NDArray

from hil.archive import container, schema
from hil.archive.cdr import LayoutError, MessageLayout, fixed_layout
from hil.archive.chunk import Bytes, ChunkParser, Messages
from hil.archive.columns import Columns
from hil.archive.container import Damage, Record
from hil.archive.events import ArchivedEvent
from hil.archive.messages import decode_log, joint_state_of

_NEEDED = ("kind", "joint_names", "attachments")
_MARGIN = 1.3  # room for chunks that are smaller than the one the count is guessed from
_COLUMN_OF = {"effort": "torque"}  # where a message has another word for it than we


class Content:
    """What has been read from a file so far.

    Args:
        fields: columns wanted, None for all.
    """

    def __init__(self, fields: Collection[str] | None = None) -> None:
        self.metadata: dict[str, str] | None = None
        self.outcome: dict[str, str] | None = None
        self.attachments: dict[str, bytes] = {}
        self.events: list[ArchivedEvent] = []
        self._fields = fields
        self._size = 0
        self._decompressor = zstandard.ZstdDecompressor()
        self._parser = ChunkParser()
        self._channels: dict[str, _Channel] = {}

    def collect(self, stream: BinaryIO, size: int) -> Damage | None:
        """Read a file up to its end or its first damage, which is returned."""
        self._size = size
        try:
            for record in container.records(stream, size):
                if record.opcode == container.CHUNK:
                    self._take_chunk(record)
                elif record.opcode == container.ATTACHMENT:
                    name, data = container.attachment(record)
                    self.attachments[name] = data
                elif record.opcode == container.METADATA:
                    self._take_metadata(record)
            self._check_counts(size)
        except Damage as damage:
            return damage
        return None

    def columns(self) -> dict[str, NDArray[Any]]:
        """The columns read, all of the same length."""
        joined: dict[str, NDArray[Any]] = {"stamp": np.zeros(0, np.int64)}
        for channel in self._channels.values():
            joined |= channel.finished()
        return joined

    def _take_metadata(self, record: Record) -> None:
        name, entries = container.metadata(record)
        if name not in (schema.METADATA, schema.OUTCOME):
            return
        claimed = entries.pop("checksum", None)
        if claimed != schema.checksum(entries):
            raise Damage(record.offset, f"(metadata {name!r}) fails its checksum")
        if name == schema.OUTCOME:
            self.outcome = entries
            return
        if entries.get("format_version") != str(schema.FORMAT_VERSION):
            self.metadata = entries
            raise Damage(record.offset, "is of another version")
        absent = [key for key in _NEEDED if key not in entries]
        if absent:
            raise Damage(record.offset, f"(metadata {name!r}) has no entry {absent[0]!r}")
        self.metadata = entries

    def _take_chunk(self, record: Record) -> None:
        if self.metadata is None:
            return  # some other MCAP file, which will be refused as such
        data = container.chunk_data(record, decompressor=self._decompressor)
        found = self._parser.messages(data, record.offset)
        recorded = {channel.topic for channel in self._parser.channels.values()}
        wanted = (
            (schema.CYCLE,) if schema.CYCLE in recorded else (schema.MEASURED, schema.MOTOR_CURRENT)
        )
        counts = {
            len(found[topic]) if topic in found else 0 for topic in wanted if topic in recorded
        }
        if len(counts) > 1:
            raise Damage(record.offset, "(chunk) has channels of different length")
        decoded = []
        for topic in wanted:
            if topic in found:
                channel = self._channel(topic, found[topic], record.offset)
                decoded.append((channel, channel.verified(found[topic], record.offset)))
        events = self._decoded_events(found.get(schema.EVENTS), record.offset)
        for channel, messages in decoded:
            channel.append(
                messages, expected=int(_MARGIN * len(messages) * self._size / len(record.body))
            )
        self.events += events

    def _channel(self, topic: str, messages: Messages, offset: int) -> _Channel:
        """The decoder of a topic, made from its schema or from its first message."""
        if topic not in self._channels:
            try:
                layout = self._layout(topic, messages)
            except LayoutError as error:
                raise Damage(offset, f"(chunk) has messages of {topic}: {error}") from error
            self._channels[topic] = _Channel(layout, self._fields)
        return self._channels[topic]

    def _layout(self, topic: str, messages: Messages) -> MessageLayout:
        if topic == schema.MEASURED:
            return joint_state_of(messages.message(0))[1]
        channels = self._parser.channels.values()
        identity = next(channel.schema_id for channel in channels if channel.topic == topic)
        if identity not in self._parser.schemas:
            raise LayoutError("their schema is missing")
        return fixed_layout(self._parser.schemas[identity].definition)

    def _decoded_events(self, messages: Messages | None, offset: int) -> list[ArchivedEvent]:
        if messages is None:
            return []
        _check_sequence(messages, len(self.events), offset)
        try:
            logs = [decode_log(messages.message(index)) for index in range(len(messages))]
        except LayoutError as error:
            raise Damage(offset, f"(chunk) has an event that cannot be read: {error}") from error
        return [ArchivedEvent.from_log(log) for log in logs]

    def _check_counts(self, size: int) -> None:
        """Compare what was read with what the writer says it wrote."""
        if self.metadata is None:
            return
        announced = set(json.loads(self.metadata["attachments"]))
        absent = sorted(announced - set(self.attachments))
        if absent:
            raise Damage(size, f"(attachment {absent[0]!r}) is missing")
        if self.outcome is None:
            raise Damage(size, f"(metadata {schema.OUTCOME!r}) is missing")
        counts = {"samples": len(self.columns()["stamp"]), "events": len(self.events)}
        for key, count in counts.items():
            if int(self.outcome[key]) != count:
                raise Damage(size, f"is missing: {self.outcome[key]} {key} were written")


class _Channel:
    """Decodes the messages of one topic into columns."""

    def __init__(self, layout: MessageLayout, fields: Collection[str] | None) -> None:
        self._layout = layout
        names = layout.dtype.names or ()
        wanted = [name for name in names if fields is None or _COLUMN_OF.get(name, name) in fields]
        self._columns = Columns(layout, wanted)

    def __len__(self) -> int:
        return len(self._columns)

    def verified(self, messages: Messages, offset: int) -> Bytes:
        """The messages as bytes (k, size): the next of this topic, and like those before."""
        _check_sequence(messages, len(self._columns), offset)
        data = messages.matrix(self._layout.size)
        if data is None or not self._layout.is_kept_by(data):
            raise Damage(offset, "(chunk) has messages that differ from those before")
        return data

    def append(self, data: Bytes, expected: int) -> None:
        """Append verified messages; `expected` is a guess at the final count."""
        self._columns.append(data, expected)

    def finished(self) -> dict[str, NDArray[Any]]:
        """The columns by our names."""
        columns = self._columns.finished()
        return {_COLUMN_OF.get(name, name): column for name, column in columns.items()}


def _check_sequence(messages: Messages, expected: int, offset: int) -> None:
    wanted = np.arange(expected, expected + len(messages), dtype=np.int64) & 0xFFFFFFFF
    if not np.array_equal(messages.sequence, wanted):
        raise Damage(offset, "(chunk) does not continue the one before it: a chunk is missing")
