"""Message indexes and summary of an MCAP file, computed from the records that they index.

The `mcap` library writes them with the archive, but has no check of them: those in a file must be,
to the byte, what its writer makes of the records in front of them.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from typing import TypeAlias

import numpy as np
from isal.isal_zlib import crc32
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from hil.archive import verified_records
from hil.archive.chunk_messages import ChunkMessages
from hil.archive.verified_records import MAGIC, encode

_ENTRY = np.dtype([("stamp", "<u8"), ("offset", "<u8")])
_MESSAGE_INDEX = struct.Struct("<BQHI")

ByChannel: TypeAlias = Mapping[int, ChunkMessages]
"""The messages of a chunk, by channel in order of first occurrence."""


def span(messages: ByChannel) -> tuple[int, int]:
    """Return first and last stamp [ns], zeros of a chunk without messages."""
    stamps = [part.of_heads("log_time") for part in messages.values() if len(part)]
    if not stamps:
        return 0, 0
    return int(min(part.min() for part in stamps)), int(max(part.max() for part in stamps))


class FileIndex:
    """What indexes the records of a file, which are added in their order."""

    def __init__(self) -> None:
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._chunks: list[ChunkIndex] = []
        self._attachments: list[AttachmentIndex] = []
        self._metadata: list[MetadataIndex] = []
        self._counts: dict[int, int] = {}

    def add(self, item: McapRecord, offset: int, length: int) -> None:
        """Index a record other than a chunk."""
        if isinstance(item, Metadata):
            self._metadata.append(MetadataIndex(offset, length, item.name))
        elif isinstance(item, Attachment):
            times = (item.log_time, item.create_time)
            size = len(item.data)
            self._attachments.append(
                AttachmentIndex(offset, length, *times, size, item.name, item.media_type)
            )
        elif isinstance(item, Schema | Channel):
            self.define(item)

    def define(self, item: Schema | Channel) -> None:
        """List a definition, of the data section or of a chunk, once."""
        if isinstance(item, Schema):
            self._schemas.setdefault(item.id, item)
        else:
            self._channels.setdefault(item.id, item)

    def add_chunk(self, chunk: Chunk, messages: ByChannel, offset: int, length: int) -> bytes:
        """Index a chunk; return the message indexes that follow it.

        Args:
            chunk: as written.
            messages: in it, by channel.
            offset: of the chunk in the file.
            length: of the chunk.
        """
        end = offset + length
        offsets: dict[int, int] = {}
        data = b""
        for channel, part in messages.items():
            offsets[channel] = end + len(data)
            self._counts[channel] = self._counts.get(channel, 0) + len(part)
            data += _message_index(channel, part)
        first, last = span(messages)
        self._chunks.append(
            ChunkIndex(
                chunk_length=length,
                chunk_start_offset=offset,
                compression=chunk.compression,
                compressed_size=len(chunk.data),
                message_end_time=last,
                message_index_length=len(data),
                message_index_offsets=offsets,
                message_start_time=first,
                uncompressed_size=chunk.uncompressed_size,
            )
        )
        return data

    def ended(self, offset: int) -> bytes:
        """Return the end of the file, from DataEnd at `offset` on."""
        end = encode(DataEnd(0))
        start = offset + len(end)
        statistics = Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self._channels),
            channel_message_counts=self._counts,
            chunk_count=len(self._chunks),
            message_count=sum(self._counts.values()),
            message_end_time=max((chunk.message_end_time for chunk in self._chunks), default=0),
            message_start_time=min((chunk.message_start_time for chunk in self._chunks), default=0),
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )
        groups: list[tuple[int, Sequence[McapRecord]]] = [
            (verified_records.SCHEMA, [*self._schemas.values()]),
            (verified_records.CHANNEL, [*self._channels.values()]),
            (verified_records.STATISTICS, [statistics]),
            (verified_records.CHUNK_INDEX, self._chunks),
            (verified_records.ATTACHMENT_INDEX, self._attachments),
            (verified_records.METADATA_INDEX, self._metadata),
        ]
        summary = b""
        offsets = b""
        for opcode, records in groups:
            data = b"".join(map(encode, records))
            offsets += encode(SummaryOffset(opcode, start + len(summary), len(data)))
            summary += data
        # The checksum of the summary covers the footer up to the checksum itself.
        footer = encode(Footer(start, start + len(summary), 0))
        covered = (summary + offsets + footer)[: -struct.calcsize("<I")]
        return end + covered + struct.pack("<I", crc32(covered)) + MAGIC


def _message_index(channel: int, messages: ChunkMessages) -> bytes:
    entries = np.empty(len(messages), _ENTRY)
    entries["stamp"] = messages.of_heads("log_time")
    entries["offset"] = np.concatenate(messages.places)
    length = _MESSAGE_INDEX.size - verified_records.RECORD.size + entries.nbytes
    head = _MESSAGE_INDEX.pack(verified_records.MESSAGE_INDEX, length, channel, entries.nbytes)
    return head + entries.tobytes()
