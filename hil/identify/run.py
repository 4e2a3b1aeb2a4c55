"""Identification: estimate, validate, verdict, results."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hil import results
from hil.archive import ArchiveHeader
from hil.cell import Cell
from hil.errors import InputError
from hil.progress import Reporter
from hil.report import ReportSeries
from hil.version import software
from identification import Factor, IdentificationError, RobotModel
from identification.estimators.least_squares import RepeatedEstimate
from identification.excitation import (
    Criteria,
    Excitation,
    correlation,
    coupling_index_max,
    information,
)
from identification.model.elements import TorqueRipple
from identification.selection.essential import Elimination, choose_essential
from identification.signals.samples import Samples
from identification.validation.calibration import TorqueMeans, calibrate
from identification.validation.evidence import Evidence, gather
from identification.validation.plausibility import ConsistencyCheck, check_consistency
from identification.validation.prediction import (
    PredictionError,
    pooled_error,
    prediction_error,
)
from identification.validation.residuals import BLOCK, Profile
from identification.validation.verdict import Verdict, judge
from planner import FourierSeries
from sim_fixtures.ns16 import TABLE2, URDF_PATH

from .cell_context import cell_context_of, nominal_of
from .estimating import Estimation, estimate_with, with_transmitted_load
from .figure_series import report_series
from .options import ESTIMATORS, Options
from .prepared import Prepared, executed_rows, prepare_sources
from .sources import Sources, gather_sources

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Identification:
    """An identification with everything it was computed from."""

    paths: tuple[Path, ...]  #: of the archives
    prepared: Prepared
    estimation: Estimation
    essential: Elimination | str  #: essential parameters, or the reason why there are none
    consistency: ConsistencyCheck | str  #: consistent parameters, or the reason why there are none
    verdict: Verdict
    results: results.Results  #: content of `results.json`

    @property
    def cell(self) -> Cell:
        """The cell of the archives."""
        return self.prepared.sources.cell

    @property
    def estimate(self) -> RepeatedEstimate:
        """Pooled and per repetition."""
        return self.estimation.result

    @cached_property
    def series(self) -> ReportSeries:
        """Data of the report's figures."""
        return report_series(self.prepared, self.estimate)


def consistency_of(estimation: Estimation, held_out: Factor) -> ConsistencyCheck | str:
    """Compare the posteriors with and without possible bodies, or return why that failed."""
    posterior, training = estimation.posterior, estimation.result.factor
    try:
        return check_consistency(
            posterior.model,
            training,
            held_out,
            posterior.free(training).estimate,
            weights=posterior.weights(training),
            prior=posterior.prior,
            design_effect=posterior.design_effect,
        )
    except IdentificationError as error:
        return str(error)


def identify_archives(
    paths: Sequence[Path],
    reporter: Reporter,
    options: Options = Options(),
    *,
    predict: Sequence[Path] = (),
    name: str = "",
    warnings: Sequence[str] = (),
) -> Identification:
    """Identify from archives; their kind decides what is fitted, `predict` is held out.

    Raises:
        InputError: the archives cannot be used, not together, or not by the chosen estimator.
    """
    sources = gather_sources(paths, options.split, predict, in_sample=options.in_sample)
    prepared = with_transmitted_load(prepare_sources(sources, options, reporter))
    estimation = estimate_with(prepared, options, reporter)
    sources, result, cell = prepared.sources, estimation.result, prepared.sources.cell
    warned = [*sources.warnings, *warnings, *estimation.warnings]
    with reporter.task("validating", 3) as task:
        unseen = sum(estimation.held_out, Factor.zero(cell.model))
        consistency = consistency_of(estimation, unseen)
        impossible: list[str] = []
        if isinstance(consistency, str):
            warned.append(f"no physically consistent parameters were found: {consistency}")
        else:
            if sources.in_sample:
                consistency = replace(consistency, judged_on="in-sample")
            if consistency.impossible:  # no rigid bodies produce the predicted torque
                impossible.append(f"{consistency.sentence}: {consistency.remedy}")
            elif consistency.costly:
                warned.append(consistency.sentence)
        task.advance(1, "essential parameters")
        essential: Elimination | str = "they are chosen on held-out data, and there is none"
        if not sources.in_sample:
            try:
                essential = choose_essential(cell.model, result.factor, estimation.held_out)
            except IdentificationError as error:
                essential = str(error)
        if isinstance(essential, str):
            warned.append(f"no essential parameters: {essential}")
        task.advance(1, "verdict")
        nominal = nominal_of(cell)
        evidence = gather(
            cell.model,
            result,
            prepared.training,
            prepared.held_out,
            same_motion=sources.same_motion,
            nominal=None if nominal is None else nominal.values,
            context=cell_context_of(prepared, result.pooled),
            in_sample=sources.in_sample,
            names=[source.name for source in sources.training],
            unseen=sum(estimation.held_out, Factor.zero(cell.model)),
        )
        implausible = evidence.implausible
        reasons = (*implausible.impossible, *impossible)
        evidence = replace(evidence, implausible=implausible._replace(impossible=reasons))
        verdict = judge(cell.model.joint_names, evidence, tested_on=sources.tested_on)
        task.advance(1)
    prepared = replace(prepared, sources=replace(sources, warnings=tuple(warned)))
    return Identification(
        paths=(*paths, *predict),
        prepared=prepared,
        estimation=estimation,
        essential=essential,
        consistency=consistency,
        verdict=verdict,
        results=summarise(
            name or paths[0].stem,
            prepared,
            estimation,
            verdict,
            evidence,
            None if nominal is None else nominal.label,
            essential,
            consistency,
        ),
    )


# Results


def summarise(
    name: str,
    prepared: Prepared,
    estimation: Estimation,
    verdict: Verdict,
    evidence: Evidence,
    nominal: str | None,
    essential: Elimination | str,
    consistency: ConsistencyCheck | str,
) -> results.Results:
    """Return the results; `nominal` describes the nominal model.

    Raises:
        InputError: the plan in the archives cannot be read.
    """
    sources, estimate = prepared.sources, estimation.result
    cell, model, pooled = sources.cell, sources.cell.model, estimate.pooled
    excitation, gram = _excitation(prepared)
    simulated = sources.header.only_simulated
    truth = true_values(cell, sources.header) if simulated else None
    return results.Results(
        name=name,
        cell=cell.name,
        simulated=simulated,
        effects=[*sources.header.effects],
        joint_names=list(model.joint_names),
        period=_period(prepared.training[0]),
        software=software(),
        excitation=excitation,
        estimator=results.EstimatorResult(
            name=estimation.estimator,
            words=pooled.method
            if estimation.estimator == "auto"
            else ESTIMATORS[estimation.estimator],
            prior=estimation.with_prior.words,
            condition=pooled.condition,
            grouping=model.base.explanation(),
        ),
        notes=[*prepared.notes, *estimation.notes],
        parameters=_parameters(cell, estimation, truth),
        n_base=len(model.base.names),
        uncertainty=results.UncertaintyResult.of(estimation.stated),
        repetitions=[source.name for source in sources.training],
        repetition_values=[one.values.tolist() for one in estimate.repetitions],
        noise_std=pooled.noise_std.tolist(),
        correlation=correlation(gram).tolist(),
        validation=[] if sources.in_sample else _validation(prepared, pooled.values),
        fitted=_fitted(prepared, pooled.values),
        calibration=_calibration(prepared, estimation),
        delays=_delays(prepared),
        choices=[*prepared.settings.choices],
        coverage=None if truth is None else _coverage(pooled.values, pooled.std, truth),
        verdict=results.VerdictResult.of(verdict, warnings=[*verdict.warnings, *sources.warnings]),
        essential=None if isinstance(essential, str) else essential_result(essential),
        consistency=None
        if isinstance(consistency, str)
        else consistency_result(model, consistency),
        judgement=_judgement(model.joint_names, evidence, verdict, nominal),
    )


def _calibration(prepared: Prepared, estimation: Estimation) -> results.CalibrationResult | None:
    """Check the intervals of held-out torque; None if nothing or too little was held out."""
    if prepared.sources.in_sample:
        return None
    model, result = prepared.sources.cell.model, estimation.result
    try:
        found = calibrate(
            result.pooled,
            result.factor,
            TorqueMeans.of(model, prepared.training),
            TorqueMeans.of(model, prepared.held_out),
            estimation.refit,
        )
    except IdentificationError:
        return None
    if math.isnan(found.overall):
        return None
    return results.CalibrationResult.of(
        block=BLOCK,
        means=int(found.blocks.sum()),
        inside=found.overall,
        white_inside=found.white_overall,
        joint_inside=found.inside,
        half_width=found.half_width,
    )


def consistency_result(model: RobotModel, check: ConsistencyCheck) -> results.ConsistencyResult:
    """Return the result of a consistency check."""
    found = check.consistent
    standard = dict(zip(model.layout.names, found.standard.tolist(), strict=True))
    inertial = found.standard[model.layout.links]
    return results.ConsistencyResult.of(
        check,
        in_sample=found.relative_error,
        unconstrained_in_sample=found.unconstrained_relative_error,
        shift=found.shift,
        status=found.status,
        links=results.LinkResult.rows(
            joint=model.joint_names,
            mass=inertial[:, 9],
            centre=inertial[:, 6:9] / inertial[:, 9:],
            rotor_inertia=[standard.get(f"I{k + 1}m") for k in range(model.n_joints)],
            room=check.room,
            reference=found.reference,
        ),
    )


def essential_result(choice: Elimination) -> results.EssentialResult:
    """Return the result of a choice of essential parameters."""
    left = choice.estimate
    return results.EssentialResult.of(
        choice,
        parameters=results.EssentialParameter.rows(
            name=left.names, unit=left.units, estimate=left.values, std=left.std
        ),
    )


def true_values(cell: Cell, header: ArchiveHeader) -> Array | None:
    """Return the parameters (p,) of the simulated arm, NaN of a torque ripple; None if unknown."""
    model, planted = cell.model, header.planted
    if planted is not None:
        if not planted.keys() >= {*model.parameter_names[: model.element_part.start]}:
            return None
        return np.array([planted.get(name, np.nan) for name in model.parameter_names])
    if cell.file.simulation is None:
        return None
    from hil.simulation import planted_values  # only for a simulated arm

    values = planted_values(cell)
    for one in model.elements.identified:
        if isinstance(one.element, TorqueRipple):
            values[model.element_part][one.part] = np.nan
    return values


def _period(samples: Samples) -> float:
    return float(np.median(np.diff(samples.motion.time)))


def _excitation(prepared: Prepared) -> tuple[results.ExcitationResult, Array]:
    """Return the criteria of executed and planned motion, and the information (p, p); all rows."""
    model, lengths = prepared.sources.cell.model, []
    factor = Factor.zero(model)
    for source, samples in zip(prepared.sources.training, prepared.training, strict=True):
        part = executed_rows(source, samples)
        lengths.append(part.stop - part.start)
        motion = samples.motion.rows(part)._replace(direction=None)
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
    trajectory, via_points = planned.trajectory, planned.via_points
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
    model, estimate, posterior = cell.model, estimation.result, estimation.with_prior
    pooled, many = estimation.stated, len(estimate.repetitions) > 1
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
    )


def _validation(prepared: Prepared, values: Array) -> list[results.ValidationResult]:
    sources, model = prepared.sources, prepared.sources.cell.model
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
    found, applied = prepared.delays, prepared.assumed_delay
    every = np.ones(len(prepared.sources.cell.joint_names))
    if found is not None:
        # A delay with a wide interval is applied, too, where it predicts better.
        known = 1.0 if found.determined or found.delay == applied else np.nan
        delay, interval = known * found.delay, known * found.half_interval
    elif applied != prepared.settings.stated_delay:
        # The lag of a low-pass that predicts as well as the low-pass.
        delay, interval = applied, np.nan
    else:
        return None
    return results.DelaysResult.of(
        found=delay * every, interval=interval * every, applied=applied * every
    )


def _coverage(values: Array, std: Array, truth: Array) -> results.CoverageResult:
    """Return the coverage of the determined parameters with known true values."""
    determined = np.isfinite(std) & np.isfinite(truth)
    distance, std = np.abs(values - truth)[determined], std[determined]
    within_2, within_3 = (int((distance <= limit * std).sum()) for limit in (2.0, 3.0))
    return results.CoverageResult(within_2=within_2, within_3=within_3, total=len(std))


def _judgement(
    joint_names: Sequence[str], evidence: Evidence, verdict: Verdict, nominal: str | None
) -> results.JudgementResult:
    """Return the verdict with the numbers behind it."""

    def profile(one: Profile) -> list[results.ProfileResult]:
        bins = one.bins
        return results.ProfileResult.rows(centre=one.centres, mean=bins.mean, std=bins.std)

    checks, context, error = evidence.residuals, evidence.context, evidence.held_out
    assert checks is not None
    inertia = context.controller_inertia
    limit = context.torque_limit
    joints = results.JointJudgement.rows(
        joint=joint_names,
        unit=["N·m" if evidence.revolute(j) else "N" for j in range(len(joint_names))],
        rms=error.rms,
        relative=error.relative,
        fitted_relative=evidence.training.relative,
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
        nominal=None if evidence.nominal is None else nominal,
        findings=verdict.findings,
        next_steps=verdict.next_steps,
        joints=joints,
        speed=profile(checks.speed),
        position=profile(checks.position),
    )
