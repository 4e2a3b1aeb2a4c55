"""Where the second method beats the first on the interpolator's motions: the paper's Fig. 3."""

from __future__ import annotations

from collections.abc import Sequence

from hil.report import numbers

from .reading_sines import as_printed
from .records import PLANTED
from .results import (
    ComparisonResult,
    ConditionResult,
    EqualDataResult,
    Paragraph,
    StudyResults,
)
from .wording import (
    FLY_BY,
    cell_of,
    compared,
    counted,
    interval,
    labels_of,
    listed,
    main_class,
    opening,
    outcome_in,
    percent,
    ratio_words,
    under_each,
    upper,
    where,
)


def prediction_paragraph(results: StudyResults) -> Paragraph:
    """The first two methods on the robot's own motions; on another class where there are none."""
    names = list(labels_of(results.conditions[0]).values())
    if len(names) < 2:
        return Paragraph(key="prediction", heading="", sentences=[])
    pairs = [
        (condition, one)
        for condition in results.conditions
        if (one := compared(condition, main_class(condition))) is not None
    ]
    own = not pairs or main_class(pairs[0][0]) == FLY_BY
    kind = "the robot's own" if own else "held-out"
    heading = f"Does {names[1]} predict {kind} motions better than {names[0]}?"
    if not pairs:
        return Paragraph(
            key="prediction",
            heading=heading,
            verdict="There is no held-out motion, so nothing can be predicted.",
            sentences=["Tables and figures of the excitations and parameters stand below."],
        )
    return Paragraph(
        key="prediction",
        heading=heading,
        verdict=under_each([(c, outcome_in(c, one)) for c, one in pairs]),
        sentences=[
            *_at_home(pairs),
            _sentence(pairs),
            *as_printed(results),
        ],
        more=[text for condition, _ in pairs for text in _closer(condition)],
    )


def _sentence(pairs: Sequence[tuple[ConditionResult, ComparisonResult]]) -> str:
    condition, first = pairs[0]
    labels = labels_of(condition)
    kind = "wide fly-by" if first.motion_class == FLY_BY else first.motion_class
    parts = [
        f"{where(each)} {numbers.fixed(one.ratio, 3)} times that with"
        f" {labels[one.first]}{interval(one)}, smaller on {one.wins} of {one.motions}"
        for each, one in pairs
    ]
    return f"On {kind} motions the error with {labels[first.second]} is {'; '.join(parts)}."


def _at_home(pairs: Sequence[tuple[ConditionResult, ComparisonResult]]) -> list[str]:
    """Where the answer depends on the campaign whose motions are predicted."""
    sides = {one.ratio < 1.0 for _, one in pairs if one.differs}
    if len(sides) < 2 or any(not c.key.startswith("recorded") for c, _ in pairs):
        return []
    return [
        "The same motions, run in each campaign, give opposite answers: what differs is the state"
        " of the arm from one campaign to the other, and not what the excitations are worth."
    ]


def _closer(condition: ConditionResult) -> list[str]:
    """Axes, what the estimates themselves are off by, and the same with equal data."""
    labels = labels_of(condition)
    told = [
        _joints(condition.joint_comparisons, labels) if condition.joint_comparisons else "",
        _own(condition, labels),
        _equal(condition.equal_data, labels) if condition.equal_data is not None else "",
    ]
    words = " ".join(text for text in told if text)
    return [f"{opening(condition)}: {words}"] if words else []


def _joints(comparisons: Sequence[ComparisonResult], labels: dict[str, str]) -> str:
    first, second = labels[comparisons[0].first], labels[comparisons[0].second]
    better = [one for one in comparisons if one.differs and one.ratio < 1.0]
    worse = [one for one in comparisons if one.differs and one.ratio > 1.0]
    rest = len(comparisons) - len(better) - len(worse)
    if all(one.verdict == "too few" for one in comparisons):
        return ""
    if rest == len(comparisons):
        return "no single axis shows a difference."
    parts = [
        f"{second} is better on {listed([_joint(one) for one in better])}" if better else "",
        f"{first} is better on {listed([_joint(one) for one in worse])}" if worse else "",
        f"{counted(rest, 'axis shows', 'axes show')} no difference" if rest else "",
    ]
    return f"axis by axis, {'; '.join(part for part in parts if part)}."


def _joint(one: ComparisonResult) -> str:
    slightly = ", slightly" if one.verdict.startswith("slightly") else ""
    return f"{one.joint} (ratio {numbers.fixed(one.ratio, 3)}{slightly})"


def _own(condition: ConditionResult, labels: dict[str, str]) -> str:
    """What the estimates themselves add to what even the planted values miss."""
    one = next((c for c in condition.own_comparisons if c.motion_class == FLY_BY), None)
    cells = [cell_of(condition, key, FLY_BY) for key in (*list(labels)[:2], PLANTED)]
    if one is None or any(cell is None for cell in cells):
        return ""
    first, second, planted = (cell for cell in cells if cell is not None)
    if first.own_median is None or second.own_median is None:
        return ""
    mostly = max(first.own_median, second.own_median) < 0.5 * planted.median
    names = labels[one.first], labels[one.second]
    told = (
        f"Nearly all of the error is what even the planted values miss ({percent(planted.median)});"
        " what the estimates themselves are off by, ‖Φ(π − planted)‖ / ‖τ‖, is"
        if mostly
        else f"The planted values miss {percent(planted.median)}; what the estimates themselves are"
        " off by, ‖Φ(π − planted)‖ / ‖τ‖, is"
    )
    return (
        f"{told} {percent(first.own_median)} with {names[0]} and {percent(second.own_median)} with"
        f" {names[1]}: {ratio_words(one, labels)}."
    )


def _equal(equal: EqualDataResult, labels: dict[str, str]) -> str:
    """The same with as much motion of each."""
    one = next((c for c in equal.comparisons if c.motion_class == FLY_BY), None)
    if one is None:
        return ""
    # The cut estimate has a name of its own.
    named = labels | {equal.name: labels[equal.cut]}
    return upper(
        f"with as much motion of each ({counted(equal.repetitions, 'repetition', 'repetitions')}"
        f" of {labels[equal.cut]}, {numbers.fixed(equal.seconds, 0)} s, beside"
        f" {numbers.fixed(equal.other_seconds, 0)} s of {labels[equal.other]})"
        f" {ratio_words(one, named)}."
    )
