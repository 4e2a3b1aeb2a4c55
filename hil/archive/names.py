"""File names of archives: ``excitation_007_a1.mcap`` is kind, index and attempt."""

from __future__ import annotations

import re
from dataclasses import dataclass
from os import PathLike
from pathlib import Path

from hil.errors import ArchiveError

KINDS = ("standstill", "move", "warmup", "dryrun", "excitation", "validation", "imported")
SUFFIX = ".mcap"
WORDS = {
    "dryrun": "dry run",
    "warmup": "warm-up",
    "excitation": "repetition",
    "imported": "recording",
}
"""What a person calls a kind, where that is another word."""

_PATTERN = re.compile(
    r"(?P<kind>[a-z]+)_(?P<index>[0-9]{3,18})_a(?P<attempt>[1-9][0-9]{0,17})\.mcap"
)


def motion_name(kind: str, index: int) -> str:
    """What a person calls a motion, counted from 1: "repetition 1" for the excitation 0."""
    return f"{WORDS.get(kind, kind)} {index + 1}"


@dataclass(frozen=True, order=True)
class ArchiveName:
    """What an archive is called.

    Attributes:
        kind: why the arm moved, one of `KINDS`.
        index: number of the interval within its kind, from 0.
        attempt: 1 for the first try at this interval; a torn or stopped one is done again.
    """

    kind: str
    index: int
    attempt: int = 1

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ArchiveError(
                None, f"{self.kind!r} is no kind of archive", remedy=f"use {', '.join(KINDS)}"
            )
        if self.index < 0 or self.attempt < 1:
            raise ArchiveError(
                None,
                f"index {self.index}, attempt {self.attempt}",
                field=self.kind,
                remedy="an index is zero or more, an attempt one or more",
            )

    @property
    def filename(self) -> str:
        """The name of the file, without folder."""
        return f"{self.kind}_{self.index:03d}_a{self.attempt}{SUFFIX}"

    def __str__(self) -> str:
        return self.filename

    def __fspath__(self) -> str:
        """The file name, so that a folder can be joined with it."""
        return self.filename

    @classmethod
    def parse(cls, path: str | PathLike[str]) -> ArchiveName | None:
        """Read kind, index and attempt from a file name; None when it is not such a name."""
        match = _PATTERN.fullmatch(Path(path).name)
        if match is None or match["kind"] not in KINDS:
            return None
        return cls(match["kind"], int(match["index"]), int(match["attempt"]))

    @property
    def motion(self) -> str:
        """What a person calls it; without the attempt."""
        return motion_name(self.kind, self.index)

    def metadata(self) -> dict[str, str]:
        """The name as entries of the archive's metadata."""
        return {"kind": self.kind, "index": str(self.index), "attempt": str(self.attempt)}
