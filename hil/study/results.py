"""What a study leaves behind: `results.json`, checked on the way in and out.

SI units; lists per joint follow `joint_names`, lists per parameter `parameters`. Torque errors are
low-passed at 30 Hz unless they say otherwise.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final, Literal, Self

from pydantic import Field

from hil.results import Frozen

from .records import ClassErrors, ExampleRecord, Fitted
from .settings import StudySettings, load_json

SCHEMA_VERSION: Final = 1
ALPHA: Final = 0.05
"""How often, at most, a table shows any difference where there is none."""
SMALL: Final = 0.02
"""A difference of errors below this share exists and does not matter."""

Verdict = Literal["better", "slightly better", "none", "slightly worse", "worse", "too few"]


class StudyParameter(Frozen):
    """One parameter, and what the paper prints about it (null for another arm)."""

    name: str
    unit: str
    truth: float | None
    """Planted value; only a simulated arm has one."""
    printed_id: int | None = None
    """Row of the paper's Table 2."""
    printed_symbol: str | None = None
    printed_factor: float = 1.0
    """What a value is multiplied with to compare it with the print."""
    printed_a: float | None = None
    printed_b: float | None = None
    printed_c: float | None = None


class SearchResult(Frozen):
    """One search, and the motion it found; null figures where it found none."""

    key: str
    words: str
    chosen: bool
    """Whether its motion was executed in full."""
    tried: int
    infeasible: dict[str, int]
    log10_det: float | None
    coupling_index: float | None
    duration: float | None


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
    """What one excitation gave under one condition."""

    key: str
    label: str
    repetitions: int
    seconds: float
    """Of motion that was fitted, all repetitions."""
    mean: list[float]
    """Over the repetitions' own estimates: the paper's Table 2."""
    std: list[float]
    """Over the repetitions, of one of them."""


class CrossCell(Frozen):
    """How well one estimate predicts the motions of one class: ||e|| / ||tau||."""

    method: str
    motion_class: str
    median: float
    lower: float
    upper: float
    """Quartiles over the motions."""
    all_rows_median: float
    """Over the whole motion: rows at rest, near ends and at reversals are included."""
    own_median: float | None
    """Of ||Phi (pi - planted)|| / ||tau||; null with effects, or where nothing is planted."""


class ComparisonResult(Frozen):
    """Two estimates on the same motions: errors with `second` over errors with `first`.

    The interval treats motions and repetitions as random samples; the verdict rests on it alone.
    The signed-rank test is over the motions, for these two estimates as they are.
    """

    motion_class: str
    joint: str | None
    """Null for all joints together."""
    first: str
    second: str
    motions: int
    repetitions: list[int]
    """Of `first` and `second`."""
    ratio: float
    """Geometric mean over the motions."""
    error: float | None
    """Standard error of the log ratio; null with fewer than three repetitions, or one motion."""
    freedom: float | None
    """Its degrees of freedom."""
    level: float
    """Of the interval by itself, such that all of its table hold at 95 % (Bonferroni)."""
    low: float | None
    high: float | None
    """Interval of the ratio at that level."""
    verdict: Verdict
    """On `second`: whether the interval excludes 1."""
    wins: int
    """Motions that `second` predicts better."""
    p_value: float
    """Wilcoxon's signed-rank test, two-sided."""
    p_corrected: float
    """The same after Holm, for all comparisons of its table."""

    @property
    def differs(self) -> bool:
        """Whether the difference is significant."""
        return self.verdict not in ("none", "too few")


class ClassResult(ClassErrors):
    """The motions of one class, and the errors of every estimate on each of them."""

    motion_class: str
    archives: list[str]
    left_out: list[float]
    """Share of the samples of the motions that all other errors leave out, per joint."""
    left_out_share: float
    """Of all joints together."""


class ClosenessResult(Frozen):
    """How many parameters of a group the second of two estimates brings closer to a reference."""

    group: str
    reference: str
    first: str
    second: str
    parameters: int
    second_closer: int
    printed_second_closer: int | None
    """Of the paper's own columns A and B."""


class EqualDataResult(Frozen):
    """The first two methods with as much motion of each: the longer one cut."""

    cut: str
    """Key of the method of which only the first repetitions are used."""
    name: str
    """Of that estimate in the cross table."""
    repetitions: int
    seconds: float
    other: str
    other_seconds: float
    comparisons: list[ComparisonResult]
    """Class by class, in the order of the methods; corrected among themselves."""


class ConditionResult(Frozen):
    """Everything under one condition: with or without effects, or as recorded."""

    key: str
    words: str
    effects: list[str]
    methods: list[MethodResult]
    classes: list[ClassResult]
    cross: list[CrossCell]
    comparisons: list[ComparisonResult]
    own_comparisons: list[ComparisonResult]
    """The first two, class by class, in the errors of the estimates themselves."""
    joint_comparisons: list[ComparisonResult]
    equal_data: EqualDataResult | None
    """Null where both have as much motion anyway."""
    closeness: list[ClosenessResult]
    examples: list[ExampleRecord]

    @property
    def labels(self) -> dict[str, str]:
        """Labels of the methods by key, in the order of the tables."""
        return {one.key: one.label for one in self.methods}

    def compared(self, motion_class: str, first: str, second: str) -> ComparisonResult | None:
        """One pair of methods, in this order, on one class."""
        wanted = (motion_class, first, second)
        rows = (c for c in self.comparisons if (c.motion_class, c.first, c.second) == wanted)
        return next(rows, None)


class AblationPoint(Frozen):
    """One setting of what is varied."""

    value: float
    label: str = ""
    """Where the setting is not a number, which `value` then only counts."""
    method: str
    base: bool
    """Whether it is the setting of the study itself."""
    repetitions: int
    log10_det: float | None
    coupling_index: float | None
    duration: float | None
    parameter_error: float | None
    """Geometric mean over the parameters of distance to the planted value, the study's B = 1."""
    error: dict[str, float]
    """Median over the motions of each class of ||e|| / ||tau||."""
    own: dict[str, float]
    """The same of the estimate itself; empty where nothing is planted."""

    @property
    def name(self) -> str:
        """The setting as text."""
        return self.label or f"{self.value:g}"


class AblationBand(Frozen):
    """Range of a figure over subsets of the study's own repetitions of one method."""

    method: str
    repetitions: int
    """In each subset."""
    quantity: Literal["error", "own", "parameter_error"]
    motion_class: str | None
    """Null for the parameters."""
    low: float
    high: float
    """2.5 and 97.5 % of the subsets."""
    subsets: int


class AblationResult(Frozen):
    """One thing varied, everything else unchanged."""

    key: str
    title: str
    variable: str
    words: str
    points: list[AblationPoint]
    comparisons: list[ComparisonResult] = Field(default_factory=list)
    """With B, where the settings are another method's."""
    bands: list[AblationBand] = Field(default_factory=list)
    """Of as many repetitions as the points have; none where the study has no more itself."""


class Paragraph(Frozen):
    """What the numbers say."""

    key: str
    heading: str
    verdict: str = ""
    """The conclusion in one line, where the heading is a question."""
    sentences: list[str]


class StudyResults(Frozen):
    """One study, whole."""

    schema_version: int = SCHEMA_VERSION
    name: str
    cell: str
    simulated: bool
    quick: bool
    settings: StudySettings | None
    """Null for a study of recorded campaigns."""
    software: dict[str, str]
    joint_names: list[str]
    n_base: int
    parameters: list[StudyParameter]
    searches: list[SearchResult]
    table1: list[MotionRow]
    conditions: list[ConditionResult]
    ablations: list[AblationResult]
    reading: list[Paragraph]
    missing: list[str]
    """What of the paper's study is not in this one, and why."""
    times: dict[str, float]
    """Wall time [s] of each stage in the last session."""

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read and check a study's `results.json`.

        Raises:
            InputError: the file is none.
        """
        return load_json(cls, path, "is not the result of a study", "run the study again")
