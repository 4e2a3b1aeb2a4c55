"""One thing that was checked, what came out, and what to do about it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

Level = Literal["good", "information", "doubtful", "wrong"]
Role = Literal["condition", "cause", "symptom"]


@dataclass(frozen=True)
class Finding:
    """Outcome of one check.

    Attributes:
        check: what was looked at, in two or three words.
        level: "wrong" is a reason not to use the model, "doubtful" is worth a word, "information"
            is neither good nor bad.
        words: what was found, in a sentence without its full stop.
        next_step: what to do about it; empty where nothing needs doing.
        role: a cause explains errors, and its step is always given; a symptom is an error, and its
            step is a guess that is given only where no cause was found.
    """

    check: str
    level: Level
    words: str
    next_step: str = ""
    role: Role = "condition"


def joined(names: Sequence[str], most: int = 6) -> str:
    """Names in a row, the first few of many."""
    rest = len(names) - most
    return ", ".join(names[:most]) + (f" and {rest} more" if rest > 0 else "")
