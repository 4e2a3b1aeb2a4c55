"""Repair of truncated or damaged archives.

What `hil.archive.scan` finds whole is written again, also behind damage, message by message by the
writer of archives; the outcome states what is lost.
"""

from __future__ import annotations

import json
import os
import stat
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any, BinaryIO, Final

from mcap.records import Attachment, Header, Metadata

from hil.archive import header, schema, verified_records
from hil.archive.chunk_messages import ChunkParser
from hil.archive.header import METADATA, OUTCOME, ArchiveOutcome
from hil.archive.index import FileIndex, span
from hil.archive.reader import open_archive, scan_archive
from hil.archive.scan import Scan
from hil.archive.writer import mcap_writer
from hil.base.errors import ArchiveError, ArchiveWriteError
from hil.base.files import replace_file, sync_folder
from hil.base.safe_input import open_file
from hil.base.terminal_text import typed

_MESSAGE: Final = struct.Struct("<HIQQ")
"""Channel, sequence, log time and publish time in front of the data of a message."""


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
    complete and has been read back. An intact one is copied where an output is named.

    Raises:
        NotAnArchiveError: another kind of file, or its header is lost.
        ArchiveWriteError: the output exists or cannot be written.
        ArchiveError: it cannot be read, or nothing of it can be saved.
    """
    path = Path(path)
    scan = scan_archive(path, all_channels=True)[1]
    if scan.mixed:
        problem = "its beginning and its end are from different recordings, its samples from either"
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
    """Replace outcome and reason of an intact archive; one version exists at all times.

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
    begin = verified_records.MAGIC + verified_records.encode(Header(schema.PROFILE, schema.LIBRARY))
    index = FileIndex()
    parser = ChunkParser()
    with open_file(path) as stream:
        if stream.read(len(begin)) != begin:
            return False
        position = len(begin)
        for head in scan.heads[1:]:
            if head.offset != position or head.opcode == verified_records.HEADER:
                return False
            record = verified_records.read_record(stream, head)
            position = head.end
            if head.opcode != verified_records.CHUNK:
                parser.define(record)
                index.add(verified_records.parse_item(record), head.offset, head.end - head.offset)
                continue
            chunk = verified_records.parse_chunk(record)
            messages = parser.messages(verified_records.chunk_data(chunk, head.offset), head.offset)
            for definition in parser.definitions:
                index.define(definition)
            indexes = index.add_chunk(chunk, messages, head.offset, head.end - head.offset)
            times = (chunk.message_start_time, chunk.message_end_time)
            if times != span(messages) or stream.read(len(indexes)) != indexes:
                return False
            position += len(indexes)
        stream.seek(position)
        end = index.ended(position)
        return stream.read(len(end) + 1) == end


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
                _copy(scan, stream, output, outcome)
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
    scan: Scan, stream: BinaryIO, output: BinaryIO, outcome: Mapping[str, str] | None = None
) -> None:
    """Write the valid content of an archive as a new one, its chunks and their order as before."""
    writer = mcap_writer(output)
    described = _description(scan)
    writer.add_metadata(METADATA, header.with_checksum(described))
    channels = _registered(writer, scan.parser)
    for head in scan.heads:
        if head.opcode == verified_records.HEADER:
            continue
        record = verified_records.read_record(stream, head)
        if head.opcode == verified_records.CHUNK:
            data = verified_records.chunk_data(verified_records.parse_chunk(record), head.offset)
            for item in verified_records.split_records(data, head.offset):
                if item.opcode == verified_records.MESSAGE:
                    number, sequence, log_time, publish_time = _MESSAGE.unpack_from(item.body)
                    message = item.body[_MESSAGE.size :]
                    channel = channels[number]
                    writer.add_message(channel, log_time, message, publish_time, sequence)
            writer.flush()
            continue
        content = verified_records.parse_item(record)
        if isinstance(content, Attachment):
            writer.add_attachment(
                content.create_time,
                content.log_time,
                content.name,
                content.media_type,
                content.data,
            )
        elif isinstance(content, Metadata) and content.name not in (METADATA, OUTCOME):
            writer.add_metadata(content.name, content.metadata)
    stated = {**_outcome(scan, described), **(outcome or {})}
    writer.add_metadata(OUTCOME, header.with_checksum(stated))
    writer.finish()


def _registered(writer: Any, parser: ChunkParser) -> dict[int, int]:
    """Define the channels of an archive; return their new numbers by the numbers in the archive."""
    schemas: dict[int, int] = {}
    channels: dict[int, int] = {}
    for channel in parser.channels.values():
        definition = parser.schemas.get(channel.schema_id)
        if definition is not None and definition.id not in schemas:
            schemas[definition.id] = writer.register_schema(
                definition.name, definition.encoding, definition.data
            )
        schema_number = schemas.get(channel.schema_id, 0)
        channels[channel.id] = writer.register_channel(
            channel.topic, channel.message_encoding, schema_number, channel.metadata
        )
    return channels


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
