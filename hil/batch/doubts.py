"""What readers must know of the archives behind an estimate, said once however many there are."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

from .types import Summary

_TOLD: Final = 12
"""Different doubts that are told; of very many archives there may be very many."""


class Doubts:
    """Counts in how many archives there is reason for which doubt."""

    def __init__(self) -> None:
        self._archives = 0
        self._found: dict[str, tuple[int, str]] = {}

    def note(self, summary: Summary) -> None:
        """Take in those of an archive."""
        self._archives += 1
        name = f"{summary.ref.campaign.rsplit('/', 1)[-1]}/{summary.ref.name}"
        self._count((text, 1, name) for text in summary.doubts)

    def add(self, other: Doubts) -> None:
        """Take in those of other archives."""
        self._archives += other._archives
        self._count((text, count, name) for text, (count, name) in other._found.items())

    def lines(self) -> tuple[str, ...]:
        """In sentences, each with what it concerns; most archives first."""
        ordered = sorted(self._found.items(), key=lambda item: -item[1][0])
        found = [self._line(text, count, name) for text, (count, name) in ordered[:_TOLD]]
        if len(ordered) > _TOLD:
            found.append(f"{len(ordered) - _TOLD} more doubts stand with the repetitions")
        return tuple(found)

    def _count(self, found: Iterable[tuple[str, int, str]]) -> None:
        for text, count, name in found:
            known, first = self._found.get(text, (0, name))
            self._found[text] = (known + count, first)

    def _line(self, text: str, count: int, name: str) -> str:
        if count == self._archives:
            return text
        if count == 1:
            return f"{name}: {text}"
        return f"{count} of {self._archives} archives, such as {name}: {text}"
