"""Notes of a batch in words."""

from __future__ import annotations

from collections.abc import Iterable

from hil.pipeline.note_messages import note_lines
from hil.pipeline.notes import Note

from .notes import DifferentSetups, MoreNotes, OfSomeArchives


def batch_lines(notes: Iterable[Note]) -> list[str]:
    """Return sentences on archives and estimates, without full stops."""
    return [line for note in notes for line in _lines(note)]


def _lines(note: Note) -> list[str]:
    match note:
        case OfSomeArchives(inner, archives, of, example):
            start = f"{archives} of {of} archives, such as {example}: "
            return [f"{start}{line}" for line in batch_lines([inner])]
        case MoreNotes(count):
            return [f"{count} more warnings are listed with the repetitions"]
        case DifferentSetups(setups):
            stated = "; ".join(setup or "nothing" for setup in setups)
            return [
                "pooled over campaigns whose cells state different payloads or delays, which are"
                f" compensated: {stated}"
            ]
    return note_lines([note])
