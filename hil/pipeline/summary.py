"""Results of an identification, as in `results.json`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from hil.archive import ArchiveHeader
from hil.base.arrays import Array
from hil.base.errors import InputError
from hil.base.version import software
from hil.cell import Cell
from hil.results import results
from identification import Factor, RobotModel
from identification.estimators.torque_scale import absolute
from identification.excitation.criteria import (
    Criteria,
    correlation,
    coupling_index_max,
    friction_of_excitation,
    information,
)
from identification.excitation.excitation import Excitation
from identification.factor.messages import method_words, prior_words, status_words
from identification.model.elements import PeriodicTorque
from identification.selection.essential import Elimination
from identification.selection.messages import candidate_words, cut_words
from identification.selection.settings import Choice
from identification.signals.samples import Samples
from identification.validation.consistency import ConsistencyCheck
from identification.validation.evidence import Evidence
from identification.validation.finding_messages import consistency_words, impossible_words
from identification.validation.prediction import (
    PredictionError,
    pooled_error,
    prediction_error,
)
from identification.validation.residuals import Profile
from planner.fourier import FourierSeries
from sim_fixtures.ns16 import TABLE2, URDF_PATH

from .estimating import Estimation
from .estimators import ESTIMATORS
from .note_messages import note_lines
from .notes import NotConsistent, NotEssential
from .prepared import Prepared, executed_rows
from .sources import Sources
from .validation import Validation


def summary(
    name: str, prepared: Prepared, estimation: Estimation, validation: Validation
) -> results.Results:
    """Return the results of an identification.

    Args:
        name: of the results.
        prepared: recordings and settings.
        estimation: of the parameters.
        validation: of the estimate.

    Raises:
        InputError: the plan in the archives cannot be read.
    """
    sources = prepared.sources
    estimate = estimation.result
    cell = sources.cell
    model = sources.cell.model
    pooled = estimate.pooled
    verdict = validation.verdict
    consistency = validation.consistency
    calibration = validation.calibration
    excitation, gram = _excitation(prepared)
    simulated = sources.header.only_simulated
    known = simulated and not sources.header.simulated_by_unknown
    truth = true_values(cell, sources.header) if known else None
    return results.Results(
        name=name,
        cell=cell.name,
        simulated=simulated,
        simulated_by_unknown=sources.header.simulated_by_unknown,
        effects=[*sources.header.effects],
        joint_names=list(model.joint_names),
        period=_period(prepared.training[0]),
        software=software(),
        excitation=excitation,
        estimator=_estimator(estimation),
        notes=note_lines([*prepared.notes, *estimation.notes]),
        parameters=_parameters(cell, estimation, truth),
        n_base=len(model.base.names),
        uncertainty=results.UncertaintyResult.of(
            estimation.stated, method=method_words(estimation.stated.method)
        ),
        repetitions=[source.name for source in sources.training],
        repetition_values=estimate.values.tolist(),
        noise_std=pooled.noise_std.tolist(),
        correlation=correlation(gram).tolist(),
        validation=[] if sources.in_sample else _validation(prepared, pooled.values),
        fitted=_fitted(prepared, pooled.values),
        calibration=None if calibration is None else results.CalibrationResult.of(calibration),
        delays=_delays(prepared),
        choices=[*map(_choice, prepared.settings.choices)],
        coverage=None if truth is None else _coverage(pooled.values, absolute(pooled).std, truth),
        verdict=results.VerdictResult.of(
            verdict, warnings=[*verdict.warnings, *note_lines(sources.warnings)]
        ),
        contact_thresholds=[*validation.thresholds],
        essential=_essential(validation.essential),
        consistency=None
        if isinstance(consistency, NotConsistent)
        else _consistency(model, consistency),
        judgement=_judgement(model.joint_names, validation),
    )


def _estimator(estimation: Estimation) -> results.EstimatorResult:
    name = estimation.estimator
    pooled = estimation.result.pooled
    return results.EstimatorResult(
        name=name,
        words=method_words(pooled.method) if name == "auto" else ESTIMATORS[name],
        prior=prior_words(estimation.with_prior.origin),
        condition=pooled.condition,
        grouping=estimation.posterior.model.base.explanation(),
    )


def _consistency(model: RobotModel, check: ConsistencyCheck) -> results.ConsistencyResult:
    consistent = check.consistent
    standard = dict(zip(model.layout.names, consistent.standard.tolist(), strict=True))
    inertial = consistent.standard[model.layout.links]
    return results.ConsistencyResult.of(
        check,
        in_sample=consistent.relative_error,
        unconstrained_in_sample=consistent.unconstrained_relative_error,
        shift=consistent.shift,
        status=status_words(consistent.fits),
        moved=check.shifted_parameters,
        sentence=consistency_words(check),
        bounds=[impossible_words(violation) for violation in check.violations],
        links=results.LinkResult.rows(
            joint=model.joint_names,
            mass=inertial[:, 9],
            centre=inertial[:, 6:9] / inertial[:, 9:],
            rotor_inertia=[standard.get(f"I{k + 1}m") for k in range(model.n_joints)],
            rotor_at_bound=model.layout.rotors_at_bound(consistent.standard).tolist(),
            room=check.margin,
            reference=consistent.reference,
        ),
    )


def _choice(choice: Choice) -> results.ChoiceResult:
    return results.ChoiceResult(
        name=choice.name,
        candidates=candidate_words(choice.candidates),
        errors=list(choice.errors),
        chosen=choice.chosen,
    )


def _essential(choice: Elimination | NotEssential) -> results.EssentialResult | None:
    if isinstance(choice, NotEssential):
        return None
    estimate = choice.estimate
    return results.EssentialResult.of(
        choice,
        reason=cut_words(choice),
        parameters=results.EssentialParameter.rows(
            name=estimate.names,
            unit=estimate.units,
            estimate=estimate.values,
            std=estimate.std,
        ),
    )


def true_values(cell: Cell, header: ArchiveHeader) -> Array | None:
    """Return the parameters (p,) of the simulated arm, NaN of periodic torques; None if unknown."""
    model = cell.model
    planted = header.planted
    if planted is not None:
        if not planted.keys() >= {*model.parameter_names[: model.element_part.start]}:
            return None
        return np.array([planted.get(name, np.nan) for name in model.parameter_names])
    if cell.file.simulation is None:
        return None
    from hil.control.planted_arm import planted_values  # only for a simulated arm

    values = planted_values(cell)
    for placed in model.elements.identified:
        if isinstance(placed.element, PeriodicTorque):
            values[model.element_part][placed.part] = np.nan
    return values


def _period(samples: Samples) -> float:
    return float(np.median(np.diff(samples.motion.time)))


def _excitation(prepared: Prepared) -> tuple[results.ExcitationResult, Array]:
    """Return the criteria of executed and planned motion, and the information (p, p); all rows."""
    model = prepared.sources.cell.model
    friction = friction_of_excitation(model)
    lengths = []
    factor = Factor.zero(model)
    for source, samples in zip(prepared.sources.training, prepared.training, strict=True):
        part = executed_rows(source, samples)
        lengths.append(part.stop - part.start)
        motion = samples.motion.rows(part)
        motion = replace(motion, direction=friction.direction(motion))
        factor = factor + Factor.from_samples(model, motion, samples.torque[part])
    gram = information(factor)
    most = coupling_index_max(len(gram))
    executed = Criteria.of_gram(gram, sum(lengths))
    planned = _planned(prepared.sources)
    if planned is None:
        duration = lengths[0] * _period(prepared.training[0])
        return results.ExcitationResult(
            duration=duration, coupling_index_max=most, executed=executed
        ), gram
    trajectory = planned.trajectory
    via_points = planned.via_points
    n_via = None
    if via_points is not None:  # without start and end of a closed path
        n_via = len(via_points) - 2 * np.array_equal(via_points[0], via_points[-1])
    return results.ExcitationResult(
        method=planned.method,
        duration=trajectory.duration,
        n_via=n_via,
        fly=planned.fly,
        n_sines=trajectory.amplitude.shape[1] if isinstance(trajectory, FourierSeries) else None,
        coupling_index_max=most,
        planned=planned.criteria,
        executed=executed,
    ), gram


def _planned(sources: Sources) -> Excitation | None:
    """Return the planned excitation, if the archives contain one."""
    plan = sources.plan or {}
    try:
        return Excitation.from_dict(plan["excitation"]) if "excitation" in plan else None
    except (KeyError, TypeError, ValueError) as error:
        problem = f"the excitation in its plan.json cannot be read ({error!r})"
        remedy = "identify with the version of hil that recorded it"
        raise InputError(sources.training[0].name, problem, remedy=remedy) from error


def _parameters(
    cell: Cell, estimation: Estimation, truth: Array | None
) -> list[results.ParameterResult]:
    model = cell.model
    estimate = estimation.result
    posterior = estimation.with_prior
    pooled = estimation.stated
    many = len(estimate.values) > 1
    # Rows 29 and 31 of the paper's Table 2 have the other sign.
    ids = {row.pivot or row.parameter: row.id for row in TABLE2}
    is_ns16 = cell.urdf == URDF_PATH.read_text(encoding="utf-8")
    return results.ParameterResult.rows(
        name=model.parameter_names,
        expression=[*model.expressions()],
        unit=model.units,
        table2_id=[ids.get(name) for name in model.parameter_names] if is_ns16 else None,
        estimate=pooled.values,
        std=pooled.std,
        repetition_mean=estimate.mean,
        repetition_std=estimate.std if many else None,
        truth=truth,
        undetermined=[name in pooled.undetermined for name in model.parameter_names],
        of_this_run=model.friction_columns,
        prior_std=posterior.prior_std,
        prior_ratio=posterior.ratio,
        learned=posterior.learned,
        absolute_std=absolute(pooled).std,
    )


def _validation(prepared: Prepared, values: Array) -> list[results.ValidationResult]:
    sources = prepared.sources
    model = prepared.sources.cell.model
    errors = prediction_error(model, values, prepared.held_out)
    everywhere = prediction_error(model, values, prepared.held_out, all_rows=True)
    return [
        results.ValidationResult.of(
            archive=source.name,
            duration=float(source.recording.time[-1] - source.recording.time[0]),
            mean_abs_error=error.mean_absolute,
            rms_error=error.rms,
            mean_error=error.mean,
            relative_error=error.relative,
            overall_relative_error=error.overall,
            all_rows_relative_error=all_rows.overall,
            all_rows_joint_errors=all_rows.relative,
        )
        for source, error, all_rows in zip(sources.held_out, errors, everywhere, strict=True)
    ]


def _fitted(prepared: Prepared, values: Array) -> results.FittedResult:
    """Return in-sample errors of the recorded torque, and of a smoothed one that was fitted."""

    def error(samples: Sequence[Samples], *, all_rows: bool = True) -> PredictionError:
        model = prepared.sources.cell.model
        return pooled_error(prediction_error(model, values, samples, all_rows=all_rows))

    moving = error(prepared.training, all_rows=False)
    everywhere = error(prepared.training)
    paper = prepared.settings.preprocessing.smooth_torque
    smoothed = error(prepared.fitted) if paper else None
    return results.FittedResult.of(
        relative_error=moving.relative,
        overall_relative_error=moving.overall,
        all_rows_relative_error=everywhere.overall,
        all_rows_joint_errors=everywhere.relative,
        smoothed_relative_error=None if smoothed is None else smoothed.relative,
        smoothed_overall_relative_error=None if smoothed is None else smoothed.overall,
    )


def _delays(prepared: Prepared) -> results.DelaysResult | None:
    estimate = prepared.delays
    applied = prepared.assumed_delay
    every = np.ones(len(prepared.sources.cell.joint_names))
    if estimate is not None:
        # A delay with a wide interval is applied, too, where it predicts better.
        mask = 1.0 if estimate.determined or estimate.delay == applied else np.nan
        delay = mask * estimate.delay
        interval = mask * estimate.half_interval
    elif applied != prepared.settings.stated_delay:
        # The lag of a low-pass that predicts as well as the low-pass.
        delay = applied
        interval = np.nan
    else:
        return None
    return results.DelaysResult.of(
        found=delay * every, interval=interval * every, applied=applied * every
    )


def _coverage(values: Array, std: Array, truth: Array) -> results.CoverageResult:
    """Return the coverage of the determined parameters with known true values."""
    determined = np.isfinite(std) & np.isfinite(truth)
    distance = np.abs(values - truth)[determined]
    std = std[determined]
    within_2, within_3 = (int((distance <= limit * std).sum()) for limit in (2.0, 3.0))
    return results.CoverageResult(within_2=within_2, within_3=within_3, total=len(std))


def _all_joints(evidence: Evidence) -> results.OverallJudgement:
    """Return the errors over all joints together."""
    references = {
        "nominal_relative": evidence.nominal,
        "nominal_with_friction_relative": evidence.nominal_with_friction,
        "controller_relative": evidence.context.controller,
    }
    return results.OverallJudgement(
        relative=evidence.held_out.overall,
        fitted_relative=evidence.training.overall,
        noise_relative=evidence.floor,
        **{name: None if error is None else error.overall for name, error in references.items()},
    )


def _judgement(joint_names: Sequence[str], validation: Validation) -> results.JudgementResult:
    """Return the verdict with the numbers behind it."""

    def profile(error_profile: Profile) -> list[results.ProfileResult]:
        bins = error_profile.bins
        return results.ProfileResult.rows(
            centre=error_profile.centres, mean=bins.mean, std=bins.std
        )

    evidence = validation.evidence
    verdict = validation.verdict
    nominal = validation.nominal
    checks = evidence.residuals
    context = evidence.context
    error = evidence.held_out
    assert checks is not None
    inertia = context.controller_inertia
    limit = context.torque_limit
    joints = results.JointJudgement.rows(
        joint=joint_names,
        unit=["N·m" if evidence.revolute(j) else "N" for j in range(len(joint_names))],
        rms=error.rms,
        relative=error.relative,
        fitted_relative=evidence.training.relative,
        noise_relative=evidence.noise_relative,
        explained=error.explained,
        limit=limit,
        share_of_limit=None if limit is None else error.rms / limit,
        nominal_relative=None if evidence.nominal is None else evidence.nominal.relative,
        controller_relative=None if context.controller is None else context.controller.relative,
        nominal_scale=None if context.nominal_scale is None else context.nominal_scale.scale,
        controller_inertia=None if inertia is None else inertia.ratio,
        controller_inertia_spread=None if inertia is None else inertia.spread,
    )
    return results.JudgementResult.of(
        in_sample=evidence.in_sample,
        nominal=None if nominal is None else nominal.label,
        findings=verdict.findings,
        next_steps=verdict.next_steps,
        joints=joints,
        all_joints=_all_joints(evidence),
        speed=profile(checks.speed),
        position=profile(checks.position),
    )
