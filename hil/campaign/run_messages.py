"""Notes for the reader of a run's results, in words."""

from __future__ import annotations

from collections.abc import Iterable
from typing import assert_never

from hil.control.messages import lower_limit_words

from .operator import RequestUnread, ScreenFailed
from .quality_messages import replaced_words, rest_words
from .quality_problems import ReplacedRepetitions
from .record_messages import gravity_lines, warm_up_line
from .run_notes import (
    AgainstGravity,
    LowerCurrentLimits,
    NotWarm,
    RunNote,
    WarmedUpAgain,
)


def run_lines(notes: Iterable[RunNote]) -> list[str]:
    """Return sentences without their full stops, one for most notes."""
    return [line for note in notes for line in _lines(note)]


def _lines(note: RunNote) -> list[str]:
    if isinstance(note, AgainstGravity):
        return [f"dry run: {line}" for line in gravity_lines(note.record)]
    return [_line(note)]


def _line(
    note: LowerCurrentLimits
    | NotWarm
    | WarmedUpAgain
    | ReplacedRepetitions
    | ScreenFailed
    | RequestUnread,
) -> str:
    match note:
        case LowerCurrentLimits(limits):
            below = "; ".join(map(lower_limit_words, limits))
            return f"the controller's own, lower current limits were used ({below})"
        case NotWarm(record):
            return f"the arm was not warm when the repetitions began ({warm_up_line(record)})"
        case WarmedUpAgain(rest):
            return f"{rest_words(rest)} during the campaign, and was warmed up again"
        case ReplacedRepetitions():
            return replaced_words(note)
        case ScreenFailed(error):
            return f"the operator's screen failed ({error}); nothing was shown"
        case RequestUnread(error, ended_hold):
            became = "the last request remained active"
            if ended_hold:
                became = "the arm was held and could not be released: the run was stopped"
            return f"the operator's request could not be read ({error}); {became}"
        case never:
            assert_never(never)
