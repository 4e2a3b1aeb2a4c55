"""What the numbers of a study say: some twenty sentences, made from them and from nothing else."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from hil.cell import Cell
from hil.report.numbers import capitalised, fixed, significant
from hil.version import software

from .results import (
    AblationResult,
    ComparisonResult,
    ConditionResult,
    Paragraph,
    StudyParameter,
    StudyResults,
)
from .searches import AP, B0, A, B

_NONE: Final = "no significant difference"
TOO_FEW: Final = "too few repetitions or motions for a conclusion"
OWN_CLASS: Final = {A: "sinusoid", B: "fly-by", B0: "stop-to-stop"}
"""Class of motion by the method whose excitation is of it."""
_WHERE: Final = {"plain": "without unmodelled effects", "effects": "with unmodelled effects"}


def reading_of(results: StudyResults) -> list[Paragraph]:
    """All paragraphs, the paper's question first."""
    paragraphs = [
        _prediction(results),
        _classes(results),
        _effects(results),
        *(_ablation(one) for one in results.ablations),
    ]
    return [one for one in paragraphs if one is not None]


def study_results(
    root: Path, cell: Cell, parameters: list[StudyParameter], **tables: Any
) -> StudyResults:
    """Results of a study with what its numbers say; `tables` are the other fields."""
    results = StudyResults(
        name=root.resolve().name,
        cell=cell.name,
        software=software(),
        joint_names=list(cell.joint_names),
        n_base=len(cell.model.base.names),
        parameters=parameters,
        reading=[],
        **tables,
    )
    return results.model_copy(update={"reading": reading_of(results)})


def summary_of(results: StudyResults) -> dict[str, Any]:
    """The conclusions for a script, and in one line: `line`, and the ratios that it rests on."""
    fields = {"motion_class", "first", "second", "ratio", "level", "verdict", "p_corrected"}
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


def _prediction(results: StudyResults) -> Paragraph | None:
    """The first two methods on the robot's own motions: the paper's Fig. 3."""
    labels = list(results.conditions[0].labels.values())
    if len(labels) < 2:
        return None
    pairs = [(one, row) for one in results.conditions if (row := _main(one)) is not None]
    kind = pairs[0][1].motion_class if pairs else "held-out"
    if not pairs:
        verdict = "There is no held-out motion, so nothing can be predicted."
        sentences = ["The tables and figures below are of the excitations and the parameters."]
    else:
        verdict = _each(pairs)
        sentences = [f"{_where(one)}, {_ratio(row, one.labels)}." for one, row in pairs]
    conditions = results.conditions
    printed = [(one, row) for one in conditions if (row := one.compared("fly-by", AP, B))]
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
    heading = f"Does {labels[1]} predict {kind} motions better than {labels[0]}?"
    return Paragraph(key="prediction", heading=heading, verdict=verdict, sentences=sentences)


def _classes(results: StudyResults) -> Paragraph | None:
    """Whether estimates predict their own class of motion best: the paper's main argument."""
    counts, best, total = [], 0, 0
    for condition in results.conditions:
        present = [one.motion_class for one in condition.classes]
        own = [k for k, name in OWN_CLASS.items() if k in condition.labels and name in present]
        if len(own) > 1:  # of one class there is nothing to compare it with
            upheld = sum(_best(condition, key, OWN_CLASS[key]) for key in own)
            best, total = best + upheld, total + len(own)
            counts.append(f"{upheld} of {len(own)} {_lower(_where(condition))}")
    if not counts:
        return None
    return Paragraph(
        key="classes",
        heading="Do estimates predict their own class of motion best?",
        verdict=f"{'Yes' if best == total else 'In part' if best else 'No'}: {', '.join(counts)}.",
        sentences=["Best means significantly better than every other estimate."],
    )


def _best(condition: ConditionResult, key: str, motion_class: str) -> bool:
    """Whether an estimate is significantly better on a class than all others."""
    rows = [
        one.verdict.endswith("better" if one.second == key else "worse")
        for one in condition.comparisons
        if one.motion_class == motion_class and key in (one.first, one.second)
    ]
    return bool(rows) and all(rows)


def _effects(results: StudyResults) -> Paragraph | None:
    """How the conclusion depends on what the model leaves out."""
    by_key = {one.key: one for one in results.conditions}
    if not {"plain", "effects"} <= by_key.keys():
        return None
    before, after = _main(by_key["plain"]), _main(by_key["effects"])
    if before is None or after is None:
        return None
    same = (before.differs, before.ratio < 1.0) == (after.differs, after.ratio < 1.0)
    same = same or not (before.differs or after.differs)
    return Paragraph(
        key="effects",
        heading="Does that depend on the unmodelled effects?",
        verdict="No." if same else f"Yes: {_each([(by_key['effects'], after)])}",
        sentences=[
            f"The effects change the ratio of the errors from {fixed(before.ratio, 3)} to"
            f" {fixed(after.ratio, 3)} on {after.motion_class} motions.",
            f"Effects: {'; '.join(by_key['effects'].effects)}.",
        ],
    )


def _ablation(ablation: AblationResult) -> Paragraph | None:
    """Which settings lie beyond what other repetitions of the study's own motion would give."""
    bands = [one for one in ablation.bands if one.motion_class == "fly-by" and one.method == B]
    if not bands or ablation.key not in ("fly", "n_via", "weight"):
        return None
    band = bands[-1]  # that of the estimate itself, where it is known
    outside = [
        point.name
        for point in ablation.points
        for value in [getattr(point, band.quantity).get("fly-by", band.low)]
        if not (point.base or band.low <= value <= band.high)
    ]
    low, high = (significant(100.0 * bound, 3) for bound in (band.low, band.high))
    own = "own " if band.quantity == "own" else ""
    text = (
        f"The {own}fly-by error for other repetitions of the study's own B ranges from {low} % to"
        f" {high} %; outside: {', '.join(outside) or 'no setting'}."
    )
    return Paragraph(key=f"ablation-{ablation.key}", heading=ablation.title, sentences=[text])


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
        return f"{capitalised(texts[0]) if texts[0] in (TOO_FEW, _NONE) else texts[0]}."
    named = [f"{_lower(_where(one))} {text}" for (one, _), text in zip(pairs, texts, strict=True)]
    return capitalised("; ".join(named) + ".")


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
    return capitalised(_WHERE.get(condition.key, condition.words))


def _lower(words: str) -> str:
    return words[:1].lower() + words[1:] if words[1:2].islower() else words
