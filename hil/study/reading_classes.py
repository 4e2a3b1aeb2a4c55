"""Whether estimates predict their own class of motion best: the paper's main argument."""

from __future__ import annotations

from typing import Final

from hil.report import numbers

from .results import ConditionResult, Paragraph, StudyResults
from .wording import labels_of, listed, lower, opening, percent, under_each

OWN_CLASS: Final = {"a": "sinusoid", "b": "fly-by", "b0": "stop-to-stop"}
"""Class of motion by the method whose excitation is of it."""


def classes_paragraph(results: StudyResults) -> Paragraph:
    """How many estimates do, under each condition."""
    counts: list[tuple[ConditionResult, str]] = []
    sentences: list[str] = []
    more: list[str] = []
    best = wanted = 0
    for condition in results.conditions:
        labels, there = labels_of(condition), {one.motion_class for one in condition.classes}
        own = {key: name for key, name in OWN_CLASS.items() if key in labels and name in there}
        if len(own) < 2:  # of one class there is nothing to set it beside
            continue
        judged = [_class_sentence(condition, key, name, labels) for key, name in own.items()]
        upheld = sum(ok for ok, _ in judged)
        best, wanted = best + upheld, wanted + len(judged)
        counts.append(
            (condition, f"{upheld or 'none'} of {len(judged)} {'does' if upheld == 1 else 'do'}")
        )
        sentences.append(f"{opening(condition)} {_spread(condition)}")
        more.append(f"{opening(condition)}: {lower(' '.join(text for _, text in judged))}")
    if not counts:
        return Paragraph(key="classes", heading="", sentences=[])
    answer = "Yes" if best == wanted else "In part" if best else "No"
    told = under_each(counts)
    return Paragraph(
        key="classes",
        heading="Do estimates predict their own class of motion best?",
        verdict=f"{answer}: {lower(told)}",
        sentences=sentences,
        more=["Best is what is told to be better than every other estimate.", *more],
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
        slightly = ", slightly" if one.verdict.startswith("slightly") else ""
        words = f"{labels[other]} (ratio {numbers.fixed(ratio, 3)}{slightly})"
        (same if not one.differs else better if ratio < 1.0 else worse).append(words)
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
    medians = [one.median for one in cells]
    return (
        f"the choice of the estimate changes the median error within a class by a factor of"
        f" {numbers.fixed(ratio, 2)} at most ({widest}); medians lie between"
        f" {percent(min(medians))} and {percent(max(medians))}."
    )
