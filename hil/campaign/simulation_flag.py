"""Whether a simulated arm or a real one made an archive, as the archive itself says."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from hil.archive import open_archive
from hil.errors import ArchiveError

SIMULATED: Final = "simulated"
"""Metadata: whether nothing but a simulated arm can have moved, "yes" or "no". The link says so,
whatever the caller of a run says."""


def said_of(only_simulated: bool) -> str:
    """The kind of arm as archives name it under `SIMULATED`."""
    return "yes" if only_simulated else "no"


def made_by(path: Path, only_simulated: bool) -> bool:
    """Whether an archive says that this kind of arm made it; a damaged one does not."""
    try:
        return open_archive(path, fields=()).header.simulated == said_of(only_simulated)
    except ArchiveError:
        return False
