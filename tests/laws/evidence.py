"""What a run with faults leaves behind: the input of the laws, whoever ran it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from numpy.typing import ArrayLike

from hil.archive import ArchiveOutcome, open_archive
from identification import Estimate
from tests.laws.manifests import Entry, manifest_of
from tests.laws.motions import Motion
from tests.laws.second_reader import Archived, read


@dataclass(frozen=True, eq=False)
class ArchiveFile:
    """An archive that can be opened.

    Attributes:
        archived: as the second reader sees it.
        complete, missing: by the product: whether it is complete, and what is missing.
        excused: a fault struck while it was written.
        records_lost: between exchange and file, as it states.
        missed: packets that the controller did not send or that never arrived, as it states.
    """

    archived: Archived
    complete: bool
    missing: str = ""
    excused: bool = False
    records_lost: int = 0
    missed: int = 0

    @classmethod
    def of(cls, path: Path, *, excused: bool = False) -> ArchiveFile:
        """Open a file; ArchiveError if it cannot be opened."""
        archive = open_archive(path, fields=())
        outcome = archive.outcome or ArchiveOutcome()
        return cls(
            read(path),
            archive.complete,
            archive.missing or "",
            excused,
            outcome.records_lost or 0,
            outcome.lost_packets or 0,
        )


class Rest(NamedTuple):
    """State of the arm at a time at which it has to be at rest outside open mode."""

    when: str  # such as "at the end"
    velocity: ArrayLike  # of joints or motors, (n,) or (k, n)
    allowed: ArrayLike  # velocity that counts as rest
    phase: str = ""  # of the controller
    any_open: bool = False  # whether an axis was in open mode
    unit: str = "rad/s"


@dataclass(frozen=True, eq=False)
class Evidence:
    """What is known of one run; a law applies where its part is there.

    Attributes:
        period: of the cell [s].
        files: archives.
        unreadable: what the product says of files that it should be able to use and is not.
        folder: of the campaign.
        manifests: entries of its manifest, at successive times.
        counts: motions of a campaign that should be complete, by `WANTED`.
        motions: those of the plan, by kind and index.
        rests: times at which the arm has to be at rest.
        disk: operations that a disk refused, and the error that was raised.
        estimates: of the campaign, and of the same without faults.
        session: broken laws of session and guard, by `tests.drivers.judge`.
        simulated: an `Observed` of `tests.simulate`.
        processes: a `Processes` of `tests.process_death`.
        damage: a `Damage` of `tests.disk`.
        piece: a `Piece` of `tests.endurance`.
    """

    period: float = math.nan
    files: tuple[ArchiveFile, ...] = ()
    unreadable: tuple[str, ...] = ()
    folder: Path | None = None
    manifests: tuple[tuple[Entry, ...], ...] = ()
    counts: tuple[int, ...] = ()
    motions: Mapping[tuple[str, int], Motion] = field(default_factory=dict)
    rests: tuple[Rest, ...] = ()
    disk: tuple[tuple[str, ...], BaseException | None] | None = None
    estimates: tuple[Estimate, Estimate] | None = None
    session: tuple[str, ...] | None = None
    simulated: Any = None
    processes: Any = None
    damage: Any = None
    piece: Any = None

    @property
    def entries(self) -> tuple[Entry, ...]:
        """The manifest as it was last."""
        return self.manifests[-1] if self.manifests else ()


def entries_of(folder: Path) -> tuple[Entry, ...]:
    """Return the entries of the manifest of a campaign's folder."""
    return tuple(manifest_of(folder)[1])


class Broken(NamedTuple):
    """A violation of a law."""

    law: str  # its name
    text: str  # with the values
