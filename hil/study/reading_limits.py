"""What the numbers of a study cannot show."""

from __future__ import annotations

from typing import Final

from .results import ConditionResult, Paragraph, StudyResults
from .verdict import ALPHA
from .wording import LITTLE, TOO_FEW, listed, opening, upper

_ROUNDED: Final = 6e-4
"""Of the print's three decimals, and of planted values that are feasible together."""


def limits_paragraph(results: StudyResults) -> Paragraph:
    """How differences are judged, and what stands behind none of the numbers."""
    judged = any(one.comparisons for one in results.conditions)
    sentences = [
        "Intervals take the held-out motions and the repetitions behind each estimate as drawn by"
        f" chance, and hold together in {100.0 * (1.0 - ALPHA):g} % of cases for all comparisons"
        " of their table. A difference is told where the interval leaves out 1, and called slight"
        f" where it is less than {LITTLE}. Wilcoxon's signed ranks, corrected after Holm, are over"
        " the motions for these very estimates: no verdict rests on them.",
        "One search stands behind each excitation: another search, or another arm, may come out"
        " otherwise.",
    ]
    sentences = sentences if judged else []
    if results.simulated:
        sentences.append(_arm(results))
    sentences += [text for text in map(_too_few, results.conditions) if text]
    if results.quick:
        sentences.append(
            "This is the quick setting: short searches, few repetitions and few motions. It shows"
            " how the study works and settles nothing."
        )
    return Paragraph(key="limits", heading="What this does not show", sentences=sentences)


def _arm(results: StudyResults) -> str:
    values = "; its parameters are the manufacturer's column π_C" if _is_print(results) else ""
    conditions = {one.key: one for one in results.conditions}
    if "effects" in conditions:
        law = (
            "without effects it is rigid and has just the model's friction, with them it does what"
            " the cell file says and no more"
        )
    elif any(one.effects for one in results.conditions):
        law = "of what a real arm does it has the effects that are named, and no more"
    else:
        law = "it is rigid and has just the model's friction"
    return f"The arm is simulated{values}: {law}."


def _is_print(results: StudyResults) -> bool:
    """Whether what is planted is what the paper prints."""
    known = [
        (one.printed_factor * one.truth, one.printed_c)
        for one in results.parameters
        if one.truth is not None and one.printed_c is not None
    ]
    return bool(known) and all(abs(ours - print_) < _ROUNDED for ours, print_ in known)


def _too_few(condition: ConditionResult) -> str:
    tables = {
        "the cross table": condition.comparisons,
        "the table of the axes": condition.joint_comparisons,
    }
    blind = [name for name, rows in tables.items() if any(one.verdict == "too few" for one in rows)]
    return upper(f"{opening(condition)}: {TOO_FEW} in {listed(blind)}.") if blind else ""
