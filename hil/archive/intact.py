"""What stands of an archive that was gone through past its damages, and what does not."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from hil.archive import schema
from hil.archive.container import Record
from hil.archive.header import ArchiveHeader, ArchiveOutcome

NUMBERS = (schema.CYCLE, schema.MEASURED, schema.COMMANDED, schema.MOTOR_CURRENT)
"""Channels that have one message of each sample."""


class Fault(NamedTuple):
    """Something that is not as it must be.

    Attributes:
        aspect: part of the profile: container, metadata, attachments, chunks, sequence, outcome
            or index.
        text: what is wrong, as a sentence without its end.
        loss: whether content is lost by it; otherwise it follows from what is there.
    """

    aspect: str
    text: str
    loss: bool


class Piece(NamedTuple):
    """A record that stands.

    Attributes:
        offset: where it begins in the file.
        length: with its head.
        opcode: kind of record.
        shift: of a chunk behind a loss, how much too high its messages count, by channel.
        times: of a chunk, first and last log time of its messages [ns].
    """

    offset: int
    length: int
    opcode: int
    shift: dict[int, int] | None = None
    times: tuple[int, int] | None = None


@dataclass
class Survey:
    """What stands of a file, and what does not.

    Attributes:
        path: the file.
        size: its length.
        written_by: profile and library, None where the record is damaged.
        metadata: entries of the ``hil`` record, None where it is missing or damaged.
        header: the same, parsed; None where they cannot be used.
        outcome: the ``hil.outcome`` record, None where it is missing or damaged.
        attachments: names of those that stand.
        pieces: records that stand, but for ``hil`` and ``hil.outcome``, in the order of the file.
        definitions: schemas and channels that only the summary still has.
        faults: what is wrong.
        counts: messages that stand, by topic.
        types: of their messages, by topic.
        missing: messages missing between those that stand, by topic.
    """

    path: Path
    size: int
    written_by: tuple[str, str] | None = None
    metadata: dict[str, str] | None = None
    header: ArchiveHeader | None = None
    outcome: ArchiveOutcome | None = None
    attachments: list[str] = field(default_factory=list)
    pieces: list[Piece] = field(default_factory=list)
    definitions: tuple[Record, ...] = ()
    faults: list[Fault] = field(default_factory=list)
    counts: dict[str, int] = field(default_factory=dict)
    types: dict[str, str] = field(default_factory=dict)
    missing: dict[str, int] = field(default_factory=dict)

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
