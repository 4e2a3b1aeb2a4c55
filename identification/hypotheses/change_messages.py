"""Words for what is other in a part of a recording, or throughout."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

from identification.hypotheses.joint_changes import Change, Meaning
from identification.text import joined

_WORDS: Final[Mapping[Meaning, str]] = {
    "payload": "another load",
    "scale": "another scale of the torque of {}",
    "friction": "another friction of {}",
    "friction drift": "friction that drifts throughout",
    "delay": "another delay of {}",
    "drift": "a drifting zero of {}",
    "spring": "a spring or cable on {}",
    "load friction": "friction that grows with the load",
    "arm": "another arm, tool or setting",
    "unmodelled": "another motion, which shows more of what the model lacks",
}
CHANGES_OF_A_PART: Final = frozenset(_WORDS)
"""Meanings of changes that may be in a part alone, or explain one."""


def part_words(change: Change, joints: Sequence[str]) -> str:
    """Return a change of a part, or one that explains it, without its size.

    Args:
        change: with one of the meanings in `CHANGES_OF_A_PART`.
        joints: names of all.
    """
    names = joined([joints[joint] for joint in change.joints]) or "all axes"
    words = _WORDS[change.meaning].format(names)
    return f"{words} throughout" if change.is_constant else words
