"""Results of a study: `results.json`.

SI units; lists per joint follow `joint_names`, lists per parameter `parameters`. Torque errors are
low-passed at 30 Hz unless stated otherwise.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final, Literal, Self

from pydantic import Field

from hil.report.numbers import capitalised, fixed, significant
from hil.results import Frozen

from .campaigns import AP, OWN_CLASS, A, B
from .records import ExampleRecord, Fitted
from .settings import StudySettings, load_json

SCHEMA_VERSION: Final = 1
ALPHA: Final = 0.05  #: How often, at most, a table shows any difference where there is none
SMALL: Final = 0.02  #: A difference of errors below this share exists and does not matter

Quantity = Literal["error", "own", "parameter_error"]
Verdict = Literal["better", "slightly better", "none", "slightly worse", "worse", "too few"]


class StudyParameter(Frozen):
    """One parameter with the values that the paper prints (null for another arm)."""

    name: str
    unit: str
    truth: float  #: Planted value
    printed_id: int | None = None  #: Row of the paper's Table 2
    printed_symbol: str | None = None
    printed_factor: float = 1.0  #: What a value is multiplied with to compare it with the print
    printed_a: float | None = None
    printed_b: float | None = None
    printed_c: float | None = None


class SearchResult(Frozen):
    """One search and its motion; null figures if it found none."""

    key: str
    words: str
    chosen: bool  #: Whether its motion was executed in full
    tried: int = 0
    infeasible: dict[str, int] = Field(default_factory=dict)
    log10_det: float | None = None
    coupling_index: float | None = None
    duration: float | None = None


class MotionRow(Frozen):
    """A row of Table 1."""

    key: str
    words: str
    n_samples: int
    log10_det: float
    coupling_index: float
    executed_log10_det: float | None = None
    executed_coupling_index: float | None = None
    duration: float | None = None
    printed: bool = False


class MethodResult(Fitted):
    """Estimates of one excitation under one condition."""

    key: str
    label: str
    repetitions: int
    seconds: float  #: Of motion that was fitted, all repetitions
    mean: list[float]  #: Over the repetitions' own estimates: the paper's Table 2
    std: list[float]  #: Over the repetitions, of one of them


class ComparisonResult(Frozen):
    """Two estimates on the same motions: errors with `second` over errors with `first`.

    The interval treats motions and repetitions as random samples; the verdict follows from it.
    """

    motion_class: str
    first: str
    second: str
    motions: int
    repetitions: list[int]  #: Of `first` and `second`
    ratio: float  #: Geometric mean over the motions
    wins: int  #: Motions that `second` predicts better
    error: float | None
    """Standard error of the log ratio; null with fewer than three repetitions, or one motion."""
    freedom: float | None  #: Its degrees of freedom
    level: float = 1.0 - ALPHA
    """Of the interval by itself, such that all of its table hold at 95 % (Bonferroni)."""
    low: float | None = None
    high: float | None = None  #: Interval of the ratio at that level
    verdict: Verdict = "too few"  #: On `second`: whether the interval excludes 1

    @property
    def differs(self) -> bool:
        """Whether the difference is significant."""
        return self.verdict not in ("none", "too few")


class ClassResult(Frozen):
    """The motions of one class, and relative errors ||e|| / ||tau|| of every estimate on each.

    They are low-passed at 30 Hz as in the paper's Fig. 4, which removes the noise of the currents.
    """

    motion_class: str
    archives: list[str]
    durations: list[float]
    overall: dict[str, list[float]]  #: Of all joints together, for each estimate
    own: dict[str, list[float]]
    """||Phi (pi - planted)|| / ||tau||, errors of the estimates themselves, without effects."""
    mean_abs: dict[str, list[list[float]]]
    """Motion by motion, mean |e| per joint, N·m: the paper's Fig. 3."""
    all_rows: dict[str, list[float]]
    """As `overall`, over the whole motion: rows at rest, near ends and at reversals included."""
    left_out: list[float]
    """Share of the samples of the motions that all other errors leave out, per joint."""

    @property
    def left_out_share(self) -> float:
        """Of all joints together."""
        return sum(self.left_out) / len(self.left_out)


class ClosenessResult(Frozen):
    """Number of parameters of a group that are closer to a reference with the second estimate."""

    group: str
    reference: str
    first: str
    second: str
    parameters: int
    second_closer: int
    printed_second_closer: int | None  #: Of the paper's own columns A and B


class EqualDataResult(Frozen):
    """Comparison of the first two methods with equal motion time: the longer one is shortened."""

    cut: str  #: Key of the method of which only the first repetitions are used
    name: str  #: Of that estimate in the cross table
    repetitions: int
    seconds: float
    other: str
    other_seconds: float
    comparisons: list[ComparisonResult]
    """Class by class, in the order of the methods; corrected among themselves."""


class ConditionResult(Frozen):
    """Results of one condition: with or without effects."""

    key: str
    words: str
    effects: list[str]
    methods: list[MethodResult]
    classes: list[ClassResult]
    comparisons: list[ComparisonResult]
    own_comparisons: list[ComparisonResult]
    """The first two, class by class, in the errors of the estimates themselves."""
    equal_data: EqualDataResult | None  #: Null where both have as much motion anyway
    closeness: list[ClosenessResult]
    examples: list[ExampleRecord]

    @property
    def labels(self) -> dict[str, str]:
        """Labels of the methods by key, in the order of the tables."""
        return {one.key: one.label for one in self.methods}

    def compared(self, motion_class: str, first: str, second: str) -> ComparisonResult | None:
        """Return one pair of methods, in this order, on one class."""
        wanted = (motion_class, first, second)
        rows = (c for c in self.comparisons if (c.motion_class, c.first, c.second) == wanted)
        return next(rows, None)


class AblationPoint(Frozen):
    """One setting of an ablation."""

    value: float
    label: str = ""  #: Where the setting is not a number, which `value` then only counts
    method: str
    base: bool  #: Whether it is the setting of the study itself
    repetitions: int
    log10_det: float | None
    coupling_index: float | None
    duration: float | None
    parameter_error: float | None
    """Geometric mean over the parameters of distance to the planted value, the study's B = 1."""
    error: dict[str, float]  #: Median over the motions of each class of ||e|| / ||tau||
    own: dict[str, float]  #: The same of the estimate itself

    @property
    def name(self) -> str:
        """The setting as text."""
        return self.label or f"{self.value:g}"


class ChanceRange(Frozen):
    """Range of a figure over subsets of the study's own repetitions of one method."""

    method: str
    repetitions: int  #: In each subset
    quantity: Quantity
    motion_class: str | None  #: Null for the parameters
    low: float
    high: float  #: 2.5 and 97.5 % of the subsets
    subsets: int


class AblationResult(Frozen):
    """Results with one setting varied."""

    key: str
    title: str
    variable: str
    words: str
    points: list[AblationPoint]
    comparisons: list[ComparisonResult] = Field(default_factory=list)
    """With B, where the settings are another method's."""


class Paragraph(Frozen):
    """One conclusion."""

    key: str
    heading: str
    verdict: str = ""  #: The conclusion in one line, where the heading is a question
    sentences: list[str]


class StudyResults(Frozen):
    """Content of the `results.json` of a study."""

    schema_version: int = SCHEMA_VERSION
    name: str
    cell: str
    simulated: bool
    quick: bool
    settings: StudySettings
    software: dict[str, str]
    joint_names: list[str]
    n_base: int
    parameters: list[StudyParameter]
    searches: list[SearchResult]
    table1: list[MotionRow]
    conditions: list[ConditionResult]
    ablations: list[AblationResult]
    ranges: list[ChanceRange]
    """Of as many repetitions as the ablations have; none where the study has no more itself."""
    reading: list[Paragraph]
    missing: list[str]  #: What of the paper's study is not in this one, and why
    times: dict[str, float]  #: Wall time [s] of each stage in the last session

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read a study's `results.json`; InputError if it is not one."""
        return load_json(cls, path, "is not the result of a study", "run the study again")


_OUTCOMES: Final = {
    "none": "No significant difference",
    "too few": "Too few repetitions or motions for a conclusion",
}


def conclusions(results: StudyResults) -> list[Paragraph]:
    """Return all paragraphs, the paper's question first."""
    found = [_prediction(results), _classes(results), _effects(results)]
    return [one for one in found if one is not None]


def summary_of(results: StudyResults) -> dict[str, Any]:
    """Return the conclusions as JSON data: `line`, and the ratios that it is based on."""
    fields = {"motion_class", "first", "second", "ratio", "level", "verdict"}
    return {
        "name": results.name,
        "simulated": results.simulated,
        "quick": results.quick,
        "line": " ".join(f"{one.heading} {one.verdict}" for one in results.reading if one.verdict),
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
        "missing": results.missing,
    }


def _prediction(results: StudyResults) -> Paragraph:
    """Compare the first two methods on the robot's own motions: the paper's Fig. 3."""
    conditions = results.conditions
    pairs = [(one, _main(one)) for one in conditions]
    printed = [(one, row) for one in conditions if (row := one.compared("fly-by", AP, B))]
    return Paragraph(
        key="prediction",
        heading="Does B predict fly-by motions better than A?",
        verdict=_each(pairs),
        sentences=[
            f"{capitalised(one.words)}, the error with {one.labels[row.second]} is"
            f" {fixed(row.ratio, 3)} times that with {one.labels[row.first]}"
            f" (interval {fixed(row.low, 3)} to {fixed(row.high, 3)}),"
            f" smaller on {row.wins} of {row.motions} motions."
            for one, row in (*pairs, *printed)
        ],
    )


def _classes(results: StudyResults) -> Paragraph | None:
    """Check whether estimates predict their own class of motion best: the paper's main argument."""
    upheld = {
        condition.words: [_best(condition, key, name) for key, name in OWN_CLASS.items()]
        for condition in results.conditions
        if len(condition.classes) == len(OWN_CLASS)
    }
    if not upheld:
        return None
    every = [one for own in upheld.values() for one in own]
    counts = ", ".join(f"{sum(own)} of {len(own)} {words}" for words, own in upheld.items())
    return Paragraph(
        key="classes",
        heading="Do estimates predict their own class of motion best?",
        verdict=f"{'Yes' if all(every) else 'In part' if any(every) else 'No'}: {counts}.",
        sentences=["Best means significantly better than every other estimate."],
    )


def _best(condition: ConditionResult, key: str, motion_class: str) -> bool:
    """Return whether an estimate is significantly better on a class than all others."""
    rows = [
        one.verdict.endswith("better" if one.second == key else "worse")
        for one in condition.comparisons
        if one.motion_class == motion_class and key in (one.first, one.second)
    ]
    return bool(rows) and all(rows)


def _effects(results: StudyResults) -> Paragraph | None:
    """Check whether the conclusion depends on the unmodelled effects."""
    if len(results.conditions) < 2:
        return None
    rigid, effects = results.conditions
    before, after = _main(rigid), _main(effects)
    same = (before.differs, before.ratio < 1.0) == (after.differs, after.ratio < 1.0)
    same = same or not (before.differs or after.differs)
    return Paragraph(
        key="effects",
        heading="Does that depend on the unmodelled effects?",
        verdict="No." if same else f"Yes: {_each([(effects, after)])}",
        sentences=[
            f"The effects change the ratio of the errors from {fixed(before.ratio, 3)} to"
            f" {fixed(after.ratio, 3)} on {after.motion_class} motions.",
            f"Effects: {'; '.join(effects.effects)}.",
        ],
    )


def _main(condition: ConditionResult) -> ComparisonResult:
    """Return the comparison of A and B on fly-by motions."""
    row = condition.compared("fly-by", A, B)
    assert row is not None  # every study has them
    return row


def _each(pairs: Sequence[tuple[ConditionResult, ComparisonResult]]) -> str:
    """Format the conclusion of each condition; once if they are equal."""
    texts = [_outcome(condition, row) for condition, row in pairs]
    if len(set(texts)) > 1:
        named = zip(pairs, texts, strict=True)
        texts = [f"{capitalised(one.words)}: {text}" for (one, _), text in named]
    return " ".join(f"{text}." for text in dict.fromkeys(texts))


def _outcome(condition: ConditionResult, row: ComparisonResult) -> str:
    """Format whose error is smaller, by how much, and whether equal motion time changes that."""
    if not row.differs:
        return _OUTCOMES[row.verdict]
    better = condition.labels[row.second if row.ratio < 1.0 else row.first]
    saved = significant(100.0 * (1.0 - min(row.ratio, 1.0 / row.ratio)), 2)
    slightly = "slightly " if row.verdict.startswith("slightly") else ""
    text = f"{better} is {slightly}better, its error {saved} % smaller"
    equal = condition.equal_data.comparisons if condition.equal_data is not None else []
    gone = any(o.verdict == "none" for o in equal if o.motion_class == row.motion_class)
    return f"{text}, but not with as much motion of each" if gone else text
