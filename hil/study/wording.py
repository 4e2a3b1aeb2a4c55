"""Words and numbers that the sentences of a study are made of."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Final

from hil.report import numbers

from .results import ComparisonResult, ConditionResult, CrossCell
from .verdict import SMALL

FLY_BY: Final = "fly-by"
TOO_FEW: Final = "too few repetitions or motions to tell"
_NO_NAMES: Final = ("no ", "too few ")  # what is told begins with these, or with a method's label
ASTERISK: Final = "An asterisk marks a difference that is told."
LITTLE: Final = f"{100.0 * SMALL:g} %"
"""What a difference must reach to matter."""
_ELASTICITY: Final = re.compile(r"elasticity of (?P<sizes>[0-9.e+-]+(, [0-9.e+-]+)*) rad/\(N·m\)")
_OPENINGS: Final = {
    "plain": "without unmodelled effects",
    "effects": "with unmodelled effects",
}


def compared(condition: ConditionResult, motion_class: str) -> ComparisonResult | None:
    """The first two methods on one class."""
    if len(condition.methods) < 2:
        return None
    return pair(condition, condition.methods[0].key, condition.methods[1].key, motion_class)


def pair(
    condition: ConditionResult, first: str, second: str, motion_class: str
) -> ComparisonResult | None:
    """One pair of methods, in this order, on one class."""
    return next(
        (
            one
            for one in condition.comparisons
            if (one.motion_class, one.first, one.second) == (motion_class, first, second)
        ),
        None,
    )


def main_class(condition: ConditionResult) -> str:
    """The class that a comparison is told of first: the robot's own motions, if there are any."""
    there = [one.motion_class for one in condition.classes]
    return FLY_BY if FLY_BY in there or not there else there[0]


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
    return upper(where(condition))


def where(condition: ConditionResult) -> str:
    """The condition in the middle of a sentence."""
    return _OPENINGS.get(condition.key, condition.words)


def under_each(told: Sequence[tuple[ConditionResult, str]]) -> str:
    """What is told of each condition, as one sentence; once where it is the same of all."""
    if not told:
        return ""
    conditions, words = zip(*told, strict=True)
    if len(set(words)) == 1:
        both = [one.key for one in conditions] == list(_OPENINGS)
        line = f"{words[0]}{', with and without unmodelled effects' if both else ''}."
        return upper(line) if line.startswith(_NO_NAMES) else line
    return upper(
        "; ".join(f"{where(one)} {text}" for one, text in told) + "."
    )  # the conditions differ, so each is named


def outcome(one: ComparisonResult, labels: Mapping[str, str]) -> str:
    """What is told of a pair: whose error is smaller, and by how much."""
    if one.verdict == "too few":
        return TOO_FEW
    if not one.differs:
        return "no difference is shown"
    better = labels[one.second] if one.ratio < 1.0 else labels[one.first]
    saved = numbers.significant(100.0 * (1.0 - min(one.ratio, 1.0 / one.ratio)), 2)
    slightly = "slightly " if one.verdict.startswith("slightly") else ""
    return f"{better} is {slightly}better, its error {saved} % smaller"


def outcome_in(condition: ConditionResult, one: ComparisonResult) -> str:
    """What is told of the first two methods, and whether more motion of one is all there is to it.

    As many repetitions of a longer motion are more data, and see more of an arm that warms up.
    """
    told, equal = outcome(one, labels_of(condition)), condition.equal_data
    if equal is None or not one.differs:
        return told
    gone = any(
        each.verdict == "none"
        for each in equal.comparisons
        if each.motion_class == one.motion_class
    )
    return f"{told}, but not with as much motion of each" if gone else told


def ratio_words(one: ComparisonResult, labels: Mapping[str, str]) -> str:
    """The ratio of two errors and what is told of it, as the end of a sentence."""
    first, second = labels[one.first], labels[one.second]
    told = {"none": ", no difference", "too few": f", {TOO_FEW}"}.get(one.verdict, "")
    if one.verdict.startswith("slightly"):
        told = f", a difference of less than {LITTLE}"
    return (
        f"the error with {second} is {numbers.fixed(one.ratio, 3)} times that with"
        f" {first}{interval(one)}{told}"
    )


def interval(one: ComparisonResult) -> str:
    """The interval of a ratio in brackets, with a space before; nothing where there is none."""
    if one.low is None or one.high is None:
        return ""
    return f" (interval {numbers.fixed(one.low, 3)} to {numbers.fixed(one.high, 3)})"


def ratios_of(pairs: Sequence[tuple[str, ComparisonResult]]) -> str:
    """Several ratios, each under its name, and what their asterisks mean."""
    told = "; ".join(
        f"{name} {numbers.fixed(one.ratio, 3)}{mark(one)}{interval(one)}" for name, one in pairs
    )
    if all(one.verdict == "too few" for _, one in pairs):
        return f"{told}: {TOO_FEW}."
    if not any(one.differs for _, one in pairs):
        return f"{told}: no difference is shown."
    return f"{told}. {ASTERISK}"


def mark(one: ComparisonResult) -> str:
    """An asterisk where a difference is told."""
    return "*" if one.differs else ""


def percent(share: float) -> str:
    """A share in per cent."""
    return f"{numbers.significant(100.0 * share, 3)} %"


def effect_words(effects: Sequence[str], joint_names: Sequence[str]) -> list[str]:
    """Effects as archives name them, for people: the joints that bend, and spaces before units."""
    return [_bending(one, joint_names) for one in (text.replace("%", " %") for text in effects)]


def _bending(effect: str, joint_names: Sequence[str]) -> str:
    """An elasticity that is listed joint by joint: each size once, and the joints that have it."""
    found = _ELASTICITY.fullmatch(effect)
    sizes = [] if found is None else [float(size) for size in found["sizes"].split(", ")]
    if found is None or len(sizes) != len(joint_names):
        return effect
    joints: dict[float, list[str]] = {}
    for size, name in zip(sizes, joint_names, strict=True):
        if size:
            joints.setdefault(size, []).append(name)
    parts = [f"{1e6 * size:g} µrad/(N·m) in {listed(names)}" for size, names in joints.items()]
    return f"elasticity of {' and '.join(parts)}"


def upper(words: str) -> str:
    """Words with a capital at their beginning."""
    return words[:1].upper() + words[1:]


def lower(words: str) -> str:
    """Words without one, in the middle of a sentence."""
    return words[:1].lower() + words[1:] if words[1:2].islower() else words


def counted(count: int, one: str, many: str) -> str:
    """A number, up to six as a word, with its noun."""
    words = {0: "none", 1: "one", 2: "two", 3: "three", 4: "four", 5: "five", 6: "six"}
    return f"{words.get(count, str(count))} {one if count == 1 else many}"


def listed(words: Sequence[str]) -> str:
    """Words with commas and an "and"."""
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"
