"""Who does the work on archives, whichever machine it is on."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

from .on_workers import ArchiveTask, Part, Summed
from .tree import sum_tree
from .types import Broken

T = TypeVar("T")
S = TypeVar("S")


class Workers(ABC):
    """Who does the work on archives.

    Attributes:
        near: whether files they write can be read here under the same names.
    """

    near: bool

    @abstractmethod
    def sums(
        self,
        groups: Sequence[Sequence[ArchiveTask[T, S]]],
        add: Callable[[T, T], T],
        *,
        done: Callable[[int], None] | None = None,
    ) -> list[Summed[T, S]]:
        """Do the tasks, and add up what comes of those of each group, in `tree.sum_tree`'s order.

        A task that ends its process or takes too long has a `Broken` in place of its note.

        Args:
            groups: the work, in an order that decides about the last bits.
            add: sum of two totals, importable on the workers; it must not change them.
            done: called with a number of tasks whenever so many more are finished.
        """

    def sums_in_turn(
        self,
        groups: Sequence[Sequence[ArchiveTask[T, S]]],
        add: Callable[[T, T], T],
        *,
        done: Callable[[int], None] | None = None,
    ) -> Iterator[Summed[T, S]]:
        """The same, group by group as soon as each is there."""
        for group in groups:
            yield from self.sums([group], add, done=done)


def summed(parts: Sequence[Part[T, S] | Broken], add: Callable[[T, T], T]) -> Summed[T, S]:
    """What comes of the tasks of one group."""
    return Summed(
        sum_tree([None if isinstance(part, Broken) else part.total for part in parts], add),
        tuple(part if isinstance(part, Broken) else part.note for part in parts),
    )
