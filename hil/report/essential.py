"""Which parameters can be trusted, and which the motion needs, as the page shows them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

from hil.report import numbers
from hil.report.figures.elimination import elimination_panels
from hil.report.parameters import deviation, mark
from hil.results import BlindResult, EssentialResult, ParameterResult, Results
from hil.results.essential import EssentialParameter

_WELL: Final = 0.1
_ROUGHLY: Final = 0.5
_LEARNED: Final = {True: "yes", False: "no", None: ""}


@dataclass(frozen=True)
class Trust:
    """Parameters of the full model by how well the data know them."""

    well: list[str]
    roughly: list[str]
    hardly: list[str]
    undetermined: list[str]
    not_learned: list[str] | None
    """Of which the nominal figures say more than the data; None without a prior."""
    well_percent: str
    roughly_percent: str


@dataclass(frozen=True)
class EssentialRow:
    """One parameter of the essential model, every number already text."""

    name: str
    unit: str
    estimate: str
    std: str
    relative_std: str
    full: str
    """The same parameter in the model with all parameters."""
    truth: str
    deviation: str
    """From the truth, in standard deviations."""
    mark: str
    """`out2` or `out3` where that is more than 2 or 3, as in the table of all parameters."""
    learned: str
    """Whether the data say more than the nominal figures; empty without these."""
    refused: bool


@dataclass(frozen=True)
class EssentialPart:
    """What the page says about the essential parameters."""

    reason: str
    rule_of_thumb: str
    blind: str
    removed: list[str]
    rows: list[EssentialRow]


def context(results: Results) -> dict[str, Any]:
    """What the template `trust.html.j2` needs."""
    essential = results.essential
    return {
        "trust": trust(results),
        "essential": None if essential is None else essential_part(results, essential),
        "elimination_panels": [] if essential is None else elimination_panels(essential),
    }


def trust(results: Results) -> Trust:
    """Sort the parameters by relative standard deviation."""
    grades = ("well", "roughly", "hardly", "undetermined")
    found: dict[str, list[str]] = {grade: [] for grade in grades}
    for parameter in results.parameters:
        found[_grade(parameter)].append(parameter.name)
    return Trust(
        **found,
        not_learned=_not_learned(results),
        well_percent=f"{100.0 * _WELL:g}",
        roughly_percent=f"{100.0 * _ROUGHLY:g}",
    )


def _not_learned(results: Results) -> list[str] | None:
    if all(parameter.learned is None for parameter in results.parameters):
        return None
    return [parameter.name for parameter in results.parameters if parameter.learned is False]


def _grade(parameter: ParameterResult) -> str:
    if parameter.undetermined or not math.isfinite(parameter.std):
        return "undetermined"
    size = abs(parameter.estimate)
    if parameter.std <= _WELL * size:
        return "well"
    return "roughly" if parameter.std <= _ROUGHLY * size else "hardly"


def essential_part(results: Results, essential: EssentialResult) -> EssentialPart:
    """The essential parameters in words and rows."""
    full = {parameter.name: parameter for parameter in results.parameters}
    kept = essential.parameters
    return EssentialPart(
        reason=essential.reason,
        rule_of_thumb=(
            f"Relative standard deviations alone (largest less than 30 times the smallest: Pham and"
            f" Gautier 1991) would leave {essential.by_spread_left} parameters, with a held-out"
            f" error of {essential.by_spread_held_out:.2%}"
        ),
        blind=_blind(essential.blind),
        removed=[str(step.removed) for step in essential.steps[1 : essential.cut + 1]],
        rows=[
            EssentialRow(
                name=one.name,
                unit=one.unit.replace(" ", "·"),
                estimate=numbers.beside(one.estimate, one.std),
                std=numbers.significant(one.std, 2),
                relative_std=numbers.percent(
                    one.std / abs(one.estimate) if one.estimate else math.inf
                ),
                full=numbers.beside(full[one.name].estimate, full[one.name].std),
                truth=numbers.beside(full[one.name].truth, one.std),
                deviation=numbers.fixed(_deviation(one, full[one.name]), 2, sign=True),
                mark=mark(_deviation(one, full[one.name])),
                learned=_LEARNED[full[one.name].learned],
                refused=one.name in essential.refused,
            )
            for one in kept
        ],
    )


def _deviation(one: EssentialParameter, full: ParameterResult) -> float | None:
    """Of the essential model's estimate from the truth; None without one."""
    return deviation(full.model_copy(update={"estimate": one.estimate, "std": one.std}))


def _blind(blind: BlindResult | None) -> str:
    if blind is None:
        return (
            "The fitted motion is too short to tell what such a choice is worth on motion that had"
            " no say in it"
        )
    return (
        "The held-out motion has chosen them, so its error flatters. The honest figure: chosen"
        f" inside the fitted motion alone, {blind.left} parameters predict the held-out motion"
        f" with an error of {blind.essential:.2%}, against {blind.full:.2%} with all"
    )
