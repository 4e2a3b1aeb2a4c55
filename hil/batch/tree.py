"""Sums in an order that depends on nothing but the number of terms.

Floating-point addition is not associative, so where the terms are added decides about the last
bits. Here each sum is a tree over the terms in their order, of which every part can be added
wherever its terms are: one process and a hundred machines give the same bits.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import reduce
from typing import Final, TypeVar

T = TypeVar("T")

FAN_IN: Final = 8
"""Terms of each sum of the tree: few enough to be held at once, many enough to send little."""


def runs(count: int) -> list[range]:
    """Indices 0 to count - 1 in the runs that are added first; the last one may be shorter."""
    return [range(begin, min(begin + FAN_IN, count)) for begin in range(0, count, FAN_IN)]


def sum_run(terms: Sequence[T | None], add: Callable[[T, T], T]) -> T | None:
    """Add the terms from first to last; None is nothing, and what the sum of nothing is."""
    present = [term for term in terms if term is not None]
    return reduce(add, present) if present else None


def sum_tree(terms: Sequence[T | None], add: Callable[[T, T], T]) -> T | None:
    """Add runs of terms, then runs of their sums, until one is left.

    Args:
        terms: in an order that does not depend on who computed them; None for a missing one.
        add: sum of two terms, which it does not change.

    Returns:
        The sum, None where there is no term.
    """
    while len(terms) > 1:
        terms = [sum_run([terms[k] for k in run], add) for run in runs(len(terms))]
    return terms[0] if terms else None
