"""The conclusion of a study in sentences, and the sizes of the model errors in words."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, get_args

from hil.cell import Cell
from hil.report.numbers import capitalised, fixed, significant
from identification.excitation import Method
from identification.text import percentage

from .campaigns import MOTION_CLASSES
from .model_errors import (
    ALL,
    LENGTH_ERROR,
    LOAD_FRICTION_SHARE,
    NONE,
    STRIBECK_SHARE,
    STRIBECK_SPEED_SHARE,
    TORQUE_CONSTANT_ERROR,
)
from .results import ConditionResult, Criterion, Quantity, StudyResults

CRITERION_WORDS: Final[dict[Criterion, str]] = {
    "coupling_index": "coupling index",
    "log10_det": "log det",
    "scaled_condition": "condition number",
}
QUANTITY_WORDS: Final[dict[Quantity, str]] = {
    "variance": "scatter",
    "bias": "bias",
    "error": "error",
}
_OTHERS: Final[dict[str, Method]] = {"A": "a", "B": "b"}
_BETTER: Final = ("better", "slightly better")
_WORSE: Final = ("worse", "slightly worse")


def condition_words(condition: ConditionResult) -> str:
    """Name a condition."""
    if condition.error == "none":
        return "no model error"
    if condition.error == "all":
        return "all model errors together"
    return f"{condition.error} x {condition.size}"


def effect_words(cell: Cell) -> list[str]:
    """Describe the model errors at size 1."""
    simulation = cell.simulation
    ripple = percentage(simulation.torque_ripple)
    drift = percentage(simulation.friction_drift)
    elastic = ", ".join(f"{compliance:g}" for compliance in simulation.elasticity)
    described = [
        (simulation.torque_ripple, f"torque ripple {ripple} of the Coulomb torque"),
        (simulation.friction_drift, f"friction falls by {drift} from cold to hot"),
        (max(simulation.elasticity, default=0.0), f"elastic gears {elastic} rad/(N·m)"),
        (simulation.delay, f"current {1e3 * simulation.delay:g} ms late"),
    ]
    slow = percentage(STRIBECK_SPEED_SHARE)
    return [
        *(words for size, words in described if size > 0.0),
        f"Stribeck friction {percentage(STRIBECK_SHARE)} of the Coulomb torque, e-fold at {slow} of"
        " the speed limit",
        f"dry friction {percentage(LOAD_FRICTION_SHARE)} of the load of a gear",
        f"lengths ± {percentage(LENGTH_ERROR, 1)}",
        f"torque constants ± {percentage(TORQUE_CONSTANT_ERROR)}",
    ]


def conclusion_of(results: StudyResults) -> list[str]:
    """Return at most ten sentences of at most 100 characters, the conclusion first."""
    by_key = {condition.key: condition for condition in results.conditions}
    none = by_key[NONE.key]
    worst = by_key.get(ALL.key, none)
    sentences = [_for_design(results.conditions)]
    if results.quick:
        sentences.append("The quick setting is too small to compare the methods.")
    sentences.append(f"Error of B relative to A, exact model: {_b_over_a(none, decimals=3)}.")
    if worst is not none:
        sentences.append(f"With {condition_words(worst)}: {_b_over_a(worst)}.")
    printed = _b_over_a(worst, printed_sizes=True)
    sentences.append(f"A fitted to 2000 rows, as in the paper: {printed}.")
    if worst is not none:
        sentences.append(_by_error(results.conditions))
    sentences.append(_of_default(worst))
    return [*sentences, *(_of_criterion(results, criterion) for criterion in get_args(Criterion))]


def _b_over_a(condition: ConditionResult, *, printed_sizes: bool = False, decimals: int = 2) -> str:
    texts = []
    for motions in MOTION_CLASSES:
        row = condition.comparison("a", "b", motions, printed_sizes=printed_sizes)
        interval = "too few searches"
        if row.low is not None:
            interval = f"{fixed(row.low, decimals)} to {fixed(row.high, decimals)}"
        texts.append(f"{motions} {fixed(row.ratio, decimals)} ({interval})")
    return ", ".join(texts)


def _by_error(conditions: Sequence[ConditionResult]) -> str:
    """Say in how many cases of single errors B or A predicts better, and by how much at most."""
    cases = [
        condition.comparison("a", "b", motions)
        for condition in conditions
        if condition.error not in ("none", "all")
        for motions in MOTION_CLASSES
    ]
    b = [1.0 - row.ratio for row in cases if row.verdict in _BETTER]
    a = [1.0 - 1.0 / row.ratio for row in cases if row.verdict in _WORSE]
    return (
        f"With single model errors: B is better in {len(b)} of {len(cases)} cases"
        f"{_at_most(b)}, A in {len(a)}{_at_most(a)}."
    )


def _at_most(savings: Sequence[float]) -> str:
    return f" (up to {significant(100.0 * max(savings), 2)} %)" if savings else ""


def _of_default(condition: ConditionResult) -> str:
    over = {
        label: ", ".join(
            f"{motions} {fixed(condition.comparison(method, 'gradient', motions).ratio, 2)}"
            for motions in MOTION_CLASSES
        )
        for label, method in _OTHERS.items()
    }
    return f"The default of hil design over A: {over['A']}; over B: {over['B']}."


def _of_criterion(results: StudyResults, criterion: Criterion) -> str:
    worst = results.conditions[-1].key
    parts = []
    places: list[tuple[Quantity, str]] = [("variance", NONE.key)]
    if worst != NONE.key:
        places.append(("bias", worst))
    for quantity, key in places:
        relation = results.relation(criterion, quantity, key)
        parts.append(f"{QUANTITY_WORDS[quantity]} {fixed(relation.correlation, 2)}")
    relation = results.relation(criterion, "error", worst)
    interval = f"{fixed(relation.low, 2)} to {fixed(relation.high, 2)}"
    parts.append(f"{QUANTITY_WORDS['error']} {fixed(relation.correlation, 2)} ({interval})")
    return f"{capitalised(CRITERION_WORDS[criterion])}, rank correlation: {', '.join(parts)}."


def _for_design(conditions: Sequence[ConditionResult]) -> str:
    """Say whether B, with its weight of the coupling index, is worth offering by `hil design`.

    That takes an error of the model under which it predicts better than both other methods.
    """
    helped = [
        condition
        for condition in conditions
        if any(
            condition.comparison("a", "b", motions).verdict in _BETTER
            and condition.comparison("gradient", "b", motions).verdict in _BETTER
            for motions in MOTION_CLASSES
        )
    ]
    if not helped:
        return "B beats both A and the default of hil design under none of the model errors."
    words = condition_words(helped[0])
    more = f" and {len(helped) - 1} more" if len(helped) > 1 else ""
    return f"B beats both A and the default of hil design under {words}{more}."
