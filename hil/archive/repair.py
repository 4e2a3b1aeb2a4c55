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
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import BinaryIO, NamedTuple

from mcap.records import Header

from hil.archive import container, header, schema
from hil.archive.chunk import ChunkParser, Messages
from hil.archive.container import Damage, Record, Summary
from hil.archive.header import METADATA, OUTCOME, ArchiveOutcome
from hil.archive.mcap_writer import McapWriter, entries_of, span
from hil.archive.reader import open_archive
from hil.archive.scan import NUMBERS, Expected, Scan
from hil.errors import ArchiveError, ArchiveWriteError, NotAnArchiveError
from hil.files import replacing, sync_folder
from hil.reading import opened

_ASPECTS = {
    container.METADATA: "metadata",
    container.ATTACHMENT: "attachments",
    container.CHUNK: "chunks",
}
_CONTENT = (*_ASPECTS, container.SCHEMA, container.CHANNEL)


class Fault(NamedTuple):
    """Something that is not as it must be.

    Attributes:
        aspect: part of the profile: container, metadata, attachments, chunks, sequence or outcome.
        text: what is wrong, as a sentence without its end.
        loss: whether content is lost by it; otherwise it follows from what is there.
    """

    aspect: str
    text: str
    loss: bool


Visit = Callable[["Survey", Record, Mapping[str, Messages]], None]


class Survey(Scan):
    """What can be believed of a file; message indexes and summary are not looked at.

    Args:
        path: the file.
        stream: the same, open.
        visit: called with each sound chunk.

    Attributes:
        path: the file.
        size: its length.
        written_by: profile and library, None where the record is damaged.
        pieces: sound records, but for header and outcome, in the order of the file: opcode, offset
            and length with the head.
        faults: what is wrong.
    """

    def __init__(self, path: Path, stream: BinaryIO, visit: Visit | None) -> None:
        self.path = path
        self.size = os.fstat(stream.fileno()).st_size
        self.written_by: tuple[str, str] | None = None
        self.pieces: list[tuple[int, int, int]] = []
        self.faults: list[Fault] = []
        self._visit = visit
        self._record = Record(0, 0, b"")  # the one that is examined
        self._lost_since = False
        # Found from head to head, since a chunk of another length may have come before it.
        walk = container.records(stream, self.size, only=(container.DATA_END,), check_end=False)
        try:
            end: int | None = next(walk).end
        except Damage:
            end = None
        summary = Summary.read(stream, self.size, start=end)
        super().__init__(
            Expected.read(stream, self.size, summary),
            gapless=False,
            definitions=summary.definitions if summary else (),
        )
        self._run(stream, summary)

    @property
    def losses(self) -> list[str]:
        """What is lost, and where; empty if everything that was written is there."""
        if not any(fault.loss for fault in self.faults):
            return []
        return [fault.text for fault in self.faults if fault.loss or fault.aspect == "container"]

    @property
    def mixed(self) -> bool:
        """Whether begin and end are of two recordings, and the samples of nobody knows which."""
        return self.outcome is not None and not self.outcome.belongs_to(self.header)

    @property
    def samples(self) -> int:
        """Samples that are sound."""
        return max(self.counts.get(topic, 0) for topic in NUMBERS)

    @property
    def samples_lost(self) -> int | None:
        """Samples that are not, None where nobody can say."""
        if not self.losses:
            return 0
        stated = self.outcome.samples if self.outcome else None
        return None if stated is None else max(0, stated - self.samples)

    def _run(self, stream: BinaryIO, summary: Summary | None) -> None:
        seen: set[int] = set()
        stream.seek(0)
        only = container.BUT_INDEXES
        try:
            for record in container.records(stream, self.size, only=only, check_end=False):
                seen.add(record.offset)
                self._examine(record)
        except Damage as damage:
            self._lost_since = True  # and what is lost, counts and outcome will tell
            self._fault("container", damage, loss=False)
        try:
            places = summary.places if summary else []
        except Damage:
            places = []
        for place in places:
            if place[0] not in seen:  # the walk did not get there
                seen.add(place[0])
                try:
                    self._examine(container.record_at(stream, *place))
                except Damage as damage:
                    self._fault("container", damage, loss=True)
        if self.metadata is not None:
            if self.written_by != (schema.PROFILE, schema.LIBRARY):
                self._fault("container", "the header is not that of the profile", loss=False)
            if self.mixed:
                self._fault("outcome", "the outcome is that of another recording", loss=True)
            for aspect, text in self.shortfalls():
                self._fault(aspect, text, loss=True)

    def _fault(self, aspect: str, problem: Damage | str, *, loss: bool) -> None:
        self._lost_since |= loss
        if isinstance(problem, Damage):
            problem = f"the record at byte {problem.offset} {problem.reason}"
        fault = Fault(aspect, problem, loss)
        if fault not in self.faults:
            self.faults.append(fault)

    def _examine(self, record: Record) -> None:
        self._record, ours = record, (self.metadata, self.outcome)
        try:
            if record.opcode == container.HEADER:
                head = container.parsed(Header, record)
                self.written_by = head.profile, head.library
            self.take(record)
        except Damage as damage:
            aspect = _ASPECTS.get(record.opcode, "container")
            self._fault(aspect, damage, loss=record.opcode != container.HEADER)
            return
        is_ours = ours != (self.metadata, self.outcome)
        if record.opcode in _CONTENT and not is_ours and self.metadata is not None:
            self.pieces.append((record.opcode, record.offset, record.size))

    def visit(self, found: Mapping[str, Messages], offset: int) -> None:  # noqa: ARG002
        """Have a chunk checked."""
        self._lost_since = False
        if self._visit is not None:
            self._visit(self, self._record, found)

    def missing(self, topics: Collection[str], offset: int) -> None:
        """Note that messages are missing; a gap in samples must show in the samples behind it."""
        if schema.CYCLE not in self.parser.topics and not set(NUMBERS).isdisjoint(topics):
            raise Damage(offset, "(chunk) comes after a gap that nothing would show")
        if not self._lost_since and not self.expected.repaired:
            damage = Damage(offset, "(chunk) does not continue the one before")
            self._fault("sequence", damage, loss=True)


def survey(path: str | PathLike[str], visit: Visit | None = None) -> Survey:
    """Go through a whole file, past its damages.

    Args:
        path: the file.
        visit: called with each sound chunk, with its messages by topic.

    Raises:
        ArchiveError: it cannot be read.
    """
    path = Path(path)
    try:
        with opened(path) as stream:
            return Survey(path, stream, visit)
    except OSError as error:
        raise ArchiveError(path, f"cannot be read: {error.strerror}") from error


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
        _rewrite(found, target)
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
    found = survey(path)
    if found.faults or found.metadata is None or found.outcome is None or not is_indexed(found):
        raise ArchiveError(found.path, "is not whole", remedy="repair it with `hil archive repair`")
    _rewrite(found, found.path, {"outcome": outcome, "reason": reason})


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

        _copy(found, stream, compare)
        return same and not other.read(1)


def _rewrite(found: Survey, target: Path, outcome: Mapping[str, str] | None = None) -> None:
    """Make an archive of what stands of another; `target` is at any moment what it was, or whole.

    File and folder are on the disk when this returns, and the file has the mode of its source.

    Args:
        found: what stands of it.
        target: the file to write or to replace, which may be the source.
        outcome: entries of its outcome that are to be others than before.

    Raises:
        ArchiveWriteError: the disk refuses.
        ArchiveError: what was written cannot be read back; it is thrown away.
    """
    try:
        with found.path.open("rb") as stream, replacing(target) as temporary:
            with temporary.open("xb") as output:
                os.fchmod(output.fileno(), stat.S_IMODE(os.fstat(stream.fileno()).st_mode))
                _copy(found, stream, output.write, outcome)
                output.flush()
                os.fsync(output.fileno())
            back = open_archive(temporary, fields=())
            if not back.complete:
                raise ArchiveError(
                    found.path,
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
    found: Survey,
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


def _description(found: Survey) -> dict[str, str]:
    """The ``hil`` record: as it was, without the attachments that are lost."""
    assert found.metadata is not None and found.header is not None
    names = [name for name in found.header.attachments if name in found.attachments]
    if len(names) == len(found.header.attachments):
        return found.metadata
    return {**found.metadata, "attachments": json.dumps(names)}


def _outcome(found: Survey, described: Mapping[str, str], chunks: Sequence[int]) -> dict[str, str]:
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
