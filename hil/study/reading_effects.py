"""How the answer depends on what the model leaves out."""

from __future__ import annotations

from hil.report import numbers

from .records import PLANTED
from .results import ConditionResult, Paragraph, StudyResults
from .wording import (
    ASTERISK,
    FLY_BY,
    cell_of,
    compared,
    effect_words,
    labels_of,
    listed,
    mark,
    opening,
    outcome_in,
    percent,
)

_HEADING = "How does that depend on what the model leaves out?"


def effects_paragraph(results: StudyResults) -> Paragraph:
    """Both conditions beside each other; nothing where there is one."""
    by_key = {one.key: one for one in results.conditions}
    if not {"plain", "effects"} <= by_key.keys():
        return Paragraph(key="effects", heading=_HEADING, sentences=[])
    plain, real = by_key["plain"], by_key["effects"]
    ratios = [
        f"{numbers.fixed(before.ratio, 3)}{mark(before)} becomes"
        f" {numbers.fixed(after.ratio, 3)}{mark(after)} on {name} motions"
        for name in (FLY_BY, "stop-to-stop", "sinusoid")
        if (before := compared(plain, name)) is not None
        and (after := compared(real, name)) is not None
    ]
    second, first = (labels_of(plain)[one.key] for one in reversed(plain.methods[:2]))
    return Paragraph(
        key="effects",
        heading=_HEADING,
        verdict=_verdict(plain, real),
        sentences=[f"The error with {second} over that with {first}: {listed(ratios)}. {ASTERISK}"]
        + [text for one in (plain, real) if (text := _beside_planted(one))],
        more=[f"Switched on: {'; '.join(effect_words(real.effects, results.joint_names))}."],
    )


def _verdict(plain: ConditionResult, real: ConditionResult) -> str:
    before, after = compared(plain, FLY_BY), compared(real, FLY_BY)
    if before is None or after is None:
        return ""
    if (before.differs, before.ratio < 1.0) == (after.differs, after.ratio < 1.0) or not (
        before.differs or after.differs
    ):
        told = outcome_in(real, after)
        return f"On fly-by motions it does not: {told} either way."
    return (
        f"On fly-by motions it does: without them {outcome_in(plain, before)}; with them"
        f" {outcome_in(real, after)}."
    )


def _beside_planted(condition: ConditionResult) -> str:
    """What is left even when the planted parameters predict, and the estimates beside it."""
    planted = cell_of(condition, PLANTED, FLY_BY)
    own = [cell_of(condition, key, FLY_BY) for key in labels_of(condition)]
    known = [one.median for one in own if one is not None]
    if planted is None or not known:
        return ""
    low, high = (numbers.fixed(pick(known) / planted.median, 2) for pick in (min, max))
    span = low if low == high else f"{low} to {high}"
    effects_help = bool(condition.effects) and max(known) < planted.median
    return (
        f"{opening(condition)} the planted values themselves miss {percent(planted.median)}, the"
        f" estimates {span} times as much"
        + (": they take in part of the effects." if effects_help else ".")
    )
