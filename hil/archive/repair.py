"""Says what of a torn or damaged archive can be believed, and makes of it one for every reader.

The reader stops at the first damage; a survey goes on, so that what follows can be saved. What is
believed has passed the same checks (`hil.archive.scan`) and is copied record by record; message
indexes and summary are made anew, and the outcome says what is lost. Nothing is invented: what
cannot be verified is left out.
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
from hil.archive.chunk import ChunkParser, Messages
from hil.archive.header import METADATA, OUTCOME, ArchiveOutcome
from hil.archive.mcap_writer import McapWriter, entries_of, span
from hil.archive.reader import open_archive, refusal
from hil.archive.scan import Scan
from hil.errors import ArchiveError, ArchiveWriteError, NotAnArchiveError
from hil.files import replace_file, sync_folder
from hil.reading import open_file

Visit = Callable[[Scan, Mapping[str, Messages], int], None]


def survey(path: Path, visit: Visit = lambda *_: None) -> Scan:
    """Go through a whole file, past its damages.

    Args:
        path: the file.
        visit: called with each sound chunk, with its messages by topic and its offset.

    Raises:
        ArchiveError: it cannot be read.
    """
    try:
        with open_file(path) as stream:
            return Scan(stream, visit, past_damage=True)
    except OSError as error:
        raise refusal(path, error) from error


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
    whole = not found.faults and is_indexed(path, found)
    written = None
    if not whole or (output is not None and not in_place):
        _rewrite(path, found, target)
        written = target
    return Repair(path, written, whole, tuple(found.losses), found.samples, found.samples_lost)


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
    if found.faults or found.header is None or found.outcome is None or not is_indexed(path, found):
        raise ArchiveError(path, "is not whole", remedy="repair it with `hil archive repair`")
    _rewrite(path, found, path, {"outcome": outcome, "reason": reason})


def is_indexed(path: Path, found: Scan) -> bool:
    """Whether message indexes, summary and all else that follows from a sound content fit it.

    Args:
        path: the file.
        found: what is in it, without a fault.
    """
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
    """Make an archive of what is sound of another; `target` is always what it was, or whole.

    File and folder are on the disk when this returns, and the file has the mode of its source.

    Args:
        path: the source.
        found: what is sound of it.
        target: the file to write or to replace, which may be the source.
        outcome: entries of its outcome that are to be others than before.

    Raises:
        ArchiveWriteError: the disk refuses.
        ArchiveError: what was written cannot be read back; it is thrown away.
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
                    f"cannot be written anew: {back.damage}",
                    remedy="it is as it was, and what opens of it can be read: restore it from a "
                    "copy, or record again",
                )
        sync_folder(target.parent)
    except OSError as error:
        raise ArchiveWriteError(
            target,
            f"cannot be written: {error.strerror}",
            remedy="what was there is as it was: make room or make its folder writable, "
            "and do it again",
        ) from error


def _copy(
    found: Scan,
    stream: BinaryIO,
    write: Callable[[bytes], object],
    outcome: Mapping[str, str] | None = None,
) -> None:
    """Write what is sound of an archive as a new one."""
    writer, parser = McapWriter(write, schema.PROFILE, schema.LIBRARY), ChunkParser()
    described = _description(found)
    writer.add_metadata(METADATA, header.sealed(described))
    for opcode, *place in found.pieces:
        record = container.record_at(stream, *place)
        if opcode != container.CHUNK:
            parser.define(record)
            writer.put(record.data)
            continue
        head = container.chunk(record)
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
    writer.add_metadata(OUTCOME, header.sealed({**stated, **(outcome or {})}))
    writer.finish()


def _description(found: Scan) -> dict[str, str]:
    """The ``hil`` record: as it was, without the attachments that are lost."""
    assert found.metadata is not None and found.header is not None
    names = [name for name in found.header.attachments if name in found.attachments]
    if len(names) == len(found.header.attachments):
        return found.metadata
    return {**found.metadata, "attachments": json.dumps(names)}


def _outcome(found: Scan, described: Mapping[str, str], chunks: Sequence[int]) -> dict[str, str]:
    """The ``hil.outcome`` record of a file of these chunks: as it was where nothing is lost."""
    chunk_list = {header.CHUNKS: header.chunk_list(chunks)}
    if not found.losses and found.outcome is not None:
        record = found.outcome.record  # other chunks than before if another program cut them
        return {**record, **(chunk_list if header.CHUNKS in record else {})}
    unknown = {"outcome": "unknown", "reason": "the outcome is lost"}
    before = found.outcome or ArchiveOutcome.of(unknown)
    lost, earlier = found.samples_lost, before.samples_lost
    packets = str(found.counts.get(schema.PACKETS, 0))
    return {
        **before.record,
        header.DESCRIPTION: header.checksum(described),
        **chunk_list,
        "samples": str(found.samples),
        "events": str(found.counts.get(schema.EVENTS, 0)),
        **({"packets": packets} if "packets" in before.record else {}),
        "repaired": "yes",
        "repaired.samples_lost": (
            "unknown" if lost is None or earlier is None else str(lost + earlier)
        ),
        "repaired.losses": json.dumps([*before.losses, *found.losses]),
    }
