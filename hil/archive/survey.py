"""Goes through a whole archive, past its damages, and says what of it stands.

The reader stops at the first damage; a survey goes on, so that what follows can be saved. What it
keeps has passed the same checks (`hil.archive.scan`).
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import BinaryIO, NamedTuple

from mcap.records import Header

from hil.archive import container, schema
from hil.archive.chunk import KnownChannels, Messages
from hil.archive.container import Damage, Record, Summary
from hil.archive.header import METADATA, OUTCOME
from hil.archive.scan import NUMBERS, Order, Scan
from hil.errors import ArchiveError
from hil.reading import opened

_ASPECTS = {
    container.METADATA: "metadata",
    container.ATTACHMENT: "attachments",
    container.CHUNK: "chunks",
}


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
    """What stands of a file, and what does not; message indexes and summary are not looked at.

    Args:
        path: the file.
        stream: the same, open.
        order: the chunks that must come.
        summary: of the file, None where it is not whole.
        visit: called with each chunk that stands.

    Attributes:
        path: the file.
        size: its length.
        written_by: profile and library, None where the record is damaged.
        pieces: records that stand, but for header and outcome, in the order of the file, without
            their bodies.
        definitions: schemas and channels that only the summary still has.
        faults: what is wrong.
    """

    def __init__(
        self,
        path: Path,
        stream: BinaryIO,
        order: Order,
        summary: Summary | None,
        visit: Visit | None = None,
    ) -> None:
        super().__init__(order)
        self.path = path
        self.size = os.fstat(stream.fileno()).st_size
        self.written_by: tuple[str, str] | None = None
        self.pieces: list[Record] = []
        self.definitions: list[Record] = []
        self.faults: list[Fault] = []
        self._stream = stream
        self._visit = visit
        self._summary = summary
        self._seen: set[int] = set()
        self._lost_since = False
        self._ended = False

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
        """Samples that stand."""
        return max((self.counts.get(topic, 0) for topic in NUMBERS), default=0)

    @property
    def events(self) -> int:
        """Events that stand."""
        return self.counts.get(schema.EVENTS, 0)

    @property
    def chunks(self) -> int:
        """Chunks that stand."""
        return sum(piece.opcode == container.CHUNK for piece in self.pieces)

    def schema_name(self, topic: str) -> str:
        """The type of the messages of a topic, empty where nothing says it."""
        found = self.parser.known.schema(topic)
        return found.name if found else ""

    def run(self) -> None:
        """Go through the file."""
        self._stream.seek(0)
        skip = (container.MESSAGE_INDEX,)
        try:
            for record in container.records(self._stream, self.size, skip=skip, check_end=False):
                self._examine(record)
        except Damage as damage:
            self._lost_since = True  # and what is lost, counts and outcome will tell
            self._fault("container", damage, loss=False)
        for record in self._unreached():
            self._examine(record)
        self._finish()

    def _unreached(self) -> Iterator[Record]:
        """Records that the summary knows and the walk did not reach."""
        try:
            places = self._summary.places if self._summary else []
        except Damage:
            places = []
        for place in places:
            if place[0] not in self._seen:
                try:
                    yield container.record_at(self._stream, *place)
                except Damage as damage:
                    self._fault("container", damage, loss=True)

    def _fault(self, aspect: str, problem: Damage | str, *, loss: bool) -> None:
        self._lost_since |= loss
        text = problem
        if isinstance(problem, Damage):
            text = f"the record at byte {problem.offset} {problem.reason}"
        fault = Fault(aspect, str(text), loss)
        if fault not in self.faults:
            self.faults.append(fault)

    def _examine(self, record: Record) -> None:
        self._seen.add(record.offset)
        try:
            if record.opcode == container.HEADER:
                header = container.parsed(Header, record.body, record.offset)
                self.written_by = header.profile, header.library
            self.take(record)
        except Damage as damage:
            aspect = _ASPECTS.get(record.opcode, "container")
            self._fault(aspect, damage, loss=record.opcode != container.HEADER)
        else:
            if record.opcode in (container.SCHEMA, container.CHANNEL):
                self._keep(record)

    def _keep(self, record: Record) -> None:
        self.pieces.append(record._replace(body=b""))

    def take_metadata(self, record: Record, name: str, entries: dict[str, str]) -> None:
        """Take header or outcome; another one is left as it is."""
        super().take_metadata(record, name, entries)
        if name not in (METADATA, OUTCOME):
            self._keep(record)

    def take_attachment(self, record: Record) -> None:
        """Take an attachment, of each name one."""
        name = container.attachment(record).name
        if name in self.attachments:
            raise Damage(record.offset, f"(attachment {name!r}) is there a second time")
        super().take_attachment(record)
        self._keep(record)

    def take_chunk(self, record: Record) -> None:
        """Take a chunk, if it follows those before or what is missing will show."""
        if self._ended:
            raise Damage(record.offset, "(chunk) comes after a gap that nothing would show")
        data = self.opened(record)
        known, definitions = KnownChannels(self.parser.known), self.definitions
        try:
            numbered = self.parser.messages(data, record.offset)
            self._recover_channels(numbered)
            found = self.parser.by_topic(numbered, record.offset)
            self.continued(found, record.offset)
        except Damage:
            self.parser.known, self.definitions = known, definitions  # what it says goes with it
            raise
        self._keep(record)
        self._lost_since = False
        if self._visit is not None:
            self._visit(self, record, found)

    def _recover_channels(self, numbered: Mapping[int, Messages]) -> None:
        """Take channels that no record before announces from the summary."""
        if numbered.keys() <= self.parser.known.channels.keys():
            return
        self.definitions = self._summary.definitions if self._summary else []
        for item in self.definitions:
            self.parser.known.take(item)

    def missing(self, gaps: Mapping[str, int], offset: int) -> None:
        """Note that messages are missing; a gap in samples must show in the samples behind it."""
        unseen = any(gap and topic in NUMBERS for topic, gap in gaps.items())
        if unseen and schema.CYCLE not in self.parser.known.topics:
            self._ended = True
            raise Damage(offset, "(chunk) comes after a gap that nothing would show")
        if not self._lost_since and not self._order.repaired:
            damage = Damage(offset, "(chunk) does not continue the one before")
            self._fault("sequence", damage, loss=True)

    def _finish(self) -> None:
        if self.metadata is None:
            return
        if self.written_by != (schema.PROFILE, schema.LIBRARY):
            self._fault("container", "the header is not that of the profile", loss=False)
        for name in self.header.attachments if self.header else ():
            if name not in self.attachments:
                self._fault("attachments", f"attachment {name!r} is missing", loss=True)
        self._check_outcome()

    def _check_outcome(self) -> None:
        outcome = self.outcome
        if outcome is None:
            self._fault("outcome", "the outcome is missing", loss=True)
            return
        if self.mixed:
            self._fault("outcome", "the outcome is that of another recording", loss=True)
        counts = {
            "samples": (outcome.samples, self.samples),
            "events": (outcome.events, self.events),
        }
        if "packets" in outcome.record:
            counts["packets"] = outcome.packets, self.counts.get(schema.PACKETS, 0)
        if self._order.chunks is not None:
            counts["chunks"] = len(self._order.chunks), self.chunks
        for key, (stated, count) in counts.items():
            if stated != count:
                text = f"{stated} {key} were written, {count} are there"
                self._fault("outcome", text, loss=True)


def survey(path: str | PathLike[str], visit: Visit | None = None) -> Survey:
    """Go through a file.

    Args:
        path: the file.
        visit: called with each chunk that stands, with its messages by topic.

    Raises:
        ArchiveError: it cannot be read.
    """
    path = Path(path)
    try:
        with opened(path) as stream:
            size = os.fstat(stream.fileno()).st_size
            # Found from head to head, since a chunk of another length may have come before it.
            summary = Summary.read(stream, size, start=container.data_end(stream, size))
            order = replace(Order.read(stream, size, summary), gapless=False)
            if order.strange:
                order = Order(gapless=False)  # a fault of the outcome will say so
            found = Survey(path, stream, order, summary, visit)
            found.run()
            return found
    except OSError as error:
        raise ArchiveError(path, f"cannot be read: {error.strerror}") from error
