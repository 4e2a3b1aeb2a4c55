"""Content of a study's `results.json`.

SI units; lists per joint follow `joint_names`, lists per parameter `parameters`. Torque errors are
relative, ||e|| / ||tau|| over all joints, low-passed at 30 Hz as in the paper's Fig. 4, which
removes the noise of the currents, unless stated otherwise.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final, Literal, Self

from hil.base.errors import InputError
from hil.base.safe_input import read_text
from hil.results.results import Frozen
from identification.excitation import Method

from .settings import StudySettings

Verdict = Literal["better", "slightly better", "none", "slightly worse", "worse", "too few"]
Criterion = Literal["coupling_index", "log10_det", "scaled_condition"]
Quantity = Literal["variance", "bias", "error"]

SCHEMA_VERSION: Final = 3
TRUE_VALUES: Final = "planted"  #: Key of the true parameters among the estimates


class StudyParameter(Frozen):
    """One parameter with the values that the paper prints (null for another arm)."""

    name: str
    unit: str
    truth: float  #: Of the simulated arm
    printed_id: int | None = None  #: Row of the paper's Table 2
    printed_symbol: str | None = None
    printed_factor: float = 1.0  #: What a value is multiplied with to compare it with the paper
    printed_a: float | None = None
    printed_b: float | None = None
    printed_c: float | None = None


class MotionRow(Frozen):
    """A row of Table 1: a search of this study, or a row of the paper; null figures if none."""

    key: str
    words: str
    printed: bool = False
    executed: bool = False  #: Whether the page shows its motion and its estimates
    tried: int = 0
    n_samples: int | None = None
    duration: float | None = None
    log10_det: float | None = None
    coupling_index: float | None = None
    condition: float | None = None
    scaled_condition: float | None = None
    executed_log10_det: float | None = None
    executed_coupling_index: float | None = None


class MethodResult(Frozen):
    """Estimates from the repetitions of one excitation under one condition (eq. 4)."""

    key: Method
    label: str
    values: list[list[float]]  #: Of each repetition
    mean: list[float]  #: Over the repetitions' own estimates: the paper's Table 2
    std: list[float]  #: Over the repetitions, of one of them
    pooled: list[float]
    pooled_std: list[float]
    undetermined: list[str]
    log10_det: float  #: Of the executed motion
    coupling_index: float  #: Of the executed motion
    correlation: list[list[float]]  #: Of the executed motion
    duration: float  #: Of one repetition
    time: list[float]
    position: list[list[float]]  #: Per joint, of the first repetition


class HeldOut(Frozen):
    """Errors on the held-out fly-by motions, by estimate and motion."""

    archives: list[str]
    overall: dict[str, list[float]]  #: Of all joints together, over the rows that a fit uses
    all_rows: dict[str, list[float]]  #: The same with rest, ends of motion and reversals
    mean_abs: dict[str, list[list[float]]]
    """Motion by motion, mean |e| per joint, N·m: the paper's Fig. 3."""
    left_out: list[float]  #: Share of the moving samples that `overall` excludes, per joint
    example: str  #: Archive of the motion of median error
    time: list[float]  #: Of that motion
    measured: list[list[float]]  #: Torque per joint
    predicted: dict[str, list[list[float]]]


class ShownCondition(Frozen):
    """The best excitation of each method under one condition, as the paper shows its two."""

    condition: str  #: Key of the condition
    methods: list[MethodResult]
    held_out: HeldOut


class StudyComparison(Frozen):
    """Errors with the second method over errors with the first, over searches and motions.

    The interval treats searches, repetitions and motions as random samples; the verdict follows
    from it.
    """

    first: Method
    second: Method
    motions: str  #: Class of the held-out motions
    printed_sizes: bool = False  #: Whether A was fitted to as many rows as in the paper
    ratio: float  #: Geometric mean over searches and motions
    wins: int  #: Motions that the second method predicts better, in the mean over searches
    motion_count: int
    low: float | None = None
    high: float | None = None  #: 95 % interval; null with too few searches or motions
    verdict: Verdict = "too few"  #: On the second method: whether the interval excludes 1


class ConditionResult(Frozen):
    """Comparisons of the methods under one condition."""

    key: str
    error: str  #: Of the model; "none" or "all"
    size: int  #: Times the sizes of the settings and of the cell file
    comparisons: list[StudyComparison]

    def comparison(
        self, first: Method, second: Method, motions: str, *, printed_sizes: bool = False
    ) -> StudyComparison:
        """Return one of the comparisons.

        Args:
            first: method.
            second: method that it is compared with.
            motions: on which errors are compared.
            printed_sizes: whether A was fitted to as many rows as in the paper.
        """
        key = (first, second, motions, printed_sizes)
        return next(
            row
            for row in self.comparisons
            if (row.first, row.second, row.motions, row.printed_sizes) == key
        )


class DesignPoint(Frozen):
    """What one search found, and how well it estimates; one point of the criteria's pictures."""

    key: str
    method: Method
    criteria: dict[Criterion, float]
    variance: float
    """Standard deviation of the estimates of a repetition without errors of the model, RMS over
    the parameters, each over its RMS of all designs."""
    bias: dict[str, float]
    """Shift of the estimates by the errors of each condition, RMS over the parameters in the same
    units."""
    error: dict[str, float]
    """Torque error on the held-out motions under each condition, geometric mean over all."""


class Relation(Frozen):
    """Rank correlation of a criterion with what it is meant to foretell, over all designs."""

    criterion: Criterion
    quantity: Quantity
    condition: str  #: Key
    correlation: float  #: Spearman's
    low: float
    high: float  #: 95 % interval over the searches of each method
    within: float  #: Mean over the methods of the correlation among the designs of one
    within_low: float
    within_high: float


class StudyResults(Frozen):
    """Content of the `results.json` of a study."""

    schema_version: int = SCHEMA_VERSION
    name: str
    cell: str
    simulated: bool = True
    quick: bool
    settings: StudySettings
    software: dict[str, str]
    joint_names: list[str]
    n_base: int
    parameters: list[StudyParameter]
    table1: list[MotionRow]
    conditions: list[ConditionResult]
    designs: list[DesignPoint]
    relations: list[Relation]
    shown: list[ShownCondition]
    effects: list[str]  #: Sizes of the errors of the model, in words
    conclusion: list[str]  #: Sentences

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read a study's `results.json`; InputError if it is not one."""
        try:
            return cls.model_validate_json(read_text(path))
        except (OSError, ValueError) as error:
            problem = f"is not the result of a study ({error})"
            raise InputError(path, problem, remedy="run the study again") from error

    @property
    def summary(self) -> dict[str, Any]:
        """The conclusion as JSON data, with the ratios that it is based on."""
        return {
            "name": self.name,
            "simulated": self.simulated,
            "quick": self.quick,
            "line": " ".join(self.conclusion),
            "ratios": [
                {"condition": condition.key} | row.model_dump()
                for condition in self.conditions
                for row in condition.comparisons
            ],
            "relations": [relation.model_dump() for relation in self.relations],
        }

    def relation(self, criterion: Criterion, quantity: Quantity, condition: str) -> Relation:
        """Return one of the relations."""
        key = (criterion, quantity, condition)
        return next(
            row for row in self.relations if (row.criterion, row.quantity, row.condition) == key
        )
