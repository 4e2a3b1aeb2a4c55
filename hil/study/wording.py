"""Words and numbers that the sentences of a study are made of."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from hil.report import numbers

from .results import ComparisonResult, ConditionResult, CrossCell

ALPHA: Final = 0.05
"""A difference is one where chance, after Holm's correction, would give it less often."""


def differs(one: ComparisonResult) -> bool:
    """Whether the two estimates differ on these motions by more than chance.

    The signed ranks must say so, the interval of the ratio, and most motions on the side of the
    ratio: ranks may point one way and the mean, drawn by a few motions, the other.
    """
    one_side = 2 * one.wins > one.motions if one.ratio < 1.0 else 2 * one.wins < one.motions
    return one.p_corrected < ALPHA and one_side and not one.low <= 1.0 <= one.high


def compared(condition: ConditionResult, motion_class: str) -> ComparisonResult | None:
    """The first two methods on one class."""
    if len(condition.methods) < 2:
        return None
    keys = condition.methods[0].key, condition.methods[1].key
    return next(
        (
            one
            for one in condition.comparisons
            if one.motion_class == motion_class and (one.first, one.second) == keys
        ),
        None,
    )


def cell_of(condition: ConditionResult, method: str, motion_class: str) -> CrossCell | None:
    """Entry of the cross table, if there is one."""
    return next(
        (c for c in condition.cross if (c.method, c.motion_class) == (method, motion_class)), None
    )


def labels_of(condition: ConditionResult) -> dict[str, str]:
    """Labels of the methods by key, in the order of the tables."""
    return {one.key: one.label for one in condition.methods}


def opening(condition: ConditionResult) -> str:
    """How a sentence about a condition begins."""
    return {
        "plain": "Without unmodelled effects",
        "effects": "With unmodelled effects",
    }.get(condition.key, "As recorded")


def p_value(one: ComparisonResult) -> str:
    """Corrected p value with its sign of relation."""
    return "< 0.0001" if one.p_corrected < 1e-4 else "= " + numbers.significant(one.p_corrected, 2)


def ratio_words(one: ComparisonResult, first: str, second: str) -> str:
    """The ratio of two errors, and whether they differ, as the end of a sentence."""
    told = (
        f"the error with {second} is {numbers.fixed(one.ratio, 3)} times that with {first}"
        f" (95 % interval {numbers.fixed(one.low, 3)} to {numbers.fixed(one.high, 3)}, p"
        f" {p_value(one)})"
    )
    return told if differs(one) else f"{told}, which may be chance"


def mark(one: ComparisonResult) -> str:
    """An asterisk where two estimates differ."""
    return "*" if differs(one) else ""


def percent(share: float) -> str:
    """A share in per cent."""
    return f"{numbers.significant(100.0 * share, 3)} %"


def counted(count: int, one: str, many: str) -> str:
    """A number, up to six as a word, with its noun."""
    words = {0: "none", 1: "one", 2: "two", 3: "three", 4: "four", 5: "five", 6: "six"}
    return f"{words.get(count, str(count))} {one if count == 1 else many}"


def listed(words: Sequence[str]) -> str:
    """Words with commas and an "and"."""
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"
