"""Validation of an estimate: evidence for and against it, and the verdict."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from hil.base.progress import Reporter
from hil.cell.nominal import Nominal, nominal_of
from identification import Factor, IdentificationError
from identification.hypotheses.diagnosis import TorqueDiagnosis
from identification.hypotheses.sizes import ScorePrior
from identification.purposes.purposes import Application, purposes_of
from identification.purposes.thresholds import ContactThreshold
from identification.selection.essential import Elimination, choose_essential
from identification.validation.calibration import Calibration, TorqueMeans, calibrate
from identification.validation.consistency import ConsistencyCheck, check_consistency
from identification.validation.evidence import Evidence, gather
from identification.validation.verdict import Verdict, judge

from .cell_context import cell_context_of, joint_ranges
from .estimating import Estimation
from .notes import CostlyBodies, NoEssentialParameters, NotConsistent, Note, NotEssential
from .options import Options
from .prepared import Prepared
from .sources import Sources


@dataclass(frozen=True, eq=False)
class Validation:
    """Evidence on an estimate, and the verdict."""

    consistency: ConsistencyCheck | NotConsistent  #: consistent parameters, or why there are none
    essential: Elimination | NotEssential  #: essential parameters, or why there are none
    #: coverage of the intervals of held-out torque; None if too little or nothing was held out
    calibration: Calibration | None
    nominal: Nominal | None  #: nominal model
    evidence: Evidence
    verdict: Verdict
    thresholds: tuple[ContactThreshold, ...] = ()  #: of contacts, from held-out motion

    @property
    def warnings(self) -> tuple[Note, ...]:
        """Remarks that do not affect the verdict."""
        found: list[Note] = []
        if isinstance(self.consistency, NotConsistent):
            found.append(self.consistency)
        elif self.consistency.costly and not self.consistency.impossible:  # which is a finding
            found.append(CostlyBodies(self.consistency))
        if isinstance(self.essential, NotEssential):
            found.append(self.essential)
        return tuple(found)


def validate(
    prepared: Prepared,
    estimation: Estimation,
    options: Options,
    reporter: Reporter,
    diagnoses: Mapping[Path, TorqueDiagnosis],
) -> Validation:
    """Gather the evidence on an estimate, and judge it.

    Args:
        prepared: recordings and settings.
        estimation: of the parameters.
        options: of the identification, with the purposes that decide.
        reporter: of progress.
        diagnoses: what the torques of archives are, by path, where that was asked.
    """
    sources = prepared.sources
    result = estimation.result
    model = sources.cell.model
    nominal = nominal_of(sources.cell)
    posterior = estimation.posterior
    with reporter.task("validating", 4) as task:
        unseen = sum(estimation.held_out, Factor.zero(model))
        consistency = _consistency(estimation, unseen, in_sample=sources.in_sample)
        task.advance(1, "essential parameters")
        essential = _essential(prepared, estimation)
        task.advance(1, "verdict")
        evidence = gather(
            model,
            result,
            prepared.training,
            prepared.held_out,
            same_motion=sources.same_motion,
            nominal=None if nominal is None else nominal.values,
            context=cell_context_of(prepared, result.pooled),
            in_sample=sources.in_sample,
            names=[source.name for source in sources.training],
            unseen=unseen,
            known=_known(sources, diagnoses),
            prior=ScorePrior(posterior.prior.belief.gaussian, posterior.design_effect),
        )
        possible = None if isinstance(consistency, NotConsistent) else consistency
        evidence = replace(evidence, form=estimation.form, consistency=possible)
        task.advance(1, "purposes")
        application = _application(prepared, estimation, evidence, consistency)
        verdict = judge(
            model.joint_names,
            evidence,
            tested_on=sources.tested_on,
            purposes=purposes_of(application, options.required),
            asked=options.purposes,
        )
        task.advance(1)
    calibration = _calibration(prepared, estimation)
    return Validation(
        consistency, essential, calibration, nominal, evidence, verdict, application.thresholds()
    )


def _known(sources: Sources, diagnoses: Mapping[Path, TorqueDiagnosis]) -> TorqueDiagnosis | None:
    """Return what the fitted recording is; None of several, which say more together."""
    (first, *more) = sources.training
    return None if more else diagnoses.get(first.path)


def _application(
    prepared: Prepared,
    estimation: Estimation,
    evidence: Evidence,
    consistency: ConsistencyCheck | NotConsistent,
) -> Application:
    sources = prepared.sources
    lower, upper = joint_ranges(sources)
    possible = (
        None if isinstance(consistency, NotConsistent) else consistency.consistent.estimate.values
    )
    return Application(
        model=sources.cell.model,
        estimate=estimation.result.pooled,
        stated=estimation.stated,
        evidence=evidence,
        held_out=() if sources.in_sample else prepared.held_out,
        consistent=possible,
        lower=lower,
        upper=upper,
    )


def _consistency(
    estimation: Estimation, unseen: Factor, *, in_sample: bool
) -> ConsistencyCheck | NotConsistent:
    """Compare the posteriors with and without possible bodies, or return why that failed."""
    posterior = estimation.posterior
    training = estimation.result.factor
    try:
        return check_consistency(
            posterior.model,
            training,
            unseen,
            posterior.free(training).estimate,
            weights=posterior.weights(training),
            prior=posterior.prior,
            design_effect=posterior.design_effect,
            in_sample=in_sample,
        )
    except IdentificationError as error:
        return NotConsistent(str(error))


def _essential(prepared: Prepared, estimation: Estimation) -> Elimination | NotEssential:
    """Choose the essential parameters, or return why there are none."""
    if prepared.sources.in_sample:
        return NotEssential(NoEssentialParameters.NOTHING_HELD_OUT)
    model = prepared.sources.cell.model
    try:
        return choose_essential(model, estimation.result.factor, estimation.held_out)
    except IdentificationError as error:
        return NotEssential(str(error))


def _calibration(prepared: Prepared, estimation: Estimation) -> Calibration | None:
    """Check the intervals of held-out torque."""
    if prepared.sources.in_sample:
        return None
    model = prepared.sources.cell.model
    result = estimation.result
    try:
        calibration = calibrate(
            result.pooled,
            result.factor,
            TorqueMeans.of(model, prepared.training),
            TorqueMeans.of(model, prepared.held_out),
            estimation.refit,
        )
    except IdentificationError:
        return None
    return None if math.isnan(calibration.inside) else calibration
