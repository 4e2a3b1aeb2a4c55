"""Notes of a batch in words."""

from __future__ import annotations

from collections.abc import Iterable

from hil.pipeline.note_messages import note_lines
from hil.pipeline.notes import Note

from .notes import DifferentSetups, MoreNotes, OfSomeArchives
from .setup import Setup


def batch_lines(notes: Iterable[Note]) -> list[str]:
    """Return sentences on archives and estimates, without full stops."""
    return [line for note in notes for line in _lines(note)]


def setup_words(setup: Setup) -> str:
    """Return torque delay and payload of a cell, with all digits; "" for neither."""
    phrases = [f"torque lags by {1e3 * setup.delay:.12g} ms"] if setup.delay else []
    if setup.centre:
        frame = f" in {setup.frame}" if setup.frame else ""
        phrases.append(f"carries {setup.mass:.12g} kg at {_row(setup.centre)} m{frame}")
    if setup.inertia:
        phrases.append(f"{_row(setup.inertia)} kg·m²")
    return ", ".join(phrases)


def _row(figures: Iterable[float]) -> str:
    return f"({', '.join(f'{figure:.12g}' for figure in figures)})"


def _lines(note: Note) -> list[str]:
    match note:
        case OfSomeArchives(inner, archives, of, example):
            start = f"{archives} of {of} archives, such as {example}: "
            return [f"{start}{line}" for line in batch_lines([inner])]
        case MoreNotes(count):
            return [f"{count} more warnings are listed with the repetitions"]
        case DifferentSetups(setups):
            stated = "; ".join(setup_words(setup) or "nothing" for setup in setups)
            return [
                "pooled over campaigns whose cells state different payloads or delays, which are"
                f" compensated: {stated}"
            ]
    return note_lines([note])
