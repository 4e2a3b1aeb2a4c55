"""Gives a whole archive another outcome: a motion that ended well may turn out to be of no use."""

from __future__ import annotations

from os import PathLike
from pathlib import Path
from typing import IO, BinaryIO

from hil.archive.repair import copy_of
from hil.archive.rewrite import write_anew
from hil.archive.survey import survey
from hil.errors import ArchiveError

REJECTED = "rejected"
"""Outcome of a motion that ended well and failed its quality check."""


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
    if found.faults or found.metadata is None or found.outcome is None:
        raise ArchiveError(path, "is not whole", remedy="repair it with `hil archive repair`")
    amended = {"outcome": outcome, "reason": reason}

    def fill(stream: BinaryIO, output: IO[bytes]) -> None:
        copy_of(found, stream, output, outcome=amended)

    write_anew(path, path, fill)
