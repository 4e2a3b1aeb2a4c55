"""The physical consistency of an estimate, as it goes into a result."""

from __future__ import annotations

import numpy as np

from hil.results import ConsistencyResult, LinkResult
from identification import Factor, IdentificationError, RobotModel, estimate
from identification.estimators.consistent import Consistency
from identification.estimators.consistent_program import link_parameters
from identification.estimators.covariance import with_block_covariance
from identification.factor.factor import joint_weights
from identification.factor.phases import PhaseFactor
from identification.validation.consistency import ConsistencyCheck, check_consistency


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


def consistency_reasons(consistency: ConsistencyCheck | str) -> tuple[str, ...]:
    """Why a model must not be relied on: no machine predicts what it predicts."""
    if isinstance(consistency, str) or not consistency.impossible:
        return ()
    return (
        f"{consistency.sentence}: look there for a wrong sign, torque constant, coupling or"
        " description",
    )


def consistency_warnings(consistency: ConsistencyCheck | str) -> tuple[str, ...]:
    """What a reader of the verdict must know of it."""
    if isinstance(consistency, str):
        return (f"no physically consistent parameters were found: {consistency}",)
    costly = consistency.costly and not consistency.impossible
    return (consistency.sentence,) if costly else ()


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
