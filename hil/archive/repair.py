"""Repair of truncated or damaged archives.

What `hil.archive.scan` finds whole is copied, also behind damage; message indexes and summary are
regenerated, and the outcome states what is lost.
"""

from __future__ import annotations

import json
import os
import stat
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import BinaryIO

from mcap.records import Metadata

from hil.archive import container, header, schema
from hil.archive.chunk import ChunkParser
from hil.archive.header import METADATA, OUTCOME, ArchiveOutcome
from hil.archive.mcap_writer import McapWriter, entries_of, span
from hil.archive.reader import open_archive, scan_archive
from hil.archive.scan import Scan
from hil.errors import ArchiveError, ArchiveWriteError
from hil.files import replace_file, sync_folder
from hil.reading import open_file
from hil.terminal_text import typed


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
    scan = scan_archive(path, all_channels=True)[1]
    if scan.mixed:
        problem = "its beginning and its end are of two recordings, its samples of either"
        raise ArchiveError(path, problem, remedy="restore it from a copy, or record again")
    target = path.resolve() if in_place else Path(output) if output else repaired_name(path)
    if not in_place and os.path.lexists(target):
        raise ArchiveWriteError(target, "exists already", remedy="choose another name with -o")
    intact = is_intact(path, scan)
    written = None
    if not intact or (output is not None and not in_place):
        _rewrite(path, scan, target)
        written = target
    losses = tuple(scan.faults) if scan.lost else ()
    return Repair(path, written, intact, losses, scan.samples, _samples_lost(scan))


def amend_outcome(path: str | PathLike[str], outcome: str, reason: str) -> None:
    """Replace outcome and reason of an intact archive, of which always one version exists.

    Raises:
        ArchiveError: it is not an intact archive.
        ArchiveWriteError: it cannot be written; the archive is unchanged.
    """
    path = Path(path)
    scan = scan_archive(path, all_channels=True)[1]
    if not is_intact(path, scan):
        remedy = f"repair it with `hil archive repair {typed(path)}`"
        raise ArchiveError(path, "is damaged", remedy=remedy)
    _rewrite(path, scan, path, {"outcome": outcome, "reason": reason})


def is_intact(path: Path, scan: Scan) -> bool:
    """Return whether the file has no damage, and its message indexes and summary fit."""
    if scan.faults:
        return False
    with open_file(path) as stream, open_file(path) as other:
        same = True

        def compare(data: bytes) -> None:
            nonlocal same
            same = same and other.read(len(data)) == data

        _copy(scan, stream, compare)
        return same and not other.read(1)


def _rewrite(
    path: Path, scan: Scan, target: Path, outcome: Mapping[str, str] | None = None
) -> None:
    """Write the valid content of an archive to `target`, which may be the source.

    The output has the mode of its source, and is on the disk when this returns; one that cannot be
    read back is removed. `outcome` has entries of the outcome to replace.
    """
    try:
        with path.open("rb") as stream, replace_file(target) as temporary:
            with temporary.open("xb") as output:
                os.fchmod(output.fileno(), stat.S_IMODE(os.fstat(stream.fileno()).st_mode))
                _copy(scan, stream, output.write, outcome)
                output.flush()
                os.fsync(output.fileno())
            back = open_archive(temporary, fields=())
            if not back.complete:
                raise ArchiveError(
                    path,
                    f"cannot be rewritten: {back.damage}",
                    remedy="it is unchanged: restore it from a copy, or record again",
                )
        sync_folder(target.parent)
    except OSError as error:
        raise ArchiveWriteError(
            target,
            f"cannot be written: {error.strerror}",
            remedy="nothing was changed: make room or make its folder writable, and repeat",
        ) from error


def _copy(
    scan: Scan,
    stream: BinaryIO,
    write: Callable[[bytes], object],
    outcome: Mapping[str, str] | None = None,
) -> None:
    """Write the valid content of an archive as a new one."""
    writer = McapWriter(write, schema.PROFILE, schema.LIBRARY)
    parser = ChunkParser()
    described = _description(scan)
    writer.put(Metadata(METADATA, header.with_checksum(described)))
    for head in scan.heads:
        if head.opcode == container.HEADER:
            continue
        record = container.read_record(stream, head)
        if head.opcode == container.CHUNK:
            chunk = container.parse_chunk(record)
            messages = parser.messages(container.chunk_data(chunk, head.offset), head.offset)
            if not messages.keys() <= parser.channels.keys():
                for definition in scan.definitions:
                    parser.add(definition, head.offset)
                    writer.put(definition)
            for definition in parser.definitions:
                writer.note(definition)
            entries = entries_of(messages)
            first, last = span(entries)
            chunk = replace(chunk, message_start_time=first, message_end_time=last)
            writer.add_chunk(chunk, entries)
            continue
        parser.define(record)
        item = container.parse_item(record)
        if not isinstance(item, Metadata) or item.name not in (METADATA, OUTCOME):
            writer.put(item)
    stated = {**_outcome(scan, described), **(outcome or {})}
    writer.put(Metadata(OUTCOME, header.with_checksum(stated)))
    writer.finish()


def _samples_lost(scan: Scan) -> int | None:
    """Return the number of lost samples, None where unknown."""
    if not scan.lost:
        return 0
    stated = None if scan.outcome is None else scan.outcome.samples
    return None if stated is None else max(0, stated - scan.samples)


def _description(scan: Scan) -> dict[str, str]:
    """Return the ``hil`` record without the attachments that are lost."""
    assert scan.metadata is not None and scan.header is not None
    names = [name for name in scan.header.attachments if name in scan.attachments]
    if len(names) == len(scan.header.attachments):
        return scan.metadata
    return {**scan.metadata, "attachments": json.dumps(names)}


def _outcome(scan: Scan, described: Mapping[str, str]) -> dict[str, str]:
    """Return the ``hil.outcome`` record, unchanged without loss."""
    unknown = ArchiveOutcome.of({"outcome": "unknown", "reason": "the outcome is lost"})
    before = scan.outcome or unknown
    lost = _samples_lost(scan)
    if not scan.lost:
        return dict(before.record)
    earlier = before.samples_lost
    return {
        **{key: text for key, text in before.record.items() if key != header.CHUNKS},
        header.DESCRIPTION: header.checksum(described),
        "samples": str(scan.samples),
        "events": str(scan.counts.get(schema.EVENTS, 0)),
        "repaired": "yes",
        "repaired.samples_lost": (
            "unknown" if lost is None or earlier is None else str(lost + earlier)
        ),
        "repaired.losses": json.dumps([*before.losses, *scan.faults]),
    }
