"""Estimation of parameters from samples, with the prior of the arm."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hil.base.errors import ArchiveError, InputError
from hil.base.progress import Reporter
from hil.cell import Cell
from identification import IdentificationError, RobotModel
from identification.estimators.consistent import (
    SolverError,
    consistent_values,
)
from identification.estimators.delay import rate_products, with_uncertain_delay
from identification.estimators.elasticity import (
    ElasticTorque,
    expected_compliance,
    with_elastic_gears,
)
from identification.estimators.friction_form import (
    FormUncertainty,
    form_factor,
    form_uncertainty,
    with_drift,
    with_uncertain_form,
)
from identification.estimators.instrumental import (
    estimate_instrumental,
    planned_motion,
    same_plan,
)
from identification.estimators.least_squares import (
    RepeatedEstimate,
    estimate_repetitions,
)
from identification.estimators.load_friction import LoadFit, fit_with_load
from identification.estimators.losses import Huber, Loss, Tukey
from identification.estimators.prior import (
    BODY_SHARE,
    NOMINAL_SHARE,
    BodyPrior,
    PosteriorEstimate,
    body_prior,
    design_effect_of,
    fit_posterior,
    posterior_values,
)
from identification.estimators.robust import RobustEstimate, robust_estimate
from identification.estimators.torque_scale import with_torque_scale
from identification.factor.columns import instrument_factor
from identification.factor.estimate import Estimate, inverse_variance
from identification.factor.factor import QR_CONDITION, Factor, no_rows_message, total_factor
from identification.factor.normal_equations import solve
from identification.selection.settings import Settings, Strength
from identification.signals.samples import Samples
from identification.text import percentage
from identification.validation.calibration import Refit
from identification.validation.finding import joined
from identification.validation.residuals import drift_of_factors

from .cell_context import TorqueScale, torque_scale_of
from .estimators import OF_PRIOR, Estimator, fit_of, values_of
from .options import Options
from .prepared import MAX_RECORDINGS, Prepared, known_parameters, samples_of
from .sources import Sources

# Hz. A narrower smoother removes part of the motion from the regressor, a bias that instruments
# cannot correct. On simulated NS 16 logs with 100 to 1000 times the encoder noise, instrumental
# variables at the best bandwidth of least squares (7 to 14 Hz) were worse than least squares, and
# at 20 Hz always better.
MIN_IV_BANDWIDTH: Final = 20.0
# Difference between data and prior, in standard deviations, that is reported.
_MAX_PRIOR_DEVIATION: Final = 4.0

# Repetitions of a motion in which elastic gears add the same torque: no more are read for it.
_ALIKE: Final = 3

Array = NDArray[np.float64]

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
    warnings: tuple[str, ...]
    #: the pooled result, with the uncertainty of elastic gears in its covariance, and its change by
    #: the scale of the torques: no residual shows what they do to parameters
    stated: Estimate
    notes: tuple[str, ...]  #: what the intervals assume
    elastic: tuple[ElasticTorque, ...]  #: of the first recordings, at most `_ALIKE` of one motion
    forms: tuple[Factor, ...]  #: with more friction terms, of the same recordings
    form: FormUncertainty  #: whether the friction law lacks one of them


def fit_with_transmitted_load(
    cell: Cell, fitted: Sequence[Samples], strength: Strength
) -> LoadFit[Estimate]:
    """Return the posterior with the torque that the gears transmit, as a fixed point."""
    model = cell.model

    def fit(samples: Sequence[Samples]) -> Estimate:
        total = total_factor(model, samples)
        return Posterior.of(cell, total, "auto", strength).fit(total).estimate

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
        change = percentage(loaded.change, 1)
        notes += (
            f"the friction that grows with load still changed the torque by {change} in pass"
            f" {loaded.passes}",
        )
    return replace(carrying, fitted=loaded.samples, notes=notes)


def estimate_with(
    prepared: Prepared,
    options: Options,
    reporter: Reporter,
    factors: Sequence[Factor] = (),
    products: Array | None = None,
    elastic: Sequence[ElasticTorque] = (),
    forms: Sequence[Factor] = (),
) -> Estimation:
    """Estimate the parameters by `options.estimator`, with all applicable tests.

    `factors` by time of the fitted samples, the sum of their `rate_products`, and of the first of
    them the torques of elastic gears and `form_factor` are computed unless known (not for "iv").

    Raises:
        InputError: the archives lack data that the estimator needs.
        ArchiveError: a recording has no usable row.
    """
    cell, name, settings = prepared.sources.cell, options.estimator, prepared.settings
    model = cell.model
    _require_usable_rows(prepared)
    with reporter.task("estimating", 4) as task:
        fitted = smoothed_for_instruments(model, prepared) if name == "iv" else prepared.fitted
        task.advance(1, name)
        factors = factors or [Factor.by_time(model, samples) for samples in fitted]
        total = sum(factors, Factor.zero(model))
        posterior = Posterior.of(cell, total, name, settings.strength)
        posterior, beside, unsolved = posterior.solved(total)
        if name in OF_PRIOR:
            result = _posterior(model, fitted, posterior, beside.estimate, factors)
            warnings = unsolved
        else:
            result, warnings = _without_prior(prepared, fitted, name)
        if prepared.sources.same_motion:
            result = result.with_scatter()
        precision = posterior.precision if name in OF_PRIOR else None
        result = _with_uncertain_delay(prepared, result, fitted, products, precision)
        task.advance(1, "prior")
        of_prior = replace(beside, estimate=result.pooled)
        beside = of_prior if name in OF_PRIOR else posterior.fit(result.factor)
        warnings += _prior_contradictions(model, beside) if name == "prior" else []
        task.advance(1, "held-out motion")
        held_out = tuple(Factor.by_time(model, samples) for samples in prepared.held_out)
        task.advance(1)
    stated, notes, elastic = _stated(prepared, result, fitted, posterior, precision, elastic)
    form, forms = _form_of_friction(prepared, result, fitted, posterior, precision, forms)
    return Estimation(
        estimator=name,
        result=result,
        held_out=held_out,
        posterior=posterior,
        with_prior=beside,
        refit=refit_of(model, name, posterior),
        warnings=tuple(warnings),
        stated=_with_uncertain_friction(model, stated, form, factors),
        notes=notes,
        elastic=elastic,
        forms=forms,
        form=form,
    )


def _without_prior(
    prepared: Prepared, fitted: Sequence[Samples], name: Estimator
) -> tuple[RepeatedEstimate, list[str]]:
    """Fit by an estimator that has no prior; return its warnings as well."""
    model = prepared.sources.cell.model
    if name == "iv":
        result, warnings = _instrumental(model, prepared, fitted)
    elif name in _LOSSES:
        result, warnings = _robust(model, fitted, name)
    else:
        result, warnings = _by_factor(model, fitted, name)
    return result, warnings + _poorly_separated(result.pooled)


def _with_uncertain_delay(
    prepared: Prepared,
    result: RepeatedEstimate,
    fitted: Sequence[Samples],
    products: Array | None,
    precision: Array | None,
) -> RepeatedEstimate:
    variance = prepared.settings.delay_variance
    if not variance:
        return result
    model = prepared.sources.cell.model
    if products is None:
        products = np.asarray(sum(rate_products(model, samples) for samples in fitted))
    pooled = with_uncertain_delay(result.pooled, result.factor, products, variance, precision)
    return replace(result, pooled=pooled)


def _poorly_separated(estimate: Estimate) -> list[str]:
    if estimate.undetermined or estimate.condition <= QR_CONDITION:
        return []
    return [
        f"the scaled condition number is {estimate.condition:.2g}: the motion separates some"
        " parameters poorly (solved by QR)"
    ]


def _stated(
    prepared: Prepared,
    result: RepeatedEstimate,
    fitted: Sequence[Samples],
    posterior: Posterior,
    precision: Array | None,
    elastic: Sequence[ElasticTorque],
) -> tuple[Estimate, tuple[str, ...], tuple[ElasticTorque, ...]]:
    """Return the pooled estimate with what no residual shows in its covariance, and notes on it.

    Also the torques of elastic gears, of which `elastic` are known.
    """
    sources = prepared.sources
    scale = torque_scale_of(sources)
    estimate = with_uncertain_scale(result.pooled, result.factor, precision, scale)
    note = (
        "the intervals of the parameters are in units of the torque of this arm; absolute ones are"
        f" computed {scale.message}"
    )
    if sources.cell.file.drive_train is None:  # positions may be those of links, behind the gears
        return estimate, (note,), ()
    model = posterior.model
    values = estimate.values
    some = _enough(prepared, fitted)
    compliance = expected_compliance(model, some[0], values)
    elastic = (
        *elastic[: len(some)],
        *(ElasticTorque.of(model, more, values, compliance) for more in some[len(elastic) :]),
    )
    torque = ElasticTorque.total(elastic, len(fitted) / len(some))
    effect = posterior.design_effect
    believed = None if precision is None else posterior.believed(result.factor)
    estimate = with_elastic_gears(estimate, result.factor, torque, effect, precision, believed)
    return estimate, (note, "they allow for elastic gears between motors and links"), elastic


def _enough(prepared: Prepared, fitted: Sequence[Samples]) -> Sequence[Samples]:
    """Return the recordings that show what is alike in all: few of one motion."""
    return fitted[:_ALIKE] if prepared.sources.same_motion else fitted


def _form_of_friction(
    prepared: Prepared,
    result: RepeatedEstimate,
    fitted: Sequence[Samples],
    posterior: Posterior,
    precision: Array | None,
    forms: Sequence[Factor],
) -> tuple[FormUncertainty, tuple[Factor, ...]]:
    """Return the uncertainty of the friction law, and the factors of its terms; some are known."""
    model = prepared.sources.cell.model
    some = _enough(prepared, fitted)
    every = (
        *forms[: len(some)],
        *(form_factor(model, samples) for samples in some[len(forms) :]),
    )
    total = sum(every[1:], every[0])
    estimate = result.pooled
    if precision is not None:  # the scores of a stronger prior, or of possible bodies, are not zero
        estimate = replace(estimate, values=posterior.believed(result.factor))
    return form_uncertainty(model, estimate, result.factor, total, precision), every


def _with_uncertain_friction(
    model: RobotModel, estimate: Estimate, form: FormUncertainty, factors: Sequence[Factor]
) -> Estimate:
    """Return the estimate with form and significant drift of friction in its covariance."""
    estimate = with_uncertain_form(estimate, form)
    drift = drift_of_factors(model, estimate.values, factors)
    if drift is None:
        return estimate
    change = np.where(drift.significant, np.nan_to_num(drift.change), 0.0)
    return with_drift(model, estimate, change)


def _require_usable_rows(prepared: Prepared) -> None:
    """Raise ArchiveError for a recording without a usable row, for example a truncated one."""
    model = prepared.sources.cell.model
    for source, samples in zip(prepared.sources.training, prepared.fitted, strict=True):
        if not samples.usable.any():
            lasts = f"it lasts {np.ptp(samples.motion.time):.3g} s"
            raise ArchiveError(
                Path(source.name), f"{no_rows_message(model)} ({lasts})", remedy="leave it out"
            )


def with_uncertain_scale(
    estimate: Estimate, factor: Factor, precision: Array | None, scale: TorqueScale
) -> Estimate:
    """Return the estimate with its change by the uncertain scale of the torques.

    `precision` (p, p) is that of a prior beside the factor.
    """
    if not scale.std.any():
        return estimate
    weights = inverse_variance(estimate.noise_std**2)
    equations = factor.weighted(weights)
    if precision is not None:
        equations = equations._replace(A=equations.A + precision)
    return with_torque_scale(estimate, factor, weights, solve(equations).inverse, scale.std)


@dataclass(frozen=True, eq=False)
class Posterior:
    """Prior of an arm, and how strongly it counts."""

    model: RobotModel
    prior: BodyPrior
    design_effect: float  #: rows that count as one
    consistent: bool  #: whether parameters that no bodies have are excluded

    @classmethod
    def of(cls, cell: Cell, factor: Factor, name: str, strength: Strength) -> Posterior:
        """Return the posterior of an estimator; all but "auto" have the strength of the residuals.

        The bodies are as uncertain as `[nominal]` states; the estimator "prior" trusts them to
        `NOMINAL_SHARE` if it states nothing.
        """
        table = cell.file.nominal
        share = NOMINAL_SHARE if name == "prior" else BODY_SHARE
        if table is not None and "uncertainty" in table.model_fields_set:
            share = table.uncertainty or share
        if name != "auto":
            strength = Strength()
        prior = body_prior(
            cell.model,
            factor,
            share,
            known_parameters(cell),
            wide_rotors=strength.wide_rotors,
        )
        effect = design_effect_of(factor, prior.gaussian)
        prior = prior.with_weight(strength.weight)
        return cls(cell.model, prior, effect, strength.consistent)

    @property
    def precision(self) -> Array:
        """Information of what is believed, as it counts beside that of all rows (p, p)."""
        return self.design_effect * self.prior.belief.gaussian.information

    def believed(self, factor: Factor) -> Array:
        """Return the parameters (p,) by what is believed, without a stronger prior."""
        return posterior_values(factor, self.prior.belief.gaussian, self.design_effect)[0]

    def free(self, factor: Factor, share: float = 1.0) -> PosteriorEstimate:
        """Fit a factor that is this share of the rows, whatever bodies the parameters need."""
        effect = share * self.design_effect
        return fit_posterior(self.model, factor, self.prior.gaussian, effect)

    def weights(self, factor: Factor, share: float = 1.0) -> Array:
        """Return the weights of the joints (n,): inverse variances of their residuals."""
        return posterior_values(factor, self.prior.gaussian, share * self.design_effect)[1]

    def fit(self, factor: Factor, share: float = 1.0) -> PosteriorEstimate:
        """Fit a factor that is this share of the rows, with the prior counting as for all."""
        result = self.free(factor, share)
        if not self.consistent:
            return result
        values = self.values(factor, share)
        noise = factor.residual_rms(values)
        return replace(result, estimate=replace(result.estimate, values=values, noise_std=noise))

    def values(self, factor: Factor, share: float = 1.0) -> Array:
        """Return the parameters (p,) from a factor that is this share of the rows."""
        effect = share * self.design_effect
        values, weights = posterior_values(factor, self.prior.gaussian, effect)
        if not self.consistent:
            return values
        return consistent_values(self.model, factor, weights, values, self.prior, effect)

    def solved(self, factor: Factor) -> tuple[Posterior, PosteriorEstimate, list[str]]:
        """Fit a factor, without restriction to possible bodies if that fails, and say why."""
        try:
            return self, self.fit(factor), []
        except SolverError as error:
            free = replace(self, consistent=False)
            return free, free.fit(factor), [f"all bodies were allowed because {error}"]


# Estimators


def refit_of(model: RobotModel, name: Estimator, posterior: Posterior) -> Refit:
    """Return the parameters (p,) by an estimator as a function of a factor."""
    return posterior.values if name in OF_PRIOR else values_of(model, name)


def _posterior(
    model: RobotModel,
    fitted: Sequence[Samples],
    posterior: Posterior,
    pooled: Estimate,
    factors: Sequence[Factor],
) -> RepeatedEstimate:
    share = 1.0 / len(fitted)
    return estimate_repetitions(
        model,
        fitted,
        lambda *_: pooled,
        # The prior counts for a part as for the whole, so that the scatter is that of the noise.
        each=lambda _, factor: posterior.values(factor, share),
        factors=factors,
    )


def _by_factor(
    model: RobotModel, fitted: Sequence[Samples], name: Estimator
) -> tuple[RepeatedEstimate, list[str]]:
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
) -> tuple[RepeatedEstimate, list[str]]:
    fits: list[RobustEstimate] = []

    def fit(some: Sequence[Samples], total: Factor) -> Estimate:
        fits.append(robust_estimate(model, some, _LOSSES[name], total=total))
        return fits[-1].estimate

    result = estimate_repetitions(model, fitted, fit)
    of_all = fits[0]
    warnings = [
        f"{percentage(of_all.outlying[joint])} of the rows of {model.joint_names[joint]} deviate by"
        " more than four standard deviations: an unmodelled effect rather than outliers, which a"
        " robust loss would hide; use --estimator wls"
        for joint in np.flatnonzero(of_all.doubtful)
    ]
    if not of_all.converged:
        warnings.append(f"the reweighting did not converge in {of_all.iterations} iterations")
    return result, warnings


def _prior_contradictions(model: RobotModel, posterior: PosteriorEstimate) -> list[str]:
    far = np.flatnonzero(np.abs(np.nan_to_num(posterior.normalized_change)) > _MAX_PRIOR_DEVIATION)
    if not far.size:
        return []
    return [
        f"data and prior of {joined([model.parameter_names[k] for k in far])} differ by more"
        f" than {_MAX_PRIOR_DEVIATION:g} standard deviations: correct the CAD values, or their"
        " uncertainty in [nominal]"
    ]


# Instruments


def smoothed_for_instruments(model: RobotModel, prepared: Prepared) -> tuple[Samples, ...]:
    """Return the fitted samples, smoothed with a bandwidth of at least `MIN_IV_BANDWIDTH`."""
    wide = prepared.settings.preprocessed(rigid_bandwidth=MIN_IV_BANDWIDTH)
    noiseless = replace(wide, noise_variance=(0.0,) * model.n_joints)
    return tuple(
        samples
        if float(samples.position_bandwidth.min()) >= MIN_IV_BANDWIDTH
        else samples_of(source, prepared.sources.cell, noiseless)
        for source, samples in zip(prepared.sources.training, prepared.fitted, strict=True)
    )


def _instrumental(
    model: RobotModel, prepared: Prepared, fitted: Sequence[Samples]
) -> tuple[RepeatedEstimate, list[str]]:
    """Fit with the commanded motion as instruments."""
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
    warnings = [f"the instruments are too weak for {joined(pooled.weak)}"] if pooled.weak else []
    return result, warnings
