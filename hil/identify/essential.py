"""The essential parameters of an estimate, as they go into a result."""

from __future__ import annotations

from collections.abc import Sequence

from hil.results import BlindResult, EliminationStepResult, EssentialParameter, EssentialResult
from identification import IdentificationError, RobotModel
from identification.factor.phases import PhaseFactor
from identification.selection.essential_choice import EssentialChoice, choose_essential


def essential_of(
    model: RobotModel, training: PhaseFactor, held_out: Sequence[PhaseFactor]
) -> EssentialChoice | str:
    """The essential parameters; in words why there are none."""
    try:
        return choose_essential(model, training, held_out)
    except IdentificationError as error:
        return str(error)


def essential_warnings(choice: EssentialChoice | str) -> tuple[str, ...]:
    """What a reader of the verdict must know of it."""
    return (
        (f"essential parameters were not looked for: {choice}",) if isinstance(choice, str) else ()
    )


def essential_result(choice: EssentialChoice | str) -> EssentialResult | None:
    """As it goes into `results.json`."""
    if isinstance(choice, str):
        return None
    elimination, blind = choice.elimination, choice.blind
    estimate_left = elimination.estimate
    return EssentialResult(
        reason=elimination.reason,
        cut=elimination.cut,
        steps=[
            EliminationStepResult(
                removed=step.removed,
                left=step.left,
                spread=step.spread,
                in_sample=step.in_sample,
                held_out=step.held_out,
                largest_relative_std=step.largest_relative_std,
            )
            for step in elimination.steps
        ],
        refused=list(elimination.refused),
        parameters=[
            EssentialParameter(name=name, unit=unit, estimate=value, std=std)
            for name, unit, value, std in zip(
                estimate_left.names,
                estimate_left.units,
                estimate_left.values.tolist(),
                estimate_left.std.tolist(),
                strict=True,
            )
        ],
        by_spread_left=choice.by_spread.left,
        by_spread_held_out=choice.by_spread.held_out,
        blind=None
        if blind is None
        else BlindResult(left=blind.left, essential=blind.essential, full=blind.full),
    )
