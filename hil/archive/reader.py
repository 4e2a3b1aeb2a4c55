"""Opens archives: whole ones, and torn ones up to their last whole chunk."""

from __future__ import annotations

import errno
import os
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any, BinaryIO, Final

import numpy as np
from numpy.typing import NDArray

from drivers.record import cycle_dtype
from hil.archive import container
from hil.archive.cdr import Rows
from hil.archive.container import Damage
from hil.archive.content import Content
from hil.archive.description import Description, DescriptionError
from hil.archive.events import ArchivedEvent
from hil.archive.index import Summary
from hil.archive.order import Contested, Order, Written
from hil.archive.schema import CYCLE, EVENTS, FORMAT_VERSION, LATER_FIELDS, METADATA
from hil.archive.selection import Selection
from hil.archive.standing import NUMBERS
from hil.errors import ArchiveError, ArchiveVersionError, NotAnArchiveError
from hil.reading import opened

_UNREAD = frozenset((container.MESSAGE_INDEX,))
"""Records that only other programs need."""
_REMEDIES: Final = {
    errno.ENOENT: "see whether it was moved or removed",
    errno.EACCES: "make it readable for yourself",
    errno.EIO: "its disk fails: restore it from a copy",
}


@dataclass(frozen=True)
class ArchiveDamage:
    """What an archive lost.

    Attributes:
        offset: byte in the file from which nothing was read.
        reason: what is wrong there.
        bytes_dropped: bytes from there to the end of the file.
        samples: samples that could be read; None where no column was asked for.
        duration: time from the first of them to the last [s].
        outcome_missing: whether the outcome is among the losses.
    """

    offset: int
    reason: str
    bytes_dropped: int
    samples: int | None = 0
    duration: float = 0.0
    outcome_missing: bool = True

    def __str__(self) -> str:
        read = f"; {self.samples} samples ({self.duration:.6g} s) could be read"
        lost = f"the record at byte {self.offset} {self.reason}"
        lost += f" ({self.bytes_dropped} bytes from there on are unused)"
        outcome = "; the outcome is missing" if self.outcome_missing else ""
        return f"{lost}{'' if self.samples is None else read}{outcome}"


@dataclass(frozen=True, eq=False)
class Archive:
    """What an archive holds.

    Attributes:
        path: the file.
        metadata: entries of the ``hil`` record.
        outcome: entries of the ``hil.outcome`` record, None when it is missing.
        attachments: content by file name.
        joint_names: joints in the order of the columns.
        columns: contiguous read-only arrays (m,) or (m, n) by name: the fields of the cycle
            message, or ``position``, ``velocity``, ``torque`` and ``motor_current`` of an imported
            recording as far as it has them; and ``stamp`` (m,), nanoseconds.
        events: what happened, in the order of writing.
        damage: what was lost, None when nothing was.
    """

    path: Path
    metadata: Mapping[str, str]
    outcome: Mapping[str, str] | None
    attachments: Mapping[str, bytes]
    joint_names: tuple[str, ...]
    columns: Mapping[str, NDArray[Any]]
    events: tuple[ArchivedEvent, ...]
    damage: ArchiveDamage | None

    @property
    def complete(self) -> bool:
        """Whether the archive is whole: it was closed, and all its content passed its checks."""
        return self.damage is None

    @property
    def missing(self) -> str | None:
        """What is missing, as a sentence; None when the archive is complete."""
        return None if self.damage is None else f"{self.path}: {self.damage}"

    @property
    def kind(self) -> str:
        """Why the arm moved, one of `hil.archive.KINDS`."""
        return self.metadata["kind"]

    @property
    def period(self) -> float | None:
        """Cycle time [s]; None for an imported recording without a fixed one."""
        text = self.metadata.get("period")
        return None if text is None else float(text)

    @property
    def n_samples(self) -> int:
        """Number of samples."""
        return len(self.columns["stamp"])

    def recorded(self, *names: str) -> Mapping[str, NDArray[Any]]:
        """The columns, of an archive that has all of these.

        Raises:
            ArchiveError: one is missing, as in one that was imported.
        """
        if missing := [name for name in names if name not in self.columns]:
            raise ArchiveError(
                self.path,
                f"is no recording of a motion of hil's own: it has no {missing[0]}",
                remedy="take it out of the folder",
            )
        return self.columns

    def text(self, name: str) -> str:
        """An attachment that is text.

        Raises:
            ArchiveError: it is not there, or not UTF-8.
        """
        if name not in self.attachments:
            raise ArchiveError(
                self.path,
                f"carries no {name}",
                remedy="import the recording again with a URDF or a cell file",
            )
        try:
            return self.attachments[name].decode()
        except UnicodeDecodeError as error:
            raise ArchiveError(
                self.path,
                f"is no text in UTF-8 ({error.reason} at byte {error.start})",
                field=name,
                remedy="import the recording again with a URDF or a cell file in UTF-8",
            ) from error

    def cycles(self) -> Rows:
        """The cycle records as the session wrote them, structure of `drivers.cycle_dtype`.

        Raises:
            ArchiveError: the archive was opened without all fields, or holds no cycles.
        """
        dtype = cycle_dtype(len(self.joint_names))
        names = dtype.names or ()
        absent = [name for name in names if name not in self.columns and name not in LATER_FIELDS]
        if absent:
            raise ArchiveError(self.path, f"has no column {absent[0]}", field=CYCLE)
        rows = np.zeros(self.n_samples, dtype)
        for name in names:
            if name in self.columns:
                rows[name] = self.columns[name]
        return rows


def open_archive(
    path: str | PathLike[str],
    *,
    fields: Collection[str] | None = None,
    topics: Collection[str] | None = None,
    start: float | None = None,
    stop: float | None = None,
) -> Archive:
    """Read an archive.

    A file that was cut off or damaged is read up to its last whole chunk before the damage; what
    is read is what was written, or the archive says what it lost. Where only some channels or
    times are wanted and the index of the file is whole, the rest is not even read, and its damages
    go unnoticed.

    Args:
        path: the file.
        fields: columns wanted, None for all.
        topics: channels wanted, such as ``/joint_states_commanded`` instead of ``/hil/cycle``;
            None for those that hold the numbers and the events.
        start: first instant wanted [s], on the clock of ``stamp`` and of the events.
        stop: end of the time wanted [s]; what happened then is left out.

    Raises:
        NotAnArchiveError: another kind of file, or one torn before it held anything.
        ArchiveVersionError: written by a newer version of the profile.
        ArchiveError: the file cannot be read, or has no such channel.
    """
    path = Path(path)
    selection = Selection(fields, topics, start, stop)
    try:
        with opened(path) as stream:
            size = os.fstat(stream.fileno()).st_size
            written = Written.read(stream, size)
            content = _by_index(stream, size, selection, written) if selection.partial else None
            damage = None
            if content is None:
                content, damage = _from_the_beginning(stream, size, selection, written)
    except OSError as error:
        remedy = _REMEDIES.get(error.errno or 0, "")
        raise ArchiveError(path, f"cannot be read: {error.strerror}", remedy=remedy) from error
    except MemoryError as error:
        raise ArchiveError(
            path, "does not fit into memory", remedy="read a part of its time, or fewer columns"
        ) from error
    metadata = _checked_metadata(path, size, content, damage)
    if damage is None:
        _check_topics(path, content, selection)
    columns = content.columns()
    stamp = columns["stamp"] if fields is None or fields else None
    return Archive(
        path=path,
        metadata=metadata,
        outcome=content.outcome,
        attachments=content.attachments,
        joint_names=_described(path, metadata).joint_names,
        columns=columns,
        events=tuple(content.events),
        damage=None if damage is None else _damage(damage, size, content, stamp),
    )


def _from_the_beginning(
    stream: BinaryIO,
    size: int,
    selection: Selection,
    written: Written,
    until: Contested | None = None,
) -> tuple[Content, Damage | None]:
    """What is selected of the whole chunks before the first damage, and that."""
    stream.seek(0)
    content = Content(selection, Order(written, until=until))
    damage = content.collect(container.records(stream, size, skip=_UNREAD), size)
    if until is None and isinstance(damage, Contested):  # some of what was read may be strange
        return _from_the_beginning(stream, size, selection, written, damage)
    return content, damage


def _by_index(
    stream: BinaryIO, size: int, selection: Selection, written: Written
) -> Content | None:
    """What is selected, found through the summary; None where that or what it names is damaged."""
    summary = Summary.read(stream, size)
    if summary is None:
        return None
    content = Content(selection, Order(written, gapless=False), gapless=False)
    try:
        for record in summary.announced:
            content.parser.announced.take(record.opcode, record.body, record.offset)
    except Damage:
        return None
    announced = content.parser.announced
    topics = {*selection.numbers(announced.topics)}
    if selection.events:
        topics.add(EVENTS)
    if selection.topics is None:
        topics.update(NUMBERS)  # a chunk that has others than those wanted is to be seen, too
    wanted = {channel.id for channel in announced.channels.values() if channel.topic in topics}
    start, stop = selection.times
    chunks = [chunk for chunk in summary.chunks if chunk.channels & wanted]
    taken = [chunk for chunk in chunks if chunk.start_time < stop and chunk.end_time >= start]
    # Where nothing falls into the range, one chunk still tells what columns there are.
    places = [(chunk.offset, chunk.length) for chunk in taken or chunks[:1]]
    records = (container.record_at(stream, *place) for place in sorted([*summary.others, *places]))
    damage = content.collect(records, sum(length for _, length in places))
    return content if damage is None and content.metadata is not None else None


def _check_topics(path: Path, content: Content, selection: Selection) -> None:
    """Check that the archive has the channels wanted."""
    recorded = sorted(content.parser.announced.topics)
    for topic in selection.topics or ():
        if recorded and topic not in recorded:
            raise ArchiveError(
                path, "has no such channel", field=topic, remedy=f"it has {', '.join(recorded)}"
            )


def _checked_metadata(
    path: Path, size: int, content: Content, damage: Damage | None
) -> Mapping[str, str]:
    """The ``hil`` record, whose version we know."""
    if content.metadata is not None:
        version = content.metadata.get("format_version")
        if version != str(FORMAT_VERSION):
            raise ArchiveVersionError(
                path,
                f"is of profile version {version}; this software reads version {FORMAT_VERSION}",
                remedy="install a newer hil",
            )
        return content.metadata
    remedy = "record it again"
    if size == 0:
        problem = "is empty: the recording ended before anything was written"
    elif damage is None:
        problem = f"is an MCAP file, but not an archive: it has no {METADATA!r} metadata record"
        remedy = "name a file that hil recorded or imported"
    elif damage.offset == 0:
        problem = "is not an MCAP file"
        remedy = "name a file that hil recorded, or import this one first"
    else:
        problem = f"is torn before its first data: the record at byte {damage.offset} {damage}"
    raise NotAnArchiveError(path, problem, remedy=remedy)


def _described(path: Path, metadata: Mapping[str, str]) -> Description:
    try:
        return Description.of(metadata)
    except DescriptionError as error:
        raise ArchiveError(
            path,
            error.problem,
            field=error.field,
            remedy=f"what wrote this archive does not keep the profile: its record {METADATA!r} "
            "must be mended there",
        ) from error


def _damage(
    damage: Damage, size: int, content: Content, stamp: NDArray[np.int64] | None
) -> ArchiveDamage:
    return ArchiveDamage(
        offset=damage.offset,
        reason=damage.reason,
        bytes_dropped=size - damage.offset,
        samples=None if stamp is None else len(stamp),
        duration=0.0 if stamp is None or not len(stamp) else 1e-9 * float(stamp[-1] - stamp[0]),
        outcome_missing=content.outcome is None,
    )
