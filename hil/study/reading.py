"""What the numbers of a study say, in sentences that are made from them and from nothing else."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

from hil.report import numbers

from .reading_sines import as_printed
from .reading_tables import ablation_paragraph, criteria_paragraph, parameters_paragraph
from .records import PLANTED
from .results import (
    ComparisonResult,
    ConditionResult,
    EqualDataResult,
    Paragraph,
    StudyResults,
)
from .wording import (
    ALPHA,
    cell_of,
    compared,
    counted,
    differs,
    labels_of,
    listed,
    mark,
    opening,
    p_value,
    percent,
    ratio_words,
)

SMALL: Final = 0.02
"""A difference of errors below this share is shown to be there, and matters to nobody."""
OWN_CLASS: Final = {"a": "sinusoid", "b": "fly-by", "b0": "stop-to-stop"}


def reading_of(results: StudyResults) -> list[Paragraph]:
    """All paragraphs, the answer to the paper's question first."""
    paragraphs = [
        _prediction(results),
        _classes(results),
        _effects(results),
        criteria_paragraph(results),
        parameters_paragraph(results),
        *(ablation_paragraph(one) for one in results.ablations),
        _limits(results),
    ]
    return [one for one in paragraphs if one.sentences]


def _prediction(results: StudyResults) -> Paragraph:
    """Where the second method beats the first on the interpolator's motions: the paper's Fig. 3."""
    sentences: list[str] = []
    names = list(labels_of(results.conditions[0]).values())
    if len(names) < 2:
        return Paragraph(key="prediction", heading="", sentences=[])
    for condition in results.conditions:
        one = compared(condition, "fly-by")
        if one is None:
            continue
        labels = labels_of(condition)
        told = f"{opening(condition)}, {_sentence(one, labels, 'wide fly-by motions')}"
        if condition.joint_comparisons:
            told += f" {_joints(condition.joint_comparisons, labels, either=not differs(one))}"
        told += _own(condition, labels)
        if condition.equal_data is not None:
            told += f" {_equal(condition.equal_data, labels)}"
        sentences.append(told)
    sentences += as_printed(results)
    return Paragraph(
        key="prediction",
        heading=f"Does {names[1]} predict the robot's own motions better than {names[0]}?",
        sentences=sentences,
    )


def _sentence(one: ComparisonResult, labels: dict[str, str], motions: str) -> str:
    first, second = labels[one.first], labels[one.second]
    size = (
        f"{numbers.fixed(one.ratio, 3)} (95 % interval {numbers.fixed(one.low, 3)} to"
        f" {numbers.fixed(one.high, 3)})"
    )
    count = f"it is smaller on {one.wins} of {one.motions}"
    if not differs(one):
        return (
            f"{one.motions} {motions} show no difference between {second} and {first}: the error"
            f" with {second} is {size} times that with {first}, {count} (p {p_value(one)})."
        )
    word = "better" if one.ratio < 1.0 else "worse"
    though = f", though by less than {SMALL:.0%}".replace("%", " %") if _small(one) else ""
    return (
        f"{second} predicts {one.motions} {motions} {word} than {first}{though}: its error"
        f" is {size} times as large, {count} (p {p_value(one)})."
    )


def _small(one: ComparisonResult) -> bool:
    return abs(one.ratio - 1.0) < SMALL


def _joints(
    comparisons: Sequence[ComparisonResult], labels: dict[str, str], *, either: bool
) -> str:
    first, second = labels[comparisons[0].first], labels[comparisons[0].second]
    better = [one for one in comparisons if differs(one) and one.ratio < 1.0]
    worse = [one for one in comparisons if differs(one) and one.ratio > 1.0]
    rest = len(comparisons) - len(better) - len(worse)
    parts = [
        f"{second} is better on {listed([_joint(one) for one in better])}" if better else "",
        f"{first} is better on {listed([_joint(one) for one in worse])}" if worse else "",
        f"{counted(rest, 'axis shows', 'axes show')} no difference" if rest else "",
    ]
    if rest == len(comparisons):
        return f"No single axis {'shows a difference either' if either else 'shows it by itself'}."
    return f"Axis by axis, {'; '.join(part for part in parts if part)}."


def _equal(equal: EqualDataResult, labels: dict[str, str]) -> str:
    """The same with as much motion of each."""
    one = next((c for c in equal.comparisons if c.motion_class == "fly-by"), None)
    if one is None:
        return ""
    amounts = (
        f"With as much motion of each ({counted(equal.repetitions, 'repetition', 'repetitions')}"
        f" of {labels[equal.cut]}, {numbers.fixed(equal.seconds, 0)} s, beside"
        f" {numbers.fixed(equal.other_seconds, 0)} s of {labels[equal.other]})"
    )
    return f"{amounts} {ratio_words(one, *list(labels.values())[:2])}."


def _own(condition: ConditionResult, labels: dict[str, str]) -> str:
    """What the estimates themselves add to what even the planted values miss."""
    one = next((c for c in condition.own_comparisons if c.motion_class == "fly-by"), None)
    cells = [cell_of(condition, key, "fly-by") for key in (*list(labels)[:2], PLANTED)]
    if one is None or any(cell is None for cell in cells):
        return ""
    first, second, planted = (cell for cell in cells if cell is not None)
    if first.own_median is None or second.own_median is None:
        return ""
    names = [labels[one.first], labels[one.second]]
    return (
        f" Nearly all of that is what even the planted values miss ({percent(planted.median)})."
        if first.own_median < 0.5 * planted.median and second.own_median < 0.5 * planted.median
        else ""
    ) + (
        " What the estimates themselves are off by, ‖Φ(π − planted)‖ / ‖τ‖, is"
        f" {percent(first.own_median)} with {names[0]} and {percent(second.own_median)} with"
        f" {names[1]}: {ratio_words(one, *names)}."
    )


def _joint(one: ComparisonResult) -> str:
    return f"{one.joint} (ratio {numbers.fixed(one.ratio, 3)})"


def _classes(results: StudyResults) -> Paragraph:
    """Whether estimates predict their own class of motion best: the paper's main argument."""
    sentences = []
    for condition in results.conditions:
        labels, there = labels_of(condition), {one.motion_class for one in condition.classes}
        own = {key: name for key, name in OWN_CLASS.items() if key in labels and name in there}
        if len(labels) < 2 or not own:
            continue
        upheld = [_class_sentence(condition, key, name, labels) for key, name in own.items()]
        best = sum(ok for ok, _ in upheld)
        first = (
            f"{opening(condition)}, {best or 'none'} of {len(own)} estimates"
            f" {'predict' if best > 1 else 'predicts'} the class of motion that it was made from"
            " better than every other estimate does."
        )
        told = [first, *(text for _, text in upheld), _spread(condition)]
        sentences.append(" ".join(told))
    return Paragraph(
        key="classes",
        heading="Do estimates predict their own class of motion best?",
        sentences=sentences,
    )


def _class_sentence(
    condition: ConditionResult, key: str, name: str, labels: dict[str, str]
) -> tuple[bool, str]:
    """Whether an estimate is better on its own class than all others, and that in words."""
    better: list[str] = []
    worse: list[str] = []
    same: list[str] = []
    for one in condition.comparisons:
        if one.motion_class != name or key not in (one.first, one.second):
            continue
        other = one.first if one.second == key else one.second
        ratio = one.ratio if one.second == key else 1.0 / one.ratio
        words = f"{labels[other]} (ratio {numbers.fixed(ratio, 3)})"
        (same if not differs(one) else better if ratio < 1.0 else worse).append(words)
    parts = [
        f"better than {listed(better)}" if better else "",
        f"worse than {listed(worse)}" if worse else "",
        f"not told apart from {listed(same)}" if same else "",
    ]
    told = "; ".join(part for part in parts if part)
    return bool(better) and not worse and not same, f"On {name} motions {labels[key]} is {told}."


def _spread(condition: ConditionResult) -> str:
    """How much the choice of the estimate matters beside the class of motion."""
    cells = [one for one in condition.cross if one.method in labels_of(condition)]
    by_class = {
        name: [one.median for one in cells if one.motion_class == name]
        for name in dict.fromkeys(one.motion_class for one in cells)
    }
    widest = max(by_class, key=lambda name: max(by_class[name]) / min(by_class[name]))
    ratio = max(by_class[widest]) / min(by_class[widest])
    medians, raw = ([getattr(c, f) for c in cells] for f in ("median", "unfiltered_median"))
    return (
        f"Median errors lie between {percent(min(medians))} and {percent(max(medians))}; within"
        f" one class the choice of the estimate changes the median by a factor of"
        f" {numbers.fixed(ratio, 2)} at most ({widest}). Without the low-pass of the errors at"
        f" 30 Hz the medians lie between {percent(min(raw))} and {percent(max(raw))}."
    )


def _effects(results: StudyResults) -> Paragraph:
    """How the answer depends on what the model leaves out."""
    sentences: list[str] = []
    if len(results.conditions) > 1:
        plain, real = results.conditions[:2]
        for name in ("fly-by", "stop-to-stop", "sinusoid"):
            before, after = compared(plain, name), compared(real, name)
            if before is None or after is None:
                continue
            sentences.append(
                f"On {name} motions the error with B over that with A goes from"
                f" {numbers.fixed(before.ratio, 3)}{mark(before)} without these effects to"
                f" {numbers.fixed(after.ratio, 3)}{mark(after)} with them."
            )
        sentences = [" ".join(sentences)] if sentences else []
        planted = [text for one in (plain, real) if (text := _beside_planted(one)) is not None]
        sentences += [" ".join(planted)] if planted else []
        sentences.append(
            "Switched on were: " + "; ".join(real.effects) + ". An asterisk marks a ratio that"
            " differs from 1 by more than chance."
        )
    return Paragraph(
        key="effects",
        heading="How does that depend on what the model leaves out?",
        sentences=sentences,
    )


def _beside_planted(condition: ConditionResult) -> str | None:
    """What is left even when the planted parameters predict, and the estimates beside it."""
    planted = cell_of(condition, PLANTED, "fly-by")
    own = [cell_of(condition, key, "fly-by") for key in labels_of(condition)]
    known = [one.median for one in own if one is not None]
    if planted is None or not known:
        return None
    low, high = (numbers.fixed(f(known) / planted.median, 2) for f in (min, max))
    span = low if low == high else f"{low} to {high}"
    effects_help = bool(condition.effects) and max(known) < planted.median
    return (
        f"{opening(condition)}, the planted parameters themselves miss fly-by motions by"
        f" {percent(planted.median)}; the estimates miss them by {span} times as much"
        + (", for they take in part of the effects." if effects_help else ".")
    )


def _limits(results: StudyResults) -> Paragraph:
    """What these numbers cannot show."""
    sentences = [
        "Statistics are over the held-out motions, for the estimates of one search and one set of"
        " repetitions each: another search, or another arm, may come out otherwise.",
        "p values are Wilcoxon's signed-rank test on the ratio of errors motion by motion,"
        " corrected after Holm within each table and condition. Intervals are percentile bootstraps"
        " over the motions, not corrected for their number. A difference is told where p is below"
        f" {ALPHA:g}, the interval leaves out 1 and most motions lie on its side.",
    ]
    if results.simulated:
        sentences.append(
            "The arm is simulated: its parameters are the manufacturer's column pi_C, and it is"
            " rigid with the friction the model has unless the effects are switched on."
        )
    sentences += [text for text in map(_too_few, results.conditions) if text]
    if results.quick:
        sentences.append(
            "This is the quick setting: short searches, few repetitions and few motions. It shows"
            " how the study works and settles nothing."
        )
    return Paragraph(key="limits", heading="What this does not show", sentences=sentences)


def _too_few(condition: ConditionResult) -> str:
    """Where no outcome at all could be told from chance: signed ranks of n have 2**n signs."""
    tables = {
        "the cross table": condition.comparisons,
        "the table of the axes": condition.joint_comparisons,
    }
    blind = [
        f"{name} ({len(rows)} comparisons)"
        for name, rows in tables.items()
        if rows and len(rows) * 2.0 ** (1 - max(one.motions for one in rows)) >= ALPHA
    ]
    if not blind:
        return ""
    return (
        f"{opening(condition)}, so few held-out motions can show no difference whatever they are,"
        f" once p is corrected, in {listed(blind)}."
    )


def answer_of(results: StudyResults) -> dict[str, Any]:
    """The answer for a script, and in one line: `line`, and the ratios that it rests on."""
    ratios = [
        {
            "condition": condition.key,
            "motion_class": one.motion_class,
            "first": one.first,
            "second": one.second,
            "ratio": one.ratio,
            "interval": [one.low, one.high],
            "p_corrected": one.p_corrected,
            "differs": differs(one),
        }
        for condition in results.conditions
        for one in condition.comparisons
    ]
    told = [one for one in results.reading if one.key == "prediction"]
    cells = [one for condition in results.conditions for one in condition.cross]
    line = (
        " ".join(sentence for sentence in told[0].sentences if not sentence.startswith("Axis"))
        if told
        else f"{results.name}: one excitation, nothing to compare it with."
    )
    return {
        "name": results.name,
        "simulated": results.simulated,
        "quick": results.quick,
        "line": line,
        "ratios": ratios,
        "cross": [one.model_dump() for one in cells],
        "missing": results.missing,
    }
