"""Repair of truncated or damaged archives.

What passes the checks of `hil.archive.scan` is copied, also behind a damage; message indexes and
summary are regenerated, and the outcome states what is lost.
"""

from __future__ import annotations

import json
import os
import stat
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import BinaryIO

from hil.archive import container, header, schema
from hil.archive.chunk import ChunkParser
from hil.archive.header import METADATA, OUTCOME, ArchiveOutcome
from hil.archive.mcap_writer import McapWriter, entries_of, span
from hil.archive.reader import open_archive, scan_file
from hil.archive.scan import Scan
from hil.errors import ArchiveError, ArchiveWriteError, NotAnArchiveError
from hil.files import replace_file, sync_folder
from hil.reading import open_file


@dataclass(frozen=True)
class Repair:
    """Result of a repair.

    Attributes:
        output: the repaired file, None where nothing had to be written.
        losses: one sentence each; empty if all that was written is there.
        samples, samples_lost: in the repaired file, and lost; None where unknown.
    """

    path: Path
    output: Path | None
    intact: bool
    losses: tuple[str, ...]
    samples: int
    samples_lost: int | None


def repaired_name(path: Path) -> Path:
    """Return the default file name of a repaired archive."""
    return path.with_name(f"{path.stem}_repaired{path.suffix}")


def repair(
    path: str | PathLike[str],
    output: str | PathLike[str] | None = None,
    *,
    in_place: bool = False,
) -> Repair:
    """Repair an archive; it is unchanged unless `in_place`.

    The output, by default `repaired_name`, must not exist, and gets its name only when it is
    complete and has been read back. A file that lost only its index is restored to the byte; an
    intact one is copied where an output is named.

    Raises:
        NotAnArchiveError: another kind of file, or its header is lost.
        ArchiveWriteError: the output exists or cannot be written.
        ArchiveError: it cannot be read, or nothing of it can be saved.
    """
    path = Path(path)
    found = scan_file(path, past_damage=True)
    if found.header is None:
        open_archive(path, fields=())  # raises with the reason
        raise NotAnArchiveError(path, "is not an archive")
    if found.mixed:
        problem = "its beginning and its end are of two recordings, its samples of either"
        raise ArchiveError(path, problem, remedy="restore it from a copy, or record again")
    target = path.resolve() if in_place else Path(output) if output else repaired_name(path)
    if not in_place and os.path.lexists(target):
        raise ArchiveWriteError(target, "exists already", remedy="choose another name with -o")
    intact = not found.faults and has_valid_index(path, found)
    written = None
    if not intact or (output is not None and not in_place):
        _rewrite(path, found, target)
        written = target
    return Repair(path, written, intact, tuple(found.losses), found.samples, found.samples_lost)


def amend_outcome(path: str | PathLike[str], outcome: str, reason: str) -> None:
    """Replace outcome and reason of an intact archive, of which always one version exists.

    Raises:
        ArchiveError: it is not an intact archive.
        ArchiveWriteError: it cannot be written; the archive is unchanged.
    """
    path = Path(path)
    found = scan_file(path, past_damage=True)
    if (
        found.faults
        or found.header is None
        or found.outcome is None
        or not has_valid_index(path, found)
    ):
        raise ArchiveError(path, "is damaged", remedy="repair it with `hil archive repair`")
    _rewrite(path, found, path, {"outcome": outcome, "reason": reason})


def has_valid_index(path: Path, found: Scan) -> bool:
    """Return whether message indexes and summary fit the content, which has no fault."""
    with open_file(path) as stream, open_file(path) as other:
        same = True

        def compare(data: bytes) -> None:
            nonlocal same
            same = same and other.read(len(data)) == data

        _copy(found, stream, compare)
        return same and not other.read(1)


def _rewrite(
    path: Path, found: Scan, target: Path, outcome: Mapping[str, str] | None = None
) -> None:
    """Write the valid content of an archive to `target`, which may be the source.

    The output has the mode of its source, and is on the disk when this returns; one that cannot be
    read back is removed. `outcome` has entries of the outcome to replace.
    """
    try:
        with path.open("rb") as stream, replace_file(target) as temporary:
            with temporary.open("xb") as output:
                os.fchmod(output.fileno(), stat.S_IMODE(os.fstat(stream.fileno()).st_mode))
                _copy(found, stream, output.write, outcome)
                output.flush()
                os.fsync(output.fileno())
            back = open_archive(temporary, fields=())
            if not back.complete:
                raise ArchiveError(
                    path,
                    f"cannot be rewritten: {back.damage}",
                    remedy="it is unchanged and can be read as far as it opens: restore it from a "
                    "copy, or record again",
                )
        sync_folder(target.parent)
    except OSError as error:
        raise ArchiveWriteError(
            target,
            f"cannot be written: {error.strerror}",
            remedy="nothing was changed: make room or make its folder writable, and repeat",
        ) from error


def _copy(
    found: Scan,
    stream: BinaryIO,
    write: Callable[[bytes], object],
    outcome: Mapping[str, str] | None = None,
) -> None:
    """Write the valid content of an archive as a new one."""
    writer, parser = McapWriter(write, schema.PROFILE, schema.LIBRARY), ChunkParser()
    described = _description(found)
    writer.add_metadata(METADATA, header.with_checksum(described))
    for opcode, *place in found.pieces:
        record = container.record_at(stream, *place)
        if opcode != container.CHUNK:
            parser.define(record)
            writer.put(record.data)
            continue
        head = container.parse_chunk(record)
        messages = parser.messages(container.chunk_data(head, record.offset), record.offset)
        if not messages.keys() <= parser.channels.keys():
            for definition in found.definitions:
                parser.define(definition)
                writer.put(definition.data)
        for known in parser.definitions:
            writer.note(known)
        entries = entries_of(messages)
        first, last = span(entries)
        head = replace(head, message_start_time=first, message_end_time=last)
        writer.add_chunk(head, entries)
    stated = _outcome(found, described, writer.checksums)
    writer.add_metadata(OUTCOME, header.with_checksum({**stated, **(outcome or {})}))
    writer.finish()


def _description(found: Scan) -> dict[str, str]:
    """Return the ``hil`` record without the attachments that are lost."""
    assert found.metadata is not None and found.header is not None
    names = [name for name in found.header.attachments if name in found.attachments]
    if len(names) == len(found.header.attachments):
        return found.metadata
    return {**found.metadata, "attachments": json.dumps(names)}


def _outcome(found: Scan, described: Mapping[str, str], chunks: Sequence[int]) -> dict[str, str]:
    """Return the ``hil.outcome`` record of a file with these chunks, unchanged without loss."""
    chunk_list = {header.CHUNKS: header.format_chunk_list(chunks)}
    if not found.losses and found.outcome is not None:
        record = found.outcome.record  # other chunks than before if another program cut them
        return {**record, **(chunk_list if header.CHUNKS in record else {})}
    unknown = {"outcome": "unknown", "reason": "the outcome is lost"}
    before = found.outcome or ArchiveOutcome.of(unknown)
    lost, earlier = found.samples_lost, before.samples_lost
    return {
        **before.record,
        header.DESCRIPTION: header.checksum(described),
        **chunk_list,
        "samples": str(found.samples),
        "events": str(found.counts.get(schema.EVENTS, 0)),
        "repaired": "yes",
        "repaired.samples_lost": (
            "unknown" if lost is None or earlier is None else str(lost + earlier)
        ),
        "repaired.losses": json.dumps([*before.losses, *found.losses]),
    }
