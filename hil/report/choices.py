"""Settings that were chosen by inner prediction, as rows of text."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from hil.report import numbers
from hil.results import ChoiceResult, Results

_MOST: Final = 6
"""Candidates of one question that are shown: the first, and the best of the others."""


@dataclass(frozen=True)
class Candidate:
    """One answer to a question: its error of inner prediction in per cent, and whether it won."""

    words: str
    error: str
    chosen: bool


@dataclass(frozen=True)
class Question:
    """One setting that was chosen.

    Attributes:
        name: what was chosen.
        candidates: those that are shown, the first one first.
        others: how many more there were.
    """

    name: str
    candidates: tuple[Candidate, ...]
    others: int


def questions(results: Results) -> list[Question]:
    """Every choice, in the order in which they were made."""
    return [_question(choice) for choice in results.choices]


def _question(choice: ChoiceResult) -> Question:
    errors = [math.inf if error is None else error for error in choice.errors]
    shown = list(range(len(errors)))
    if len(shown) > _MOST:
        # The first is the simplest, against which the others had to pay: least squares.
        shown = [0, *sorted(shown[1:], key=lambda k: (k != choice.chosen, errors[k]))[: _MOST - 1]]
    return Question(
        name=choice.name,
        candidates=tuple(
            Candidate(choice.candidates[k], _percent(choice.errors[k]), k == choice.chosen)
            for k in shown
        ),
        others=len(errors) - len(shown),
    )


def _percent(error: float | None) -> str:
    # Two decimals throughout: candidates are distinguished by little.
    return numbers.MISSING if error is None else numbers.fixed(100.0 * error, 2)
