"""The sum of :func:`hil.batch.tree.sum_tree`, of terms that come one by one and are not kept."""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any, Generic, TypeVar

from .tree import FAN_IN

T = TypeVar("T")


class _Run(Generic[T]):
    """A sum that is still going on: so many terms, and what they add up to."""

    def __init__(self) -> None:
        self.count = 0
        self.total: T | None = None


class TreeSum(Generic[T]):
    """Terms in their order; the sum is that of the tree, to the last bit.

    At each time one sum per level of the tree is held.
    """

    def __init__(self, add: Callable[[Any, Any], Any] = operator.add) -> None:
        self._add = add
        self._levels: list[_Run[T]] = []

    def add(self, term: T | None) -> None:
        """Take the next term; None is nothing, and has its place nevertheless."""
        self._add_at(0, term)

    def result(self) -> T | None:
        """The sum of all terms, None if there was none; nothing can be added afterwards."""
        level = 0
        while level < len(self._levels):
            run = self._levels[level]
            if level == len(self._levels) - 1 and run.count == 1:
                return run.total
            if run.count:
                self._close(level)
            level += 1
        return None

    def _add_at(self, level: int, term: T | None) -> None:
        if level == len(self._levels):
            self._levels.append(_Run())
        run = self._levels[level]
        run.count += 1
        if term is not None:
            run.total = term if run.total is None else self._add(run.total, term)
        if run.count == FAN_IN:
            self._close(level)

    def _close(self, level: int) -> None:
        run = self._levels[level]
        self._levels[level] = _Run()
        self._add_at(level + 1, run.total)
