"""An identification as numbers: `results.json`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict

import numpy as np
from numpy.typing import NDArray

from hil.archive import ArchiveHeader
from hil.cell import Cell
from hil.errors import InputError
from hil.results import (
    BlindResult,
    CalibrationResult,
    ChoiceResult,
    ConsistencyResult,
    CoverageResult,
    CriteriaResult,
    DelaysResult,
    EliminationStepResult,
    EndogeneityResult,
    EssentialParameter,
    EssentialResult,
    EstimatorResult,
    ExcitationResult,
    FittedResult,
    LinkResult,
    ParameterResult,
    Results,
    UncertaintyResult,
    ValidationResult,
    VerdictResult,
)
from hil.simulation import planted_values
from hil.version import software
from identification import Factor, IdentificationError, RobotModel, estimate
from identification.estimators.consistent import Consistency
from identification.estimators.covariance import with_block_covariance
from identification.estimators.least_squares import RepeatedEstimate
from identification.estimators.shrinkage import Shrinkage, fitted_values
from identification.excitation import (
    Excitation,
    condition_number,
    correlation,
    coupling_index,
    coupling_index_max,
    fitness_eq7,
    information,
    log10_det,
)
from identification.factor.factor import joint_weights
from identification.factor.phases import PhaseFactor
from identification.model.elements import TorqueRipple
from identification.selection.essential import EssentialChoice, choose_essential
from identification.signals.samples import Samples
from identification.validation.calibration import Calibration, TorqueMeans, calibrate
from identification.validation.consistency import ConsistencyCheck, check_consistency
from identification.validation.prediction import PredictionError, over_all, prediction_error
from identification.validation.residuals import BLOCK
from identification.validation.verdict import Verdict
from planner import FourierSeries
from sim_fixtures.ns16 import TABLE2, URDF_PATH

from .estimating import Estimation
from .options import ESTIMATORS
from .prepared import Prepared
from .sources import Source, Sources

Array = NDArray[np.float64]


def calibration_result(prepared: Prepared, estimation: Estimation) -> CalibrationResult | None:
    """Intervals of held-out torque; None without held-out motion, or too little fitted."""
    if prepared.sources.in_sample:
        return None
    model, result = prepared.sources.cell.model, estimation.result
    shrinkage = _fold_estimator(prepared, estimation)

    def refit(factor: Factor) -> Array:
        return fitted_values(model, factor, shrinkage)

    try:
        found = calibrate(
            result.pooled,
            result.phase,
            TorqueMeans.of(model, prepared.training),
            TorqueMeans.of(model, prepared.held_out),
            refit,
        )
    except IdentificationError:
        return None
    return None if math.isnan(found.overall) else _result(found)


def _fold_estimator(prepared: Prepared, estimation: Estimation) -> Shrinkage:
    """The estimator, as far as it works on factors alone.

    Folds are fitted by least squares where it is a robust loss, instruments or a prior from CAD.
    """
    if estimation.estimator == "consistent":
        return Shrinkage(strength=math.inf)
    return prepared.settings.shrinkage if estimation.estimator == "auto" else Shrinkage()


def _result(found: Calibration) -> CalibrationResult:
    return CalibrationResult(
        block=BLOCK,
        means=int(found.blocks.sum()),
        inside=found.overall,
        white_inside=found.white_overall,
        joint_inside=_known(found.inside),
        half_width=_known(found.half_width),
    )


def _known(values: Array) -> list[float | None]:
    return [None if math.isnan(value) else value for value in values.tolist()]


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
    standard = dict(zip(model.standard_names, check.consistent.standard.tolist(), strict=True))
    inertial = check.consistent.standard[model.layout.links]
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
            EliminationStepResult.model_validate(step, from_attributes=True)
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


def estimator_result(model: RobotModel, estimation: Estimation) -> EstimatorResult:
    """Name, words, and the prior that "learned from the data" is measured against."""
    posterior, pooled = estimation.posterior, estimation.result.pooled
    return EstimatorResult(
        name=estimation.estimator,
        words=ESTIMATORS[estimation.estimator]
        if estimation.estimator != "auto"
        else estimation.result.pooled.method,
        prior=posterior if isinstance(posterior, str) else posterior.words,
        condition=pooled.condition,
        grouping=model.base.explanation(),
    )


def endogeneity_result(estimation: Estimation) -> EndogeneityResult | None:
    """Durbin-Wu-Hausman test, None where there was none."""
    test = estimation.endogeneity
    if isinstance(test, str):
        return None
    return EndogeneityResult(
        sentence=test.words,
        biased=test.biased,
        statistic=test.statistic,
        p_value=test.p_value,
        degrees_of_freedom=test.freedom,
        noise=test.noise.tolist(),
        shifted=list(test.shifted),
        shift=test.shift.tolist(),
    )


def uncertainty_result(estimation: Estimation) -> UncertaintyResult:
    """Standard deviations by every method that was used."""
    result = estimation.result
    pooled, many = result.pooled, len(result.repetitions) > 1
    by_posterior = estimation.estimator == "prior"
    reported = pooled.std.tolist()
    return UncertaintyResult(
        reported="posterior" if by_posterior else "phase_clustered",
        method=pooled.method,
        interval_factor=pooled.interval_factor,
        least_squares=result.classical_std.tolist(),
        independent_repetitions=result.independent_std.tolist() if many else None,
        phase_clustered=None if by_posterior else reported,
        scatter_of_mean=result.scatter_std.tolist() if many else None,
        posterior=reported if by_posterior else None,
    )


def summarise(
    name: str,
    prepared: Prepared,
    estimation: Estimation,
    verdict: Verdict,
    essential: EssentialChoice | str,
    consistency: ConsistencyCheck | str,
) -> Results:
    """Everything that was found, as it goes into `results.json`."""
    sources, training, estimate = prepared.sources, prepared.training, estimation.result
    cell, model, pooled = sources.cell, sources.cell.model, estimate.pooled
    rows = [
        executed_rows(source, samples)
        for source, samples in zip(sources.training, training, strict=True)
    ]
    gram = information(_executed(cell.model, training, rows))
    simulated = sources.header.only_simulated
    truth = planted_in(cell, sources.header) if simulated else None
    return Results(
        name=name,
        cell=cell.name,
        simulated=simulated,
        effects=[*sources.header.effects],
        joint_names=list(model.joint_names),
        period=_period(training[0]),
        software=software(),
        excitation=_excitation(sources, gram, training, rows),
        estimator=estimator_result(model, estimation),
        endogeneity=endogeneity_result(estimation),
        endogeneity_untested=(
            estimation.endogeneity if isinstance(estimation.endogeneity, str) else None
        ),
        notes=list(prepared.notes),
        parameters=_parameters(cell, estimation, truth),
        n_base=len(model.base.names),
        uncertainty=uncertainty_result(estimation),
        repetitions=[source.name for source in sources.training],
        repetition_values=[one.values.tolist() for one in estimate.repetitions],
        noise_std=pooled.noise_std.tolist(),
        correlation=correlation(gram).tolist(),
        validation=[] if sources.in_sample else _validation(sources, estimate, prepared.held_out),
        fitted=_fitted(model, pooled.values, prepared),
        calibration=calibration_result(prepared, estimation),
        delays=_delays(prepared),
        choices=[
            ChoiceResult(
                name=choice.name,
                candidates=[*choice.candidates],
                errors=[error if np.isfinite(error) else None for error in choice.errors],
                chosen=choice.chosen,
            )
            for choice in prepared.settings.choices
        ],
        coverage=None if truth is None else _coverage(pooled.values, pooled.std, truth),
        verdict=VerdictResult(
            good=verdict.good,
            line=verdict.line,
            reasons=[*verdict.reasons],
            warnings=[*verdict.warnings, *sources.warnings],
        ),
        essential=essential_result(essential),
        consistency=consistency_result(model, consistency),
    )


def planted_in(cell: Cell, header: ArchiveHeader) -> Array | None:
    """What was planted in the simulated arm (p,): as the archive says, or else its cell.

    None where neither says it, and where the archive does not say it of each parameter. That of a
    torque ripple, whose phase is drawn, is NaN.
    """
    model, planted = cell.model, header.planted
    if planted is not None:
        if not planted.keys() >= {*model.parameter_names[: model.element_part.start]}:
            return None
        return np.array([planted.get(name, np.nan) for name in model.parameter_names])
    if cell.file.simulation is None:
        return None
    values = planted_values(cell)
    for one in model.elements.identified:
        if isinstance(one.element, TorqueRipple):
            values[model.element_part][one.part] = np.nan
    return values


def _period(samples: Samples) -> float:
    return float(np.median(np.diff(samples.motion.time)))


def _executed(model: RobotModel, training: Sequence[Samples], rows: Sequence[slice]) -> Factor:
    """Every sample of the motion, resting joints included, as the criteria of a plan see it."""
    factor = Factor.zero(model)
    for samples, part in zip(training, rows, strict=True):
        motion = samples.motion.rows(part)._replace(direction=None)
        factor = factor + Factor.from_samples(model, motion, samples.torque[part])
    return factor


def _excitation(
    sources: Sources, gram: Array, training: Sequence[Samples], rows: Sequence[slice]
) -> ExcitationResult:
    """Criteria of what was executed (all repetitions), and of the plan where one was attached."""
    lengths = [part.stop - part.start for part in rows]
    executed = _criteria(gram, sum(lengths))
    planned = _planned(sources)
    if planned is None:
        return ExcitationResult(
            duration=lengths[0] * _period(training[0]),
            n_via=None,
            fly=None,
            planned=None,
            executed=executed,
        )
    trajectory, criteria = planned.trajectory, planned.criteria
    return ExcitationResult(
        method=planned.method,
        duration=trajectory.duration,
        n_via=_n_via(planned.via_points),
        fly=planned.fly,
        n_sines=trajectory.amplitude.shape[1] if isinstance(trajectory, FourierSeries) else None,
        planned=CriteriaResult(
            **asdict(criteria), coupling_index_max=coupling_index_max(len(gram))
        ),
        executed=executed,
    )


def _planned(sources: Sources) -> Excitation | None:
    """The excitation that was planned, where the archives say what it was."""
    plan = sources.plan or {}
    try:
        return Excitation.from_dict(plan["excitation"]) if "excitation" in plan else None
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            sources.training[0].name,
            f"its plan.json holds no excitation that can be read ({error!r})",
            remedy="identify with the version of hil that recorded it",
        ) from error


def _n_via(via_points: Array | None) -> int | None:
    """Via points, without the posture that a closed path begins and ends at."""
    if via_points is None:
        return None
    closed = np.array_equal(via_points[0], via_points[-1])
    return len(via_points) - 2 if closed else len(via_points)


def executed_rows(source: Source, samples: Samples) -> slice:
    """Time samples of the motion itself: those of a plan, from where it was asked to move.

    Where no set-points were recorded, from the first to the last in which some joint moves.
    """
    commanded, time = source.recording.commanded_position, source.recording.time
    if commanded is None:
        return moving_rows(samples)
    steps = np.flatnonzero((np.abs(np.diff(commanded, axis=0)) > 0.0).any(axis=1))
    if not steps.size:
        return slice(0, 0)
    first, last = np.searchsorted(samples.motion.time, time[[steps[0], steps[-1] + 1]])
    return slice(int(first), int(last) + 1)


def moving_rows(samples: Samples) -> slice:
    """Time samples from the first to the last in which some joint moves."""
    moving = np.flatnonzero(samples.usable.any(axis=1))
    return slice(int(moving[0]), int(moving[-1]) + 1) if moving.size else slice(0, 0)


def _criteria(gram: Array, n_samples: int) -> CriteriaResult:
    return CriteriaResult(
        log10_det=log10_det(gram, n_samples),
        coupling_index=coupling_index(gram),
        coupling_index_max=coupling_index_max(len(gram)),
        fitness=fitness_eq7(gram, n_samples),
        n_samples=n_samples,
        condition=condition_number(gram, scaled=False),
        scaled_condition=condition_number(gram, scaled=True),
    )


def _parameters(cell: Cell, estimation: Estimation, truth: Array | None) -> list[ParameterResult]:
    model, estimate, posterior = cell.model, estimation.result, estimation.posterior
    pooled = estimate.pooled
    expressions = [*model.base.expressions(), *model.parameter_names[len(model.base.names) :]]
    std = estimate.std if len(estimate.repetitions) > 1 else None
    printed = _table2_ids() if cell.urdf == URDF_PATH.read_text(encoding="utf-8") else {}
    return [
        ParameterResult(
            name=parameter,
            expression=expressions[i],
            unit=model.units[i],
            table2_id=printed.get(parameter),
            estimate=float(pooled.values[i]),
            std=float(pooled.std[i]),
            repetition_mean=float(estimate.mean[i]),
            repetition_std=None if std is None else float(std[i]),
            truth=None if truth is None or np.isnan(truth[i]) else float(truth[i]),
            undetermined=parameter in pooled.undetermined,
            of_this_run=bool(model.friction_columns[i]),
            prior_std=None if isinstance(posterior, str) else float(posterior.prior_std[i]),
            prior_ratio=None if isinstance(posterior, str) else float(posterior.ratio[i]),
            learned=None if isinstance(posterior, str) else bool(posterior.learned[i]),
        )
        for i, parameter in enumerate(model.parameter_names)
    ]


def _table2_ids() -> dict[str, int]:
    """Row of the paper's Table 2 by our parameter name (rows 29 and 31 have the other sign)."""
    return {row.pivot or row.parameter: row.id for row in TABLE2}


def _validation(
    sources: Sources, estimate: RepeatedEstimate, held_out: Sequence[Samples]
) -> list[ValidationResult]:
    model, values = sources.cell.model, estimate.pooled.values
    errors = prediction_error(model, values, held_out)
    everywhere = prediction_error(model, values, held_out, all_rows=True)
    return [
        ValidationResult(
            archive=source.name,
            duration=float(source.recording.time[-1] - source.recording.time[0]),
            mean_abs_error=error.mean_absolute.tolist(),
            rms_error=error.rms.tolist(),
            mean_error=error.mean.tolist(),
            relative_error=error.relative.tolist(),
            overall_relative_error=error.overall,
            all_rows_relative_error=all_rows.overall,
            all_rows_joint_errors=all_rows.relative.tolist(),
        )
        for source, error, all_rows in zip(sources.held_out, errors, everywhere, strict=True)
    ]


def _fitted(model: RobotModel, values: Array, prepared: Prepared) -> FittedResult:
    """In-sample errors: of the torque as recorded, and as it was fitted where that differs."""

    def error(samples: Sequence[Samples], *, all_rows: bool) -> PredictionError:
        return over_all(prediction_error(model, values, samples, all_rows=all_rows))

    moving = error(prepared.training, all_rows=False)
    everywhere = error(prepared.training, all_rows=True)
    smoothed = (
        error(prepared.fitted, all_rows=True)
        if prepared.settings.preprocessing.smooth_torque
        else None
    )
    return FittedResult(
        relative_error=moving.relative.tolist(),
        overall_relative_error=moving.overall,
        all_rows_relative_error=everywhere.overall,
        all_rows_joint_errors=everywhere.relative.tolist(),
        smoothed_relative_error=None if smoothed is None else smoothed.relative.tolist(),
        smoothed_overall_relative_error=None if smoothed is None else smoothed.overall,
    )


def _delays(prepared: Prepared) -> DelaysResult | None:
    found = prepared.delays
    if found is None:
        return None
    known = found.determined.tolist()
    half = (found.interval_factor * found.std).tolist()
    return DelaysResult(
        found=[d if k else None for d, k in zip(found.delays.tolist(), known, strict=True)],
        interval=[h if k else None for h, k in zip(half, known, strict=True)],
        applied=prepared.assumed_delay.tolist(),
    )


def _coverage(values: Array, std: Array, truth: Array) -> CoverageResult:
    """Of the parameters that the data determine and whose truth is known."""
    determined = np.isfinite(std) & np.isfinite(truth)
    distance = np.abs(values - truth)[determined]
    std = std[determined]
    return CoverageResult(
        within_2=int((distance <= 2.0 * std).sum()),
        within_3=int((distance <= 3.0 * std).sum()),
        total=int(determined.sum()),
    )
