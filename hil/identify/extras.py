"""Essential parameters and physical consistency of an estimate, as they go into a result."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hil.extras_results import (
    BlindResult,
    ConsistencyResult,
    EliminationStepResult,
    EssentialParameter,
    EssentialResult,
    LinkResult,
)
from identification import Factor, IdentificationError, RobotModel, estimate
from identification.consistency_check import ConsistencyCheck, check_consistency
from identification.consistent import Consistency
from identification.consistent_program import link_parameters
from identification.covariance import with_block_covariance
from identification.essential_choice import EssentialChoice, choose_essential
from identification.estimation import joint_weights
from identification.phase_factor import PhaseFactor


def essential_of(
    model: RobotModel, training: PhaseFactor, held_out: Sequence[PhaseFactor]
) -> EssentialChoice | str:
    """The essential parameters; in words why there are none."""
    try:
        return choose_essential(model, training, held_out)
    except IdentificationError as error:
        return str(error)


def consistency_of(
    model: RobotModel,
    training: PhaseFactor,
    held_out: Factor,
    options: Consistency = Consistency(),  # noqa: B008 - frozen
) -> ConsistencyCheck | str:
    """Weighted least squares with the inequalities of a machine and without.

    In words why there is none. It says what the inequalities cost whatever the estimator was.
    """
    total = training.total
    try:
        weights = joint_weights(total)
        free = with_block_covariance(estimate(model, total, weights), training, weights)
        return check_consistency(model, total, held_out, free, weights=weights, options=options)
    except IdentificationError as error:
        return str(error)


def extras_reasons(consistency: ConsistencyCheck | str) -> tuple[str, ...]:
    """Why a model must not be relied on: no machine predicts what it predicts."""
    if isinstance(consistency, str) or not consistency.impossible:
        return ()
    return (
        f"{consistency.sentence}: look there for a wrong sign, torque constant, coupling or"
        " description",
    )


def extras_doubts(
    essential: EssentialChoice | str, consistency: ConsistencyCheck | str
) -> tuple[str, ...]:
    """What a reader of the verdict must know of both."""
    doubts = []
    if isinstance(consistency, str):
        doubts.append(f"no physically consistent parameters were found: {consistency}")
    elif consistency.costly and not consistency.impossible:
        doubts.append(consistency.sentence)
    if isinstance(essential, str):
        doubts.append(f"essential parameters were not looked for: {essential}")
    return tuple(doubts)


def essential_result(choice: EssentialChoice | str) -> EssentialResult | None:
    """As it goes into `results.json`."""
    if isinstance(choice, str):
        return None
    elimination, blind = choice.elimination, choice.blind
    kept = elimination.estimate
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
                kept.names,
                kept.units,
                kept.values.tolist(),
                kept.std.tolist(),
                strict=True,
            )
        ],
        by_spread_left=choice.by_spread.left,
        by_spread_held_out=choice.by_spread.held_out,
        blind=None
        if blind is None
        else BlindResult(left=blind.left, essential=blind.essential, full=blind.full),
    )


def consistency_result(
    model: RobotModel, check: ConsistencyCheck | str
) -> ConsistencyResult | None:
    """As it goes into `results.json`."""
    if isinstance(check, str):
        return None
    found = check.consistent
    return ConsistencyResult(
        sentence=check.sentence,
        impossible=check.impossible,
        costly=check.costly,
        held_out=check.held_out,
        unconstrained_held_out=check.unconstrained_held_out,
        in_sample=found.relative_error,
        unconstrained_in_sample=found.unconstrained_relative_error,
        moved=list(check.moved),
        shift=found.shift.tolist(),
        bounds=list(check.bounds),
        links=_links(model, check),
        status=found.status,
    )


def _links(model: RobotModel, check: ConsistencyCheck) -> list[LinkResult]:
    standard = dict(
        zip(check.consistent.standard_names, check.consistent.standard.tolist(), strict=True)
    )
    inertial = link_parameters(model, check.consistent.standard)
    return [
        LinkResult(
            joint=joint,
            mass=float(inertial[k, 9]),
            centre=np.divide(inertial[k, 6:9], inertial[k, 9]).tolist(),
            rotor_inertia=standard.get(f"I{k + 1}m"),
            room=float(check.room[k]),
            reference=check.consistent.reference[k],
        )
        for k, joint in enumerate(model.joint_names)
    ]
