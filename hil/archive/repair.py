"""Makes of a torn or damaged archive one that every reader accepts.

What stands is copied record by record; message indexes and summary are made anew, and the outcome
says what is lost. Nothing is invented: what cannot be verified is left out.
"""

from __future__ import annotations

import contextlib
import json
import os
import stat
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from os import PathLike
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import IO, BinaryIO

import zstandard
from mcap.records import Chunk

from hil.archive import container, header, schema
from hil.archive.chunk import ChunkParser
from hil.archive.container import Record
from hil.archive.header import ArchiveOutcome
from hil.archive.mcap_writer import Entries, McapWriter, entries_of, span
from hil.archive.reader import open_archive
from hil.archive.survey import Survey, survey
from hil.archive.writer import sync_folder
from hil.errors import ArchiveError, ArchiveWriteError, NotAnArchiveError
from hil.reading import opened

Write = Callable[[bytes], object]
_NAMED = 40  # characters that the temporary file takes over of the name


def write_anew(source: Path, target: Path, fill: Callable[[BinaryIO, Write], None]) -> None:
    """Make an archive of another one; `target` is at any moment what it was, or whole.

    File and folder are on the disk when this returns, and the file has the mode of its source.

    Args:
        source: the archive to make it of.
        target: the file to write or to replace, which may be the source.
        fill: writes the content, given the source and what takes the bytes of the new file.

    Raises:
        ArchiveWriteError: the disk refuses.
        ArchiveError: what was written cannot be read back; it is thrown away.
    """
    try:
        with source.open("rb") as stream, _beside(target) as output:
            os.fchmod(output.fileno(), stat.S_IMODE(os.fstat(stream.fileno()).st_mode))
            fill(stream, output.write)
            output.flush()
            os.fsync(output.fileno())
            back = open_archive(output.name, fields=())
            if not back.complete:
                raise ArchiveError(
                    source,
                    f"cannot be written anew: {back.damage}",
                    remedy="it is as it was, and what opens of it can be read: restore it from a "
                    "copy, or record again",
                )
            Path(output.name).replace(target)
        sync_folder(target.parent)
    except OSError as error:
        raise ArchiveWriteError(
            target,
            f"cannot be written: {error.strerror}",
            remedy="what was there is as it was: make room or make its folder writable, "
            "and do it again",
        ) from error


@contextlib.contextmanager
def _beside(target: Path) -> Iterator[IO[bytes]]:
    """A new file in the folder of another, of a name that nobody else has or can foresee."""
    with NamedTemporaryFile(
        dir=target.parent, prefix=f".{target.name[:_NAMED]}.", suffix=".part", delete=False
    ) as output:
        try:
            yield output
        finally:
            with contextlib.suppress(FileNotFoundError):
                Path(output.name).unlink()


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
        path: the archive, which stays as it is unless `in_place`.
        output: the file to write, which must not exist; `repaired_name` by default.
        in_place: replace the archive by the repaired one instead.

    Raises:
        NotAnArchiveError: another kind of file, or one whose description is lost.
        ArchiveWriteError: the output exists, or the disk refuses.
        ArchiveError: it cannot be read, or nothing of it can be saved.
    """
    path = Path(path)
    found = survey(path)
    if found.header is None:
        open_archive(path, fields=())  # says why it is none
        raise NotAnArchiveError(path, "is not an archive")
    if found.mixed:
        problem = "its begin and its end are of two recordings, and the samples of either"
        raise ArchiveError(path, problem, remedy="restore it from a copy, or record again")
    target = path.resolve() if in_place else Path(output) if output else repaired_name(path)
    if not in_place and os.path.lexists(target):
        raise ArchiveWriteError(target, "exists already", remedy="choose another name with -o")
    whole = not found.faults and is_indexed(found)
    written = None
    if not whole or (output is not None and not in_place):
        write_anew(path, target, partial(copy_of, found))
        written = target
    return Repair(
        path, written, whole, tuple(found.losses), found.samples, samples_lost=_samples_lost(found)
    )


def _samples_lost(found: Survey) -> int | None:
    if not found.losses:
        return 0
    stated = None if found.outcome is None else found.outcome.samples
    return None if stated is None else max(0, stated - found.samples)


def is_indexed(found: Survey) -> bool:
    """Whether message indexes, summary and all else that follows from a sound content fit it.

    Args:
        found: of a file whose content has no fault.
    """
    with opened(found.path) as stream, opened(found.path) as other:
        same = True

        def compare(data: bytes) -> None:
            nonlocal same
            same = same and other.read(len(data)) == data

        copy_of(found, stream, compare)
        return same and not other.read(1)


def copy_of(
    found: Survey, stream: BinaryIO, write: Write, *, outcome: Mapping[str, str] | None = None
) -> None:
    """Write what stands of an archive as a new one.

    Args:
        found: what stands of it.
        stream: the archive.
        write: takes the bytes of the new one.
        outcome: entries of its outcome that are to be others than before.
    """
    writer, parser = McapWriter(write), ChunkParser()
    described = _description(found)
    writer.start(schema.PROFILE, schema.LIBRARY)
    writer.add_metadata(header.METADATA, header.sealed(described))
    recovered = found.definitions
    for piece in found.pieces:
        record = container.record_at(stream, piece.offset, piece.size)
        if piece.opcode != container.CHUNK:
            writer.copy(record)
            continue
        for definition in recovered:
            parser.known.take(definition)
            writer.copy(definition)
        recovered = []
        chunk, entries = _chunk(record, parser)
        for known in parser.known.definitions:
            writer.note(known)
        writer.add_chunk(chunk, entries)
    stated = {**_outcome(found, writer.checksums), **(outcome or {})}
    writer.add_metadata(header.OUTCOME, header.sealed(stated))
    writer.finish()


def _chunk(record: Record, parser: ChunkParser) -> tuple[Chunk, Entries]:
    """A chunk as it stands, with the times of its messages, and their entries."""
    head = container.chunk(record)
    data = container.chunk_data(record, decompressor=zstandard.ZstdDecompressor(), head=head)
    entries = entries_of(parser.messages(data, record.offset))
    first, last = span(entries)
    return replace(head, message_start_time=first, message_end_time=last), entries


def _description(found: Survey) -> dict[str, str]:
    """The ``hil`` record: as it was, without the attachments that are lost."""
    assert found.metadata is not None and found.header is not None
    names = [*found.header.attachments]
    found_names = [name for name in names if name in found.attachments]
    if found_names == names:
        return found.metadata
    return {**found.metadata, "attachments": json.dumps(found_names)}


def _outcome(found: Survey, chunks: Sequence[int]) -> dict[str, str]:
    """The ``hil.outcome`` record of a file of these chunks: as it was where nothing is lost."""
    lists = {header.CHUNKS: header.chunk_list(chunks)}
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


def amend_outcome(path: str | PathLike[str], outcome: str, reason: str) -> None:
    """Replace outcome and reason of a whole archive; all else stays as it was written.

    The file is written anew beside its name, read back, and then takes its name: whatever
    interrupts it leaves the old or the new file.

    Args:
        path: the archive.
        outcome: how the interval is judged now, such as ``rejected``.
        reason: why, in a sentence.

    Raises:
        ArchiveError: it is no whole archive.
        ArchiveWriteError: the disk refuses; the archive is as it was.
    """
    path = Path(path)
    found = survey(path)
    if found.faults or found.metadata is None or found.outcome is None or not is_indexed(found):
        raise ArchiveError(path, "is not whole", remedy="repair it with `hil archive repair`")
    amended = {"outcome": outcome, "reason": reason}

    write_anew(path, path, partial(copy_of, found, outcome=amended))
