"""The file under an archive being written: MCAP records, flushed so that a crash costs little."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path, PurePath

import numpy as np

from hil.archive.cdr import LogMessage, encode_log
from hil.archive.header import (
    CHUNKS,
    DESCRIPTION,
    FORMAT_VERSION,
    METADATA,
    OUTCOME,
    checksum,
    listed,
)
from hil.archive.mcap_writer import McapWriter
from hil.archive.schema import (
    EVENT_CHANNEL,
    LIBRARY,
    PROFILE,
    Batch,
    Channel,
)
from hil.errors import ArchiveWriteError

_MOST_NUMBERS = 1 << 32  # message numbers are counted modulo this
_MEDIA_TYPES = {
    ".toml": "application/toml",
    ".urdf": "application/xml",
    ".json": "application/json",
    ".csv": "text/csv",
    ".txt": "text/plain",
}


class _Sink:
    """Collects what is to be written; each flush is one write to the file."""

    def __init__(self, descriptor: int, *, durable: bool) -> None:
        self._descriptor = descriptor
        self._durable = durable
        self._parts: list[bytes] = []
        self.slowest = 0.0

    def write(self, data: bytes) -> None:
        self._parts.append(data)

    def flush(self) -> None:
        data = memoryview(b"".join(self._parts))
        self._parts.clear()
        begin = time.monotonic()
        while data:
            data = data[os.write(self._descriptor, data) :]
        if self._durable:
            os.fdatasync(self._descriptor)
        self.slowest = max(self.slowest, time.monotonic() - begin)


class ArchiveFile:
    """An MCAP file of the archive profile, open for writing.

    The file gets its final name at once; one without footer is torn and readable up to its last
    whole chunk. An existing file is never overwritten.

    Args:
        path: where to write.
        channels: the channels whose messages come in batches, one of each at every instant.
        packets: a channel for raw packets, which come as they come.
        metadata: entries of the ``hil`` metadata record.
        attachments: file name to content.
        durable: wait at each flush until the disk has the data.

    Raises:
        ArchiveWriteError: the file exists or cannot be created.
    """

    def __init__(
        self,
        path: Path,
        *,
        channels: Sequence[Channel],
        metadata: Mapping[str, str],
        attachments: Mapping[str, bytes],
        durable: bool,
        packets: Channel | None = None,
    ) -> None:
        self.path = path
        self._descriptor = _create(path)
        self._closed = False
        self._written = 0
        self._events = 0
        self._packets = 0
        self._description = ""
        self._sink = _Sink(self._descriptor, durable=durable)
        self._writer = McapWriter(self._sink.write)
        with self._guarded():
            self._start(metadata, attachments)
            if durable:  # only now: the file is empty for as short a time as possible
                sync_folder(path.parent)
            self._channels = [self._register(channel) for channel in channels]
            self._event_channel = self._register(EVENT_CHANNEL)
            self._packet_channel = None if packets is None else self._register(packets)

    @property
    def samples(self) -> int:
        """Number of instants written so far."""
        return self._written

    @property
    def events(self) -> int:
        """Number of events written so far."""
        return self._events

    @property
    def packets(self) -> int:
        """Number of raw packets written so far."""
        return self._packets

    @property
    def slowest_flush(self) -> float:
        """Longest time that the disk took for what was handed to it at once [s]."""
        return self._sink.slowest

    @property
    def closed(self) -> bool:
        """Whether the file is closed, by `finish` or by a failure of the disk."""
        return self._closed

    def add(self, batch: Batch) -> None:
        """Add a batch of messages to the chunk in progress."""
        self._add(self._channels, self._written, batch)
        self._written += len(batch.stamp)

    def add_packets(self, batch: Batch) -> None:
        """Add raw packets to the chunk in progress.

        Raises:
            ValueError: the file was opened without a channel for them.
        """
        if self._packet_channel is None:
            raise ValueError("this file has no channel for raw packets")
        self._add([self._packet_channel], self._packets, batch)
        self._packets += len(batch.stamp)

    def add_event(self, message: LogMessage) -> None:
        """Add an event to the chunk in progress."""
        with self._guarded():
            self._writer.add_message(
                self._event_channel,
                message.stamp,
                self._events % _MOST_NUMBERS,
                encode_log(message),
            )
        self._events += 1

    def flush(self) -> None:
        """End the chunk in progress and hand everything to the operating system, or the disk."""
        with self._guarded():
            self._writer.flush()
            self._sink.flush()

    def finish(self, outcome: Mapping[str, str]) -> None:
        """Write the outcome, index and footer, and close the file."""
        if self._closed:
            return
        with self._guarded():
            self._writer.flush()
            chunks = listed(self._writer.checksums)
            seals = {DESCRIPTION: self._description, CHUNKS: chunks}
            self._add_metadata(OUTCOME, {**outcome, **seals})
            self._writer.finish()
            self._sink.flush()
            self._close()  # some file systems tell only now that they did not take everything

    def _add(self, channels: Sequence[int], first: int, batch: Batch) -> None:
        numbers = (first + np.arange(len(batch.stamp))) % _MOST_NUMBERS
        with self._guarded():
            self._writer.add_rows(channels, batch.stamp, numbers, batch.messages)

    def _start(self, metadata: Mapping[str, str], attachments: Mapping[str, bytes]) -> None:
        self._writer.start(PROFILE, LIBRARY)
        own = {
            "format_version": str(FORMAT_VERSION),
            "attachments": json.dumps(sorted(attachments)),
        }
        described = {**metadata, **own}
        self._description = checksum(described)
        self._add_metadata(METADATA, described)
        for name, data in sorted(attachments.items()):
            media_type = _MEDIA_TYPES.get(PurePath(name).suffix, "application/octet-stream")
            self._writer.add_attachment(name, media_type, data)
        self._sink.flush()

    def _add_metadata(self, name: str, entries: Mapping[str, str]) -> None:
        self._writer.add_metadata(name, {**entries, "checksum": checksum(entries)})

    def _register(self, channel: Channel) -> int:
        definition = channel.definition.encode()
        return self._writer.register(
            channel.topic, "cdr", schema=channel.schema, encoding="ros2msg", definition=definition
        )

    def _guarded(self) -> _DiskGuard:
        if self._closed:
            raise ArchiveWriteError(self.path, "the archive is closed")
        return _DiskGuard(self)

    def _close(self) -> None:
        if not self._closed:
            self._closed = True
            os.close(self._descriptor)


class _DiskGuard:
    """Turns a failure of the disk into our error, and closes the file for good."""

    def __init__(self, file: ArchiveFile) -> None:
        self._file = file

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if isinstance(error, OSError):
            with suppress(OSError):
                self._file._close()
            raise ArchiveWriteError(
                self._file.path,
                f"cannot be written further: {error.strerror}",
                remedy="what was flushed before can be read; make room or mend the disk, "
                "and record again",
            ) from error


def _create(path: Path) -> int:
    try:
        return os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
    except FileExistsError as error:
        raise ArchiveWriteError(
            path, "exists already", remedy="archives are never overwritten; choose another name"
        ) from error
    except OSError as error:
        raise ArchiveWriteError(
            path,
            f"cannot be created: {error.strerror}",
            remedy="see that its folder is there and writable and its disk has room, "
            "and record again",
        ) from error


def sync_folder(folder: Path) -> None:
    """Make the name of a new file survive a power cut."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
