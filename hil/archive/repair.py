"""Makes of a torn or damaged archive one that every reader accepts.

What stands is copied record by record; message indexes and summary are made anew, and the outcome
says what is lost. Nothing is invented: what cannot be verified is left out.
"""

from __future__ import annotations

import json
import os
import shutil
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import IO, BinaryIO

import zstandard

from hil.archive import container, header, index, schema
from hil.archive.container import Record
from hil.archive.header import ArchiveOutcome
from hil.archive.index import IndexBuilder, MessageHead
from hil.archive.intact import Piece, Survey
from hil.archive.reader import open_archive
from hil.archive.rewrite import write_anew
from hil.archive.survey import HEADER, survey
from hil.errors import ArchiveError, ArchiveWriteError, NotAnArchiveError

_SEQUENCE_AT = container.RECORD.size + 2  # in a message record


@dataclass(frozen=True)
class Repair:
    """What was done to an archive.

    Attributes:
        path: the archive as it was.
        output: the repaired file, None where nothing had to be written.
        whole: whether nothing was wrong with it.
        losses: what is lost, one sentence each; empty if everything that was written is there.
        samples: samples that are there.
        samples_lost: samples that are not, None where nobody can say.
    """

    path: Path
    output: Path | None
    whole: bool
    losses: tuple[str, ...]
    samples: int
    samples_lost: int | None


def repaired_name(path: Path) -> Path:
    """What a repaired archive is called unless a name is given."""
    return path.with_name(f"{path.stem}_repaired{path.suffix}")


def repair(
    path: str | PathLike[str],
    output: str | PathLike[str] | None = None,
    *,
    in_place: bool = False,
) -> Repair:
    """Repair an archive.

    The file appears under its name only when it is complete and has been read back. One that lost
    its index alone becomes what it was, to the byte; one that is whole is copied where an output
    is named, and left alone otherwise.

    Args:
        path: the archive, which is kept unless `in_place`.
        output: the file to write, which must not exist; `repaired_name` by default.
        in_place: replace the archive by the repaired one instead.

    Raises:
        NotAnArchiveError: another kind of file, or one whose description is lost.
        ArchiveWriteError: the output exists, or the disk refuses.
        ArchiveError: it cannot be read, or nothing of it can be saved.
    """
    path = Path(path)
    found = survey(path)
    if found.header is None or found.metadata is None or not header.is_known(found.metadata):
        open_archive(path, fields=())  # says why it is none
        raise NotAnArchiveError(path, "is not an archive")
    if found.mixed:
        problem = "its begin and its end are of two recordings, and the samples of either"
        raise ArchiveError(path, problem, remedy="restore it from a copy, or record again")
    target = path.resolve() if in_place else Path(output) if output else repaired_name(path)
    if not in_place and os.path.lexists(target):
        raise ArchiveWriteError(target, "exists already", remedy="choose another name with -o")
    whole = not found.faults
    written = None
    if not whole or (output is not None and not in_place):
        _write(found, target)
        written = target
    return Repair(
        path, written, whole, tuple(found.losses), found.samples, samples_lost=_samples_lost(found)
    )


def _samples_lost(found: Survey) -> int | None:
    if not found.losses:
        return 0
    stated = None if found.outcome is None else found.outcome.samples
    return None if stated is None else max(0, stated - found.samples)


def _write(found: Survey, target: Path) -> None:
    """Write the repaired archive; one that is whole is copied to the byte."""

    def fill(stream: BinaryIO, output: IO[bytes]) -> None:
        if found.faults:
            ArchiveCopy(stream, output).write(found)
        else:
            shutil.copyfileobj(stream, output)

    write_anew(found.path, target, fill)


class ArchiveCopy:
    """Copies what stands of a survey into a new file, with the outcome of the survey."""

    def __init__(self, stream: BinaryIO, output: IO[bytes]) -> None:
        self._stream = stream
        self._output = output
        self._offset = 0
        self._index = IndexBuilder()
        self._checksums: list[int] = []
        self._decompressor = zstandard.ZstdDecompressor()
        self._compressor = zstandard.ZstdCompressor()

    def write(self, found: Survey) -> None:
        """Write the file."""
        assert found.metadata is not None
        self._put(container.MAGIC + HEADER)
        self._metadata(header.METADATA, _description(found))
        announced = False
        for piece in found.pieces:
            if piece.opcode == container.CHUNK and not announced:
                announced = True
                for record in found.definitions:
                    self._announce(record)
            self._piece(piece)
        self._metadata(header.OUTCOME, _outcome(found, self._checksums))
        self._put(self._index.tail(self._offset))

    def _put(self, data: bytes) -> None:
        self._output.write(data)
        self._offset += len(data)

    def _metadata(self, name: str, entries: Mapping[str, str]) -> None:
        data = index.metadata(name, {**entries, "checksum": header.checksum(entries)})
        self._index.add_metadata(self._offset, len(data), name)
        self._put(data)

    def _announce(self, record: Record) -> None:
        self._index.announce(record.opcode, record.body)
        self._put(index.record(record.opcode, record.body))

    def _piece(self, piece: Piece) -> None:
        record = container.record_at(self._stream, piece.offset, piece.length)
        if piece.opcode == container.CHUNK:
            self._chunk(record, piece)
        elif piece.opcode in (container.SCHEMA, container.CHANNEL):
            self._announce(record)
        else:
            if piece.opcode == container.ATTACHMENT:
                self._index.add_attachment(self._offset, record)
            else:
                name, _ = container.metadata(record)
                self._index.add_metadata(self._offset, piece.length, name)
            self._put(index.record(record.opcode, record.body))

    def _chunk(self, record: Record, piece: Piece) -> None:
        head = container.chunk(record)
        data = container.chunk_data(record, decompressor=self._decompressor)
        copy = index.record(record.opcode, record.body)
        assert piece.times is not None
        if piece.shift is not None:
            data = _renumbered(data, piece)
            copy = index.chunk(data, self._compressor.compress(data), "zstd", piece.times)
        elif piece.times != (head.start_time, head.end_time):
            copy = index.chunk(data, bytes(head.data), head.compression, piece.times)
        taken = Record(self._offset, record.opcode, copy[container.RECORD.size :], 0)
        indexes = self._index.add_chunk(self._offset, len(copy), container.chunk(taken), data)
        self._checksums.append(container.chunk(taken).crc)
        self._put(copy)
        self._put(indexes)


def _renumbered(data: bytes, piece: Piece) -> bytes:
    """The records of a chunk with its messages counting on from those that stand before it."""
    assert piece.shift is not None
    changed = bytearray(data)
    for item in index.messages(data, piece.offset):
        if isinstance(item, MessageHead):
            sequence = item.sequence - piece.shift[item.channel]
            struct.pack_into("<I", changed, item.start + _SEQUENCE_AT, sequence)
    return bytes(changed)


def _description(found: Survey) -> dict[str, str]:
    """The ``hil`` record: as it was, without the attachments that are lost."""
    assert found.metadata is not None and found.header is not None
    announced = [*found.header.attachments]
    kept = [name for name in announced if name in found.attachments]
    if kept == announced:
        return found.metadata
    return {**found.metadata, "attachments": json.dumps(kept)}


def _outcome(found: Survey, chunks: Sequence[int]) -> dict[str, str]:
    """The ``hil.outcome`` record of a file of these chunks: as it was where nothing is lost."""
    lists = {header.CHUNKS: header.listed(chunks)}
    if not found.losses and found.outcome is not None:
        record = found.outcome.record  # other chunks than before if another program cut them
        return {**record, **(lists if header.CHUNKS in record else {})}
    unknown = {"outcome": "unknown", "reason": "the outcome is lost"}
    outcome = found.outcome or ArchiveOutcome.of(unknown)
    before, lost = outcome.record, _samples_lost(found)
    known = lost is not None and outcome.samples_lost is not None
    return {
        **before,
        header.DESCRIPTION: header.checksum(_description(found)),
        **lists,
        "samples": str(found.samples),
        "events": str(found.events),
        **({"packets": str(found.counts.get(schema.PACKETS, 0))} if "packets" in before else {}),
        "repaired": "yes",
        "repaired.samples_lost": str((lost or 0) + (outcome.samples_lost or 0))
        if known
        else "unknown",
        "repaired.losses": json.dumps([*outcome.losses, *found.losses]),
    }
