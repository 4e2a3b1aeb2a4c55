"""Writing of archives: cycle records as they arrive, and imported recordings."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import pairwise
from os import PathLike
from pathlib import Path, PurePath
from typing import Any, Final, Self

import numpy as np
from mcap.writer import CompressionType, Writer
from numpy.typing import NDArray

from drivers.cycle_records import ARM_STATE
from hil.archive.cdr import Rows
from hil.archive.header import (
    DESCRIPTION,
    FORMAT_VERSION,
    KINDS,
    METADATA,
    OUTCOME,
    SEQUENCE_MODULUS,
    ArchiveName,
    checksum,
    with_checksum,
)
from hil.archive.schema import (
    COMMANDED,
    CYCLE,
    EVENTS,
    LIBRARY,
    MEASURED,
    OTHERS,
    PROFILE,
    ArchiveChannel,
    ArchivedEvent,
    Batch,
    Level,
    cycle_messages,
    description_message,
    profile,
    sample_messages,
)
from hil.archive.schema import DESCRIPTION as DESCRIPTION_TOPIC
from hil.base.arrays import Array
from hil.base.errors import ArchiveWriteError
from hil.base.files import sync_folder
from hil.base.terminal_text import with_joint_names

FLUSH_PERIOD = 0.1  # s of the controller's time in one chunk; a crash loses at most that
_SAMPLES_PER_CHUNK: Final = 1000
_UNLIMITED_CHUNK_BYTES: Final = 1 << 62  # bytes of a chunk: it ends at `flush` only
_COMPRESSION: Final = CompressionType.LZ4
"""Of chunks. With Zstandard at the only level of the library files are a fifth smaller, and take
three times as long to decompress (`python -m benchmarks.archive --sizes`)."""
_MEDIA_TYPES: Final = {
    ".toml": "application/toml",
    ".urdf": "application/xml",
    ".json": "application/json",
    ".csv": "text/csv",
    ".txt": "text/plain",
}


def mcap_writer(output: Any) -> Any:
    """Return a begun `mcap.writer.Writer` of the profile, which is not typed.

    Chunks end at its `flush` only; one without messages is not written. `output` has the methods
    ``write``, ``tell`` and ``flush`` of a binary file.
    """
    writer: Any = Writer(output, chunk_size=_UNLIMITED_CHUNK_BYTES, compression=_COMPRESSION)
    writer.start(PROFILE, LIBRARY)
    return writer


class _Pending:
    """The part of a file that is not written yet, as the output of a `Writer`.

    Its own buffer would be written again where a disk has failed, when it is closed.
    """

    def __init__(self) -> None:
        self._parts: list[bytes] = []
        self._end = 0

    def write(self, data: bytes) -> None:
        self._parts.append(data)
        self._end += len(data)

    def tell(self) -> int:
        """Return the size of the file with this part."""
        return self._end

    def flush(self) -> None:
        """Do nothing: `ArchiveFile` writes whole chunks, each by one call."""

    def take(self) -> bytes:
        """Return the part, and forget it."""
        data = b"".join(self._parts)
        self._parts.clear()
        return data


class ArchiveFile:
    """An MCAP file of the archive profile, open for writing.

    It has its final name from the start; without footer it is truncated, and readable up to its
    last complete chunk. An existing file is never overwritten.

    Args:
        metadata: entries of the ``hil`` record. Kind, index and attempt are read from the file name
            where it is an `ArchiveName`; otherwise ``kind``, one of `KINDS`, is required.
        period: cycle time [s], None where it is not fixed.
        attachments: content by file name; viewers get a ``robot.urdf`` as a message as well.
        durable: wait at each flush until the data are on the disk.

    Attributes:
        counts: messages written so far, by topic.
        slowest_flush: longest time that the disk took for one flush [s].
        closed: whether the file is closed, by `finish` or by a failure of the disk.

    Raises:
        ArchiveWriteError: the file exists or cannot be created, or the metadata are invalid.
    """

    def __init__(
        self,
        path: Path,
        *,
        joint_names: Sequence[str],
        topics: Sequence[str],
        metadata: Mapping[str, str],
        period: float | None,
        attachments: Mapping[str, bytes],
        durable: bool,
    ) -> None:
        entries = described(
            path,
            joint_names=joint_names,
            metadata=metadata,
            period=period,
            attachments=attachments,
        )
        self._description_message = description_message(attachments.get("robot.urdf", b""))
        by_topic = profile(len(joint_names))
        shown = [] if self._description_message is None else [DESCRIPTION_TOPIC]
        channels = [by_topic[topic] for topic in (*topics, *shown)]
        self.counts = {channel.topic: 0 for channel in channels}
        self.slowest_flush = 0.0
        self.closed = False
        self._path = path
        self._durable = durable
        self._description = checksum(entries)
        self._descriptor = _create(path)
        self._pending = _Pending()
        self._writer = mcap_writer(self._pending)
        with self._guarded():
            self._writer.add_metadata(METADATA, with_checksum(entries))
            for name, data in sorted(attachments.items()):
                media_type = _MEDIA_TYPES.get(PurePath(name).suffix, "application/octet-stream")
                self._writer.add_attachment(0, 0, name, media_type, data)
            self._write()
            if durable:  # at last, so that the file is empty for as short a time as possible
                sync_folder(path.parent)
        self._numbers = {channel.topic: self._registered(channel) for channel in channels}

    def _registered(self, channel: ArchiveChannel) -> int:
        """Define a channel and the schema of its messages; return the channel's number."""
        definition = channel.definition.encode()
        number = self._writer.register_schema(channel.schema, "ros2msg", definition)
        return int(self._writer.register_channel(channel.topic, "cdr", number))

    def add(self, batch: Batch) -> None:
        """Add messages of several channels to the chunk in progress, one of each at each stamp."""
        topics = [*batch.messages]
        numbers = (self.counts[topics[0]] + np.arange(len(batch.stamp))) % SEQUENCE_MODULUS
        stamps = batch.stamp.tolist()
        channels = [self._numbers[topic] for topic in topics]
        messages = [rows.view(f"V{rows.itemsize}").tolist() for rows in batch.messages.values()]
        with self._guarded():
            if stamps and self._description_message is not None:
                self._add_message(DESCRIPTION_TOPIC, stamps[0], self._description_message)
                self._description_message = None
            add_message = self._writer.add_message
            for stamp, number, *data in zip(stamps, numbers.tolist(), *messages, strict=True):
                for channel, message in zip(channels, data, strict=True):
                    add_message(channel, stamp, message, stamp, number)
        for topic in topics:
            self.counts[topic] += len(stamps)

    def add_event(self, event: ArchivedEvent) -> None:
        """Add an event to the chunk in progress."""
        with self._guarded():
            self._add_message(EVENTS, event.stamp, event.encode())

    def _add_message(self, topic: str, stamp: int, data: bytes) -> None:
        number = self.counts[topic] % SEQUENCE_MODULUS
        self._writer.add_message(self._numbers[topic], stamp, data, stamp, number)
        self.counts[topic] += 1

    def flush(self) -> None:
        """End the chunk in progress and write everything to the file."""
        with self._guarded():
            self._writer.flush()
            self._write()

    def finish(self, outcome: Mapping[str, str]) -> None:
        """Write the outcome, index and footer, and close the file."""
        if self.closed:
            return
        with self._guarded():
            self._writer.flush()
            stated = {**outcome, DESCRIPTION: self._description}
            self._writer.add_metadata(OUTCOME, with_checksum(stated))
            self._writer.finish()
            self._write()
            self._close()  # some file systems report only here that the disk is full

    def _write(self) -> None:
        data = memoryview(self._pending.take())
        begin = time.monotonic()
        while data:
            data = data[os.write(self._descriptor, data) :]
        if self._durable:
            os.fdatasync(self._descriptor)
        self.slowest_flush = max(self.slowest_flush, time.monotonic() - begin)

    @contextmanager
    def _guarded(self) -> Iterator[None]:
        """Convert a failure of the disk into `ArchiveWriteError`, and close the file."""
        if self.closed:
            raise ArchiveWriteError(self._path, "the archive is closed")
        try:
            yield
        except OSError as error:
            with suppress(OSError):
                self._close()
            raise ArchiveWriteError(
                self._path,
                f"cannot be written any more: {error.strerror}",
                remedy="what was flushed before can be read; make room or repair the disk, "
                "and record again",
            ) from error

    def _close(self) -> None:
        if not self.closed:
            self.closed = True
            os.close(self._descriptor)


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
            remedy="make sure that its folder exists, is writable and has room, and record again",
        ) from error


def described(
    path: Path,
    *,
    joint_names: Sequence[str],
    metadata: Mapping[str, str],
    period: float | None,
    attachments: Mapping[str, bytes],
) -> dict[str, str]:
    """Return the entries of the ``hil`` record of an archive.

    Args:
        path: of the archive.
        joint_names: as of `ArchiveFile`.
        metadata: likewise.
        period: likewise [s].
        attachments: likewise.

    Raises:
        ArchiveWriteError: the metadata are invalid.
    """
    entries = _checked_metadata(path, metadata) | {"joint_names": json.dumps([*joint_names])}
    if period is not None:
        entries["period"] = json.dumps(period)
    entries["format_version"] = str(FORMAT_VERSION)
    entries["attachments"] = json.dumps(sorted(attachments))
    return entries


def _checked_metadata(path: Path, metadata: Mapping[str, str]) -> dict[str, str]:
    """Return the caller's entries with the entries of the file name, which must agree."""
    name = ArchiveName.parse(path)
    named = name.metadata() if name else {}
    entries = {**named, **{key: str(value) for key, value in metadata.items()}}
    for key, value in named.items():
        if entries[key] != value:
            raise ArchiveWriteError(
                path, f"{key} is {entries[key]!r}, but {value!r} in the file name", field=key
            )
    if entries.get("kind") not in KINDS:
        raise ArchiveWriteError(
            path,
            f"{entries.get('kind')!r} is not a kind of archive",
            field="kind",
            remedy=f"use {', '.join(KINDS)}",
        )
    return entries


class ArchiveWriter:
    """An archive that is being recorded.

    Chunks end at fixed cycles, every 100 ms of the controller's time: the same records give the
    same bytes however they are divided into calls. A killed process loses what follows the last
    complete chunk. As a context manager it closes the archive with outcome ``interrupted`` on an
    exception, else ``unknown`` if no outcome was given.

    Args:
        path: the file, which must not exist.
        joint_names: joints in the order of the records' columns.
        period: cycle time of the controller [s].
        metadata: see `ArchiveFile`. Times of day only if a real arm moves.
        states: topics (`hil.archive.schema.STATE_TOPICS`) of the arm's state in each record.
        attachments: ``cell.toml``, ``robot.urdf``, ``drive_train.json``, ``plan.json`` by name.
        durable: wait at each flush until the data are on the disk.

    Attributes:
        file: counts of messages, time of the slowest flush, and whether it is closed.
        newest: the last cycle added, -1 before the first.
        missed: packets lost by the link, by the records.

    Raises:
        ArchiveWriteError: the file exists or cannot be written, or the metadata are invalid.
    """

    def __init__(
        self,
        path: str | PathLike[str],
        *,
        joint_names: Sequence[str],
        period: float,
        metadata: Mapping[str, str],
        attachments: Mapping[str, bytes] | None = None,
        durable: bool = True,
        states: Sequence[str] = (),
    ) -> None:
        self.path = Path(path)
        self.period = period
        self._joint_names = tuple(joint_names)
        self._cycles_per_chunk = max(1, round(FLUSH_PERIOD / period))
        self._pending: list[tuple[Rows, Array]] = []
        self._states = tuple(states)
        self._first: int | None = None
        self.newest = -1
        self.missed = 0
        self.file = ArchiveFile(
            self.path,
            joint_names=joint_names,
            topics=(CYCLE, MEASURED, COMMANDED, *self._states, EVENTS),
            metadata=metadata,
            period=period,
            attachments=attachments or {},
            durable=durable,
        )

    @property
    def chunk_ends_in(self) -> float:
        """Time of the controller until the chunk in progress is complete and written [s]."""
        begun = 0 if self._first is None else self.newest + 1 - self._first
        return (self._cycles_per_chunk - begun % self._cycles_per_chunk) * self.period

    def write(self, records: Rows, torque: Array | None = None) -> None:
        """Append cycle records.

        Args:
            records: (k,), of type `drivers.cycle_dtype`; referenced until their chunk is written,
                so pass a copy. Batches of some 100 cycles are most efficient.
            torque: joint torque of each record, (k, n) [N·m]; None where unknown.

        Raises:
            ArchiveWriteError: the disk fails, the archive is closed, or the cycles do not increase,
                in which case none of these records is written.
        """
        if self.file.closed:
            raise ArchiveWriteError(self.path, "the archive is closed")
        if not len(records):
            return
        unknown = np.full((len(records), len(self._joint_names)), np.nan)
        torques = unknown if torque is None else np.asarray(torque, np.float64)
        if not records["position"].shape == torques.shape == unknown.shape:
            raise ValueError(f"records and torques of {unknown.shape} are expected")
        if self._states and ARM_STATE not in (records.dtype.names or ()):
            raise ValueError(f"records without the state of {self._states[0]}")
        cycles = records["cycle"]
        self._check_growth(cycles)
        if self._first is None:
            self._first = int(cycles[0])
        self.newest = int(cycles[-1])
        self.missed += int(records["gap"].sum())
        self._pending.append((records, torques))
        oldest = int(self._pending[0][0]["cycle"][0])
        if self._slot(oldest) != self._slot(self.newest + 1):
            self._emit(everything=False)

    def _check_growth(self, cycles: NDArray[np.int64]) -> None:
        before = int(cycles[0]) - 1 if self._first is None else self.newest
        falling = np.flatnonzero(np.diff(cycles, prepend=before) <= 0)
        if not falling.size:
            return
        at = int(falling[0])
        last = int(cycles[at - 1]) if at else before
        raise ArchiveWriteError(
            self.path,
            f"cycle {int(cycles[at])} follows cycle {last}: the cycles of an archive increase",
            field="cycle",
            remedy="begin another archive for another session with the controller",
        )

    def event(
        self,
        cycle: int | None,
        name: str,
        text: str,
        *,
        level: Level = Level.INFO,
        data: Mapping[str, Any] | None = None,
    ) -> None:
        """Add an event; it is flushed with the cycles that follow.

        Args:
            cycle: of the controller in which it happened, None for the newest one written.
            name: of the event.
            text: one line, in which numbers of joints become their names.
            level: of the event.
            data: JSON values.
        """
        text = with_joint_names(text, self._joint_names)
        time = (self.newest if cycle is None else cycle) * self.period
        self.file.add_event(ArchivedEvent(time, name, text, level, data or {}))

    def flush(self) -> None:
        """Write all pending records, including an incomplete chunk."""
        self._emit(everything=True)
        self.file.flush()

    def close(
        self, outcome: str, *, reason: str = "", details: Mapping[str, str] | None = None
    ) -> None:
        """Write the outcome, such as ``completed``, and close the archive.

        `details` are further entries of the ``hil.outcome`` record.
        """
        if self.file.closed:
            return
        reason = with_joint_names(reason, self._joint_names)
        self._emit(everything=True)
        counts = self.file.counts
        cycles = {
            "samples": counts[CYCLE],
            "events": counts[EVENTS],
            "lost_packets": self.missed,
        }
        if self._first is not None:
            cycles |= {"first_cycle": self._first, "last_cycle": self.newest}
        texts = {key: str(value) for key, value in cycles.items()}
        self.file.finish({**(details or {}), "outcome": outcome, "reason": reason, **texts})

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if error is None:
            self.close("unknown", reason="the recording ended without an outcome")
        else:
            self.close("interrupted", reason=f"{type(error).__name__}: {error}")

    def _slot(self, cycle: int) -> int:
        """Return the number of the chunk that a cycle belongs to."""
        return (cycle - (self._first or 0)) // self._cycles_per_chunk

    def _emit(self, *, everything: bool) -> None:
        """Write the pending records slot by slot; the open slot only if `everything`."""
        if not self._pending:
            return
        records = np.concatenate([part for part, _ in self._pending])
        torque = np.concatenate([part for _, part in self._pending])
        slots = (records["cycle"] - (self._first or 0)) // self._cycles_per_chunk
        cuts = [0, *(np.flatnonzero(np.diff(slots)) + 1).tolist(), len(records)]
        if not everything and self._slot(self.newest + 1) == slots[-1]:
            cuts.pop()
        for start, stop in pairwise(cuts):
            part = records[start:stop]
            states = dict.fromkeys(self._states, part[ARM_STATE]) if self._states else {}
            batch = cycle_messages(self._joint_names, self.period, part, torque[start:stop], states)
            self.file.add(batch)
            self.file.flush()
        written = cuts[-1]
        remains = written < len(records)
        self._pending = [(records[written:], torque[written:])] if remains else []


@dataclass(frozen=True, eq=False)
class ImportedSamples:
    """A recording to be imported, m samples of n joints, joint side in SI units.

    Attributes:
        stamp: (m,) nanoseconds, on any clock.
        position: (m, n) [rad].
        velocity: (m, n) [rad/s], None where not recorded.
        torque: (m, n) [N·m], None where not recorded.
        motor_current: (m, n) [A], motor side, None where not recorded.
        commanded_position: (m, n) [rad], None where not recorded.
    """

    stamp: NDArray[np.int64]
    position: Array
    velocity: Array | None = None
    torque: Array | None = None
    motor_current: Array | None = None
    commanded_position: Array | None = None


def require_storable(path: Path, samples: ImportedSamples) -> None:
    """Raise ArchiveWriteError if a stamp cannot be stored."""
    stamp = samples.stamp
    if stamp.size and not 0 <= stamp.min() <= stamp.max() < 2**31 * 10**9:
        raise ArchiveWriteError(
            path, "a stamp is outside 0 .. 2^31 s", remedy="shift the recording's clock"
        )


def write_samples(
    path: str | PathLike[str],
    samples: ImportedSamples,
    *,
    joint_names: Sequence[str],
    metadata: Mapping[str, str],
    attachments: Mapping[str, bytes] | None = None,
    period: float | None = None,
    durable: bool = True,
) -> Path:
    """Write a recording as an archive of kind ``imported``; see `ArchiveWriter`.

    Args:
        path: of the archive.
        samples: of the recording.
        joint_names: in their order.
        metadata: of the archive.
        attachments: files in it, by name.
        period: step of a recording at a fixed rate [s].
        durable: wait for the disk.

    Raises:
        ArchiveWriteError: the file exists or cannot be written, or a stamp cannot be stored.
    """
    path = Path(path)
    require_storable(path, samples)
    stamp = samples.stamp
    recorded = {
        "position": samples.position, "velocity": samples.velocity, "effort": samples.torque
    }  # fmt: skip
    states = {name: values for name, values in recorded.items() if values is not None}
    channels = {name: getattr(samples, name) for name in OTHERS}
    others = {name: values for name, values in channels.items() if values is not None}
    file = ArchiveFile(
        path,
        joint_names=joint_names,
        topics=(MEASURED, *(OTHERS[name] for name in others), EVENTS),
        metadata={**metadata, "kind": "imported"},
        period=period,
        attachments=attachments or {},
        durable=durable,
    )
    for start in range(0, len(stamp), _SAMPLES_PER_CHUNK):
        part = slice(start, start + _SAMPLES_PER_CHUNK)
        values = {name: column[part] for name, column in states.items()}
        rows = {name: column[part] for name, column in others.items()}
        file.add(sample_messages(joint_names, stamp[part], values, rows))
        file.flush()
    file.finish({"outcome": "completed", "samples": str(len(stamp)), "events": "0"})
    return path
