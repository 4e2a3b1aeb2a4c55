"""Makes the script of a failure as small and plain as it can be."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

from tests.simulate.script import simpler

MOST_TRIES: Final = 40  # Campaigns that are played for it, at most

Fails = Callable[[tuple[str, ...]], bool]


def shrunk(lines: Sequence[str], fails: Fails, tries: int = MOST_TRIES) -> tuple[str, ...]:
    """A script of which no line can be left out or made plainer, as far as was tried.

    Args:
        lines: a script that fails.
        fails: whether another one breaks the same law.
        tries: how often that is asked, at most.
    """
    left = [tries]

    def still(candidate: tuple[str, ...]) -> bool:
        if left[0] <= 0:
            return False
        left[0] -= 1
        return fails(candidate)

    return _plainer(_fewer(tuple(lines), still), still)


def _fewer(lines: tuple[str, ...], still: Fails) -> tuple[str, ...]:
    """Leave out halves first, then lines."""
    size = max(1, len(lines) // 2)
    while True:
        start = 0
        while start < len(lines):
            candidate = lines[:start] + lines[start + size :]
            if still(candidate):
                lines = candidate
            else:
                start += size
        if size == 1:
            return lines
        size //= 2


def _plainer(lines: tuple[str, ...], still: Fails) -> tuple[str, ...]:
    """Make the numbers of each line smaller or rounder."""
    for row in range(len(lines)):
        again = True
        while again:
            again = False
            for other in simpler(lines[row]):
                candidate = (*lines[:row], other, *lines[row + 1 :])
                if still(candidate):
                    lines, again = candidate, True
                    break
    return lines
