"""Estimation of parameters from samples, with the prior of the arm."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from hil.base.arrays import Array
from hil.base.errors import ArchiveError, InputError
from hil.base.progress import Reporter
from hil.cell import Cell
from identification import IdentificationError, RobotModel
from identification.estimators.friction_form import FormUncertainty
from identification.estimators.instrumental import (
    estimate_instrumental,
    planned_motion,
    same_plan,
)
from identification.estimators.least_squares import RepeatedEstimate, estimate_repetitions
from identification.estimators.load_friction import LoadFit, fit_with_load
from identification.estimators.loss_functions import Huber, Loss, Tukey
from identification.estimators.prior import BODY_STD_SHARE, NOMINAL_STD_SHARE, PosteriorEstimate
from identification.estimators.robust import RobustEstimate, robust_estimate
from identification.factor.columns import instrument_factor
from identification.factor.estimate import Estimate
from identification.factor.factor import MAX_GRAM_CONDITION, Factor, no_rows_message, total_factor
from identification.reduction.intervals import widened
from identification.reduction.posterior import Posterior
from identification.reduction.reduction import Reduction
from identification.selection.settings import Settings, Strength
from identification.signals.samples import Samples
from identification.text import duration_text
from identification.validation.calibration import Refit

from .cell_context import torque_scale_of
from .estimators import OF_PRIOR, Estimator, fit_of, values_of
from .notes import (
    ElasticGears,
    IntervalUnits,
    LoadNotConverged,
    ManyOutliers,
    Note,
    PoorlySeparated,
    PriorContradicted,
    ReweightingNotConverged,
    UnrestrictedBodies,
    WeakInstruments,
)
from .options import Options
from .prepared import MAX_RECORDINGS, Prepared, known_parameters, samples_of
from .sources import Sources
from .torque_scale import TorqueScale

# Hz. A narrower smoother removes part of the motion from the regressor, a bias that instruments
# cannot correct. On simulated NS 16 logs with 100 to 1000 times the encoder noise, instrumental
# variables at the best bandwidth of least squares (7 to 14 Hz) were worse than least squares, and
# at 20 Hz always better.
MIN_IV_BANDWIDTH: Final = 20.0
# Difference between data and prior, in standard deviations, that is reported.
_MAX_PRIOR_DEVIATION: Final = 4.0


# Time since the origin and commanded positions of a motion, and the lag of each axis, which is the
# same in every repetition.
_Plan = tuple[tuple[Array, Array], Array]


@dataclass(frozen=True, eq=False)
class Estimation:
    """An estimate with its tests and warnings."""

    estimator: Estimator
    result: RepeatedEstimate  #: pooled and per repetition
    held_out: tuple[Factor, ...]  #: one per held-out recording
    posterior: Posterior  #: prior of the arm, and its strength
    #: estimate with that prior, which is the result of "auto" and "prior"
    with_prior: PosteriorEstimate
    refit: Refit  #: parameters by the estimator from a factor, to predict parts of the fitted rows
    warnings: tuple[Note, ...]
    #: the pooled result, with the uncertainty of elastic gears in its covariance, and its change by
    #: the scale of the torques: no residual shows what they do to parameters
    stated: Estimate
    notes: tuple[Note, ...]  #: what the intervals assume
    form: FormUncertainty | None  #: whether the friction law lacks a term


def fit_with_transmitted_load(
    cell: Cell, fitted: Sequence[Samples], strength: Strength
) -> LoadFit[Estimate]:
    """Return the posterior with the torque that the gears transmit, as a fixed point."""
    model = cell.model

    def fit(samples: Sequence[Samples]) -> Estimate:
        total = total_factor(model, samples)
        return posterior_of(cell, total, "auto", strength).fit(total).estimate

    return fit_with_load(model, fitted, fit)


def with_loading(settings: Settings, sources: Sources) -> Settings:
    """Return settings with the parameters that load the gears, if friction grows with the load.

    All recordings have them then, so that their factors can be added.
    """
    cell = sources.cell.with_friction(**settings.friction)
    if not cell.model.friction.has_load:
        return settings
    fitted = [samples_of(source, cell, settings) for source in sources.training[:MAX_RECORDINGS]]
    loaded = fit_with_transmitted_load(cell, fitted, settings.strength)
    return replace(settings, loading=tuple(loaded.result.values.tolist()))


def with_transmitted_load(prepared: Prepared) -> Prepared:
    """Return samples that carry the torque that the gears transmit.

    Of the posterior, as a fixed point; unchanged without friction that grows with it.
    """
    cell = prepared.sources.cell
    model = cell.model
    if not model.friction.has_load:
        return prepared
    loaded = fit_with_transmitted_load(cell, prepared.fitted, prepared.settings.strength)
    carrying = prepared.with_load(loaded.result.values)
    notes = prepared.notes
    if not loaded.converged:
        notes += (LoadNotConverged(loaded.change, loaded.passes),)
    return replace(carrying, fitted=loaded.samples, notes=notes)


def estimate_with(
    prepared: Prepared,
    options: Options,
    reporter: Reporter,
    reductions: Sequence[Reduction] = (),
) -> Estimation:
    """Estimate the parameters by `options.estimator`, with all applicable tests.

    Args:
        prepared: recordings and settings.
        options: of the identification.
        reporter: of progress.
        reductions: of the fitted recordings; computed unless known.

    Raises:
        InputError: the archives lack data that the estimator needs.
        ArchiveError: a recording has no usable row.
    """
    cell, name, settings = prepared.sources.cell, options.estimator, prepared.settings
    model = cell.model
    _require_usable_rows(prepared)
    with reporter.task("estimating", 4) as task:
        if name == "iv":
            prepared = smoothed_for_instruments(prepared)
        task.advance(1, name)
        reductions = reductions or prepared.reductions
        factors = [reduction.factor for reduction in reductions]
        total = Reduction.total(model, reductions)
        posterior, beside, unrestricted = fit_with_prior(
            cell, total.factor, name, settings.strength
        )
        if name in OF_PRIOR:
            result = _posterior(model, posterior, beside.estimate, factors)
            warnings: list[Note] = [*unrestricted]
        else:
            result, warnings = _without_prior(prepared, name)
        scale = torque_scale_of(prepared.sources)
        pooled, stated, form = widened(
            result.pooled,
            total,
            posterior,
            posterior.precision if name in OF_PRIOR else None,
            delay_variance=settings.delay_variance,
            repetitions=result.values if prepared.sources.same_motion else None,
            torque_scale=scale.std,
            recordings=factors,
        )
        result = replace(result, pooled=pooled)
        task.advance(1, "prior")
        of_prior = replace(beside, estimate=pooled)
        beside = of_prior if name in OF_PRIOR else posterior.fit(result.factor)
        warnings += _prior_contradictions(model, beside) if name == "prior" else []
        task.advance(1, "held-out motion")
        held_out = tuple(Factor.by_time(model, samples) for samples in prepared.held_out)
        task.advance(1)
    return Estimation(
        estimator=name,
        result=result,
        held_out=held_out,
        posterior=posterior,
        with_prior=beside,
        refit=refit_of(model, name, posterior),
        warnings=tuple(warnings),
        stated=stated,
        notes=_interval_notes(cell, scale),
        form=form,
    )


def _interval_notes(cell: Cell, scale: TorqueScale) -> tuple[Note, ...]:
    """Return what the intervals assume."""
    units = IntervalUnits(scale)
    if cell.file.drive_train is None:  # positions may be measured behind the gears
        return (units,)
    return units, ElasticGears()


def posterior_of(cell: Cell, factor: Factor, name: str, strength: Strength) -> Posterior:
    """Return the posterior of an estimator.

    The bodies are as uncertain as `[nominal]` states; the estimator "prior" trusts them to
    `NOMINAL_STD_SHARE` if it states nothing.

    Args:
        cell: of the arm.
        factor: of the data.
        name: of the estimator.
        strength: of the prior for "auto"; others take the strength that the residuals give.
    """
    table = cell.file.nominal
    share = NOMINAL_STD_SHARE if name == "prior" else BODY_STD_SHARE
    if table is not None and "uncertainty" in table.model_fields_set:
        share = table.uncertainty or share
    if name != "auto":
        strength = Strength()
    return Posterior.of(cell.model, factor, share, known_parameters(cell), strength)


class PriorFit(NamedTuple):
    """Posterior of a sum of recordings, with its fit."""

    posterior: Posterior
    estimate: PosteriorEstimate
    notes: tuple[UnrestrictedBodies, ...]  #: why the bodies are not restricted to possible ones


def fit_with_prior(cell: Cell, total: Factor, name: str, strength: Strength) -> PriorFit:
    """Fit a sum of recordings with the prior of an estimator.

    Args:
        cell: of the arm.
        total: of the recordings.
        name: of the estimator.
        strength: of the prior, as for :func:`posterior_of`.
    """
    posterior, fit, unsolved = posterior_of(cell, total, name, strength).solved(total)
    return PriorFit(
        posterior, fit, () if unsolved is None else (UnrestrictedBodies(str(unsolved)),)
    )


def _without_prior(prepared: Prepared, name: Estimator) -> tuple[RepeatedEstimate, list[Note]]:
    """Fit by an estimator that has no prior; return its warnings as well."""
    model = prepared.sources.cell.model
    fitted = prepared.fitted
    if name == "iv":
        result, warnings = _instrumental(model, prepared)
    elif name in _LOSSES:
        result, warnings = _robust(model, fitted, name)
    else:
        result, warnings = _by_factor(model, fitted, name)
    return result, warnings + _poorly_separated(result.pooled)


def _poorly_separated(estimate: Estimate) -> list[Note]:
    if estimate.undetermined or estimate.condition <= MAX_GRAM_CONDITION:
        return []
    return [PoorlySeparated(estimate.condition)]


def _require_usable_rows(prepared: Prepared) -> None:
    """Raise ArchiveError for a recording without a usable row, for example a truncated one."""
    model = prepared.sources.cell.model
    for source, samples in zip(prepared.sources.training, prepared.fitted, strict=True):
        if not samples.usable.any():
            lasts = f"it lasts {duration_text(np.ptp(samples.motion.time))}"
            raise ArchiveError(
                Path(source.name), f"{no_rows_message(model)} ({lasts})", remedy="leave it out"
            )


# Estimators


def refit_of(model: RobotModel, name: Estimator, posterior: Posterior) -> Refit:
    """Return the parameters (p,) by an estimator as a function of a factor."""
    return posterior.values if name in OF_PRIOR else values_of(model, name)


def _posterior(
    model: RobotModel, posterior: Posterior, pooled: Estimate, factors: Sequence[Factor]
) -> RepeatedEstimate:
    share = 1.0 / len(factors)
    values = [pooled.values]
    if len(factors) > 1:
        # The prior counts for a part as for the whole, so that the scatter is that of the noise.
        values = [posterior.values(factor, share) for factor in factors]
    return RepeatedEstimate.of(model, pooled, values, sum(factors, Factor.zero(model)))


def _by_factor(
    model: RobotModel, fitted: Sequence[Samples], name: Estimator
) -> tuple[RepeatedEstimate, list[Note]]:
    try:
        # The scatter over repetitions shows noise; least squares is enough for it.
        fit = fit_of(model, "wls" if name == "consistent" else name)
        return estimate_repetitions(
            model,
            fitted,
            fit_of(model, name),
            each=lambda some, factor: fit(some, factor).values,
        ), []
    except IdentificationError as error:
        if name != "consistent":
            raise
        problem = f"no physically consistent parameters were found: {error}"
        remedy = "use --estimator wls and read the consistency in its verdict"
        raise InputError(None, problem, field="--estimator consistent", remedy=remedy) from error


_LOSSES: Final[dict[str, Loss]] = {"huber": Huber(), "tukey": Tukey()}


def _robust(
    model: RobotModel, fitted: Sequence[Samples], name: str
) -> tuple[RepeatedEstimate, list[Note]]:
    fits: list[RobustEstimate] = []

    def fit(some: Sequence[Samples], total: Factor) -> Estimate:
        fits.append(robust_estimate(model, some, _LOSSES[name], total=total))
        return fits[-1].estimate

    result = estimate_repetitions(model, fitted, fit)
    of_all = fits[0]
    warnings: list[Note] = [
        ManyOutliers(model.joint_names[joint], float(of_all.outlying[joint]))
        for joint in np.flatnonzero(of_all.doubtful)
    ]
    if not of_all.converged:
        warnings.append(ReweightingNotConverged(of_all.iterations))
    return result, warnings


def _prior_contradictions(model: RobotModel, posterior: PosteriorEstimate) -> list[Note]:
    far = np.flatnonzero(np.abs(np.nan_to_num(posterior.normalized_change)) > _MAX_PRIOR_DEVIATION)
    if not far.size:
        return []
    names = tuple(model.parameter_names[k] for k in far)
    return [PriorContradicted(names, _MAX_PRIOR_DEVIATION)]


# Instruments


def smoothed_for_instruments(prepared: Prepared) -> Prepared:
    """Return fitted samples that are smoothed with a bandwidth of at least `MIN_IV_BANDWIDTH`."""
    model = prepared.sources.cell.model
    wide = prepared.settings.preprocessed(rigid_bandwidth=MIN_IV_BANDWIDTH)
    noiseless = replace(wide, noise_variance=(0.0,) * model.n_joints)
    fitted = tuple(
        samples
        if float(samples.position_bandwidth.min()) >= MIN_IV_BANDWIDTH
        else samples_of(source, prepared.sources.cell, noiseless)
        for source, samples in zip(prepared.sources.training, prepared.fitted, strict=True)
    )
    return replace(prepared, fitted=fitted, hedged=())


def _instrumental(model: RobotModel, prepared: Prepared) -> tuple[RepeatedEstimate, list[Note]]:
    """Fit with the commanded motion as instruments."""
    fitted = prepared.fitted
    factors = []
    plans: list[_Plan] = []
    try:
        for samples, source in zip(fitted, prepared.sources.training, strict=True):
            commanded = source.recording.commanded_position
            if commanded is None:
                raise IdentificationError("the recordings hold no commanded positions")
            plan = samples.motion.time - samples.origin, commanded
            lag = next(
                (known_lag for known_plan, known_lag in plans if same_plan(known_plan, plan)), None
            )
            planned = planned_motion(samples, commanded, lag=lag)
            if lag is None:
                plans.append((plan, planned.lag))
            factors.append(instrument_factor(model, samples, planned.motion, planned.usable))
        pooled = estimate_instrumental(model, sum(factors[1:], factors[0]))
        each = [estimate_instrumental(model, factor).estimate.values for factor in factors]
    except IdentificationError as error:
        problem = f"there are no instruments: {error}"
        remedy = "record the commanded positions as well, or use --estimator wls"
        raise InputError(None, problem, field="--estimator iv", remedy=remedy) from error
    result = RepeatedEstimate.of(model, pooled.estimate, each, total_factor(model, fitted))
    return result, [WeakInstruments(tuple(pooled.weak))] if pooled.weak else []
