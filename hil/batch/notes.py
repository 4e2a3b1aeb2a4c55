"""What a batch says of archives and estimates, as values; `hil.batch.messages` words them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, Final

from hil.base.type_adapter import adapter_of
from hil.pipeline.notes import (
    AssumedTorqueConstants,
    MergedSamples,
    Note,
    OtherMeaning,
    RepairedArchive,
    StatedText,
)
from identification.hypotheses.joint_changes import Change
from identification.signals.position_steps import PositionJump
from identification.signals.row_faults import RowFaults
from identification.signals.sample_times import SampleTimes
from identification.validation.finding import Figure, Finding, RepeatedSamples

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


_Values = Mapping[
    str,
    Figure
    | Change
    | RowFaults
    | SampleTimes
    | tuple[str, ...]
    | tuple[int, ...]
    | tuple[float, ...]
    | tuple[Change, ...]
    | tuple[PositionJump, ...]
    | tuple[RepeatedSamples, ...],
]
"""Values of findings about a recording; findings about an estimate have further ones."""


def note_as_json(note: Note) -> list[Any]:
    """Return one of `ARCHIVE_NOTES` as JSON data."""
    content = asdict(note)
    if isinstance(note, OtherMeaning):
        values = adapter_of(_Values).dump_python(note.finding.values, mode="json")
        content["finding"]["values"] = values
    return [type(note).__name__, content]


def note_of_json(content: tuple[str, Mapping[str, Any]]) -> Note:
    """Return the note of :func:`note_as_json`.

    Raises:
        KeyError, TypeError, ValueError: it is none.
    """
    kind, fields = content
    if kind != OtherMeaning.__name__:
        return ARCHIVE_NOTES[kind](**fields)
    finding = Finding(**fields["finding"])
    finding = replace(
        finding,
        values=adapter_of(_Values).validate_python(finding.values),
        joints=tuple(finding.joints),
        each={name: tuple(figures) for name, figures in finding.each.items()},
    )
    return OtherMeaning(finding, tuple(fields["joints"]))
