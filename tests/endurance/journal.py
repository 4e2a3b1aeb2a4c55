"""What a long run leaves behind: one line of JSON each, added as soon as it is known.

`begin` and `end` enclose a piece; one without an end was killed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

from tests.journal import entries

SYNC_EVERY: Final = 60.0
"""s between two waits for the disk."""


@dataclass(frozen=True)
class Use:
    """What a process takes: bytes behind which is no file (swapped ones too), and threads."""

    own: int
    threads: int


@dataclass(frozen=True)
class Sample:
    """One look at everything.

    Attributes:
        t: s since the piece began.
        load: average of the machine over a minute.
        processes: by name.
        shared: files in /dev/shm, of whoever.
        counters: of the exchange, since it began.
        stalls, stood: of the machine since the piece began, see `tests.endurance.stalls`, and the
            s that they lasted; 0 where nobody could look.
        latencies: answers by duration, in the bins of `drivers.exchange.control`.
    """

    t: float
    load: float
    processes: Mapping[str, Use]
    shared: int
    counters: Mapping[str, float]
    stalls: int = 0
    stood: float = 0.0
    latencies: Sequence[int] = ()


@dataclass(frozen=True)
class Ran:
    """One campaign.

    Attributes:
        number: in its piece, from 0.
        t: s since the piece began, at its end.
        complete: whether everything of its plan was done.
        stopped: whether it was stopped because the piece was over; otherwise one that is not
            complete was given up after some restarts.
        restarts: how often it was resumed, with the errors.
        motions: that ended on the link meanwhile, as the exchange counted them.
        archives, records, records_lost: files, what is in them, and what they say is not.
        faulty: those that do not keep the archive profile, with what is wrong.
        outcomes: archives by outcome.
        descriptors: open ones by process, with no archive open.
        held: by the supervisor of its memory: bytes of malloc, blocks of Python's own allocator.
    """

    number: int
    t: float
    complete: bool
    stopped: bool
    restarts: Sequence[str]
    motions: int
    archives: int
    faulty: Sequence[str]
    outcomes: Mapping[str, int]
    records: int
    records_lost: int
    descriptors: Mapping[str, int]
    held: Mapping[str, int] = field(default_factory=dict)

    @property
    def given_up(self) -> bool:
        """Whether it was left incomplete, and nobody had asked for that."""
        return not (self.complete or self.stopped)


@dataclass(frozen=True)
class Piece:
    """One call of the command; `ended` is None if it was killed."""

    begun: Mapping[str, Any]
    samples: list[Sample] = field(default_factory=list)
    campaigns: list[Ran] = field(default_factory=list)
    ended: Mapping[str, Any] | None = None

    @property
    def seconds(self) -> float:
        """How long it was seen to run."""
        return self.samples[-1].t if self.samples else 0.0


def read_journal(path: Path) -> list[Piece]:
    """All pieces of a journal; none if there is no such file.

    Args:
        path: of the file; where its name ends in `.xz` it is compressed.

    Raises:
        JournalError: it cannot be read, or a line of it is none of ours.
    """
    pieces: list[Piece] = []
    entries(path, lambda facts: _take(facts, pieces), "line of a long run's journal")
    return pieces


def _take(facts: dict[str, Any], pieces: list[Piece]) -> None:
    """Take a line into the pieces that were read so far."""
    kind = facts.pop("kind")
    if kind == "begin":
        pieces.append(Piece(facts))
    elif kind == "link":
        pieces[-1] = replace(pieces[-1], begun={**pieces[-1].begun, **facts})
    elif kind == "sample":
        used = {name: Use(**use) for name, use in facts.pop("processes").items()}
        pieces[-1].samples.append(Sample(processes=used, **facts))
    elif kind == "campaign":
        pieces[-1].campaigns.append(Ran(**facts))
    elif kind == "end":
        pieces[-1] = replace(pieces[-1], ended=facts)
    else:
        raise KeyError(kind)
