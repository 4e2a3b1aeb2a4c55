"""Whether a chunk is one that was written, and stands where it was written.

Its own checksum says that a chunk is whole, not that it is of this recording: a file system may put
a chunk of another archive in its place. The outcome lists the checksums of all chunks in order, so
that each is known by its own. Archives of earlier versions have no such list, torn ones no outcome:
there the cycles must do, which grow from the first to the last that the outcome names. Where two
chunks claim the same cycles, nobody knows which is strange, and neither is believed.

Reader and survey ask the same questions here, in the order of the file.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import BinaryIO, Self

import numpy as np
from numpy.typing import NDArray

from hil.archive import container, index, schema
from hil.archive.container import Damage, Record
from hil.archive.header import (
    METADATA,
    OUTCOME,
    ArchiveHeader,
    ArchiveOutcome,
    HeaderError,
    checksum,
)

_BUT_METADATA = frozenset(range(256)) - {container.METADATA}


class Contested(Damage):
    """Cycles that cannot be where they are, though each chunk may be sound by itself.

    Attributes:
        since: stamp [ns]; no chunk that reaches it is believed, nor any behind.
    """

    def __init__(self, offset: int, reason: str, since: int) -> None:
        super().__init__(offset, reason)
        self.since = since


@dataclass(frozen=True, eq=False)
class Written:
    """What the end of a file says of its chunks, as far as it is there.

    Attributes:
        chunks: their checksums in order, shape (k,).
        ends: stamps of the first and the last cycle [ns].
        strange: whether that end is of another recording than the beginning.
    """

    chunks: NDArray[np.uint32] | None = None
    ends: tuple[int, int] | None = None
    strange: bool = False

    @classmethod
    def read(cls, stream: BinaryIO, size: int) -> Self:
        """Find it; the stream is left anywhere."""
        found = _records_of_ours(_indexed(stream, size))
        if found.keys() != {METADATA, OUTCOME}:
            found = _records_of_ours(_walked(stream, size))
        if found.keys() != {METADATA, OUTCOME}:
            return cls()
        try:
            header = ArchiveHeader.of(found[METADATA])
        except HeaderError:
            return cls()
        written = cls.of(header, ArchiveOutcome.of(found[OUTCOME]))
        # Another program that copies a file may cut its chunks anew, and then names itself.
        return written if _is_ours(stream, size) else replace(written, chunks=None)

    @classmethod
    def of(cls, header: ArchiveHeader, outcome: ArchiveOutcome) -> Self:
        """What the outcome says of the recording with this header."""
        if not outcome.belongs_to(header):
            return cls(strange=True)
        chunks = None if outcome.chunks is None else np.array(outcome.chunks, np.uint32)
        return cls(chunks, _ends(header, outcome))


class Order:
    """Goes with the chunks of a file from its beginning to its end.

    Args:
        written: what the end of the file says.
        gapless: whether every chunk comes; otherwise some are left out.
        until: what an earlier go ended with.
    """

    def __init__(
        self, written: Written, *, gapless: bool = True, until: Contested | None = None
    ) -> None:
        self._written = written
        self._gapless = gapless
        self._until = until
        self._at = 0
        self._newest = -1
        self.closed = False
        """Whether no further chunk can be believed."""

    @property
    def listed(self) -> int | None:
        """How many chunks were written, None where nothing says so."""
        chunks = self._written.chunks
        return None if chunks is None else len(chunks)

    def check_chunk(self, crc: int, offset: int) -> None:
        """Check that the chunk with this checksum, its own, is the next.

        Raises:
            Damage: it is not.
        """
        if self._written.strange:
            reason = "(chunk) may be of either of two: the outcome is that of another recording"
            raise Damage(offset, reason)
        chunks = self._written.chunks
        if chunks is None:
            return
        if self._at < len(chunks) and chunks[self._at] == crc:
            self._at += 1
            return
        places = np.flatnonzero(chunks == crc)
        if not len(places) or places[-1] < self._at:
            why = "stands behind one that followed it" if len(places) else "is of another recording"
            raise Damage(offset, f"(chunk) {why}, by the outcome's list of checksums")
        if self._gapless:
            raise Damage(offset, "(chunk) does not continue the one before")
        self._at = int(places[-1]) + 1

    def check_cycles(self, stamps: NDArray[np.int64], offset: int, *, begins: bool) -> None:
        """Check that cycles follow those before, and that they are of this recording.

        Args:
            stamps: theirs, shape (k,) [ns], k > 0.
            offset: where their chunk stands.
            begins: whether they are the first that were written.

        Raises:
            Contested: a chunk before claims the same time.
            Damage: this chunk is wrong by itself.
        """
        if self._until is not None and stamps.max() >= self._until.since:
            self.closed = True
            raise Damage(offset, self._until.reason)
        if (np.diff(stamps) <= 0).any():
            raise Damage(offset, "(chunk) has cycles that do not grow")
        first, last = self._written.ends or (int(stamps[0]), int(stamps[-1]))
        if stamps[0] < first or stamps[-1] > last or (begins and stamps[0] != first):
            reason = "(chunk) has cycles of another recording: the outcome names others"
            raise Damage(offset, reason)
        if stamps[0] <= self._newest:
            reason = "(chunk) has cycles that do not follow those before, or others claim them too"
            raise Contested(offset, reason, int(stamps[0]))

    def take(self, newest: int) -> None:
        """Note that cycles up to the stamp `newest` [ns] were taken."""
        self._newest = newest

    def check_end(self, size: int) -> None:
        """Check that the last cycle taken is the last that was written, where none is missing.

        Raises:
            Contested: it is another.
        """
        ends = self._written.ends
        if ends is None or self._newest in (-1, ends[1]) or self._until is not None:
            return
        reason = "(chunk) does not end with the last cycle that the outcome names"
        raise Contested(size, reason, self._newest)


def _ends(header: ArchiveHeader, outcome: ArchiveOutcome) -> tuple[int, int] | None:
    """Stamps of the first and the last cycle; None of what was repaired or has no cycles."""
    step, first, last = header.period, outcome.first_cycle, outcome.last_cycle
    if step is None or outcome.repaired or first is None or last is None:
        return None
    if first > last:  # earlier versions took two sessions
        return None
    return round(first * (step * 1e9)), round(last * (step * 1e9))


def _is_ours(stream: BinaryIO, size: int) -> bool:
    """Whether the header says that the file was written by us."""
    stream.seek(0)
    try:
        header = next(container.records(stream, size, check_end=False))
        fields = container.Fields(header.body, header.offset)
        fields.text()  # the profile
        return header.opcode == container.HEADER and fields.text() == schema.LIBRARY
    except Damage:
        return False


def _records_of_ours(records: Iterable[Record]) -> dict[str, dict[str, str]]:
    """The first of each of our two metadata records that passes its checksum."""
    found: dict[str, dict[str, str]] = {}
    try:
        for record in records:
            name, entries = container.metadata(record)
            claimed = entries.pop("checksum", None)
            if name in (METADATA, OUTCOME) and claimed == checksum(entries):
                found.setdefault(name, entries)
    except Damage:
        pass  # what comes behind it cannot be found this way
    return found


def _indexed(stream: BinaryIO, size: int) -> Iterator[Record]:
    """Metadata records where the end of the file says that they are."""
    for place in index.metadata_places(stream, size):
        record = container.record_at(stream, *place)
        if record.opcode == container.METADATA:
            yield record


def _walked(stream: BinaryIO, size: int) -> Iterator[Record]:
    """Metadata records, found from head to head."""
    stream.seek(0)
    for record in container.records(stream, size, skip=_BUT_METADATA, check_end=False):
        if record.opcode == container.METADATA:
            yield record
