"""What a batch says of archives and estimates, as values; `hil.batch.messages` words them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Final

from hil.pipeline.notes import (
    AssumedTorqueConstants,
    MergedSamples,
    Note,
    OtherMeaning,
    RepairedArchive,
    StatedText,
)

from .setup import Setup

ARCHIVE_NOTES: Final[Mapping[str, type[Note]]] = {
    kind.__name__: kind
    for kind in (AssumedTorqueConstants, MergedSamples, OtherMeaning, RepairedArchive, StatedText)
}
"""Notes on an archive by itself, which are cached."""


@dataclass(frozen=True)
class OfSomeArchives(Note):
    """A note on some of the archives of an estimate."""

    note: Note
    archives: int
    of: int
    example: str  #: folder and name of one of them


@dataclass(frozen=True)
class MoreNotes(Note):
    """Notes that are listed with the single archives only."""

    count: int


@dataclass(frozen=True)
class DifferentSetups(Note):
    """Campaigns whose cells state different payloads or delays are pooled."""

    setups: tuple[Setup, ...]


def note_as_json(note: Note) -> list[Any]:
    """Return one of `ARCHIVE_NOTES` as JSON data."""
    return [type(note).__name__, asdict(note)]


def note_of_json(content: tuple[str, Mapping[str, Any]]) -> Note:
    """Return the note of :func:`note_as_json`.

    Raises:
        KeyError, TypeError, ValueError: it is none.
    """
    kind, fields = content
    return ARCHIVE_NOTES[kind](**fields)
