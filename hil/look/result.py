"""The result of a look at a recording: rows of one table, questions, and what can be determined."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

Certainty = Literal["sure", "likely", "open"]


@dataclass(frozen=True)
class Row:
    """What one aspect of a recording is.

    Attributes:
        aspect: such as ``position`` or ``gravity``.
        reading: what it is.
        certainty: ``sure``: nothing else fits; ``likely``: by names or custom; ``open``: the
            recording does not say.
        reason: why.
        decide: what would decide it; empty if there is none.
    """

    aspect: str
    reading: str
    certainty: Certainty
    reason: str
    decide: str = ""


@dataclass(frozen=True)
class Choice:
    """One of the readings that fit alike.

    Attributes:
        aspect: that of a row.
        reading: what it would be.
        error: of the torque, predicted from other parts of the recording, as a share of it; None
            if the motion says nothing about it.
        line: of a column map, or an option, that states it.
        entries: of the map, by dotted key; empty if the line is no entry of a map.
    """

    aspect: str
    reading: str
    error: float | None
    line: str
    entries: tuple[tuple[str, Any], ...] = ()


@dataclass(frozen=True)
class Group:
    """How many parameters of a body or joint the recording determines."""

    body: str
    quantity: str
    identifiable: int
    weak: int
    missing: int


def fit_alike(choices: Sequence[Choice]) -> str:
    """Return how many readings fit alike, in words."""
    return f"{'two' if len(choices) == 2 else 'three'} readings fit alike"


@dataclass(frozen=True)
class Look:
    """What a recording contains.

    Attributes:
        source: its file name.
        rows: of the table.
        questions: readings that fit alike, one tuple for each question.
        groups: parameters that the recording determines; empty without masses or geometry.
        map_text: the column map with the sure conclusions; None for a bag.
        options: for `hil identify`, beside the map.
        error: of the torque as read, predicted from other parts of the recording, as a share of
            it; None without a torque or an arm.
    """

    source: str
    rows: tuple[Row, ...]
    questions: tuple[tuple[Choice, ...], ...]
    groups: tuple[Group, ...]
    map_text: str | None
    options: tuple[str, ...] = ()
    error: float | None = None

    def as_json(self) -> dict[str, Any]:
        """Return the result for programs."""
        questions = [
            [
                {
                    "aspect": choice.aspect,
                    "reading": choice.reading,
                    "error": choice.error,
                    "line": choice.line,
                }
                for choice in choices
            ]
            for choices in self.questions
        ]
        return {
            "source": self.source,
            "rows": [asdict(row) for row in self.rows],
            "questions": questions,
            "determines": [asdict(group) for group in self.groups],
            "map": self.map_text,
            "options": list(self.options),
            "error": self.error,
        }
