"""What the numbers of a study say: some twenty sentences, made from them and from nothing else."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from hil.report.numbers import fixed, significant

from .records import CLASSES, PLANTED
from .results import (
    ALPHA,
    SMALL,
    AblationResult,
    ComparisonResult,
    ConditionResult,
    Paragraph,
    StudyResults,
)
from .searches import AP, B0, A, B

TOO_FEW: Final = "too few repetitions or motions for a conclusion"
OWN_CLASS: Final = {A: "sinusoid", B: "fly-by", B0: "stop-to-stop"}
"""Class of motion by the method whose excitation is of it."""
_WHERE: Final = {"plain": "without unmodelled effects", "effects": "with unmodelled effects"}


def reading_of(results: StudyResults) -> list[Paragraph]:
    """All paragraphs, the answer to the paper's question first."""
    paragraphs = [
        _prediction(results),
        _classes(results),
        _effects(results),
        _criteria(results),
        _parameters(results),
        *(_ablation(one) for one in results.ablations),
        _limits(results),
    ]
    return [one for one in paragraphs if one.sentences]


def answer_of(results: StudyResults) -> dict[str, Any]:
    """The conclusions for a script, and in one line: `line`, and the ratios that it rests on."""
    fields = {
        *("motion_class", "first", "second", "ratio", "level", "verdict", "p_corrected"),
    }
    conclusions = [f"{one.heading} {one.verdict}" for one in results.reading if one.verdict]
    return {
        "name": results.name,
        "simulated": results.simulated,
        "quick": results.quick,
        "line": " ".join(conclusions) or f"{results.name}: one excitation, nothing to compare.",
        "ratios": [
            {
                "condition": condition.key,
                **one.model_dump(include=fields),
                "interval": None if one.low is None else [one.low, one.high],
                "differs": one.differs,
            }
            for condition in results.conditions
            for one in condition.comparisons
        ],
        "cross": [one.model_dump() for some in results.conditions for one in some.cross],
        "missing": results.missing,
    }


def _prediction(results: StudyResults) -> Paragraph:
    """The first two methods on the robot's own motions: the paper's Fig. 3."""
    labels = results.conditions[0].labels
    if len(labels) < 2:
        return Paragraph(key="prediction", heading="", sentences=[])
    first, second = list(labels)[:2]
    pairs = [(one, row) for one in results.conditions if (row := _main(one)) is not None]
    kind = pairs[0][1].motion_class if pairs else "held-out"
    heading = f"Does {labels[second]} predict {kind} motions better than {labels[first]}?"
    if not pairs:
        return Paragraph(
            key="prediction",
            heading=heading,
            verdict="There is no held-out motion, so nothing can be predicted.",
            sentences=["The tables and figures below are of the excitations and the parameters."],
        )
    sentences = [f"{_where(one)}, {_ratio(row, one.labels)}." for one, row in pairs]
    printed = [
        (one, row)
        for one in results.conditions
        if (row := one.compared("fly-by", AP, B)) is not None
    ]
    if printed:
        sentences.append(
            "A is its best search here, beyond the frequencies that the paper prints. Compared"
            f" with A as printed: {_lower(_each(printed))}"
        )
    directions = {row.ratio < 1.0 for _, row in pairs if row.differs}
    if len(directions) == 2 and all(one.key.startswith("recorded") for one, _ in pairs):
        sentences.insert(
            0,
            "The same motions, run in each campaign, lead to opposite conclusions: the state of"
            " the arm differs from one campaign to the other.",
        )
    more = [text for one, _ in pairs for text in _details(one)]
    return Paragraph(
        key="prediction", heading=heading, verdict=_each(pairs), sentences=sentences, more=more
    )


def _details(condition: ConditionResult) -> list[str]:
    """Errors of the estimates themselves, and the comparison with equal data."""
    labels, where, equal = condition.labels, _where(condition), condition.equal_data
    sentences = [
        f"{where}, without the noise that every estimate leaves, {_ratio(row, labels)}."
        for row in condition.own_comparisons
        if row.motion_class == "fly-by"
    ]
    if equal is not None:
        data = (
            f"{where}, with as much motion of each ({equal.repetitions} repetitions of"
            f" {labels[equal.cut]}, {equal.seconds:.0f} s, and {equal.other_seconds:.0f} s of"
            f" {labels[equal.other]})"
        )
        labels = labels | {equal.name: labels[equal.cut]}
        rows = (row for row in equal.comparisons if row.motion_class == "fly-by")
        sentences += [f"{data}, {_ratio(row, labels)}." for row in rows]
    return sentences


def _classes(results: StudyResults) -> Paragraph:
    """Whether estimates predict their own class of motion best: the paper's main argument."""
    counts, sentences, best, total = [], [], 0, 0
    for condition in results.conditions:
        present = {one.motion_class for one in condition.classes}
        own = {
            k: name for k, name in OWN_CLASS.items() if k in condition.labels and name in present
        }
        if len(own) < 2:  # of one class there is nothing to compare it with
            continue
        upheld = sum(_best(condition, key, name) for key, name in own.items())
        best, total = best + upheld, total + len(own)
        counts.append(f"{upheld} of {len(own)} {_WHERE.get(condition.key, condition.words)}")
        medians = {
            name: [one.median for one in condition.cross
                   if one.motion_class == name and one.method in condition.labels]
            for name in present
        }  # fmt: skip
        widest = max(
            CLASSES, key=lambda c: max(medians[c]) / min(medians[c]) if c in medians else 0
        )
        factor = max(medians[widest]) / min(medians[widest])
        sentences.append(
            f"{_where(condition)}, the choice of the estimate changes the median error within a"
            f" class by a factor of {factor:.2f} at most ({widest})."
        )
    if not counts:
        return Paragraph(key="classes", heading="", sentences=[])
    answer = "Yes" if best == total else "In part" if best else "No"
    return Paragraph(
        key="classes",
        heading="Do estimates predict their own class of motion best?",
        verdict=f"{answer}: {', '.join(counts)}.",
        sentences=sentences,
        more=["Best means significantly better than every other estimate."],
    )


def _best(condition: ConditionResult, key: str, motion_class: str) -> bool:
    """Whether an estimate is significantly better on a class than all others."""
    rows = [
        one.verdict.endswith("better" if one.second == key else "worse")
        for one in condition.comparisons
        if one.motion_class == motion_class and key in (one.first, one.second)
    ]
    return bool(rows) and all(rows)


def _effects(results: StudyResults) -> Paragraph:
    """How the conclusion depends on what the model leaves out."""
    heading = "Does that depend on the unmodelled effects?"
    rows = {one.key: _main(one) for one in results.conditions}
    before, after = rows.get("plain"), rows.get("effects")
    if before is None or after is None:
        return Paragraph(key="effects", heading=heading, sentences=[])
    with_effects = next(one for one in results.conditions if one.key == "effects")
    same = (before.differs, before.ratio < 1.0) == (after.differs, after.ratio < 1.0)
    same = same or not (before.differs or after.differs)
    sentences = [
        f"The effects change the ratio of the errors from {fixed(before.ratio, 3)} to"
        f" {fixed(after.ratio, 3)} on {after.motion_class} motions."
    ]
    planted = [c for c in with_effects.cross if (c.method, c.motion_class) == (PLANTED, "fly-by")]
    if planted:
        sentences.append(
            "With them, the error of the planted values themselves is"
            f" {_percent(planted[0].median)}: an estimate that includes part of the effects may be"
            " below that."
        )
    return Paragraph(
        key="effects",
        heading=heading,
        verdict="No." if same else f"Yes: {_each([(with_effects, after)])}",
        sentences=sentences,
        more=[f"Effects: {'; '.join(with_effects.effects)}."],
    )


def _criteria(results: StudyResults) -> Paragraph:
    """Table 1."""
    ours, paper = ({r.key: r for r in results.table1 if r.printed is p} for p in (False, True))
    if not {A, B} <= ours.keys():
        return Paragraph(key="criteria", heading="The two excitations", sentences=[])
    a, b = ours[A], ours[B]
    sentences = [
        f"A reaches log det {fixed(a.log10_det, 1)} with I_c {fixed(a.coupling_index, 1)},"
        f" B {fixed(b.log10_det, 1)} with {fixed(b.coupling_index, 1)}."
    ]
    if {A, B} <= paper.keys():
        det = (a.log10_det > b.log10_det) == (paper[A].log10_det > paper[B].log10_det)
        print_a, print_b = paper[A].coupling_index, paper[B].coupling_index
        index = (a.coupling_index < b.coupling_index) == (print_a < print_b)
        sentences += [
            f"The order of {what} is {'as' if alike else 'not as'} in the paper."
            for what, alike in (("the determinants", det), ("the coupling indices", index))
        ]
    return Paragraph(key="criteria", heading="The two excitations", sentences=sentences)


def _parameters(results: StudyResults) -> Paragraph:
    """Table 2."""
    sentences = []
    for condition in results.conditions:
        labels, methods = condition.labels, condition.methods[:2]
        stds = [np.array(one.std) for one in methods]
        if len(methods) > 1 and all(np.any(std) for std in stds):
            usable = (stds[0] > 0.0) & (stds[1] > 0.0)
            ratio = float(np.exp(np.mean(np.log(stds[1][usable] / stds[0][usable]))))
            sentences.append(
                f"{_where(condition)}, the standard deviation over the repetitions with"
                f" {methods[1].label} is {fixed(ratio, 2)} times that with {methods[0].label}"
                " (geometric mean of the parameters)."
            )
        if condition.closeness:
            one = condition.closeness[0]
            sentences.append(
                f"{_where(condition)}, {labels[one.second]} is closer to π_C than"
                f" {labels[one.first]} in "
                + "; ".join(
                    f"{row.second_closer} of {row.parameters} in {row.group}"
                    for row in condition.closeness
                )
                + "."
            )
    return Paragraph(key="parameters", heading="The parameters", sentences=sentences)


def _ablation(ablation: AblationResult) -> Paragraph:
    """Which settings lie beyond what other repetitions of the study's own motion would give."""
    sentences = [ablation.words]
    bands = [
        one
        for one in ablation.bands
        if one.motion_class == "fly-by" and ablation.key in ("fly", "n_via", "weight")
    ]
    for band in bands[-1:]:  # the last is of the estimate itself, where that is known
        outside = [
            point.name
            for point in ablation.points
            if not point.base
            and (point.method, point.repetitions) == (band.method, band.repetitions)
            for value in [(point.own if band.quantity == "own" else point.error).get("fly-by")]
            if value is not None and not band.low <= value <= band.high
        ]
        sentences.append(
            f"Other repetitions of the study's own B have a fly-by error of"
            f" {_percent(band.low)} to {_percent(band.high)}: outside that range:"
            f" {', '.join(outside) or 'no setting'}."
        )
    if ablation.key in ("n_via", "weight"):
        sentences.append("Each setting is one search: differences may be chance of the search.")
    return Paragraph(
        key=f"ablation-{ablation.key}",
        heading=ablation.title,
        sentences=[*sentences, *ablation.missing],
    )


def _limits(results: StudyResults) -> Paragraph:
    """How differences are judged, and what the numbers cannot show."""
    sentences = []
    if any(one.comparisons for one in results.conditions):
        sentences += [
            "Intervals treat the held-out motions and the repetitions of each estimate as random"
            f" samples, and hold together in {100.0 * (1.0 - ALPHA):g} % of cases for all"
            " comparisons of their table. A difference is significant where the interval excludes"
            f" 1, and called slight below {100.0 * SMALL:g} %.",
            "Each excitation is the result of one search: another search, or another arm, may lead"
            " to another conclusion.",
        ]
    if results.simulated:
        sentences.append(
            "The arm is simulated: it is rigid with exactly the model's friction, and has the"
            " effects that are named and no others."
        )
    if results.quick:
        sentences.append(
            "This is the quick setting: short searches, few repetitions and few motions. It shows"
            " how the study works and supports no conclusion."
        )
    return Paragraph(key="limits", heading="What this does not show", sentences=sentences)


def _main(condition: ConditionResult) -> ComparisonResult | None:
    """The first two methods on the robot's own motions; on the first class where there are none."""
    names = [one.motion_class for one in condition.classes]
    if len(condition.methods) < 2 or not names:
        return None
    first, second = list(condition.labels)[:2]
    return condition.compared("fly-by" if "fly-by" in names else names[0], first, second)


def _each(pairs: Sequence[tuple[ConditionResult, ComparisonResult]]) -> str:
    """The conclusion under each condition; once where it is the same."""
    texts = [_outcome(condition, row) for condition, row in pairs]
    if len(set(texts)) == 1:
        return f"{_upper(texts[0]) if texts[0] in (TOO_FEW, _NONE) else texts[0]}."
    named = [f"{_lower(_where(one))} {text}" for (one, _), text in zip(pairs, texts, strict=True)]
    return _upper("; ".join(named) + ".")


_NONE: Final = "no significant difference"


def _outcome(condition: ConditionResult, row: ComparisonResult) -> str:
    """Whose error is smaller, by how much, and whether more motion is all there is to it."""
    if not row.differs:
        return TOO_FEW if row.verdict == "too few" else _NONE
    better = condition.labels[row.second if row.ratio < 1.0 else row.first]
    saved = significant(100.0 * (1.0 - min(row.ratio, 1.0 / row.ratio)), 2)
    slightly = "slightly " if row.verdict.startswith("slightly") else ""
    text = f"{better} is {slightly}better, its error {saved} % smaller"
    equal = condition.equal_data.comparisons if condition.equal_data is not None else []
    gone = any(o.verdict == "none" for o in equal if o.motion_class == row.motion_class)
    return f"{text}, but not with as much motion of each" if gone else text


def _ratio(row: ComparisonResult, labels: dict[str, str]) -> str:
    """The ratio of two errors, in words."""
    interval = "" if row.low is None else f" (interval {fixed(row.low, 3)} to {fixed(row.high, 3)})"
    return (
        f"the error with {labels[row.second]} is {fixed(row.ratio, 3)} times that with"
        f" {labels[row.first]}{interval}, smaller on {row.wins} of {row.motions} motions"
    )


def _where(condition: ConditionResult) -> str:
    return _upper(_WHERE.get(condition.key, condition.words))


def _percent(share: float) -> str:
    return f"{significant(100.0 * share, 3)} %"


def _upper(words: str) -> str:
    return words[:1].upper() + words[1:]


def _lower(words: str) -> str:
    return words[:1].lower() + words[1:] if words[1:2].islower() else words
